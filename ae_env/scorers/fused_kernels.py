"""The kernel of `ae_env.scorers.fused`: means over the pixels, for many exposures.

Light that is exposed longer is multiplied, and so are the exponentials under their sigmoids: those
of the scene are worked out once, and no exposure needs a transcendental function of a pixel.

The constants are those of `ae_env.scorers.terms`, and arguments here: numba's cache on disk would
not notice that they changed elsewhere. This module imports numba.
"""

from __future__ import annotations

import numpy as np

from simulator.jit import kernel

#: Pixels that are added up in float32 before their sum is in float64.
_BLOCK = 256
_ZERO, _ONE, _TINY = np.float32(0), np.float32(1), np.float32(1e-30)

_FAST = {"nsz", "contract", "reassoc"}
_jit = kernel(fastmath=_FAST, boundscheck=False)
#: Written into its caller. Sums of a function that is called would be added up in another order in
#: the process that compiles it than in those that load what was compiled.
_inline = kernel(fastmath=_FAST, boundscheck=False, inline="always")


@_inline
def _dark(values, root):  # type: ignore[no-untyped-def]
    """Sum of ``1 / (1 + value root^2)``; the square alone could leave float32's range."""
    total = _ZERO
    for i in range(len(values)):
        total += _ONE / (_ONE + (values[i] * root) * root)
    return total


@_inline
def _bright(values, factor):  # type: ignore[no-untyped-def]
    """Sum of ``1 - 1 / (1 + value factor)``."""
    total = 0.0
    for i in range(len(values)):
        total += 1.0 - 1.0 / (1.0 + values[i] * factor)
    return total


@_inline
def _clean(light, ratio, shot, read, half):  # type: ignore[no-untyped-def]
    """Sum of ``s / (s + half)``, s = SNR^1.5."""
    total = _ZERO
    for i in range(len(light)):
        x = light[i] * ratio
        x = x if x > _ZERO else _ZERO
        variance = x * shot + read
        variance = variance if variance > _TINY else _TINY
        x = x if x < _ONE else _ONE
        root = np.sqrt(x * x / variance)
        power = root * np.sqrt(root)
        total += power / (power + half)
    return total


@_jit
def fused_means(  # type: ignore[no-untyped-def]
    first, last, light, dark, bright, ratio, dark_root, bright_factor, shot, read, half, means
):
    """Exposures `first` to `last` of S, of light in R parts of C pixels that each have their gain.

    Args:
        first: First exposure.
        last: Behind the last.
        light: (4, R, C) float32.
        dark: (4, R, C) float32, ``exp((log2 x + depth) / width)`` of the light x.
        bright: (R, C) float64, ``exp(log2 x / width)`` of the brightest plane.
        ratio: (S, R) float32, what the light is multiplied by.
        dark_root: (S, R) float32, root of what `dark` is multiplied by.
        bright_factor: (S, R) float64, what `bright` is multiplied by.
        shot: (S, 4) float32 of the camera.
        read: (S, 4) float32.
        half: float32, SNR^1.5 at which `noise` is a half.
        means: (S, 3) float64 to write to: shares of blown and of blocked pixels, and `noise`.
    """
    planes, rows, columns = light.shape
    for state in range(first, last):
        blown = blocked = clean = 0.0
        for row in range(rows):
            for start in range(0, columns, _BLOCK):
                end = min(start + _BLOCK, columns)
                blown += _bright(bright[row, start:end], bright_factor[state, row])
                for plane in range(planes):
                    part = dark[plane, row, start:end]
                    blocked += _dark(part, dark_root[state, row])
                    by_light, by_itself = shot[state, plane], read[state, plane]
                    signal = light[plane, row, start:end]
                    clean += _clean(signal, ratio[state, row], by_light, by_itself, half)
        count = rows * columns
        means[state, 0] = blown / count
        means[state, 1] = blocked / (4 * count)
        means[state, 2] = clean / (4 * count)
