"""Light at both ends of what a sensor can hold and far beyond: exposure, lamps."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import torch
from scipy.integrate import quad

from benchmarks.harness import Row
from benchmarks.isolated import median_seconds
from benchmarks.stability.case import row
from simulator import CameraSettings, NoiseLevelFunction, PreparedScene, exposure_ratio, get_camera
from simulator.optics.flicker_integral import Lamp, MainsLamp, PulsedLamp

#: Rounding of a float32 and of a float64.
EPS32, EPS64 = 2.0**-24, 2.0**-53
_START = CameraSettings(iso=100.0, exposure_time=1.0, f_number=4.0)
_STOPS = range(-30, 31)


def _settings(stops: float) -> CameraSettings:
    """Settings `stops` brighter than the start's, shared out to ISO and shutter."""
    iso = 100.0 * 2.0 ** max(-16.0, min(16.0, stops / 2.0))
    return CameraSettings(iso, 2.0**stops * 100.0 / iso, 4.0)


def _prepared(light: torch.Tensor, reference: CameraSettings) -> PreparedScene:
    """Light without noise, seen by a camera without noise."""
    camera = replace(get_camera("nikon_z6"), nlf_by_iso={100.0: NoiseLevelFunction.zero()})
    return PreparedScene(light, reference, replace(camera, segments=()), NoiseLevelFunction.zero())


def exposures(seed: int, quick: bool) -> list[Row]:
    """Exposure ratios far beyond any camera's, there and back, and in chains."""
    generator = torch.Generator().manual_seed(seed)
    light = 2.0 ** -(11.0 + 9.0 * torch.rand(4, 64, 64, generator=generator))
    there_and_back, ratios = [], []
    for stops in _STOPS:
        settings = _settings(stops)
        back = _prepared(_prepared(light, _START).expected(settings), settings).expected(_START)
        there_and_back.append(float((back.double() / light.double() - 1.0).abs().max()))
        exact = Fraction(2) ** stops
        ratios.append(abs(float(Fraction(exposure_ratio(_START, settings)) / exact - 1)))
    rng, lengths = np.random.default_rng(seed), (1, 2, 5, 10, 20, 50, 100)
    chains = []
    for length in lengths:
        worst = 0.0
        for _ in range(5 if quick else 50):
            draws = rng.random((length - 1, 3)).tolist()
            steps = [_START, *(_random_settings(*draw) for draw in draws), _START]
            product = math.prod(
                Fraction(exposure_ratio(a, b)) for a, b in itertools.pairwise(steps)
            )
            worst = max(worst, abs(float(product - 1)))
        chains.append(worst)
    name = "random transitions that return to where they started"
    return [
        row("ratio of two settings", _STOPS, ratios, limit=64 * EPS64, dtype="float64"),
        row("light there and back", _STOPS, there_and_back, limit=8 * EPS32),
        # Each ratio is 2 to the power of a difference of logarithms of up to 2^5.
        row(name, lengths, chains, limit=100 * 2**6 * EPS64, dtype="float64"),
    ]


def _random_settings(iso: float, time: float, aperture: float) -> CameraSettings:
    """ISO 50 to 25600, 1/8000 s to 4 s, f/1.4 to f/22, of three numbers in [0, 1]."""
    return CameraSettings(
        50.0 * 2 ** (9 * iso), 2.0 ** (15 * time - 13), 2.0 ** (0.5 + 4 * aperture)
    )


def signals(seed: int, quick: bool) -> list[Row]:
    """Recorded digital numbers without noise against float64, over the exposure."""
    camera, size = get_camera("nikon_z6"), 48
    flat, hot = torch.ones(4, size, size), torch.zeros(4, size, size)
    hot[:, size // 2, size // 2] = 1e6
    stops = torch.from_numpy(np.random.default_rng(seed).uniform(-30.0, 0.0, (4, size, size)))
    cases = {
        "one digital number": flat / torch.tensor(camera.span)[:, None, None],
        "negative, as dark as black goes": -flat * torch.tensor(camera.pedestal)[:, None, None],
        "one hot pixel of 1e6": hot,
        "30 stops in one frame": (2.0**stops).float(),
        "light of 1e6": 1e6 * flat,
    }
    span, black = (np.array(v)[:, None, None] for v in (camera.span, camera.black_level))
    rows = []
    for name, light in cases.items():
        frames = _prepared(light, _START).expose([_settings(s) for s in _STOPS]).numpy()
        errors = []
        for exposure, frame in zip(_STOPS, frames.astype(np.float64), strict=True):
            exact = light.numpy().astype(np.float64) * 2.0**exposure * span + black
            exact = np.clip(exact, 0.0, camera.white_level)
            errors.append(float(np.abs(frame * span + black - exact).max()))
        # Rounding to whole numbers, and float32 products of numbers of 14 bits.
        limit = 0.5 + 4 * EPS32 * 2**14
        rows.append(row(name, _STOPS, errors, unit="digital numbers", limit=limit))
    return rows


# -- light that changes a million times faster than the shutter -----------------------------------

_TIMES = (1 / 8000, 1 / 1000, 1 / 120, 1 / 60, 1 / 4, 4.0)


def lamps(seed: int, quick: bool) -> list[Row]:
    """Closed forms against quadrature or exact fractions, over the exposure time."""
    rng = np.random.default_rng(seed)
    # In the first second, and an hour and a day later.
    starts = [*rng.random(2 if quick else 8).tolist(), 3600.1, 86_400.7]
    rows = [_mains(MainsLamp(120.0), starts[:-2])]
    for frequency, duty in ((1_000, 0.01), (1_000, 0.5), (20_000, 0.01), (25, 25 * 10e-6)):
        lamp = PulsedLamp(frequency, duty)
        errors = [max(_pulse_error(lamp, start, time) for start in starts) for time in _TIMES]
        name = f"pulses at {frequency:,} Hz, {duty:.2%} of the time"
        rows.append(_lamp_row(name, lamp, errors))
    return rows


def _lamp_row(case: str, lamp: Lamp, errors: list[float]) -> Row:
    """A row; the note says how much longer a frame of the longest exposure takes."""
    seconds = [
        median_seconds(lambda t=time: lamp.row_light(0.1, t, 2000, 11e-6), least=0.02)  # type: ignore[misc]
        for time in (_TIMES[0], _TIMES[-1])
    ]
    note = f"4 s take {seconds[1] / seconds[0]:.2f} times as long as 1/8000 s"
    return row(case, _TIMES, errors, limit=1e-9, dtype="float64", note=note)


def _mains(lamp: MainsLamp, starts: list[float]) -> Row:
    """Against SciPy's adaptive quadrature, period by period."""

    def light(t: float) -> float:
        return 1.0 + lamp.depth * math.cos(2.0 * math.pi * (lamp.frequency * t + lamp.phase))

    def error(start: float, time: float) -> float:
        edges = np.linspace(start, start + time, max(1, math.ceil(time * lamp.frequency)) + 1)
        pieces = itertools.pairwise(edges.tolist())
        parts = (quad(light, a, b, epsabs=0, epsrel=1e-12, limit=200)[0] for a, b in pieces)
        return abs(float(lamp.mean_light(start, time)) / (math.fsum(parts) / time) - 1.0)

    errors = [max(error(start, time) for start in starts) for time in _TIMES]
    return _lamp_row(f"mains at {lamp.frequency:g} Hz", lamp, errors)


def _pulse_error(lamp: PulsedLamp, start: float, time: float) -> float:
    """Against exact fractions: a quadrature would step over pulses.

    Relative, to a thousandth of the mean light where hardly any pulse is seen.
    """
    frequency, duty = Fraction(lamp.frequency), Fraction(lamp.duty)
    begin, span = Fraction(start) * frequency, Fraction(time) * frequency

    def on_before(periods: Fraction) -> Fraction:
        whole = math.floor(periods)
        return whole * duty + min(periods - whole, duty)

    wanted = float((on_before(begin + span) - on_before(begin)) / (duty * span))
    return abs(float(lamp.mean_light(start, time)) - wanted) / max(wanted, 1e-3)
