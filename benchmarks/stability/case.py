"""One stiff or extreme case, and what came of it."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Row:
    """What one case found.

    Args:
        group: Group of cases that it belongs to.
        case: What was done.
        max_error: Worst error in the unit of `error`, against float64 unless the case says what
            else; None where there is nothing to compare with, or it is not finite.
        error: Unit of `max_error`, such as ``"relative"``.
        limit: Largest `max_error` that is right; None where `ok` is told by the other columns.
        dtype: Of the computation.
        finite: Whether every number was.
        monotone: Whether more light never gave less; None where that is not asked.
        unbiased: Whether the mean was right within its standard error; None where not asked.
        time_ratio: Time of the case over that of the ordinary case; None where not timed.
        time_limit: Largest `time_ratio` that is right; None where any is.
        declared: How a result that cannot be right is declared; empty where it is right.
        note: What else there is to say.
    """

    group: str
    case: str
    max_error: float | None
    error: str = "relative"
    limit: float | None = None
    dtype: str = "float32"
    finite: bool = True
    monotone: bool | None = None
    unbiased: bool | None = None
    time_ratio: float | None = None
    time_limit: float | None = None
    declared: str = ""
    note: str = ""

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong with it, but for what is declared."""
        within = True
        if self.limit is not None:
            within = self.max_error is not None and self.max_error <= self.limit
        if self.time_limit is not None and self.time_ratio is not None:
            within &= self.time_ratio <= self.time_limit
        return within and self.finite and self.monotone is not False and self.unbiased is not False

    def json(self) -> dict[str, Any]:
        """The row of the result file."""
        row = {name: getattr(self, name) for name in self.__dataclass_fields__}
        if self.max_error is not None and not math.isfinite(self.max_error):
            row["max_error"], row["finite"] = None, False
        return row | {"ok": self.ok and row["finite"]}


def time_ratio(case: Callable[[], Any], ordinary: Callable[[], Any], repeats: int = 7) -> float:
    """Median time of `case` over that of `ordinary`; they take turns, each warmed up once."""
    case(), ordinary()
    seconds: tuple[list[float], list[float]] = ([], [])
    for _ in range(repeats):
        for own, run in zip(seconds, (case, ordinary), strict=True):
            start = time.perf_counter()
            run()
            own.append(time.perf_counter() - start)
    first, second = (statistics.median(own) for own in seconds)
    return first / max(second, 1e-9)
