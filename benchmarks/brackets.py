"""The exposure step against a real multi-exposure bracket (1 to 32 ms in whole stops).

Measures, per plane, the ratio between consecutive exposures against `simulator.exposure_ratio`,
then simulates the 2 to 32 ms frames from the 1 ms frame and the 1 ms frame from each of them, with
and without the noise of the source removed (by `compact`), and compares with the real ones.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import torch
from skimage.io import imread
from skimage.measure import block_reduce
from skimage.metrics import structural_similarity
from skimage.registration import phase_cross_correlation

from benchmarks.harness import Part, Report, Row, benchmark, pivot, real_files, table
from simulator import CameraSettings, CameraSimulator, RawImage, exposure_ratio
from simulator.camera import BayerPattern, CameraProfile
from simulator.noise.noise_level_function import NoiseLevelFunction, noise_variance
from simulator.raw.image import PLANES
from simulator.raw.noise_estimation import estimate_nlf

#: The first is static, the second moves.
SCENES = ("left_c0", "left_c5")
TIMES_MS = (1, 2, 4, 8, 16, 32)
#: Above this level the published response curve is not linear any more (see the ratios).
LINEAR_BELOW = 0.4
#: Green saturates at 0.86 of the largest code, smeared by 0.03, and red at 1: no further up than
#: this is any plane surely unsaturated.
UNSATURATED_BELOW = 0.8
_SOURCE = "measurement only: BorealHDR, left camera"
#: The largest code that the files hold is 4094: saturation, 4089 after linearising.
CAMERA = CameraProfile("boreal_left", BayerPattern.RGGB, (0.0,) * 4, 4089, 12, source=_SOURCE)
BLOCK = 8


def settings(milliseconds: float) -> CameraSettings:
    """Gain and aperture of the bracket are not stated, but fixed: only the time counts."""
    return CameraSettings(iso=100, exposure_time=milliseconds / 1000, f_number=4)


def load(folder: Path, scene: str, milliseconds: int) -> RawImage:
    """One frame, linearised as the data's README says."""
    (path,) = folder.glob(f"{scene}_{milliseconds:04.1f}ms_*.png")
    (curve_path,) = folder.glob("pcalib*.txt")
    curve = 16.0 * np.loadtxt(curve_path).ravel()
    curve[0], curve[-1] = 0.0, 4095.0
    linear = np.interp(imread(path), np.linspace(0, 4095, 256), curve)
    linear = np.minimum(linear, CAMERA.white_level)
    return RawImage.from_mosaic(linear, settings(milliseconds), CAMERA)


def calibrated(frames: dict[int, RawImage]) -> tuple[dict[int, RawImage], dict[str, Any]]:
    """The frames of one gain with one NLF: the median of their blind estimates."""
    estimates = [estimate_nlf(frame.data) for frame in frames.values()]
    values = {key: np.array([getattr(e, key) for e in estimates]) for key in ("shot", "read")}
    shot, read = (tuple(np.median(values[key], axis=0).tolist()) for key in ("shot", "read"))
    camera = CAMERA.with_nlf(100, NoiseLevelFunction(shot, read, source="blind, median of 6"))
    green = {key: [float(f"{v:.3g}") for v in value[:, 1]] for key, value in values.items()}
    return {t: RawImage(f.data, f.settings, camera) for t, f in frames.items()}, green


def ratio_rows(scene: str, frames: dict[int, RawImage]) -> list[Row]:
    """Exposure ratio of consecutive frames, per plane, on block means.

    Averaging blocks of 8 x 8 packed pixels takes out noise and the frames' small shifts; blocks are
    selected by the mean of both frames, because selecting by one would favour its noise.
    """
    rows = []
    for shorter, longer in itertools.pairwise(TIMES_MS):
        nominal = exposure_ratio(settings(shorter), settings(longer))
        x, y = (_blocks(frames[t].data.numpy()) for t in (shorter, longer))
        peak = _blocks(frames[longer].data.numpy(), np.max)
        level = (nominal * x + y) / 2
        for top, (plane, name) in itertools.product(
            (LINEAR_BELOW, UNSATURATED_BELOW), enumerate(PLANES)
        ):
            use = ((level > 0.02) & (level < top) & (peak < UNSATURATED_BELOW))[plane]
            a, b = x[plane][use], y[plane][use]
            row: Row = {"kind": "ratio", "scene": scene, "source_ms": shorter, "target_ms": longer}
            row |= {"plane": name, "levels": [0.02, top], "blocks": len(a), "nominal": nominal}
            row |= {"median": float(np.median(b / a)), "least_squares": float(a @ b / (a @ a))}
            rows.append(row)
    return rows


def _blocks(data: np.ndarray, reduce: Any = np.mean) -> np.ndarray:
    height, width = (n - n % BLOCK for n in data.shape[1:])
    reduced: Any = block_reduce
    return reduced(data[:, :height, :width].astype(np.float64), (1, BLOCK, BLOCK), reduce)


def transition_rows(
    scene: str, times: tuple[int, int], source: RawImage, real: RawImage, seed: int
) -> list[Row]:
    """What is simulated of the `real` frame from the `source`, taken at two `times` [ms]."""
    target, bare = real.settings, CameraSimulator(device="cpu")
    compact = CameraSimulator.from_pretrained(device="cpu").prepare(source, tolerance=0.0)
    exposed = bare.prepare(source).expected(target).clamp(0.0, 1.0)
    # Rows and columns [packed pixel] by which the simulation must move to lie on the real frame.
    greens = (np.sqrt(np.clip(frame[1], 0.0, 1.0)) for frame in (real.data, exposed))
    registered: Any = phase_cross_correlation
    shift = registered(*map(np.asarray, greens), upsample_factor=20)[0]
    whole = round(float(shift[0])), round(float(shift[1]))
    # Pixels saturated in the source: what they would show when darker is unknown.
    saturated = (source.data >= UNSATURATED_BELOW).any(dim=0).numpy() & (times[1] < times[0])
    own = exposure_ratio(source.settings, target) ** 2 * noise_variance(source.data, source.noise)
    wanted = noise_variance(real.data, real.noise)
    top_up = torch.maximum(own, noise_variance(exposed, source.noise))
    variants = {  # not registered, a blurred frame would be nearer to the real one than a sharp one
        "simulated": (bare.simulate(source, target, seed=seed).data, (0, 0)),
        "exposure only": (exposed, (0, 0)),
        "exposure only, registered": (exposed, whole),
        "exposure of denoised, registered": (compact.expected(target).clamp(0.0, 1.0), whole),
    }
    head: Row = {"kind": "transition", "scene": scene, "source_ms": times[0]}
    head |= {"target_ms": times[1], "masked_share": float(saturated.mean())}
    rows = []
    for name, (image, moved) in variants.items():
        noise = wanted + (top_up if name == "simulated" else own)
        limit = _decibel(noise[:, torch.from_numpy(~saturated)].double().mean().item())
        scores = compare(image.numpy(), real.data.numpy(), saturated, moved)
        rows.append({**head, "variant": name, **scores, "psnr_noise_limit_db": limit})
    return rows


def compare(image: np.ndarray, real: np.ndarray, left_out: np.ndarray, moved: Any) -> Row:
    image = np.roll(image, moved, axis=(1, 2)).astype(np.float64)
    real = real.astype(np.float64)
    inside = ~np.roll(left_out, moved, axis=(0, 1))
    if border := max(map(abs, moved)):
        inside[:border], inside[-border:], inside[:, :border], inside[:, -border:] = (False,) * 4
    options: Any = {"data_range": 1.0, "channel_axis": 0, "use_sample_covariance": False}
    options |= {"gaussian_weights": True, "sigma": 1.5, "full": True}
    measure: Any = structural_similarity
    _, similarity = measure(image, real, **options)
    error, power = ((image - real) ** 2)[:, inside].mean(), (real[:, inside] ** 2).mean()
    ours, theirs = (
        texture(torch.from_numpy(x), torch.from_numpy(inside[1:, 1:])) for x in (image, real)
    )
    scores: Row = {"psnr_db": _decibel(error), "ssim": float(similarity[:, inside].mean())}
    scores |= {"relative_rmse": float(np.sqrt(error / power)), "texture_ratio": ours / theirs}
    return scores


def texture(image: torch.Tensor, use: torch.Tensor) -> float:
    """Mean square of the diagonal difference of 2 x 2 neighbours: noise, and detail alike.

    `use` (H - 1, W - 1) chooses them; 0 where it is nowhere true.
    """
    a, b, c, d = (image[:, i : i - 1 or None, j : j - 1 or None] for i in (0, 1) for j in (0, 1))
    return float(((a - b - c + d) / 2.0)[:, use].square().mean()) if use.any() else 0.0


def _decibel(mean_square: float) -> float | None:
    return -10 * float(np.log10(mean_square)) if mean_square > 0 else None


def measure(scene: str, seed: int, quick: bool) -> dict[str, Any]:
    folder = real_files("boreal_brackets")
    frames, estimates = calibrated({t: load(folder, scene, t) for t in TIMES_MS})
    rows = ratio_rows(scene, frames)
    steps = [(1, t) for t in TIMES_MS[1:]] + [(t, 1) for t in TIMES_MS[1:]]
    for source, target in steps[3:6] if quick else steps:
        pair = frames[source], frames[target]
        rows += transition_rows(scene, (source, target), *pair, seed)
    return {"rows": rows, "estimates": estimates, "frame": list(frames[1].data.shape)}


def parts(seed: int, quick: bool) -> list[Part]:
    real_files("boreal_brackets")  # raises before any work
    return [Part(s, measure, {"scene": s}, threads=1) for s in SCENES[: 1 if quick else None]]


_COLUMNS = """transition = {source_ms} to {target_ms} ms: {variant} | PSNR [dB] = {psnr_db:.2f} |
noise limit [dB] = {psnr_noise_limit_db:.2f} | SSIM = {ssim:.4f} |
relative RMSE = {relative_rmse:.4f} | texture ratio = {texture_ratio:.3f} |
masked = {masked_share:.2%}"""


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    rows = [row for own in results.values() for row in own["rows"]]
    estimates = {scene: own["estimates"] for scene, own in results.items()}
    more: dict[str, Any] = {"blind_nlf_of_green": {"exposure_ms": list(TIMES_MS), **estimates}}
    more["frame"] = next(iter(results.values()))["frame"]
    ratios = (row for row in rows if row["kind"] == "ratio")
    line = "scene, frames, levels = {scene}, {source_ms} to {target_ms} ms, {levels}"
    found = {"ratios": pivot(ratios, line, "{plane}", "{median:.3f} ({least_squares:.3f})")}
    for scene in SCENES:
        own = (row for row in rows if (row["kind"], row["scene"]) == ("transition", scene))
        found[scene] = table(own, _COLUMNS)
    return Report(rows, found, meta=more)


run = benchmark("brackets", parts, report)
