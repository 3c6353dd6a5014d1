"""The exposure step against a real multi-exposure bracket (1 to 32 ms in whole stops).

    ae-env bench brackets

Measures, per plane, the ratio between consecutive exposures against `simulator.exposure_ratio`,
then simulates the 2 to 32 ms frames from the 1 ms frame and the 1 ms frame from each of them, with
and without the noise of the source removed, and compares with the real ones.
"""

from __future__ import annotations

import functools
import itertools
import statistics
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from skimage.io import imread
from skimage.measure import block_reduce
from skimage.metrics import structural_similarity
from skimage.registration import phase_cross_correlation

from benchmarks.denoising import behind_anscombe, non_local_means
from benchmarks.harness import Part, Report, Row, benchmark, data_folder, pivot, table
from benchmarks.isolated import timed
from simulator import (
    BayerPattern,
    CameraProfile,
    CameraSettings,
    CameraSimulator,
    NoiseLevelFunction,
    PreparedScene,
    RawImage,
    estimate_nlf,
    exposure_ratio,
)
from simulator.networks.noise_module import SIZES
from simulator.noise.noise_level_function import noise_variance
from simulator.raw.image import PLANES

#: The first is static, the second moves.
SCENES = ("left_c0", "left_c5")
#: Timed runs of each simulation.
REPEATS = 5
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


@dataclass
class Pair:
    """One transition between two real frames."""

    scene: str
    source_ms: int
    target_ms: int
    source: RawImage
    target: RawImage
    seconds_apart: float

    @property
    def masked(self) -> np.ndarray:
        """(H, W) pixels saturated in the source: what they would show when darker is unknown."""
        saturated = (self.source.data >= UNSATURATED_BELOW).any(dim=0).numpy()
        return saturated if self.target_ms < self.source_ms else np.zeros_like(saturated)


def settings(milliseconds: float) -> CameraSettings:
    """Gain and aperture of the bracket are not stated, but fixed: only the time counts."""
    return CameraSettings(iso=100, exposure_time=milliseconds / 1000, f_number=4)


def load(folder: Path, scene: str, milliseconds: int) -> tuple[RawImage, float]:
    """One frame, linearised as the data's README says, and when it was taken [s]."""
    (path,) = folder.glob(f"{scene}_{milliseconds:04.1f}ms_*.png")
    (curve_path,) = folder.glob("pcalib*.txt")
    curve = 16.0 * np.loadtxt(curve_path).ravel()
    curve[0], curve[-1] = 0.0, 4095.0
    linear = np.interp(imread(path), np.linspace(0, 4095, 256), curve)
    linear = np.minimum(linear, CAMERA.white_level)
    taken = int(path.stem.rsplit("_", 1)[1]) / 1e9
    return RawImage.from_mosaic(linear, settings(milliseconds), CAMERA), taken


def load_pairs(folder: Path, scene: str) -> tuple[list[Pair], dict[str, Any]]:
    """Every transition from and to 1 ms, and the blind noise estimates of green."""
    loaded = {t: load(folder, scene, t) for t in TIMES_MS}
    frames, estimates = calibrated({t: raw for t, (raw, _) in loaded.items()})
    steps = [(1, t) for t in TIMES_MS[1:]] + [(t, 1) for t in TIMES_MS[1:]]
    pairs = []
    for source, target in steps:
        apart = abs(loaded[source][1] - loaded[target][1])
        pairs.append(Pair(scene, source, target, frames[source], frames[target], apart))
    return pairs, estimates


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


def denoised_scenes(source: RawImage) -> dict[str, PreparedScene]:
    found = {}
    for name in SIZES:
        simulator = CameraSimulator.from_pretrained(name, device="cpu")
        found[f"exposure of denoised, {name}"] = simulator.prepare(source, tolerance=0.0)
    light = behind_anscombe(non_local_means)(source.data, source.noise)
    none = NoiseLevelFunction.zero()
    found["exposure of VST + NLM"] = PreparedScene(light, source.settings, source.camera, none)
    return found


def transition_rows(
    pair: Pair, denoised: Mapping[str, PreparedScene], repeats: int, seed: int
) -> list[Row]:
    target, bare = pair.target.settings, CameraSimulator(device="cpu")
    real, source = pair.target.data.numpy(), pair.source
    calls = {"simulated": lambda: bare.simulate(source, target, seed=seed).data}
    for name, own in {"exposure only": bare.prepare(source), **denoised}.items():
        calls[name] = lambda own=own: own.expected(target).clamp(0.0, 1.0)  # type: ignore[misc]
    found = {name: timed_result(call, repeats) for name, call in calls.items()}
    exposed = found["exposure only"][0]
    # Rows and columns [packed pixel] by which the simulation must move to lie on the real frame.
    greens = (np.sqrt(np.clip(frame[1], 0.0, 1.0)) for frame in (real, exposed.numpy()))
    registered: Any = phase_cross_correlation
    shift = registered(*greens, upsample_factor=20)[0]
    whole = round(float(shift[0])), round(float(shift[1]))
    ratio = exposure_ratio(source.settings, target)
    own_variance = ratio**2 * noise_variance(source.data, source.noise)
    target_variance = noise_variance(pair.target.data, pair.target.noise)
    top_up = torch.maximum(own_variance, noise_variance(exposed, source.noise))
    usable = np.broadcast_to(~pair.masked, real.shape)
    head: Row = {"kind": "transition", "scene": pair.scene, "source_ms": pair.source_ms}
    head |= {"target_ms": pair.target_ms, "masked_share": float(pair.masked.mean())}
    head |= {"seconds_apart": pair.seconds_apart, "image_shift": shift.tolist()}
    rows = []
    for variant, (image, ms) in found.items():
        # Not registered, a blurred frame would be nearer to the real one than a sharp one.
        moves = {"simulated": ((0, 0),), "exposure only": ((0, 0), whole)}.get(variant, (whole,))
        noise = target_variance + (top_up if variant == "simulated" else own_variance)
        limit = _decibel(noise.numpy()[usable].mean(dtype=np.float64))
        for moved in moves:
            name = variant + ", registered" * (moved is whole)
            row = {**head, "variant": name, **compare(image.numpy(), real, pair, moved)}
            rows.append(row | {"psnr_noise_limit_db": limit, "ms": ms})
    return rows


def compare(image: np.ndarray, real: np.ndarray, pair: Pair, moved: tuple[int, int]) -> Row:
    image = np.roll(image, moved, axis=(1, 2)).astype(np.float64)
    real = real.astype(np.float64)
    inside = ~np.roll(pair.masked, moved, axis=(0, 1))
    if border := max(map(abs, moved)):
        inside[:border], inside[-border:], inside[:, :border], inside[:, -border:] = (False,) * 4
    use = np.broadcast_to(inside, real.shape)
    longer = pair.target if pair.target_ms > pair.source_ms else pair.source
    linear = use & (longer.data.numpy() < LINEAR_BELOW)
    square = (image - real) ** 2
    options: Any = {"data_range": 1.0, "channel_axis": 0, "use_sample_covariance": False}
    options |= {"gaussian_weights": True, "sigma": 1.5, "full": True}
    measure: Any = structural_similarity
    _, similarity = measure(image, real, **options)
    error, power = square[use].mean(), (real[use] ** 2).mean()
    scores: Row = {"psnr_db": _decibel(error), "ssim": float(similarity[use].mean())}
    scores |= {"psnr_linear_range_db": _decibel(square[linear].mean())}
    scores |= {"relative_rmse": float(np.sqrt(error / power))}
    ours, theirs = (
        texture(torch.from_numpy(x), torch.from_numpy(inside[1:, 1:])) for x in (image, real)
    )
    return scores | {"texture_ratio": ours / theirs}


def texture(image: torch.Tensor, use: torch.Tensor) -> float:
    """Mean square of the diagonal difference of 2 x 2 neighbours: noise, and detail alike.

    `use` (H - 1, W - 1) chooses them; 0 where it is nowhere true.
    """
    a, b, c, d = (image[:, i : i - 1 or None, j : j - 1 or None] for i in (0, 1) for j in (0, 1))
    return float(((a - b - c + d) / 2.0)[:, use].square().mean()) if use.any() else 0.0


def _decibel(mean_square: float) -> float | None:
    return -10 * float(np.log10(mean_square)) if mean_square > 0 else None


def timed_result(call: Callable[[], torch.Tensor], repeats: int) -> tuple[torch.Tensor, float]:
    """Result of `call` and the median time of `repeats` runs after one to warm up [ms]."""
    result = call()
    return result, 1e3 * statistics.median(timed(call) for _ in range(repeats))


def measure(scene: str, repeats: int, seed: int) -> dict[str, Any]:
    pairs, estimates = load_pairs(data_folder("boreal_brackets"), scene)
    frames = {pair.source_ms: pair.source for pair in pairs}
    rows = ratio_rows(scene, frames)
    denoised = functools.cache(denoised_scenes)
    for pair in pairs if repeats > 1 else pairs[3:6]:
        rows += transition_rows(pair, denoised(pair.source), repeats, seed)
    return {"rows": rows, "estimates": estimates, "frame": list(frames[1].data.shape)}


def parts(seed: int, quick: bool) -> list[Part]:
    data_folder("boreal_brackets")  # raises before any work
    given = {"repeats": 1 if quick else REPEATS, "seed": seed}
    scenes = SCENES[: 1 if quick else None]
    return [Part(scene, measure, {"scene": scene, **given}, threads=1) for scene in scenes]


_COLUMNS = f"""transition = {{source_ms}} to {{target_ms}} ms: {{variant}} |
PSNR [dB] = {{psnr_db:.2f}} | noise limit [dB] = {{psnr_noise_limit_db:.2f}} |
PSNR below {LINEAR_BELOW} [dB] = {{psnr_linear_range_db:.2f}} | SSIM = {{ssim:.4f}} |
relative RMSE = {{relative_rmse:.4f}} | texture ratio = {{texture_ratio:.3f}} | ms = {{ms:.1f}} |
masked = {{masked_share:.2%}} | shift = {{image_shift[0]:.2f}}, {{image_shift[1]:.2f}} |
s apart = {{seconds_apart:.3f}}"""


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
