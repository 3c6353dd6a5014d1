"""Noise reduction from ISO 6400 to ISO 100 on held-out radiance maps, against classical methods.

The source has 1/64 of the target's exposure time: the same brightness, and the light of the scene's
incident-light exposure, where little clips. The truth is the noise-free mean. Non-local means and
wavelets get what the networks get, the noise level function: they run behind the generalised
Anscombe transform, where the noise has a standard deviation of 1, and its unbiased inverse
(Makitalo and Foi 2013, closed form).
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from skimage.restoration import denoise_nl_means, denoise_wavelet
from torch import Tensor

from benchmarks.simulator.models import Models
from benchmarks.simulator.scenes import Progress, clipped, held_out_scenes, psnr
from simulator import (
    CameraSettings,
    CameraSimulator,
    NoiseLevelFunction,
    PreparedScene,
    RawImage,
    get_camera,
)
from simulator.noise.noise_level_function import nlf_tensors
from simulator.reference.reference_camera import ReferenceCamera, ReferenceCapture

CAMERAS = ("nikon_z6", "canon_70d")
SOURCE_ISO, TARGET_ISO = 6400, 100
#: Least gain over EXP that is asked of ``compact`` [dB].
ASKED = {"nikon_z6": 4.0, "canon_70d": 5.0}
#: Exposure ratios, in stops, at which the gain must be the same.
STOPS = (-12, -9, -6, -3, -0.5, 0, 0.5, 3, 6, 9, 12)
#: Non-local means' strength in units of the noise and patch size, and the wavelet: the best of a
#: few on the validation maps, halved as the test maps are.
NLM_STRENGTH, NLM_PATCH, WAVELET = 0.6, 3, "db2"
#: What denoises a raw: takes it and its prepared scene, returns (4, H, W).
Denoiser = Callable[[PreparedScene], Tensor]


def measure(
    models: Models, *, seed: int, quick: bool, progress: Progress | None = None
) -> list[dict[str, Any]]:
    """One row per camera and method, and per camera, network and exposure ratio.

    Without the radiance maps there are none.

    Args:
        models: What is measured.
        seed: Of the noise.
        quick: Two small views.
        progress: Called with the camera and the share that is done.
    """
    networks = {"NS `compact`": models.compact, "NS `paper`": models.paper}
    simulators = {name: s for name, s in networks.items() if s is not None}
    denoisers: dict[str, Denoiser] = {
        **{name: simulator.denoise for name, simulator in simulators.items()},
        "non-local means": behind_anscombe(non_local_means),
        "wavelets (BayesShrink)": behind_anscombe(wavelets),
        "wavelets, 16 cycle spins": behind_anscombe(spun_wavelets),
    }
    rows: list[dict[str, Any]] = []
    for number, camera in enumerate(CAMERAS):
        captures = list(_captures(camera, seed, quick))
        results: dict[str, list[tuple[float, float]]] = {name: [] for name in denoisers}
        for done, (raw, target) in enumerate(captures):
            if progress is not None:
                progress(camera, (number + done / len(captures)) / len(CAMERAS))
            for name, denoise in denoisers.items():
                results[name].append(_gain(denoise, raw, target.mean))
        for name, values in results.items() if captures else ():
            rows.append(_row(camera, name, values, captures))
        for name, simulator in simulators.items() if captures else ():
            rows += _ratio_rows(camera, name, simulator, captures[:: max(1, len(captures) // 8)])
    return rows


def _captures(camera: str, seed: int, quick: bool) -> Iterator[tuple[RawImage, ReferenceCapture]]:
    """Noisy sources and their targets: every view, or two if `quick`."""
    profile = get_camera(camera)
    reference = ReferenceCamera(profile)
    known = held_out_scenes(camera, quick=quick)
    scenes = [s for s in known if s.kind == "radiance"]
    for scene in scenes[:2] if quick else scenes:
        target = scene.reference
        time = target.exposure_time * TARGET_ISO / SOURCE_ISO
        source = CameraSettings(SOURCE_ISO, time, target.f_number)
        taken = reference.capture(scene, source, seed)
        yield RawImage(taken.sample, source, profile), reference.capture(scene, target, seed)


def _gain(denoise: Denoiser, raw: RawImage, mean: Tensor) -> tuple[float, float]:
    """By how much `denoise` raises the PSNR [dB], and how long it takes [ms]."""
    prepared = CameraSimulator(device="cpu").prepare(raw)
    began = time.perf_counter()
    image = denoise(prepared)
    milliseconds = 1e3 * (time.perf_counter() - began)
    before = psnr(clipped(prepared.light, raw.camera), mean)
    return psnr(clipped(image, raw.camera), mean) - before, milliseconds


def _row(
    camera: str,
    method: str,
    values: list[tuple[float, float]],
    captures: list[tuple[RawImage, ReferenceCapture]],
) -> dict[str, Any]:
    gains, times = (np.array(v) for v in zip(*values, strict=True))
    means = [target.mean for _, target in captures]
    before = [psnr(raw.data, target.mean) for raw, target in captures]
    return {
        "part": "denoising",
        "camera": camera,
        "method": method,
        "views": len(captures),
        "size": means[0].shape[-1],
        "gain_db": float(gains.mean()),
        "gain_db_10_percent": float(np.quantile(gains, 0.1)),
        "gain_db_90_percent": float(np.quantile(gains, 0.9)),
        "exp_db": float(np.mean(before)),
        "clipped": float(np.mean([(mean >= 1.0).double().mean() for mean in means])),
        "milliseconds": float(np.median(times)),
    }


def _ratio_rows(
    camera: str,
    method: str,
    simulator: CameraSimulator,
    captures: list[tuple[RawImage, ReferenceCapture]],
) -> Iterator[dict[str, Any]]:
    """The gain of a network after an exposure by each ratio, nothing clipped."""
    for stops in STOPS:
        ratio = 2.0**stops
        gains = []
        for raw, target in captures:
            prepared = CameraSimulator(device="cpu").prepare(raw)
            exposed = replace(
                prepared, light=prepared.light * ratio, nlf=prepared.nlf.exposed(ratio)
            )
            images = (exposed.light, simulator.denoise(exposed))
            before, after = (psnr(image, target.mean * ratio, peak=ratio) for image in images)
            gains.append(after - before)
        yield {
            "part": "denoising",
            "camera": camera,
            "method": method,
            "stops": stops,
            "views": len(captures),
            "gain_db": float(np.mean(gains)),
        }


# -- classical methods ----------------------------------------------------------------------------


def behind_anscombe(denoise: Callable[[np.ndarray], np.ndarray]) -> Denoiser:
    """`denoise`, which removes noise of standard deviation 1, as a denoiser of raws."""

    def denoiser(prepared: PreparedScene) -> Tensor:
        stable = anscombe(prepared.light, prepared.nlf)
        smooth = denoise(stable.double().numpy())
        return inverse_anscombe(torch.from_numpy(smooth), prepared.nlf).float()

    return denoiser


def anscombe(raw: Tensor, nlf: NoiseLevelFunction) -> Tensor:
    """Generalised Anscombe transform of a raw (4, H, W): its noise has a deviation of about 1.

    >>> nlf = NoiseLevelFunction((1e-3,) * 4, (0.0,) * 4)
    >>> round(float(anscombe(torch.full((4, 1, 1), 0.1), nlf)[0]), 3)
    20.037
    """
    shot, read = nlf_tensors(nlf)
    return 2.0 * (raw / shot + 0.375 + read / shot.square()).clamp(min=0.0).sqrt()


def inverse_anscombe(stable: Tensor, nlf: NoiseLevelFunction) -> Tensor:
    """What raw (4, H, W) has `stable` as the mean of its transform: unbiased, in closed form."""
    shot, read = nlf_tensors(nlf)
    # The transform of no light at all; below it the closed form turns up again.
    d = torch.maximum(stable, 2.0 * (0.375 + read / shot.square()).sqrt())
    root = 1.5**0.5
    counts = d.square() / 4 - 1 / 8 + root / (4 * d) - 11 / (8 * d.square()) + 5 * root / (8 * d**3)
    return (counts - read / shot.square()) * shot


def non_local_means(stable: np.ndarray) -> np.ndarray:
    """Non-local means (4, H, W), patches 3 x 3 within 6 pixels, planes compared together."""
    return denoise_nl_means(
        stable,
        patch_size=NLM_PATCH,
        patch_distance=6,
        h=NLM_STRENGTH,
        sigma=1.0,
        fast_mode=True,
        channel_axis=0,
    )


def wavelets(stable: np.ndarray) -> np.ndarray:
    """Wavelet denoising (4, H, W) with BayesShrink's soft thresholds."""
    return denoise_wavelet(
        stable,
        sigma=1.0,
        wavelet=WAVELET,
        method="BayesShrink",
        mode="soft",
        rescale_sigma=False,
        channel_axis=0,
    )


def spun_wavelets(stable: np.ndarray) -> np.ndarray:
    """The mean of `wavelets` over 16 shifts of the image: without its blocks, 16 times the work."""
    total = np.zeros_like(stable)
    for shift in itertools.product(range(4), repeat=2):
        back = tuple(-s for s in shift)
        total += np.roll(wavelets(np.roll(stable, shift, (1, 2))), back, (1, 2))
    return total / 16.0


# -- report ---------------------------------------------------------------------------------------


def section(rows: list[dict[str, Any]]) -> str:
    """Markdown: gain and time of every method, and the gain by exposure ratio."""
    if not rows:
        return "Left out: the radiance maps are not here."
    own = [r for r in rows if "stops" not in r]
    first = own[0]
    lines = [
        f"{first['views']} views of {first['size']} x {first['size']} into held-out radiance maps, "
        f"captured at ISO {SOURCE_ISO} and 1/{SOURCE_ISO // TARGET_ISO} of the target's exposure "
        f"time; the truth is the noise-free mean at ISO {TARGET_ISO}. Gain of PSNR over the noisy "
        "source (EXP), mean over the views and its 10 and 90 % quantiles. Non-local means and "
        "wavelets are scikit-image's, behind the generalised Anscombe transform and its unbiased "
        "inverse; their strength, patch size and wavelet are the best on the validation maps.",
        "",
        "| method"
        + "".join(f" | {camera}: gain [dB] | 10 to 90 % | ms" for camera in CAMERAS)
        + " |",
        "|---" + "|--:" * (3 * len(CAMERAS)) + "|",
    ]
    for method in dict.fromkeys(r["method"] for r in own):
        cells = []
        for camera in CAMERAS:
            row = next(r for r in own if (r["camera"], r["method"]) == (camera, method))
            low, high = row["gain_db_10_percent"], row["gain_db_90_percent"]
            cells += [f"{row['gain_db']:.2f}", f"{low:.2f} to {high:.2f}"]
            cells.append(f"{row['milliseconds']:.1f}")
        lines.append(f"| {method} | {' | '.join(cells)} |")
    asked = "; ".join(f"{camera} {ASKED[camera]:g} dB" for camera in CAMERAS)
    exposure = "; ".join(
        f"{r['camera']} {r['exp_db']:.2f} dB, {r['clipped']:.1%} of the target's pixels at white"
        for r in own
        if r["method"] == first["method"]
    )
    lines += ["", f"Asked of `compact`: {asked}, and more than every other row. EXP: {exposure}."]
    return "\n".join([*lines, "", *_ratio_table([r for r in rows if "stops" in r])])


def _ratio_table(rows: list[dict[str, Any]]) -> list[str]:
    lines = [
        "Gain [dB] after an exposure by a ratio, nothing clipped; asked of `compact`: the same to "
        "0.1 dB.",
        "",
        "| camera, method |" + "".join(f" 2^{stops:g} |" for stops in STOPS) + " largest change |",
        "|---" + "|--:" * (len(STOPS) + 1) + "|",
    ]
    for key in dict.fromkeys((r["camera"], r["method"]) for r in rows):
        gains = {r["stops"]: r["gain_db"] for r in rows if (r["camera"], r["method"]) == key}
        change = max(abs(gain - gains[0]) for gain in gains.values())
        cells = " | ".join(f"{gains[stops]:.2f}" for stops in STOPS)
        lines.append(f"| {', '.join(key)} | {cells} | {change:.3g} |")
    return lines
