import numpy as np
import pytest
import scipy.stats

from agents.evaluation.intervals import MIN_GROUPS, difference_interval, rank, score_interval


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


SPAN = np.ones(60)


def _gains(seed: int = 0, **means: float) -> dict[str, np.ndarray]:
    """Policies that share the difficulty of the groups, with noise of 0.02 of their own."""
    rng = np.random.default_rng(seed)
    groups = rng.normal(0.0, 0.2, 60)
    return {n: (m + groups + rng.normal(0, 0.02, 60))[None] for n, m in means.items()}


def test_differences_far_beyond_the_noise_make_tiers():
    found = rank(_gains(low=0.3, best=0.8, alike=0.799), SPAN, resamples=4000)
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
