"""From an EV to one state of the grid: what the programs P, A, S and M have in common."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ae_env.grid import ExposureGrid
from ae_env.utils.checks import check_number, check_word
from agents.evaluation.metrics import SAME_EV
from agents.metering.ev_tracker import check_damping
from agents.policy import MANUAL_PROGRAMS

Floats = NDArray[np.float64]

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
#: Largest exposure compensation [EV].
MAX_COMPENSATION = 32.0
#: Weights of what comes first, second and third in the choice of a state.
_CAPPED, _BY_HAND, _DISTANCE = 1e9, 1e6, 1e3
#: A state above the ceiling is so much farther than it is [EV]: any below it is nearer.
_ABOVE_CEILING_EV = 100.0


@dataclass(frozen=True)
class ProgramOptions:
    """The options that every metering policy takes.

    Args:
        compensation: Exposure compensation [EV], positive is brighter, in [-32, 32].
        damping: Share of the distance to the metered EV that is kept per frame, in [0, 1).
        shutter_cap: Longest exposure time that may be used, whatever the meter says, where there is
            a shorter one [s]; None: no limit.
        f_number: Aperture that A and M keep.
        exposure_time: Shutter that S and M keep [s].
        iso: ISO speed that M keeps; None: it follows the meter.

    Raises:
        ValueError: If one is out of range.
    """

    compensation: float = 0.0
    damping: float = 0.0
    shutter_cap: float | None = None
    f_number: float = PRIORITY_F_NUMBER
    exposure_time: float = PRIORITY_TIME
    iso: float | None = None

    def __post_init__(self) -> None:
        limit = MAX_COMPENSATION
        values = {
            "compensation": check_number("compensation", self.compensation, -limit, limit),
            "damping": check_damping(self.damping),
            "f_number": check_number("f_number", self.f_number, 0.1, 1000.0),
            "exposure_time": check_number("exposure_time", self.exposure_time, 1e-7, 1e5),
        }
        if self.shutter_cap is not None:
            values["shutter_cap"] = check_number("shutter_cap", self.shutter_cap, 1e-7, 1e5)
        if self.iso is not None:
            values["iso"] = check_number("iso", self.iso, 1.0, 1e7)
        for name, value in values.items():
            object.__setattr__(self, name, value)


class StateChooser:
    """How well each state of a grid fits an EV and what is set by hand.

    Args:
        grid: The exposure states.
        program: ``"P"``, ``"A"``, ``"S"`` or ``"M"``; nothing is set by hand in any other.
        options: What is set by hand, and the shutter cap.
        ceiling: Whether the EV wanted is the most exposure that may be given.
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
        self._fixed = self._off(program, options)
        #: Stops by which each state is slower than the cap, ``(S,)``.
        self.over_cap = np.zeros(len(grid))
        if options.shutter_cap is not None:
            times = np.array([s.exposure_time for s in grid.states])
            self.over_cap = np.maximum(np.log2(times / options.shutter_cap) - 1e-6, 0.0)
        first = _CAPPED * self.over_cap + _BY_HAND * self._fixed
        self._allowed = first == first.min()

    def _off(self, program: str, options: ProgramOptions) -> Floats:
        """Stops by which each state is further from what is set by hand than the nearest one is."""
        off = np.zeros_like(self.aperture)
        if program in ("A", "M"):
            off += _excess(np.abs(self.aperture - 2.0 * np.log2(options.f_number)))
        if program in ("S", "M"):
            off += _excess(np.abs(self.time + np.log2(options.exposure_time)))
        if program == "M" and options.iso is not None:
            off += _excess(np.abs(self.speed - np.log2(options.iso / 100.0) - 5.0))
        return off

    def kept(self, target: Floats, previous: NDArray[np.int64] | None) -> Floats:
        """`target` [EV] ``(N,)``, or the EV of the `previous` states where that is near enough."""
        if previous is None:
            return target
        old = self.ev100[previous]
        if self.ceiling:  # a brighter state must be below the ceiling by the hysteresis
            return np.where(old < target, target, np.minimum(target + self.hysteresis, old))
        farther = np.abs(target - old) - self._least_distance(self._distance(target))[:, 0]
        return np.where(farther < self.hysteresis, old, target)

    def _distance(self, target: Floats) -> Floats:
        darker: Floats = self.ev100[None] - target[:, None]  # (N, S)
        distance: Floats = np.abs(darker)
        return distance + _ABOVE_CEILING_EV * (darker < -1e-9) if self.ceiling else distance

    def _least_distance(self, distance: Floats) -> Floats:
        """Of the states that the cap and what is set by hand leave, ``(N, 1)``."""
        least: Floats = distance[:, self._allowed].min(axis=1, keepdims=True)
        return least

    def nearby(self, target: Floats, limit: float) -> NDArray[np.bool_]:
        """States that may be used within `limit` [EV] of `target` or as near as any, ``(N, S)``."""
        distance = self._distance(target)
        near = np.maximum(self._least_distance(distance) + SAME_EV, limit)
        found: NDArray[np.bool_] = (distance <= near) & self._allowed
        return found

    def utility(self, target: Floats, preference: Floats) -> Floats:
        """How well each state fits, ``(N, S)``; the highest is to be taken.

        The shutter cap comes first, what is set by hand second, then the EV; among states of the
        same exposure, `preference` decides.

        Args:
            target: EV100 wanted, ``(N,)``.
            preference: Cost of each state besides, well below 1000, ``(S,)`` or ``(N, S)``.
        """
        distance = self._distance(target)
        # Nominal values are rounded (1/15 s for 1/16 s): states this near are the same exposure.
        distance = np.maximum(distance - self._least_distance(distance) - SAME_EV, 0.0)
        first = _CAPPED * self.over_cap + _BY_HAND * self._fixed
        return -(first + _DISTANCE * distance + preference)


def check_program(program: str, programs: tuple[str, ...] = MANUAL_PROGRAMS) -> str:
    """`program` as it is.

    Raises:
        ValueError: Unless it is one of `programs`.
    """
    check_word("program", program, programs)
    return program


def check_used(program: str, **options: object) -> None:
    """Raises a `ValueError` if one of the `options` of `USED_BY` is given to another program."""
    for name, value in options.items():
        users = USED_BY[name]
        if value is not None and program not in users:
            programs = f"program{'s' if len(users) > 1 else ''} {' and '.join(users)}"
            raise ValueError(
                f"`{name}` (={value!r}) is an option of {programs} only, not of {program}"
            )


def ev_step(grid: ExposureGrid) -> float:
    """Distance between neighbouring exposures of a grid [EV], the median.

    States within 1/6 EV count as the same exposure.

    >>> round(ev_step(ExposureGrid.default())), round(3 * ev_step(ExposureGrid.third_stop()))
    (1, 1)
    """
    levels = np.sort(grid.ev100)
    gaps = np.diff(levels)
    starts = np.concatenate([[True], gaps > SAME_EV])
    steps = np.diff(levels[starts])
    return float(np.median(steps)) if len(steps) else 1.0


def _excess(values: Floats) -> Floats:
    """How far each value is above the least one."""
    excess: Floats = values - values.min()
    return np.where(excess < 1e-9, 0.0, excess)
