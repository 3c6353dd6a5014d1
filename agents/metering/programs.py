"""The programs P, A, S and M: from a metered EV to one exposure state of the grid.

P is free in everything, A (aperture priority) keeps the f-number, S (shutter priority) the exposure
time, M both and, where it is given, the ISO speed. `StateChooser` ranks the states by the settings
chosen by hand and by EV; `program_cost` says which of the states of one EV a program prefers.
"""

from dataclasses import dataclass

import numpy as np

from ae_env.grid import ExposureGrid
from agents.policy import Bools, Floats, Ints
from simulator.utils.checks import check_number

#: EVs nearer than this are the same exposure: 1/15 s stands for 1/16 s, 0.09 EV from it.
SAME_EV = 1.0 / 6.0
#: Longest shutter of a hand-held camera that knows nothing of its motion [s]: the rule of thumb
#: 1 / focal length for a normal lens. With sensors, the blur that programs accept, in frame heights
#: (one pixel of a 64-pixel frame). And the aperture that P tends to.
HANDHELD_LIMIT, BLUR_LIMIT, PROGRAM_F_NUMBER = 1 / 60, 1 / 64, 5.6
#: A program keeps its EV until another is nearer to the metered one by this, in steps of the grid:
#: on even steps, while it is within 0.6 steps.
HYSTERESIS_STEPS = 0.2
#: Aperture of A and M, and shutter of S and M [s], where no other is given.
PRIORITY_F_NUMBER, PRIORITY_TIME = 8.0, 1 / 125
#: Options that not every program uses, and the programs that do.
USED_BY = {
    "f_number": ("A", "M"),
    "exposure_time": ("S", "M"),
    "iso": ("M",),
    "flicker_period": ("P", "A"),
    "weights": ("tuned", "tuned_blind"),
}
#: Ranges of the numbers among the options.
_RANGES = {
    "compensation": (-32.0, 32.0),
    "damping": (0.0, 0.999),  # at 1 nothing would ever move
    "f_number": (0.1, 1000.0),
    "exposure_time": (1e-7, 1e5),
    "shutter_cap": (1e-7, 1e5),
    "iso_cap": (1.0, 1e7),
    "iso": (1.0, 1e7),
}
#: Weights of what comes first, second and third in the choice of a state.
_CAPPED, _BY_HAND, _DISTANCE = 1e9, 1e6, 1e3
#: A state above the ceiling is so much farther than it is [EV]: any below it is nearer.
_ABOVE_CEILING_EV = 100.0


@dataclass(frozen=True)
class ProgramOptions:
    """The options that every metering policy takes, checked; see `MeteringPolicy`."""

    compensation: float = 0.0
    damping: float = 0.0
    shutter_cap: float | None = None
    f_number: float = PRIORITY_F_NUMBER
    exposure_time: float = PRIORITY_TIME
    iso: float | None = None
    iso_cap: float | None = None

    def __post_init__(self) -> None:
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if value is not None or name not in ("shutter_cap", "iso_cap", "iso"):
                object.__setattr__(self, name, check_number(name, value, low, high))


class StateChooser:
    """How well each state of a grid fits an EV and what is set by hand.

    In the programs ``"A"``, ``"S"`` and ``"M"`` the `options` say what is set by hand; in any other
    nothing is. `ceiling` says whether the EV wanted is the most exposure that may be given.
    """

    def __init__(
        self, grid: ExposureGrid, program: str, options: ProgramOptions, ceiling: bool = False
    ) -> None:
        apex = np.array([(s.aperture_stop / 3.0, s.time_value, s.speed_value) for s in grid.states])
        self.aperture, self.time, self.speed = apex.T
        self.ev100 = grid.ev100
        self.ceiling = ceiling
        self.step = ev_step(grid)
        self.hysteresis = HYSTERESIS_STEPS * self.step
        #: Stops by which each state is slower than its cap and has more gain, ``(S,)``.
        self.over_cap = np.zeros(len(grid))
        for name, cap in {"exposure_time": options.shutter_cap, "iso": options.iso_cap}.items():
            if cap is not None:
                values = np.array([getattr(s, name) for s in grid.states])
                if name == "iso" and cap < (least := values.min()) * (1.0 - 1e-6):
                    rule = f"must be at least {least:g}, the grid's lowest ISO speed"
                    raise ValueError(f"`iso_cap` (={cap:g}) {rule}")
                self.over_cap += np.maximum(np.log2(values / cap) - 1e-6, 0.0)
        wanted = []  # by hand
        if program in ("A", "M"):
            wanted.append((self.aperture, 2.0 * np.log2(options.f_number)))
        if program in ("S", "M"):
            wanted.append((self.time, -np.log2(options.exposure_time)))
        if program == "M" and options.iso is not None:
            wanted.append((self.speed, np.log2(options.iso / 100.0) + 5.0))
        off = np.zeros(len(grid))  # stops further from it than the nearest state is
        for values, value in wanted:
            distance = np.abs(values - value)
            above_least = distance - distance.min()
            off += np.where(above_least < 1e-9, 0.0, above_least)
        self._first = _CAPPED * self.over_cap + _BY_HAND * off
        self._allowed = self._first == self._first.min()

    def with_hysteresis(self, target: Floats, previous: Ints | None) -> Floats:
        """`target` [EV] ``(N,)``, or the EV of the `previous` states where that is near enough."""
        if previous is None:
            return target
        old = self.ev100[previous]
        if self.ceiling:  # a brighter state must be below the ceiling by the hysteresis
            return np.where(old < target, target, np.minimum(target + self.hysteresis, old))
        farther = np.abs(target - old) - self._least_distance(self._distance(target))[:, 0]
        return np.where(farther < self.hysteresis, old, target)

    def _distance(self, target: Floats) -> Floats:
        darker = self.ev100[None] - target[:, None]  # (N, S)
        return np.asarray(np.abs(darker) + _ABOVE_CEILING_EV * (self.ceiling & (darker < -1e-9)))

    def _least_distance(self, distance: Floats) -> Floats:
        """Of the states that the caps and what is set by hand leave, ``(N, 1)``."""
        return np.asarray(distance[:, self._allowed].min(axis=1, keepdims=True))

    def nearby(self, target: Floats, limit: float) -> Bools:
        """States that may be used within `limit` [EV] of `target` or as near as any, ``(N, S)``."""
        distance = self._distance(target)
        near = np.maximum(self._least_distance(distance) + SAME_EV, limit)
        return np.asarray((distance <= near) & self._allowed)

    def utility(self, target: Floats, preference: Floats) -> Floats:
        """How well each state fits the EV100 `target` (N,), ``(N, S)``; the highest is to be taken.

        The caps come first, what is set by hand second, then the EV; among states of the
        same exposure, `preference` decides: further cost, well below 1000, ``(S,)`` or ``(N, S)``.
        """
        distance = self._distance(target)
        # Nominal values are rounded (1/15 s for 1/16 s): states this near are the same exposure.
        distance = np.maximum(distance - self._least_distance(distance) - SAME_EV, 0.0)
        return -(self._first + _DISTANCE * distance + preference)


def check_used(program: str, **options: object) -> None:
    """Raises a `ValueError` if one of the `options` of `USED_BY` is given to another program."""
    for name, value in options.items():
        users = USED_BY[name]
        if value is not None and program not in users:
            only = f"of the program {' and '.join(users)} only, not of {program}"
            raise ValueError(f"`{name}` (={value!r}) is an option {only}")


def ev_step(grid: ExposureGrid) -> float:
    """Distance between neighbouring exposures of a grid [EV], the median.

    States within 1/6 EV count as the same exposure.

    >>> round(ev_step(ExposureGrid.default())), round(3 * ev_step(ExposureGrid.third_stop()))
    (1, 1)
    """
    levels = np.sort(grid.ev100)
    steps = np.diff(levels[np.diff(levels, prepend=-np.inf) > SAME_EV])
    return float(np.median(steps)) if len(steps) else 1.0


def program_cost(program: str, chooser: StateChooser, readings: Floats) -> Floats:
    """Which of the states of one EV a program prefers: the cost of each, ``(N or 1, S)``.

    P trades in squares of stops: motion blur counts 1, defocus 1/2, gain 1/4, the distance from
    f/5.6 1/20. A avoids motion blur, then gain; S and M avoid gain. For the `readings` see
    `MeteringPolicy.observe`.
    """
    gain = (chooser.speed - chooser.speed.min())[None]
    if program in ("S", "M"):
        return np.asarray(0.1 * gain)
    slow = np.maximum(shutter_limit(readings) - chooser.time[None], 0.0)  # stops too slow
    if program == "A":
        return np.asarray(10.0 * slow + 0.1 * gain)
    wide = np.maximum(aperture_limit(readings) - chooser.aperture[None], 0.0)  # stops too wide
    line = np.abs(chooser.aperture - 2.0 * np.log2(PROGRAM_F_NUMBER))[None]
    return np.asarray(slow**2 + 0.5 * wide**2 + (0.25 * gain**2 + 0.05 * line**2))


def shutter_limit(readings: Floats) -> Floats:
    """Tv of the slowest shutter that keeps motion blur within the limit, ``(N, 1)``.

    Where no speed is read, that of a camera in the hand.
    """
    if readings.shape[1] == 1:
        return np.full((len(readings), 1), -np.log2(HANDHELD_LIMIT))
    return np.asarray(readings[:, 1:2] - np.log2(BLUR_LIMIT))


def aperture_limit(readings: Floats) -> Floats:
    """Av of the widest aperture that keeps defocus within the limit; f/5.6 where none is read."""
    if readings.shape[1] == 1:
        return np.full((len(readings), 1), 2.0 * np.log2(PROGRAM_F_NUMBER))
    # Blur diameter at f-number N is 4 D / N pixels of a 64-pixel frame.
    return np.asarray(2.0 * (2.0 + readings[:, 2:3] - np.log2(64 * BLUR_LIMIT)))
