"""Every learner of `examples/learners.py` trains, and is judged from its file as it was."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from ae_env.observation import encode_settings
from ae_env.wrappers import VectorContinuousActions
from agents import make_policy
from agents.evaluation.engine import evaluate
from agents.policy import PolicyContext
from agents.rollouts import make_envs as envs_of
from tests.ae_env.environments import make_envs

PROGRAM = Path(__file__).parents[2] / "examples" / "learners.py"
spec = importlib.util.spec_from_file_location("learners", PROGRAM)
assert spec is not None
assert spec.loader is not None
learners = importlib.util.module_from_spec(spec)
spec.loader.exec_module(learners)


@pytest.mark.parametrize("name", learners.NAMES)
def test_a_learner_trains_and_its_file_is_judged_alike(name: str, tmp_path: Path) -> None:
    off_policy = name in ("dqn", "qrdqn", "sac", "drl_ae")
    changed = {"learning_starts": 64} if off_policy else {}
    moving = learners.load(name)[0]["task"] != learners.STILL
    exam = ("bundled:small", "test", 2 if moving else None)
    given = {"out": tmp_path, "scenes": "bundled:small", "exam": exam, **changed}
    if name == "a2c":  # a run of other settings is trained anew
        learners.train(name, 1, 1_024, **given, learning_rate=0.1)
    rows = learners.train(name, 1, 1_024, **given)
    assert learners.train(name, 1, 1_024, **given) == rows  # read: the seconds are the same
    assert rows[-1]["frames"] == 1_024
    assert rows[-1]["wall_seconds"] > 0.0
    test = {"scenes": "bundled:small", "split": "test", "observation": "statistics"}
    test |= {"grid": "video", "delay": learners.DELAY} if moving else {}
    context = PolicyContext.from_envs(envs_of(test, num_envs=1, frames=1))
    weights = tmp_path / f"{name}-1.safetensors"
    policy = make_policy(f"{PROGRAM}:Learnt?weights={weights}", context)
    if moving:  # without the tables of its light once more, which take longest
        again = learners.EXAMS[moving, *exam].score(policy)
    else:
        again = evaluate({"it": policy}, test).normalised("it")
    assert again == pytest.approx(rows[-1]["score"], abs=1e-6)


def test_actions_as_the_wrapper_has_them_and_changes_of_them() -> None:
    """A change of zero keeps the settings; of 4 stops of time, the nearest of the grid is."""
    envs = make_envs(num_envs=64)
    wrapper, grid = VectorContinuousActions(envs), envs.unwrapped.grid
    actions = np.random.default_rng(0).uniform(-1.2, 1.2, (64, 3)).astype(np.float32)
    envs.reset(seed=0)
    wanted = wrapper.actions(actions)
    np.testing.assert_array_equal(learners.ApexActions(grid, 64).states(actions), wanted)
    changes = learners.ApexActions(grid, 64, stops=4.0)
    changes.begin({"settings": encode_settings(grid.apex)})
    np.testing.assert_array_equal(changes.states(np.zeros((64, 3))), np.arange(64))
    states = changes.states(np.tile([0.0, 1.0, 0.0], (64, 1)))
    shorter = {1 / 2: 1 / 15, 1 / 15: 0.008, 0.008: 0.001, 0.001: 0.001}  # the nearest to 1/16
    for state, before in zip(states.tolist(), grid.states, strict=True):
        wanted = before.iso, shorter[before.exposure_time], before.f_number
        assert (grid[state].iso, grid[state].exposure_time, grid[state].f_number) == wanted


def test_missing_weights_are_named() -> None:
    context = PolicyContext.from_envs(make_envs(1))
    with pytest.raises(ValueError, match=r"`weights` \(=.none\.safetensors.\)"):
        make_policy(f"{PROGRAM}:Learnt?weights=none.safetensors", context)
