from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from agents.evaluation.ranking import rank
from agents.evaluation.statistics import MIN_GROUPS

SPAN = np.ones(60)


def _gains(seed: int = 0, **means: float) -> dict[str, np.ndarray]:
    """Policies that share the difficulty of the groups, with noise of 0.02 of their own."""
    rng = np.random.default_rng(seed)
    groups = rng.normal(0.0, 0.2, 60)
    return {n: (m + groups + rng.normal(0, 0.02, 60))[None] for n, m in means.items()}


def test_differences_far_beyond_the_noise_make_tiers():
    found = rank(_gains(low=0.3, best=0.8, alike=0.799), SPAN, resamples=4000)
    assert [one.policy for one in found] == ["best", "alike", "low"]
    assert [one.tier for one in found] == [1, 1, 2]
    best, alike, low = found
    assert best.to_best is None
    assert low.to_next is None
    assert not best.to_next.significant
    assert low.to_best.significant
    assert alike.to_next.significant
    # Every policy's own interval is wide: the groups differ by 0.2.
    assert best.score.high - best.score.low > 0.08
    assert low.to_best.high - low.to_best.low < 0.04


def test_two_policies_have_the_interval_of_a_single_paired_difference():
    gains = _gains(a=0.5, b=0.45)
    found = rank(gains, SPAN, resamples=20_000)
    change = (gains["b"] - gains["a"])[0]
    half = 1.96 * change.std() / np.sqrt(60)  # mean of 60 differences
    low, high = found[1].to_best.low, found[1].to_best.high
    assert (high - low) / 2 == pytest.approx(half, rel=0.04)
    assert (high + low) / 2 == pytest.approx(change.mean())


def test_more_policies_widen_the_intervals_as_tukeys_range_does():
    # Independent policies of equal noise: the factor is the studentised range quantile / sqrt(2).
    rng = np.random.default_rng(1)
    gains = {f"p{i}": rng.normal(0.5, 0.1, (1, 400)) for i in range(6)}
    found = rank(gains, np.ones(400), resamples=20_000)
    change = gains[found[-1].policy] - gains[found[0].policy]
    factor = stats.studentized_range.ppf(0.95, 6, np.inf) / np.sqrt(2)
    error = change.std() / np.sqrt(400)
    half = (found[-1].to_best.high - found[-1].to_best.low) / 2
    assert half == pytest.approx(factor * error, rel=0.06)


def test_false_claims_are_as_rare_as_promised():
    claims = 0
    for trial in range(60):
        rng = np.random.default_rng(trial)
        gains = {f"p{i}": rng.normal(0.5, 0.1, (1, 40)) for i in range(5)}  # all alike in truth
        found = rank(gains, np.ones(40), resamples=600)
        claims += found[-1].to_best.significant
    assert claims <= 9  # 5 % of 60 is 3; more than 9 has a chance of 1e-3


def test_few_groups_have_an_order_but_no_claims():
    gains = {"a": np.full((1, MIN_GROUPS - 1), 0.9), "b": np.zeros((1, MIN_GROUPS - 1))}
    found = rank(gains, np.ones(MIN_GROUPS - 1))
    assert [(one.policy, one.tier) for one in found] == [("a", None), ("b", None)]
    assert not found[1].to_best.significant
    assert found[1].to_best.value == pytest.approx(-0.9)


def test_the_same_policy_twice_is_no_difference():
    gains = _gains(a=0.5)
    found = rank({"a": gains["a"], "again": gains["a"].copy()}, SPAN, resamples=500)
    assert [one.tier for one in found] == [1, 1]
    assert found[1].to_best.value == 0.0
    assert not found[1].to_best.significant


def test_training_seeds_that_disagree_take_claims_back():
    groups = np.random.default_rng(3).normal(0.0, 0.01, 60)
    steady = (0.5 + groups)[None]
    seeds = np.array([0.2, 0.5, 0.68])[:, None] + groups  # mean 0.46, widely apart
    found = rank({"steady": steady, "seeds": seeds}, SPAN, resamples=4000)
    assert found[0].policy == "steady"
    assert not found[1].to_best.significant
    one = rank({"steady": steady, "mean": seeds.mean(0)[None] + 1e-4 * groups}, SPAN)
    assert one[1].to_best.significant
