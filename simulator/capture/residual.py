"""What a denoising network leaves of the noise and takes from detail: predicted from the source.

A network errs by the noise that it leaves and by the detail that it takes for noise. Both are, in
units of the noise, functions of how well noise and detail can be told apart: of the error that the
best linear filter would make. They are measured once for each network, on pictures that it was not
trained on, and are part of its weights' card.

This module imports numba.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from simulator.capture.light_statistics import SUMS, SURE, noise_numbers
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.utils.compute import kernel

#: Side of a block, over which light is averaged, and of a window, over which detail is [packed
#: pixel]; blocks that are looked at, at most about this many.
BLOCK, _WINDOW, _BLOCKS = 8, 32, 16384
#: Variance of the Laplacian of noise of variance 1: 4^2 + 4.
_LAPLACIAN = 20.0
#: Relative variance of its square: twice the squared autocorrelation, over as many samples.
_CHANCE = 2.0 * (20.0**2 + 4 * 8.0**2 + 4 * 2.0**2 + 4 * 1.0**2) / 20.0**2
#: Shares of white noise in octaves of detail, from the finest: 3/4, 3/16, ..., and what is coarser.
_OCTAVES = (0.75, 0.1875, 0.046875, 0.015625)
#: What the Wiener error of a window of noise alone comes to by chance.
_LEAST = 0.003
#: A frame of n pixels keeps at least this many nths of its noise, however smooth it is.
_FEW = 2.0
#: Levels of light that blocks are gathered into, for quick answers.
_LEVELS = 24
_TINY = 1e-30
_TABLES = ("wiener_error", "bias", "variance")


def wiener_error(light: torch.Tensor, nlf: NoiseLevelFunction) -> torch.Tensor:
    """Mean square error of the best linear filter, in units of the noise's variance.

    Where detail has S times the energy of the noise, the Wiener filter errs by S / (1 + S) of the
    noise. S is estimated for each octave from the energy of the Laplacian of the light averaged
    over 1, 2, 4 and 8 pixels, all planes together, in windows of 32 x 32 pixels.

    Args:
        light: (4, H, W) as recorded.
        nlf: Its noise, not zero.

    Returns:
        (H // 8, W // 8) in [0, 1], alike within a window; one block for a frame of fewer pixels.
    """
    size = light.shape[-2:]
    window = tuple(min(_WINDOW, n) for n in size)
    shot, read = (torch.tensor(v)[:, None, None].to(light) for v in (nlf.shot, nlf.read))
    noise = F.avg_pool2d(light, window).clamp_(min=0.0).mul_(shot).add_(read).clamp_(min=_TINY)
    error = torch.zeros_like(noise[0])
    for octave, share in enumerate(_OCTAVES):
        if octave:
            if min(light.shape[-2:]) < 2:
                break
            light, window = F.avg_pool2d(light, 2), tuple(max(1, n // 2) for n in window)
        energy = F.avg_pool2d(_laplacian(light).square_(), window)
        excess = (energy / noise).mean(dim=0) * (4.0**octave / _LAPLACIAN) - 1.0
        chance = _CHANCE / (len(light) * window[0] * window[1])
        mean, spread = excess.mean(), excess.var(correction=0).clamp(min=chance)
        excess = mean + (1.0 - chance / spread) * (excess - mean)
        error += share * (1.0 - 1.0 / (1.0 + excess.clamp_(min=0.0)))
    error.clamp_(min=min(1.0, _FEW / (size[0] * size[1])))
    rows, columns = (
        (torch.arange(max(1, n // BLOCK)) * BLOCK // _WINDOW).clamp(max=windows - 1)
        for n, windows in zip(size, error.shape, strict=True)
    )
    return error[rows][:, columns]


def _laplacian(light: torch.Tensor) -> torch.Tensor:
    padded = F.pad(light[None], (1, 1, 1, 1), mode="replicate")[0]
    around = padded[:, 2:, 1:-1] + padded[:, :-2, 1:-1] + padded[:, 1:-1, 2:] + padded[:, 1:-1, :-2]
    return around.sub_(light, alpha=4.0)


def _blocks(image: torch.Tensor) -> torch.Tensor:
    """Means of a picture (C, H, W) over blocks."""
    return F.avg_pool2d(image, tuple(min(BLOCK, n) for n in image.shape[-2:]))


@dataclass(frozen=True, eq=False)
class Residual:
    """Error of one network in units of the standard deviation of the noise that it removes.

    Args:
        wiener_error: (K,) ascending values of `wiener_error`.
        bias: (K,) mean square of the systematic error there: detail that is taken for noise.
        variance: (K,) mean variance of what comes out: noise that is left.
        spread: Factor on a predicted error below which 90 % of the measured ones are.
    """

    wiener_error: np.ndarray
    bias: np.ndarray
    variance: np.ndarray
    spread: float

    @classmethod
    def from_card(cls, values: Mapping[str, Any]) -> Residual:
        """Of the numbers in a model card.

        Raises:
            ValueError: If they are not such numbers.
        """
        try:
            tables = tuple(np.asarray(values[n], np.float64) for n in _TABLES)
            spread = float(values["spread"])
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"`residual` (={values!r}) must be a calibration: {error}") from None
        if len({t.shape for t in tables}) != 1 or tables[0].ndim != 1 or len(tables[0]) < 2:
            raise ValueError(f"`residual` (={values!r}) must be three lists of one length")
        finite = all(np.isfinite(t).all() and (t >= 0).all() for t in tables)
        if not finite or not 1.0 <= spread < math.inf:
            raise ValueError(f"`residual` (={values!r}) must be finite and >= 0, its spread >= 1")
        return cls(tables[0], tables[1], tables[2], spread)

    def to_card(self) -> dict[str, Any]:
        """JSON values of a model card."""
        tables = {n: getattr(self, n) for n in _TABLES}
        rounded = {n: [float(f"{v:.4g}") for v in t] for n, t in tables.items()}
        return {**rounded, "spread": round(self.spread, 3)}

    def at(self, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Squared bias and variance where the Wiener filter has this `error`."""
        place, knots = np.log2(error + _LEAST), np.log2(self.wiener_error + _LEAST)
        return np.interp(place, knots, self.bias), np.interp(place, knots, self.variance)


@kernel(fastmath=SUMS, boundscheck=False)
def _error(bias, variance, level, share, ratio, source, target, noise, sure):  # type: ignore[no-untyped-def]
    """`ResidualStatistics.error`.

    Args:
        bias: (P, L) squared bias of the network, in units of the source's noise.
        variance: (P, L) variance of what comes out, in the same units.
        level: (P, L) mean light.
        share: (P, L) share of all samples.
        ratio: Exposure ratio to the target.
        source: (2, P) shot and read noise of the light.
        target: (2, P) shot and read noise that are wanted.
        noise: Whether noise of the target's is added.
        sure: Standard deviations of the source's noise above white from which a level is white
            in a noisy capture.
    """
    total = 0.0
    for plane in range(level.shape[0]):
        for index in range(level.shape[1]):
            light = level[plane, index]
            own = source[0, plane] * light + source[1, plane]
            wanted = target[0, plane] * light * ratio + target[1, plane]
            relative = own * ratio * ratio / (wanted if wanted > _TINY else _TINY)
            left = variance[plane, index] * relative
            if noise:
                if ratio * (light - sure * np.sqrt(own)) > 1.0:
                    continue
                beyond = np.sqrt(1.0 + left) - 1.0
                left = beyond * beyond
            total += share[plane, index] * (bias[plane, index] * relative + left)
    return np.sqrt(total)


class ResidualStatistics:
    """Predicts the errors of networks on one recorded light, for any target.

    Nothing is computed before it is first asked for; the first answer takes a pass over the pixels
    (over some rows of blocks, where the frame is large), later ones a few microseconds.

    Args:
        light: (4, H, W) as recorded.
        nlf: Its noise.
    """

    def __init__(self, light: torch.Tensor, nlf: NoiseLevelFunction) -> None:
        self.light, self.nlf = light, nlf
        self._gathered: dict[Residual, tuple[np.ndarray, np.ndarray]] = {}

    def __reduce__(self) -> tuple[type[ResidualStatistics], tuple[Any, ...]]:
        return ResidualStatistics, (self.light, self.nlf)

    def error(
        self,
        residual: Residual,
        ratio: float,
        target: NoiseLevelFunction,
        *,
        noise: bool = True,
    ) -> float:
        """Error of a capture that starts from the light which a network has denoised.

        Root mean square over the pixels of ``sqrt(dm^2 + ds^2) / s``, where the mean moves by dm,
        the standard deviation by ds, and s is the one that the target should have.

        Args:
            residual: Of the network.
            ratio: Exposure ratio to the target.
            target: Noise that the capture should have.
            noise: Whether a capture is wanted; else the light alone, in which noise that is left
                is an error in full.
        """
        level, share = self._levels
        noises = noise_numbers(self.nlf), noise_numbers(target)
        return float(_error(*self._of(residual), level, share, float(ratio), *noises, noise, SURE))

    def _of(self, residual: Residual) -> tuple[np.ndarray, np.ndarray]:
        """Squared bias and variance of a network by plane and level of light, (4, L) each."""
        found = self._gathered.get(residual)
        if found is None:
            error, _, place, counts = self._measured
            sums = [
                np.stack([np.bincount(p, v, _LEVELS) for p in place]) for v in residual.at(error)
            ]
            found = sums[0] / np.maximum(counts, 1), sums[1] / np.maximum(counts, 1)
            self._gathered[residual] = found
        return found

    @functools.cached_property
    def _levels(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean light, and share of all samples, by plane and level, (4, L) each."""
        _, light, place, counts = self._measured
        sums = [np.bincount(p, v, _LEVELS) for p, v in zip(place, light, strict=True)]
        return np.stack(sums) / np.maximum(counts, 1), counts / counts.sum()

    @functools.cached_property
    def _measured(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Wiener error (N,) and light (4, N) of blocks, their levels, and how many each has."""
        rows = _some_rows(self.light)
        parts = [self.light[:, top:bottom] for top, bottom in rows]
        error = torch.cat([wiener_error(part, self.nlf).flatten() for part in parts])
        light = torch.cat([_blocks(part).flatten(1) for part in parts], dim=1).clamp_(min=0.0)
        values = light.double().cpu().numpy()
        order = np.argsort(np.argsort(values, axis=1), axis=1)
        place = order * _LEVELS // values.shape[1]
        counts = np.stack([np.bincount(p, minlength=_LEVELS) for p in place])
        return error.double().cpu().numpy(), values, place, counts


def _some_rows(light: torch.Tensor) -> Sequence[tuple[int, int]]:
    """First row, and row after the last, of the bands that are looked at."""
    height, width = light.shape[-2:]
    blocks = max(1, height // BLOCK) * max(1, width // BLOCK)
    if blocks <= _BLOCKS or height < 2 * _WINDOW:
        return [(0, height)]
    step = _WINDOW * math.ceil(blocks / _BLOCKS)
    return [(top, top + _WINDOW) for top in range(0, height - _WINDOW + 1, step)]
