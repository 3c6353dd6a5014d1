"""Noise where the Gaussian ends: few electrons, and both ends of the scale."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from scipy import stats

from benchmarks.stability.case import Row, time_ratio
from simulator import CameraProfile, CameraSettings, Latent, NoiseLevelFunction, get_camera
from simulator.frame_noise import Noise

GROUP = "noise draws"
_STATE = CameraSettings(iso=100.0, exposure_time=1.0, f_number=4.0)
#: Standard errors that a mean or a variance may be off by.
_SIGMAS = 5.0
#: Largest distance of two distribution functions that we call the same noise.
SAME = 0.05


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """The cases of this group."""
    yield _where_the_gaussian_breaks()
    for electrons in (0.1, 1.0, 3.0, 10.0, 100.0):
        yield _poisson(electrons)
    size = 256 if quick else 1024
    for noise in ("exact", "bank"):
        for sigmas in (-3.0, -1.0, 0.0, 1.0, 3.0):
            yield _clipped("white", sigmas, noise, size, seed)
            yield _clipped("black", sigmas, noise, size, seed)


def _distance(electrons: float, read: float) -> tuple[float, float, float]:
    """Photons and read noise against a Gaussian of the same mean and variance.

    Returns:
        Largest distance of the distribution functions; what clipping at black, without a black
        level, adds to the mean of each [electrons].
    """
    counts = np.arange(int(electrons + 40 * math.sqrt(electrons) + 60))
    weights = stats.poisson.pmf(counts, electrons)
    sigma = math.sqrt(electrons + read**2)
    grid = np.linspace(-8 * sigma, electrons + 10 * sigma + 8, 8001)
    exact = (weights[:, None] * stats.norm.cdf((grid - counts[:, None]) / read)).sum(axis=0)
    distance = float(np.abs(exact - stats.norm.cdf((grid - electrons) / sigma)).max())
    lifted = float((weights * _lift(counts, np.full(len(counts), read))).sum())
    return distance, lifted, float(_lift(np.array(electrons), np.array(sigma)))


def _lift(mean: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """What clipping at 0 adds to the mean of a Gaussian."""
    z = mean / sigma
    return sigma * stats.norm.pdf(z) - mean * stats.norm.cdf(-z)


def _poisson(electrons: float) -> Row:
    camera = get_camera("nikon_z6")
    read = _read_electrons(camera, 6400.0)
    distance, exact, gaussian = _distance(electrons, read)
    return Row(
        GROUP,
        f"{electrons:g} electrons and the Z6's read noise at ISO 6400 ({read:.1f})",
        distance,
        error="of the distribution function",
        dtype="float64",
        declared="the noise model is Gaussian (docs/stability.md)" if distance > SAME else "",
        note=f"clipping at black lifts the mean by {exact:.3f}, a Gaussian's by {gaussian:.3f}",
    )


def _read_electrons(camera: CameraProfile, iso: float) -> float:
    nlf = camera.nlf(iso)
    return math.sqrt(nlf.read[1]) / nlf.shot[1]


def _where_the_gaussian_breaks() -> Row:
    """The worst of a sensor that reads without noise, and from where on it hardly matters."""
    read = 0.3  # of the quietest sensors there are
    levels = np.geomspace(0.1, 1000.0, 41)
    distances = [_distance(float(level), read)[0] for level in levels]
    enough = levels[np.nonzero(np.array(distances) > SAME)[0].max() + 1]
    worst = int(np.argmax(distances))
    return Row(
        GROUP,
        f"read noise of {read:g} electrons, 0.1 to 1000 electrons",
        distances[worst],
        error="of the distribution function",
        dtype="float64",
        declared="the noise model is Gaussian (docs/stability.md)",
        note=f"worst at {levels[worst]:.2g} electrons; below {SAME:.0%} from {enough:.0f} on",
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
    latent = Latent(light, _STATE, camera, NoiseLevelFunction.zero())
    frame = latent.expose([_STATE], seed=seed, noise=noise)[0].double()
    # The distance from the end is a Gaussian clipped at 0.
    away = 1.0 - frame if end == "white" else frame
    mean, variance, kurtosis = _clipped_gaussian(sigmas * sigma, sigma)
    count = frame.numel()
    mean_error = (float(away.mean()) - mean) / math.sqrt(variance / count)
    spread = variance * math.sqrt((kurtosis - 1.0) / count)
    variance_error = (float(away.var()) - variance) / spread
    ordinary = Latent(torch.full_like(light, 0.5), _STATE, camera, NoiseLevelFunction.zero())
    return Row(
        GROUP,
        f"{sigmas:+g} standard deviations from {end}, {noise}",
        max(abs(mean_error), abs(variance_error)),
        error="standard errors",
        limit=_SIGMAS,
        finite=bool(torch.isfinite(frame).all()),
        unbiased=abs(mean_error) < _SIGMAS,
        time_ratio=time_ratio(
            lambda: latent.expose([_STATE], noise=noise),
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
