"""Exposure fusion: one picture of a bracket of pictures, without a radiance map between.

After S. Lee, J. S. Park and N. I. Cho, "A multi-exposure image fusion based on the adaptive weights
reflecting the relative pixel intensity and global gradient", ICIP 2018; blended in a Laplacian
pyramid as by T. Mertens, J. Kautz and F. Van Reeth, "Exposure fusion", Pacific Graphics 2007.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

#: Width of the first weight, relative to the spacing of the bracket's mean brightnesses.
ALPHA = 0.75
#: Levels of the pyramid, and standard deviation of the weights' smoothing [pixel].
LEVELS, SMOOTHING = 7, 5.0
_BINS = 256
_LUMA = (0.299, 0.587, 0.114)
#: Smallest weight: somewhere all pictures may be black or white.
_LEAST = 1e-12


def fuse(pictures: Sequence[Tensor] | Callable[[], Iterator[Tensor]]) -> Tensor:
    """Fuses a bracket.

    A picture counts where it is bright if it is one of the darker ones, and where it is dark if it
    is one of the brighter ones; and more where its brightnesses are rare, so that it has contrast
    there: where a picture is black or white, all of it has the same one.

    Args:
        pictures: N >= 2 pictures (3, H, W) float32 in [0, 1], sRGB, or a function that yields
            them, always the same ones, called several times: a bracket of large pictures need
            not be held at once.

    Returns:
        (3, H, W) in [0, 1].

    Raises:
        ValueError: If there are fewer than 2 pictures.
    """
    every = pictures if callable(pictures) else lambda: iter(pictures)
    means = torch.tensor([float(_luma(picture).mean()) for picture in every()])
    if len(means) < 2:
        raise ValueError(f"`pictures` (={len(means)}) must be at least 2")
    widths = _spacing(means)
    total: Tensor | None = None
    for picture, mean, width in zip(every(), means, widths, strict=True):
        weight = _weight(_luma(picture), float(mean), float(width))
        total = weight if total is None else total + weight
    assert total is not None
    fused: list[Tensor] = []
    for picture, mean, width in zip(every(), means, widths, strict=True):
        weight = smoothed(_weight(_luma(picture), float(mean), float(width)) / total)
        weights = _gaussian_pyramid(weight[None])
        details = _laplacian_pyramid(picture)
        blended = [w * d for w, d in zip(weights, details, strict=True)]
        fused = blended if not fused else [f.add_(b) for f, b in zip(fused, blended, strict=True)]
    result = fused[-1]
    for detail in reversed(fused[:-1]):
        result = detail + _expand(result, detail.shape[-2:])
    return result.clamp(0.0, 1.0)


def _spacing(means: Tensor) -> Tensor:
    """Standard deviation of the first weight of each picture."""
    order = means.argsort()
    ascending = means[order]
    between = torch.empty_like(ascending)
    between[1:-1] = ascending[2:] - ascending[:-2]
    between[0] = 2.0 * (ascending[1] - ascending[0])
    between[-1] = 2.0 * (ascending[-1] - ascending[-2])
    widths = torch.empty_like(between)
    widths[order] = ALPHA * between
    return widths.clamp(min=1.0 / _BINS)  # pictures that are alike


def _weight(luma: Tensor, mean: float, width: float) -> Tensor:
    """The product of both weights, (H, W), before it is normalised over the bracket."""
    well_placed = torch.exp(-((luma - (1.0 - mean)) ** 2) / (2.0 * width**2))
    codes = (luma * (_BINS - 1)).round().long().clamp(0, _BINS - 1)
    # The gradient of the cumulative histogram: how many pixels have this brightness.
    counts = torch.bincount(codes.flatten(), minlength=_BINS).double() / codes.numel()
    rarity = (1.0 / counts.clamp(min=1.0 / codes.numel())).float()[codes]
    return well_placed * rarity + _LEAST


def smoothed(weight: Tensor) -> Tensor:
    """`weight` (H, W) after a Gaussian of `SMOOTHING`, borders repeated."""
    radius = int(3 * SMOOTHING)
    taps = torch.exp(-0.5 * (torch.arange(-radius, radius + 1) / SMOOTHING) ** 2)
    taps = (taps / taps.sum()).to(weight)
    padded = F.pad(weight[None, None], (radius,) * 4, mode="replicate")
    rows = F.conv2d(padded, taps[None, None, None, :])
    return F.conv2d(rows, taps[None, None, :, None])[0, 0]


def _luma(picture: Tensor) -> Tensor:
    red, green, blue = (share * plane for share, plane in zip(_LUMA, picture, strict=True))
    return red + green + blue


# -- pyramids (Burt and Adelson 1983) -------------------------------------------------------------


def _binomial(image: Tensor, gain: float = 1.0) -> Tensor:
    """(C, H, W) after the filter [1 4 6 4 1] / 16 both ways, borders repeated."""
    taps = gain * torch.tensor([1.0, 4.0, 6.0, 4.0, 1.0]).to(image) / 16.0
    padded = F.pad(image[:, None], (2, 2, 2, 2), mode="replicate")
    rows = F.conv2d(padded, taps[None, None, None, :])
    return F.conv2d(rows, taps[None, None, :, None])[:, 0]


def _reduce(image: Tensor) -> Tensor:
    return _binomial(image)[:, ::2, ::2]


def _expand(image: Tensor, size: Sequence[int]) -> Tensor:
    height, width = size
    doubled = F.interpolate(image[None], scale_factor=2, mode="nearest")[0]
    return _binomial(doubled)[:, :height, :width]


def _gaussian_pyramid(image: Tensor) -> list[Tensor]:
    levels = [image]
    while len(levels) < LEVELS and min(levels[-1].shape[-2:]) > 1:
        levels.append(_reduce(levels[-1]))
    return levels


def _laplacian_pyramid(image: Tensor) -> list[Tensor]:
    levels = _gaussian_pyramid(image)
    details = [
        fine - _expand(coarse, fine.shape[-2:]) for fine, coarse in itertools.pairwise(levels)
    ]
    return [*details, levels[-1]]
