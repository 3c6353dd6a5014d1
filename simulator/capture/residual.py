"""What a denoising network leaves of the noise and takes from detail: predicted from the source.

A network errs by the noise that it leaves and by the detail that it takes for noise. Both are, in
units of the noise, functions of how far detail stands out of the noise. They are measured once for
each network, on pictures that it was not trained on, and are part of its weights' card.
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

from simulator.capture.light_statistics import SURE
from simulator.noise.noise_level_function import NoiseLevelFunction

#: Side of a block [packed pixel], and blocks that are looked at, at most about this many.
BLOCK, _BLOCKS = 8, 8192
#: Variance of the Laplacian of noise of variance 1: 4^2 + 4.
_LAPLACIAN = 20.0
#: Detail below this share of the noise cannot be told from none: blocks are small.
_LEAST_DETAIL = 0.1
#: Levels of light that blocks are gathered into, for quick answers.
_LEVELS = 24
_TINY = 1e-30
_TABLES = ("detail", "bias", "variance")


def relative_detail(light: torch.Tensor, nlf: NoiseLevelFunction) -> torch.Tensor:
    """How far detail stands out of the noise, in blocks of 8 x 8 pixels.

    The energy of the Laplacian, all planes together, over that of noise alone, less 1.

    Args:
        light: (4, H, W) as recorded.
        nlf: Its noise, not zero.

    Returns:
        (H // 8, W // 8), at least 0; one block for a frame of fewer pixels.
    """
    padded = F.pad(light[None], (1, 1, 1, 1), mode="replicate")[0]
    around = padded[:, 2:, 1:-1] + padded[:, :-2, 1:-1] + padded[:, 1:-1, 2:] + padded[:, 1:-1, :-2]
    energy = _blocks((around - 4.0 * light).square_())
    shot, read = (torch.tensor(v)[:, None, None].to(light) for v in (nlf.shot, nlf.read))
    noise = _blocks(light).clamp_(min=0.0).mul_(shot).add_(read).clamp_(min=_TINY)
    return (energy / noise).mean(dim=0).div_(_LAPLACIAN).sub_(1.0).clamp_(min=0.0)


def _blocks(image: torch.Tensor) -> torch.Tensor:
    """Means of a picture (C, H, W) over blocks."""
    return F.avg_pool2d(image, tuple(min(BLOCK, n) for n in image.shape[-2:]))


@dataclass(frozen=True, eq=False)
class Residual:
    """Error of one network in units of the standard deviation of the noise that it removes.

    Args:
        detail: (K,) ascending values of `relative_detail`.
        bias: (K,) mean square of the systematic error there: detail that is taken for noise.
        variance: (K,) mean variance of what comes out: noise that is left.
        spread: Factor on a predicted error below which 90 % of the measured ones are.
    """

    detail: np.ndarray
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

    def at(self, detail: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Squared bias and variance where `detail` stands out that far."""
        place, knots = np.log2(detail + _LEAST_DETAIL), np.log2(self.detail + _LEAST_DETAIL)
        return np.interp(place, knots, self.bias), np.interp(place, knots, self.variance)


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
        bias, variance = self._of(residual)
        shot, read = (np.array(v)[:, None] for v in (target.shot, target.read))
        wanted = np.maximum(shot * (level * ratio) + read, _TINY)
        own = np.array(self.nlf.shot)[:, None] * level + np.array(self.nlf.read)[:, None]
        relative = own * (ratio * ratio) / wanted
        if noise:  # what is surely white in the capture shows no error
            share = np.where(ratio * (level - SURE * np.sqrt(own)) > 1.0, 0.0, share)
        left = variance * relative
        spread = np.square(np.sqrt(1.0 + left) - 1.0) if noise else left
        return math.sqrt(float(np.vdot(share, bias * relative + spread)))

    def _of(self, residual: Residual) -> tuple[np.ndarray, np.ndarray]:
        """Squared bias and variance of a network by plane and level of light, (4, L) each."""
        found = self._gathered.get(residual)
        if found is None:
            detail, _, place, counts = self._measured
            sums = [
                np.stack([np.bincount(p, v, _LEVELS) for p in place]) for v in residual.at(detail)
            ]
            found = sums[0] / np.maximum(counts, 1), sums[1] / np.maximum(counts, 1)
            self._gathered[residual] = found
        return found

    @property
    def _levels(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean light, and share of all samples, by plane and level, (4, L) each."""
        _, _light, _place, counts = self._measured
        return self._means, counts / counts.sum()

    @functools.cached_property
    def _means(self) -> np.ndarray:
        _, light, place, counts = self._measured
        sums = [np.bincount(p, v, _LEVELS) for p, v in zip(place, light, strict=True)]
        return np.stack(sums) / np.maximum(counts, 1)

    @functools.cached_property
    def _measured(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Detail (N,) and light (4, N) of blocks, their levels (4, N), and how many each has."""
        rows = _some_rows(self.light)
        parts = [self.light[:, top:bottom] for top, bottom in rows]
        detail = torch.cat([relative_detail(part, self.nlf).flatten() for part in parts])
        light = torch.cat([_blocks(part).flatten(1) for part in parts], dim=1).clamp_(min=0.0)
        values = light.double().cpu().numpy()
        order = np.argsort(np.argsort(values, axis=1), axis=1)
        place = order * _LEVELS // values.shape[1]
        counts = np.stack([np.bincount(p, minlength=_LEVELS) for p in place])
        return detail.double().cpu().numpy(), values, place, counts


def _some_rows(light: torch.Tensor) -> Sequence[tuple[int, int]]:
    """First row, and row after the last, of the bands that are looked at."""
    height, width = light.shape[-2:]
    blocks = max(1, height // BLOCK) * max(1, width // BLOCK)
    if blocks <= _BLOCKS or height < 2 * BLOCK:
        return [(0, height)]
    step = BLOCK * math.ceil(blocks / _BLOCKS)
    return [(top, top + BLOCK) for top in range(0, height - BLOCK + 1, step)]
