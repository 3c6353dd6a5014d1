"""Exposure fusion: one picture of a bracket of pictures, without a radiance map between.

After S. Lee, J. S. Park and N. I. Cho, "A multi-exposure image fusion based on the adaptive weights
reflecting the relative pixel intensity and global gradient", ICIP 2018; blended in a Laplacian
pyramid as by T. Mertens, J. Kautz and F. Van Reeth, "Exposure fusion", Pacific Graphics 2007.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import correlate1d
from torch import Tensor

#: Width of the first weight, relative to the spacing of the bracket's mean brightnesses.
ALPHA = 0.75
#: Levels of the pyramid of a picture of less than 512 pixels a side, and standard deviation of the
#: weights' smoothing [pixel].
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
    taps = np.exp(-0.5 * (np.arange(-radius, radius + 1) / SMOOTHING) ** 2)
    values = weight.cpu().numpy()
    for axis in (0, 1):
        values = correlate1d(values, taps / taps.sum(), axis=axis, mode="nearest")
    return torch.from_numpy(values).to(weight.device)


def _luma(picture: Tensor) -> Tensor:
    red, green, blue = (share * plane for share, plane in zip(_LUMA, picture, strict=True))
    return red + green + blue


# -- pyramids (Burt and Adelson 1983) -------------------------------------------------------------


def _reduce(image: Tensor) -> Tensor:
    """Every second pixel of (C, H, W) after [1 4 6 4 1] / 16 both ways, borders repeated."""
    for axis in (1, 2):
        padded, length = _padded(image, axis, 2), image.shape[axis]
        every_second = (slice(None),) * axis + (slice(None, None, 2),)
        taps = [padded.narrow(axis, offset, length)[every_second] for offset in range(5)]
        inner = (taps[1] + taps[3]).mul_(4.0).add_(taps[2], alpha=6.0)
        image = inner.add_(taps[0]).add_(taps[4]).div_(16.0)
    return image


def _expand(image: Tensor, size: Sequence[int]) -> Tensor:
    """(C, H, W) at twice the pixels, cut to `size`, filled in by the same filter.

    Pixel k comes to lie at 2 k, where `_reduce` took it from.
    """
    for axis, length in zip((1, 2), size, strict=True):
        padded = _padded(image, axis, 1)
        before, here, after = (padded.narrow(axis, o, image.shape[axis]) for o in range(3))
        even = (before + after).add_(here, alpha=6.0).div_(8.0)
        odd = (here + after).div_(2.0)
        image = torch.stack([even, odd], axis + 1).flatten(axis, axis + 1).narrow(axis, 0, length)
    return image


def _padded(image: Tensor, axis: int, margin: int) -> Tensor:
    margins = (0, 0, margin, margin) if axis == 1 else (margin, margin, 0, 0)
    return F.pad(image, margins, mode="replicate")


def _depth(image: Tensor) -> int:
    """Levels such that the coarsest has 4 to 8 pixels along its shorter side, at least `LEVELS`.

    What is larger than a pixel of the coarsest level is weighted as a whole: with 7 levels, a flat
    patch of a photograph of some megapixels fades from its edges to its middle.
    """
    return max(LEVELS, min(image.shape[-2:]).bit_length() - 2)


def _gaussian_pyramid(image: Tensor) -> list[Tensor]:
    levels = [image]
    while len(levels) < _depth(image) and min(levels[-1].shape[-2:]) > 1:
        levels.append(_reduce(levels[-1]))
    return levels


def _laplacian_pyramid(image: Tensor) -> list[Tensor]:
    levels = _gaussian_pyramid(image)
    details = [
        fine - _expand(coarse, fine.shape[-2:]) for fine, coarse in itertools.pairwise(levels)
    ]
    return [*details, levels[-1]]
