"""Real exposures of 1 to 32 ms: EXP and NS, with and without w and b.

The data and the comparison are those of `benchmarks.brackets`. Gain and aperture are fixed, so
the aperture module has no part in it.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import torch.nn.functional as F

from benchmarks.brackets import (
    BLOCK,
    CAMERA,
    LINEAR_BELOW,
    SCENES,
    UNSATURATED_BELOW,
    Pair,
    compare,
    decibel,
    exposed_variance,
    image_shift,
    load_pairs,
    timed,
    variance,
)
from benchmarks.simulator.scenes import Progress, data_root
from simulator import CameraSimulator, PreparedScene, RawImage, exposure_ratio
from simulator.networks.exposure_module import ExposureModule, LinearFit

if TYPE_CHECKING:
    from benchmarks.simulator.models import Models

#: Transitions of the quick run, and height and width of what it looks at [pixel].
QUICK_STEPS, QUICK_SIZE = ((1, 8), (8, 1)), 192
#: Runs of each timed step.
REPEATS = 3
#: Which w and b: none, those of the training camera's body, those of this camera's other scene.
CORRECTIONS = ("none", "shipped", "other scene")


@dataclass(frozen=True)
class _Method:
    stage: str
    correction: str
    simulator: CameraSimulator


def measure(
    models: Models, *, seed: int, quick: bool, progress: Progress | None = None
) -> list[dict[str, Any]]:
    """Rows of kind ``"fit"`` per scene and ``"transition"``; none where the data is absent.

    Args:
        models: The preset ``"compact"``, and the w and b shipped with it.
        seed: Of the simulated noise.
        quick: Two transitions of the middle of the static scene.
        progress: Called before every transition.
    """
    root = data_root()
    if root is None or not (root / "boreal_brackets").is_dir():
        return []
    brackets = {scene: load_pairs(root / "boreal_brackets", scene)[0] for scene in SCENES}
    fits = {scene: fitted(pairs) for scene, pairs in brackets.items()}
    rows: list[dict[str, Any]] = []
    for scene, module in fits.items():
        offsets = [round(float(b) * CAMERA.white_level, 2) for b in module.b]
        head = {"part": "brackets", "kind": "fit", "scene": scene}
        rows.append({**head, "w": round(float(module.w), 4), "b_digital_numbers": offsets})
    chosen = [pair for pairs in brackets.values() for pair in pairs]
    if quick:
        static = [p for p in chosen if p.scene == next(iter(SCENES))]
        steps = [p for p in static if (p.source_ms, p.target_ms) in QUICK_STEPS]
        chosen = [_middle(pair) for pair in steps]
    prepared_scenes: dict[tuple[str, int], list[tuple[PreparedScene, float]]] = {}
    for done, pair in enumerate(chosen):
        if progress is not None:
            progress(f"{pair.source_ms} to {pair.target_ms} ms", done / len(chosen))
        other = next(module for scene, module in fits.items() if scene != pair.scene)
        methods, key = _methods(models, other), (pair.scene, pair.source_ms)
        if key not in prepared_scenes:
            prepared_scenes[key] = [_prepared(method.simulator, pair.source) for method in methods]
        rows += transition_rows(pair, methods, prepared_scenes[key], seed)
    return rows


def _middle(pair: Pair) -> Pair:
    def cut(raw: RawImage) -> RawImage:
        top, left = ((n - QUICK_SIZE) // 2 for n in raw.data.shape[1:])
        data = raw.data[:, top : top + QUICK_SIZE, left : left + QUICK_SIZE]
        return RawImage(data.contiguous(), raw.settings, raw.camera)

    return replace(pair, source=cut(pair.source), target=cut(pair.target))


def _prepared(simulator: CameraSimulator, source: RawImage) -> tuple[PreparedScene, float]:
    """What serves every exposure, and the time that it took [ms]."""
    start = time.perf_counter()
    prepared = simulator.prepare(source)
    return prepared, round(1e3 * (time.perf_counter() - start), 1)


def fitted(pairs: Sequence[Pair]) -> ExposureModule:
    """w and b of least squares over a bracket.

    On means of blocks of packed pixels of the registered frames, which take out noise and what is
    left of their shift; blocks that hold a pixel near saturation are left out.
    """
    fit = LinearFit()
    for pair in pairs:
        ratio = exposure_ratio(pair.source.settings, pair.target.settings)
        moved = _shift(pair, (pair.source.data * ratio).clamp(0.0, 1.0))
        border = max(map(abs, moved))
        height, width = (n - 2 * border for n in pair.source.data.shape[1:])
        source = torch.roll(pair.source.data, moved, dims=(1, 2))
        x, y = (
            _blocks(frame.narrow(1, border, height).narrow(2, border, width))
            for frame in (source, pair.target.data)
        )
        fit.add(x, y, torch.tensor([ratio]))
    return fit.solve()


def _shift(pair: Pair, exposed: torch.Tensor) -> tuple[int, int]:
    """Whole pixels by which `exposed` must be rolled to lie on the target."""
    rows, columns = image_shift(pair.target.data.numpy(), exposed.numpy())
    return round(float(rows)), round(float(columns))


def _blocks(data: torch.Tensor) -> torch.Tensor:
    mean, largest = F.avg_pool2d(data[None], BLOCK), F.max_pool2d(data[None], BLOCK)
    return torch.where(largest < UNSATURATED_BELOW, mean, 1.0)  # 1 is left out by the fit


def _methods(models: Models, other: ExposureModule) -> list[_Method]:
    shipped = models.compact_body.exposure
    exposures = dict(zip(CORRECTIONS, (ExposureModule(), shipped, other), strict=True))
    methods = []
    for stage in ("EXP", "NS"):
        for name, exposure in exposures.items():
            simulator = CameraSimulator(device="cpu")
            simulator.exposure = exposure.requires_grad_(False)
            simulator.noise = models.compact.noise if stage == "NS" else None
            methods.append(_Method(stage, name, simulator))
    return methods


def transition_rows(
    pair: Pair,
    methods: Sequence[_Method],
    prepared_scenes: Sequence[tuple[PreparedScene, float]],
    seed: int,
) -> list[dict[str, Any]]:
    """Error of every method before and after the output's noise, registered to whole pixels."""
    target, real = pair.target.settings, pair.target.data.numpy()
    ratio = exposure_ratio(pair.source.settings, target)
    own_noise = variance(real, pair.target.noise)
    limits = {"EXP": own_noise + exposed_variance(pair.source, ratio), "NS": own_noise}
    linear = np.broadcast_to(~pair.masked, real.shape) & (pair.brighter < LINEAR_BELOW)
    # By one method's shift, so that all are compared on the same pixels.
    moved = _shift(pair, prepared_scenes[0][0].expected(target).clamp(0.0, 1.0))
    rows = []
    for method, (prepared, prepare_ms) in zip(methods, prepared_scenes, strict=True):
        clean, ms = timed(lambda x=prepared: x.expected(target).clamp(0.0, 1.0), REPEATS)
        capture, _ = prepared.capture(target, seed)
        before = compare(clean.numpy(), real, pair, moved)
        after = compare(capture.numpy(), real, pair, moved)
        rows.append(
            {
                "part": "brackets",
                "kind": "transition",
                "scene": pair.scene,
                "source_ms": pair.source_ms,
                "target_ms": pair.target_ms,
                "stage": method.stage,
                "correction": method.correction,
                "denoised": prepared.exposure(target).denoised,
                **before,
                "limit_linear_range_db": decibel(float(limits[method.stage][linear].mean())),
                "with_noise": {k: after[k] for k in ("psnr_db", "ssim", "texture_ratio")},
                "prepare_ms": prepare_ms,
                "ms": ms,
                "moved": list(moved),
                "shape": list(real.shape),
            }
        )
    return rows


def section(rows: list[dict[str, Any]]) -> str:
    """The part as Markdown."""
    if not rows:
        return "Left out: it needs `boreal_brackets` in the folder that `AE_ENV_DATA` names.\n"
    fits = [r for r in rows if r["kind"] == "fit"]
    lines = [
        "Transitions between real exposures of an industrial camera (`boreal_brackets`, "
        "linearised, noise estimated blindly), each simulated from the other. Gain and "
        "aperture do not change, so there is nothing to open. PSNR against the real, noisy frame "
        f"where its brighter one is below {LINEAR_BELOW:g}, the range in which the published "
        "response is linear, registered to whole pixels; before the output's noise. Limit: what "
        "noise alone leaves. w and b are none; those shipped, which belong to the body that the "
        "weights were trained on; and those of least squares on the *other* scene of this camera: "
        + "; ".join(_fit_text(fit) for fit in fits)
        + ". NS denoises only where the source is noisier than the target. Texture: mean square of "
        "the finest differences relative to the real frame's, after the output's noise was added; "
        "1 is right, more is noise, less is lost detail.",
    ]
    transitions = [r for r in rows if r["kind"] == "transition"]
    for scene in dict.fromkeys(r["scene"] for r in transitions):
        lines += ["", f"### {scene} ({SCENES[scene]})", "", *_table(transitions, scene)]
    shape = " x ".join(map(str, transitions[0]["shape"]))
    denoised = [r["prepare_ms"] for r in transitions if r["stage"] == "NS"]
    exposed = [r["ms"] for r in transitions]
    lines += [
        "",
        f"Denoising, once per frame: {np.median(denoised):.0f} ms; EXP and NS, per exposure: "
        f"{np.median(exposed):.1f} ms (medians over the transitions, {shape}).",
    ]
    return "\n".join(lines) + "\n"


def _fit_text(fit: dict[str, Any]) -> str:
    offsets = ", ".join(f"{b:+.1f}" for b in fit["b_digital_numbers"])
    return f"`{fit['scene']}` gives w {fit['w']:.3f} and b {offsets} of {CAMERA.white_level:g}"


def _table(transitions: list[dict[str, Any]], scene: str) -> list[str]:
    heads = [f"{stage}, {c}" for stage in ("EXP", "NS") for c in CORRECTIONS]
    lines = [
        f"| ms | {' | '.join(heads)} | limit EXP | limit NS | SSIM EXP, NS | "
        "texture with noise, EXP, NS |",
        f"|---|{'--:|' * (len(heads) + 4)}",
    ]
    own = [r for r in transitions if r["scene"] == scene]
    for step in dict.fromkeys((r["source_ms"], r["target_ms"]) for r in own):
        group = [r for r in own if (r["source_ms"], r["target_ms"]) == step]
        plain = [next(r for r in group if r["stage"] == stage) for stage in ("EXP", "NS")]
        cells = [f"{r['psnr_linear_range_db']:.2f}" for r in group]
        cells += [f"{r['limit_linear_range_db']:.1f}" for r in plain]
        cells.append(", ".join(f"{r['ssim']:.3f}" for r in plain))
        cells.append(", ".join(f"{r['with_noise']['texture_ratio']:.2f}" for r in plain))
        lines.append(f"| {step[0]} to {step[1]} | {' | '.join(cells)} |")
    return lines
