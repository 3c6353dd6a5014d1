"""`evaluate`: every policy on the same episodes, whatever the batch or the forbidden states."""

import dataclasses
from contextlib import closing

import numpy as np
import pytest
import torch

from ae_env import UserCodeError
from ae_env.scorers import make_scorer
from ae_env.scorers.score_table import ScoreTables
from agents import Policy, evaluate, fit_policies, make_policy, run_plan
from agents.evaluation.evaluation_plan import EvaluationPlan, plan_scenes
from agents.policy import PolicyContext
from agents.rollouts import make_envs

OPTIONS = {"scenes": "bundled:small", "split": "test", "resolution": 36}


@pytest.fixture(scope="module")
def small() -> PolicyContext:
    with closing(make_envs(OPTIONS, num_envs=4, frames=2)) as envs:
        return PolicyContext.from_envs(envs)


@pytest.fixture(scope="module")
def few() -> dict:
    return {**OPTIONS, "scenes": plan_scenes(EvaluationPlan(environment=OPTIONS, max_scenes=8))}


@pytest.fixture(scope="module")
def result(small, few):
    policies = {n: make_policy(n, small) for n in ("random", "oracle", "matrix:P")}
    policies["random*3"] = [make_policy("random", small) for _ in range(3)]
    calls = []
    sizes = {"episodes_per_scene": 2, "frames": 3, "batch": 7}
    found = evaluate(policies, few, **sizes, progress=lambda *a: calls.append(a))
    assert calls[-1][0] == calls[-1][1]
    return found


def test_shapes_and_oracle(result):
    episodes = len(result.scene_ids)
    assert result.scores.shape == result.allowed.shape == (episodes, 3, 64)
    assert result.tracks["random*3"].states.shape == (3, episodes, 3)
    assert len(set(result.scene_ids.tolist())) == episodes // 2
    np.testing.assert_array_equal(
        result.tracks["oracle"].states[0], np.repeat(result.oracle_states[:, None], 3, axis=1)
    )
    assert result.tracks["oracle"].privileged
    assert result.tracks["matrix:P"].ms_alone > 0
    oracle = result.episode_metrics("oracle")
    assert np.abs(oracle["regret"]).max() < 1e-12
    assert oracle["ev_error"].max() == 0.0


def test_the_batch_size_changes_nothing_and_a_plan_is_the_same(small, few, result, tmp_path):
    policies = {"matrix:P": make_policy("matrix:P", small)}
    again = evaluate(policies, few, episodes_per_scene=2, frames=3, batch=32)
    entries = {"starts": ("random",), "seeds": (0, 1), "frames": 3, "policies": ("matrix:P",)}
    plan = EvaluationPlan(environment=OPTIONS, max_scenes=8, **entries)
    for other in (again, run_plan(plan, tmp_path)["static"]):
        for name in ("scene_ids", "start_states", "scores", "hard", "groups", "speed", "defocus"):
            np.testing.assert_array_equal(getattr(other, name), getattr(result, name))
        for name in ("states", "image_mean", "clipped_high"):
            tracks = (one.tracks["matrix:P"] for one in (other, result))
            np.testing.assert_array_equal(*(track.arrays[name] for track in tracks))


class Bad(Policy):
    answer: object = None

    def act(self, observations, action_masks=None):
        return self.answer


def test_wrong_actions_name_the_policy_and_arguments_are_checked(small, few):
    policy = Bad(small)
    for policy.answer in (
        *(np.zeros(3, int), np.zeros(8), np.full(8, 64), np.full(8, -1)),
        *([[0], [0, 1]], torch.zeros(8, requires_grad=True)),
    ):
        with pytest.raises(UserCodeError, match="policy 'mine'"):
            evaluate({"mine": policy}, few, frames=1)
    policies = {"random": make_policy("random", small)}
    for name, value in (("frames", 0), ("seed", -1), ("batch", 0), ("episodes_per_scene", 1.5)):
        with pytest.raises(ValueError, match=rf"`{name}` \(={value}\)"):
            evaluate(policies, OPTIONS, **{name: value})
    for given, options, name in ((policies, {"scens": 1}, "scenes"), ({}, OPTIONS, "policies")):
        with pytest.raises(ValueError, match=f"`{name}`"):
            evaluate(given, options)


@pytest.fixture(scope="module")
def fitted(small) -> dict:
    names = ("best_fixed", "average:tuned", "average:tuned_blind", "random", "average:P")
    policies = {n: make_policy(n, small) for n in names}
    fit_policies(policies, OPTIONS, seed=1, batch=20)
    return policies


def test_forbidden_states_are_neither_chosen_nor_taken(small, few, fitted):
    """Scenes allow a third of the states each, another third every time."""
    masks = [np.arange(64) % 3 == i % 3 for i in range(6)]
    scenes = zip(few["scenes"], masks, strict=False)
    holes = {**OPTIONS, "scenes": [dataclasses.replace(s, allowed=mask) for s, mask in scenes]}
    names = ("random", "best_fixed", "oracle", "spot:P", "zhang:A", "average:S", "matrix:M")
    policies = {n: make_policy(n, small) for n in (*names, "rpi_agc")}
    policies["best_fixed"].mean_scores = np.linspace(0, 1, 64)
    policies["tuned"] = fitted["average:tuned"]
    result = evaluate(policies, holes, frames=4, episodes_per_scene=2, batch=5)
    allowed = result.allowed[:, 0]
    assert (allowed.sum(axis=1) <= 22).all()
    rows = np.arange(len(allowed))
    assert allowed[rows, result.start_states].all()
    for name, track in result.tracks.items():
        assert allowed[rows[:, None], track.states[0]].all(), name
    best_fixed = np.where(allowed, np.arange(64), -1).max(axis=1)
    assert (result.tracks["best_fixed"].states[0] == best_fixed[:, None]).all()
    # The oracle is the best of the allowed states, and random the mean over them.
    best = np.where(allowed, result.scores[:, 0], -1.0).max(axis=1)
    np.testing.assert_allclose(result.oracle, best, atol=1e-7)
    assert np.abs(result.episode_metrics("oracle")["regret"]).max() < 1e-6
    mean = (result.scores[:, 0] * allowed).sum(axis=1) / allowed.sum(axis=1)
    np.testing.assert_allclose(result.random, mean)
    assert (result.scores[:, 0].max(axis=1) > best + 1e-3).any()  # a forbidden one would be better
    stubborn = Bad(small)
    stubborn.answer = np.zeros(6, int)
    with pytest.raises(UserCodeError, match="policy 'mine'"):
        evaluate({"mine": stubborn}, holes, frames=1)


def test_delay_scores_the_frame_that_was_exposed(small, few):
    options = {**few, "delay": 1}
    result = evaluate({"oracle": make_policy("oracle", small)}, options, frames=3, batch=8)
    states = result.tracks["oracle"].states[0]
    np.testing.assert_array_equal(states[:, 0], result.start_states)
    np.testing.assert_array_equal(states[:, 1], result.oracle_states)
    found = result.episode_metrics("oracle")
    np.testing.assert_allclose(found["regret_delayed"], 0.0, atol=1e-12)
    assert found["regret"].mean() > 0.01


def test_fit_makes_tuned_and_fixed_policies_better_than_random(small, fitted):
    result = evaluate(fitted, {**OPTIONS, "split": "train"}, frames=3, batch=20, seed=77)
    score = {n: float(result.episode_metrics(n)["score"].mean()) for n in fitted}
    assert score["average:tuned"] > score["average:P"] > score["random"]
    assert score["best_fixed"] > score["random"]
    assert fitted["average:tuned"].regression.features.shape[1] == 3
    assert fitted["average:tuned_blind"].regression.features.shape[1] == 1
    again = make_policy("average:tuned", small)
    fit_policies({"again": again}, OPTIONS, seed=1, batch=7)
    first = fitted["average:tuned"].regression.scores
    np.testing.assert_array_equal(again.regression.scores, first)


def test_other_scorers_rate_chosen_states_over_frames_then_groups(tmp_path):
    plan = EvaluationPlan(environment=OPTIONS, max_scenes=3, frames=3, starts=("dark",))
    scorers = {"other_scorers": ("brightness", "sharpness"), "other_scorer_scenes": 2}
    plan = plan.changed(policies=("matrix:P", "random"), **scorers)
    result = run_plan(plan, tmp_path)["static"]
    table = result.other_scores
    assert list(table) == ["brightness", "sharpness"]
    # By hand: two scenes of the three, each a group of its own.
    tables = ScoreTables(result.grid, plan.options().make_camera(), make_scorer("brightness"))
    for policy, track in result.tracks.items():
        means = [tables.table(result.scenes[j]).mean[track.states[0, j]].mean() for j in (0, 1)]
        assert table["brightness"][policy] == pytest.approx(np.mean(means), abs=1e-9)
