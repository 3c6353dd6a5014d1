"""Scenes drawn on demand: the same ones, and no more than are needed."""

import pickle
from collections.abc import Callable, Iterator
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch

from ae_env.scenes import Scene, load_scenes
from ae_env.scenes.bundled import DrawnScenes, SceneGroup, bundled_scenes
from ae_env.scenes.load import _LOADED
from ae_env.scenes.scene import SceneRequest
from simulator.camera import get_camera
from simulator.utils.cache import disk_cache
from tests.ae_env.environments import assert_equal

CAMERA = get_camera("nikon_z6")


@pytest.fixture
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path))
    _LOADED.clear()
    yield
    _LOADED.clear()


def made(names: list[str]) -> Callable[[], list[Scene]]:
    def make() -> list[Scene]:
        made_now.append(names)
        light = torch.full((4, 36, 36), 0.1 * len(made_now))
        reference = next(iter(load_scenes("bundled:small", "test", camera=CAMERA))).reference
        return [Scene.from_array(light, reference, CAMERA, scene_id=name) for name in names]

    return make


made_now: list[list[str]] = []


@pytest.mark.usefixtures("empty_cache")
@pytest.mark.parametrize("part", ["night", "photograph"])
def test_drawn_one_by_one_they_are_those_drawn_together(part: str, monkeypatch) -> None:
    together = load_scenes(f"bundled:{part}", "test", camera=CAMERA, resolution=36)
    request = SceneRequest("test", CAMERA, 36)
    loaded = bundled_scenes(request, part=part)
    monkeypatch.setenv("AE_ENV_CACHE", "/dev/null/none")  # nothing is stored, nothing is found
    drawn = bundled_scenes(request, part=part)
    assert loaded.loaded == list(range(len(together)))
    assert drawn.loaded != loaded.loaded
    assert list(drawn.scene_ids) == [scene.scene_id for scene in together]
    for index in np.random.default_rng(0).permutation(len(drawn)).tolist():
        for one in (drawn[index], loaded[index]):
            assert one.scene_id == together[index].scene_id
            assert one.content == together[index].content
            assert one.reference == together[index].reference
            assert one.ev100 == together[index].ev100
        assert drawn[index] is drawn[index]


@pytest.mark.usefixtures("empty_cache")
def test_no_more_are_drawn_than_are_asked_for_and_the_last_one_stores_them() -> None:
    made_now.clear()
    groups = [["a"], ["b", "c"], ["d"]]
    scenes = DrawnScenes("some", [SceneGroup(g, made(g)) for g in groups], "0" * 64)
    assert made_now == [["a"]]  # what cannot be drawn must fail at once
    assert (len(scenes), scenes.scene_ids) == (4, ("a", "b", "c", "d"))
    assert scenes[-2].scene_id == "c"
    assert [scene.scene_id for scene in scenes[:3]] == ["a", "b", "c"]
    assert made_now == [["a"], ["b", "c"]]
    assert disk_cache().get("0" * 64) is None
    with pytest.raises(IndexError):
        scenes[4]
    copied = pickle.loads(pickle.dumps(scenes))
    assert made_now == [["a"], ["b", "c"], ["d"]]
    assert disk_cache().get("0" * 64) is not None
    for one, other in zip(scenes, copied, strict=True):
        assert one.scene_id == other.scene_id
        assert one.content == other.content
    assert len(made_now) == 3


@pytest.mark.usefixtures("empty_cache")
@pytest.mark.parametrize("name", ["AutoExposure-v0", "ExposureBracket-v0"])
def test_episodes_do_not_depend_on_when_scenes_are_drawn(name: str) -> None:
    """Which scene an episode shows, too: the draw must not wait for what is drawn."""

    def episodes() -> list[tuple[object, ...]]:
        _LOADED.clear()
        envs = gym.make_vec(
            f"ae_env/{name}", num_envs=3, scenes="bundled:spot_light", split="test", resolution=36
        )
        core = envs.unwrapped.core  # type: ignore[attr-defined]
        loaded.append(len(core.scenes.loaded))
        found: list[tuple[object, ...]] = [envs.reset(seed=5)]
        found += [envs.step(np.full(3, action)) for action in range(0, 21, 3)]
        unpickled = pickle.loads(pickle.dumps(core))
        assert_equal(unpickled.episodes.columns(), core.episodes.columns())
        return found

    loaded: list[int] = []
    first = episodes()
    load_scenes("bundled:spot_light", "test", camera=CAMERA, resolution=36)  # draws and stores all
    assert_equal(first, episodes())
    assert loaded[0] < loaded[1] == 10
