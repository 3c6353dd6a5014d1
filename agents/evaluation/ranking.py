"""Which differences between policies are significant: simultaneous intervals, and tiers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agents.evaluation.statistics import (
    MIN_GROUPS,
    RESAMPLES,
    Interval,
    resampled_scores,
    score_interval,
)

Floats = NDArray[np.float64]
#: Standard errors below this are rounding: the two policies do the same.
_ROUNDING = 1e-12


@dataclass(frozen=True)
class Difference:
    """Paired difference of two policies' normalised scores.

    Args:
        policy: The one.
        minus: The other.
        value: Their difference.
        low: Lower end of its simultaneous interval; None below 15 source groups.
        high: Upper end.
    """

    policy: str
    minus: str
    value: float
    low: float | None
    high: float | None

    @property
    def significant(self) -> bool:
        """Whether the interval leaves out zero."""
        return self.low is not None and self.high is not None and (self.low > 0 or self.high < 0)


@dataclass(frozen=True)
class Rank:
    """One line of a ranking.

    Args:
        policy: Name.
        score: Normalised score with its own (not simultaneous) interval.
        tier: 1 for the best; None below 15 source groups.
        to_best: Difference to the best policy; None for itself.
        to_next: Difference to the policy below; None for the last.
    """

    policy: str
    score: Interval
    tier: int | None
    to_best: Difference | None
    to_next: Difference | None


def rank(
    gains: Mapping[str, Floats],
    span: Floats,
    *,
    resamples: int = RESAMPLES,
    level: float = 0.95,
    seed: int = 0,
) -> list[Rank]:
    """Policies from the best to the worst, with the differences that are significant.

    Differences of all pairs are bootstrapped together (source groups are drawn once for all
    policies, training seeds for each), divided by their standard errors, and the largest of all
    pairs gives the half width of every interval: with the probability `level` all of them cover
    the truth at once (single-step max-t: Westfall and Young 1993; Hothorn, Bretz and Westfall
    2008). A tier begins with the best policy that is left, and has those below it that are not
    significantly worse than that one.

    Args:
        gains: ``q - q_random`` by policy, ``(K, G)`` per training seed and source group.
        span: ``q_oracle - q_random`` per source group, ``(G,)``.
        resamples: Number of resamples.
        level: Coverage of all intervals together.
        seed: Seed of the resampling.
    """
    scores = {
        name: score_interval(own, span, resamples=resamples, level=level, seed=seed)
        for name, own in gains.items()
    }
    names = sorted(scores, key=lambda name: -scores[name].value)  # ties keep the given order
    widths = None
    if len(span) >= MIN_GROUPS and len(names) > 1:
        widths = _half_widths([gains[name] for name in names], span, resamples, level, seed)

    def difference(i: int, j: int) -> Difference:
        value = scores[names[i]].value - scores[names[j]].value
        if widths is None:
            return Difference(names[i], names[j], value, None, None)
        half = float(widths[i, j])
        return Difference(names[i], names[j], value, value - half, value + half)

    tiers = _tiers(len(names), difference) if widths is not None else [None] * len(names)
    return [
        Rank(
            name,
            scores[name],
            tiers[i],
            difference(i, 0) if i else None,
            difference(i, i + 1) if i + 1 < len(names) else None,
        )
        for i, name in enumerate(names)
    ]


def _half_widths(
    gains: list[Floats], span: Floats, resamples: int, level: float, seed: int
) -> Floats:
    """Half widths of the simultaneous intervals of all differences, ``(P, P)``."""
    drawn = np.stack(
        [
            resampled_scores(own, span, resamples=resamples, seed=seed, stream=i)
            for i, own in enumerate(gains)
        ]
    )  # (P, R)
    errors = np.zeros((len(gains), len(gains)))
    largest = np.zeros(resamples)
    for i in range(len(gains)):
        for j in range(i + 1, len(gains)):
            change = drawn[i] - drawn[j]
            error = change.std(ddof=1)
            errors[i, j] = errors[j, i] = error
            if error > _ROUNDING:
                np.maximum(largest, np.abs(change - change.mean()) / error, out=largest)
    return errors * float(np.quantile(largest, level))


def _tiers(count: int, difference) -> list[int | None]:  # type: ignore[no-untyped-def]
    tiers: list[int | None] = []
    leader, tier = 0, 1
    for i in range(count):
        if i > leader and difference(i, leader).significant:
            leader, tier = i, tier + 1
        tiers.append(tier)
    return tiers
