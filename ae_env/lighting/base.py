"""What every lighting is, and the one that does not change."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from numbers import Integral, Real
from typing import Any, ClassVar, NamedTuple

import numpy as np

from ae_env.utils.checks import check_integer, check_number

#: Most stops that the light may change by: float32 holds it at any settings of a grid.
MAX_STOPS = 64


def _check_frame(name: str, value: Any, low: int, high: int) -> int:
    """`value` as an int; a whole float, as some write JSON, is one too."""
    number = isinstance(value, Real) and not isinstance(value, Integral)
    if number and low <= value <= high and value % 1 == 0:
        value = int(value)
    return check_integer(name, value, low, high)


#: Least and greatest value of each option, and what checks it.
_FRAME = (-(2**31), 2**31, _check_frame)
_RANGES: dict[str, tuple[Any, Any, Callable[..., Any]]] = {
    "stops": (-MAX_STOPS, MAX_STOPS, check_number),
    "stops_per_frame": (0, MAX_STOPS, check_number),
    "period": (1e-3, 2**31, check_number),
    "edge": (0, 2**31, _check_frame),
    **dict.fromkeys(("at", "enter", "leave", "on", "off"), _FRAME),
}


class RollingShutter(NamedTuple):
    """How a frame is read: one sensor row after the other.

    Args:
        rows: Rows of the packed frame.
        row_time: From one sensor row's begin to the next one's [s].
        sensor_rows: Sensor rows that one row of the frame is the mean of.
    """

    rows: int
    row_time: float
    sensor_rows: int


@dataclass(frozen=True)
class Lighting:
    """Light that does not change; base of the others.

    The gain of an exposure is the mean light while the shutter is open, relative to the scene's.
    """

    name: ClassVar[str] = "static"
    #: Whether light also changes within a frame, so that it depends on the exposure time.
    within_frame: ClassVar[bool] = False

    def __post_init__(self) -> None:
        for option in fields(self):
            if option.name in _RANGES:
                low, high, check = _RANGES[option.name]
                value = check(f"lighting[{option.name!r}]", getattr(self, option.name), low, high)
                object.__setattr__(self, option.name, value)

    def gain(self, frame: int, exposure_time: float, phase: float) -> float:
        """Mean relative light of an exposure.

        Args:
            frame: Frame of the episode; 0 is the one that `reset` returns.
            exposure_time: Time the shutter is open [s].
            phase: The episode's own phase, in [0, 1).
        """
        return 1.0

    def rows(
        self, frame: int, exposure_time: float, phase: float, shutter: RollingShutter
    ) -> tuple[float, np.ndarray | None]:
        """Light of an exposure, row by row.

        Args:
            frame: See `gain`.
            exposure_time: See `gain`.
            phase: See `gain`.
            shutter: How the frame is read.

        Returns:
            Mean relative light of the frame, and (rows,) float64 that of each row relative to this
            mean; None where all rows have the same.
        """
        return self.gain(frame, exposure_time, phase), None
