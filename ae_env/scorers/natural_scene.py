"""Statistics of natural pictures: what NIQE compares.

A natural picture's locally normalised luma is close to a generalised normal distribution, and the
products of its neighbours to an asymmetric one; noise, blur and clipping change their shapes.

Source: Mittal, Soundararajan and Bovik, Making a "Completely Blind" Image Quality Analyzer, IEEE
Signal Processing Letters 20(3), 2013; the asymmetric fit: Lasmar, Stitou and Berthoumieu, 2009.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor
from torch.nn import functional

#: Numbers of one scale, and of the two together.
FEATURES_PER_SCALE, SCALES = 18, 2
FEATURES = FEATURES_PER_SCALE * SCALES
#: Neighbours whose products are fitted: right, below, and along both diagonals.
_SHIFTS = ((0, 1), (1, 0), (1, 1), (1, -1))
#: Shapes that the fit chooses from.
_LEAST_SHAPE, _LARGEST_SHAPE, _SHAPE_STEP = 0.2, 10.0, 0.001
_WINDOW, _WINDOW_SIGMA = 7, 7.0 / 6.0


def normalised_luma(luma: Tensor) -> tuple[Tensor, Tensor]:
    """Luma with its local mean taken off, divided by its local deviation + 1.

    The window is a Gaussian of 7 x 7 pixels, sigma 7/6; edges are repeated.

    Args:
        luma: (B, H, W) in [0, 255].

    Returns:
        (B, H, W) normalised (MSCN) coefficients, and (B, H, W) local standard deviation.
    """
    mean = _blur(luma)
    deviation = (_blur(luma.square()) - mean.square()).abs().sqrt()
    return (luma - mean) / (deviation + 1.0), deviation


def fit_asymmetric(samples: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Asymmetric generalised normal distribution of zero mode, by matching moments.

    Density ``exp(-(|x| / beta)^alpha)`` up to its constant, with a beta for each side.

    Args:
        samples: (..., N).

    Returns:
        Shape alpha in [0.2, 10], scale of the left side and scale of the right side, each (...).
        Where all samples are 0, alpha is 10 and the scales are 0.
    """
    below, above = samples < 0, samples > 0
    squares = samples.square()

    def deviation(side: Tensor) -> Tensor:
        return ((squares * side).sum(-1) / side.sum(-1).clamp(min=1)).sqrt()

    left, right = deviation(below), deviation(above)
    tiny = torch.finfo(samples.dtype).tiny
    share = left / right.clamp(min=tiny)
    # Symmetric in the two sides; a share beyond this only overflows.
    share = share.clamp(1e-6, 1e6)
    ratio = samples.abs().mean(-1).square() / squares.mean(-1).clamp(min=tiny)
    ratio = ratio * (share**3 + 1.0) * (share + 1.0) / (share**2 + 1.0).square()
    shapes, ratios = _shape_table(samples.dtype)
    upper = torch.searchsorted(ratios, ratio.contiguous()).clamp(1, len(ratios) - 1)
    nearer_lower = (ratio - ratios[upper - 1]) <= (ratios[upper] - ratio)
    alpha = shapes[upper - nearer_lower.long()]
    empty = squares.amax(-1) == 0
    alpha = torch.where(empty, shapes[-1], alpha)
    # The deviation of a generalised normal of scale 1.
    unit = torch.exp(0.5 * (torch.lgamma(1.0 / alpha) - torch.lgamma(3.0 / alpha)))
    return alpha, left * unit, right * unit


def block_features(luma: Tensor, block: int) -> tuple[Tensor, Tensor]:
    """NIQE's 36 features of each block of each picture.

    Args:
        luma: (B, H, W) float64 in [0, 255], H and W at least `block`; what is left over right and
            below is not looked at.
        block: Side of a block [pixel], even; the second scale has half of it.

    Returns:
        (B, N, 36) features of N = (H // block) (W // block) blocks, and (B, N) their mean local
        deviation at full size, the sharpness.
    """
    rows, columns = luma.shape[1] // block, luma.shape[2] // block
    luma = luma[:, : rows * block, : columns * block]
    features, sharpness = [], luma.new_zeros(0)
    for scale in range(SCALES):
        side = block >> scale
        normalised, deviation = normalised_luma(luma)
        features.append(_scale_features(_blocks(normalised, side)))
        if scale == 0:
            sharpness = _blocks(deviation, side).mean(dim=(2, 3))
            half = [n // 2 for n in luma.shape[1:]]
            luma = functional.interpolate(
                luma[:, None], half, mode="bicubic", antialias=True, align_corners=False
            )[:, 0]
    return torch.cat(features, dim=2), sharpness


def _scale_features(blocks: Tensor) -> Tensor:
    """(B, N, 18) of normalised blocks (B, N, side, side)."""
    alpha, left, right = fit_asymmetric(blocks.flatten(2))
    values = [alpha, (left + right) / 2.0]
    for shift in _SHIFTS:
        neighbours = blocks * blocks.roll(shift, dims=(2, 3))
        alpha, left, right = fit_asymmetric(neighbours.flatten(2))
        mean = (right - left) * torch.exp(torch.lgamma(2.0 / alpha) - torch.lgamma(1.0 / alpha))
        values += [alpha, mean, left, right]
    return torch.stack(values, dim=2)


def _blocks(values: Tensor, side: int) -> Tensor:
    """(B, N, side, side) tiles of (B, H, W), row by row."""
    batch, height, width = values.shape
    tiles = values.reshape(batch, height // side, side, width // side, side)
    return tiles.permute(0, 1, 3, 2, 4).reshape(batch, -1, side, side)


def _blur(values: Tensor) -> Tensor:
    place = torch.arange(_WINDOW, dtype=values.dtype, device=values.device) - _WINDOW // 2
    weights = torch.exp(-place.square() / (2.0 * _WINDOW_SIGMA**2))
    weights = weights / weights.sum()
    edge = _WINDOW // 2
    padded = functional.pad(values[:, None], (edge, edge, edge, edge), mode="replicate")
    across = functional.conv2d(padded, weights[None, None, None, :])
    return functional.conv2d(across, weights[None, None, :, None])[:, 0]


@lru_cache(maxsize=4)
def _shape_table(dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Shapes, and E|x|^2 / E x^2 of the generalised normal distribution of each: it only rises."""
    count = round((_LARGEST_SHAPE - _LEAST_SHAPE) / _SHAPE_STEP) + 1
    shapes = _LEAST_SHAPE + _SHAPE_STEP * torch.arange(count, dtype=torch.float64)
    log = 2.0 * torch.lgamma(2.0 / shapes) - torch.lgamma(1.0 / shapes)
    return shapes.to(dtype), torch.exp(log - torch.lgamma(3.0 / shapes)).to(dtype)
