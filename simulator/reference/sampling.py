"""From light at the pitch of the photosites to the four planes of a raw.

A sensor sees each colour at its own place: light is blurred by the lens (about a pixel), each
photosite takes the colour of its filter, and only then may neighbours of one plane be averaged.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from simulator.camera import BayerPattern

#: Standard deviation of a sharp lens's blur [photosite]: a point is about a pixel wide (its full
#: width at half maximum is 1.2), between diffraction at f/4 and at f/11 for a pitch of 4 to 6 um.
LENS_SIGMA = 0.5


def lens_blur(light: Tensor, sigma: float = LENS_SIGMA) -> Tensor:
    """Gaussian blur of a lens in focus, borders repeated.

    Args:
        light: (C, H, W) linear light at the pitch of the photosites.
        sigma: Standard deviation [photosite]; 0 changes nothing.
    """
    if sigma == 0.0:
        return light
    reach = max(1, math.ceil(3.0 * sigma))
    weights = [math.exp(-0.5 * (offset / sigma) ** 2) for offset in range(-reach, reach + 1)]
    total = sum(weights)
    height, width = light.shape[-2:]
    padded = F.pad(light[None], (reach,) * 4, mode="replicate")[0]
    # Sums of shifted views: for these few taps three times as fast as a depthwise convolution.
    rows, blurred = torch.zeros_like(padded[:, :height]), torch.zeros_like(light)
    for i, weight in enumerate(weights):
        rows += weight / total * padded[:, i : i + height]
    for i, weight in enumerate(weights):
        blurred += weight / total * rows[..., i : i + width]
    return blurred


def sample_mosaic(light: Tensor, cfa: BayerPattern = BayerPattern.RGGB) -> Tensor:
    """The planes R, G1, G2, B that photosites behind a colour filter array take of `light`.

    Args:
        light: (3, 2H, 2W) red, green and blue at every photosite; a last odd row or column is cut.
        cfa: Order of the filters.

    Returns:
        (4, H, W).

    >>> ramp = torch.arange(16.0).reshape(1, 4, 4).expand(3, 4, 4)
    >>> sample_mosaic(ramp)[:, 0, 0].tolist()
    [0.0, 1.0, 4.0, 5.0]
    """
    height, width = (n // 2 * 2 for n in light.shape[-2:])
    colours = (0, 1, 1, 2)
    planes = [
        light[..., colour, row:height:2, column:width:2]
        for colour, (row, column) in zip(colours, cfa.offsets, strict=True)
    ]
    return torch.stack(planes, dim=-3)


def average_planes(planes: Tensor, k: int) -> Tensor:
    """Means over k x k samples of one plane, (..., 4, H, W) to (..., 4, H // k, W // k)."""
    return planes if k == 1 else F.avg_pool2d(planes, k)
