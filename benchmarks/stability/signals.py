"""Signals at both ends of what a sensor can hold, and far beyond them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch

from benchmarks.stability.case import Row, time_ratio
from simulator import CameraProfile, CameraSettings, Latent, NoiseLevelFunction, get_camera
from simulator.blur import disc_blur, motion_blur
from simulator.blur_shapes import disc_kernel
from simulator.capture import top_up
from simulator.exposure import Exposure

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
        yield _recorded(name, light, ordinary, camera)
    for name, light in extreme_signals(seed).items():
        if name in _BLURRED:
            yield _blurred(name, light, ordinary)
    yield _monotone(camera)
    for exponent in range(-12, 1, 3):
        yield _variance(10.0**exponent, seed, 4 if quick else 32)


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
        "latent of 1e6": 1e6 * flat,
    }


_BLURRED = ("zero", "one hot pixel of 1e6", "checkerboard of 0 and 1", "30 stops in one frame")


def _exposed(stops: float) -> CameraSettings:
    half = 2.0 ** (stops / 2.0)
    return CameraSettings(100.0 * half, half, 4.0)


def _recorded(name: str, light: torch.Tensor, ordinary: torch.Tensor, camera: CameraProfile) -> Row:
    """Without noise, against float64: the recorded number less the exact one before rounding."""
    clean = replace(camera, nlf_by_iso={100.0: NoiseLevelFunction.zero()}, segments=())
    latent = Latent(light, _REFERENCE, clean, NoiseLevelFunction.zero())
    frames = latent.expose([_exposed(stops) for stops in STOPS]).numpy().astype(np.float64)
    span, black = (np.array(v)[:, None, None] for v in (camera.span, camera.black_level))
    worst = 0.0
    for stops, frame in zip(STOPS, frames, strict=True):
        exact = np.clip(light.numpy().astype(np.float64) * 2.0**stops * span + black, 0.0, None)
        exact = np.minimum(exact, camera.white_level)
        worst = max(worst, float(np.abs(frame * span + black - exact).max()))
    states = [_exposed(stops) for stops in STOPS]
    usual = Latent(ordinary, _REFERENCE, clean, NoiseLevelFunction.zero())
    clipped = bool((light >= 1.0).any())
    return Row(
        GROUP,
        f"{name}, recorded at -30 to +30 stops",
        worst,
        error="digital numbers",
        # Rounding to whole numbers, and float32 products of numbers of 14 bits.
        limit=0.5 + 4 * EPS32 * 2**14,
        finite=bool(np.isfinite(frames).all()),
        time_ratio=time_ratio(lambda: latent.expose(states), lambda: usual.expose(states)),
        declared="clipped highlights: `info['clipped_high']`, `Latent.saturated`" * clipped,
    )


def _blurred(name: str, light: torch.Tensor, ordinary: torch.Tensor) -> Row:
    """A streak and a disc, against sums in float64, relative to the brightest light near by."""
    worst, finite, exact_light = 0.0, True, light.double()
    for extent in (0.3, 5.0, 40.0):
        found = motion_blur(light, extent)
        finite &= bool(torch.isfinite(found).all())
        worst = max(worst, _relative(found, motion_blur(exact_light, extent), light))
    for diameter in (0.5, 6.0, 20.0):
        found = disc_blur(light, diameter)
        finite &= bool(torch.isfinite(found).all())
        worst = max(worst, _relative(found, _disc_sum(exact_light, diameter), light))
    return Row(
        GROUP,
        f"{name}, blurred",
        worst,
        error="of the brightest",
        limit=64 * EPS32,
        finite=finite,
        time_ratio=time_ratio(lambda: disc_blur(light, 6.0), lambda: disc_blur(ordinary, 6.0)),
    )


def _relative(found: torch.Tensor, wanted: torch.Tensor, light: torch.Tensor) -> float:
    return float((found.double() - wanted).abs().max() / max(float(light.abs().max()), 1e-30))


def _disc_sum(light: torch.Tensor, diameter: float) -> torch.Tensor:
    """The disc's weights times shifted copies, in float64."""
    weights = disc_kernel(diameter)
    radius = len(weights) // 2
    padded = np.pad(light.numpy(), ((0, 0), (radius, radius), (radius, radius)), mode="edge")
    total = np.zeros(light.shape)
    for i, row in enumerate(weights):
        for j, weight in enumerate(row):
            total += weight * padded[:, i : i + light.shape[1], j : j + light.shape[2]]
    return torch.from_numpy(total)


def _monotone(camera: CameraProfile) -> Row:
    """More light never gives less, whatever the exposure."""
    levels = torch.cat([-(2.0 ** torch.linspace(-4, -30, 500)), torch.zeros(1)])
    levels = torch.cat([levels, 2.0 ** torch.linspace(-30, 30, 1803)])
    light = levels.reshape(1, 48, 48).expand(4, 48, 48).contiguous()
    clean = replace(camera, nlf_by_iso={100.0: NoiseLevelFunction.zero()}, segments=())
    latent = Latent(light, _REFERENCE, clean, NoiseLevelFunction.zero())
    frames = latent.expose([_exposed(stops) for stops in STOPS]).flatten(2)
    monotone = bool((frames.diff(dim=-1) >= 0).all())
    finite = bool(torch.isfinite(frames).all())
    name = "a ramp from -2^-4 to 2^30, at -30 to +30 stops"
    return Row(GROUP, name, None, finite=finite, monotone=monotone)


def _variance(variance: float, seed: int, frames: int) -> Row:
    """Noise of a given variance on a light of 0.5, before the clip: variance and mean."""
    nlf = NoiseLevelFunction((0.0,) * 4, (variance,) * 4)
    exposure = Exposure(ratio=1.0, source=NoiseLevelFunction.zero(), target=nlf)
    generator = torch.Generator().manual_seed(seed)
    # Of a light of 0, so that float32 resolves the smallest of them.
    light = torch.zeros(frames, 4, 128, 128)
    normals = torch.randn(light.shape, generator=generator)
    noisy = top_up(light, [exposure] * frames, normals)[0].double()
    wanted = normals.double() * math.sqrt(variance)
    error = float((noisy - wanted).abs().max() / math.sqrt(variance))
    standard_error = math.sqrt(variance / noisy.numel())
    return Row(
        GROUP,
        f"noise of variance {variance:.0e}",
        error,
        error="standard deviations",
        limit=16 * EPS32,
        finite=bool(torch.isfinite(noisy).all()),
        unbiased=abs(float(noisy.mean())) < 5 * standard_error,
    )
