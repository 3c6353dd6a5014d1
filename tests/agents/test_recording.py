"""Recorded episodes, and what policies are fitted on where the scenes are too few to train on."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ae_env import UserCodeError
from agents import Policy, PolicyContext, make_policy
from agents.recording import record_dataset
from agents.rollouts import fitting_arguments, training_arguments
from tests.ae_env.environments import make_envs
from tests.ae_env.scene_files import GRID, write_raws

TASK = "ae_env/AutoExposure-v0"
SMALL = {"scenes": "bundled:small", "resolution": 36, "split": "test"}


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path / "minari"


@pytest.fixture
def context() -> PolicyContext:
    return PolicyContext.from_envs(make_envs(1, split="test"))


@pytest.mark.parametrize("name", ["centre_weighted:P", "oracle"])
def test_recorded_episodes_happen_again(name: str, context: PolicyContext) -> None:
    policy = make_policy(name, context)
    dataset = record_dataset(policy, name, TASK, SMALL, "ae/mine-v0", episodes=3, seed=5)
    assert (dataset.total_episodes, dataset.total_steps) == (3, 24)
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


def test_what_is_unfinished_is_removed_and_names_are_checked(folder, context):
    with pytest.raises(UserCodeError, match=r"'stops'.*KeyError: 'lost'"):
        record_dataset(Stops(context), "stops", TASK, SMALL, "mine-v0", episodes=1)
    assert list(folder.iterdir()) == []
    policy = make_policy("random", context)
    record_dataset(policy, "random", TASK, SMALL, "mine-v0", episodes=1)
    for wrong in ("mine", "a/mine-v0", "mine-v0"):  # namespaces have two letters or more; is there
        with pytest.raises(ValueError, match=rf"`out` \(='{wrong}'\)"):
            record_dataset(policy, "random", TASK, SMALL, wrong, episodes=1)


STATES = {name: list(values) for name, values in asdict(GRID).items()}


def test_recorded_grids_are_trained_for_on_their_own_states(tmp_path: Path) -> None:
    write_raws(tmp_path / "a")
    named = f"recorded:{tmp_path}"
    for spec in (named, {"recorded": str(tmp_path)}):
        assert training_arguments(spec, 36) == ({"scenes": "bundled", "grid": STATES}, True)
    assert training_arguments(str(tmp_path), 36) == ({"scenes": "bundled"}, True)
    assert training_arguments("bundled") == ({"scenes": "bundled"}, False)
    judged = {"scenes": named, "split": "test", "grid": "video"}
    assert fitting_arguments(judged, 36) == {**judged, "scenes": "bundled"}  # what is named stays


def test_a_fitted_policy_is_recorded_and_judged_on_a_recorded_grid(ae_env, tmp_path, monkeypatch):
    few: tuple[dict[str, Any], bool] = ({"scenes": "bundled:small", "grid": STATES}, True)
    monkeypatch.setattr("agents.rollouts.training_arguments", lambda *_: few)
    write_raws(tmp_path / "grid" / "a")
    (tmp_path / "env.yaml").write_text("{scenes: 'recorded:grid', split: train, resolution: 36}")
    options = ("--env", "env.yaml", "--split", "all", "--episodes", "1")  # no scene to train on
    code, _, error = ae_env("record", "--policy", "average", "-o", "ae/mine-v0", *options)
    assert code == 0, error
    write_raws(tmp_path / "grid" / "b", tuple(GRID)[1:], seed=1)
    policies = ("--policy", "best_fixed", "--policy", "average", "--policy", "oracle")
    code, out, _ = ae_env("evaluate", *policies, *options, "--frames", "2", "--out", "out")
    assert (code, "best_fixed" in out) == (0, True)
