"""How much of each pixel a disc covers; a kernel, as each new diameter asks for it."""

from __future__ import annotations

import functools
import math

import numpy as np

from simulator.jit import kernel

#: Rows per pixel in the numerical integration of a disc's coverage.
_SUBROWS = 32
_jit = functools.partial(kernel, fastmath={"contract"})


@_jit()
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
    area = area + area.T  # the quadrature treats rows and columns alike
    return area / (area[0, 0] + 2.0 * (area[0, 1:].sum() + area[1:].sum() + area[1:, 1:].sum()))
