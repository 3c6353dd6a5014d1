"""Exposure module: learnt w and b against the closed form, and against w = 1, b = 0."""

from __future__ import annotations

from typing import Any

import torch

from ae_env.scenes.reference_scenes import reference_scenes
from benchmarks.simulator.models import Models
from simulator.camera import get_camera
from simulator.networks.exposure_module import OVER_EXPOSED, ExposureModule, LinearFit
from simulator.reference.reference_camera import BodyError, ReferenceCamera
from simulator.training.data import Batch, ReferencePairs, draw_sequences

#: The body that the shipped weights were trained on.
_CAMERA, _BODY = "nikon_z6", 1
_CROP, _BATCH = 96, 16


def measure(models: Models, *, seed: int, quick: bool, progress: Any = None) -> list[dict]:
    """L1 error on pairs of test scenes, of the same body and of another one.

    The closed form is fitted on training scenes, as w and b were learnt.
    """
    number, steps = (4, 1) if quick else (32, 8)
    fit = LinearFit()
    for batch in _batches("train", _BODY, number, steps, seed):
        fit.add(batch.source, batch.sample, batch.ratio)
    modules = {
        "w = 1, b = 0": ExposureModule(),
        "learnt by L1": models.compact_body.exposure,
        "closed form": fit.solve(),
    }
    rows = []
    for body in (_BODY, _BODY + 1):
        batches = list(_batches("test", body, number, steps, seed))
        for name, module in modules.items():
            rows.append(
                {
                    "part": "exposure",
                    "method": name,
                    "body": "trained" if body == _BODY else "another",
                    "w": round(float(module.w.detach()), 5),
                    "b_digital_numbers": _digital_numbers(module.b),
                    "l1": _error(module, batches),
                }
            )
    truth = BodyError.draw(get_camera(_CAMERA), _BODY)
    rows.append(
        {
            "part": "exposure",
            "method": "truth",
            "body": "trained",
            "b_digital_numbers": _digital_numbers(-torch.tensor(truth.black_offset)),
            "shutter_delay_us": round(1e6 * truth.shutter_delay, 1),
        }
    )
    return rows


def section(rows: list[dict]) -> str:
    """The table of the report."""
    own = [row for row in rows if row["part"] == "exposure"]
    lines = [
        "| body | w, b | w | b [digital numbers: R, G1, G2, B] | L1 x 1000 |",
        "|---|---|--:|---|--:|",
    ]
    for row in own:
        if row["method"] != "truth":
            offsets = ", ".join(f"{b:+.2f}" for b in row["b_digital_numbers"])
            cells = (row["body"], row["method"], f"{row['w']:.4f}", offsets)
            lines.append(f"| {' | '.join(cells)} | {1e3 * row['l1']:.3f} |")
    truth = next(row for row in own if row["method"] == "truth")
    offsets = ", ".join(f"{b:+.2f}" for b in truth["b_digital_numbers"])
    return "\n".join(
        [
            "Pixels above 0.99 of the source are left out, as in training. A pair and its reverse "
            "ask for w and 1 / w, so w has little to learn; b is the recorded black level's error, "
            f"which this body has at {offsets} with the sign reversed (its shutter is "
            f"{truth['shutter_delay_us']:+.1f} us late).",
            "",
            *lines,
        ]
    )


def _batches(split: Any, body: int, number: int, steps: int, seed: int) -> Any:
    camera = get_camera(_CAMERA)
    scenes = reference_scenes(split, camera, number=number, size=256)
    sequences = draw_sequences(scenes, camera, seed)
    reference = ReferenceCamera(camera, body=BodyError.draw(camera, body))
    pairs = ReferencePairs(sequences, reference, "exposure", seed=seed)
    return (pairs.batch(step, _BATCH, _CROP) for step in range(steps))


def _digital_numbers(offset: torch.Tensor) -> list[float]:
    span = torch.tensor(get_camera(_CAMERA).span)
    return [round(float(v), 3) for v in offset.detach().cpu() * span]


def _error(module: ExposureModule, batches: list[Batch]) -> float:
    total, count = 0.0, 0
    with torch.no_grad():
        for batch in batches:
            used = batch.source <= OVER_EXPOSED
            exposed = module(batch.source, batch.ratio).clamp(0.0, 1.0)
            total += float(((exposed - batch.sample).abs() * used).sum(dtype=torch.float64))
            count += int(used.sum())
    return total / count
