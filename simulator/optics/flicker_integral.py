"""Flickering light integrated over an exposure: mains, modulated pulses, strobes.

Each lamp gives its mean light over an exposure in closed form, relative to its long-term mean, so
that the cost does not depend on how many periods the exposure lasts and no pulse, however short, is
missed between two samples. On a rolling shutter each row has an exposure of its own, which
`row_light` gives: bands.
"""

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from simulator.utils.checks import check_integer, check_number

#: Shortest and longest exposure [s], and how far from 0 a moment may lie [s]: periods are counted
#: in whole numbers, and no product of the following leaves the range of float64.
_SHORTEST, _LONGEST = 1e-12, 1e9
#: Least and greatest value of each field.
_RANGES = {
    "frequency": (1e-9, 1e9),
    "depth": (0.0, 1.0),
    "phase": (-1e9, 1e9),
    "duty": (1e-12, 1.0),
}


@dataclass(frozen=True)
class Lamp:
    """Light that does not change; base of the others."""

    def __post_init__(self) -> None:
        for field in fields(self):
            check_number(field.name, getattr(self, field.name), *_RANGES[field.name])

    def mean_light(
        self, start: ArrayLike, exposure_time: ArrayLike, phase: ArrayLike = 0.0
    ) -> np.ndarray:
        """Mean light (...) float64 of exposures, relative to the lamp's long-term mean.

        `start` (...) in [-1e9, 1e9] and `exposure_time` (...) in [1e-12, 1e9] are in seconds;
        `phase` (...) in [-1e9, 1e9] adds to the lamp's.
        """
        given = {"start": start, "exposure_time": exposure_time, "phase": phase}
        for name, values in given.items():
            low, array = _SHORTEST if name == "exposure_time" else -_LONGEST, np.asarray(values)
            if array.dtype.kind not in "fiu" or not ((array >= low) & (array <= _LONGEST)).all():
                rule = f"in [{low:g}, {_LONGEST:g}]{' s' * (name != 'phase')}"
                raise ValueError(f"`{name}` (={values!r}) must be a number {rule}, or such numbers")
        return self._mean(*(np.asarray(values, np.float64) for values in given.values()))

    def _mean(self, start: np.ndarray, time: np.ndarray, phase: np.ndarray) -> np.ndarray:
        return np.ones(np.broadcast_shapes(start.shape, time.shape, phase.shape))

    def row_light(
        self,
        start: ArrayLike,
        exposure_time: ArrayLike,
        rows: int,
        row_time: float,
        sensor_rows: int = 2,
        phase: ArrayLike = 0.0,
    ) -> np.ndarray:
        """Mean light (..., rows) float64 of each row of a packed raw behind a rolling shutter.

        The first sensor row begins its exposure at `start` (...), the next one `row_time` later
        [s]. A packed row is the mean of `sensor_rows` of them. See `mean_light` for the others.
        """
        check_integer("rows", rows, 1, 2**20)
        check_integer("sensor_rows", sensor_rows, 1, 2**12)
        check_number("row_time", row_time, 0.0, _LONGEST, more=" s")
        start, time, phase = (np.asarray(v)[..., None] for v in (start, exposure_time, phase))
        light = self.mean_light(start + row_time * np.arange(rows * sensor_rows), time, phase)
        return light.reshape(*light.shape[:-1], rows, sensor_rows).mean(axis=-1)


@dataclass(frozen=True)
class MainsLamp(Lamp):
    """A lamp on the mains without a capacitor: ``1 + depth cos(2 pi (frequency t + phase))``."""

    frequency: float = 100.0  # of the light [Hz], twice that of the mains
    depth: float = 1.0  # from 0 (steady) to 1 (dark once a period)
    phase: float = 0.0  # of the first brightest moment, in periods

    def _mean(self, start: np.ndarray, time: np.ndarray, phase: np.ndarray) -> np.ndarray:
        begin, whole, rest = _periods(start, time, self.frequency, self.phase, phase)
        # sin(pi (n + r)) = (-1)^n sin(pi r), and half a period's turn for every odd n in cos.
        swing = np.sin(math.pi * rest) / (math.pi * (whole + rest))
        # Where the lamp is darkest, 1 - |cos| would lose its digits: 2 sin^2 of half the angle.
        half = math.pi * (begin + rest / 2.0 + 0.5)
        dark = 2.0 * np.sin(half) ** 2  # 1 + cos of the middle, less whole periods
        return (1.0 - self.depth * swing) + self.depth * swing * dark


@dataclass(frozen=True)
class PulsedLamp(Lamp):
    """A lamp that is switched on for a share of each period: dimmed LEDs, screens, strobes."""

    frequency: float = 1000.0  # pulses per second [Hz]
    duty: float = 0.5  # share of the period that it is on, in (0, 1]; a strobe's is tiny
    phase: float = 0.0  # where in a period the time 0 is, in periods; it is on from 0 to `duty`

    def _mean(self, start: np.ndarray, time: np.ndarray, phase: np.ndarray) -> np.ndarray:
        begin, whole, rest = _periods(start, time, self.frequency, self.phase, phase)
        now = np.clip(self.duty - begin, 0.0, rest)  # of the pulse that it begins in
        later = np.clip(rest - (1.0 - begin), 0.0, self.duty)  # of the next one
        return (whole + (now + later) / self.duty) / (whole + rest)


def _periods(
    start: np.ndarray, time: np.ndarray, frequency: float, phase: float, more: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Begin within a period, in [0, 1); whole periods that exposures last; the rest, in [0, 1)."""
    # A whole second of whole periods changes nothing: without it, what is left of a day of periods
    # still tells where in one it is, as well as the rounding of `start` lets it.
    seconds = np.floor(start)
    turns = (start - seconds) * frequency + seconds * (frequency - math.floor(frequency))
    phases, span = phase + more, time * frequency
    begin = (turns - np.floor(turns)) + (phases - np.floor(phases))
    whole = np.floor(span)
    return begin - np.floor(begin), whole, span - whole  # as by `np.mod`, which takes longer
