"""`Lighting`, the base of every change of light, and `make_lighting`, which finds one by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from numbers import Integral, Real
from typing import Any, ClassVar, NamedTuple

import numpy as np

from simulator.utils.checks import check_integer, check_number, did_you_mean

#: Most stops that the light may change by: float32 holds it at any settings of a grid.
MAX_STOPS = 64


def _check_frame(name: str, value: Any, low: int, high: int) -> int:
    """`value` as an int; a whole float, as some JSON writers give it, is one too."""
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
    """Readout of a frame, one sensor row after the other.

    Args:
        rows: Rows of the packed frame.
        row_time: Time from the start of one sensor row to the start of the next [s].
        sensor_rows: Number of sensor rows that are averaged into one row of the frame.
    """

    rows: int
    row_time: float
    sensor_rows: int


#: Lightings by name: every subclass of `Lighting` with a `name` of its own.
KINDS: dict[str, type[Lighting]] = {}


@dataclass(frozen=True)
class Lighting:
    """Light that does not change; base of the others.

    The gain of an exposure is the mean light while the shutter is open, relative to the scene's.
    A subclass gives `name`, by which `make_lighting` knows it, and `gain`.
    """

    name: ClassVar[str] = "static"
    #: Whether light also changes within a frame, so that it depends on the exposure time.
    within_frame: ClassVar[bool] = False

    def __init_subclass__(cls) -> None:
        KINDS.setdefault(cls.name, cls)

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


KINDS[Lighting.name] = Lighting


def make_lighting(spec: str | Mapping[str, Any] | Lighting) -> Lighting:
    """A lighting from a name or from a mapping such as ``{"kind": "step", "stops": 3}``.

    Raises:
        ValueError: If the kind or one of its options is unknown, or an option is out of range.

    >>> make_lighting({"kind": "step", "stops": 3, "at": 2}).gain(2, 0.01, 0.0)
    8.0
    """
    if isinstance(spec, Lighting):
        return spec
    if not isinstance(spec, str | Mapping):
        raise ValueError(
            f"`lighting` (={spec!r}) must be one of {sorted(KINDS)}, a mapping with a 'kind' of "
            "them, or a Lighting"
        )
    options = {"kind": spec} if isinstance(spec, str) else dict(spec)
    if "kind" not in options:
        raise ValueError(f"`lighting` (={spec!r}) needs a 'kind', one of {sorted(KINDS)}")
    name = options.pop("kind", None)
    if not isinstance(name, str) or name not in KINDS:
        hint = did_you_mean(name, KINDS)
        raise ValueError(f"`lighting` (={spec!r}) must be one of {sorted(KINDS)}{hint}")
    kind = KINDS[name]
    known = [f.name for f in fields(kind)]
    for option in options:
        if option not in known:
            hint = did_you_mean(option, known)
            raise ValueError(
                f"`lighting` (={spec!r}): {name!r} takes {known}, not {option!r}{hint}"
            )
    return kind(**options)
