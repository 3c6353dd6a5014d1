"""The environment contract: spaces, info, seeding, rewards, and the checkers of its consumers."""

import gc
import os
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_sb3

from ae_env.scenes.polyhaven import list_assets
from tests.ae_env.environments import assert_equal, make_env, rollout

#: Pages of memory of this process.
STATM = Path("/proc/self/statm")
INFO_KEYS = {
    *("scene_id", "state", "iso", "exposure_time", "f_number", "ev100"),
    *("clipped_high", "clipped_low", "excess_noise", "predicted_error", "modules", "rewards"),
}


@pytest.mark.parametrize("task", [name for name in gym.registry if name.startswith("ae_env/")])
@pytest.mark.parametrize(
    "arguments",
    [{}, {"observation": "statistics"}, {"observation": "linear"}, {"observation": "dn"}],
    ids=str,
)
def test_both_checkers_have_nothing_to_say(task: str, arguments: dict[str, Any]) -> None:
    env = make_env(task, render_mode="rgb_array", **arguments).unwrapped
    check_env(env)  # warnings are errors
    if not arguments:
        check_sb3(env)


@pytest.mark.parametrize("kind", ["uint8", "linear", "dn"])
def test_same_seed_same_rollout(kind: str) -> None:
    first = rollout(7, observation=kind)
    assert_equal(rollout(7, observation=kind), first)
    assert (first[0][0]["raw"] != rollout(8)[0][0]["raw"]).any()
    unseen = make_env(observation=kind, sensors=False)
    assert set(unseen.observation_space) == {"raw", "settings"}
    np.testing.assert_array_equal(unseen.reset(seed=7)[0]["raw"], first[0][0]["raw"])


@pytest.mark.skipif(not STATM.is_file(), reason="the memory of a process is Linux's to tell")
def test_a_long_run_takes_no_more_memory() -> None:
    env, rng, pages = make_env(max_episode_steps=None), np.random.default_rng(0), list[int]()
    for episode in range(60):
        env.reset(seed=episode)
        for _ in range(30):
            env.step(rng.integers(64))
        gc.collect()
        pages.append(int(STATM.read_text().split()[1]))
    assert (max(pages[20:]) - pages[20]) * os.sysconf("SC_PAGE_SIZE") < 16 * 2**20


def test_spaces_are_as_documented() -> None:
    env = make_env(resolution=40)
    for name, low, high, shape, dtype in (
        *(("raw", 0, 255, (4, 40, 40), np.uint8), ("sensors", -1, 1, (2,), np.float32)),
        ("settings", -1, 1, (3,), np.float32),
    ):
        assert env.observation_space[name] == gym.spaces.Box(low, high, shape, dtype)
    linear, dn = (make_env(observation=kind).observation_space["raw"] for kind in ("linear", "dn"))
    assert (linear.dtype, dn.dtype) == (np.float32, np.uint16)
    assert dn.high.max() == env.unwrapped.camera.white_level
    assert env.action_space == gym.spaces.Discrete(64)
    assert env.get_wrapper_attr("action_masks")().tolist() == [True] * 64


def test_info_has_the_same_keys_and_plain_numbers() -> None:
    env = make_env(with_oracle=True)
    _, first = env.reset(seed=0)
    _, reward, terminated, truncated, second = env.step(5)
    parts = {"brightness", "highlights", "shadows", "noise", "sharpness", "score"}
    for info in (first, second):
        assert set(info) == INFO_KEYS | {"oracle_state", "regret"}
        assert set(info["rewards"]) == parts
        assert all(isinstance(v, int | float | str | dict) for v in info.values())
    assert (type(reward), type(terminated), type(truncated)) == (float, bool, bool)
    assert (second["state"], second["iso"], second["f_number"]) == (5, 100.0, 5.6)
    assert second["ev100"] == pytest.approx(np.log2(5.6**2 / second["exposure_time"]))
    assert second["modules"].startswith("exposure")


def test_reset_options_choose_scene_state_and_frame() -> None:
    env = make_env(lighting={"kind": "step", "stops": -3, "at": 5})
    scene = env.unwrapped.scenes[3].scene_id
    for chosen in (scene, 3):
        info = env.reset(seed=0, options={"scene": chosen, "state": 17})[1]
        assert (info["scene_id"], info["state"]) == (scene, 17)
    shown, episodes = [], []
    for frame in (0, 5):
        options = {"scene": 3, "state": 17, "frame": frame}
        shown.append(env.reset(seed=1, options=options)[0]["raw"].mean())
        episodes.append(env.unwrapped.episode())
    assert shown[1] < shown[0]
    # The draws do not depend on the options: the episode is the same otherwise.
    assert len({(episode.speed, episode.defocus) for episode in episodes}) == 1


def test_noise_depends_on_the_frame_and_on_nothing_else() -> None:
    env = make_env()
    first, _ = env.reset(seed=2, options={"state": 20})
    second, *_ = env.step(20)
    assert (first["raw"] != second["raw"]).any()  # the same state again, other noise
    env.reset(seed=2, options={"state": 40})
    np.testing.assert_array_equal(env.step(20)[0]["raw"], second["raw"])


def test_global_random_state_is_left_alone() -> None:
    drawn = []
    for work in (lambda: None, lambda: rollout(1)):
        torch.manual_seed(0)
        np.random.seed(0)  # noqa: NPY002
        work()
        drawn.append((float(torch.rand(1)), np.random.rand()))  # noqa: NPY002
    assert drawn[0] == drawn[1]


def test_returned_arrays_are_never_reused() -> None:
    env = make_env(with_oracle=True)
    frames = [env.reset(seed=0)]
    frames += [env.step(9)[::4] for _ in range(5)]
    arrays = [array for observation, _ in frames for array in observation.values()]
    copies = [array.copy() for array in arrays]
    env.step(60)
    env.reset()
    for i, (array, copy) in enumerate(zip(arrays, copies, strict=True)):
        np.testing.assert_array_equal(array, copy)
        assert not any(np.shares_memory(array, other) for other in arrays[i + 1 :])
    assert len({id(info) for _, info in frames}) == len(frames)


def test_costs_are_subtracted_and_shown() -> None:
    costs = {"flicker": 0.5, "switch": 0.25}
    env, free = make_env(costs=costs), make_env()
    _, info = env.reset(seed=0, options={"state": 0})
    free.reset(seed=0, options={"state": 0})
    assert (info["rewards"]["flicker"], info["rewards"]["switch"]) == (0.0, 0.0)
    before = env.reset(seed=0, options={"state": 0})[0]["raw"].mean() / 255.0
    for state, changed in ((0, 0.0), (1, 1 / 3), (63, 1.0)):  # state 1 to 63: all but none alike
        observation, reward, _, _, info = env.step(state)
        score = free.step(state)[1]
        mean = observation["raw"].mean() / 255.0
        assert info["rewards"]["switch"] == pytest.approx(changed)
        assert info["rewards"]["flicker"] == pytest.approx(abs(mean - before), abs=1e-6)
        expected = score - 0.5 * abs(mean - before) - 0.25 * changed
        assert reward == pytest.approx(expected, abs=1e-6)
        assert info["rewards"]["score"] == pytest.approx(score)
        before = mean


def test_oracle_and_regret_agree_with_the_expected_scores() -> None:
    env = make_env(with_oracle=True)
    for seed in range(3):
        env.reset(seed=seed)
        info = env.step(30)[4]
        scores = env.unwrapped.expected_scores()
        assert scores[info["oracle_state"]] == pytest.approx(scores.max(), abs=1e-7)
        assert info["regret"] == pytest.approx(scores.max() - scores[30])


def test_clipped_fractions_are_those_of_the_frame() -> None:
    env = make_env(observation="linear")
    for state in (0, 63):  # the darkest but for ISO and aperture, and the brightest
        observation, info = env.reset(seed=0, options={"state": state})
        raw = observation["raw"]
        assert info["clipped_high"] == pytest.approx((raw >= 1 - 1e-6).mean(), abs=1e-6)
        assert info["clipped_low"] == pytest.approx((raw <= 2.0**-10).mean(), abs=1e-6)


def test_motion_and_depth_can_be_switched_off() -> None:
    env = make_env(motion="none", depth="far", noise=False)
    for seed in range(4):
        observation, info = env.reset(seed=seed)
        assert info["modules"] == "exposure"
        assert observation["sensors"][0] == -1.0
        assert info["rewards"]["sharpness"] == 1.0
    moving = make_env(motion=0.5, depth=2.0)
    longest = max(moving.unwrapped.grid.states, key=lambda s: s.exposure_time / s.f_number)
    state = moving.unwrapped.grid.states.index(longest)
    info = moving.reset(seed=0, options={"state": state})[1]
    assert info["modules"] == "exposure+defocus+motion_blur+noise"


def test_a_third_of_the_episodes_stands_still_and_defocus_stays_in_range() -> None:
    env = make_env(resolution=36).unwrapped
    speeds, defocus = [], []
    for seed in range(400):
        env.core.begin(np.array([0]), [np.random.default_rng(seed)])
        speeds.append((env.episode().speed, env.episode().subject_speed))
        defocus.append(env.episode().defocus)
    shakes, subject_moves = np.array(speeds).T > 0.0
    assert np.mean(~shakes & ~subject_moves) == pytest.approx(1 / 3, abs=0.08)  # 3.4 sigma
    assert np.mean(subject_moves) == pytest.approx(1 / 3, abs=0.08)
    assert np.mean(subject_moves & ~shakes) == pytest.approx(0.1, abs=0.05)
    assert min(defocus) >= 0.1
    assert max(defocus) <= 8.0
    assert np.median(defocus) == pytest.approx(1.0, rel=0.25)


@pytest.mark.slow
@pytest.mark.parametrize("scenes", ["bundled", "polyhaven"])
def test_oracle_is_spread_over_every_control(scenes: str) -> None:
    """No single value of a control may be the oracle's in more than half of the episodes."""
    if scenes == "polyhaven" and any(asset.path is None for asset in list_assets()):
        pytest.skip("needs the maps of Poly Haven (AE_ENV_DATA)")
    env = make_env(scenes=scenes, split="test", resolution=64).unwrapped
    states = []
    for i in range(3 * len(env.scenes)):
        wanted = [{"scene": i % len(env.scenes)}]
        env.core.begin(np.array([0]), [np.random.default_rng(i)], wanted)
        states.append(env.score_table().oracle)
    for control in env.grid.controls(np.array(states)).T:
        assert np.bincount(control).max() <= 0.5 * len(states)


def test_cached_light_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blurred light is cached where memory allows; frames must not depend on it."""
    cached = rollout(5, depth=3.0, motion=0.5)
    monkeypatch.setattr("ae_env.episodes.core.LIGHT_CACHE_BYTES", 0)
    assert_equal(rollout(5, depth=3.0, motion=0.5), cached)
