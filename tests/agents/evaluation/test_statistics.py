from __future__ import annotations

import numpy as np
import pytest
import scipy.stats

from agents.evaluation.statistics import MIN_GROUPS, difference_interval, score_interval


def _data(groups=60, seeds=1, seed=0):
    rng = np.random.default_rng(seed)
    span = rng.uniform(0.3, 0.7, groups)
    gains = span * np.clip(rng.normal(0.8, 0.15, (seeds, groups)), 0, 1)
    return gains, span


def test_interval_over_groups_agrees_with_scipy():
    gains, span = _data()
    expected = scipy.stats.bootstrap(
        (gains[0], span),
        lambda g, s, axis=-1: g.sum(axis) / s.sum(axis),
        paired=True,
        n_resamples=20_000,
        method="percentile",
        rng=np.random.default_rng(1),
    ).confidence_interval
    found = score_interval(gains, span, resamples=20_000)
    assert found.value == pytest.approx(gains.sum() / span.sum())
    assert found.pair == pytest.approx([expected.low, expected.high], abs=2e-3)


def test_paired_difference_agrees_with_scipy_and_is_narrower_than_unpaired():
    first, span = _data()
    second = first * 0.95
    expected = scipy.stats.bootstrap(
        (first[0], second[0], span),
        lambda a, b, s, axis=-1: (a.sum(axis) - b.sum(axis)) / s.sum(axis),
        paired=True,
        n_resamples=20_000,
        method="percentile",
        rng=np.random.default_rng(1),
    ).confidence_interval
    found = difference_interval(first, second, span, resamples=20_000)
    assert found.pair == pytest.approx([expected.low, expected.high], abs=5e-4)
    alone = score_interval(first, span)
    assert found.high - found.low < 0.2 * (alone.high - alone.low)


def test_standard_error_over_groups_has_its_closed_form():
    rng = np.random.default_rng(3)
    gains, span = rng.normal(0.4, 0.1, 200), np.ones(200)  # the mean of 200 values
    found = score_interval(gains, span, resamples=20_000)
    error = gains.std() / np.sqrt(200)
    assert found.high - found.low == pytest.approx(2 * 1.96 * error, rel=0.03)
    assert found.low < gains.mean() < found.high


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


def test_below_fifteen_groups_there_is_no_interval():
    gains, span = _data(MIN_GROUPS - 1)
    found = score_interval(gains, span)
    assert (found.low, found.high, found.pair) == (None, None, None)
    assert "no interval" in str(found)
    assert score_interval(*_data(MIN_GROUPS)).pair is not None


def test_seeded_and_antisymmetric():
    first, span = _data(seeds=3)
    second, _ = _data(seeds=3, seed=5)
    once, again = (difference_interval(first, second, span, seed=4) for _ in range(2))
    assert once == again
    swapped = difference_interval(second, first, span, seed=4)
    assert swapped.value == pytest.approx(-once.value)
    assert swapped.low == pytest.approx(-once.high, abs=3e-3)


def test_shapes_must_agree():
    gains, span = _data()
    with pytest.raises(ValueError, match=r"one column for each of the 60 groups"):
        difference_interval(gains, gains[:, 1:], span)
