"""Metrics of known trajectories, and intervals and ranks against SciPy."""

import numpy as np
import pytest
import scipy.stats

from agents.evaluation import intervals, metrics
from agents.evaluation.intervals import MIN_GROUPS, difference_interval, rank, score_interval

EV = np.array([4.0, 4.05, 5.0, 6.0, 8.0])
# One episode, two frames, five states.
Q = np.array([[[0.2, 0.6, 0.895, 0.9, 0.1], [0.2, 0.6, 0.888, 0.9, 0.1]]])
ALL = np.ones((1, 1, 5), bool)


def test_scores_of_chosen_oracle_and_random():
    states = np.array([[1, 3]])
    for own in (states, states[0]):
        np.testing.assert_allclose(metrics.score_of(Q, own), [[0.6, 0.9]])
    seeds = np.array([states, [[0, 0]]])  # (K=2, E=1, T=2)
    np.testing.assert_allclose(metrics.score_of(Q, seeds), [[[0.6, 0.9]], [[0.2, 0.2]]])
    np.testing.assert_allclose(metrics.oracle_score(Q, ALL), [[0.9, 0.9]])
    np.testing.assert_allclose(metrics.random_score(Q, ALL), [[0.539, 0.5376]])
    some = np.array([True, True, False, False, True])
    np.testing.assert_allclose(metrics.oracle_score(Q, some), [[0.6, 0.6]])
    np.testing.assert_allclose(metrics.random_score(Q, some), [[0.3, 0.3]])


def test_regret_given_ev_looks_at_the_same_exposure_only():
    # State 0 shares its EV with state 1 (0.05 EV apart), the others stand alone.
    states = np.array([[0, 2]])
    np.testing.assert_allclose(metrics.regret_given_ev(Q, states, EV, ALL), [[0.4, 0.0]])
    masked = np.array([True, False, True, True, True])
    np.testing.assert_allclose(metrics.regret_given_ev(Q, states, EV, masked), [[0.0, 0.0]])


def test_ev_error_is_to_the_nearest_state_that_is_good_enough():
    # Good in frame 0: states 2 and 3 (within 0.01 of 0.9); in frame 1, 0.012 below, only state 3.
    for state, errors in ((4, [2, 2]), (0, [1, 2]), (2, [0, 1]), (3, [0, 0])):
        found = metrics.ev_error(Q, np.full((1, 2), state), EV, ALL)
        np.testing.assert_allclose(found, [errors])


@pytest.mark.parametrize(
    ("errors", "frames", "converged"),
    [
        ([0, 0, 0, 0], 1, True),
        ([1, 0.3, 0, 1 / 3], 2, True),
        ([1, 0.34, 0, 0], 3, True),
        ([0, 0, 1, 0], 4, True),
        ([0, 0, 0, 1], 4, False),
        ([1, 1, 1, 1], 4, False),
    ],
)
def test_frames_to_converge(errors, frames, converged):
    found = metrics.frames_to_converge(np.array(errors, float))
    assert (int(found[0]), bool(found[1])) == (frames, converged)
    found = metrics.frames_to_converge(np.array([1.0, 0.5, 0.5]), tolerance=0.5)
    assert int(found[0]) == 2  # the largest error that counts
    found = metrics.frames_to_converge(np.array([[0.0, 0, 0, 4, 2, 1, 0]]), since=np.array([4]))
    assert found[0].tolist() == [3]  # of those after a step that frame 4 shows


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
    for own in (evs, np.stack([evs, evs])):  # (E, T), (K, E, T)
        np.testing.assert_allclose(metrics.overshoot(own), np.full(own.shape[:-1], over), atol=1e-9)
        np.testing.assert_array_equal(metrics.reversals(own), np.full(own.shape[:-1], turns))


@pytest.mark.parametrize(
    ("light", "since"),
    [
        ([1, 1, 1, 1, 1, 1], 0),  # static: from the reset frame on
        ([1, 2, 3, 3, 3, 3, 3], 3),  # a ramp that ends
        ([1, 0, 0, 1, 1, 1, 1, 1], 4),  # a lens cap: from its removal
        ([1, 2, 1, 2, 1, 2, 1, 2], 0),  # never at rest
        ([1, 1, 1, 1, 1, 2, 2, 2], 0),  # too short to wait for
    ],
)
def test_settling_is_the_frame_after_the_last_change(light, since):
    scores = np.array(light, float)[None, :, None] * np.array([0.0, 0.2])  # one state stays
    assert metrics.settling(scores).tolist() == [since]


def test_settling_and_overshoot_are_those_of_the_answer_to_a_step():
    # Wrong but still from frame 6 on, the second that knows of a step in frame 4 (index 3).
    evs = np.array([9.0, 9, 9, 9, 9, 6, 5, 5, 5, 5, 5])
    assert metrics.frames_to_settle(evs, since=4) == 2
    assert metrics.frames_to_settle(evs + np.array([0.0, *[0.3] * 9, 0.0]), since=4) == 2
    assert metrics.frames_to_settle(np.tile([5.0, 6.0], 5), since=4) == 5  # as many as there are
    # 9 -> 5 before the step; then 5 -> 8 by way of 10: two beyond. Counted from the start, the
    # way down from 9 would make it 2 in the other direction: 8 - 5 = 3.
    evs = np.array([[9.0, 5.0, 5.0, 5.0, 10.0, 8.0]])
    found = [metrics.overshoot(evs, since=since).tolist() for since in (np.array([3]), 0)]
    assert found == [[2.0], [3.0]]


def test_flicker_counts_frames_of_the_same_light_and_jumps_all():
    means = np.array([[0.1, 0.2, 0.2, 0.5], [0.0, 0.0, 0.0, 0.0]])
    np.testing.assert_allclose(metrics.flicker(means, np.array([True])), [0.4 / 3, 0.0])
    static = np.array([[True, True, False], [False, False, False]])
    np.testing.assert_allclose(metrics.flicker(means, static), [0.05, 0.0])
    once = metrics.flicker(np.stack([means, means]), np.array([False, False, True]))
    np.testing.assert_allclose(once, [[0.3, 0.0]] * 2)
    # Jumps are the mean change of successive frames.
    means = np.array([[0.1, 0.3, 0.2], [0.5, 0.5, 0.5]])
    np.testing.assert_allclose(metrics.jump(means), [0.15, 0.0])
    assert metrics.jump(means[0]) == pytest.approx(0.15)
    for alone in (means[:, :1], means[0, :1]):  # one frame never jumps
        assert metrics.jump(alone).tolist() == np.zeros(alone.shape[:-1]).tolist()


def test_delayed_states_are_the_start_until_the_first_is_in_effect_and_groups_count_alike():
    for delay, expected in ((0, [0, 1, 2, 3]), (1, [7, 0, 1, 2]), (9, [7, 7, 7, 7])):
        found = metrics.delayed_states(np.array([[0, 1, 2, 3]]), np.array([7]), delay)
        np.testing.assert_array_equal(found, [expected])
    values = np.array([[1.0, 3.0, 10.0], [0.0, 0.0, 1.0]])
    means = metrics.group_means(values, np.array(["b", "b", "a"]))  # "a" comes first
    np.testing.assert_allclose(means, [[10.0, 2.0], [1.0, 0.0]])


def _data(groups=60, seeds=1, seed=0):
    rng = np.random.default_rng(seed)
    span = rng.uniform(0.3, 0.7, groups)
    gains = span * np.clip(rng.normal(0.8, 0.15, (seeds, groups)), 0, 1)
    return gains, span


def test_intervals_agree_with_scipy_and_differences_are_paired():
    def expected(tolerance, statistic, *samples):
        options = {"paired": True, "n_resamples": 20_000, "method": "percentile"}
        rng = np.random.default_rng(1)
        found = scipy.stats.bootstrap(samples, statistic, **options, rng=rng).confidence_interval
        return pytest.approx([found.low, found.high], abs=tolerance)

    first, span = _data()
    second = first * 0.95
    alone = score_interval(first, span, resamples=20_000)
    assert alone.value == pytest.approx(first.sum() / span.sum())
    mean = expected(2e-3, lambda g, s, axis=-1: g.sum(axis) / s.sum(axis), first[0], span)
    assert alone.pair == mean
    found = difference_interval(first, second, span, resamples=20_000)
    assert found.pair == expected(
        5e-4,
        lambda a, b, s, axis=-1: (a.sum(axis) - b.sum(axis)) / s.sum(axis),
        *(first[0], second[0], span),
    )
    assert found.high - found.low < 0.2 * (alone.high - alone.low)


def test_training_seeds_that_differ_widen_the_interval_by_their_variance():
    groups, seeds = 50, 4
    span = np.ones(groups)
    offsets = np.array([-0.2, -0.1, 0.1, 0.2])
    gains = np.full((seeds, groups), 0.5) + offsets[:, None]  # groups alike: only seeds vary
    found = score_interval(gains, span, resamples=20_000)
    draws = np.random.default_rng(0).choice(offsets, (200_000, seeds)).mean(axis=1) + 0.5
    assert found.pair == pytest.approx(np.percentile(draws, [2.5, 97.5]), abs=0.011)
    assert found.num_seeds == seeds
    one = score_interval(gains.mean(axis=0), span)
    assert one.high - one.low == pytest.approx(0.0, abs=1e-12)


def test_differences_far_beyond_the_noise_make_tiers():
    """Policies share the difficulty of the groups, with noise of 0.02 of their own."""
    rng = np.random.default_rng(0)
    groups, means = rng.normal(0.0, 0.2, 60), {"low": 0.3, "best": 0.8, "alike": 0.799}
    gains = {n: (m + groups + rng.normal(0, 0.02, 60))[None] for n, m in means.items()}
    found = rank(gains, np.ones(60), resamples=4000)
    assert found.policy.tolist() == ["best", "alike", "low"]
    assert found.tier.tolist() == [1, 1, 2]
    best, alike, low = found.itertuples()
    assert best.to_best is None
    assert low.to_next is None
    assert not best.to_next["significant"]
    assert low.to_best["significant"]
    assert alike.to_next["significant"]
    # Every policy's own interval is wide: the groups differ by 0.2.
    assert np.ptp(best.ci95) > 0.08
    assert np.ptp(low.to_best["simultaneous_ci95"]) < 0.04
    assert np.mean(low.to_best["simultaneous_ci95"]) == pytest.approx(low.to_best["difference"])


def test_scores_are_compared_with_the_best_of_some():
    (own,), _ = _data()
    scores = {"low": own / 2, "third": own / 3, "best": own * 1.1}
    best, low, third = intervals.mean_rows(scores, ("third", "low"))
    assert [row["policy"] for row in (best, low, third)] == ["best", "low", "third"]
    assert best["score"] == pytest.approx(1.1 * own.mean())
    assert best["ci95"][0] < best["score"] < best["ci95"][1]
    # Everywhere by the same factor: nothing is left to chance.
    assert [best["more"], *best["more_ci95"]] == pytest.approx([1.2] * 3)
    assert [third["more"], *third["more_ci95"]] == pytest.approx([-1 / 3] * 3)
    assert low["more"] == 0.0


def test_agreement_of_rankings_is_scipys_and_its_interval_that_of_the_groups():
    rng = np.random.default_rng(2)
    first = rng.random((7, 20)) + np.arange(7)[:, None] / 10
    second = rng.random((7, 20)) + np.array([1, 0, 2, 3, 5, 4, 5])[:, None] / 10
    second[6] = second[4]  # a tie

    def tau(groups):
        means = (np.round(own[:, groups].mean(axis=1), 9) for own in (first, second))
        return scipy.stats.kendalltau(*means).statistic

    found = intervals.rank_agreement(first, second)
    assert found.value == pytest.approx(tau(np.arange(20)))
    drawn = [tau(rng.integers(20, size=20)) for _ in range(2000)]
    assert found.pair == pytest.approx(np.percentile(drawn, [2.5, 97.5]), abs=0.06)
    assert intervals.rank_agreement(first, -first).value == -1.0


def test_more_policies_widen_the_intervals_as_tukeys_range_does():
    # Independent policies of equal noise: the factor is the studentised range quantile / sqrt(2).
    rng = np.random.default_rng(1)
    gains = {f"p{i}": rng.normal(0.5, 0.1, (1, 400)) for i in range(6)}
    found = rank(gains, np.ones(400), resamples=20_000)
    best, last = found.policy.iloc[0], found.policy.iloc[-1]
    factor = scipy.stats.studentized_range.ppf(0.95, 6, np.inf) / np.sqrt(2)
    error = (gains[last] - gains[best]).std() / np.sqrt(400)
    half = np.ptp(found.to_best.iloc[-1]["simultaneous_ci95"]) / 2
    assert half == pytest.approx(factor * error, rel=0.06)


def test_below_fifteen_groups_there_is_an_order_but_no_interval():
    found = score_interval(*_data(MIN_GROUPS - 1))
    assert (found.low, found.high, found.pair) == (None, None, None)
    assert score_interval(*_data(MIN_GROUPS)).pair is not None
    gains = {"a": np.full((1, MIN_GROUPS - 1), 0.9), "b": np.zeros((1, MIN_GROUPS - 1))}
    found = rank(gains, np.ones(MIN_GROUPS - 1))
    assert (found.policy.tolist(), found.tier.tolist()) == (["a", "b"], [None, None])
    assert not found.to_best[1]["significant"]
    assert found.to_best[1]["difference"] == pytest.approx(-0.9)
