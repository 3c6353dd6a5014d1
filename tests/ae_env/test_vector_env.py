"""The native vector environment against SyncVectorEnv of single ones, and in other processes."""

import os
import subprocess
import sys
from collections import deque
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import NumpyToTorch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.ae_env.environments import assert_same, check_parity, make_envs
from tests.strategies import SEEDS

RICH = {"with_oracle": True, "observation": "linear", "lighting": "sine", "delay": 1}
RICH["costs"] = {"flicker": 0.1, "switch": 0.1}


@pytest.mark.parametrize(
    ("mode", "extra"), [(mode.name, RICH) for mode in AutoresetMode] + [("SAME_STEP", {})]
)
def test_parity_with_sync_vector_env(mode: str, extra: dict[str, Any]) -> None:
    check_parity(11, 9, mode, max_episode_steps=3, **extra)


LIGHTINGS: list[Any] = [
    "static",
    "sine",
    {"kind": "flicker", "frequency": 500, "duty": 0.2},
    {"kind": "schedule", "ev": [0, 1, -1]},
]


@pytest.mark.parametrize("lighting", LIGHTINGS, ids=str)
def test_parity_in_every_light(lighting: Any) -> None:
    extra = {"lighting": lighting, "with_oracle": True, "scorer": {"balanced": 0.7, "banding": 0.3}}
    check_parity(5, 4, max_episode_steps=3, delay=2, **extra)


@pytest.mark.parametrize("lighting", LIGHTINGS, ids=str)
def test_delayed_settings_meet_the_light_of_their_frame(lighting: Any) -> None:
    """The light of a frame does not wait; `info` and the score are of the settings in force."""
    extra = {"lighting": lighting, "motion": "none", "depth": "far", "max_episode_steps": None}
    delayed, direct = make_envs(delay=3, **extra), make_envs(**extra)
    start = np.array([3, 20, 41])
    for envs in (delayed, direct):
        envs.reset(seed=9, options={"state": start})
    actions = np.random.default_rng(2).integers(64, size=(5, 3))
    in_force = np.concatenate([np.tile(start, (3, 1)), actions])
    for frame in range(5):
        mine, theirs = delayed.step(actions[frame]), direct.step(in_force[frame])
        np.testing.assert_array_equal(mine[4]["state"], in_force[frame])
        times = [delayed.unwrapped.grid[s].exposure_time for s in in_force[frame]]
        np.testing.assert_array_equal(mine[4]["exposure_time"], times)
        assert_same(mine, theirs, f"frame {frame}")


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_modes_have_the_names_and_values_of_gymnasiums_enum(mode: AutoresetMode) -> None:
    for given_as in (mode, mode.name, mode.value):
        envs = make_envs(autoreset_mode=given_as, max_episode_steps=1)
        assert envs.metadata["autoreset_mode"] is mode
    if mode is not AutoresetMode.SAME_STEP:  # Gymnasium's `final_obs` is an array of objects
        envs = NumpyToTorch(envs)  # everything else is a number
        assert envs.reset(seed=0)[1]["modules"].dtype == torch.int64
        assert envs.step(torch.tensor([5, 6, 7]))[4]["rewards"]["score"].shape == (3,)


def test_resets_that_are_needed() -> None:
    envs = make_envs(autoreset_mode="DISABLED", max_episode_steps=1, render_mode="rgb_array")
    first = {"options": {"reset_mask": np.array([True, False, True])}}
    for early in (envs.render, lambda: envs.step([0] * 3), lambda: envs.reset(**first)):
        with pytest.raises(gym.error.ResetNeeded):
            early()
    envs.reset(seed=0)
    envs.step([0] * 3)
    with pytest.raises(gym.error.ResetNeeded, match="reset_mask"):
        envs.step([0] * 3)


def test_reset_options_per_environment() -> None:
    envs = make_envs()
    ids = [envs.unwrapped.scenes[i].scene_id for i in (0, 2, 4)]
    _, info = envs.reset(seed=0, options={"scene": ids, "state": [1, 2, 3]})
    names = envs.unwrapped.scene_ids
    assert [names[i] for i in info["scene_id"]] == ids
    np.testing.assert_array_equal(envs.unwrapped.states, [1, 2, 3])
    _, info = envs.reset(options={"scene": ids[1], "state": 9})
    assert [names[i] for i in info["scene_id"]] == [ids[1]] * 3
    assert info["state"].tolist() == [9] * 3
    states = torch.tensor([4, 5, 6])
    for own, wanted in ((states, [4, 5, 6]), (deque([4, 5, 6]), [4, 5, 6]), (states[0], [4] * 3)):
        envs.reset(options={"state": own})
        np.testing.assert_array_equal(envs.unwrapped.states, wanted)


def test_scores_and_pictures_of_every_environment() -> None:
    envs = make_envs(render_mode="rgb_array", with_oracle=True)
    _, info = envs.reset(seed=0)
    scores = envs.unwrapped.expected_scores()
    np.testing.assert_allclose(scores[range(3), info["oracle_state"]], scores.max(1), atol=1e-7)
    pictures = envs.render()
    assert len(pictures) == 3
    assert all(p.dtype == np.uint8 and p.shape[2] == 3 and p.shape[0] >= 256 for p in pictures)
    assert make_envs().render() is None


@pytest.mark.parametrize("mode", [mode.name for mode in AutoresetMode])
def test_a_masked_reset_shows_the_others_as_they_were(mode: str) -> None:
    """Also where the caller has written to the arrays meanwhile."""
    envs = make_envs(autoreset_mode=mode)
    shown = [envs.reset(seed=0)[0]]
    for mask in ([True, False, False], [False, True, False]):
        shown.append(envs.step(np.array([1, 2, 3]))[0])
        wanted = {name: values.copy() for name, values in shown[-1].items()}
        for observation in shown:
            for values in observation.values():
                values[...] = 0
        shown.append(envs.reset(options={"reset_mask": np.array(mask)})[0])
        for name, values in wanted.items():
            others = ~np.array(mask)
            np.testing.assert_array_equal(shown[-1][name][others], values[others])


@pytest.mark.slow
def test_workers_that_are_forked_from_a_process_with_environments(tmp_path: Path) -> None:
    # Gymnasium's default: torch's threads do not survive the fork, a worker must not need them,
    # not even to draw the scenes, as nothing is cached yet.
    code = (
        "import gymnasium as gym\n"
        "envs = gym.make_vec('ae_env:ae_env/AutoExposure-v0', num_envs=2,"
        " vectorization_mode='async', scenes='bundled:snow', split='test', resolution=36)\n"
        "envs.reset(seed=0)\n"
        "print(envs.step([3, 40])[1].shape)\n"
        "envs.close()\n"
    )
    variables = {k: v for k, v in os.environ.items() if k != "OMP_NUM_THREADS"}
    variables["AE_ENV_CACHE"] = str(tmp_path)
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=variables, capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stdout) == (0, "(2,)\n"), done.stderr


STATM = Path("/proc/self/statm")


@pytest.mark.slow
@pytest.mark.skipif(not STATM.exists(), reason="needs /proc")
def test_memory_stays_flat() -> None:
    envs, pages = make_envs(64, autoreset_mode="SAME_STEP"), list[int]()
    envs.reset(seed=0)
    for step, actions in enumerate(np.random.default_rng(0).integers(64, size=(200, 64))):
        envs.step(actions)
        if step in (50, 199):
            pages.append(int(STATM.read_text().split()[1]))
    assert 4096 * (pages[1] - pages[0]) < 6 * 2**20


def _episodes(seeds: list[int], actions: np.ndarray, **arguments: Any) -> list[Any]:
    """Of each seed's episode what all of its frames show: raws, rewards and states."""
    envs = make_envs(len(seeds), **arguments)
    observation, info = envs.reset(seed=seeds)
    frames = [(*observation.values(), info["state"], info["excess_noise"])]
    for action in actions:
        observation, reward, _, _, info = envs.step(action)
        frames.append((*observation.values(), reward, info["state"], info["clipped_high"]))
    ones = [slice(i, i + 1) for i in range(len(seeds))]
    return [[[column[one] for column in frame] for frame in frames] for one in ones]


@settings(max_examples=8)
@given(
    st.lists(SEEDS, min_size=2, max_size=5, unique=True),
    SEEDS,
    st.randoms(use_true_random=False),
    st.sampled_from(["uint8", "linear", "dn"]),
    st.sampled_from(["static", "sine"]),
    st.sampled_from([True, "exact", False]),
)
def test_episodes_do_not_depend_on_their_index(seeds, seed, random, observation, lighting, noise):
    """A permutation of the seeds permutes the episodes, which are also those of one alone."""
    arguments = {"observation": observation, "lighting": lighting, "noise": noise}
    actions = np.random.default_rng(seed).integers(0, 64, (10, len(seeds)))  # beyond one episode
    order = random.sample(range(len(seeds)), len(seeds))
    first = _episodes(seeds, actions, **arguments)
    permuted = _episodes([seeds[i] for i in order], actions[:, order], **arguments)
    assert_same([first[i] for i in order], permuted)
    assert_same(first[:1], _episodes(seeds[:1], actions[:, :1], **arguments))
    if noise:
        shown = {tuple(frame[0].tobytes() for frame in frames) for frames in first}
        assert len(shown) == len(seeds)
