"""Extents of blur that differ from pixel to pixel, counted instead of listed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from ae_env.scenes.scene import Scene
from simulator.optics.disc_bank import DIAMETERS
from simulator.optics.motion_path import Movement


class PixelBlur(NamedTuple):
    """Blur of B captures whose pixels differ in it.

    Args:
        levels: (B, K) float64, extents that pixels of a capture have [pixel of the frame].
        shares: (B, K) float64, shares of the pixels that have them; they sum to 1.
    """

    levels: torch.Tensor
    shares: torch.Tensor

    @property
    def rms_px(self) -> torch.Tensor:
        """(B,) root mean square extent over the pixels [pixel of the frame]."""
        return self.levels.square().mul_(self.shares).sum(dim=1).sqrt_()


def layout_blur(
    scene: Scene,
    movement: Movement,
    *,
    speed: float,
    times: np.ndarray,
    discs: np.ndarray,
    own: np.ndarray,
) -> PixelBlur | None:
    """Blur of S captures of a scene with a layout; None where all pixels have the same.

    Args:
        scene: The scene.
        movement: Directions of the image's motion, and the subject's own.
        speed: Image speed [frame heights per second].
        times: (S,) exposure times [s].
        discs: (S,) diameters of the largest disc of defocus [pixel].
        own: (S,) blur that the scene brings itself [pixel].
    """
    layout, height = scene.layout, scene.light.shape[-2]
    if layout is None or not (discs.any() or movement.subject_speed):
        return None
    counted = layout.shares
    own_square = own**2
    rest = ((speed * times * height) ** 2 + own_square)[:, None]
    if movement.subject_speed:
        extent = movement.subject_extent(speed, times) * height
        rest = np.where(counted.subject, (extent**2 + own_square)[:, None], rest)
    levels = np.minimum(np.multiply.outer(discs, counted.defocus), DIAMETERS[-1])  # as in the frame
    levels *= levels
    levels += rest
    np.sqrt(levels, out=levels)  # (S, K)
    shares = torch.from_numpy(counted.share).expand(len(times), -1)
    return PixelBlur(torch.from_numpy(levels), shares)


def stacked(parts: Sequence[PixelBlur | None], blur_px: np.ndarray) -> PixelBlur | None:
    """One of captures of several scenes, from one of each; None where none of them has any.

    Args:
        parts: Of one capture each, B long.
        blur_px: (B,) extent of those that have the same everywhere [pixel of the frame].
    """
    most = max((part.levels.shape[1] for part in parts if part is not None), default=0)
    if not most:
        return None
    levels, shares = torch.zeros(2, len(parts), most, dtype=torch.float64)
    for i, part in enumerate(parts):
        if part is None:
            levels[i, 0], shares[i, 0] = float(blur_px[i]), 1.0
        else:
            count = part.levels.shape[1]
            levels[i, :count], shares[i, :count] = part.levels[0], part.shares[0]
    return PixelBlur(levels, shares)
