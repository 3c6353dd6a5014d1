"""Minari datasets: what is in them, and that nothing unfinished stays."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from ae_env import UserCodeError
from agents import Policy, PolicyContext, make_policy
from agents.recording import record_dataset

TASK = "ae_env/AutoExposure-v0"
SMALL = {"scenes": "bundled:small", "resolution": 36, "split": "test"}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return tmp_path


@pytest.fixture
def context() -> PolicyContext:
    return PolicyContext.from_envs(gym.make_vec(f"ae_env:{TASK}", num_envs=1, **SMALL))


@pytest.mark.parametrize("name", ["centre_weighted:P", "oracle"])
def test_recorded_episodes_happen_again(name: str, folder: Path, context: PolicyContext) -> None:
    policy = make_policy(name, context)
    dataset = record_dataset(policy, name, TASK, SMALL, "ae/mine-v0", episodes=3, seed=5)
    assert (dataset.total_episodes, dataset.total_steps) == (3, 24)
    assert dataset.storage.metadata["algorithm_name"] == name
    env = dataset.recover_environment()
    metadata = dataset.storage.get_episode_metadata(range(3))
    for seed, episode, own in zip((5, 6, 7), dataset.iterate_episodes(), metadata, strict=True):
        assert own["seed"] == seed
        shown, _ = env.reset(seed=seed, options=own["options"])
        for step, action in enumerate(episode.actions):
            for key, value in shown.items():
                np.testing.assert_array_equal(episode.observations[key][step], value)
            shown, reward, *_ = env.step(action)
            assert reward == pytest.approx(episode.rewards[step], abs=1e-9)
        assert episode.truncations.tolist() == [False] * 7 + [True]


class Stops(Policy):
    def act(self, observations, action_masks=None):
        raise KeyError("lost")


def test_what_is_unfinished_is_removed(folder: Path, context: PolicyContext) -> None:
    with pytest.raises(UserCodeError, match=r"'stops'.*KeyError: 'lost'"):
        record_dataset(Stops(context), "stops", TASK, SMALL, "mine-v0", episodes=1)
    assert list(folder.iterdir()) == []


def test_names_are_checked_first(folder: Path, context: PolicyContext) -> None:
    policy = make_policy("random", context)
    record_dataset(policy, "random", TASK, SMALL, "mine-v0", episodes=1)
    for wrong in ("mine", "a/mine-v0", "mine-v0"):  # namespaces have two letters or more; is there
        with pytest.raises(ValueError, match=rf"`out` \(='{wrong}'\)"):
            record_dataset(policy, "random", TASK, SMALL, wrong, episodes=1)
