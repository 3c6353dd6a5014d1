from __future__ import annotations

import numpy as np
import pytest

from agents import Policy, evaluate, fit_policies, make_policy
from agents.episodes import episode_batches, make_envs
from agents.policy import PolicyContext

OPTIONS = {"scenes": "bundled:small", "split": "test", "resolution": 36}


@pytest.fixture(scope="module")
def small() -> PolicyContext:
    envs = make_envs(OPTIONS, num_envs=4, frames=2)
    context = PolicyContext.from_envs(envs)
    envs.close()
    return context


@pytest.fixture(scope="module")
def result(small):
    policies = {n: make_policy(n, small) for n in ("random", "oracle", "matrix:P")}
    policies["random*3"] = [make_policy("random", small) for _ in range(3)]
    calls = []
    found = evaluate(
        policies,
        OPTIONS,
        episodes_per_scene=2,
        frames=3,
        batch=7,
        progress=lambda *a: calls.append(a),
    )
    assert calls[-1][0] == calls[-1][1]
    return found


def test_context_describes_the_environment(small):
    assert len(small.grid) == 64
    assert small.has_sensors
    assert small.delay == 0


def test_shapes_and_oracle(result):
    episodes = len(result.scene_ids)
    assert result.scores.shape == (episodes, 3, 64)
    assert result.tracks["random*3"].states.shape == (3, episodes, 3)
    assert len(set(result.scene_ids.tolist())) == episodes // 2
    np.testing.assert_array_equal(
        result.tracks["oracle"].states[0], np.repeat(result.oracle_states[:, None], 3, axis=1)
    )
    assert result.tracks["oracle"].privileged
    oracle = result.episode_metrics("oracle")
    assert np.abs(oracle["regret"]).max() < 1e-12
    assert oracle["ev_error"].max() == 0.0


def test_metrics_are_those_of_the_states_chosen(result):
    track = result.tracks["matrix:P"]
    found = result.episode_metrics("matrix:P")
    e = 5
    chosen = [result.scores[e, t, track.states[0, e, t]] for t in range(3)]
    assert found["score"][0, e] == pytest.approx(np.mean(chosen))
    assert found["regret"][0, e] == pytest.approx(np.mean(result.scores[e].max(-1) - chosen))
    assert ((track.clipped_high >= 0) & (track.clipped_high <= 1)).all()
    assert found["regret_delayed"] == pytest.approx(found["regret"])  # no delay


def test_episodes_do_not_depend_on_the_batch_size(small, result):
    again = evaluate(
        {"matrix:P": make_policy("matrix:P", small)},
        OPTIONS,
        episodes_per_scene=2,
        frames=3,
        batch=32,
    )
    for name in ("scene_ids", "start_states", "scores", "hard", "groups"):
        np.testing.assert_array_equal(getattr(again, name), getattr(result, name))
    np.testing.assert_array_equal(again.tracks["matrix:P"].states, result.tracks["matrix:P"].states)
    np.testing.assert_array_equal(
        again.tracks["matrix:P"].image_mean, result.tracks["matrix:P"].image_mean
    )


def test_batches_cover_every_scene_once_per_episode():
    envs = make_envs(OPTIONS, num_envs=6, frames=2)
    batches = list(episode_batches(envs, episodes_per_scene=2, seed=0))
    scenes = np.concatenate([b.scenes[b.valid] for b in batches])
    assert (np.bincount(scenes) == 2).all()
    assert all(b.action_masks.shape == (6, 64) for b in batches)
    envs.close()


class Bad(Policy):
    answer: object = None

    def act(self, observations, action_masks=None):
        return self.answer


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (np.zeros(3, int), r"must return 8 integers, one per camera"),
        (np.zeros(8), r"dtype float64"),
        (np.full(8, 64), r"state 64 is not in \[0, 64\)"),
        (None, r"must return 8 integers"),
    ],
)
def test_wrong_actions_name_the_policy(small, answer, message):
    policy = Bad(small)
    policy.answer = answer
    with pytest.raises(ValueError, match=f"policy 'mine'.*{message}"):
        evaluate({"mine": policy}, OPTIONS, frames=1, batch=8)


def test_arguments_are_checked(small):
    with pytest.raises(ValueError, match=r"`frames` \(=0\)"):
        evaluate({"random": make_policy("random", small)}, OPTIONS, frames=0)
    with pytest.raises(ValueError, match="`policies`"):
        evaluate({}, OPTIONS)


def test_delay_scores_the_frame_that_was_exposed(small):
    options = {**OPTIONS, "delay": 1}
    result = evaluate({"oracle": make_policy("oracle", small)}, options, frames=3, batch=8)
    states = result.tracks["oracle"].states[0]
    np.testing.assert_array_equal(states[:, 0], result.start_states)
    np.testing.assert_array_equal(states[:, 1], result.oracle_states)
    found = result.episode_metrics("oracle")
    np.testing.assert_allclose(found["regret_delayed"], 0.0, atol=1e-12)
    assert found["regret"].mean() > 0.01


def test_fit_makes_tuned_and_fixed_policies_better_than_random(small):
    names = ("best_fixed", "average:tuned", "average:tuned_blind", "random", "average:P")
    policies = {n: make_policy(n, small) for n in names}
    options = {**OPTIONS, "split": "train"}
    fit_policies(policies, options, seed=1, batch=20)
    result = evaluate(policies, options, frames=3, batch=20, seed=77)
    score = {n: float(result.episode_metrics(n)["score"].mean()) for n in names}
    assert score["average:tuned"] > score["average:P"] > score["random"]
    assert score["best_fixed"] > score["random"]
    assert policies["average:tuned"].regression.features.shape[1] == 3
    assert policies["average:tuned_blind"].regression.features.shape[1] == 1
    again = make_policy("average:tuned", small)
    fit_policies({"again": again}, options, seed=1, batch=20)
    np.testing.assert_array_equal(
        again.regression.scores, policies["average:tuned"].regression.scores
    )
