"""Motion along a path: how an image moves while the shutter is open, and the blur that this makes.

The shake of a camera has a direction that turns; a subject may move on its own besides. The part of
the path that is traversed during an exposure is rasterised into a few weighted shifts (taps), whose
sum is the blurred image. Taps are widened as the streaks of `simulator.optics.blur` are: along
both axes their second moment is that of the path. Borders are replicated.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from simulator.optics.blur import streak_share
from simulator.utils.compute import kernel, parallel_ranges

#: Points of a path, per pixel of its length and at most: longer ones are sampled more coarsely.
_POINTS_PER_PIXEL, _MOST_POINTS = 2.0, 1024
#: Points that the length of a path is summed over.
_LENGTH_POINTS = 32
#: Shares below this are left out.
_LEAST_WEIGHT = 1e-9
#: Samples from which another thread is worth waking.
_WORTH_A_THREAD = 2**18
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
        return self.turn == 0.0 and self.direction == 0.0

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
        return _lengths(speed * times, self.direction, self.turn * times, *drift)


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
        return float(_length(*self))


@_jit()
def _length(extent, direction, turn, drift_x, drift_y):  # type: ignore[no-untyped-def]
    """`Path.length`, by the midpoint rule."""
    total = 0.0
    for i in range(_LENGTH_POINTS):
        angle = direction + turn * (i + 0.5) / _LENGTH_POINTS
        total += math.hypot(extent * math.cos(angle) + drift_x, extent * math.sin(angle) + drift_y)
    return total / _LENGTH_POINTS


@_jit()
def _lengths(extent, direction, turn, drift_x, drift_y):  # type: ignore[no-untyped-def]
    """Lengths of S paths of one direction; the others are (S,)."""
    out = np.empty(len(extent))
    for i in range(len(out)):
        out[i] = _length(extent[i], direction, turn[i], drift_x[i], drift_y[i])
    return out


# -- taps -------------------------------------------------------------------------------------


class Taps(NamedTuple):
    """Weighted shifts, K of them, a multiple of 4: the last may have no weight.

    Args:
        rows: (K,) int64, by how many rows down each looks.
        columns: (K,) int64, by how many columns to the right.
        weights: (K,) float32, >= 0; their sum is 1.
    """

    rows: np.ndarray
    columns: np.ndarray
    weights: np.ndarray


@functools.lru_cache(maxsize=256)
def path_taps(path: Path, height: int, width: int) -> Taps:
    """The taps of `path` on frames of `height` x `width` pixels.

    Shifts beyond the frame show its border whatever they are, so however long a path is, its taps
    are about as many as the frame is high and wide.
    """
    if path.turn == path.drift_y == 0.0 and path.direction == 0.0:
        return _streak_taps(path.extent + path.drift_x, width)
    count = math.ceil(min(max(_POINTS_PER_PIXEL * path.length, 8.0), _MOST_POINTS))
    return Taps(*_rasterised(*path, count, height, width))


def _streak_taps(extent_px: float, width: int) -> Taps:
    """The taps of a streak along the rows, as `simulator.optics.blur.motion_kernel` has them."""
    n, end = streak_share(abs(extent_px))
    weights = np.ones(2 * n + 3)
    weights[0] = weights[-1] = end
    columns = np.clip(np.arange(-n - 1, n + 2), 1 - width, width - 1)
    found, index = np.unique(columns, return_inverse=True)
    total = np.bincount(index, weights / weights.sum(), len(found)).astype(np.float32)
    fill = (0, -len(found) % 4)
    return Taps(np.zeros(len(found) + fill[1], np.int64), np.pad(found, fill), np.pad(total, fill))


@_jit()
def _positions(extent, direction, turn, drift_x, drift_y, count):  # type: ignore[no-untyped-def]
    """y and x [pixel] of moments evenly spread over the exposure, their means at 0."""
    y, x = np.empty(count), np.empty(count)
    for i in range(count):
        u = (i + 0.5) / count
        half = 0.5 * turn * u
        # The chord of an arc: its length times sin(half) / half, in the mean of its directions.
        chord = extent * u * (math.sin(half) / half if abs(half) > 1e-6 else 1.0)
        y[i] = chord * math.sin(direction + half) + drift_y * u
        x[i] = chord * math.cos(direction + half) + drift_x * u
    return y - y.mean(), x - x.mean()


@_jit()
def _widened(points):  # type: ignore[no-untyped-def]
    """`points` along an axis, scaled such that their taps have the path's second moment.

    That of the path is that of the points, and of the straight piece that each stands for. A point
    between two pixels has a share of each, which alone widens it: below a pixel by more than the
    path is long.
    """
    target, count = 0.0, len(points)
    for i in range(count):
        step = 0.5 * (points[min(i + 1, count - 1)] - points[max(i - 1, 0)])
        step = 2.0 * step if i in (0, count - 1) else step
        target += points[i] ** 2 + step * step / 12.0
    low, high = 0.0, 1.5
    for _ in range(40):
        scale, moment = 0.5 * (low + high), 0.0
        for point in points:
            value = scale * point
            share = value - math.floor(value)
            moment += value * value + share * (1.0 - share)
        if moment < target:
            low = scale
        else:
            high = scale
    return low * points


@_jit()
def _rasterised(  # type: ignore[no-untyped-def]
    extent, direction, turn, drift_x, drift_y, count, height, width
):
    """Rows, columns and weights of `Taps`: each point has a share of the four pixels around it."""
    y, x = _positions(extent, direction, turn, drift_x, drift_y, count)
    y, x = _widened(y), _widened(x)
    top, bottom = max(math.floor(y.min()), 1 - height), min(math.floor(y.max()) + 1, height - 1)
    left, right = max(math.floor(x.min()), 1 - width), min(math.floor(x.max()) + 1, width - 1)
    grid = np.zeros((bottom - top + 1, right - left + 1))
    for i in range(count):
        row, column = math.floor(y[i]), math.floor(x[i])
        for down in range(2):
            part = (y[i] - row if down else 1.0 - (y[i] - row)) / count
            inside = min(max(row + down, top), bottom) - top
            for over in range(2):
                share = x[i] - column if over else 1.0 - (x[i] - column)
                grid[inside, min(max(column + over, left), right) - left] += part * share
    number = (grid > _LEAST_WEIGHT).sum()
    size = (number + 3) // 4 * 4
    rows, columns = np.zeros(size, np.int64), np.zeros(size, np.int64)
    weights = np.zeros(size)
    k = 0
    for i in range(len(grid)):
        for j in range(grid.shape[1]):
            if grid[i, j] > _LEAST_WEIGHT:
                rows[k], columns[k], weights[k] = i + top, j + left, grid[i, j]
                k += 1
    return rows, columns, (weights / weights.sum()).astype(np.float32)


# -- blur -------------------------------------------------------------------------------------


@_jit()
def _blur_rows(planes, rows, columns, weights, limit, out):  # type: ignore[no-untyped-def]
    """Sums of shifted rows, four taps at a time."""
    height, width = planes.shape[1:]
    reach = 0
    for column in columns:
        reach = max(reach, abs(column))
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


@_jit()
def _blur_apart(planes, mask, behind, taps, own, limit, out):  # type: ignore[no-untyped-def]
    """Background along `taps`, the subject in front of it along `own`; see `path_blur_apart`."""
    count, height, width = planes.shape
    split = np.empty((1, height, width), np.float32)
    front, cover = np.empty_like(split), np.empty_like(split)
    _blur_rows(mask, own[0], own[1], own[2], limit, cover)
    for plane in range(count):
        flat = planes[plane].reshape(-1)
        for y in range(height):
            for x in range(width):
                split[0, y, x] = flat[behind[y, x]]
        _blur_rows(split, taps[0], taps[1], taps[2], limit, out[plane : plane + 1])
        for y in range(height):
            for x in range(width):
                value = planes[plane, y, x]
                value = value if value < limit else limit
                split[0, y, x] = mask[0, y, x] * (value if value > -limit else -limit)
        _blur_rows(split, own[0], own[1], own[2], limit, front)
        for y in range(height):
            for x in range(width):
                seen = max(np.float32(1) - cover[0, y, x], np.float32(0))
                out[plane, y, x] = seen * out[plane, y, x] + front[0, y, x]


def path_blur(
    light: torch.Tensor,
    taps: Taps,
    out: torch.Tensor | None = None,
    *,
    limit: float = math.inf,
) -> torch.Tensor:
    """Motion along a path; the borders are replicated.

    Args:
        light: (P, H, W) float32; on another device than the CPU, it is blurred here all the same.
        taps: Of the path on frames of H x W.
        out: Contiguous tensor on the CPU to write to, instead of a new one.
        limit: Light beyond it, on either side of 0, is clipped before it is blurred.
    """
    out = torch.empty(light.shape) if out is None else out
    planes, result = light.cpu().contiguous().numpy(), out.numpy()
    parallel_ranges(
        lambda first, last: _blur_rows(
            planes[first:last], *taps, np.float32(limit), result[first:last]
        ),
        len(planes),
        least=1 + _WORTH_A_THREAD // planes[0].size,
    )
    return out.to(light.device)


def path_blur_apart(
    light: torch.Tensor,
    mask: torch.Tensor,
    behind: torch.Tensor,
    taps: Taps,
    own: Taps,
    out: torch.Tensor | None = None,
    *,
    limit: float = math.inf,
) -> torch.Tensor:
    """A subject that moves along its own path, in front of a background that moves along another.

    ``(1 - A) (K_b * B) + K_s * (M L)`` with the mask M of the subject, A = K_s * M, and the
    background B that continues behind it: uniform light stays uniform.

    Args:
        light: (P, H, W) float32, L.
        mask: (1, H, W) float32, M.
        behind: (H, W) int64, which pixel (counted row by row) B shows in place of each.
        taps: Of the background's path, K_b.
        own: Of the subject's, K_s.
        out: See `path_blur`.
        limit: See `path_blur`.
    """
    out = torch.empty(light.shape) if out is None else out
    planes, result = light.cpu().contiguous().numpy(), out.numpy()
    fixed = (mask.numpy(), behind.numpy(), tuple(taps), tuple(own), np.float32(limit))
    parallel_ranges(
        lambda first, last: _blur_apart(planes[first:last], *fixed, result[first:last]),
        len(planes),
        least=1 + _WORTH_A_THREAD // planes[0].size,
    )
    return out.to(light.device)
