"""Thin-lens defocus of a scene with depth, aware of what hides what.

At a point of the sensor every part of the aperture looks at its own spot of the scene, nearest
surface first. The scene is cut into layers of nearly equal blur; a layer covers the share of the
aperture that the blur of its own pixels gives it there, and takes it from what nearer layers have
left. Shares add: pixels side by side on one surface fill the aperture exactly, so a highlight on a
receding floor keeps its energy and no seam opens between layers. Where the shares do not fill the
aperture, it sees past an edge, and the surface behind it is continued under the nearer one.
"""

import math
import sys
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
import torch

from simulator.optics.discs import disc_blur, disc_kernel
from simulator.utils.checks import check_number

_Length = TypeVar("_Length", float, np.ndarray, torch.Tensor)

#: Blur up to this diameter [px] is none: it moves less than 1/1000 of a pixel's light.
SHARP = 0.1
#: Below this share of the aperture a gap is the rounding of blurs to layers, not an edge.
_GAP = 0.02
#: A surface is clearly farther, with an edge between, from this step of blur [px] on, to which a
#: share of the nearer surface's blur is added: a slope is no edge.
_STEP, _STEP_SHARE = 0.5, 0.25


@dataclass(frozen=True)
class Lens:
    """A thin lens, focused at one distance."""

    focal_length: float = 0.05  #: [m], > 0
    #: Distance of the plane in focus [m], above the focal length; inf allowed.
    focus_distance: float = math.inf

    def __post_init__(self) -> None:
        check_number("focal_length", self.focal_length, sys.float_info.min, sys.float_info.max)
        if not self.focus_distance > self.focal_length:
            raise ValueError(
                f"`focus_distance` (={self.focus_distance!r}) must be above `focal_length` "
                f"(={self.focal_length!r})"
            )

    def circle_of_confusion(self, depth: _Length, f_number: float) -> _Length:
        """Diameter [m] of the image of a point at `depth`; < 0 in front of the plane in focus.

        ``f^2 / N * (1 / s - 1 / z) / (1 - f / s)``, focal length f, exact `f_number` N, focus
        distance s, `depth` z > 0 (inf allowed) from the lens [m]: the aperture f / N seen from the
        point, at the magnification of the focus plane.

        >>> lens = Lens(focal_length=0.05, focus_distance=2.0)
        >>> round(1e6 * lens.circle_of_confusion(4.0, 4.0), 1)  # micrometres
        160.3
        """
        near = 1.0 / self.focus_distance
        scale = self.focal_length**2 / f_number / (1.0 - self.focal_length * near)
        return (near - 1.0 / depth) * scale


class _Layers(NamedTuple):
    number: np.ndarray  # (H, W) which layer a pixel belongs to, 0 is the nearest
    diameters: np.ndarray  # (L,) signed [px], ascending

    def radius(self, layer: int) -> int:
        """How far the blur of `layer` reaches [px]."""
        return disc_kernel(abs(float(self.diameters[layer]))).shape[0] // 2


def _cut(diameter: np.ndarray) -> _Layers:
    """Layers of signed blur `diameter` (H, W) [px].

    A step is a tenth of the diameter, within 0.25 to 0.5 px. A layer takes the root mean square of
    its pixels' diameters, so a plane parallel to the sensor has exactly its own.
    """
    extent = np.abs(diameter)
    edges = [SHARP]
    while edges[-1] < extent.max():
        edges.append(edges[-1] + min(max(0.1 * edges[-1], 0.25), 0.5))
    signed = np.searchsorted(edges, extent, side="left") * np.sign(diameter).astype(int)
    names, number = np.unique(signed, return_inverse=True)
    number = number.reshape(diameter.shape)
    squares = np.bincount(number.ravel(), extent.ravel() ** 2)
    means = np.sqrt(squares / np.bincount(number.ravel()))
    return _Layers(number, np.sign(names) * means)


def defocus(light: torch.Tensor, diameter: torch.Tensor) -> torch.Tensor:
    """Light on the sensor behind a lens, of the linear `light` (C, H, W) that a pinhole sees.

    `diameter` is the circle of confusion (H, W) [px], smaller if nearer
    (`Lens.circle_of_confusion`). Borders are replicated. A pixel in focus (up to 0.1 px) with
    nothing nearer around comes out as it is, bit for bit.
    """
    layers = _cut(diameter.detach().cpu().double().numpy())
    if len(layers.diameters) == 1:
        return disc_blur(light, abs(float(layers.diameters[0])))
    canvas = _Canvas(light)
    in_focus = int(np.searchsorted(layers.diameters, 0.0))
    for layer, blur in enumerate(layers.diameters.tolist()):
        if layer == in_focus:
            # Between surfaces on one side of the focus, shares of the aperture lie beside each
            # other: what one takes, its neighbour did not have. On its other side their images in
            # the aperture are upside down: the light of the far side passes through what the near
            # side leaves of the aperture, and both shares count as independent.
            canvas.beyond = (1.0 - canvas.covered).clamp(min=0.0)
        mask = layers.number == layer
        box = _grown_box(mask, layers.radius(layer))
        canvas.paint(box, mask[box], light[:, *box], blur)
    _continue_behind(canvas, light, layers)
    return canvas.light / canvas.covered


class _Canvas:
    """Light gathered so far, and the share of the aperture that it came through."""

    def __init__(self, light: torch.Tensor) -> None:
        self.light = torch.zeros_like(light)  # (C, H, W)
        self.covered = torch.zeros_like(light[0])  # (H, W)
        self.beyond = torch.ones_like(light[0])  # share left by what is in front of the focus

    def paint(
        self, box: tuple[slice, slice], mask: np.ndarray, light: torch.Tensor, diameter: float
    ) -> None:
        """Adds `light` (C, h, w) of the pixels in `mask` (h, w), where the aperture is free."""
        own = torch.from_numpy(mask).to(light)
        blurred = disc_blur(torch.cat([own[None], own * light]), abs(diameter))
        share = blurred[0].clamp(min=0.0) * self.beyond[box]
        passed = torch.minimum(share, (1.0 - self.covered[box]).clamp(min=0.0))
        part = passed / blurred[0].clamp(min=torch.finfo(share.dtype).tiny)
        self.light[:, *box] += blurred[1:] * part
        self.covered[box] += passed


def _continue_behind(canvas: _Canvas, light: torch.Tensor, layers: _Layers) -> None:
    """Paints into the gaps at edges what the edges hide.

    Behind a pixel lies the surface of the nearest pixel that is clearly farther.
    """
    owner = np.full(layers.number.shape, -1)  # layer of the surface behind a pixel
    rows, columns = np.zeros_like(owner), np.zeros_like(owner)  # the pixel that shows it
    widest = max(map(layers.radius, range(len(layers.diameters))))
    for layer, blur in enumerate(layers.diameters[:-1]):
        reach = layers.radius(layer) + widest
        box = _grown_box(layers.number == layer, reach)
        farther = layers.diameters[layers.number[box]] > blur + _STEP + _STEP_SHARE * abs(blur)
        if not (farther.any() and bool((canvas.covered[box] < 1.0 - _GAP).any())):
            continue
        from scipy.ndimage import distance_transform_edt  # not above: it takes long

        distance, (row, column) = distance_transform_edt(~farther, return_indices=True)
        hiding = (layers.number[box] == layer) & (distance <= reach)
        row, column = row[hiding] + box[0].start, column[hiding] + box[1].start
        owner[box][hiding] = layers.number[row, column]
        rows[box][hiding], columns[box][hiding] = row, column
    for layer in np.unique(owner[owner >= 0]).tolist():
        mask = owner == layer
        box = _grown_box(mask, layers.radius(layer))
        row, column = (torch.from_numpy(i[box]).to(light.device) for i in (rows, columns))
        canvas.paint(box, mask[box], light[:, row, column], float(layers.diameters[layer]))


def _grown_box(mask: np.ndarray, margin: int) -> tuple[slice, slice]:
    """Bounding box of `mask` (H, W), at least one pixel wider on each side, within the image."""
    sides = []
    for axis, size in enumerate(mask.shape):
        inside = np.flatnonzero(mask.any(axis=1 - axis))
        grow = margin + 1
        sides.append(slice(max(inside[0] - grow, 0), min(inside[-1] + 1 + grow, size)))
    return sides[0], sides[1]
