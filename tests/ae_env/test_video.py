"""`AutoExposureVideo-v0`: its defaults, its delays, and both environments of it."""

import inspect
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_sb3

import ae_env
from ae_env.lighting.moving import KIND_SETS
from tests.ae_env.environments import SMALL, assert_same, check_parity, make_envs

ID = "ae_env/AutoExposureVideo-v0"
VIDEO: dict[str, Any] = {
    "grid": "video",
    "lighting": "moving",
    "delay": {"iso": 1, "exposure_time": 2, "f_number": 2},
    "costs": {"flicker": 1.0},
}


def test_both_checkers_accept_it():
    env = gym.make(ID, **SMALL)
    check_env(env.unwrapped, skip_render_check=True)
    check_sb3(env.unwrapped)


def test_it_is_the_other_environment_with_its_defaults():
    """The same frames as `AutoExposure-v0` with these arguments; 96 steps; defaults may change."""
    video = gym.make_vec(ID, num_envs=3, **SMALL)
    plain = make_envs(3, max_episode_steps=96, **VIDEO)
    assert_same(video.reset(seed=5), plain.reset(seed=5))
    for action in (7, 40, 63):
        assert_same(video.step(np.full(3, action)), plain.step(np.full(3, action)))
    assert video.unwrapped.max_episode_steps == gym.spec(ID).max_episode_steps == 96
    for kind in (ae_env.AutoExposureVideoEnv, ae_env.AutoExposureVideoVectorEnv):
        shown = inspect.signature(kind).parameters
        assert {name: shown[name].default for name in VIDEO} == VIDEO
    changed = gym.make(ID, delay=0, grid="default", **SMALL)
    assert changed.unwrapped.delays == (0, 0, 0)
    assert changed.unwrapped.grid == ae_env.ExposureGrid.default()
    with pytest.raises(TypeError, match="did you mean 'lighting'"):
        gym.make(ID, lightning="moving")


@pytest.mark.parametrize("mode", ["NEXT_STEP", "SAME_STEP"])
def test_one_and_many_are_the_same(mode: str) -> None:
    check_parity(3, 7, mode, max_episode_steps=4, with_oracle=True, **VIDEO)


def test_each_control_has_its_own_delay():
    """ISO in the frame after the next, exposure time and aperture in the one after that."""
    envs = make_envs(1, max_episode_steps=None, **(VIDEO | {"lighting": "static"}))
    grid = envs.unwrapped.grid
    envs.reset(seed=0, options={"state": [grid.index(0, 0, 0)]})
    actions = [(1, 1, 1), (2, 2, 2), (3, 3, 3), (0, 1, 2), (0, 0, 0)]
    # Frame n + 1 has the ISO of action n - 1, and the time and the aperture of action n - 2.
    expected = [(0, 0, 0), (1, 0, 0), (2, 1, 1), (3, 2, 2), (0, 3, 3)]
    for action, shown in zip(actions, expected, strict=True):
        info = envs.step(np.array([grid.index(*action)]))[4]
        assert grid.controls(info["state"][0]).tolist() == list(shown)
        state = grid[grid.index(*shown)]
        assert (info["iso"][0], info["exposure_time"][0]) == (state.iso, state.exposure_time)


def test_equal_delays_of_all_controls_are_one_number():
    same = dict.fromkeys(("iso", "exposure_time", "f_number"), 2)
    assert make_envs(1, delay=same).unwrapped.core.options.delay == 2


@pytest.mark.parametrize("split", ["train", "test"])
def test_the_light_is_of_the_kinds_of_the_split(split: Any) -> None:
    core = gym.make(ID, split=split, **SMALL).unwrapped.core
    assert core.episodes.lighting.drawn_from == KIND_SETS[split]
    chosen = {"kind": "moving", "kinds": ["pans"]}
    core = gym.make(ID, split=split, lighting=chosen, **SMALL).unwrapped.core
    assert core.episodes.lighting.drawn_from == ("pans",)
