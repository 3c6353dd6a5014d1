"""Opening the aperture from f/11 to f/4: error by size of the circle of confusion.

The source is a noisy capture at f/11, the truth the noise-free mean at f/4 and the same exposure,
with the reference camera's occlusion-aware defocus. Errors are pooled over the pixels of a class in
held-out procedural scenes, and in each of the photographs with measured depth.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from scipy.ndimage import maximum_filter
from torch import Tensor

from benchmarks.fidelity.models import load_models
from benchmarks.harness import Row, clipped, data_root, pivot, sections
from simulator import CameraSettings, CameraSimulator, RawImage, get_camera
from simulator.networks.exposure_module import OVER_EXPOSED
from simulator.networks.noise_module import smoothed, variance_map
from simulator.optics.discs import DiscBank, added_blur
from simulator.reference.camera import ReferenceCamera, ReferenceScene
from simulator.training.scenes import depth_photographs, reference_scenes

CAMERA = "nikon_z6"
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


@dataclass(frozen=True, eq=False)
class View:
    """A scene at f/11 as it was captured, and at f/4.

    Args:
        name: Of its set.
        sources: Noisy captures at f/11, by ISO.
        target: (4, H, W) noise-free mean at f/4 and the same exposure, clipped.
        diameter: (H, W) true circle of confusion at f/11 [pixel].
        classes: Those of `CLASSES` as (H, W) bool.
    """

    name: str
    sources: dict[int, RawImage]
    target: Tensor
    diameter: Tensor
    classes: dict[str, Tensor]


@torch.no_grad()
def measure(seed: int, quick: bool) -> list[Row]:
    """One row per set of scenes, ISO and class."""
    camera, (groups, size) = get_camera(CAMERA), QUICK if quick else FULL
    scenes = reference_scenes("test", camera, number=groups, size=size)
    scenes = [scene for scene in scenes if scene.kind == "depth"]
    photographs = depth_photographs(camera, data=data_root())
    chosen = [*scenes[::4], *photographs[::2]] if quick else [*scenes, *photographs]
    simulators = load_models().simulators
    pools: dict[tuple[str, int], _Pool] = {}
    for scene in chosen:
        view = _view(scene, ReferenceCamera(camera), seed)
        for iso, source in view.sources.items():
            pools.setdefault((view.name, iso), _Pool()).add(view, source, simulators)
    rows = []
    for (name, iso), pool in pools.items():
        head = {"part": "defocus", "set": name, "iso": iso}
        rows += [head | row for row in pool.rows()]
    return rows


# -- views ----------------------------------------------------------------------------------------


def _view(scene: ReferenceScene, camera: ReferenceCamera, seed: int) -> View:
    """Photographs `scene`, exposed for its incident light as its reference settings are."""
    light = {n: camera.blurred_light(scene, n) for n in (F_SOURCE, F_TARGET)}
    captures = {
        iso: camera.capture(
            scene, equal_exposure(scene.reference, iso, F_SOURCE), seed, light=light[F_SOURCE]
        )
        for iso in ISOS
    }
    settings = equal_exposure(scene.reference, ISOS[0], F_TARGET)
    target = camera.capture(scene, settings, seed, light=light[F_TARGET]).mean
    diameter = camera.blur_diameter(scene, F_SOURCE)
    white = torch.maximum(captures[ISOS[0]].mean, target).amax(dim=0) >= OVER_EXPOSED
    return View(
        name="held-out procedural scenes"
        if scene.kind == "depth"
        else f"photograph: {scene.group}",
        sources={iso: RawImage(c.sample, c.settings, camera.camera) for iso, c in captures.items()},
        target=target,
        diameter=diameter,
        classes=_pixel_classes(diameter, white),
    )


def equal_exposure(reference: CameraSettings, iso: float, f_number: float) -> CameraSettings:
    """The exposure of `reference` at another ISO and f-number."""
    unit = CameraSettings(iso, 1.0, f_number)
    return CameraSettings(iso, 2.0 ** (reference.log2_exposure - unit.log2_exposure), f_number)


def _pixel_classes(diameter: Tensor, white: Tensor) -> dict[str, Tensor]:
    """The pixels (H, W) of each of `CLASSES`, away from white (H, W) ones and from the frame."""
    clear = ~torch.from_numpy(maximum_filter(white.numpy(), 2 * CLIP_MARGIN + 1))
    for axis in (0, 1):
        clear.narrow(axis, 0, BORDER).fill_(False)
        clear.narrow(axis, clear.shape[axis] - BORDER, BORDER).fill_(False)
    return {
        name: clear & (diameter >= low) & (diameter < high)
        for name, (low, high, _) in CLASSES.items()
    }


# -- errors ---------------------------------------------------------------------------------------


def _denoised(simulator: CameraSimulator, source: RawImage) -> tuple[Tensor, Tensor]:
    """(1, 4, H, W) the source with little noise, and the deviation of what was removed."""
    assert simulator.noise is not None
    exposed = source.data[None]
    if simulator.noise.preset == "paper":
        exposed = exposed.clamp(0.0, 1.0)
    shot, read = (torch.tensor([v]) for v in (source.noise.shot, source.noise.read))
    deviation = variance_map(smoothed(exposed), shot, read).sqrt()
    return simulator.noise(exposed, shot, read), deviation


@dataclass
class _Pool:
    """Sums over one set of scenes at one ISO."""

    pixels: dict[str, int] = field(default_factory=lambda: dict.fromkeys(CLASSES, 0))
    squares: dict[str, dict[str, float]] = field(default_factory=lambda: {n: {} for n in CLASSES})
    by_scene: dict[str, list[float]] = field(default_factory=lambda: {n: [] for n in CLASSES})

    def add(self, view: View, source: RawImage, simulators: dict[str, CameraSimulator]) -> None:
        """Opens one capture with every network."""
        f_source = source.settings.effective_f_number
        clean, deviation = _denoised(simulators["compact"], source)
        # As the module does, its bank shared with the same blur of the true diameters.
        aperture: Any = simulators["compact"].aperture
        bank, diameter = DiscBank(clean[0]), aperture.defocus(clean, deviation)[0]
        full = bank.blurred(added_blur(diameter, f_source, F_TARGET))
        truth = bank.blurred(added_blur(view.diameter, f_source, F_TARGET))
        images = {"exp": source.data, "ns": clean[0], "full": full, "true_depth": truth}
        if "paper" in simulators:
            clean, deviation = _denoised(simulators["paper"], source)
            f_numbers = torch.tensor([[f_source], [F_TARGET]])
            network: Any = simulators["paper"].aperture
            images["paper"] = network(clean, deviation, *f_numbers)[0]
        errors = {
            name: (clipped(image, source.camera) - view.target).double().square().sum(dim=0)
            for name, image in images.items()
        }
        for name, mask in view.classes.items():
            count, sums = int(mask.sum()), self.squares[name]
            self.pixels[name] += count
            for variant, error in errors.items():
                sums[variant] = sums.get(variant, 0.0) + float(error[mask].sum())
            if count >= FEWEST_PIXELS:
                ratio = errors["full"][mask].sum() / errors["exp"][mask].sum()
                self.by_scene[name].append(float(ratio) ** 0.5)

    def rows(self) -> Iterator[Row]:
        """Errors by class."""
        clear = self.pixels["1.5 px and more"] + self.pixels["below 1.5 px"]
        for name, (_, _, asked) in CLASSES.items():
            count = self.pixels[name]
            if count == 0:
                continue
            rmse = {v: (s / (4 * count)) ** 0.5 for v, s in self.squares[name].items()}
            ratios = self.by_scene[name]
            yield {
                "pixels": name,
                "count": count,
                "area": count / clear,
                "rmse_exp": rmse["exp"],
                "relative_to_exp": {v: e / rmse["exp"] for v, e in rmse.items()},
                "median_scene": float(np.median(ratios)) if ratios else None,
                "asked": asked,
                "met": rmse["full"] <= asked * rmse["exp"],
            }


def tables(rows: list[Row]) -> dict[str, str]:
    """A table for each set of scenes, below its name."""
    contents: dict[str, Any] = {
        "Full": "{relative_to_exp[full]:.2f}",
        "met": lambda r: "yes" if r["met"] else "no",
        "median scene": "{median_scene:.2f}",
        "NS": "{relative_to_exp[ns]:.2f}",
        "true depth": "{relative_to_exp[true_depth]:.2f}",
        "paper": "{relative_to_exp[paper]:.2f}",
    }
    line = "circle of confusion (area; asked)", "{pixels} ({area:.1%}; {asked:g})"

    def show(own: list[Row]) -> str:
        return pivot(own, line=line, columns="ISO {iso}", contents=contents)

    return {"defocus": "\n\n".join(sections(rows, "{set}", show))}
