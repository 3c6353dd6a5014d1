"""Noise reduction from ISO 6400 to ISO 100 on held-out radiance maps, against non-local means.

The source has 1/64 of the target's exposure time: the same brightness, and the light of the scene's
incident-light exposure, where little clips. The truth is the noise-free mean. Non-local means
get what the networks get, the noise level function: they run behind the generalised Anscombe
transform, where the noise has a standard deviation of 1, and its unbiased inverse
(Makitalo and Foi 2013, closed form).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from skimage.restoration import denoise_nl_means
from torch import Tensor

from benchmarks.captures import clipped, psnr
from benchmarks.fidelity.models import held_out_scenes, load_models
from benchmarks.harness import Row, pivot
from benchmarks.isolated import timed
from simulator import (
    CameraSettings,
    CameraSimulator,
    NoiseLevelFunction,
    PreparedScene,
    RawImage,
    get_camera,
)
from simulator.reference.reference_camera import ReferenceCamera

CAMERAS = ("nikon_z6", "canon_70d")
SOURCE_ISO, TARGET_ISO = 6400, 100
#: Non-local means' strength in units of the noise and patch size: the best of a few on
#: the validation maps, halved as the test maps are.
NLM_STRENGTH, NLM_PATCH = 0.6, 3
#: A denoiser takes a prepared raw, returns (4, H, W).
Denoiser = Callable[[PreparedScene], Tensor]


def measure(camera: str, seed: int, quick: bool) -> list[Row]:
    """One row per method; none without the radiance maps."""
    profile, bare = get_camera(camera), CameraSimulator(device="cpu")
    reference = ReferenceCamera(profile)
    simulators = load_models().simulators
    denoisers: dict[str, Denoiser] = {
        **{f"NS `{name}`": simulator.denoise for name, simulator in simulators.items()},
        "non-local means": behind_anscombe(non_local_means),
    }
    scenes = [s for s in held_out_scenes(camera, quick) if s.kind == "radiance"]
    scenes = scenes[:2] if quick else scenes
    results: dict[str, list[tuple[float, float]]] = {name: [] for name in denoisers}
    before, white = [], []
    for scene in scenes:
        target = scene.reference
        time = target.exposure_time * TARGET_ISO / SOURCE_ISO
        source = CameraSettings(SOURCE_ISO, time, target.f_number)
        raw = RawImage(reference.capture(scene, source, seed).sample, source, profile)
        mean = reference.capture(scene, target, seed).mean
        prepared = bare.prepare(raw)
        before.append(psnr(clipped(prepared.light, profile), mean))
        white.append(float((mean >= 1.0).double().mean()))
        for name, denoise in denoisers.items():
            found: list[Tensor] = []
            seconds = timed(lambda d=denoise, p=prepared, f=found: f.append(d(p)))  # type: ignore[misc]
            gain = psnr(clipped(found[0], profile), mean) - before[-1]
            results[name].append((gain, 1e3 * seconds))
    rows = []
    for name, values in results.items() if scenes else ():
        gains, times = (np.array(v) for v in zip(*values, strict=True))
        row: Row = {"part": "denoising", "camera": camera, "method": name, "views": len(scenes)}
        row |= {"size": scenes[0].light.shape[-1], "gain_db": float(gains.mean())}
        row |= {f"gain_db_{n}_percent": float(np.quantile(gains, n / 100)) for n in (10, 90)}
        row |= {"exp_db": float(np.mean(before)), "clipped": float(np.mean(white))}
        rows.append(row | {"milliseconds": float(np.median(times))})
    return rows


# -- classical methods ----------------------------------------------------------------------------


def behind_anscombe(denoise: Callable[[np.ndarray], np.ndarray]) -> Denoiser:
    """`denoise`, which removes noise of standard deviation 1, as a denoiser of raws."""

    def denoiser(prepared: PreparedScene) -> Tensor:
        stable = anscombe(prepared.light, prepared.nlf)
        smooth = denoise(stable.double().numpy())
        return inverse_anscombe(torch.from_numpy(smooth), prepared.nlf).float()

    return denoiser


def _planes(nlf: NoiseLevelFunction) -> tuple[Tensor, Tensor]:
    """Shot and read noise of each plane, (4, 1, 1)."""
    shot, read = (torch.tensor(v, dtype=torch.float64)[:, None, None] for v in (nlf.shot, nlf.read))
    return shot, read


def anscombe(raw: Tensor, nlf: NoiseLevelFunction) -> Tensor:
    """Generalised Anscombe transform of a raw (4, H, W): its noise has a deviation of about 1.

    >>> nlf = NoiseLevelFunction((1e-3,) * 4, (0.0,) * 4)
    >>> round(float(anscombe(torch.full((4, 1, 1), 0.1), nlf)[0]), 3)
    20.037
    """
    shot, read = _planes(nlf)
    return 2.0 * (raw / shot + 0.375 + read / shot.square()).clamp(min=0.0).sqrt()


def inverse_anscombe(stable: Tensor, nlf: NoiseLevelFunction) -> Tensor:
    """The raw (4, H, W) whose transform has the mean `stable`: unbiased, in closed form."""
    shot, read = _planes(nlf)
    # The transform of no light at all; below it the closed form turns up again.
    d = torch.maximum(stable, 2.0 * (0.375 + read / shot.square()).sqrt())
    root = 1.5**0.5
    counts = d.square() / 4 - 1 / 8 + root / (4 * d) - 11 / (8 * d.square()) + 5 * root / (8 * d**3)
    return (counts - read / shot.square()) * shot


def non_local_means(stable: np.ndarray) -> np.ndarray:
    """Non-local means (4, H, W), patches 3 x 3 within 6 pixels, planes compared together."""
    options: dict[str, Any] = {"patch_size": NLM_PATCH, "patch_distance": 6, "h": NLM_STRENGTH}
    return denoise_nl_means(stable, sigma=1.0, fast_mode=True, channel_axis=0, **options)


def section(rows: list[Row]) -> list[str]:
    """Gain and time of every method."""
    if not rows:
        return ["Left out: the radiance maps are not here."]
    first = rows[0]
    return [
        f"{first['views']} views of {first['size']} x {first['size']} into held-out radiance maps, "
        f"captured at ISO {SOURCE_ISO} and 1/{SOURCE_ISO // TARGET_ISO} of the target's exposure "
        f"time; the truth is the noise-free mean at ISO {TARGET_ISO}. Gain of PSNR over the noisy "
        "source (EXP), mean over the views and its 10 and 90 % quantiles. Non-local means "
        "are scikit-image's, behind the generalised Anscombe transform and its unbiased inverse; "
        "their strength and patch size are the best on the validation maps.",
        pivot(
            rows,
            line=("method", "{method}"),
            columns="{camera}",
            contents={
                "gain [dB]": "{gain_db:.2f}",
                "10 to 90 %": "{gain_db_10_percent:.2f} to {gain_db_90_percent:.2f}",
                "ms": "{milliseconds:.1f}",
                "EXP [dB]": "{exp_db:.2f}",
            },
        ),
    ]
