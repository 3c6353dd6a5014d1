"""Crops of pictures at every stage: input, EXP, NS, Full and the ground truth, side by side.

The three situations that the paper shows: low light, high light, and a close shot out of focus.
"""

import math
from dataclasses import replace
from typing import Any

from torch import Tensor

from agents.report.plots import write_figure
from benchmarks.fidelity.models import equal_exposure, load_models
from benchmarks.harness import Row, clipped, psnr, side_by_side, table
from benchmarks.isolated import ROOT
from simulator import CameraSettings, RawImage, get_camera, render_srgb
from simulator.reference.reference_camera import ReferenceCamera, ReferenceScene
from simulator.training.scenes import depth_photographs, reference_scenes
from simulator.utils.files import data_folder

#: The published picture; a quick run leaves it alone.
IMAGE = ROOT / "docs" / "images" / "simulator_stages.webp"
#: Height and width of the crops [packed pixel].
CROP = 72
#: By situation: scenes that can show it, of which the first that is there is taken, with the middle
#: of the crop as a share of height and width; then ISO, f-number and exposure relative to incident
#: light [EV] of input and target. Times are rounded to whole stops.
CASES: dict[str, tuple[dict[str, tuple[float, float]], Any, Any]] = {
    "low light": ({"Desk": (0.75, 0.45), "chelsea": (0.4, 0.5)}, (6400, 4, -1.5), (800, 4, 1.5)),
    "high light": ({"warehouse-090": (0.35, 0.7), "grass": (0.5, 0.5)}, (1600, 8, -2), (100, 4, 0)),
    "close shot": ({"motorcycle-front": (0.25, 0.72)}, (800, 11, 0.0), (100, 4, 0.0)),
}


def measure(seed: int, quick: bool) -> list[Row]:
    camera = get_camera("nikon_z6")
    found = list(reference_scenes("test", camera, number=0, data=data_folder()))
    scenes = {s.scene_id: s for s in (*found, *depth_photographs(camera, data=None))}
    rows, lines = [], []
    for case, (crops, source, target) in CASES.items():
        name = next(name for name in crops if name in scenes)
        row, pictures = _photographed(scenes[name], source, target, seed)
        rows.append({"part": "pictures", "case": case, **row})
        lines.append(_titled(rows[-1], pictures, crops[name]))
    if not quick:
        write_figure(IMAGE, side_by_side(*lines))
    return rows


def _photographed(
    scene: ReferenceScene, source_at: Any, target_at: Any, seed: int
) -> tuple[Row, dict[str, Tensor]]:
    """Settings and PSNR, and the developed pictures (3, H, W) by stage."""
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
    shown = {"input": source.data, **before, "Full": stages.capture, "ground truth": wanted.sample}
    # A pixel a packed pixel.
    render = {k: render_srgb(replace(source, data=v), demosaic="half") for k, v in shown.items()}
    return row, render


def _titled(
    row: Row, pictures: dict[str, Tensor], middle: tuple[float, float]
) -> dict[str, Tensor]:
    """The crop around `middle` at every stage, by what it shows."""
    top, left = (
        min(max(round(share * n - CROP / 2), 0), n - CROP)
        for share, n in zip(middle, pictures["input"].shape[1:], strict=True)
    )
    notes = {"input": row["source"], "ground truth": row["target"]}
    notes |= {name: f"{value:.1f} dB" for name, value in row["psnr_db"].items()}
    return {
        f"{name}, {notes[name]}": picture[:, top : top + CROP, left : left + CROP]
        for name, picture in pictures.items()
    }


def tables(rows: list[Row]) -> dict[str, str]:
    columns = """situation = {case} | scene = {scene} | light [lux] = {illuminance:g} |
    input = {source} | simulated = {target} | EXP = {psnr_db[EXP]:.2f} | NS = {psnr_db[NS]:.2f} |
    Full = {psnr_db[Full]:.2f}"""
    return {"pictures": table(rows, columns)}
