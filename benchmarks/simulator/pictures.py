"""Pictures of every stage: input, EXP, NS, Full and the ground truth, side by side.

The three situations that the paper shows: low light, high light, and a close shot out of focus.
"""

from __future__ import annotations

import io
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ae_env.scenes.reference_scenes import depth_photographs, reference_scenes
from benchmarks.simulator.depth_views import equal_exposure
from benchmarks.simulator.scenes import Progress, clipped, data_root, psnr
from simulator import CameraSettings, RawImage, get_camera, render_srgb
from simulator.reference.reference_camera import ReferenceCamera, ReferenceScene
from simulator.utils.files import write_atomically

if TYPE_CHECKING:
    from benchmarks.simulator.models import Models

CAMERA = "nikon_z6"
IMAGE = Path("docs/images/simulator_stages.png")
#: The quick run leaves the published picture alone.
QUICK_IMAGE = Path("runs/simulator/simulator_stages.png")
#: Height and width of the crops [packed pixel].
CROP = 72
COLUMNS = ("whole picture", "input", "EXP", "NS", "Full", "ground truth")


@dataclass(frozen=True)
class Case:
    """One row of the figure.

    Args:
        name: What it shows.
        crops: Scenes that can show it, the first that is there is taken, and the middle of the
            crop as a share of height and width.
        source: ISO, f-number and exposure of the input relative to incident light [EV]; its time
            is rounded to a whole stop.
        target: The same of what is simulated.
    """

    name: str
    crops: dict[str, tuple[float, float]]
    source: tuple[float, float, float]
    target: tuple[float, float, float]


CASES = (
    Case(
        "low light", {"Desk": (0.75, 0.45), "chelsea-0": (0.4, 0.5)}, (6400, 4, -1.5), (800, 4, 1.5)
    ),
    Case(
        "high light",
        {"warehouse-090": (0.35, 0.7), "grass-0": (0.5, 0.5)},
        (1600, 8, -2.0),
        (100, 4, 0.0),
    ),
    Case("close shot", {"motorcycle-front": (0.25, 0.72)}, (800, 11, 0.0), (100, 4, 0.0)),
)


def measure(
    models: Models, *, seed: int, quick: bool, progress: Progress | None = None
) -> list[dict[str, Any]]:
    """Draws the figure; one row per situation with its settings and PSNR.

    Args:
        models: Of which the preset ``"compact"`` is shown.
        seed: Of all noise.
        quick: Writes `QUICK_IMAGE` in place of `IMAGE`.
        progress: Called before every situation.
    """
    profile, folder = get_camera(CAMERA), data_root()
    scenes = [
        *reference_scenes("test", profile, number=0, radiance=folder),
        *depth_photographs(profile, data=None),
    ]
    by_name = {scene.scene_id: scene for scene in scenes}
    path = QUICK_IMAGE if quick else IMAGE
    rows, strips = [], []
    for done, case in enumerate(CASES):
        if progress is not None:
            progress(case.name, done / len(CASES))
        name = next(name for name in case.crops if name in by_name)
        row, pictures = _photographed(case, by_name[name], models, seed)
        rows.append({"part": "pictures", "image": str(path), **row})
        strips.append((row, pictures))
    _draw(strips, path)
    return rows


def _photographed(
    case: Case, scene: ReferenceScene, models: Models, seed: int
) -> tuple[dict[str, Any], list[np.ndarray]]:
    """The row of results, and the developed pictures (H, W, 3) in the order of `COLUMNS`."""
    profile = get_camera(CAMERA)
    camera = ReferenceCamera(profile)
    settings = [_settings(scene, *wanted) for wanted in (case.source, case.target)]
    captures = [camera.capture(scene, s, seed + i) for i, s in enumerate(settings)]
    source = RawImage(captures[0].sample, settings[0], profile, white_balance=scene.white_balance)
    stages = models.compact.stages(source, settings[1], seed=seed + 2)
    truth = captures[1].mean
    before = {"EXP": stages.exposed, "NS": stages.denoised, "Full": stages.opened}
    row = {
        "case": case.name,
        "scene": scene.scene_id,
        "illuminance": scene.illuminance,
        "source": str(settings[0]),
        "target": str(settings[1]),
        "psnr_db": {k: round(psnr(clipped(v, profile), truth), 2) for k, v in before.items()},
        "middle": list(case.crops[scene.scene_id]),
    }
    sample = captures[1].sample
    shown = (sample, source.data, stages.exposed, stages.denoised, stages.capture, sample)
    return row, [_developed(data, source) for data in shown]


def _settings(scene: ReferenceScene, iso: float, f_number: float, ev: float) -> CameraSettings:
    right = equal_exposure(scene.reference, iso, f_number).exposure_time
    return CameraSettings(iso, 2.0 ** round(math.log2(right) + ev), f_number)


def _developed(data: torch.Tensor, like: RawImage) -> np.ndarray:
    raw = RawImage(data, like.settings, like.camera, white_balance=like.white_balance)
    # Light that lies at one place for all four planes: interpolation would colour its edges.
    return render_srgb(raw, demosaic="half").permute(1, 2, 0).numpy()


def _draw(strips: list[tuple[dict[str, Any], list[np.ndarray]]], path: Path) -> None:
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    figure = Figure(figsize=(13.0, 2.5 * len(strips)), dpi=110, layout="constrained")
    axes = figure.subplots(len(strips), len(COLUMNS), squeeze=False)
    for line, (row, pictures) in zip(axes, strips, strict=True):
        height, width = pictures[0].shape[:2]
        top, left = (
            min(max(round(share * n - CROP / 2), 0), n - CROP)
            for share, n in zip(row["middle"], (height, width), strict=True)
        )
        for number, (axis, picture, title) in enumerate(zip(line, pictures, COLUMNS, strict=True)):
            axis.set_xticks([])
            axis.set_yticks([])
            if number == 0:
                axis.set_title(title, fontsize=10)
                axis.imshow(picture)
                axis.add_patch(Rectangle((left, top), CROP, CROP, fill=False, color="red", lw=1.5))
                axis.set_ylabel(row["case"], fontsize=11)
                continue
            axis.imshow(picture[top : top + CROP, left : left + CROP], interpolation="nearest")
            psnr_db = row["psnr_db"].get(title)
            axis.set_title(title if psnr_db is None else f"{title}, {psnr_db:.1f} dB", fontsize=10)
            if title == "input":
                axis.set_xlabel(row["source"], fontsize=8)
            elif number == len(COLUMNS) - 1:
                axis.set_xlabel(row["target"], fontsize=8)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, buffer.getvalue())


def section(rows: list[dict[str, Any]]) -> str:
    """The part as Markdown, beside the results."""
    link = os.path.relpath(rows[0]["image"], "docs/results") if rows else ""
    lines = [
        f"![Input, EXP, NS, Full and ground truth]({link})",
        "",
        f"Crops of {CROP} x {CROP} packed pixels, developed alike and not corrected for exposure; "
        "Full with the target's noise, the ground truth a noisy capture. PSNR of the whole picture "
        "before output noise, against the noise-free mean.",
        "",
        "| situation | scene | light [lux] | input | simulated | EXP | NS | Full |",
        "|---|---|--:|---|---|--:|--:|--:|",
    ]
    for row in rows:
        cells = [row["case"], row["scene"], f"{row['illuminance']:g}", row["source"], row["target"]]
        cells += [f"{row['psnr_db'][stage]:.2f}" for stage in ("EXP", "NS", "Full")]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"
