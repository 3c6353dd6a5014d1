"""Exposures as the tables of `Transitions`, and kernels of streaks, by hand."""

import numpy as np

from simulator import NoiseLevelFunction
from simulator.optics.motion import streak

Exposure = tuple[float, NoiseLevelFunction, NoiseLevelFunction]


def exposure_table(*exposures: Exposure) -> np.ndarray:
    """(B, 5, 4) of exposure ratios, noises of the sources before, and noises of the targets."""
    rows = []
    for ratio, source, target in exposures:
        given = np.array([source.shot, source.read]) * [[ratio], [ratio**2]]
        rows.append([[ratio] * 4, *(np.array([target.shot, target.read]) - given), *given])
    return np.array(rows, np.float32)


def streak_kernel(extent: float) -> np.ndarray:
    """Weights (K,) of a streak of `extent` pixels on rows that are longer."""
    radius, end = streak(extent, 2**20)
    weights = np.pad(np.ones(2 * radius - 1), 1, constant_values=end)
    return weights / weights.sum()
