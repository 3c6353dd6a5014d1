"""Bootstrap intervals over source groups and training seeds, and the ranking that they allow."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd

from agents.policy import Floats

RESAMPLES = 10_000
#: Coverage of the intervals, and the quantiles that are their ends.
LEVEL, ENDS = 0.95, (0.025, 0.975)
#: Below this many source groups an interval would promise too much: values only.
MIN_GROUPS = 15
RANK_COLUMNS = ("place", "policy", "tier", "normalised_score", "ci95", "to_best", "to_next")
#: Standard errors below this are rounding: the two policies do the same.
_ROUNDING = 1e-12


@dataclass(frozen=True)
class Interval:
    """An estimate from all groups and training seeds with its percentile-bootstrap interval.

    Below 15 source groups the ends are None.
    """

    value: float
    low: float | None
    high: float | None
    num_groups: int
    num_seeds: int = 1

    @property
    def pair(self) -> list[float] | None:
        """``[low, high]``, or None."""
        return None if self.low is None or self.high is None else [self.low, self.high]


def score_interval(
    gains: Floats, span: Floats, *, resamples: int = RESAMPLES, seed: int = 0
) -> Interval:
    """Normalised score of a policy and its interval.

    ``sum over groups of the seeds' mean gain / sum of the span``. Each resample draws G groups with
    replacement and, independently, K training seeds with replacement (Efron and Tibshirani 1993;
    crossed factors as in Owen 2007).

    Args:
        gains: ``q - q_random`` per training seed and source group, ``(K, G)`` or ``(G,)``.
        span: ``q_oracle - q_random`` per source group, ``(G,)``.
        seed: Seed of the resampling; policies compared under one seed see the same groups.
    """
    nothing = np.zeros((1, len(span)))
    return difference_interval(gains, nothing, span, resamples=resamples, seed=seed)


def difference_interval(
    gains: Floats, other: Floats, span: Floats, *, resamples: int = RESAMPLES, seed: int = 0
) -> Interval:
    """Paired difference of two policies' normalised scores and its interval.

    Both policies are evaluated on the same groups, which are resampled together; the training
    seeds of each are resampled on their own. Arguments are those of `score_interval`.
    """
    first, second, groups = np.atleast_2d(gains), np.atleast_2d(other), len(span)
    value = float((first.mean(0) - second.mean(0)).sum() / span.sum())
    seeds = max(len(first), len(second))
    if groups < MIN_GROUPS:
        return Interval(value, None, None, groups, seeds)
    rng = np.random.default_rng([seed, 1])
    weights = group_weights(groups, resamples, seed)
    totals = _resampled(first, weights, rng) - _resampled(second, weights, rng)
    low, high = np.quantile(totals / (weights @ span), ENDS).tolist()
    return Interval(value, low, high, groups, seeds)


def mean_rows(scores: Mapping[str, Sequence[float]], among: Sequence[str]) -> list[dict[str, Any]]:
    """A row for each policy, the best first, of its scores in the same G source groups.

    ``score`` is their mean, with its interval ``ci95``; ``more`` by how much that is above the mean
    of the best policy of `among`, relative to it, with the paired interval ``more_ci95``.
    """
    known, rows = {name: np.array(own) for name, own in scores.items()}, []
    best = max((known[name] for name in among), key=np.mean)
    for name, own in sorted(known.items(), key=lambda pair: -pair[1].mean()):
        alone, more = score_interval(own, np.ones_like(own)), difference_interval(own, best, best)
        row = {"policy": name, "score": alone.value, "ci95": alone.pair}
        rows.append(row | {"more": more.value, "more_ci95": more.pair})
    return rows


def rank_agreement(first: Floats, second: Floats) -> Interval:
    """Kendall's tau-b of the rankings of P policies by two measures, with its interval.

    A ranking is by the mean over all groups. Both measures, ``(P, G)``, are of the same groups,
    which are resampled together. 1: the same ranking; 0: unrelated ones; -1: one reversed.
    """
    (one, other), groups = np.triu_indices(len(first), 1), first.shape[1]

    def tau(weights: Floats) -> Floats:
        gaps = (weights @ (measure[one] - measure[other]).T for measure in (first, second))
        a, b = (np.sign(np.where(np.abs(gap) > _ROUNDING, gap, 0.0)) for gap in gaps)  # (R, pairs)
        return np.asarray((a * b).sum(1) / np.sqrt((a * a).sum(1) * (b * b).sum(1)))

    value = float(tau(np.full((1, groups), 1.0 / groups))[0])
    if groups < MIN_GROUPS:
        return Interval(value, None, None, groups)
    low, high = np.quantile(tau(group_weights(groups, RESAMPLES, 0) / groups), ENDS).tolist()
    return Interval(value, low, high, groups)


@lru_cache(maxsize=16)
def group_weights(groups: int, resamples: int, seed: int) -> Floats:
    """How often each group is drawn, ``(R, G)``; the same for all that are compared."""
    rng = np.random.default_rng(seed)
    return rng.multinomial(groups, np.full(groups, 1 / groups), size=resamples).astype(np.float64)


def _resampled(values: Floats, weights: Floats, rng: np.random.Generator) -> Floats:
    """Sums over the groups drawn of the mean over training seeds drawn with replacement, (R,)."""
    sums: Floats = weights @ values.T  # (R, K)
    count = len(values)
    if count == 1:
        return sums[:, 0]
    drawn = rng.multinomial(count, np.full(count, 1 / count), size=len(weights)) / count
    return (sums * drawn).sum(axis=1)


def rank(gains: Mapping[str, Floats], span: Floats, *, resamples: int = RESAMPLES) -> pd.DataFrame:
    """Policies from the best to the worst, with the differences that are significant.

    Differences of all pairs are bootstrapped together (source groups are drawn once for all
    policies, training seeds for each), divided by their standard errors, and the largest of all
    pairs gives the half width of every interval: with the probability `LEVEL` all of them cover
    the truth at once (single-step max-t: Westfall and Young 1993; Hothorn, Bretz and Westfall
    2008). A tier begins with the best policy that is left, and has those below it that are not
    significantly worse than that one.

    Arguments are those of `score_interval`, gains by policy. A row has a policy's ``place``,
    ``policy``, its ``tier`` (1 for the best; None below 15 source groups), ``normalised_score``
    with its own (not simultaneous) interval ``ci95``; ``to_best`` and ``to_next`` (None for the
    best and the last) have the ``other`` policy, the ``difference`` to it, its
    ``simultaneous_ci95`` and whether that is ``significant``.
    """
    scores = {name: score_interval(own, span, resamples=resamples) for name, own in gains.items()}
    names = sorted(scores, key=lambda name: -scores[name].value)  # ties keep the given order
    widths = None
    if len(span) >= MIN_GROUPS and len(names) > 1:
        widths = _half_widths([gains[name] for name in names], span, resamples)

    def difference(i: int, j: int) -> dict[str, Any]:
        value = scores[names[i]].value - scores[names[j]].value
        half = None if widths is None else float(widths[i, j])
        return {
            "other": names[j],
            "difference": value,
            "simultaneous_ci95": None if half is None else [value - half, value + half],
            "significant": half is not None and abs(value) > half,
        }

    rows = []
    leader, tier = 0, None if widths is None else 1
    for i, name in enumerate(names):
        if tier is not None and i > leader and difference(i, leader)["significant"]:
            leader, tier = i, tier + 1
        to_best = difference(i, 0) if i else None
        to_next = difference(i, i + 1) if i + 1 < len(names) else None
        score = scores[name]
        rows.append((i + 1, name, tier, score.value, score.pair, to_best, to_next))
    return pd.DataFrame(rows, columns=list(RANK_COLUMNS))


def _half_widths(gains: list[Floats], span: Floats, resamples: int) -> Floats:
    """Half widths of the simultaneous intervals of all differences, ``(P, P)``."""
    weights = group_weights(len(span), resamples, 0)
    drawn = [  # training seeds are drawn for each policy
        _resampled(np.atleast_2d(own), weights, np.random.default_rng([0, 1, i])) / (weights @ span)
        for i, own in enumerate(gains)
    ]
    errors = np.zeros((len(gains), len(gains)))
    largest = np.zeros(resamples)
    for i, j in combinations(range(len(gains)), 2):
        change = drawn[i] - drawn[j]
        error = errors[i, j] = errors[j, i] = change.std(ddof=1)
        if error > _ROUNDING:
            np.maximum(largest, np.abs(change - change.mean()) / error, out=largest)
    return errors * float(np.quantile(largest, LEVEL))
