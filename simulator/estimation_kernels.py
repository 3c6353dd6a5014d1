"""Sums over windows, for `simulator.noise_estimation`; CPU only."""

from __future__ import annotations

import numpy as np

from simulator.jit import kernel


@kernel()
def summed_area(image, total):  # type: ignore[no-untyped-def]
    """Sum over everything above and to the left of each corner of a pixel.

    Args:
        image: (H, W), any number type.
        total: (H + 1, W + 1) float64, written to.
    """
    height, width = image.shape
    columns = np.zeros(width)
    total[0] = 0.0
    for y in range(height):
        columns += image[y]
        row, value = total[y + 1], 0.0
        row[0] = 0.0
        for x in range(width):
            value += columns[x]
            row[x + 1] = value
