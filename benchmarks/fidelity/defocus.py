"""Opening the aperture: error by size of the circle of confusion; pictures in focus.

The source is a noisy capture at f/11, the truth the noise-free mean at f/4 and the same exposure,
with the reference camera's occlusion-aware defocus.

Pictures that are in focus throughout may not change where their depth is not told: photographed at
f/8 and opened to f/4. The change is that of the noise-free light against the same with
``depth="far"``, root mean square in units of the source's noise.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
import torch
from scipy.ndimage import maximum_filter
from torch import Tensor

from benchmarks.fidelity.models import equal_exposure, load_models
from benchmarks.harness import Row, clipped, cropped, pivot, sections, table
from simulator import CameraSimulator, RawImage, get_camera
from simulator.networks.exposure_module import OVER_EXPOSED
from simulator.networks.noise_module import smoothed, variance_map
from simulator.noise.noise_level_function import noise_variance
from simulator.optics.discs import DiscBank, added_blur
from simulator.reference.reference_camera import ReferenceCamera, ReferenceScene
from simulator.training.scenes import depth_photographs, mosaic_scenes, reference_scenes
from simulator.utils.files import data_folder

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
    photographs = depth_photographs(camera, data=data_folder())
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


# -- pictures in focus ----------------------------------------------------------------------------

#: Height and width of a picture in focus [packed pixel], at most.
SIZE = 160
#: Change that was asked for, and the share of the pictures that shall stay below it.
ASKED, ASKED_SHARE = 0.1, 0.95
#: Its letters are blurred over five pixels.
_OUT_OF_FOCUS = "CRW_0118"
_SHARE = f"""pictures = {{pictures}} | change by less than {ASKED:g} of the noise = {{small:.1%}} |
asked = {{asked:.0%}}"""


def measure_in_focus(seed: int, quick: bool) -> list[Row]:
    simulator = CameraSimulator.from_pretrained(device="cpu", cache=None)
    camera, data, rows = get_camera("nikon_z6"), data_folder(), []
    scenes = list(reference_scenes("test", camera, number=0, data=data))
    if data is not None:
        scenes += mosaic_scenes("test", data)
    sharp = (scene for scene in scenes if scene.depth is None and scene.in_focus)
    chosen = [scene for scene in sharp if scene.scene_id != _OUT_OF_FOCUS]
    for number, scene in enumerate(chosen[:: 8 if quick else 1]):
        scene = cropped(scene, SIZE, SIZE)
        source, target = (equal_exposure(scene.reference, ISOS[0], f) for f in (8.0, F_TARGET))
        sample = ReferenceCamera(camera).capture(scene, source, seed + number).sample
        raw = RawImage(sample, source, camera)
        unknown = simulator.prepare(raw, depth="unknown").expected(target)
        far = simulator.prepare(raw, depth="far").expected(target)
        variance = noise_variance(far.clamp(min=0.0), raw.noise)
        change = float(((unknown - far).square() / variance).double().mean().sqrt())
        row: Row = {"part": "in focus", "picture": scene.scene_id, "kind": scene.kind}
        rows.append(row | {"change": change})
    return rows


def tables(rows: list[Row]) -> dict[str, str]:
    line = "circle of confusion (area; asked) = {pixels} ({area:.1%}; {asked:g})"
    opened, sharp = ([r for r in rows if r["part"] == part] for part in ("defocus", "in focus"))
    small = np.mean([row["change"] < ASKED for row in sharp])
    share = {"pictures": len(sharp), "small": small, "asked": ASKED_SHARE}
    return {
        "defocus": sections(opened, "{set}", lambda own: pivot(own, line, "ISO {iso}", _CONTENTS)),
        "in-focus": table([share], _SHARE),
    }
