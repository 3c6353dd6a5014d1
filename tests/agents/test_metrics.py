from __future__ import annotations

import numpy as np
import pytest

from agents import metrics

EV = np.array([4.0, 4.05, 5.0, 6.0, 8.0])
# One episode, two frames, five states.
Q = np.array([[[0.2, 0.6, 0.895, 0.9, 0.1], [0.2, 0.6, 0.8, 0.9, 0.1]]])
ALL = np.ones((1, 1, 5), bool)


def test_scores_of_chosen_oracle_and_random():
    states = np.array([[1, 3]])
    np.testing.assert_allclose(metrics.score_of(Q, states), [[0.6, 0.9]])
    np.testing.assert_allclose(metrics.oracle_score(Q, ALL), [[0.9, 0.9]])
    np.testing.assert_allclose(metrics.random_score(Q, ALL), [[0.539, 0.52]])
    some = np.array([True, True, False, False, True])
    np.testing.assert_allclose(metrics.oracle_score(Q, some), [[0.6, 0.6]])
    np.testing.assert_allclose(metrics.random_score(Q, some), [[0.3, 0.3]])


def test_training_seeds_broadcast_against_the_same_scores():
    states = np.array([[[1, 3]], [[0, 0]]])  # (K=2, E=1, T=2)
    np.testing.assert_allclose(metrics.score_of(Q, states), [[[0.6, 0.9]], [[0.2, 0.2]]])


def test_regret_given_ev_looks_at_the_same_exposure_only():
    # State 0 shares its EV with state 1 (0.05 EV apart), the others stand alone.
    states = np.array([[0, 2]])
    np.testing.assert_allclose(metrics.regret_given_ev(Q, states, EV, ALL), [[0.4, 0.0]])
    masked = np.array([True, False, True, True, True])
    np.testing.assert_allclose(metrics.regret_given_ev(Q, states, EV, masked), [[0.0, 0.0]])


def test_ev_error_is_to_the_nearest_state_that_is_good_enough():
    # Good in frame 0: states 2 and 3 (within 0.01 of 0.9); in frame 1 only state 3.
    errors = metrics.ev_error(Q, np.array([[4, 4]]), EV, ALL)
    np.testing.assert_allclose(errors, [[2.0, 2.0]])
    errors = metrics.ev_error(Q, np.array([[0, 0]]), EV, ALL)
    np.testing.assert_allclose(errors, [[1.0, 2.0]])
    assert metrics.ev_error(Q, np.array([[3, 3]]), EV, ALL).max() == 0.0


@pytest.mark.parametrize(
    ("errors", "frames", "converged"),
    [
        ([0, 0, 0, 0], 1, True),
        ([1, 0.3, 0, 1 / 3], 2, True),
        ([0, 0, 1, 0], 4, True),
        ([0, 0, 0, 1], 4, False),
        ([1, 1, 1, 1], 4, False),
    ],
)
def test_frames_to_converge(errors, frames, converged):
    found = metrics.frames_to_converge(np.array(errors, float))
    assert (int(found[0]), bool(found[1])) == (frames, converged)


@pytest.mark.parametrize(
    ("evs", "over", "turns"),
    [
        ([0, 4, 4, 4], 0.0, 0),
        ([0, 6, 4, 4], 2.0, 1),
        ([9, 2, 5, 4], 2.0, 2),
        ([4, 5, 3, 4], 1.0, 2),  # ends where it began: largest excursion
        ([0, 3, 3.1, 3], 0.1, 0),  # the same exposure split otherwise
        ([4, 4, 4, 4], 0.0, 0),
    ],
)
def test_overshoot_and_reversals(evs, over, turns):
    evs = np.array([evs], float)
    np.testing.assert_allclose(metrics.overshoot(evs), [over], atol=1e-12)
    assert metrics.reversals(evs).tolist() == [turns]


def test_flicker_counts_frames_of_the_same_light_only():
    means = np.array([[0.1, 0.2, 0.2, 0.5], [0.0, 0.0, 0.0, 0.0]])
    np.testing.assert_allclose(metrics.flicker(means, np.array([True])), [0.4 / 3, 0.0])
    static = np.array([[True, True, False], [False, False, False]])
    np.testing.assert_allclose(metrics.flicker(means, static), [0.05, 0.0])


def test_delayed_oracle_acts_on_what_it_saw_earlier():
    scores = np.zeros((1, 4, 3))
    for frame, best in enumerate((0, 1, 2, 2)):
        scores[0, frame, best] = 1.0
    allowed = np.ones((1, 3), bool)
    start = np.array([2])
    for delay, expected in ((0, [1, 1, 1, 1]), (1, [0, 0, 0, 1]), (9, [0, 0, 1, 1])):
        found = metrics.delayed_oracle_score(scores, allowed, start, delay)
        np.testing.assert_array_equal(found, [expected])


def test_normalised_score_at_its_ends_and_weighting():
    random, oracle = np.array([0.2, 0.4]), np.array([0.6, 1.0])
    assert metrics.normalised_score(random, random, oracle) == 0.0
    assert metrics.normalised_score(oracle, random, oracle) == pytest.approx(1.0)
    half = np.array([0.6, 0.4])  # all of the first group's 0.4, none of the second's 0.6
    assert metrics.normalised_score(half, random, oracle) == pytest.approx(0.4)


def test_group_means_weigh_episodes_within_a_group():
    values = np.array([[1.0, 3.0, 10.0], [0.0, 0.0, 1.0]])
    means, names = metrics.group_means(values, np.array(["b", "b", "a"]))
    assert names.tolist() == ["a", "b"]
    np.testing.assert_allclose(means, [[10.0, 2.0], [1.0, 0.0]])
