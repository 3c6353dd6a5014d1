"""Exposure ratios far beyond any camera's, there and back, and in long chains."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from fractions import Fraction

import numpy as np
import torch

from benchmarks.stability.case import Row, time_ratio
from simulator import CameraSettings, NoiseLevelFunction, PreparedScene, exposure_ratio, get_camera

GROUP = "exposure ratios"
#: Rounding of a float32 and of a float64.
EPS32, EPS64 = 2.0**-24, 2.0**-53
_START = CameraSettings(iso=100.0, exposure_time=1.0, f_number=4.0)
# fmt: off
#: Shutter speeds as written on cameras, third of a stop by third of a stop, from 2**-13 s.
NOMINAL_TIMES = (
    *(1.0 / n for n in (
        8000, 6400, 5000, 4000, 3200, 2500, 2000, 1600, 1250, 1000, 800, 640, 500, 400, 320, 250,
        200, 160, 125, 100, 80, 60, 50, 40, 30, 25, 20, 15, 13, 10, 8, 6, 5, 4,
    )),
    0.3, 0.4, 0.5, 0.6, 0.8, 1, 1.3, 1.6, 2, 2.5, 3.2, 4, 5, 6, 8, 10, 13, 15, 20, 25, 30,
)
#: f-numbers as written on lenses, third of a stop by third of a stop, from 1.
NOMINAL_APERTURES = (
    1, 1.1, 1.2, 1.4, 1.6, 1.8, 2, 2.2, 2.5, 2.8, 3.2, 3.5, 4, 4.5, 5, 5.6, 6.3, 7.1, 8, 9, 10, 11,
    13, 14, 16, 18, 20, 22, 25, 29, 32,
)
# fmt: on


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """The cases of this group."""
    yield _ratios()
    yield _there_and_back(seed)
    yield from _chains(seed, 20 if quick else 200)
    yield _nominal_times()
    yield _nominal_apertures()


def _settings(stops: float) -> CameraSettings:
    """Settings `stops` brighter than the start's, shared out to ISO and shutter."""
    iso = 100.0 * 2.0 ** max(-16.0, min(16.0, stops / 2.0))
    return CameraSettings(iso, 2.0**stops * 100.0 / iso, 4.0)


def _prepared(light: torch.Tensor, reference: CameraSettings) -> PreparedScene:
    return PreparedScene(light, reference, get_camera("nikon_z6"), NoiseLevelFunction.zero())


def _ratios() -> Row:
    worst = 0.0
    for stops in range(-30, 31):
        ratio = Fraction(exposure_ratio(_START, _settings(stops)))
        worst = max(worst, abs(float(ratio / Fraction(2) ** stops - 1)))
    return Row(
        GROUP, "2^-30 to 2^30 between two settings", worst, limit=64 * EPS64, dtype="float64"
    )


def _there_and_back(seed: int) -> Row:
    generator = torch.Generator().manual_seed(seed)
    light = 2.0 ** -(11.0 + 9.0 * torch.rand(4, 64, 64, generator=generator))
    worst, monotone = 0.0, True
    previous = None
    for stops in range(-30, 31):
        settings = _settings(stops)
        there = _prepared(light, _START).expected(settings)
        back = _prepared(there, settings).expected(_START)
        worst = max(worst, float((back.double() / light.double() - 1.0).abs().max()))
        monotone &= previous is None or bool((there >= previous).all())
        previous = there
    prepared = _prepared(light, _START)
    return Row(
        GROUP,
        "light there and back, 2^-30 to 2^30",
        worst,
        limit=8 * EPS32,
        monotone=monotone,
        time_ratio=time_ratio(
            lambda: prepared.expected(_settings(-30)), lambda: prepared.expected(_settings(0))
        ),
    )


def _chains(seed: int, count: int) -> Iterator[Row]:
    """Random transitions that return to where they began: the product of the ratios is 1."""
    rng = np.random.default_rng(seed)
    generator = torch.Generator().manual_seed(seed)
    light = 2.0 ** -(4.0 + 2.0 * torch.rand(4, 16, 16, generator=generator))
    numbers, images = 0.0, 0.0
    for _ in range(count):
        steps = [_START, *map(_random_settings, rng.random((99, 3))), _START]
        ratios = [exposure_ratio(a, b) for a, b in itertools.pairwise(steps)]
        numbers = max(numbers, abs(float(math.prod(map(Fraction, ratios)) - 1)))
        image = light
        for before, after in itertools.pairwise(steps):
            image = _prepared(image, before).expected(after)
        images = max(images, float((image.double() / light.double() - 1.0).abs().max()))
    name = "100 random transitions that return"
    # Each ratio is 2 to the power of a difference of logarithms of up to 2^5.
    yield Row(GROUP, f"{name}, ratios", numbers, limit=100 * 2**6 * EPS64, dtype="float64")
    yield Row(GROUP, f"{name}, light", images, limit=200 * EPS32)


def _random_settings(draw: np.ndarray) -> CameraSettings:
    """ISO 50 to 25600, 1/8000 s to 4 s, f/1.4 to f/22."""
    iso, time, aperture = draw.tolist()
    return CameraSettings(
        50.0 * 2 ** (9 * iso), 2.0 ** (15 * time - 13), 2.0 ** (0.5 + 4 * aperture)
    )


def _nominal_times() -> Row:
    worst = 0.0
    for third, written in enumerate(NOMINAL_TIMES):
        exact = 2.0 ** ((third - 39) / 3.0)
        found = CameraSettings.from_exif(100.0, written, 4.0).exposure_time
        worst = max(worst, abs(found / exact - 1.0))
    return Row(
        GROUP,
        f"{len(NOMINAL_TIMES)} written shutter speeds as exact thirds of a stop",
        worst,
        limit=4 * EPS64,
        dtype="float64",
        note="taken as written, the worst would be off by 6 %",
    )


def _nominal_apertures() -> Row:
    worst = 0.0
    for third, written in enumerate(NOMINAL_APERTURES):
        found = CameraSettings(100.0, 1.0, written).effective_f_number
        worst = max(worst, abs(found / 2.0 ** (third / 6.0) - 1.0))
    name = f"{len(NOMINAL_APERTURES)} written f-numbers as exact thirds of a stop"
    return Row(GROUP, name, worst, limit=4 * EPS64, dtype="float64")
