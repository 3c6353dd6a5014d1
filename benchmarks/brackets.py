"""The exposure step against a real multi-exposure bracket (1 to 32 ms in whole stops).

    ae-env bench brackets

Measures, per plane, the ratio between consecutive exposures against `simulator.exposure_ratio`,
then simulates the 2 to 32 ms frames from the 1 ms frame and the 1 ms frame from each of them, and
compares with the real ones. Writes the JSON and, beside it, the same as Markdown.
"""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from skimage.io import imread
from skimage.metrics import structural_similarity
from skimage.registration import phase_cross_correlation

from benchmarks.data import data_folder
from simulator import (
    CameraProfile,
    CameraSettings,
    CameraSimulator,
    NoiseLevelFunction,
    RawImage,
    estimate_nlf,
    exposure_ratio,
)
from simulator.raw.image import PLANES
from simulator.utils.files import write_atomically
from simulator.utils.results import result_meta, write_results

SCENES = {"left_c0": "static", "left_c5": "moving"}
#: Timed runs of each simulation.
REPEATS = 5
TIMES_MS = (1, 2, 4, 8, 16, 32)
#: Above this level the published response curve is not linear any more (see the ratios).
LINEAR_BELOW = 0.4
#: Green saturates at 0.86 of the largest code, smeared by 0.03, and red at 1: no further up than
#: this is any plane surely unsaturated.
UNSATURATED_BELOW = 0.8
#: The largest code that the files hold is 4094: saturation, 4089 after linearising.
CAMERA = CameraProfile(
    "boreal_left", "RGGB", 0, 4089, 12, source="measurement only: BorealHDR, left camera"
)
BLOCK = 8


@dataclass
class Pair:
    """One transition: the real source and target, and what the simulator makes of the source."""

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

    @property
    def brighter(self) -> np.ndarray:
        """(4, H, W) real frame with the longer exposure."""
        raw = self.target if self.target_ms > self.source_ms else self.source
        return raw.data.numpy()


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
    """Every transition from and to 1 ms, and the blind noise estimates of green.

    Args:
        folder: Of the data set.
        scene: One of `SCENES`.
    """
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
    median = {key: tuple(np.median(value, axis=0)) for key, value in values.items()}
    camera = CAMERA.with_nlf(100, NoiseLevelFunction(**median, source="blind, median of 6 frames"))
    green = {key: [float(f"{v:.3g}") for v in value[:, 1]] for key, value in values.items()}
    return {t: RawImage(f.data, f.settings, camera) for t, f in frames.items()}, green


def ratio_rows(scene: str, frames: dict[int, RawImage]) -> list[dict[str, Any]]:
    """Exposure ratio of consecutive frames, per plane, on block means.

    Averaging blocks of 8 x 8 packed pixels takes out noise and the frames' small shifts; blocks are
    selected by the mean of both frames, because selecting by one would favour its noise.
    """
    rows = []
    for shorter, longer in itertools.pairwise(TIMES_MS):
        nominal = exposure_ratio(settings(shorter), settings(longer))
        x, y = (_blocks(frames[t].data.numpy()) for t in (shorter, longer))
        peak = _blocks(frames[longer].data.numpy(), np.max)
        for top in (LINEAR_BELOW, UNSATURATED_BELOW):
            level = (nominal * x + y) / 2
            use = (level > 0.02) & (level < top) & (peak < UNSATURATED_BELOW)
            for plane, name in enumerate(PLANES):
                a, b = x[plane][use[plane]], y[plane][use[plane]]
                low, median, high = np.percentile(b / a, (25, 50, 75))
                rows.append(
                    {
                        "kind": "ratio",
                        "scene": scene,
                        "source_ms": shorter,
                        "target_ms": longer,
                        "plane": name,
                        "levels": [0.02, top],
                        "blocks": len(a),
                        "nominal": nominal,
                        "median": round(float(median), 4),
                        "quartiles": [round(float(low), 4), round(float(high), 4)],
                        "least_squares": round(float(a @ b / (a @ a)), 4),
                    }
                )
    return rows


def _blocks(data: np.ndarray, reduce: Any = np.mean) -> np.ndarray:
    planes, height, width = data.shape
    h, w = height // BLOCK, width // BLOCK
    cut = data[:, : h * BLOCK, : w * BLOCK].astype(np.float64)
    return reduce(cut.reshape(planes, h, BLOCK, w, BLOCK), axis=(2, 4))


def transition_rows(pair: Pair, repeats: int, seed: int) -> list[dict[str, Any]]:
    """Simulated and real frame of one transition, beside the baselines that bound the figures."""
    simulator = CameraSimulator(device="cpu")
    target = pair.target.settings
    out, simulate_ms = timed(lambda: simulator.simulate(pair.source, target, seed=seed), repeats)

    def expose() -> torch.Tensor:
        return simulator.prepare(pair.source).expected(target).clamp(0.0, 1.0)

    exposed, expose_ms = timed(expose, repeats)
    real, simulated = pair.target.data.numpy(), out.data.numpy()
    shift = image_shift(real, exposed.numpy())
    noise = pair.target.noise
    source_variance = exposed_variance(pair.source, exposure_ratio(pair.source.settings, target))
    target_variance = variance(real, noise)
    top_up = np.maximum(source_variance, variance(exposed.numpy(), pair.source.noise))
    renoised = renoise(real, target_variance, seed)

    def row(variant: str, image: np.ndarray, limit: np.ndarray | None, ms: Any) -> dict[str, Any]:
        registered = variant.endswith("registered")
        moved = [round(float(v)) for v in shift] if registered else [0, 0]
        scores = compare(image, real, pair, (moved[0], moved[1]))
        usable = np.broadcast_to(~pair.masked, real.shape)
        if limit is not None:
            scores["psnr_noise_limit_db"] = decibel(float(limit[usable].mean()))
        return {
            "kind": "transition",
            "scene": pair.scene,
            "source_ms": pair.source_ms,
            "target_ms": pair.target_ms,
            "variant": variant,
            **scores,
            "ms": ms,
            "masked_share": round(float(pair.masked.mean()), 5),
            "seconds_apart": round(pair.seconds_apart, 3),
            "image_shift": [round(float(v), 2) for v in shift],
            "excess_noise": round(out.metadata["excess_noise"], 4),
        }

    clean_limit = source_variance + target_variance
    return [
        row("simulated", simulated, top_up + target_variance, simulate_ms),
        row("exposure only", exposed.numpy(), clean_limit, expose_ms),
        row("exposure only, registered", exposed.numpy(), clean_limit, expose_ms),
        row("real, noise added again", renoised, target_variance, None),
        row("no simulation", pair.source.data.numpy(), None, None),
    ]


def variance(signal: np.ndarray, nlf: NoiseLevelFunction) -> np.ndarray:
    """Noise variance of (4, H, W) `signal` under `nlf`."""
    shot, read = (np.array(v)[:, None, None] for v in (nlf.shot, nlf.read))
    return read + shot * np.maximum(signal, 0.0)


def exposed_variance(source: RawImage, ratio: float) -> np.ndarray:
    """Noise variance that the source brings after its exposure was multiplied by `ratio`."""
    return ratio**2 * variance(source.data.numpy(), source.noise)


def renoise(real: np.ndarray, noise_variance: np.ndarray, seed: int) -> np.ndarray:
    """The real frame with fresh noise of its own strength: no simulation can agree better."""
    normals = np.random.default_rng(seed).standard_normal(real.shape)
    noisy = np.clip(real + np.sqrt(noise_variance) * normals, 0.0, 1.0)
    return np.round(noisy * CAMERA.white_level) / CAMERA.white_level


def image_shift(real: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """(rows, columns) in packed pixels by which `predicted` must move to lie on `real`."""
    a, b = (np.sqrt(np.clip(x[1], 0.0, 1.0)) for x in (real, predicted))
    shift, _, _ = phase_cross_correlation(a, b, upsample_factor=20)
    return shift


def compare(
    image: np.ndarray, real: np.ndarray, pair: Pair, moved: tuple[int, int]
) -> dict[str, Any]:
    """PSNR, SSIM and relative RMSE over the unmasked pixels, `image` rolled by `moved` first."""
    border = max(map(abs, moved))
    image = np.roll(image, moved, axis=(1, 2))
    masked = np.roll(pair.masked, moved, axis=(0, 1))
    inside = np.zeros_like(masked)
    inside[border : masked.shape[0] - border, border : masked.shape[1] - border] = True
    use = np.broadcast_to(inside & ~masked, real.shape)
    linear = use & (pair.brighter < LINEAR_BELOW)
    square = (image.astype(np.float64) - real) ** 2
    _, similarity = structural_similarity(
        image.astype(np.float64),
        real.astype(np.float64),
        data_range=1.0,
        channel_axis=0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    error, power = square[use].mean(), (real[use].astype(np.float64) ** 2).mean()
    return {
        "psnr_db": decibel(float(error)),
        "psnr_linear_range_db": decibel(float(square[linear].mean())),
        "ssim": round(float(similarity[use].mean()), 4),
        "relative_rmse": round(float(np.sqrt(error / power)), 4),
        "texture_ratio": round(_texture(image, use) / _texture(real, use), 3),
    }


def _texture(image: np.ndarray, use: np.ndarray) -> float:
    """Mean square of the diagonal difference of 2 x 2 neighbours: noise, and detail alike."""
    a, b, c, d = image[:, :-1, :-1], image[:, 1:, :-1], image[:, :-1, 1:], image[:, 1:, 1:]
    return float((((a - b - c + d) / 2)[use[:, 1:, 1:]] ** 2).mean(dtype=np.float64))


def decibel(mean_square: float) -> float | None:
    """PSNR against 1, None for a perfect match."""
    return round(-10 * float(np.log10(mean_square)), 2) if mean_square > 0 else None


def timed(call: Any, repeats: int) -> tuple[Any, float]:
    """Result of `call` and the median time of `repeats` runs after one to warm up [ms]."""
    result = call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return result, round(1000 * float(np.median(times)), 2)


def report(rows: list[dict[str, Any]], meta: dict[str, Any]) -> str:
    """The rows as Markdown."""
    machine = meta["machine"]
    lines = [
        "# Real brackets against the exposure step",
        "",
        f"Written by `{meta['command']}` on {meta['date'][:10]}: {machine['cpu']}, "
        f"{machine['threads']} thread(s), torch {meta['versions']['torch']}, seed {meta['seed']}, "
        f"frames of {' x '.join(map(str, meta['frame']))} packed.",
        "`docs/colour.md` says how to read it.",
        "",
        "## Exposure ratio between consecutive frames (`exposure_ratio` says 2)",
        "",
        "Median over blocks (least squares through the origin), per plane.",
        "",
        "| scene | frames | levels | " + " | ".join(PLANES) + " |",
        "|---|---|---|" + "---|" * 4,
    ]
    ratios = [r for r in rows if r["kind"] == "ratio"]
    for first in range(0, len(ratios), 4):
        group = ratios[first : first + 4]
        cells = [f"{r['median']:.3f} ({r['least_squares']:.3f})" for r in group]
        head = group[0]
        name = f"{head['scene']} | {head['source_ms']} to {head['target_ms']} ms"
        lines.append(
            f"| {name} | {head['levels'][0]} to {head['levels'][1]} | {' | '.join(cells)} |"
        )
    for scene, kind in SCENES.items():
        lines += [
            "",
            f"## Simulated against real frames: {scene} ({kind})",
            "",
            "| from | to | variant | PSNR dB | noise limit dB | "
            f"PSNR below {LINEAR_BELOW} dB | SSIM | "
            "relative RMSE | texture ratio | ms | masked | shift | s apart |",
            "|---|---|---|" + "---|" * 10,
        ]
        for r in rows:
            if r["kind"] != "transition" or r["scene"] != scene:
                continue
            cells = [r["psnr_db"], r.get("psnr_noise_limit_db"), r["psnr_linear_range_db"]]
            cells += [r["ssim"], r["relative_rmse"], r["texture_ratio"], r["ms"]]
            text = " | ".join("" if c is None else f"{c:g}" for c in cells)
            shift = ", ".join(f"{v:g}" for v in r["image_shift"])
            lines.append(
                f"| {r['source_ms']} | {r['target_ms']} | {r['variant']} | {text} | "
                f"{r['masked_share']:.2%} | {shift} | {r['seconds_apart']:.3f} |"
            )
    return "\n".join(lines) + "\n"


def run(out: Path, *, seed: int = 0, quick: bool = False) -> None:
    """Measures and writes ``brackets.json`` and ``brackets.md`` into `out`.

    Args:
        out: Folder of results.
        seed: Of the simulated noise.
        quick: Only the static scene, each simulation timed once.
    """
    folder = data_folder("boreal_brackets")
    rows: list[dict[str, Any]] = []
    estimates: dict[str, Any] = {}
    for scene in list(SCENES)[: 1 if quick else None]:
        pairs, estimates[scene] = load_pairs(folder, scene)
        frames = {pair.source_ms: pair.source for pair in pairs}
        rows += ratio_rows(scene, frames)
        for pair in pairs:
            rows += transition_rows(pair, 1 if quick else REPEATS, seed)
            best, step = rows[-5], f"{pair.source_ms} -> {pair.target_ms} ms"
            print(f"{scene}: {step}: {best['psnr_db']} dB, {best['ms']} ms")
    meta = result_meta("ae-env bench brackets" + (" --quick" if quick else ""), seed)
    meta["blind_nlf_of_green"] = {"exposure_ms": list(TIMES_MS), **estimates}
    meta["frame"] = list(frames[1].data.shape)
    print(f"wrote {write_results(out / 'brackets.json', rows, meta)}")
    print(f"wrote {write_atomically(out / 'brackets.md', report(rows, meta))}")
