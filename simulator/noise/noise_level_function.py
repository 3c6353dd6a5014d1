"""Noise of a pixel: its variance at each signal, and its distribution.

*The distribution of read noise*: normal and independent from pixel to pixel, unless captures ask
for ``noise="sensor"``. Real read noise has a part that is the same along a row of the sensor, and
tails that a Tukey-lambda distribution describes (Wei et al., "A physics-based noise formation model
for extreme low-light raw denoising", CVPR 2020). The variance of a sensor pixel stays that of the
noise level function: the row part is taken out of the read noise, not added.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

#: Larger variances are limited to this: float32 holds their sums over a frame of any signals.
VARIANCE_LIMIT = 1e24
#: Tukey's lambda whose excess kurtosis is 0, that of the normal distribution.
_NORMAL_SHAPE = 0.13491
#: Steps of `tail_tables` in a standard deviation, and their number: no draw reaches beyond 6.7.
TAIL_STEPS = 512
_TAIL_SIZE = int(6.7 * TAIL_STEPS) + 2
#: The planes R, G1 lie in one row of the sensor, G2, B in the other.
_ROW_OF_PLANE = (0, 0, 1, 1)


@dataclass(frozen=True)
class NoiseLevelFunction:
    """Variance of a pixel as a function of its signal: ``read + shot * max(signal, 0)``."""

    #: Slope per plane R, G1, G2, B, on the scale where sensor white is 1, >= 0.
    shot: tuple[float, float, float, float]
    read: tuple[float, float, float, float]  #: variance at zero signal per plane, >= 0
    #: Stops by which the ISO lies above the calibrated table, negative where it lies below; 0
    #: inside.
    extrapolation: float = 0.0
    source: str = ""  #: where the numbers come from

    def __post_init__(self) -> None:
        for name in ("shot", "read"):
            given: Any = getattr(self, name)
            try:
                values = tuple(map(float, given))
            except (TypeError, ValueError, OverflowError):  # a single number, a word
                values = ()
            if len(values) != 4 or not all(map(math.isfinite, values)) or min(values) < 0.0:
                raise ValueError(
                    f"`{name}` (={given!r}) must be 4 finite values >= 0, of R, G1, G2, B"
                )
            object.__setattr__(self, name, values)

    @staticmethod
    @functools.cache
    def zero() -> NoiseLevelFunction:
        """The NLF of a source without noise."""
        return NoiseLevelFunction((0.0,) * 4, (0.0,) * 4, source="noise-free")

    @functools.cached_property
    def is_zero(self) -> bool:
        """Whether there is no noise at all."""
        return max(*self.shot, *self.read) == 0.0

    def scaled(self, factor: float) -> NoiseLevelFunction:
        """Variance times `factor`: averaging ``k * k`` pixels multiplies it by ``1 / k**2``."""
        return self._with([v * factor for v in self.shot], [v * factor for v in self.read])

    def at_least(self, other: NoiseLevelFunction) -> NoiseLevelFunction:
        """The larger shot and the larger read noise of this and `other`, plane by plane."""
        return self._with(map(max, self.shot, other.shot), map(max, self.read, other.read))

    def exposed(self, ratio: float) -> NoiseLevelFunction:
        """NLF of this noise after the raw was multiplied by `ratio` (paper, section 3.2).

        No variance exceeds `VARIANCE_LIMIT`.
        """
        return self._with(
            [min(v * ratio, VARIANCE_LIMIT) for v in self.shot],
            [min(v * ratio * ratio, VARIANCE_LIMIT) for v in self.read],
        )

    def _with(self, shot: Any, read: Any) -> NoiseLevelFunction:
        return NoiseLevelFunction(shot, read, self.extrapolation, self.source)


def plane_tensor(values: Sequence[float] | np.ndarray, device: torch.device | str) -> Tensor:
    """One number for each plane as (4, 1, 1) float32: variances reach 5e-9, so never narrower."""
    return torch.tensor(values, dtype=torch.float32, device=device)[:, None, None]


def noise_variance(signal: Tensor, nlf: NoiseLevelFunction) -> Tensor:
    """Variance ``read + shot * max(signal, 0)`` of each pixel, (..., 4, H, W) float32."""
    shot, read = (plane_tensor(values, signal.device) for values in (nlf.shot, nlf.read))
    return signal.float().clamp(min=0.0) * shot + read


# -- the distribution of read noise -----------------------------------------------------------


@dataclass(frozen=True)
class ReadNoise:
    """Distribution of the read noise of averages of k x k sensor pixels."""

    #: Standard deviation of the part that a row shares, relative to that of all read noise of one
    #: sensor pixel; in [0, 1).
    row: float
    #: Tukey's lambda of the rest; 0.135 is nearly normal, less has longer tails. In (-0.25, 1],
    #: where the kurtosis is finite.
    shape: float
    box_factor: int = 1  # k

    def __post_init__(self) -> None:
        if not 0.0 <= self.row < 1.0:
            raise ValueError(f"`row` (={self.row!r}) must be in [0, 1)")
        if not -0.25 < self.shape <= 1.0:
            raise ValueError(f"`shape` (={self.shape!r}) must be in (-0.25, 1]")

    def row_part(self, variance: Tensor, normals: Tensor) -> Tensor:
        """The part that rows share, (..., 4, H, 1), of `normals` (..., 2, H).

        `variance` (..., 4, 1, 1) is that of all read noise of the averages, as if it were
        independent: an average over k x k pixels keeps 1/k of that of its k rows, of independent
        noise 1/k^2.
        """
        return (variance * self.box_factor).sqrt() * self.row * normals[..., _ROW_OF_PLANE, :, None]

    def pixel_part(self, variance: Tensor, normals: Tensor) -> Tensor:
        """The part of each pixel, (..., 4, H, W), of so many `normals`.

        Its `variance` is ``1 - row ** 2`` of that of all read noise.
        """
        return variance.sqrt() * tukey_lambda(normals, averaged_shape(self.shape, self.box_factor))


class ReadNoises(NamedTuple):
    """The read noise of each of B frames, which share a few kinds."""

    kinds: tuple[ReadNoise, ...]
    which: np.ndarray  # (B,) the one of each frame

    @classmethod
    def of(cls, each: Sequence[ReadNoise]) -> ReadNoises:
        """Those of frames that have `each`."""
        numbers = {kind: number for number, kind in enumerate(dict.fromkeys(each))}
        return cls(tuple(numbers), np.array([numbers[kind] for kind in each], np.int64))

    def part(self, frames: slice | np.ndarray) -> ReadNoises:
        """Those of some of the frames."""
        return ReadNoises(self.kinds, self.which[frames])


@functools.lru_cache(maxsize=8)
def tail_tables(kinds: tuple[ReadNoise, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Of K kinds of read noise, what a kernel draws them by, float32.

    Returns:
        (K, 2) deviation of the part that rows share and variance of the rest, where all read noise
        of the averages would have 1 if it were independent; (K, N) `tukey_lambda` of the normals 0,
        1/512, 2/512, ...: of their negatives it is the negative.
    """
    parts = [(kind.row * math.sqrt(kind.box_factor), 1.0 - kind.row**2) for kind in kinds]
    tables = [_tail_table(averaged_shape(kind.shape, kind.box_factor)) for kind in kinds]
    return np.array(parts, np.float32), np.stack(tables)


@functools.lru_cache(maxsize=256)
def _tail_table(shape: float) -> np.ndarray:
    normals = torch.arange(_TAIL_SIZE, dtype=torch.float64) / TAIL_STEPS
    return tukey_lambda(normals, shape).float().numpy()


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
