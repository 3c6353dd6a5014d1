"""Statistics of a light, from which the errors of leaving steps out are worked out."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import torch

from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.utils.compute import kernel, parallel_ranges

#: Bins of about equal population per plane, and pixels of a plane that are looked at, at most.
BINS = 64
SAMPLES = 65_536
#: Pixels of a plane that are sorted for bins and median, at most about this many.
_SORTED = 4096
#: Pixels from which another thread is worth waking.
_WORTH_A_THREAD = 2**16
#: Variance of the Laplacian of noise of variance 1: 4^2 + 4.
_LAPLACIAN = 20.0
#: Light is above white for sure where it is so by this many standard deviations of its noise.
SURE = 4.0
_FLOOR = 1e-30  # variance below which a target counts as noise-free: every change is seen


# -- sums over pixels, and over bins of pixels ------------------------------------------------


@kernel()
def _find(values, limits, indices):  # type: ignore[no-untyped-def]
    """Number of `limits` that each value reaches; they are a full tree, ascending.

    Values come in any order: a branch would be mispredicted half of the time.
    """
    indices[:] = 0
    step = (len(limits) + 1) // 2
    while step:
        for x in range(len(values)):
            reached = values[x] >= limits[indices[x] + np.uint32(step - 1)]
            indices[x] += np.uint32(step) * np.uint32(reached)
        step //= 2


@kernel()
def _accumulate(first, last, light, rows, edges, sums, levels):  # type: ignore[no-untyped-def]
    """Adds each pixel of some rows to the bin of its light.

    Args:
        first, last: Planes that are looked at, `last` exclusive.
        light: (P, H, W) float32; borders are replicated.
        rows: (R,) int64 of the rows.
        edges: (P, B - 1) float32, ascending: from which light on a pixel belongs to the next bin.
        sums: (4, P, B) float64 that are added to: number, light of at least 0, square of the
            Laplacian, square of the second difference along the row.
        levels: (2, P, B) float64: least and most light, at least 0.
    """
    _, height, width = light.shape
    half = 1
    while 2 * half <= edges.shape[1]:
        half *= 2
    limits = np.full(2 * half - 1, np.inf, np.float32)
    indices = np.empty(width, np.uint32)
    bins = np.empty((2 * half, 6))
    for plane in range(first, last):
        for index in range(edges.shape[1]):  # an array's copy takes a second more to compile
            limits[index] = edges[plane, index]
        bins[:] = 0.0  # what is known of a bin lies together
        bins[:, 4] = np.inf
        for y in rows:
            centre = light[plane, y]
            above, below = light[plane, max(y - 1, 0)], light[plane, min(y + 1, height - 1)]
            _find(centre, limits, indices)
            for x in range(width):
                value = centre[x]
                found = bins[indices[x]]
                twice = 2.0 * np.float64(value)
                left, right = centre[max(x - 1, 0)], centre[min(x + 1, width - 1)]
                along = np.float64(left) + np.float64(right) - twice
                across = np.float64(above[x]) + np.float64(below[x]) - twice
                level = max(np.float64(value), 0.0)
                found[0] += 1.0
                found[1] += level
                found[2] += (along + across) ** 2
                found[3] += along * along
                found[4] = min(found[4], level)
                found[5] = max(found[5], level)
        for index in range(sums.shape[2]):
            for kind in range(4):
                sums[kind, plane, index] += bins[index, kind]
            levels[0, plane, index] = min(levels[0, plane, index], bins[index, 4])
            levels[1, plane, index] = max(levels[1, plane, index], bins[index, 5])


#: Floating-point rules of sums over bins.
SUMS = {"reassoc", "nnan", "nsz", "contract"}


@kernel(fastmath=SUMS, boundscheck=False)
def _excess_error(share, edges, ratio, source, target, floor, sure):  # type: ignore[no-untyped-def]
    """`LightStatistics.excess_error` of bins.

    Args:
        share: (P, B) share of all pixels.
        edges: (2, P, B) least and most light.
        ratio: Exposure ratio.
        source: (2, P) shot and read noise of the light.
        target: (2, P) shot and read noise that are wanted.
        floor: Least variance that counts as noise.
        sure: Standard deviations of the source's noise above white from which a bin is white.
    """
    total = 0.0
    for plane in range(share.shape[0]):
        source_shot, source_read = (
            source[0, plane] * ratio * ratio,
            source[1, plane] * ratio * ratio,
        )
        shot, read = target[0, plane] * ratio, target[1, plane]
        for edge in range(2):
            light, shares = edges[edge, plane], share[plane]
            for index in range(len(shares)):
                wanted = read + shot * light[index]
                given = source_read + source_shot * light[index]
                shows = ratio * light[index] - sure * np.sqrt(given) <= 1.0
                beyond = np.sqrt(given / (wanted if wanted > floor else floor)) - 1.0
                beyond = beyond if beyond > 0.0 and shows else 0.0
                total += shares[index] * beyond * beyond
    return np.sqrt(total / 2.0)


@kernel(fastmath=SUMS, boundscheck=False)
def _curvature(share, light, disc, row, ratio, target, floor):  # type: ignore[no-untyped-def]
    """Root mean squares over bins of second differences in units of a target's noise.

    Args:
        share: (P, B) share of all pixels.
        light: (P, B) level that stands for the bin.
        disc, row: (P, B) mean squares of the Laplacian and of the second difference along a row.
        ratio: Exposure ratio.
        target: (2, P) shot and read noise that are wanted.
        floor: Least variance that counts as noise.
    """
    discs, rows = 0.0, 0.0
    for plane in range(share.shape[0]):
        shot, read = target[0, plane], target[1, plane]
        for index in range(share.shape[1]):
            wanted = read + shot * ratio * light[plane, index]
            wanted = wanted if wanted > floor else floor
            # What the mean moves by, and with it the deviation of shot noise.
            weight = share[plane, index] * (1.0 + shot * shot / wanted) / wanted
            discs += weight * disc[plane, index]
            rows += weight * row[plane, index]
    return np.sqrt(discs), np.sqrt(rows)


# -- the statistics ---------------------------------------------------------------------------


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

    def excess_error(
        self, ratio: float, source: NoiseLevelFunction, target: NoiseLevelFunction
    ) -> float:
        """Error of leaving a source's noise where it exceeds the target's, rather too high.

        Args:
            ratio: Exposure ratio from the light to the target.
            source: Noise of the light, at its own exposure.
            target: Noise that the capture should have.
        """
        if source.is_zero:
            return 0.0
        bins = self._bins
        # Mean of the squares at both edges of a bin: in between it is monotonic, mostly convex.
        noises = noise_numbers(source), noise_numbers(target)
        return float(_excess_error(bins.share, bins.edges, float(ratio), *noises, _FLOOR, SURE))

    def curvature(self, ratio: float, target: NoiseLevelFunction) -> tuple[float, float]:
        """Bounds on the errors of leaving out a disc, and a streak along the rows, of one pixel.

        Others go with the square of their extent. A symmetric kernel with second moment m per axis
        moves the light by at most m / 2 times its discrete Laplacian, in the root mean square:
        ``1 - cos(k t) <= k^2 (1 - cos t)``.

        Args:
            ratio: Exposure ratio from the light to the target.
            target: Noise that the capture should have.
        """
        bins = self._bins
        # The darkest pixel of a bin stands for all of it: errors are stated too high, not too low.
        squares = bins.edges[0], bins.disc, bins.row
        disc, row = _curvature(bins.share, *squares, float(ratio), noise_numbers(target), _FLOOR)
        return abs(ratio) / 32.0 * disc, abs(ratio) / 24.0 * row  # m = d^2 / 16 and e^2 / 12

    def blur_change(
        self,
        ratio: float,
        source: NoiseLevelFunction,
        target: NoiseLevelFunction,
        *,
        noise: bool = True,
    ) -> float:
        """What a disc of one pixel changes, in units of the target's noise; other than in
        `curvature` estimated, not bounded: the noise of the light itself is taken out.

        Args:
            ratio: Exposure ratio from the light to the target.
            source: Noise of the light, at its own exposure.
            target: Noise that the capture should have.
            noise: Whether a capture is wanted, in which what is surely white shows no change.
        """
        bins = self._bins
        own = _variance(bins.light, source)
        wanted = np.maximum(_variance(bins.light * ratio, target), _FLOOR)
        detail = np.maximum(bins.disc - _LAPLACIAN * own, 0.0)
        if noise:
            detail = np.where(ratio * (bins.light - SURE * np.sqrt(own)) > 1.0, 0.0, detail)
        return abs(ratio) / 32.0 * _root_mean(bins.share, detail / wanted)

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

    def relative_excess_variance(
        self, ratio: float, source: NoiseLevelFunction, target: NoiseLevelFunction
    ) -> float:
        """Mean over the pixels of the variance that `source` brings beyond the target's.

        Relative to the target's. Other than in `excess_error`, `source` is on the target's scale,
        averaged by what blur there is.
        """
        signal = self._bins.light * ratio
        wanted = np.maximum(_variance(signal, target), _FLOOR)
        beyond = np.maximum(_variance(signal, source) / wanted - 1.0, 0.0)
        return float(np.vdot(self._bins.share, beyond))

    @property
    def _rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Light (4, R, W): rows that are looked at and their neighbours; and which they are.

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
        light, rows = self._rows
        samples = len(rows) * light.shape[-1]
        edges = self._sorted[:, np.arange(1, BINS) * self._sorted.shape[1] // BINS]
        sums, levels = np.zeros((4, 4, BINS)), np.zeros((2, 4, BINS))
        levels[0] = np.inf
        least = 1 + _WORTH_A_THREAD // samples
        fixed = (light, rows, np.ascontiguousarray(edges), sums, levels)
        parallel_ranges(lambda first, last: _accumulate(first, last, *fixed), 4, least=least)
        counts = np.maximum(sums[0], 1.0)  # equal light leaves bins empty: they have no share
        return _Bins(
            share=sums[0] / (4.0 * samples),
            light=sums[1] / counts,
            edges=np.where(sums[0] > 0, levels, 0.0),
            disc=sums[2] / counts,
            row=sums[3] / counts,
        )


def _variance(signal: np.ndarray, nlf: NoiseLevelFunction) -> np.ndarray:
    shot, read = noise_numbers(nlf)[..., None]
    return read + shot * signal


@functools.lru_cache(maxsize=256)
def noise_numbers(nlf: NoiseLevelFunction) -> np.ndarray:
    """(2, 4) shot and read noise of the planes."""
    return np.array([nlf.shot, nlf.read])


def _root_mean(weight: np.ndarray, square: np.ndarray) -> float:
    return math.sqrt(float(np.vdot(weight, square)))
