"""Noise where the Gaussian ends: few electrons, and both ends of the scale."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from scipy import stats

from benchmarks.stability.case import Row, time_ratio
from simulator import CameraProfile, CameraSettings, NoiseLevelFunction, PreparedScene, get_camera
from simulator.noise.generator import Noise
from simulator.reference.reference_camera import ReferenceCamera

GROUP = "noise draws"
_STATE = CameraSettings(iso=100.0, exposure_time=1.0, f_number=4.0)
#: Standard errors that a mean or a variance may be off by.
_SIGMAS = 5.0
#: Largest distance of two distribution functions that we call the same noise.
SAME = 0.05


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """The cases of this group."""
    size = 256 if quick else 1024
    yield _where_the_gaussian_breaks()
    for read in (_read_electrons(get_camera("nikon_z6"), 6400.0), 0.3):
        for electrons in (0.1, 1.0, 3.0, 10.0, 100.0):
            yield from _few(electrons, read, size, seed)
    for noise in ("exact", "bank"):
        for sigmas in (-3.0, -1.0, 0.0, 1.0, 3.0):
            yield _clipped("white", sigmas, noise, size, seed)
            yield _clipped("black", sigmas, noise, size, seed)


def _read_electrons(camera: CameraProfile, iso: float) -> float:
    nlf = camera.nlf(iso)
    return math.sqrt(nlf.read[1]) / nlf.shot[1]


def _poisson_cdf(grid: np.ndarray, electrons: float, read: float) -> np.ndarray:
    """Distribution function of a photon count and Gaussian read noise [electrons]."""
    counts = np.arange(int(electrons + 40 * math.sqrt(electrons) + 60))
    weights = stats.poisson.pmf(counts, electrons)
    return (weights[:, None] * stats.norm.cdf((grid - counts[:, None]) / read)).sum(axis=0)


def _distance(electrons: float, read: float) -> float:
    """Largest distance of that function and of a Gaussian's of the same mean and variance."""
    sigma = math.sqrt(electrons + read**2)
    grid = np.linspace(-8 * sigma, electrons + 10 * sigma + 8, 8001)
    gaussian = stats.norm.cdf((grid - electrons) / sigma)
    return float(np.abs(_poisson_cdf(grid, electrons, read) - gaussian).max())


def _where_the_gaussian_breaks() -> Row:
    """The worst of a sensor that hardly has read noise, and from where on it matters little."""
    read = 0.3  # of the quietest sensors there are
    levels = np.geomspace(0.1, 1000.0, 41)
    distances = [_distance(float(level), read) for level in levels]
    enough = levels[np.nonzero(np.array(distances) > SAME)[0].max() + 1]
    worst = int(np.argmax(distances))
    return Row(
        GROUP,
        f"a Gaussian for photons, read noise of {read:g} electrons, 0.1 to 1000 electrons",
        distances[worst],
        error="of the distribution function",
        dtype="float64",
        declared="the noise model is Gaussian (docs/stability.md)",
        note=f"worst at {levels[worst]:.2g} electrons; below {SAME:.0%} from {enough:.0f} on",
    )


def _few(electrons: float, read: float, size: int, seed: int) -> Iterator[Row]:
    """Captures of a few electrons: the reference camera counts them, the simulator does not."""
    well, black = 1000.0, 4096.0
    nlf = NoiseLevelFunction((1.0 / well,) * 4, ((read / well) ** 2,) * 4)
    camera = replace(
        get_camera("nikon_z6"),
        black_level=(black,) * 4,
        white_level=2.0**16 - 1,
        bit_depth=16,
        nlf_by_iso={100.0: nlf},
        segments=(),
    )
    light = torch.full((4, size, size), electrons / well)
    span = camera.span[0]
    # Between digital numbers [electrons]: a capture rounds to the nearest.
    numbers = np.arange(2**16 - 1)
    grid = (numbers + 0.5 - black) / span * well
    sigma = math.sqrt(electrons + read**2)
    gaussian = stats.norm.cdf((grid - electrons) / sigma)
    prepared = PreparedScene(light, _STATE, camera, NoiseLevelFunction.zero())
    captures = {
        "reference camera against photons": (
            ReferenceCamera(camera).record(light, 100.0, torch.Generator().manual_seed(seed)),
            _poisson_cdf(grid, electrons, read),
        ),
        "simulator against its Gaussian": (prepared.expose([_STATE], seed=seed)[0], gaussian),
    }
    for name, (frame, wanted) in captures.items():
        counts = np.bincount((frame * span + black).round().long().flatten(), minlength=2**16)
        found = np.cumsum(counts)[:-1] / frame.numel()
        mean = float(frame.double().mean()) * well
        yield Row(
            GROUP,
            f"{electrons:g} electrons, read noise of {read:.1f}: {name}",
            float(np.abs(found - wanted).max()),
            error="of the distribution function",
            # Kolmogorov: exceeded by chance once in a million.
            limit=2.7 / math.sqrt(frame.numel()),
            finite=bool(torch.isfinite(frame).all()),
            unbiased=abs(mean - electrons) < _SIGMAS * sigma / math.sqrt(frame.numel()),
            note=f"the two distributions are {_distance(electrons, read):.3f} apart",
        )


def _clipped(end: str, sigmas: float, noise: Noise, size: int, seed: int) -> Row:
    """Mean and variance of captures next to an end of the scale, against the clipped Gaussian's.

    The sensor has no black level, as one whose files are clipped at black.
    """
    sigma = 0.01
    nlf = NoiseLevelFunction((0.0,) * 4, (sigma**2,) * 4)
    camera = replace(
        get_camera("nikon_z6"),
        black_level=(0.0,) * 4,
        white_level=2.0**16 - 1,
        bit_depth=16,
        nlf_by_iso={100.0: nlf},
        segments=(),
    )
    level = 1.0 - sigmas * sigma if end == "white" else sigmas * sigma
    light = torch.full((4, size, size), level)
    prepared = PreparedScene(light, _STATE, camera, NoiseLevelFunction.zero())
    frame = prepared.expose([_STATE], seed=seed, noise=noise)[0].double()
    # The distance from the end is a Gaussian clipped at 0.
    away = 1.0 - frame if end == "white" else frame
    mean, variance, kurtosis = _clipped_gaussian(sigmas * sigma, sigma)
    count = frame.numel()
    mean_error = (float(away.mean()) - mean) / math.sqrt(variance / count)
    spread = variance * math.sqrt((kurtosis - 1.0) / count)
    variance_error = (float(away.var()) - variance) / spread
    ordinary = PreparedScene(torch.full_like(light, 0.5), _STATE, camera, NoiseLevelFunction.zero())
    return Row(
        GROUP,
        f"{sigmas:+g} standard deviations from {end}, {noise}",
        max(abs(mean_error), abs(variance_error)),
        error="standard errors",
        limit=_SIGMAS,
        finite=bool(torch.isfinite(frame).all()),
        unbiased=abs(mean_error) < _SIGMAS,
        time_ratio=time_ratio(
            lambda: prepared.expose([_STATE], noise=noise),
            lambda: ordinary.expose([_STATE], noise=noise),
            repeats=3,
        ),
        note=f"the clip moves the mean by {mean / sigma - sigmas:+.3f} standard deviations",
    )


def _clipped_gaussian(mean: float, sigma: float) -> tuple[float, float, float]:
    """Mean, variance and kurtosis of max(0, x), x normal: closed forms of its moments."""
    z = mean / sigma
    density, above = float(stats.norm.pdf(z)), float(stats.norm.cdf(z))
    moments = [above, mean * above + sigma * density]
    for order in range(2, 5):  # integration by parts
        moments.append(mean * moments[-1] + (order - 1) * sigma**2 * moments[-2])
    first, second, third, fourth = moments[1:]
    variance = second - first**2
    central = fourth - 4 * first * third + 6 * first**2 * second - 3 * first**4
    return first, variance, central / variance**2
