"""Pictures of every stage: input, EXP, NS, Full and the ground truth, side by side.

The three situations that the paper shows: low light, high light, and a close shot out of focus.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from benchmarks.fidelity.models import equal_exposure, load_models
from benchmarks.harness import RUNS, Row, clipped, data_root, psnr, table, write_picture
from benchmarks.isolated import ROOT
from simulator import CameraSettings, RawImage, get_camera, render_srgb
from simulator.reference.reference_camera import ReferenceCamera, ReferenceScene
from simulator.training.scenes import depth_photographs, reference_scenes

#: The published picture; a quick run leaves it alone.
IMAGE = ROOT / "docs" / "images" / "simulator_stages.webp"
QUICK_IMAGE = RUNS / "simulator" / "simulator_stages.webp"
#: Height and width of the crops [packed pixel].
CROP = 72
COLUMNS = ("whole picture", "input", "EXP", "NS", "Full", "ground truth")
#: By situation: scenes that can show it, of which the first that is there is taken, with the middle
#: of the crop as a share of height and width; then ISO, f-number and exposure relative to incident
#: light [EV] of input and target. Times are rounded to whole stops.
CASES: dict[str, tuple[dict[str, tuple[float, float]], Any, Any]] = {
    "low light": (
        {"Desk": (0.75, 0.45), "chelsea": (0.4, 0.5)},
        (6400, 4, -1.5),
        (800, 4, 1.5),
    ),
    "high light": (
        {"warehouse-090": (0.35, 0.7), "grass": (0.5, 0.5)},
        (1600, 8, -2.0),
        (100, 4, 0.0),
    ),
    "close shot": ({"motorcycle-front": (0.25, 0.72)}, (800, 11, 0.0), (100, 4, 0.0)),
}


def measure(seed: int, quick: bool) -> list[Row]:
    camera = get_camera("nikon_z6")
    found = list(reference_scenes("test", camera, number=0, data=data_root()))
    scenes = {s.scene_id: s for s in (*found, *depth_photographs(camera, data=None))}
    figure = Figure(figsize=(13.0, 2.5 * len(CASES)), dpi=80, layout="constrained")
    axes, rows = figure.subplots(len(CASES), len(COLUMNS), squeeze=False), []
    for line, (case, (crops, source, target)) in zip(axes, CASES.items(), strict=True):
        name = next(name for name in crops if name in scenes)
        row, pictures = _photographed(scenes[name], source, target, seed)
        rows.append({"part": "pictures", "case": case, **row})
        _draw(line, rows[-1], pictures, crops[name])
    write_picture(QUICK_IMAGE if quick else IMAGE, figure)
    return rows


def _photographed(
    scene: ReferenceScene, source_at: Any, target_at: Any, seed: int
) -> tuple[Row, list[np.ndarray]]:
    """Settings and PSNR, and the developed pictures (H, W, 3) in the order of `COLUMNS`."""
    profile, settings = get_camera("nikon_z6"), []
    camera = ReferenceCamera(profile)
    for iso, f_number, ev in (source_at, target_at):
        right = equal_exposure(scene.reference, iso, f_number).exposure_time
        settings.append(CameraSettings(iso, 2.0 ** round(math.log2(right) + ev), f_number))
    taken, wanted = (camera.capture(scene, s, seed + i) for i, s in enumerate(settings))
    source = RawImage(taken.sample, settings[0], profile, white_balance=scene.white_balance)
    stages = load_models().simulators["compact"].stages(source, settings[1], seed=seed + 2)
    before = {"EXP": stages.exposed, "NS": stages.denoised, "Full": stages.opened}
    row: Row = {"scene": scene.scene_id, "illuminance": scene.illuminance}
    row |= {"source": str(settings[0]), "target": str(settings[1])}
    row["psnr_db"] = {k: psnr(clipped(v, profile), wanted.mean) for k, v in before.items()}
    shown = (wanted.sample, source.data, stages.exposed, stages.denoised, stages.capture)
    pictures = [  # a pixel a packed pixel
        render_srgb(replace(source, data=data), demosaic="half").permute(1, 2, 0).numpy()
        for data in (*shown, wanted.sample)
    ]
    return row, pictures


def _draw(axes: Any, row: Row, pictures: list[np.ndarray], middle: tuple[float, float]) -> None:
    """One line: the whole picture with a frame, then the crop at every stage."""
    top, left = (
        min(max(round(share * n - CROP / 2), 0), n - CROP)
        for share, n in zip(middle, pictures[0].shape[:2], strict=True)
    )
    crops = [picture[top : top + CROP, left : left + CROP] for picture in pictures[1:]]
    for axis, picture, title in zip(axes, [pictures[0], *crops], COLUMNS, strict=True):
        axis.imshow(picture, interpolation="nearest")
        axis.set(xticks=[], yticks=[])
        value = row["psnr_db"].get(title)
        axis.set_title(title if value is None else f"{title}, {value:.1f} dB", fontsize=10)
    axes[0].add_patch(Rectangle((left, top), CROP, CROP, fill=False, color="red", lw=1.5))
    axes[0].set_ylabel(row["case"], fontsize=11)
    axes[1].set_xlabel(row["source"], fontsize=8)
    axes[-1].set_xlabel(row["target"], fontsize=8)


def tables(rows: list[Row]) -> dict[str, str]:
    columns = """situation = {case} | scene = {scene} | light [lux] = {illuminance:g} |
    input = {source} | simulated = {target} | EXP = {psnr_db[EXP]:.2f} | NS = {psnr_db[NS]:.2f} |
    Full = {psnr_db[Full]:.2f}"""
    return {"pictures": table(rows, columns)}
