"""The environment's arguments: every mistake is named before any work is done."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import pytest
import torch

import ae_env  # noqa: F401  (registers the environment)
from ae_env.options import EnvOptions
from ae_env.scenes import Scene
from simulator import CameraSettings, get_camera

STATE = CameraSettings(100.0, 1 / 64, 4.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scorrer": "noise"}, "did you mean `scorer`"),
        ({"split": "tset"}, "did you mean 'test'"),
        ({"observation": "float"}, "`observation`"),
        ({"crop": "centre"}, "`crop`"),
        ({"reward": "score"}, "`reward`"),
        ({"resolution": 35}, r"\[36, 4096\]"),
        ({"resolution": 64.0}, "integer"),
        ({"resolution": True}, "integer"),
        ({"motion": "far"}, "`motion`"),
        ({"motion": -0.5}, "`motion`"),
        ({"motion": float("nan")}, "`motion`"),
        ({"depth": "none"}, "did you mean|must be one of"),
        ({"delay": -1}, "`delay`"),
        ({"delay": 17}, "`delay`"),
        ({"noise": "bnak"}, "did you mean 'bank'"),
        ({"noise": 1}, "`noise`"),
        ({"tolerance": -0.1}, "`tolerance`"),
        ({"tolerance": float("inf")}, "`tolerance`"),
        ({"costs": {"flicer": 1.0}}, "did you mean 'flicker'"),
        ({"costs": {"switch": -1.0}}, "costs"),
    ],
)
def test_mistakes_are_named(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        EnvOptions.from_kwargs(arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scenes": "bundeld"}, "`scenes`"),
        ({"camera": "nikon_z7"}, "did you mean 'nikon_z6'"),
        ({"scorer": "balanc"}, "did you mean 'balanced'"),
        ({"grid": "third"}, "`grid`"),
        ({"lighting": "tunel"}, "did you mean 'tunnel'"),
    ],
)
def test_unknown_names_are_refused_by_make(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        gym.make("ae_env/AutoExposure-v0", **{"scenes": "bundled:small", **arguments})


def test_defaults_are_the_documented_ones() -> None:
    options = EnvOptions()
    assert (options.scenes, options.split, options.scorer) == ("bundled", "train", "balanced")
    assert (options.observation, options.resolution, options.reward) == ("uint8", 64, "capture")
    assert (options.sensors, options.noise, options.with_oracle, options.delay) == (
        *(True, True, False),
        0,
    )
    assert options.tolerance == 0.1
    assert len(options.make_grid()) == 64
    assert options.make_camera() == get_camera("nikon_z6")


def test_scenes_are_loaded_once_and_splits_are_disjoint() -> None:
    options = {"scenes": "bundled:small", "resolution": 36}
    train = EnvOptions(**options).load_scenes()
    again = EnvOptions(**options).load_scenes()
    assert all(a is b for a, b in zip(again, train, strict=True))
    again.clear()  # a list of one's own
    assert len(EnvOptions(**options).load_scenes()) == len(train)
    test = EnvOptions(split="test", **options).load_scenes()
    assert {s.group for s in train}.isdisjoint({s.group for s in test})
    both = EnvOptions(split="all", **options).load_scenes()
    assert [s.scene_id for s in both] == [s.scene_id for s in train + test]


def test_cameras_of_one_name_have_scenes_of_their_own() -> None:
    camera = get_camera("nikon_z6")
    assert camera.colour_matrix is not None
    mixed = tuple(tuple(0.9 * v for v in row) for row in camera.colour_matrix[::-1])
    other = replace(camera, colour_matrix=mixed)
    first, second = (
        EnvOptions(scenes="bundled:small", resolution=36, camera=c).load_scenes()[0]
        for c in (camera, other)
    )
    assert (first.camera, second.camera) == (camera, other)


def test_scenes_of_ones_own_and_another_camera() -> None:
    scenes = EnvOptions(scenes="bundled:small", resolution=64).load_scenes()[:2]
    env = gym.make("ae_env/AutoExposure-v0", scenes=scenes, resolution=64, camera="canon_70d")
    env.reset(seed=0)
    assert env.unwrapped.camera.name == "canon_70d"
    assert len(env.unwrapped.scenes) == 2


def test_a_black_scene_in_unknown_light_is_refused_by_name() -> None:
    camera = get_camera("nikon_z6")
    black = Scene.from_array(torch.zeros(4, 40, 40), STATE, camera, scene_id="cap")
    with pytest.raises(ValueError, match=r"scene 'cap': `light` is 0 .* give `illuminance`"):
        EnvOptions(scenes=[black], resolution=36).load_scenes()
    lit = replace(black, illuminance=10.0)
    assert EnvOptions(scenes=[lit], resolution=36).load_scenes()[0].ev100 == 2.0
