"""How read noise is distributed: a part that a whole sensor row shares, and tails.

The model everywhere is read noise that is normal and independent from pixel to pixel. Real read
noise has a part that is the same along a row of the sensor, and tails that a Tukey-lambda
distribution describes (Wei et al., "A physics-based noise formation model for extreme low-light
raw denoising", CVPR 2020). It is an option, ``noise="sensor"``. The variance of a sensor pixel
stays that of the noise level function: the row part is taken out of the read noise, not added.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

#: Tukey's lambda whose excess kurtosis is 0, that of the normal distribution.
_NORMAL_SHAPE = 0.13491
#: The planes R, G1 lie in one row of the sensor, G2, B in the other.
_ROW_OF_PLANE = (0, 0, 1, 1)


@dataclass(frozen=True)
class ReadNoise:
    """Distribution of the read noise of averages of k x k sensor pixels.

    Args:
        row: Standard deviation of the part that a row shares, relative to that of all read noise of
            one sensor pixel; in [0, 1).
        shape: Tukey's lambda of the rest; 0.135 is nearly normal, less has longer tails. In
            (-0.25, 1], where the kurtosis is finite.
        box_factor: k.
    """

    row: float
    shape: float
    box_factor: int = 1

    def __post_init__(self) -> None:
        if not 0.0 <= self.row < 1.0:
            raise ValueError(f"`row` (={self.row!r}) must be in [0, 1)")
        if not -0.25 < self.shape <= 1.0:
            raise ValueError(f"`shape` (={self.shape!r}) must be in (-0.25, 1]")

    def row_part(self, variance: Tensor, normals: Tensor) -> Tensor:
        """The part that rows share, (..., 4, H, 1).

        An average over k x k pixels has k rows: it keeps 1/k of their variance, where independent
        noise keeps 1/k^2. The larger k, the more the rows show.

        Args:
            variance: (4, 1, 1) of all read noise of the averages, as independent noise has it.
            normals: (..., 2, H) standard normals.
        """
        return (variance * self.box_factor).sqrt() * self.row * normals[..., _ROW_OF_PLANE, :, None]

    def pixel_part(self, variance: Tensor, normals: Tensor) -> Tensor:
        """The part of each pixel, (..., 4, H, W).

        Args:
            variance: Its variance: ``1 - row ** 2`` of that of all read noise.
            normals: (..., 4, H, W) standard normals.
        """
        return variance.sqrt() * tukey_lambda(normals, averaged_shape(self.shape, self.box_factor))


def tukey_lambda(normals: Tensor, shape: float) -> Tensor:
    """Standard normals as draws of a Tukey-lambda distribution of mean 0 and variance 1."""
    from scipy.stats import tukeylambda  # not above: it takes half a second

    x = normals.double()
    below, above = torch.special.log_ndtr(x), torch.special.log_ndtr(-x)
    if shape != 0.0:  # Q(p) = (p^lambda - (1 - p)^lambda) / lambda, log(p / (1 - p)) at its limit
        below, above = torch.expm1(shape * below) / shape, torch.expm1(shape * above) / shape
    return ((below - above) / math.sqrt(tukeylambda.var(shape))).to(normals.dtype)


@functools.cache
def averaged_shape(shape: float, k: int) -> float:
    """Tukey's lambda of the mean of k x k draws: that of its excess kurtosis, 1/k^2 of one's."""
    from scipy.optimize import brentq
    from scipy.stats import tukeylambda

    def kurtosis(value: float) -> float:
        return float(tukeylambda.stats(value, moments="k"))

    wanted = kurtosis(shape) / k**2
    if k == 1 or abs(wanted) < 1e-3:
        return shape if k == 1 else _NORMAL_SHAPE
    return float(brentq(lambda value: kurtosis(value) - wanted, shape, _NORMAL_SHAPE))
