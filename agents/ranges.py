"""Checks of numbers in the configurations."""

from __future__ import annotations

import math
import numbers
from typing import Any


def check_ranges(configuration: Any, **ranges: tuple[float, float]) -> None:
    """Raises a `ValueError` if a field of `configuration` is not a number in its range.

    Args:
        configuration: Any object.
        ranges: Least and greatest allowed value by field name.
    """
    for name, (low, high) in ranges.items():
        value = getattr(configuration, name)
        number = isinstance(value, numbers.Real) and not isinstance(value, bool)
        if not (number and math.isfinite(value) and low <= value <= high):
            raise ValueError(f"`{name}` (={value!r}) must be in [{low:g}, {high:g}]")
