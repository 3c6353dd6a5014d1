"""One row of the result: the error of a case over what is varied."""

from __future__ import annotations

import math
from collections.abc import Sequence

from benchmarks.harness import Row


def row(
    case: str,
    x: Sequence[float],
    errors: Sequence[float],
    *,
    unit: str = "relative",
    limit: float | None = None,
    dtype: str = "float32",
    ok: bool = True,
    note: str = "",
) -> Row:
    """The row of a case.

    Args:
        case: In words.
        x: What is varied.
        errors: The error at each of `x`, against float64 unless the case says against what else.
        unit: Of the errors.
        limit: Largest error that is right; None where none is wrong.
        dtype: Of the computation.
        ok: Whether everything else is right.
        note: What else there is to say, such as how a result that cannot be right is declared.
    """
    finite = all(math.isfinite(error) for error in errors)
    largest = max(map(abs, errors)) if finite else None
    within = finite and (limit is None or (largest is not None and largest <= limit))
    return {
        "case": case,
        "dtype": dtype,
        "finite": finite,
        "max_error": largest,
        "error": unit,
        "limit": limit,
        "ok": within and ok,
        "note": note,
        "curve": {"x": [float(v) for v in x], "y": [float(e) for e in errors]},
    }
