"""Statistics of a light, from which the errors of a capture are predicted.

`LightStatistics` predicts the errors of steps that are left out, `ResidualStatistics` those of a
denoising network: the noise that it leaves, and the detail that it takes for noise. Both are, in
units of the noise, functions of how well noise and detail can be told apart: of the error that the
best linear filter would make. They are measured once for each network, on pictures that it was not
trained on, and are part of its weights' card.
"""

from __future__ import annotations

import functools
import math
import reprlib
import threading
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.raw.image import check_packed
from simulator.utils.compute import kernel, parallel_ranges

#: Bins of about equal population per plane, a power of two; pixels of a plane that are sampled, at
#: most.
BINS = 64
SAMPLES = 65_536
#: Pixels of a plane that are sorted to find the bins, at most about this many.
_SORTED = 4096
#: Pixels from which another thread is worth waking.
_WORTH_A_THREAD = 2**16
#: Variance of the Laplacian of noise of variance 1: 4^2 + 4.
_LAPLACIAN = 20.0
#: Light is above white for sure where it is so by this many standard deviations of its noise.
SURE = 4.0
_FLOOR = 1e-30  # variance below which a target counts as noise-free: every change is seen
#: Side of a block, over which light is averaged, and of a window, over which detail is [packed
#: pixel]; blocks that are sampled, at most about this many.
BLOCK, _WINDOW, _BLOCKS = 8, 32, 16384
#: Relative variance of the Laplacian's square: twice the squared autocorrelation, over as many
#: samples.
_CHANCE = 2.0 * (20.0**2 + 4 * 8.0**2 + 4 * 2.0**2 + 4 * 1.0**2) / 20.0**2
#: Shares of white noise in octaves of detail, from the finest: 3/4, 3/16, ..., and what is coarser.
_OCTAVES = (0.75, 0.1875, 0.046875, 0.015625)
#: What the Wiener error of a window of noise alone comes to by chance.
_LEAST = 0.003
#: A frame of n pixels keeps at least this many nths of its noise, however smooth it is.
_FEW = 2.0
#: Levels of light that blocks are gathered into, for quick answers.
LEVELS = 24
_TABLES = ("wiener_error", "bias", "variance")
#: Rounding error of float32 in a transition, as a share of the light.
ROUNDING = 2.0**-20
#: Points between white in the source and in a darker capture at which its light is integrated.
_NODES = 1024
#: Floating-point rules of sums over bins.
SUMS = {"reassoc", "nnan", "nsz", "contract"}


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
def _accumulate(first, last, light, rows, edges, bins):  # type: ignore[no-untyped-def]
    """Adds each pixel of some rows of light (P, H, W) to the bin of its light, by `edges` (P, B-1).

    `bins` (P, B, 6), where what is known of a bin lies together: number, least and most light of at
    least 0, sum of that, and of squares of the Laplacian, and of second differences along the row.
    """
    _, height, width = light.shape
    indices = np.empty(width, np.uint32)
    for plane in range(first, last):
        limits, own = edges[plane], bins[plane]
        for y in rows:
            centre = light[plane, y]
            above, below = light[plane, max(y - 1, 0)], light[plane, min(y + 1, height - 1)]
            _find(centre, limits, indices)
            for x in range(width):
                value = centre[x]
                found = own[indices[x]]
                twice = 2.0 * np.float64(value)
                left, right = centre[max(x - 1, 0)], centre[min(x + 1, width - 1)]
                along = np.float64(left) + np.float64(right) - twice
                across = np.float64(above[x]) + np.float64(below[x]) - twice
                level = max(np.float64(value), 0.0)
                found[0] += 1.0
                found[1] = min(found[1], level)
                found[2] = max(found[2], level)
                found[3] += level
                found[4] += (along + across) ** 2
                found[5] += along * along


@kernel(fastmath=SUMS, boundscheck=False)
def excess_error(share, edges, ratio, source, target):  # type: ignore[no-untyped-def]
    """Error of leaving a source's noise where it exceeds the target's, rather too high.

    Over bins. Noises are (2, P) shot and read: that of the `source` at its own exposure, and that
    which the `target` should have; `ratio` is the exposure of the target over the source's.
    """
    total = 0.0  # squares at both edges of a bin: in between it is monotonic, mostly convex
    for plane in range(share.shape[0]):
        source_shot = source[0, plane] * ratio * ratio
        source_read = source[1, plane] * ratio * ratio
        shot, read = target[0, plane] * ratio, target[1, plane]
        for edge in range(2):
            light, shares = edges[edge, plane], share[plane]
            for index in range(len(shares)):
                wanted = read + shot * light[index]
                given = source_read + source_shot * light[index]
                shows = ratio * light[index] - SURE * np.sqrt(given) <= 1.0
                beyond = np.sqrt(given / (wanted if wanted > _FLOOR else _FLOOR)) - 1.0
                beyond = beyond if beyond > 0.0 and shows else 0.0
                total += shares[index] * beyond * beyond
    return np.sqrt(total / 2.0)


@kernel(fastmath=SUMS, boundscheck=False)
def curvature(columns, ratio, target):  # type: ignore[no-untyped-def]
    """Bounds on the errors of leaving out a disc, and a streak along the rows, of one pixel.

    Of `LightStatistics.columns`. Others go with the square of their extent. A symmetric kernel with
    second moment m per axis moves the light by at most m / 2 times its discrete Laplacian, in the
    root mean square: ``1 - cos(k t) <= k^2 (1 - cos t)``. See `excess_error` for the noise.
    """
    discs, rows = 0.0, 0.0
    for plane in range(columns.shape[1]):
        shot, read = target[0, plane], target[1, plane]
        for index in range(columns.shape[2]):
            wanted = read + shot * ratio * columns[1, plane, index]
            wanted = wanted if wanted > _FLOOR else _FLOOR
            # What the mean moves by, and with it the deviation of shot noise.
            weight = columns[0, plane, index] * (1.0 + shot * shot / wanted) / wanted
            discs += weight * columns[2, plane, index]
            rows += weight * columns[3, plane, index]
    # m = d^2 / 16 and e^2 / 12
    return abs(ratio) / 32.0 * np.sqrt(discs), abs(ratio) / 24.0 * np.sqrt(rows)


@kernel(fastmath=SUMS, boundscheck=False)
def relative_level(share, light, ratio, target):  # type: ignore[no-untyped-def]
    """Root mean square of the signal in units of the target's noise, over bins."""
    total = 0.0
    for plane in range(share.shape[0]):
        for index in range(share.shape[1]):
            signal = light[plane, index] * ratio
            wanted = max(target[1, plane] + target[0, plane] * signal, _FLOOR)
            total += share[plane, index] * signal * signal / wanted
    return np.sqrt(total)


@kernel(fastmath=SUMS, boundscheck=False)
def variance_beyond(share, light, ratio, source, target, least):  # type: ignore[no-untyped-def]
    """Mean of the variance of `source`, relative to the target's, beyond the `least`.

    Over bins; noises are (2, P) shot and read, on the target's scale.
    """
    total = 0.0
    for plane in range(share.shape[0]):
        for index in range(share.shape[1]):
            signal = light[plane, index] * ratio
            wanted = max(target[1, plane] + target[0, plane] * signal, _FLOOR)
            beyond = (source[1, plane] + source[0, plane] * signal) / wanted - least
            total += share[plane, index] * max(beyond, 0.0)
    return total


@kernel(fastmath=SUMS, boundscheck=False)
def blur_change(share, light, disc, ratio, source, target, noise):  # type: ignore[no-untyped-def]
    """What a disc of one pixel changes, in units of the target's noise; other than in `curvature`
    estimated, not bounded: the noise of the light itself is taken out.

    With `noise` a capture is wanted, in which what is surely white shows no change.
    """
    total = 0.0
    for plane in range(share.shape[0]):
        for index in range(share.shape[1]):
            level = light[plane, index]
            own = source[1, plane] + source[0, plane] * level
            wanted = max(target[1, plane] + target[0, plane] * level * ratio, _FLOOR)
            shows = not noise or ratio * (level - SURE * np.sqrt(own)) <= 1.0
            detail = max(disc[plane, index] - _LAPLACIAN * own, 0.0) if shows else 0.0
            total += share[plane, index] * detail / wanted
    return abs(ratio) / 32.0 * np.sqrt(total)


@kernel()
def hidden_highlights(ratio, target, share, estimate):  # type: ignore[no-untyped-def]
    """Error of what a `share` of the samples, clipped in the source, would show when darker.

    Light above white is taken to be distributed as natural highlights are, with a density that
    falls with its square; it is shown as `estimate`. The share `ratio` of it stays white. `target`
    is (2, P) shot and read noise.
    """
    if share == 0.0 or not 0.0 < ratio < 1.0:
        return 0.0
    shown, shot, read = min(estimate * ratio, 1.0), target[0].mean(), target[1].mean()
    step = ratio ** (1.0 / _NODES)  # evenly spaced in the logarithm of light
    light, square = math.sqrt(step), 0.0
    for _ in range(_NODES):
        square += (light - shown) ** 2 / max(shot * light + read, _FLOOR) * (ratio / light)
        light *= step
    white = ratio * (1.0 - shown) ** 2 / max(shot + read, _FLOOR)
    return math.sqrt(share * (white - math.log(ratio) * square / _NODES))


# -- the statistics ---------------------------------------------------------------------------


class LightStatistics:
    """Noise and curvature of a light (4, H, W), by its levels; a pass when first needed."""

    def __init__(self, light: torch.Tensor) -> None:
        self.light = light

    @functools.cached_property
    def columns(self) -> np.ndarray:
        """(4, P, B): share, light, and squared second differences of bins, for `curvature`."""
        # The darkest pixel of a bin stands for all of it: errors are stated too high, not too low.
        return self.bins[[0, 1, 4, 5]]

    @functools.cached_property
    def bins(self) -> np.ndarray:
        """(6, P, B): share, least, most and mean light, and squared second differences of bins."""
        light, (height, width) = self.light.detach().cpu().numpy(), self.light.shape[-2:]
        # Whole rows: every column counts alike whatever the width, and a row is read at once.
        step = math.ceil(height * width / SAMPLES)
        rows = np.arange(min(step, height) // 2, height, step)
        samples = len(rows) * width
        step = max(1, samples // _SORTED)
        while math.gcd(step, width) > 1:  # every column counts alike
            step += 1
        ordered = np.sort(light[:, rows].reshape(4, -1)[:, ::step], axis=1)
        limits = ordered[:, np.arange(1, BINS) * ordered.shape[1] // BINS]
        bins = np.zeros((4, BINS, 6))
        bins[..., 1] = np.inf
        least = 1 + _WORTH_A_THREAD // samples
        fixed = (light, rows, np.ascontiguousarray(limits), bins)
        parallel_ranges(lambda first, last: _accumulate(first, last, *fixed), 4, least=least)
        found = np.ascontiguousarray(np.moveaxis(bins, 2, 0))
        found[1, found[0] == 0.0] = 0.0  # equal light leaves bins empty
        found[3:] /= np.maximum(found[0], 1.0)
        found[0] /= 4.0 * samples
        return found


# -- errors of networks -----------------------------------------------------------------------


def wiener_error(light: torch.Tensor, nlf: NoiseLevelFunction) -> torch.Tensor:
    """Mean square error of the best linear filter, in units of the noise's variance.

    Where detail has S times the energy of the noise, the Wiener filter's error is S / (1 + S) of
    the noise. S is estimated for each octave from the energy of the Laplacian of the light averaged
    over 1, 2, 4 and 8 pixels, all planes together, in windows of 32 x 32 pixels.

    `light` is (4, H, W) as recorded, `nlf` its noise, not zero; the result (H // 8, W // 8) in
    [0, 1], alike within a window, and one block for a frame of fewer pixels.
    """
    size = light.shape[-2:]
    window = tuple(min(_WINDOW, n) for n in size)
    shot, read = (torch.tensor(v)[:, None, None].to(light) for v in (nlf.shot, nlf.read))
    noise = F.avg_pool2d(light, window).clamp_(min=0.0).mul_(shot).add_(read).clamp_(min=_FLOOR)
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


@dataclass(frozen=True, eq=False)
class Residual:
    """Error of one network in units of the standard deviation of the noise that it removes."""

    wiener_error: np.ndarray  # (K,) ascending values of `wiener_error`
    bias: np.ndarray  # (K,) mean square of the systematic error: detail that is taken for noise
    variance: np.ndarray  # (K,) mean variance of what comes out: noise that is left
    spread: float  # factor on a predicted error below which 90 % of the measured ones are

    @classmethod
    def alike(cls, error: float) -> Residual:
        """The same systematic `error` whatever the light."""
        return cls(np.array([0.0, 1.0]), np.full(2, error**2), np.zeros(2), 1.0)

    @classmethod
    def from_card(cls, values: Mapping[str, Any]) -> Residual:
        """Of the numbers in a model card; a `ValueError` if they are none."""
        try:
            tables, spread = np.array([values[n] for n in _TABLES], float), float(values["spread"])
        except (KeyError, TypeError, ValueError, OverflowError):
            tables, spread = np.full((3, 1), math.nan), math.nan
        known = tables.ndim == 2 and tables.shape[1] > 1 and bool((tables >= 0.0).all())
        if not known or not max(tables.max(), spread) < math.inf or not spread >= 1.0:
            rule = f"{', '.join(_TABLES)}, of one length, finite and >= 0, and a spread >= 1"
            raise ValueError(f"`residual` (={reprlib.repr(values)}) must have {rule}")
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
def network_error(bias, variance, level, share, ratio, source, target, noise):  # type: ignore[no-untyped-def]
    """`ResidualStatistics.error`, over levels of light; bias and variance are the network's."""
    total = 0.0
    for plane in range(level.shape[0]):
        for index in range(level.shape[1]):
            light = level[plane, index]
            own = source[0, plane] * light + source[1, plane]
            wanted = target[0, plane] * light * ratio + target[1, plane]
            relative = own * ratio * ratio / (wanted if wanted > _FLOOR else _FLOOR)
            left = variance[plane, index] * relative
            if noise:
                if ratio * (light - SURE * np.sqrt(own)) > 1.0:
                    continue
                beyond = np.sqrt(1.0 + left) - 1.0
                left = beyond * beyond
            total += share[plane, index] * (bias[plane, index] * relative + left)
    return np.sqrt(total)


class ResidualStatistics:
    """Predicts the errors of networks on one recorded light, for any target.

    As fast as `LightStatistics`; of a large frame, some rows of blocks are looked at. `nlf` is the
    noise of `light` (4, H, W) as recorded.
    """

    def __init__(self, light: torch.Tensor, nlf: NoiseLevelFunction) -> None:
        self.light, self.nlf = light, nlf
        self._gathered: dict[Residual, np.ndarray] = {}

    def error(
        self, residual: Residual, ratio: float, target: NoiseLevelFunction, *, noise: bool = True
    ) -> float:
        """Error of a capture that starts from the light denoised by the network of `residual`.

        Without `noise` the light alone is wanted, in which noise that is left is an error in full;
        the other arguments are those of `LightStatistics`.
        """
        noises = (np.array([nlf.shot, nlf.read]) for nlf in (self.nlf, target))
        return float(network_error(*self.columns(residual), float(ratio), *noises, noise))

    def columns(self, residual: Residual) -> np.ndarray:
        """(4, P, L): squared bias and variance of a network, light and share of each level."""
        if residual not in self._gathered:
            wiener, place, counts, *levels = self._measured
            errors = (_by_level(v, place, counts) for v in residual.at(wiener))
            self._gathered[residual] = np.stack([*errors, *levels])
        return self._gathered[residual]

    @functools.cached_property
    def _measured(self) -> tuple[np.ndarray, ...]:
        """Wiener error (N,) and level (4, N) of blocks; number, light and share of each level."""
        (height, width), parts = self.light.shape[-2:], [self.light]
        blocks = max(1, height // BLOCK) * max(1, width // BLOCK)
        if blocks > _BLOCKS and height >= 2 * _WINDOW:  # bands of rows that are sampled
            tops = range(0, height - _WINDOW + 1, _WINDOW * math.ceil(blocks / _BLOCKS))
            parts = [self.light[:, top : top + _WINDOW] for top in tops]
        error = torch.cat([wiener_error(part, self.nlf).flatten() for part in parts])
        block = tuple(min(BLOCK, n) for n in parts[0].shape[-2:])
        means = [F.avg_pool2d(part, block).flatten(1) for part in parts]
        light = torch.cat(means, dim=1).clamp_(min=0.0)
        values = light.double().cpu().numpy()
        order = np.argsort(np.argsort(values, axis=1), axis=1)
        place = order * LEVELS // values.shape[1]
        counts = np.stack([np.bincount(p, minlength=LEVELS) for p in place])
        known = place, counts, _by_level(values, place, counts), counts / counts.sum()
        return error.double().cpu().numpy(), *known


def _by_level(values: np.ndarray, place: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """(4, L) means of `values` of blocks, (4, N) or (N,) for all planes, by their level."""
    each = zip(place, np.broadcast_to(values, place.shape), strict=True)
    return np.stack([np.bincount(p, v, LEVELS) for p, v in each]) / np.maximum(counts, 1)


@dataclass(eq=False, repr=False)
class DenoisedLight:
    """Light with its noise removed by a noise module.

    The network, the most expensive step there is, runs when `light` is first read.
    """

    _light: torch.Tensor | Callable[[], torch.Tensor]  # (4, H, W) float32, or what works it out
    _: KW_ONLY
    name: str = "network"
    residual: Residual | None = None  # error of the network; None where that was not measured
    rounding: Residual | None = None  # what bfloat16 changes; None where it ran in float32
    operations: int = 0  # arithmetic operations that it takes, all pixels together
    seconds: Callable[[], float] = float  # estimates how long that takes on this machine
    everywhere: bool = True  # whether also where a positive tolerance needs no network

    def __post_init__(self) -> None:
        if isinstance(self._light, torch.Tensor):
            self._light = check_packed("denoised", self._light)
        self._lock = threading.RLock()

    def __reduce__(self) -> tuple[Callable[..., DenoisedLight], tuple[torch.Tensor]]:
        names = ("name", "residual", "rounding", "operations", "everywhere")
        known = {name: getattr(self, name) for name in names}
        return functools.partial(DenoisedLight, **known), (self.light,)

    @property
    def light(self) -> torch.Tensor:
        """(4, H, W) at the exposure of the source."""
        with self._lock:
            if not isinstance(self._light, torch.Tensor):
                self._light = self._light()
            return self._light

    @property
    def shape(self) -> torch.Size | None:
        """Shape of `light`, where it is known already."""
        return self._light.shape if isinstance(self._light, torch.Tensor) else None

    @functools.cached_property
    def statistics(self) -> LightStatistics:
        """Statistics of `light`."""
        return LightStatistics(self.light)

    def to(self, device: torch.device) -> DenoisedLight:
        """The same on `device`; itself where it is there already."""
        light = self._light
        if isinstance(light, torch.Tensor) and light.device == device:
            return self
        return replace(self, _light=lambda: self.light.to(device))
