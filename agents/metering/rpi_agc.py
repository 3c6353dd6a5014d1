"""libcamera's AGC for the Raspberry Pi, on the states of a grid."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.metering.libcamera_agc import (
    CONSTRAINTS,
    LADDERS,
    SPEED,
    STARTUP_FRAMES,
    ZONE_WEIGHTS,
    Floats,
    Ladder,
    LibcameraAgc,
    signal_histogram,
)
from agents.metering.programs import (
    PRIORITY_TIME,
    ProgramOptions,
    StateChooser,
    check_program,
    check_used,
)
from agents.metering.reading import GREEN, TARGET_SIGNAL, frame_ev100, linear_signal
from agents.policy import Observations, Policy, PolicyContext, masked_argmax
from simulator.utils.checks import check_integer, check_number, check_word

#: Least signal from which the light is estimated.
_LEAST_SIGNAL = 1e-3
#: How near to whole periods a flicker-free exposure time is, as a part of it.
_PERIOD_TOLERANCE = 0.02
#: Advantage of the last state; the square of a stop counts 1.
_STAYS = 0.1
#: Cost of a state whose shutter lets lamps flicker where one nearby does not; the EV counts 1000
#: per stop. A state is nearby within this of the EV [EV], or where none is nearer.
_FLICKERS, _NEARBY_EV = 1e5, 0.5


class RpiAgc(Policy):
    """The Raspberry Pi's AGC (`LibcameraAgc`): the state of the grid that is nearest to it.

    Args:
        context: The camera, the grid and the observation.
        program: ``"P"``: the ladder, at an aperture of `f_number`; ``"A"``: the same, and no other
            aperture; ``"S"``: shutter by hand, the gain follows, and the aperture where the gain
            alone comes less near to the EV; ``"M"``: aperture and shutter by hand.
        metering: ``"centre_weighted"``, ``"spot"`` or ``"matrix"``: weights of the zones.
        mode: ``"normal"``, ``"short"`` or ``"long"``: the ladder.
        constraint: ``"normal"``, ``"highlight"`` or ``"shadows"``.
        compensation: Exposure compensation [EV], positive is brighter.
        damping: Share of the distance to the filtered EV that remains after a frame, in [0, 1).
        shutter_cap: Longest exposure time that may be used [s].
        f_number: Aperture of the lens; by default the widest of the grid, which is nearest to the
            f/1.8 and f/2 of the Raspberry Pi's own cameras.
        exposure_time: Shutter that S and M keep [s]; None: 1/125.
        iso: ISO speed that M keeps; None: it follows the meter.
        max_gain: Gain at the end of the ladder, 1 at ISO 100.
        flicker_period: Period of the lamps' light [s], such as 0.01: shutters of a period and more
            are whole periods, and the gain makes up for it (P and A). None: lamps are steady.
        speed: Share of the distance to the target that the filter goes per frame, in (0, 1].
        startup_frames: Frames of an episode in which it goes all of the way.

    Raises:
        ValueError: If an argument is unknown, out of range or of another program.
    """

    def __init__(
        self,
        context: PolicyContext,
        program: str = "P",
        *,
        metering: str = "centre_weighted",
        mode: str = "normal",
        constraint: str = "normal",
        compensation: float = 0.0,
        damping: float = 0.0,
        shutter_cap: float | None = None,
        f_number: float | None = None,
        exposure_time: float | None = None,
        iso: float | None = None,
        max_gain: float = 16.0,
        flicker_period: float | None = None,
        speed: float = SPEED,
        startup_frames: int = STARTUP_FRAMES,
    ) -> None:
        super().__init__(context)
        self.program = check_program(program)
        check_used(program, exposure_time=exposure_time, iso=iso, flicker_period=flicker_period)
        check_word("metering", metering, tuple(ZONE_WEIGHTS))
        check_word("mode", mode, tuple(LADDERS))
        check_word("constraint", constraint, tuple(CONSTRAINTS))
        time = PRIORITY_TIME if exposure_time is None else exposure_time
        lens = context.grid.f_numbers[0] if f_number is None else f_number
        self.options = ProgramOptions(compensation, damping, shutter_cap, lens, time, iso)
        self.speed = check_number("speed", speed, 1e-3, 1.0)
        self.startup_frames = check_integer("startup_frames", startup_frames, 0)
        max_gain = check_number("max_gain", max_gain, 1.0, 1e5)
        if flicker_period is not None:
            flicker_period = check_number("flicker_period", flicker_period, 1e-6, 10.0)
        self.flicker_period = flicker_period
        self.name = f"rpi_agc:{program}"
        ladder = LADDERS[mode]
        gains = (*ladder.gain[:-1], max(max_gain, 1.0))
        self._ladder = Ladder(ladder.shutter, tuple(min(g, max_gain) for g in gains))
        by_hand = self.program in ("S", "M")
        self._settings: dict[str, Any] = {
            "metering": metering,
            "constraint": constraint,
            "ladder": self._ladder,
            "compensation": compensation,
            "max_exposure_time": shutter_cap,
            "exposure_time": time if by_hand else None,
            "gain": None if iso is None else iso / 100.0,
            "flicker_period": flicker_period,
            "speed": self.speed,
            "startup_frames": self.startup_frames,
        }
        self._chooser = StateChooser(context.grid, program, self.options)
        self.reset(0)

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Begin the start-up frames of `num_envs` cameras."""
        super().reset(num_envs, seed)
        self._agc = LibcameraAgc(num_envs, **self._settings)
        self._damped = np.full(num_envs, np.nan)
        self._previous: NDArray[np.int64] | None = None

    def act(
        self, observations: Observations, action_masks: NDArray[np.bool_] | None = None
    ) -> NDArray[np.int64]:
        """Meter the frames, filter the exposure, split it."""
        self.check_reset(observations)
        signal = linear_signal(observations["raw"], self.context.camera, GREEN).mean(axis=1)
        signal = np.maximum(signal, 0.0).reshape(len(signal), -1)
        zones = signal @ _zone_matrix(*observations["raw"].shape[2:])
        frame_ev = frame_ev100(observations)
        brightness = zones @ self._agc.weights / self._agc.weights.sum()
        light = np.log2(np.maximum(brightness, _LEAST_SIGNAL) / TARGET_SIGNAL)
        lux = 2.5 * np.exp2(frame_ev + light)
        # As exposure time x gain at the lens's own f-number, which may not be the frame's.
        area = self.options.f_number**2
        exposure = self._agc.update(zones, signal_histogram(signal), area * np.exp2(-frame_ev), lux)
        ev = -np.log2(exposure / area)
        states = self.context.grid.ev100
        before = np.clip(self._damped, states.min(), states.max())
        distance = self.options.damping * (before - ev)
        self._damped = ev + np.where(np.isnan(distance), 0.0, distance)
        self._previous = masked_argmax(self._utility(self._damped), action_masks)
        return self._previous.copy()

    def split(self, exposure: Floats) -> tuple[Floats, Floats]:
        """Exposure time [s] and gain of `exposure` [s], ``(N,)`` each, by the ladder."""
        return self._agc.split(exposure)

    def _utility(self, ev: Floats) -> Floats:
        """How well each state fits the exposures and the ladder, ``(N, S)``."""
        chooser = self._chooser
        target = chooser.with_hysteresis(ev, self._previous)
        time, gain = self.split(self.options.f_number**2 * np.exp2(-target))
        aperture = chooser.aperture - 2.0 * np.log2(self.options.f_number)
        slower = np.log2(time)[:, None] + chooser.time[None]  # stops shorter than the ladder's
        higher = chooser.speed[None] - 5.0 - np.log2(gain)[:, None]
        cost = slower**2 + 0.25 * higher**2 + 4.0 * (aperture**2)[None]
        if self._previous is not None:  # of nominally equal exposures the last one stays
            cost[np.arange(len(cost)), self._previous] -= _STAYS
        utility = chooser.utility(target, cost)
        utility -= _FLICKERS * self._flickers(time, target)
        return utility

    def _flickers(self, time: Floats, target: Floats) -> Any:
        """1.0 where lamps flicker in a state but not in one near the EV, ``(N, S)``.

        Shutters of whole periods are looked for where that of the ladder is one, up to its longest.
        """
        if self.flicker_period is None:
            return 0.0
        times = np.exp2(-self._chooser.time)
        periods = times / self.flicker_period
        tolerance = _PERIOD_TOLERANCE * periods
        whole = (np.abs(periods - np.round(periods)) <= tolerance) & (periods > 0.5)
        whole &= times <= self._ladder.shutter[-1] * (1.0 + _PERIOD_TOLERANCE)
        steady = self._chooser.nearby(target, _NEARBY_EV) & whole
        found = (time >= self.flicker_period) & steady.any(axis=1)
        return (found[:, None] & ~steady).astype(np.float64)


def zone_map(height: int, width: int) -> NDArray[np.int64]:
    """Zone of each pixel, ``(height, width)``, 0 to 14.

    The tuning names the zones by their order only, centre first; they are laid out so::

        11 |     7     | 12
        ---+-----------+---
           |     3     |
         9 | 5 1 0 2 6 | 10
           |     4     |
        ---+-----------+---
        13 |     8     | 14

    The outer zones are a sixth of the frame wide and high.
    """
    y, x = np.mgrid[:height, :width]
    row, column = (y + 0.5) / height, (x + 0.5) / width
    top, bottom, left, right = row < 1 / 6, row >= 5 / 6, column < 1 / 6, column >= 5 / 6
    inner = np.minimum((column - 1 / 6) * 7.5, 4.0).astype(np.int64)  # 0 to 4 across
    zones = np.array([5, 1, 0, 2, 6])[np.clip(inner, 0, 4)]
    third = (row - 1 / 6) * 4.5
    zones = np.where(third < 1, 3, np.where(third >= 2, 4, zones))
    for zone, where in ((7, top), (8, bottom), (9, left), (10, right)):
        zones = np.where(where, zone, zones)
    corners = ((11, top & left), (12, top & right), (13, bottom & left), (14, bottom & right))
    for zone, where in corners:
        zones = np.where(where, zone, zones)
    return zones.astype(np.int64)


@functools.lru_cache(maxsize=8)
def _zone_matrix(height: int, width: int) -> Floats:
    """Weights of the pixels in the mean of each zone, ``(height * width, 15)``."""
    zones = zone_map(height, width).ravel()
    matrix: Floats = (zones[:, None] == np.arange(15)).astype(np.float64)
    matrix /= np.maximum(matrix.sum(axis=0), 1.0)
    return matrix
