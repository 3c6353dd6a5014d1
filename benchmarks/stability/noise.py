"""Noise between and beyond calibrated ISOs, of few electrons, over the signal."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy import stats

from benchmarks.harness import Row
from benchmarks.stability.case import row
from simulator import (
    CameraSettings,
    CameraSimulator,
    NoiseLevelFunction,
    PreparedScene,
    get_camera,
    list_cameras,
)

_STATE = CameraSettings(iso=100.0, exposure_time=1.0, f_number=4.0)
#: Largest distance of two distribution functions that we call the same noise.
SAME = 0.05
#: Lags that autocorrelations are taken over [pixel].
_LAGS = 16


def level_functions(seed: int, quick: bool) -> list[Row]:
    """Read and shot noise over ISO, against the nearest calibration where there is no other."""
    isos, rows = np.geomspace(50.0, 409_600.0, 200).tolist(), []
    for name in list_cameras():
        camera, errors, flagged = get_camera(name), [], True
        known = sorted(camera.nlf_by_iso)
        edges = [0.0, *camera.segments, math.inf]
        for iso in isos:
            low = max(edge for edge in edges if edge <= iso)
            own = [i for i in known if low <= i < min(e for e in edges if e > iso)]
            logs = np.log([[(*n.shot, *n.read)] for n in map(camera.nlf, own)])[:, 0]  # (K, 8)
            wanted = np.exp([np.interp(math.log(iso), np.log(own), column) for column in logs.T])
            beyond = iso / min(max(iso, own[0]), own[-1])
            # Shot noise goes with the ISO, read noise before it is rounded with its square.
            rounding = np.repeat([0.0, 1.0], 4) / 12 / camera.span[0] ** 2
            wanted = (wanted - rounding) * np.repeat([beyond, beyond**2], 4) + rounding
            found = camera.nlf(iso)
            errors.append(float(np.abs([*found.shot, *found.read] / wanted - 1.0).max()))
            flagged &= found.extrapolated or known[0] <= iso <= known[-1]
        case, note = f"{name}, ISO 50 to 409600", "beyond the table: `extrapolated`"
        rows.append(row(case, isos, errors, limit=1e-12, dtype="float64", ok=flagged, note=note))
    return rows


# -- few electrons --------------------------------------------------------------------------------


def electrons(seed: int, quick: bool) -> list[Row]:
    """How far the Gaussian of the noise model is from photons, over the number of electrons."""
    nlf, rows = get_camera("nikon_z6").nlf(6400.0), []
    levels = np.geomspace(0.1, 1000.0, 13 if quick else 41)
    for read in (math.sqrt(nlf.read[1]) / nlf.shot[1], 0.3):
        apart = [_gaussian_distance(float(level), read) for level in levels]
        far = levels[np.array(apart) > SAME]
        note = f"below {SAME:.0%} " + (f"above {far.max():.2g} electrons" if len(far) else "always")
        case, unit = f"read noise of {read:.1f} electrons", "of the distribution function"
        note = f"declared: the noise model is Gaussian; {note}"
        rows.append(row(case, levels.tolist(), apart, unit=unit, dtype="float64", note=note))
    return rows


def _photon_law(grid: np.ndarray, level: float, read: float) -> np.ndarray:
    """Distribution function of a photon count and Gaussian read noise [electrons]."""
    counts = np.arange(int(level + 40 * math.sqrt(level) + 60))
    weights = stats.poisson.pmf(counts, level)
    return (weights[:, None] * stats.norm.cdf((grid - counts[:, None]) / read)).sum(axis=0)


def _gaussian_distance(level: float, read: float) -> float:
    """Largest distance of that function and of a Gaussian's of the same mean and variance."""
    sigma = math.sqrt(level + read**2)
    grid = np.linspace(-8 * sigma, level + 10 * sigma + 8, 8001)
    gaussian = stats.norm.cdf((grid - level) / sigma)
    return float(np.abs(_photon_law(grid, level, read) - gaussian).max())


# -- over the signal ----------------------------------------------------------------------------


def statistics(seed: int, quick: bool) -> list[Row]:
    """Noise of even grey frames, drawn and from the bank, against the noise level function.

    Variance over signal; the distribution's distance from the normal; autocorrelation in space and
    over frames. What chance alone gives is the limit.
    """
    camera, frames, side = get_camera("nikon_z6"), 16 if quick else 128, 64
    levels = [2.0**stop for stop in range(-9, 0)]
    state = CameraSettings(6400, 1 / 64, 4.0)
    nlf, rows = camera.nlf(state.iso), []
    chance = 5.0 / math.sqrt(4 * side * side * frames)
    for noise in ("exact", "bank"):
        found: dict[str, list[float]] = {}
        for number, level in enumerate(levels):
            light = torch.full((4, side, side), level)
            prepared = PreparedScene(light, state, camera, NoiseLevelFunction.zero())
            options: dict[str, Any] = {"noise": noise}
            seeds = range(seed + 1000 * number, seed + 1000 * number + frames)
            taken = torch.cat([prepared.expose([state], seed=s, **options) for s in seeds])
            step = 1 / (12 * np.square(camera.span))  # rounding adds its own
            variance = np.array(nlf.read) + np.array(nlf.shot) * level + step
            normals = (taken.double().numpy() - level) / np.sqrt(variance)[:, None, None]
            for name, value in _whiteness(normals).items():
                found.setdefault(name, []).append(value)
        limits = {"variance": 1.5 * chance, "autocorrelation in space": 1.5 * chance}
        for name, errors in found.items():
            case, limit = f"{name}, {noise} noise", limits.get(name, chance)
            rows.append(row(case, levels, errors, unit="of the normal", limit=limit))
    return rows


def _whiteness(normals: np.ndarray) -> dict[str, float]:
    """Departures of (T, 4, H, W) from independent standard normals."""
    ordered = normals[:, 0].ravel()
    values, counts = np.unique(ordered, return_counts=True)  # whole digital numbers
    share = counts.cumsum()[:-1] / ordered.size
    law = stats.norm.cdf((values[1:] + values[:-1]) / 2)
    lagged = [normals[..., lag:] * normals[..., :-lag] for lag in range(1, _LAGS + 1)]
    return {
        "variance": abs(float(normals.var()) - 1.0),
        "distribution of a plane": float(np.abs(share - law).max()) / 2,  # 4 times fewer samples
        "autocorrelation in space": max(abs(float(product.mean())) for product in lagged),
        "autocorrelation over frames": abs(float((normals[1:] * normals[:-1]).mean())),
    }


def networks(seed: int, quick: bool) -> list[Row]:
    """Denoising commutes with exposure: `compact` against itself unexposed, in float32."""
    generator, camera = torch.Generator().manual_seed(seed), get_camera("nikon_z6")
    light = torch.rand(4, 32, 32, generator=generator)
    light += 0.02 * torch.randn(light.shape, generator=generator)
    nlf = NoiseLevelFunction((1e-3,) * 4, (1e-5,) * 4)
    prepared, stops = PreparedScene(light, _STATE, camera, nlf), range(-24, 25, 6 if quick else 2)
    wanted = CameraSimulator.from_pretrained(device="cpu", cache=None).denoise(prepared).double()
    rows = []
    for dtype, limit in (("float32", 1e-5), ("bfloat16", 0.03)):
        precision: Any = dtype
        own = CameraSimulator.from_pretrained(device="cpu", precision=precision, cache=None)
        errors = []
        for stop in stops:
            scale = 2.0**stop
            exposed = replace(prepared, light=light * scale, nlf=nlf.exposed(scale))
            back = own.denoise(exposed).double() / scale
            errors.append(float((back - wanted).abs().max() / wanted.abs().max()))
        case, unit = "compact: exposed, denoised, exposed back", "of the brightest"
        rows.append(row(case, stops, errors, unit=unit, limit=limit, dtype=dtype))
    return rows
