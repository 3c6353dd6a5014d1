"""Signals at both ends of what a sensor can hold, and far beyond them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch

from benchmarks.stability.case import Row, time_ratio
from simulator import CameraProfile, CameraSettings, NoiseLevelFunction, PreparedScene, get_camera
from simulator.capture.exposure import Exposure
from simulator.capture.sensor import add_noise
from simulator.noise.generator import FrameNoise
from simulator.optics.blur import disc_blur, motion_blur
from simulator.optics.shapes import disc_kernel, motion_kernel

GROUP = "signals"
EPS32 = 2.0**-24
_SIZE = 48
_REFERENCE = CameraSettings(iso=100.0, exposure_time=1.0, f_number=4.0)
#: Exposures of each signal relative to the reference's [stops].
STOPS = (-30.0, -10.0, -1.0, 0.0, 1.0, 10.0, 30.0)


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """The cases of this group."""
    camera = get_camera("nikon_z6")
    ordinary = _ordinary(seed)
    for name, light in extreme_signals(seed).items():
        for device in devices():
            yield _recorded(name, light.to(device), ordinary.to(device), camera)
    for name, light in extreme_signals(seed).items():
        if name in _BLURRED:
            yield _blurred(name, light, ordinary)
    yield _shapes()
    yield _monotone(camera)
    for exponent in range(-12, 1, 3):
        yield _variance(10.0**exponent, seed, 4 if quick else 32)


def devices() -> list[str]:
    """Torch devices that are at hand."""
    return ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]


def _ordinary(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 0.05 + 0.4 * torch.rand(4, _SIZE, _SIZE, generator=generator)


def extreme_signals(seed: int) -> dict[str, torch.Tensor]:
    """Light (4, H, W) by name, for a Nikon Z6."""
    camera = get_camera("nikon_z6")
    rng = np.random.default_rng(seed)
    board = (torch.arange(_SIZE)[:, None] + torch.arange(_SIZE)) % 2
    hot = torch.zeros(4, _SIZE, _SIZE)
    hot[:, _SIZE // 2, _SIZE // 2] = 1e6
    stops = torch.from_numpy(rng.uniform(-30.0, 0.0, (4, _SIZE, _SIZE)))
    flat = torch.ones(4, _SIZE, _SIZE)
    return {
        "zero": 0.0 * flat,
        "one digital number": flat / torch.tensor(camera.span)[:, None, None],
        "negative, as dark as black goes": -flat * torch.tensor(camera.pedestal)[:, None, None],
        "all saturated": flat.clone(),
        "one hot pixel of 1e6": hot,
        "checkerboard of 0 and 1": board.float().expand(4, _SIZE, _SIZE).contiguous(),
        "30 stops in one frame": (2.0**stops).float(),
        "light of 1e6": 1e6 * flat,
    }


_BLURRED = ("zero", "one hot pixel of 1e6", "checkerboard of 0 and 1", "30 stops in one frame")


def _exposed(stops: float) -> CameraSettings:
    half = 2.0 ** (stops / 2.0)
    return CameraSettings(100.0 * half, half, 4.0)


def _recorded(name: str, light: torch.Tensor, ordinary: torch.Tensor, camera: CameraProfile) -> Row:
    """Without noise, against float64: the recorded number less the exact one before rounding."""
    clean = replace(camera, nlf_by_iso={100.0: NoiseLevelFunction.zero()}, segments=())
    prepared = PreparedScene(light, _REFERENCE, clean, NoiseLevelFunction.zero())
    frames = prepared.expose([_exposed(stops) for stops in STOPS]).cpu().numpy().astype(np.float64)
    exact_light = light.cpu().numpy().astype(np.float64)
    span, black = (np.array(v)[:, None, None] for v in (camera.span, camera.black_level))
    worst = 0.0
    for stops, frame in zip(STOPS, frames, strict=True):
        exact = np.clip(exact_light * 2.0**stops * span + black, 0.0, None)
        exact = np.minimum(exact, camera.white_level)
        worst = max(worst, float(np.abs(frame * span + black - exact).max()))
    states = [_exposed(stops) for stops in STOPS]
    usual = PreparedScene(ordinary, _REFERENCE, clean, NoiseLevelFunction.zero())
    clipped = bool((light >= 1.0).any())
    return Row(
        GROUP,
        f"{name}, recorded at -30 to +30 stops",
        worst,
        error="digital numbers",
        # Rounding to whole numbers, and float32 products of numbers of 14 bits.
        limit=0.5 + 4 * EPS32 * 2**14,
        dtype="float32" if light.device.type == "cpu" else f"float32, {light.device.type}",
        finite=bool(np.isfinite(frames).all()),
        time_ratio=time_ratio(lambda: prepared.expose(states), lambda: usual.expose(states)),
        declared="clipped highlights: `info['clipped_high']`, `PreparedScene.saturated`" * clipped,
    )


def _blurred(name: str, light: torch.Tensor, ordinary: torch.Tensor) -> Row:
    """A streak and a disc, against the weights times shifted copies in float64."""
    worst, finite = 0.0, True
    for extent in (0.3, 5.0, 40.0):
        found = motion_blur(light, extent)
        finite &= bool(torch.isfinite(found).all())
        worst = max(worst, _relative(found, _weighted(light, motion_kernel(extent)[None]), light))
    for diameter in (0.5, 6.0, 20.0):
        found = disc_blur(light, diameter)
        finite &= bool(torch.isfinite(found).all())
        worst = max(worst, _relative(found, _weighted(light, disc_kernel(diameter)), light))
    return Row(
        GROUP,
        f"{name}, blurred",
        worst,
        error="of the brightest",
        limit=64 * EPS32,
        finite=finite,
        time_ratio=time_ratio(lambda: disc_blur(light, 6.0), lambda: disc_blur(ordinary, 6.0)),
    )


def _relative(found: torch.Tensor, wanted: np.ndarray, light: torch.Tensor) -> float:
    difference = np.abs(found.numpy().astype(np.float64) - wanted).max()
    return float(difference / max(float(light.abs().max()), 1e-30))


def _weighted(light: torch.Tensor, weights: np.ndarray) -> np.ndarray:
    """Sum of copies of `light` shifted by each weight's place, borders repeated."""
    rows, columns = (size // 2 for size in weights.shape)
    exact = light.numpy().astype(np.float64)
    padded = np.pad(exact, ((0, 0), (rows, rows), (columns, columns)), mode="edge")
    total = np.zeros(light.shape)
    for i, j in np.ndindex(weights.shape):
        total += weights[i, j] * padded[:, i : i + light.shape[1], j : j + light.shape[2]]
    return total


def _shapes() -> Row:
    """Energy and second moment of streaks (extent^2 / 12) and discs (diameter^2 / 16)."""
    worst = 0.0
    for extent in np.geomspace(0.01, 1000.0, 26):
        streak, disc = motion_kernel(extent), disc_kernel(min(extent, 30.0)).sum(axis=0)
        for weights, moment in ((streak, extent**2 / 12), (disc, min(extent, 30.0) ** 2 / 16)):
            offsets = np.arange(len(weights)) - len(weights) // 2
            worst = max(worst, abs(weights.sum() - 1.0))
            if moment > 1e-4:  # less blurs nothing
                worst = max(worst, abs((weights * offsets**2).sum() / moment - 1.0))
    name = "streaks of 0.01 to 1000 pixels, discs of 0.01 to 30: energy and second moment"
    return Row(GROUP, name, float(worst), limit=0.01, dtype="float64")


def _monotone(camera: CameraProfile) -> Row:
    """More light never gives less, whatever the exposure."""
    levels = torch.cat([-(2.0 ** torch.linspace(-4, -30, 500)), torch.zeros(1)])
    levels = torch.cat([levels, 2.0 ** torch.linspace(-30, 30, 1803)])
    light = levels.reshape(1, 48, 48).expand(4, 48, 48).contiguous()
    clean = replace(camera, nlf_by_iso={100.0: NoiseLevelFunction.zero()}, segments=())
    prepared = PreparedScene(light, _REFERENCE, clean, NoiseLevelFunction.zero())
    frames = prepared.expose([_exposed(stops) for stops in STOPS]).flatten(2)
    monotone = bool((frames.diff(dim=-1) >= 0).all())
    finite = bool(torch.isfinite(frames).all())
    name = "a ramp from -2^-4 to 2^30, at -30 to +30 stops"
    return Row(GROUP, name, None, finite=finite, monotone=monotone)


def _variance(variance: float, seed: int, frames: int) -> Row:
    """Noise of a given variance before the clip, on black, where float32 resolves the smallest."""
    nlf = NoiseLevelFunction((0.0,) * 4, (variance,) * 4)
    exposure = Exposure(ratio=1.0, source=NoiseLevelFunction.zero(), target=nlf)
    noises = [FrameNoise(seed * frames + i, "exact") for i in range(frames)]
    light = torch.zeros(frames, 4, 128, 128)
    noisy = add_noise(light, [exposure] * frames, noises)[0].double()
    measured = float(noisy.square().mean()) / variance
    standard_error = math.sqrt(variance / noisy.numel())
    return Row(
        GROUP,
        f"noise of variance {variance:.0e}",
        abs(measured - 1.0),
        error="of the variance",
        limit=5.0 * math.sqrt(2.0 / noisy.numel()),  # five standard errors
        finite=bool(torch.isfinite(noisy).all()),
        unbiased=abs(float(noisy.mean())) < 5.0 * standard_error,
    )
