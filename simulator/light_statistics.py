"""What must be known of a light to tell what leaving a step out would change."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import torch

from simulator.camera import NoiseLevelFunction
from simulator.threads import in_shares

#: Bins of about equal population per plane, and pixels of a plane that are looked at, at most.
BINS = 64
SAMPLES = 65_536
#: Pixels of a plane that are sorted for bins and median, at most about this many.
_SORTED = 4096
#: Pixels from which another thread is worth waking.
_WORTH_A_THREAD = 2**16
_FLOOR = 1e-30  # variance below which a target counts as noise-free: every change is seen


@dataclass(frozen=True, eq=False)
class _Bins:
    """Pixels of each plane (rows) in bins of similar light (columns), each (4, B) float64.

    Args:
        share: Share of all pixels.
        light: Mean of the light, at least 0.
        edges: Least and most light in the bin, at least 0: (2, 4, B).
        disc: Mean square of the Laplacian.
        row: Mean square of the second difference along the rows.
    """

    share: np.ndarray
    light: np.ndarray
    edges: np.ndarray
    disc: np.ndarray
    row: np.ndarray


class LightStatistics:
    """Levels and curvature of a light; nothing is computed before it is first asked for.

    Errors are in units of the target's noise: the root mean square over the pixels of
    ``sqrt(dm^2 + ds^2) / s``, where dm and ds are what a pixel's mean and standard deviation move
    by and s is the standard deviation that it should have.

    The first answer takes a pass over the pixels, the others a few microseconds each.

    Args:
        light: (4, H, W) linear light at the reference exposure.
    """

    def __init__(self, light: torch.Tensor) -> None:
        self.light = light

    def __reduce__(self) -> tuple[type[LightStatistics], tuple[torch.Tensor]]:
        return LightStatistics, (self.light,)

    @functools.cached_property
    def median(self) -> np.ndarray:
        """(4,) median light of each plane, at least 0; of a sample where there are many pixels."""
        middle = self._sorted.shape[1] // 2
        return np.maximum(self._sorted[:, [middle, -middle - 1]].mean(axis=1), 0.0)

    def excess(self, ratio: float, source: NoiseLevelFunction, target: NoiseLevelFunction) -> float:
        """Error of a source's noise that is left where it exceeds the target's, rather too high.

        Args:
            ratio: Exposure ratio from the light to the target.
            source: Noise of the light, at its own exposure.
            target: Noise that the capture should have.
        """
        if source.is_zero:
            return 0.0
        from simulator.statistics_kernels import excess  # numba: only where it is needed

        bins = self._bins
        # Mean of the squares at both edges of a bin: in between it is monotonic, mostly convex.
        noises = _numbers(source), _numbers(target)
        return float(excess(bins.share, bins.edges, float(ratio), *noises, _FLOOR))

    def blur_error(
        self,
        ratio: float,
        target: NoiseLevelFunction,
        motion_px: float | np.ndarray = 0.0,
        disc_px: float | np.ndarray = 0.0,
    ) -> float | np.ndarray:
        """Bound on the error of leaving out a streak and a disc, of one or of many extents.

        A symmetric kernel with second moment m per axis moves the light by at most m / 2 times its
        discrete Laplacian, in the root mean square: ``1 - cos(k t) <= k^2 (1 - cos t)``.

        Args:
            ratio: Exposure ratio from the light to the target.
            target: Noise that the capture should have.
            motion_px: Length of the streak along the rows [pixel].
            disc_px: Diameter of the disc [pixel].
        """
        disc, row = self.curvature(ratio, target)
        return disc * disc_px * disc_px + row * motion_px * motion_px

    def curvature(self, ratio: float, target: NoiseLevelFunction) -> tuple[float, float]:
        """`blur_error` of a disc of one pixel and of a streak of one pixel; others go with the
        square of their extent."""
        from simulator.statistics_kernels import curvature

        bins = self._bins
        # The darkest pixel of a bin stands for all of it: errors are stated too high, not too low.
        squares = bins.edges[0], bins.disc, bins.row
        disc, row = curvature(bins.share, *squares, float(ratio), _numbers(target), _FLOOR)
        return abs(ratio) / 32.0 * disc, abs(ratio) / 24.0 * row  # m = d^2 / 16 and e^2 / 12

    def relative_level(self, ratio: float, target: NoiseLevelFunction) -> float:
        """Root mean square of the signal in units of the target's noise."""
        signal = self._bins.light * ratio
        wanted = np.maximum(_variance(signal, target), _FLOOR)
        return _root_mean(self._bins.share, signal**2 / wanted)

    def relative_noise(
        self, ratio: float, source: NoiseLevelFunction, target: NoiseLevelFunction
    ) -> float:
        """Root mean square of the exposed source's noise in units of the target's."""
        signal = self._bins.light * ratio
        wanted = np.maximum(_variance(signal, target), _FLOOR)
        return _root_mean(self._bins.share, _variance(signal, source.exposed(ratio)) / wanted)

    def relative_excess(
        self, ratio: float, source: NoiseLevelFunction, target: NoiseLevelFunction
    ) -> float:
        """Mean over the pixels of the variance that `source` brings beyond the target's.

        Relative to the target's. Other than in `excess`, `source` is on the target's scale,
        averaged by what blur there is.
        """
        signal = self._bins.light * ratio
        wanted = np.maximum(_variance(signal, target), _FLOOR)
        beyond = np.maximum(_variance(signal, source) / wanted - 1.0, 0.0)
        return float(np.vdot(self._bins.share, beyond))

    @property
    def _rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Light (4, R, W) with the rows that are looked at and their neighbours, and their places.

        Whole rows: every column counts alike whatever the width, and a row is read at once.
        """
        height, width = self.light.shape[-2:]
        step = max(1, math.ceil(height * width / SAMPLES))
        if step == 1:
            return self.light.cpu().numpy(), np.arange(height)
        rows = torch.arange(min(step, height) // 2, height, step)
        around = torch.stack([(rows - 1).clamp(min=0), rows, (rows + 1).clamp(max=height - 1)], 1)
        picked = self.light[:, around.flatten().to(self.light.device)].cpu().numpy()
        return picked, np.arange(1, picked.shape[1], 3)

    @functools.cached_property
    def _sorted(self) -> np.ndarray:
        """(4, S) light of some pixels of each plane, ascending; every column counts alike."""
        light, rows = self._rows
        seen = light[:, rows].reshape(4, -1)
        step = max(1, seen.shape[1] // _SORTED)
        while math.gcd(step, light.shape[-1]) > 1:
            step += 1
        return np.sort(seen[:, ::step], axis=1)

    @functools.cached_property
    def _bins(self) -> _Bins:
        from simulator.statistics_kernels import accumulate  # numba: only where it is needed

        light, rows = self._rows
        samples = len(rows) * light.shape[-1]
        edges = self._sorted[:, np.arange(1, BINS) * self._sorted.shape[1] // BINS]
        sums, levels = np.zeros((4, 4, BINS)), np.zeros((2, 4, BINS))
        levels[0] = np.inf
        least = 1 + _WORTH_A_THREAD // samples
        fixed = (light, rows, np.ascontiguousarray(edges), sums, levels)
        in_shares(lambda first, last: accumulate(first, last, *fixed), 4, least=least)
        counts = np.maximum(sums[0], 1.0)  # equal light leaves bins empty: they have no share
        return _Bins(
            share=sums[0] / (4.0 * samples),
            light=sums[1] / counts,
            edges=np.where(sums[0] > 0, levels, 0.0),
            disc=sums[2] / counts,
            row=sums[3] / counts,
        )


def _variance(signal: np.ndarray, nlf: NoiseLevelFunction) -> np.ndarray:
    shot, read = _numbers(nlf)[..., None]
    return read + shot * signal


@functools.lru_cache(maxsize=256)
def _numbers(nlf: NoiseLevelFunction) -> np.ndarray:
    """(2, 4) shot and read noise of the planes."""
    return np.array([nlf.shot, nlf.read])


def _root_mean(weight: np.ndarray, square: np.ndarray) -> float:
    return math.sqrt(float(np.vdot(weight, square)))
