"""Denoising of real detail that no training saw, sampled as a sensor samples it.

One crop of every source of the test split of `simulator.training.scenes`, photographed by the
reference camera. The gain is that of the PSNR over the noisy input. One thread. Clipped views of
maps go the whole way of a user's raw, the estimate of what is clipped included.
"""

import math
import zlib
from collections.abc import Callable
from functools import partial
from itertools import product
from time import perf_counter
from typing import Any, get_args

import numpy as np
import pandas as pd
import torch
from skimage.restoration import denoise_nl_means
from torch import Tensor

from benchmarks.fidelity.models import weights
from benchmarks.harness import Part, Report, Row, benchmark, interval, pivot, table
from simulator import CameraSettings, CameraSimulator, RawImage, get_camera
from simulator.networks.noise_module import SIZES
from simulator.networks.weights import load_modules
from simulator.noise.generator import noise_generator
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.radiance.reading import read_radiance
from simulator.reference.reference_camera import ReferenceCamera, lens_blur, sample_mosaic
from simulator.training.crops import DetailPicture
from simulator.training.scenes import FURTHER_MAPS, Split, detail_pictures, radiance_files
from simulator.utils.checks import import_extra
from simulator.utils.files import data_folder

#: Sources are photographed by both cameras in turn.
CAMERAS = ("nikon_z6", "canon_70d")
ISOS, LEVELS = (400, 1600, 6400, 16000), (0, -3, -6)
#: Of views with highlights; at level 0 the brightest 5 % of samples begin at half of white.
BRIGHT_ISOS, BRIGHT_LEVELS, BRIGHT_GAINS = (1600, 6400), (0, -1, -2, -4), ((1, 1, 1), (2, 1, 1.5))
#: Side of a crop [packed pixel], and sources measured by one part.
SIZE, _AT_ONCE = 128, 4
#: A recorded mosaic is a case where the noise that is added has this many times its own variance.
_CLEAN_RATIO = 16.0
#: Non-local means' strength in units of the noise, and patch size: the best on validation maps.
NLM_STRENGTH, NLM_PATCH = 0.6, 3
REFERENCE = "BM3D"
#: A denoiser takes a raw (4, H, W) and its noise, and returns (4, H, W).
Denoiser = Callable[[Tensor, NoiseLevelFunction], Tensor]


def sources() -> list[DetailPicture]:
    found: dict[str, DetailPicture] = {}
    for picture in detail_pictures("test", data=data_folder(), drawn=0):
        if picture.kind != "linear" and min(picture.light.shape[1:]) >= 2 * SIZE:
            found.setdefault(picture.group, picture)
    return [found[group] for group in sorted(found)]


def cases(number: int, picture: DetailPicture, seed: int) -> list[tuple[Row, Any, Tensor, Tensor]]:
    """Facts, noise, light up to white and record of a crop of `picture`, the `number`-th source."""
    rng = np.random.default_rng([zlib.crc32(picture.name.encode()), seed])
    side = SIZE * picture.photosites
    top, left = (int(rng.integers(n - side + 1)) for n in picture.light.shape[1:])
    light = picture.light[:, top : top + side, left : left + side]
    if picture.photosites == 2:
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
        row: Row = {"source": picture.name, "kind": picture.kind, "camera": camera.name}
        row |= {"iso": iso, "ev": level}
        made.append((row, added, exposed.clamp(max=1.0), noisy))
    return made


@torch.no_grad()
def _by_network(module: Any, raw: Tensor, nlf: NoiseLevelFunction) -> Tensor:
    shot, read = (torch.tensor([v]) for v in (nlf.shot, nlf.read))
    return module(raw[None], shot, read)[0]


def networks() -> dict[str, Denoiser]:
    """The noise modules that come with the package, and the paper's where it was trained."""
    found = {name: load_modules(w)[0] for name in (*SIZES, "paper") if (w := weights(name))}
    return {name: partial(_by_network, modules["noise"]) for name, modules in found.items()}


def classical() -> dict[str, Denoiser]:
    found = {"VST + NLM": non_local_means, REFERENCE: bm3d_planes}
    return {name: behind_anscombe(denoise) for name, denoise in found.items()}


def measure(methods: str, first: int, seed: int, quick: bool) -> list[Row]:
    known, rows = {"networks": networks, "classical": classical}[methods](), []
    chosen = list(enumerate(sources()))[first : first + (1 if quick else _AT_ONCE)]
    every = [case for number, picture in chosen for case in cases(number, picture, seed)]
    for about, nlf, light, noisy in every[::3] if quick else every:
        before, green = _error(noisy, light), light[1] - light[2]
        for name, denoise in known.items():
            begun = perf_counter()
            clean = denoise(noisy, nlf)
            row: Row = {"part": "cases", "method": name, **about}
            row["milliseconds"] = 1e3 * (perf_counter() - begun)
            row["gain_db"] = 10.0 * math.log10(before / max(_error(clean, light), 1e-30))
            kept = float(((clean[1] - clean[2]) * green).sum() / green.square().sum())
            rows.append(row | {"green_kept": kept})
    return rows


def measure_highlights(seed: int, quick: bool, split: Split = "test") -> list[Row]:
    """Light of raws of maps, estimated above white and denoised, against light that never clips."""
    data, rows = data_folder(), []
    simulators = {k: CameraSimulator.from_pretrained(k, device="cpu") for k in SIZES}
    files = [] if data is None else list(radiance_files(data, split))
    if data is not None and split == "test":  # no network was trained on these
        files += (f for s in get_args(Split) for f in radiance_files(data, s, FURTHER_MAPS))
    for number, (path, _) in enumerate(files[:2] if quick else files):
        light = torch.from_numpy(read_radiance(path))
        if min(light.shape[1:]) < 2 * SIZE:
            continue
        rng = np.random.default_rng([zlib.crc32(path.stem.encode()), seed])
        top, left = (int(rng.integers(n - 2 * SIZE + 1)) for n in light.shape[1:])
        light = sample_mosaic(lens_blur(light[:, top : top + 2 * SIZE, left : left + 2 * SIZE]))
        for gains, iso, level in product(BRIGHT_GAINS, BRIGHT_ISOS, BRIGHT_LEVELS):
            true = light / torch.tensor(gains)[[0, 1, 1, 2], None, None]
            true *= 2.0**level / max(2 * float(true.quantile(0.95)), 1e-9)
            noise = noise_generator(seed, number, iso, level)
            camera = get_camera(CAMERAS[number % 2])
            noisy = ReferenceCamera(camera).record(true, iso, noise)
            raw = RawImage(noisy, CameraSettings(iso, 1 / 60, 4), camera, white_balance=gains)
            made = {k: s.prepare(raw) for k, s in simulators.items()}
            found = {"the estimate alone": made["large"].light}
            found |= {k: p.denoised_lights[-1].light for k, p in made.items()}
            for (name, clean), most in product(found.items(), (1.0, math.inf)):
                errors = [_error(x, true.clamp(max=most), most) for x in (noisy, clean)]
                row: Row = {"part": "highlights", "method": name, "source": path.stem, "iso": iso}
                row |= {"light": f"{'above' if most > 1 else 'up to'} white", "ev": level}
                row |= {"gains": "{:g}, {:g}, {:g}".format(*gains)}
                rows.append(row | {"gain_db": 10.0 * math.log10(errors[0] / errors[1])})
    return rows


def _error(image: Tensor, truth: Tensor, most: float = 1.0) -> float:
    return float((image.clamp(max=most).double() - truth.double()).square().mean())


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
    """Generalised Anscombe transform of a raw (4, H, W): its noise has a deviation of about 1."""
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
    bm3d = import_extra("bm3d", "bench", "comparing with BM3D")
    mixed = np.tensordot(_HADAMARD, stable, axes=1).transpose(1, 2, 0)
    smooth = bm3d.bm3d(mixed, [1.0] * 4).transpose(2, 0, 1)
    return np.tensordot(_HADAMARD.T, smooth, axes=1)


#: Orthonormal: the mean of the planes first, as colour BM3D puts luminance first.
_HADAMARD = np.array([[1, 1, 1, 1], [1, -1, 1, -1], [1, 1, -1, -1], [1, -1, -1, 1]]) / 2.0


def parts(seed: int, quick: bool) -> list[Part]:
    starts = list(range(0, len(sources()), 1 if quick else _AT_ONCE))[: 2 if quick else None]
    return [
        Part(f"{methods} {first}", measure, {"methods": methods, "first": first}, threads=1)
        for methods, first in product(("networks", "classical"), starts)
    ] + [Part("highlights", measure_highlights, threads=1)]


#: Beside every mean.
_GAINS = """gain [dB] = {gain_db:.2f} | worst = {worst:.2f} | below 0 = {below:.1%} |
below -0.1 dB = {clearly_below:.1%}"""
_COLUMNS = f"""method = {{method}} | {_GAINS} | 10th percentile = {{gain_db_10_percent:.2f}} |
to BM3D [dB] = {{to_bm3d_db:+.2f}} ({{ci95:+.2f}}) | green difference kept = {{green_kept:.2f}} |
ms = {{milliseconds:.1f}}"""


def gains_of(cases: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    """Mean gain, worst case and shares that lose, of each group."""
    gains = cases.groupby(by, sort=False)["gain_db"]
    found = gains.agg(gain_db="mean", worst="min", cases="size")
    for name, limit in (("below", 0.0), ("clearly_below", -0.1)):
        lost = cases["gain_db"].lt(limit)
        found[name] = lost.groupby([cases[key] for key in by], sort=False).mean()
    return found.reset_index()


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    rows = [row for own in results.values() for row in own]
    every = pd.DataFrame(rows)
    cases, bright = every[every["part"] == "cases"], every[every["part"] == "highlights"]
    by_source, summary = cases.pivot_table("gain_db", "source", "method"), []
    for row in gains_of(cases, ["method"]).to_dict("records"):
        own = cases[cases["method"] == row["method"]]
        differences = (by_source[row["method"]] - by_source[REFERENCE]).to_numpy()
        row |= {"part": "summary", "gain_db_10_percent": own["gain_db"].quantile(0.1)}
        row |= {"to_bm3d_db": differences.mean(), "ci95": interval(differences)}
        summary.append(row | own[["green_kept", "milliseconds"]].median().to_dict())
    means = gains_of(cases, ["iso", "ev", "method"])
    means = means.sort_values(["iso", "ev"], ascending=[True, False], kind="stable")
    line, group = "method = {method}", "ISO {iso:.0f}, EV {ev:.0f}"
    shown = gains_of(bright, ["method", "light", "gains"]).to_dict("records")
    tables = {"methods": table(summary, _COLUMNS)}
    contents = "{gain_db:.2f} ({worst:.2f}, {below:.0%})"
    tables["by_iso"] = pivot(means.to_dict("records"), line, group, contents)
    columns = "method = {method} | light counts = {light} | white balance = {gains} | "
    tables["highlights"] = table(shown, f"{columns}cases = {{cases}} | {_GAINS}")
    return Report([*summary, *rows], tables, meta={"sources": len(by_source)})


run = benchmark("denoising", parts, report)
