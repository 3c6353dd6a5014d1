"""Motion and defocus blur of linear light, energy-preserving and matched in second moment.

Both work on *unclipped* light, so that a lamp ten times above white smears into a streak that is
still white: clipping comes later, once (see `simulator.capture`). Borders are replicated.

A kernel that merely averages the pixels it covers does nothing below one pixel of extent. Both
kernels here are widened so that their second moment is that of the continuous streak (extent
squared / 12) or disc (diameter squared / 16 per axis): small blurs are then right, too.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
import torch.nn.functional as F

_SUBROWS = 32  # rows per pixel in the numerical integration of a disc's coverage
_FFT_TAPS = 11  # kernels wider than this are applied in the Fourier domain


def _check_extent(name: str, value: float) -> float:
    if not (math.isfinite(value) and value >= 0):
        raise ValueError(f"`{name}` (={value!r}) must be finite and >= 0 pixels")
    return float(value)


def _streak_weights(length: float) -> np.ndarray:
    """Share of a streak of `length` >= 1 that each pixel covers, symmetric, sums to 1."""
    half = length / 2.0
    full = int(half - 0.5)
    weights = np.ones(2 * full + 3)
    weights[[0, -1]] = half - 0.5 - full
    return weights / length


def _second_moment(weights: np.ndarray) -> float:
    offsets = np.arange(len(weights)) - len(weights) // 2
    return float((weights * offsets**2).sum())


@functools.lru_cache(maxsize=4096)
def motion_kernel(extent_px: float) -> np.ndarray:
    """Weights (K,), K odd, of a uniform streak of `extent_px` pixels.

    >>> motion_kernel(0.0)
    array([1.])
    """
    extent = _check_extent("extent_px", extent_px)
    target = extent * extent / 12.0
    if target < 1e-12:
        return np.ones(1)
    low, high = 1.0, extent + 2.0
    while high - low > 1e-9 * high:  # the second moment grows with the length: bisect
        middle = 0.5 * (low + high)
        if _second_moment(_streak_weights(middle)) < target:
            low = middle
        else:
            high = middle
    return _streak_weights(high)


def motion_blur(light: torch.Tensor, extent_px: float) -> torch.Tensor:
    """Uniform motion along the rows during the exposure.

    Args:
        light: (..., H, W) linear light.
        extent_px: Distance that the image moves, in pixels, >= 0.

    Returns:
        (..., H, W), the same dtype. A running sum in float64 makes the cost independent of the
        extent.
    """
    weights = motion_kernel(extent_px)
    if len(weights) == 1:
        return light
    width, radius = light.shape[-1], len(weights) // 2
    edge, full = float(weights[0]), float(weights[1])
    padded = F.pad(light.reshape(-1, 1, width), (radius, radius), mode="replicate")
    sums = F.pad(padded.double().cumsum(-1), (1, 0))
    inner = sums[..., 2 * radius : 2 * radius + width] - sums[..., 1 : 1 + width]
    ends = padded[..., :width] + padded[..., 2 * radius :]
    return (inner * full + ends.double() * edge).to(light.dtype).reshape(light.shape)


def _disc_coverage(radius: float) -> np.ndarray:
    """Area of a disc of `radius` in each pixel, (K, K), K odd, sums to 1."""
    reach = max(math.ceil(radius - 0.5), 0)
    edges = np.arange(-reach, reach + 2) - 0.5
    rows = (np.arange((2 * reach + 1) * _SUBROWS) + 0.5) / _SUBROWS - reach - 0.5
    chord = np.sqrt(np.maximum(radius**2 - rows**2, 0.0))[:, None]
    lengths = np.diff(np.clip(edges[None, :], -chord, chord), axis=1)
    coverage = lengths.reshape(2 * reach + 1, _SUBROWS, -1).sum(1)
    coverage = coverage + coverage.T  # the quadrature treats rows and columns alike
    return coverage / coverage.sum()


@functools.cache
def _radius_table() -> tuple[np.ndarray, np.ndarray]:
    """Second moments per axis of covered discs, and their radii: the inverse is interpolated."""
    radii = np.concatenate([[0.5], 0.5 + np.geomspace(1e-4, 7.5, 700)])
    moments = np.array([_second_moment(_disc_coverage(r).sum(0)) for r in radii])
    return np.maximum.accumulate(moments), radii


@functools.lru_cache(maxsize=4096)
def disc_kernel(diameter_px: float) -> np.ndarray:
    """Weights (K, K), K odd, of a uniform disc of `diameter_px` pixels.

    >>> kernel = disc_kernel(3.0)
    >>> round(float((kernel.sum(0) * [4, 1, 0, 1, 4]).sum()), 3)  # 3**2 / 16
    0.562
    """
    diameter = _check_extent("diameter_px", diameter_px)
    target = diameter * diameter / 16.0
    moments, radii = _radius_table()
    if target < 1e-6:
        return np.ones((1, 1))
    if target < moments[-1]:
        return _disc_coverage(float(np.interp(target, moments, radii)))
    return _disc_coverage(2.0 * math.sqrt(target - 1.0 / 12.0))


def disc_blur(light: torch.Tensor, diameter_px: float) -> torch.Tensor:
    """Defocus by a uniform disc.

    Args:
        light: (..., H, W) linear light.
        diameter_px: Diameter of the circle of confusion, in pixels, >= 0.

    Returns:
        (..., H, W), the same dtype.
    """
    weights = disc_kernel(diameter_px)
    taps = weights.shape[0]
    if taps == 1:
        return light
    height, width = light.shape[-2:]
    radius = taps // 2
    padded = F.pad(light.reshape(-1, 1, height, width), (radius,) * 4, mode="replicate")
    kernel = torch.from_numpy(weights).to(light.device)
    if taps <= _FFT_TAPS:
        return F.conv2d(padded, kernel[None, None].to(light.dtype)).reshape(light.shape)
    # float64: a lamp a thousand times above white must not leave ringing in the shadows.
    size = [height + 2 * radius, width + 2 * radius]
    spectrum = torch.fft.rfft2(padded.double()) * torch.fft.rfft2(kernel, s=size)
    blurred = torch.fft.irfft2(spectrum, s=size)[..., 2 * radius :, 2 * radius :]
    return blurred.to(light.dtype).reshape(light.shape)


def kernel_energy(motion_px: float, defocus_px: float) -> float:
    """Sum of squared weights of both blurs together: what they leave of white noise's variance."""
    streak, disc = motion_kernel(motion_px), disc_kernel(defocus_px)
    if disc.shape[0] == 1:
        return float((streak**2).sum())
    both = np.apply_along_axis(np.convolve, 1, disc, streak)
    return float((both**2).sum())
