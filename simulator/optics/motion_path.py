"""Motion along a path: how an image moves while the shutter is open, and the blur that this makes.

The shake of a camera has a direction that turns; a subject may move of its own besides. The part of
the path that is traversed during an exposure is rasterised into a few weighted shifts (taps), whose
sum is the blurred image. Taps are widened as the streaks of `simulator.optics.shapes` are: along
both axes their second moment is that of the path. Borders are replicated.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from simulator.optics.shapes import streak_share
from simulator.utils.jit import kernel
from simulator.utils.threads import in_shares

#: Points of a path, per pixel of its length and at most: longer ones are sampled more coarsely.
_POINTS_PER_PIXEL, _MOST_POINTS = 2.0, 1024
#: Points that the length of a path is summed over.
_LENGTH_POINTS = 32
#: Products of a tap and a sample from which another thread is worth waking.
_WORTH_A_THREAD = 2**22
_jit = functools.partial(kernel, fastmath={"contract"})


@dataclass(frozen=True)
class Movement:
    """How an image moves, apart from the speed of its shake; by default along the rows.

    Args:
        direction: Of the shake when the shutter opens [rad]; 0 is along the rows, pi / 2 down.
        turn: Rate at which that direction turns [rad/s].
        subject_speed: Own speed of the subject [frame heights per second], beside the shake.
        subject_direction: Its direction [rad].
    """

    direction: float = 0.0
    turn: float = 0.0
    subject_speed: float = 0.0
    subject_direction: float = 0.0

    def __post_init__(self) -> None:
        numbers = (self.direction, self.turn, self.subject_speed, self.subject_direction)
        if not all(math.isfinite(number) for number in numbers) or self.subject_speed < 0.0:
            raise ValueError(f"`movement` (={self}) must be finite, its `subject_speed` >= 0")

    @property
    def along_rows(self) -> bool:
        """Whether the shake makes a straight streak along the rows."""
        return self.turn == 0.0 and self.direction in (0.0, math.pi, -math.pi)

    def path(self, speed: float, time: float, height: int) -> Path:
        """Path of the background, as the camera shakes.

        Args:
            speed: Of the shake [frame heights per second].
            time: That the shutter is open [s].
            height: Of the frame [pixel].
        """
        return Path(speed * time * height, self.direction, self.turn * time)

    def subject_path(self, speed: float, time: float, height: int) -> Path:
        """Path of the subject: that of the background and its own; see `path`."""
        own, angle = self.subject_speed * time * height, self.subject_direction
        shake = self.path(speed, time, height)
        return shake._replace(drift_x=own * math.cos(angle), drift_y=own * math.sin(angle))

    def subject_extent(self, speed: float, times: np.ndarray) -> np.ndarray:
        """Lengths of the subject's path [frame heights] in exposures of `times` (S,) [s]."""
        own, angle = self.subject_speed * times, self.subject_direction
        drift = own * math.cos(angle), own * math.sin(angle)
        return _length(speed * times, self.direction, self.turn * times, *drift)


#: That of an image which moves along the rows, wherever it has a speed.
ALONG_ROWS = Movement()


class Path(NamedTuple):
    """What is traversed during one exposure: an arc at steady speed, and a straight drift with it.

    Args:
        extent: Length of the arc [pixel].
        direction: In which it begins [rad].
        turn: By how much it turns in all [rad].
        drift_x: How far it drifts along the rows meanwhile [pixel].
        drift_y: The same down the columns [pixel].
    """

    extent: float
    direction: float = 0.0
    turn: float = 0.0
    drift_x: float = 0.0
    drift_y: float = 0.0

    @property
    def length(self) -> float:
        """Length of the whole path [pixel]."""
        if not (self.drift_x or self.drift_y):
            return self.extent
        return float(_length(*(np.asarray(value) for value in self)))


def _length(
    extent: np.ndarray,
    direction: float | np.ndarray,
    turn: np.ndarray,
    drift_x: np.ndarray,
    drift_y: np.ndarray,
) -> np.ndarray:
    """Lengths (...) of paths; the arguments are those of `Path`."""
    u = (np.arange(_LENGTH_POINTS) + 0.5) / _LENGTH_POINTS
    angle = direction + turn[..., None] * u
    x = extent[..., None] * np.cos(angle) + drift_x[..., None]
    y = extent[..., None] * np.sin(angle) + drift_y[..., None]
    return np.asarray(np.hypot(x, y).mean(axis=-1))


# -- taps -------------------------------------------------------------------------------------


class Taps(NamedTuple):
    """Weighted shifts, K of them.

    Args:
        rows: (K,) int64, by how many rows down each looks.
        columns: (K,) int64, by how many columns to the right.
        weights: (K,) float32, above 0; their sum is 1.
    """

    rows: np.ndarray
    columns: np.ndarray
    weights: np.ndarray

    @property
    def energy(self) -> float:
        """Sum of squared weights: the share of white noise's variance that is left."""
        return float((self.weights.astype(np.float64) ** 2).sum())


def path_points(path: Path) -> np.ndarray:
    """(2, N) y and x [pixel] of moments evenly spread over the exposure, their mean at 0."""
    count = math.ceil(min(max(_POINTS_PER_PIXEL * path.length, 8.0), _MOST_POINTS))
    u = (np.arange(count) + 0.5) / count
    half = 0.5 * path.turn * u
    # The chord of an arc: its length times sin(half) / half, in the mean of its directions.
    chord, angle = path.extent * u * np.sinc(half / np.pi), path.direction + half
    y = chord * np.sin(angle) + path.drift_y * u
    x = chord * np.cos(angle) + path.drift_x * u
    points = np.stack([y, x])
    return points - points.mean(axis=1, keepdims=True)


@functools.lru_cache(maxsize=256)
def path_taps(path: Path, height: int, width: int) -> Taps:
    """The taps of `path` on frames of `height` x `width` pixels.

    Shifts beyond the frame show its border whatever they are, so there are never more taps than the
    frame's outline is long, about.
    """
    if path.turn == path.drift_y == 0.0 and path.direction in (0.0, math.pi, -math.pi):
        return _streak_taps(
            abs(math.copysign(path.extent, math.cos(path.direction)) + path.drift_x), width
        )
    points = path_points(path)
    # Of each point's share of the path, as straight, what lies between the points.
    steps = np.gradient(points, axis=1)
    targets = (points**2).mean(axis=1) + (steps**2).mean(axis=1) / 12.0
    y, x = (_widened(axis, target) for axis, target in zip(points, targets, strict=True))
    row, column = np.floor(y), np.floor(x)
    rows = np.concatenate([row, row, row + 1, row + 1])
    columns = np.concatenate([column, column + 1, column, column + 1])
    below, right = y - row, x - column
    weights = np.concatenate(
        [(1 - below) * (1 - right), (1 - below) * right, below * (1 - right), below * right]
    )
    rows = np.clip(rows, 1 - height, height - 1).astype(np.int64)
    columns = np.clip(columns, 1 - width, width - 1).astype(np.int64)
    pitch = 2 * width
    found, index = np.unique(rows * pitch + columns + width, return_inverse=True)
    total = np.bincount(index, weights, len(found)) / len(y)
    kept = total > 1e-9
    rows, columns = found[kept] // pitch, found[kept] % pitch - width
    return Taps(rows, columns, (total[kept] / total[kept].sum()).astype(np.float32))


def _streak_taps(extent_px: float, width: int) -> Taps:
    """The taps of a streak along the rows, as `simulator.optics.shapes.motion_kernel` has them."""
    n, end = streak_share(extent_px)
    weights = np.ones(2 * n + 3)
    weights[0] = weights[-1] = end
    columns = np.clip(np.arange(-n - 1, n + 2), 1 - width, width - 1)
    found, index = np.unique(columns, return_inverse=True)
    total = np.bincount(index, weights / weights.sum(), len(found)).astype(np.float32)
    return Taps(np.zeros(len(found), np.int64), found, total)


@_jit()
def _widened(points, target):  # type: ignore[no-untyped-def]
    """`points` along an axis, scaled such that their shares of pixels have a second moment.

    A point between two pixels has a share of each, which alone widens it: below a pixel by more
    than the path is long.
    """
    low, high = 0.0, 1.5
    for _ in range(40):
        scale, moment = 0.5 * (low + high), 0.0
        for point in points:
            value = scale * point
            share = value - math.floor(value)
            moment += value * value + share * (1.0 - share)
        if moment < target * len(points):
            low = scale
        else:
            high = scale
    return low * points


# -- blur -------------------------------------------------------------------------------------


@_jit()
def _blur_rows(planes, rows, columns, weights, reach, limit, out):  # type: ignore[no-untyped-def]
    """Sums of shifted rows, four taps at a time; as many taps as a multiple of 4."""
    height, width = planes.shape[1:]
    padded = np.empty((height, width + 2 * reach), np.float32)
    for plane in range(len(planes)):
        for y in range(height):
            for x in range(width):
                value = planes[plane, y, x]
                value = value if value < limit else limit
                padded[y, np.uint64(reach + x)] = value if value > -limit else -limit
            for x in range(reach):
                padded[y, x] = padded[y, reach]
                padded[y, np.uint64(reach + width + x)] = padded[y, reach + width - 1]
        for y in range(height):
            total = out[plane, y]
            total[:] = np.float32(0)
            for k in range(0, len(weights), 4):
                a = padded[min(max(y + rows[k], 0), height - 1), reach + columns[k] :]
                b = padded[min(max(y + rows[k + 1], 0), height - 1), reach + columns[k + 1] :]
                c = padded[min(max(y + rows[k + 2], 0), height - 1), reach + columns[k + 2] :]
                d = padded[min(max(y + rows[k + 3], 0), height - 1), reach + columns[k + 3] :]
                own = weights[k : k + 4]
                for x in range(width):
                    total[x] += (own[0] * a[x] + own[1] * b[x]) + (own[2] * c[x] + own[3] * d[x])


def path_blur(
    light: torch.Tensor,
    taps: Taps,
    out: torch.Tensor | None = None,
    *,
    limit: float = math.inf,
) -> torch.Tensor:
    """Motion along a path; the borders are replicated.

    Args:
        light: (P, H, W) float32.
        taps: Of the path on frames of H x W.
        out: Contiguous tensor like `light` to write to, instead of a new one; on the CPU only.
        limit: Light beyond it, on either side of 0, is clipped before it is blurred.
    """
    if not light.is_cpu:
        return _shifted_sum(light.clamp(-limit, limit), taps)
    out = torch.empty(light.shape) if out is None else out
    fill = (0, -len(taps.weights) % 4)
    rows, columns, weights = (np.pad(values, fill) for values in taps)
    reach = int(np.abs(columns).max(initial=0))
    planes, result = light.contiguous().numpy(), out.numpy()
    fixed = (rows, columns, weights, reach, np.float32(limit))
    in_shares(
        lambda first, last: _blur_rows(planes[first:last], *fixed, result[first:last]),
        len(planes),
        least=1 + _WORTH_A_THREAD // (len(weights) * planes[0].size),
    )
    return out


def _shifted_sum(light: torch.Tensor, taps: Taps) -> torch.Tensor:
    """`path_blur` on any device."""
    height, width = light.shape[-2:]
    y, x = (torch.arange(size, device=light.device) for size in (height, width))
    total = torch.zeros_like(light)
    for row, column, weight in zip(*(values.tolist() for values in taps), strict=True):
        shifted = light[..., (y + row).clamp(0, height - 1), :]
        total += weight * shifted[..., (x + column).clamp(0, width - 1)]
    return total
