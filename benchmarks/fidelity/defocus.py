"""Opening the aperture from f/11 to f/4: error by size of the circle of confusion.

The source is a noisy capture at f/11, the truth the noise-free mean at f/4 and the same exposure,
with the reference camera's occlusion-aware defocus. Errors are pooled over the pixels of a class in
held-out procedural scenes, and in each of the photographs with measured depth.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
import torch
from scipy.ndimage import maximum_filter
from torch import Tensor

from benchmarks.fidelity.models import equal_exposure, load_models
from benchmarks.harness import Row, clipped, data_root, pivot, sections
from simulator import CameraSimulator, RawImage, get_camera
from simulator.networks.exposure_module import OVER_EXPOSED
from simulator.networks.noise_module import smoothed, variance_map
from simulator.optics.discs import DiscBank, added_blur
from simulator.reference.reference_camera import ReferenceCamera, ReferenceScene
from simulator.training.scenes import depth_photographs, reference_scenes

#: Procedural groups, of which three quarters have depth, and their height and width [pixel].
FULL, QUICK = (32, 256), (8, 128)
F_SOURCE, F_TARGET = 11.0, 4.0
ISOS = (100, 1600)
#: Pixels this close to the frame, or to one at white in source or target, are left out.
BORDER, CLIP_MARGIN = 11, 7
#: Circles of confusion by class [pixel], and the largest error of Full relative to EXP asked for.
CLASSES: dict[str, tuple[float, float, float]] = {
    "3 px and more": (3.0, np.inf, 0.5),
    "1.5 to 3 px": (1.5, 3.0, 0.7),
    "1.5 px and more": (1.5, np.inf, 0.6),
    "0.75 to 1.5 px": (0.75, 1.5, 1.05),
    "below 0.75 px": (0.0, 0.75, 1.05),
    "below 1.5 px": (0.0, 1.5, 1.05),
}
#: Scenes with fewer pixels of a class do not count by scene.
FEWEST_PIXELS = 500
_CONTENTS = """Full = {relative_to_exp[full]:.2f} | met = {met} |
median scene = {median_scene:.2f} | NS = {relative_to_exp[ns]:.2f} |
true depth = {relative_to_exp[true_depth]:.2f} | paper = {relative_to_exp[paper]:.2f}"""


@torch.no_grad()
def measure(seed: int, quick: bool) -> list[Row]:
    camera, (groups, size) = get_camera("nikon_z6"), QUICK if quick else FULL
    scenes = reference_scenes("test", camera, number=groups, size=size)
    scenes = [scene for scene in scenes if scene.kind == "depth"]
    photographs = depth_photographs(camera, data=data_root())
    chosen = [*scenes[::4], *photographs[::2]] if quick else [*scenes, *photographs]
    frame = pd.DataFrame([row for scene in chosen for row in _errors(scene, seed)])
    rows = []
    for (name, iso), own in frame.groupby(["set", "iso"], sort=False):
        totals = own.groupby("pixels", sort=False).sum(numeric_only=True)
        clear = totals["count"]["1.5 px and more"] + totals["count"]["below 1.5 px"]
        for pixels, total in totals[totals["count"] > 0].iterrows():
            asked, exp = CLASSES[str(pixels)][2], total["exp"]
            relative = ((total[own.columns[4:]] / exp) ** 0.5).to_dict()
            row: Row = {"part": "defocus", "set": name, "iso": int(str(iso)), "pixels": pixels}
            row |= {"count": int(total["count"]), "area": total["count"] / clear}
            row |= {"rmse_exp": (exp / (4 * total["count"])) ** 0.5, "relative_to_exp": relative}
            by_scene = own[(own["pixels"] == pixels) & (own["count"] >= FEWEST_PIXELS)]
            row["median_scene"] = (by_scene["full"] / by_scene["exp"]).pow(0.5).median()
            rows.append(row | {"asked": asked, "met": bool(relative["full"] <= asked)})
    return rows


def _errors(scene: ReferenceScene, seed: int) -> Iterator[Row]:
    camera = ReferenceCamera(get_camera("nikon_z6"))
    light = {n: camera.blurred_light(scene, n) for n in (F_SOURCE, F_TARGET)}
    to_open = equal_exposure(scene.reference, ISOS[0], F_TARGET)
    target = camera.capture(scene, to_open, seed, light=light[F_TARGET]).mean
    diameter = camera.blur_diameter(scene, F_SOURCE)
    classes: dict[str, Tensor] = {}
    for iso in ISOS:
        settings = equal_exposure(scene.reference, iso, F_SOURCE)
        capture = camera.capture(scene, settings, seed, light=light[F_SOURCE])
        if not classes:
            white = torch.maximum(capture.mean, target).amax(dim=0) >= OVER_EXPOSED
            classes = _pixel_classes(diameter, white)
        source = RawImage(capture.sample, settings, camera.camera)
        images = _opened(source, diameter)
        errors = {
            name: (clipped(image, source.camera) - target).double().square().sum(dim=0)
            for name, image in images.items()
        }
        drawn = scene.kind == "depth"
        row: Row = {"set": "held-out procedural scenes" if drawn else f"photograph: {scene.group}"}
        for name, mask in classes.items():
            row |= {"iso": iso, "pixels": name, "count": int(mask.sum())}
            yield row | {variant: float(error[mask].sum()) for variant, error in errors.items()}


def _pixel_classes(diameter: Tensor, white: Tensor) -> dict[str, Tensor]:
    """The pixels (H, W) of each of `CLASSES`, away from white (H, W) ones and from the frame."""
    clear = torch.zeros_like(white)
    inside = (slice(BORDER, -BORDER), slice(BORDER, -BORDER))
    near_white = torch.from_numpy(maximum_filter(white.numpy(), 2 * CLIP_MARGIN + 1))
    clear[inside] = ~near_white[inside]
    return {
        name: clear & (diameter >= low) & (diameter < high)
        for name, (low, high, _) in CLASSES.items()
    }


def _opened(source: RawImage, true_diameter: Tensor) -> dict[str, Tensor]:
    simulators, f_source = load_models().simulators, source.settings.effective_f_number
    clean, deviation = _denoised(simulators["compact"], source)
    # As the module does, its bank shared with the same blur of the true diameters.
    aperture: Any = simulators["compact"].aperture
    bank, diameter = DiscBank(clean[0]), aperture.defocus(clean, deviation)[0]
    images = {"exp": source.data, "ns": clean[0]}
    images["full"] = bank.blurred(added_blur(diameter, f_source, F_TARGET))
    images["true_depth"] = bank.blurred(added_blur(true_diameter, f_source, F_TARGET))
    if "paper" in simulators:
        clean, deviation = _denoised(simulators["paper"], source)
        network: Any = simulators["paper"].aperture
        images["paper"] = network(clean, deviation, *torch.tensor([[f_source], [F_TARGET]]))[0]
    return images


def _denoised(simulator: CameraSimulator, source: RawImage) -> tuple[Tensor, Tensor]:
    """(1, 4, H, W) the source with little noise, and the deviation of what was removed."""
    assert simulator.noise is not None
    exposed = source.data[None]
    if simulator.noise.preset == "paper":
        exposed = exposed.clamp(0.0, 1.0)
    shot, read = (torch.tensor([v]) for v in (source.noise.shot, source.noise.read))
    deviation = variance_map(smoothed(exposed), shot, read).sqrt()
    return simulator.noise(exposed, shot, read), deviation


def tables(rows: list[Row]) -> dict[str, str]:
    line = "circle of confusion (area; asked) = {pixels} ({area:.1%}; {asked:g})"
    by_set = sections(rows, "{set}", lambda own: pivot(own, line, "ISO {iso}", _CONTENTS))
    return {"defocus": by_set}
