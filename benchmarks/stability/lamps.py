"""Light that changes a million times faster than the shutter, integrated in closed form."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from fractions import Fraction

import numpy as np
from scipy.integrate import quad

from benchmarks.stability.case import Row, time_ratio
from simulator.optics.lamps import Flash, Lamp, MainsLamp, PulsedLamp

GROUP = "stiff light"
#: Relative error that is right.
LIMIT = 1e-9
#: Exposure times [s].
TIMES = (1 / 8000, 1 / 1000, 1 / 120, 1 / 60, 1 / 4, 4.0)
#: A frame may take this much longer in the longest exposure than in the shortest.
_TIME_LIMIT = 2.0
#: Rows of a sensor that are timed, and the time from one to the next [s].
_ROWS, _ROW_TIME = 4000, 11e-6


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """The cases of this group."""
    rng = np.random.default_rng(seed)
    # In the first second, and an hour and a day later.
    starts = [*rng.random(2 if quick else 8).tolist(), 3600.1, 86_400.7]
    for frequency in (100.0, 120.0):
        lamp = MainsLamp(frequency)
        yield _row(f"mains, {frequency:g} Hz", lamp, _mains_error(lamp, starts[:-2]))
    for pulsed_frequency in (1_000, 20_000):
        for duty in (0.01, 0.5, 0.99):
            pulsed = PulsedLamp(pulsed_frequency, duty)
            name = f"pulse-width modulation, {pulsed_frequency:,} Hz, {duty:.0%} on"
            yield _row(name, pulsed, _pulse_error(pulsed, starts))
    strobe = PulsedLamp(25.0, 25.0 * 10e-6)
    yield _row("strobe, 25 Hz, 10 microseconds", strobe, _pulse_error(strobe, starts))
    yield _rows_error(PulsedLamp(1_000, 0.1))
    for decay in (1e-6, 100e-6):
        flash = Flash(at=0.25, decay=decay, energy=0.01)
        name = f"lightning, decay {decay * 1e6:g} microseconds"
        yield _row(name, flash, _flash_error(flash, starts[:-2]))


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
        time_limit=_TIME_LIMIT,
        note=f"bands of {light.min():.3g} to {light.max():.3g} times the mean light",
    )


def _rows_error(lamp: PulsedLamp) -> Row:
    """Bands of a rolling shutter, every row against exact fractions."""
    time, start, row_time = 1 / 2000, 0.1, 2.0**-16  # rows begin at exact moments
    found = lamp.row_light(start, time, _ROWS // 2, row_time)
    exact = [_exact_mean(lamp, start + row_time * row, time) for row in range(_ROWS)]
    wanted = np.array(exact).reshape(-1, 2).mean(axis=1)
    error = float((np.abs(found - wanted) / np.maximum(wanted, 1e-3)).max())
    name = f"rolling shutter, {_ROWS:,} sensor rows, 1,000 Hz, 10% on, 1/2000 s"
    return Row(GROUP, name, error, limit=LIMIT, dtype="float64")


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
        if t < lamp.at:
            return 1.0
        return 1.0 + lamp.energy / lamp.decay * math.exp(-(t - lamp.at) / lamp.decay)

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

    Relative, to a thousandth of the mean light where hardly any pulse is seen.
    """
    worst = 0.0
    for time in TIMES:
        for start in starts:
            wanted = _exact_mean(lamp, start, time)
            found = float(lamp.mean_light(start, time))
            worst = max(worst, abs(found - wanted) / max(wanted, 1e-3))
    return worst


def _exact_mean(lamp: PulsedLamp, start: float, time: float) -> float:
    frequency, duty = Fraction(lamp.frequency), Fraction(lamp.duty)
    begin, span = Fraction(start) * frequency, Fraction(time) * frequency
    return float((_on_before(begin + span, duty) - _on_before(begin, duty)) / (duty * span))


def _on_before(periods: Fraction, duty: Fraction) -> Fraction:
    """Time, in periods, that the lamp was on from 0 to `periods`."""
    whole = math.floor(periods)
    return whole * duty + min(periods - whole, duty)
