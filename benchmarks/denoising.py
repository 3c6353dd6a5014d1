"""Denoising of real detail that no training saw, sampled as a sensor samples it.

One crop of every source of the test split of `simulator.training.scenes`: views into radiance maps,
photographs and recorded mosaics, photographed by the reference camera. Every case is denoised by
every method; the gain is that of the PSNR over the noisy input. One thread.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import product
from time import perf_counter
from typing import Any

import numpy as np
import pandas as pd
import torch
from skimage.restoration import denoise_nl_means
from torch import Tensor

from benchmarks.fidelity.models import trained_noise_modules
from benchmarks.harness import Part, Report, Row, benchmark, interval, pivot, table
from simulator import CameraProfile, get_camera
from simulator.noise.generator import noise_generator
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.reference.reference_camera import ReferenceCamera, lens_blur, sample_mosaic
from simulator.training.crops import DetailPicture
from simulator.training.scenes import detail_pictures
from simulator.utils.files import data_folder

#: Sources are photographed by both cameras in turn.
CAMERAS = ("nikon_z6", "canon_70d")
ISOS, LEVELS = (400, 1600, 6400, 16000), (0, -3, -6)
#: Side of a crop [packed pixel], and sources measured by one part.
SIZE, _AT_ONCE = 128, 4
#: A recorded mosaic is a case where the noise that is added has this many times its own variance.
_CLEAN_RATIO = 16.0
#: Non-local means' strength in units of the noise and patch size: the best of a few on
#: the validation maps.
NLM_STRENGTH, NLM_PATCH = 0.6, 3
REFERENCE = "BM3D"
#: A denoiser takes a raw (4, H, W) and its noise, and returns (4, H, W).
Denoiser = Callable[[Tensor, NoiseLevelFunction], Tensor]


@dataclass(frozen=True)
class Case:
    """One photograph of one crop."""

    source: str
    kind: str
    camera: CameraProfile
    iso: int
    level: int
    light: Tensor
    noisy: Tensor


def sources() -> list[DetailPicture]:
    found: dict[str, DetailPicture] = {}
    for picture in detail_pictures("test", data=data_folder(), drawn=0):
        if picture.kind != "linear" and min(picture.light.shape[1:]) >= 2 * SIZE:
            found.setdefault(picture.group, picture)
    return [found[group] for group in sorted(found)]


def cases(number: int, picture: DetailPicture, seed: int) -> list[Case]:
    """The photographs of a crop of `picture`, the `number`-th source."""
    rng = np.random.default_rng([zlib.crc32(picture.name.encode()), seed])
    mosaic = picture.light.shape[0] == 4
    side = SIZE if mosaic else 2 * SIZE
    top, left = (int(rng.integers(n - side + 1)) for n in picture.light.shape[1:])
    light = picture.light[:, top : top + side, left : left + side]
    if not mosaic:
        light = sample_mosaic(lens_blur(light))
    white = max(float(light.quantile(0.99)), 1e-9)
    camera = get_camera(CAMERAS[number % len(CAMERAS)])
    reference, made = ReferenceCamera(camera), []
    # Every other one, as on a chessboard, and the others of the next but one source: BM3D is slow.
    for iso, level in list(product(ISOS, LEVELS))[number // len(CAMERAS) % 2 :: 2]:
        scale = 2.0**level / white
        own, added = picture.nlf.exposed(scale), camera.nlf(iso)
        ratios = zip((*own.shot, *own.read), (*added.shot, *added.read), strict=True)
        if any(_CLEAN_RATIO * a > b for a, b in ratios):
            continue
        exposed = light * scale
        noisy = reference.record(exposed, iso, noise_generator(seed, number, iso, float(level)))
        clean = exposed.clamp(max=1.0)
        made.append(Case(picture.name, picture.kind, camera, iso, level, clean, noisy))
    return made


def networks() -> dict[str, Denoiser]:
    @torch.no_grad()
    def denoise(module: Any, raw: Tensor, nlf: NoiseLevelFunction) -> Tensor:
        shot, read = (torch.tensor([v]) for v in (nlf.shot, nlf.read))
        result: Tensor = module(raw[None], shot, read)[0]
        return result

    return {name: partial(denoise, module) for name, module in trained_noise_modules().items()}


def classical() -> dict[str, Denoiser]:
    planes = {"VST + NLM": non_local_means, REFERENCE: bm3d_planes}
    return {name: behind_anscombe(denoise) for name, denoise in planes.items()}


def measure(methods: str, first: int, seed: int, quick: bool) -> list[Row]:
    known, rows = {"networks": networks, "classical": classical}[methods](), []
    chosen = list(enumerate(sources()))[first : first + (1 if quick else _AT_ONCE)]
    every = [case for number, picture in chosen for case in cases(number, picture, seed)]
    for case in every[::3] if quick else every:
        before, green = _error(case.noisy, case.light), case.light[1] - case.light[2]
        for name, denoise in known.items():
            begun = perf_counter()
            clean = denoise(case.noisy, case.camera.nlf(case.iso))
            ms = 1e3 * (perf_counter() - begun)
            row: Row = {"part": "cases", "method": name, "milliseconds": ms}
            row |= {"source": case.source, "kind": case.kind, "camera": case.camera.name}
            gain = 10.0 * np.log10(before / max(_error(clean, case.light), 1e-30))
            kept = float(((clean[1] - clean[2]) * green).sum() / green.square().sum())
            row |= {"iso": case.iso, "ev": case.level, "gain_db": float(gain)}
            rows.append(row | {"green_kept": kept})
    return rows


def _error(image: Tensor, truth: Tensor) -> float:
    return float((image.clamp(max=1.0).double() - truth.double()).square().mean())


# -- classical methods ----------------------------------------------------------------------------


def behind_anscombe(denoise: Callable[[np.ndarray], np.ndarray]) -> Denoiser:
    """`denoise`, which removes noise of standard deviation 1, as a denoiser of raws."""

    def denoiser(raw: Tensor, nlf: NoiseLevelFunction) -> Tensor:
        smooth = denoise(anscombe(raw, nlf).double().numpy())
        return inverse_anscombe(torch.from_numpy(smooth), nlf).float()

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


def bm3d_planes(stable: np.ndarray) -> np.ndarray:
    """BM3D; its authors' package is free for non-commercial use only."""
    try:
        import bm3d
    except ImportError:
        raise ImportError("comparing with BM3D needs: pip install 'ae-env[bench]'") from None
    mixed = np.tensordot(_HADAMARD, stable, axes=1).transpose(1, 2, 0)
    smooth = bm3d.bm3d(mixed, [1.0] * 4).transpose(2, 0, 1)
    return np.tensordot(_HADAMARD.T, smooth, axes=1)


#: Orthonormal: the mean of the planes first, as colour BM3D puts luminance first.
_HADAMARD = np.array([[1, 1, 1, 1], [1, -1, 1, -1], [1, 1, -1, -1], [1, -1, -1, 1]]) / 2.0


def parts(seed: int, quick: bool) -> list[Part]:
    step = 1 if quick else _AT_ONCE
    starts = list(range(0, len(sources()), step))[: 2 if quick else None]
    return [
        Part(f"{methods} {first}", measure, {"methods": methods, "first": first}, threads=1)
        for methods, first in product(("networks", "classical"), starts)
    ]


_COLUMNS = """method = {method} | gain [dB] = {gain_db:.2f} |
10th percentile = {gain_db_10_percent:.2f} | worst = {gain_db_worst:.2f} |
to BM3D [dB] = {to_bm3d_db:+.2f} ({ci95:+.2f}) | green difference kept = {green_kept:.2f} |
ms = {milliseconds:.1f}"""


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    rows = [row for own in results.values() for row in own]
    cases, summary = pd.DataFrame(rows), []
    by_source = cases.pivot_table("gain_db", "source", "method")
    for name, own in cases.groupby("method", sort=False):
        differences, gains = (by_source[name] - by_source[REFERENCE]).to_numpy(), own["gain_db"]
        row: Row = {"part": "summary", "method": name, "cases": len(own), "gain_db": gains.mean()}
        row |= {"gain_db_10_percent": gains.quantile(0.1), "gain_db_worst": gains.min()}
        row |= {"to_bm3d_db": differences.mean(), "ci95": interval(differences)}
        summary.append(row | own[["green_kept", "milliseconds"]].median().to_dict())
    means = cases.groupby(["iso", "ev", "method"], sort=False)["gain_db"].mean().reset_index()
    means = means.sort_values(["iso", "ev"], ascending=[True, False], kind="stable")
    line, group = "method = {method}", "ISO {iso:.0f}, EV {ev:.0f}"
    tables = {"methods": table(summary, _COLUMNS)}
    tables["by_iso"] = pivot(means.to_dict("records"), line, group, "{gain_db:.2f}")
    return Report([*summary, *rows], tables, meta={"sources": len(by_source)})


run = benchmark("denoising", parts, report)
