"""Light that changes a million times faster than the shutter, integrated in closed form."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from fractions import Fraction

import numpy as np
from scipy.integrate import quad

from benchmarks.stability.case import Row, time_ratio
from simulator.lamps import Flash, Lamp, MainsLamp, PulsedLamp

GROUP = "stiff light"
#: Relative error that is right.
LIMIT = 1e-9
#: Exposure times [s].
TIMES = (1 / 8000, 1 / 1000, 1 / 120, 1 / 60, 1 / 4, 4.0)
#: Rows of a sensor that are timed, and the time from one to the next [s].
_ROWS, _ROW_TIME = 4000, 11e-6


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """The cases of this group."""
    starts = np.random.default_rng(seed).random(2 if quick else 8).tolist()
    for frequency in (100.0, 120.0):
        lamp = MainsLamp(frequency)
        yield _row(f"mains, {frequency:g} Hz", lamp, _mains_error(lamp, starts))
    for frequency in (1_000, 20_000):
        for duty in (0.01, 0.5, 0.99):
            lamp = PulsedLamp(frequency, duty)
            yield _row(
                f"pulse-width modulation, {frequency:,} Hz, {duty:.0%} on",
                lamp,
                _pulse_error(lamp, starts),
            )
    strobe = PulsedLamp(25.0, 25.0 * 10e-6)
    yield _row("strobe, 25 Hz, 10 microseconds", strobe, _pulse_error(strobe, starts))
    for decay in (1e-6, 100e-6):
        lamp = Flash(at=0.25, decay=decay, energy=0.01)
        name = f"lightning, decay {decay * 1e6:g} microseconds"
        yield _row(name, lamp, _flash_error(lamp, starts))


def _row(case: str, lamp: Lamp, error: float) -> Row:
    """A row; its time is that of the longest exposure over that of the shortest."""

    def frame(time: float) -> np.ndarray:
        return lamp.row_light(0.1, time, _ROWS // 2, _ROW_TIME)

    light = np.concatenate([frame(time) for time in TIMES])
    return Row(
        GROUP,
        f"{case}, 1/8000 to 4 s",
        error,
        limit=LIMIT,
        dtype="float64",
        finite=bool(np.isfinite(light).all() and (light >= 0.0).all()),
        time_ratio=time_ratio(lambda: frame(TIMES[-1]), lambda: frame(TIMES[0])),
        note=f"bands of {light.min():.3g} to {light.max():.3g} times the mean light",
    )


def _mains_error(lamp: MainsLamp, starts: list[float]) -> float:
    """Against SciPy's adaptive quadrature, period by period."""

    def light(t: float) -> float:
        return 1.0 + lamp.depth * math.cos(2.0 * math.pi * (lamp.frequency * t + lamp.phase))

    return _quadrature_error(lamp, light, starts, lambda start, time: _periods(lamp, start, time))


def _periods(lamp: MainsLamp, start: float, time: float) -> list[float]:
    count = max(1, math.ceil(time * lamp.frequency))
    return [start + time * i / count for i in range(count + 1)]


def _flash_error(lamp: Flash, starts: list[float]) -> float:
    """Against SciPy's adaptive quadrature; 60 times the decay after the flash nothing is left."""

    def light(t: float) -> float:
        flash = lamp.energy / lamp.decay * math.exp(-(t - lamp.at) / lamp.decay)
        return 1.0 + flash if t >= lamp.at else 1.0

    def pieces(start: float, time: float) -> list[float]:
        edges = [lamp.at + lamp.decay * n for n in range(61)]
        return [start, *(t for t in edges if start < t < start + time), start + time]

    # Some that begin just before the flash, in it, and after it.
    near = [lamp.at - 1e-7, lamp.at, lamp.at + lamp.decay / 3.0, lamp.at + 1e-3]
    return _quadrature_error(lamp, light, [*starts, *near], pieces)


def _quadrature_error(lamp, light, starts, pieces) -> float:  # type: ignore[no-untyped-def]
    worst = 0.0
    for time in TIMES:
        for start in starts:
            edges = pieces(start, time)
            parts = [
                quad(light, a, b, epsabs=0, epsrel=1e-12, limit=200)[0]
                for a, b in itertools.pairwise(edges)
            ]
            wanted = math.fsum(parts) / time
            worst = max(worst, abs(float(lamp.mean_light(start, time)) / wanted - 1.0))
    return worst


def _pulse_error(lamp: PulsedLamp, starts: list[float]) -> float:
    """Against exact fractions: a quadrature would step over pulses.

    Absolute where hardly any pulse is seen, relative elsewhere.
    """
    worst = 0.0
    frequency, duty = Fraction(lamp.frequency), Fraction(lamp.duty)
    for time in TIMES:
        for start in starts:
            begin = Fraction(start) * frequency
            on = _on_before(begin + Fraction(time) * frequency, duty) - _on_before(begin, duty)
            wanted = float(on / (duty * Fraction(time) * frequency))
            found = float(lamp.mean_light(start, time))
            worst = max(worst, abs(found - wanted) / max(wanted, 1.0))
    return worst


def _on_before(periods: Fraction, duty: Fraction) -> Fraction:
    """Time, in periods, that the lamp was on from 0 to `periods`."""
    whole = math.floor(periods)
    return whole * duty + min(periods - whole, duty)
