"""Scenes as they are captured at f/11, and what f/4 shows of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import maximum_filter, minimum_filter
from torch import Tensor

from ae_env.scenes.reference_scenes import packed_pitch
from simulator import CameraProfile, CameraSettings, RawImage
from simulator.networks.exposure_module import OVER_EXPOSED
from simulator.reference.reference_camera import ReferenceCamera, ReferenceScene

F_SOURCE, F_TARGET = 11.0, 4.0
ISOS = (100, 1600)
#: Pixels this close to the frame, or to one at white in source or target, are classes of their own.
BORDER, CLIP_MARGIN = 11, 7
#: A pixel is near a depth edge where its disc at f/4 reaches one whose circle of confusion at f/11
#: differs by more than this [pixel], or the disc of such a one reaches it.
DEPTH_STEP = 0.5
#: In focus: no circle of confusion of this at f/11 [pixel] within this distance [pixel].
IN_FOCUS, FOCUS_MARGIN = 0.5, 12
#: Largest error of Full relative to EXP that is asked for, by class; None where nothing is.
CLASSES: dict[str, float | None] = {
    "3 px and more": 0.5,
    "1.5 to 3 px": 0.7,
    "1.5 px and more": 0.6,
    "3 px and more, away from depth edges": 0.3,
    "0.75 to 1.5 px": 1.05,
    "below 0.75 px": 1.05,
    "below 1.5 px": 1.05,
    "1.5 px and more, clip neighbourhoods": None,
    "1.5 px and more, border": None,
}
#: Sets of scenes by their kind; a photograph with depth is a set of its own.
_SET_NAMES = {
    "depth": "procedural",
    "photograph": "photographs, all in focus",
    "radiance": "radiance maps, all in focus",
}


@dataclass(frozen=True, eq=False)
class View:
    """A scene at f/11 as it was captured, and what f/4 shows of it.

    Args:
        name: Of the scene.
        set_name: Name of the photograph with depth, or the kind of scene.
        sources: Noisy captures at f/11, by ISO.
        target: (4, H, W) noise-free mean at f/4 and the same exposure, clipped.
        diameter: (H, W) true circle of confusion at f/11 [pixel].
        classes: Those of `CLASSES` as (H, W) bool; none for a scene without depth, which is in
            focus throughout.
        in_focus: (H, W) bool, nothing is out of focus around.
    """

    name: str
    set_name: str
    sources: dict[int, RawImage]
    target: Tensor
    diameter: Tensor
    classes: dict[str, Tensor]
    in_focus: Tensor


def make_views(
    scenes: Iterable[ReferenceScene], camera: CameraProfile, *, seed: int = 0
) -> list[View]:
    """Views of `scenes` through a body without errors of its own."""
    body = ReferenceCamera(camera)
    return [make_view(scene, body, seed=seed) for scene in scenes]


def make_view(scene: ReferenceScene, camera: ReferenceCamera, *, seed: int) -> View:
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
    signed = torch.zeros_like(target[0], dtype=torch.float64)
    if scene.depth is not None:
        f_number = captures[ISOS[0]].settings.effective_f_number
        on_sensor = scene.lens.circle_of_confusion(scene.depth.double(), f_number)
        signed = on_sensor / (packed_pitch(camera.camera) * camera.box_factor)
    white = torch.maximum(captures[ISOS[0]].mean, target).amax(dim=0) >= OVER_EXPOSED
    return View(
        name=scene.scene_id,
        set_name=_SET_NAMES.get(scene.kind, scene.group),
        sources={
            iso: RawImage(c.sample, c.settings, camera.camera, white_balance=scene.white_balance)
            for iso, c in captures.items()
        },
        target=target,
        diameter=signed.abs().float(),
        classes={} if scene.depth is None else pixel_classes(signed, white),
        in_focus=~_grown(signed.abs() >= IN_FOCUS, FOCUS_MARGIN),
    )


def equal_exposure(reference: CameraSettings, iso: float, f_number: float) -> CameraSettings:
    """The exposure of `reference` at another ISO and f-number."""
    unit = CameraSettings(iso, 1.0, f_number)
    return CameraSettings(iso, 2.0 ** (reference.log2_exposure - unit.log2_exposure), f_number)


def pixel_classes(signed: Tensor, white: Tensor) -> dict[str, Tensor]:
    """Which pixels (H, W) each of `CLASSES` holds.

    Args:
        signed: (H, W) circle of confusion at f/11 [pixel], below 0 in front of the focus.
        white: (H, W) bool, at sensor white in the source or in the target.
    """
    size = signed.abs()
    inside = torch.zeros_like(white)
    inside[BORDER:-BORDER, BORDER:-BORDER] = True
    clipped = _grown(white, CLIP_MARGIN)
    clear, blurred, large = inside & ~clipped, size >= 1.5, size >= 3.0
    return {
        "3 px and more": clear & large,
        "1.5 to 3 px": clear & blurred & ~large,
        "1.5 px and more": clear & blurred,
        "3 px and more, away from depth edges": clear & large & ~near_depth_edge(signed),
        "0.75 to 1.5 px": clear & (size >= 0.75) & ~blurred,
        "below 0.75 px": clear & (size < 0.75),
        "below 1.5 px": clear & ~blurred,
        "1.5 px and more, clip neighbourhoods": inside & clipped & blurred,
        "1.5 px and more, border": ~inside & blurred,
    }


def near_depth_edge(signed: Tensor) -> Tensor:
    """(H, W) bool, see `DEPTH_STEP`; discs are taken as the squares around them."""
    blur = signed.double().numpy()
    radius = np.ceil(np.abs(blur) * (F_SOURCE / F_TARGET) / 2.0).astype(int)
    near = np.zeros(blur.shape, bool)
    for reach in np.unique(radius[radius > 0]):
        own, side = radius == reach, 2 * reach + 1
        reached = maximum_filter(blur, side), minimum_filter(blur, side)
        near |= own & _differs(blur, *reached)
        # The discs of this size that reach a pixel; none leaves an infinity that does not differ.
        reaching = (
            maximum_filter(np.where(own, blur, -np.inf), side),
            minimum_filter(np.where(own, blur, np.inf), side),
        )
        near |= _differs(blur, *reaching)
    return torch.from_numpy(near)


def _differs(blur: np.ndarray, largest: np.ndarray, smallest: np.ndarray) -> np.ndarray:
    return (largest - blur > DEPTH_STEP) | (blur - smallest > DEPTH_STEP)


def _grown(mask: Tensor, margin: int) -> Tensor:
    return torch.from_numpy(maximum_filter(mask.numpy(), 2 * margin + 1))
