"""Shapes of blur: the weights of a streak and of a disc, matched in second moment.

A kernel that merely averages the pixels it covers does nothing below one pixel of extent. Both
kernels here are widened so that their second moment is that of the continuous streak (extent
squared / 12) or disc (diameter squared / 16 per axis): small blurs are then right, too.
"""

from __future__ import annotations

import bisect
import functools
import math

import numpy as np

from simulator.utils.compute import kernel

#: Rows per pixel in the numerical integration of a disc's coverage.
_SUBROWS = 32
#: Streaks longer than this [pixel] are not written out: they leave next to no noise in any case.
_LONGEST_KERNEL = 4096.0
_jit = functools.partial(kernel, fastmath={"contract"})


@_jit()  # every new diameter asks for it
def coverage(radius):  # type: ignore[no-untyped-def]
    """Area of a disc of `radius` in the pixels of a quadrant, (r + 1, r + 1) float64.

    Over all four quadrants it sums to 1.
    """
    reach = max(math.ceil(radius - 0.5), 0)
    area = np.zeros((reach + 1, reach + 1))
    for i in range(reach + 1):
        for k in range(_SUBROWS):
            y = (k + 0.5) / _SUBROWS + i - 0.5
            chord = math.sqrt(max(radius**2 - y**2, 0.0))
            area[i, 0] += 2.0 * min(chord, 0.5)
            for j in range(1, reach + 1):
                area[i, j] += min(chord, j + 0.5) - min(chord, j - 0.5)
    # Loops: numpy's operations on whole arrays compile three times as long.
    out = np.empty_like(area)
    first = lower = inner = 0.0
    for i in range(reach + 1):
        for j in range(reach + 1):
            out[i, j] = area[i, j] + area[j, i]  # the quadrature treats rows and columns alike
            if i:
                lower += out[i, j]
                if j:
                    inner += out[i, j]
            elif j:
                first += out[i, j]
    total = out[0, 0] + 2.0 * (first + lower + inner)
    for i in range(reach + 1):
        for j in range(reach + 1):
            out[i, j] /= total
    return out


def _check_extent(name: str, value: float) -> float:
    if not (math.isfinite(value) and value >= 0):
        raise ValueError(f"`{name}` (={value!r}) must be finite and >= 0 pixels")
    return float(value)


def _second_moment(weights: np.ndarray) -> float:
    offsets = np.arange(len(weights)) - len(weights) // 2
    return float((weights * offsets**2).sum())


@functools.lru_cache(maxsize=64)
def motion_kernel(extent_px: float) -> np.ndarray:
    """Weights (K,), K odd, of a uniform streak of `extent_px` pixels.

    The streak covers ``2 n + 1`` pixels whole and a share e of one more at each end. Its second
    moment, ``(n (n + 1) (2 n + 1) / 3 + 2 e (n + 1)^2) / (2 n + 1 + 2 e)``, is solved for n and e.

    >>> motion_kernel(2.0).round(3).tolist()
    [0.167, 0.667, 0.167]
    """
    n, end = streak_share(extent_px)
    if not n and not end:
        return np.ones(1)
    weights = np.ones(2 * n + 3)
    weights[0] = weights[-1] = end
    return weights / (2 * n + 1 + 2.0 * end)


def streak_share(extent_px: float) -> tuple[int, float]:
    """Pixels n that a streak covers whole on either side, and its share e of one more.

    Both 0 where the extent is too small to blur anything.
    """
    extent = _check_extent("extent_px", extent_px)
    target = extent * extent / 12.0
    if target < 1e-12:
        return 0, 0.0
    n = int((math.sqrt(1.0 + extent * extent) - 1.0) / 2.0)  # the moment is n (n + 1) / 3 at e = 0
    end = (target - n * (n + 1) / 3.0) * (2 * n + 1) / (2.0 * ((n + 1) ** 2 - target))
    return n, max(end, 0.0)


def _disc_coverage(radius: float) -> np.ndarray:
    """Area of a disc of `radius` in each pixel, (K, K), K odd, sums to 1."""
    rows = coverage(radius)
    rows = np.concatenate([rows[:0:-1], rows])
    return np.concatenate([rows[:, :0:-1], rows], axis=1)


@functools.cache
def _radius_table() -> tuple[list[float], list[float]]:
    """Second moments per axis of covered discs, and their radii: the inverse is interpolated."""
    radii = np.concatenate([[0.5], 0.5 + np.geomspace(1e-4, 7.5, 700)])
    moments = np.array([_second_moment(_disc_coverage(r).sum(0)) for r in radii])
    return np.maximum.accumulate(moments).tolist(), radii.tolist()


def disc_radius(diameter_px: float) -> float:
    """Radius of the disc whose coverage has the second moment of one of `diameter_px`.

    At most 0.5 where the diameter is too small to blur anything.
    """
    diameter = _check_extent("diameter_px", diameter_px)
    target = diameter * diameter / 16.0
    if target < 1e-6:
        return 0.5
    moments, radii = _radius_table()
    if target >= moments[-1]:
        return 2.0 * math.sqrt(target - 1.0 / 12.0)
    i = bisect.bisect_right(moments, target)
    share = (target - moments[i - 1]) / (moments[i] - moments[i - 1])
    return radii[i - 1] + share * (radii[i] - radii[i - 1])


@functools.lru_cache(maxsize=64)
def disc_kernel(diameter_px: float) -> np.ndarray:
    """Weights (K, K), K odd, of a uniform disc of `diameter_px` pixels.

    >>> kernel = disc_kernel(3.0)
    >>> round(float((kernel.sum(0) * [1, 0, 1]).sum()), 2)  # 3**2 / 16
    0.56
    """
    return _disc_coverage(disc_radius(diameter_px))


@functools.lru_cache(maxsize=4096)
def kernel_energy(motion_px: float, defocus_px: float) -> float:
    """Sum of squared weights of both blurs together: the share of white noise's variance left."""
    disc = disc_kernel(defocus_px)
    if motion_px > _LONGEST_KERNEL:  # as if it were much longer than the disc is wide
        n, end = streak_share(motion_px)
        total = 2 * n + 1 + 2.0 * end
        return float((disc.sum(axis=1) ** 2).sum()) * (2 * n + 1 + 2.0 * end**2) / total**2
    streak = motion_kernel(motion_px)
    if disc.shape[0] == 1:
        return float((streak**2).sum())
    both = np.apply_along_axis(np.convolve, 1, disc, streak)
    return float((both**2).sum())
