"""Exposures as the tables of `Transitions`, by hand."""

import numpy as np

from simulator import NoiseLevelFunction

Exposure = tuple[float, NoiseLevelFunction, NoiseLevelFunction]


def exposure_table(*exposures: Exposure) -> np.ndarray:
    """(B, 5, 4) of exposure ratios, noises of the sources before, and noises of the targets."""
    rows = []
    for ratio, source, target in exposures:
        given = np.array([source.shot, source.read]) * [[ratio], [ratio**2]]
        rows.append([[ratio] * 4, *(np.array([target.shot, target.read]) - given), *given])
    return np.array(rows, np.float32)
