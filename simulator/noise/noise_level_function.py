"""The noise level function: how much noise a pixel has at each signal."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

#: Larger variances are limited to this: float32 holds their sums over a frame of any signals.
VARIANCE_LIMIT = 1e24


@dataclass(frozen=True)
class NoiseLevelFunction:
    """Variance of a pixel as a function of its signal: ``read + shot * max(signal, 0)``.

    Args:
        shot: Slope per plane R, G1, G2, B, on the scale where sensor white is 1.
        read: Variance at zero signal per plane.
        extrapolation: Stops by which the ISO lies above the calibrated table, negative where it
            lies below; 0 inside.
        source: Where the numbers come from.

    Raises:
        ValueError: Unless `shot` and `read` are 4 finite numbers >= 0 each.
    """

    shot: tuple[float, float, float, float]
    read: tuple[float, float, float, float]
    extrapolation: float = 0.0
    source: str = ""

    def __post_init__(self) -> None:
        for name in ("shot", "read"):
            object.__setattr__(self, name, _four_variances(name, getattr(self, name)))

    @staticmethod
    @functools.cache
    def zero() -> NoiseLevelFunction:
        """The NLF of a source without noise."""
        return NoiseLevelFunction((0.0,) * 4, (0.0,) * 4, source="noise-free")

    @functools.cached_property
    def is_zero(self) -> bool:
        """Whether there is no noise at all."""
        return max(*self.shot, *self.read) == 0.0

    @property
    def extrapolated(self) -> bool:
        """Whether the ISO lies outside the calibrated table."""
        return self.extrapolation != 0.0

    def scaled(self, factor: float) -> NoiseLevelFunction:
        """Variance times `factor`: averaging ``k * k`` pixels multiplies it by ``1 / k**2``."""
        return self._with([v * factor for v in self.shot], [v * factor for v in self.read])

    def at_least(self, other: NoiseLevelFunction) -> NoiseLevelFunction:
        """The larger shot and the larger read noise of both, plane by plane."""
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


def _four_variances(name: str, given: Any) -> tuple[float, ...]:
    try:
        values = tuple(map(float, given))
    except (TypeError, ValueError):  # a single number, a word
        values = ()
    if len(values) != 4 or not all(map(math.isfinite, values)) or min(values) < 0.0:
        raise ValueError(
            f"`{name}` (={given!r}) must be 4 finite values >= 0, one for each of R, G1, G2, B"
        )
    return values


def nlf_tensors(
    nlf: NoiseLevelFunction, device: torch.device | str = "cpu"
) -> tuple[torch.Tensor, torch.Tensor]:
    """(shot, read), each (4, 1, 1) float32: variances reach 5e-9, so never a narrower dtype."""
    return plane_tensor(nlf.shot, device), plane_tensor(nlf.read, device)


def plane_tensor(values: Sequence[float] | np.ndarray, device: torch.device | str) -> torch.Tensor:
    """One number for each plane as (4, 1, 1) float32."""
    return torch.tensor(values, dtype=torch.float32, device=device)[:, None, None]


def noise_variance(signal: torch.Tensor, nlf: NoiseLevelFunction) -> torch.Tensor:
    """Variance ``read + shot * max(signal, 0)`` of each pixel, (..., 4, H, W) float32."""
    shot, read = nlf_tensors(nlf, signal.device)
    return signal.float().clamp(min=0.0) * shot + read
