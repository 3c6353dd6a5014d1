"""Frames that do not look the same twice, so that a training's few places are not memorised."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Frames are shifted by up to this part of their size.
_LARGEST_SHIFT = 1 / 8


def moved(raw: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Frames shifted by up to an eighth, all alike, and mirrored half of the time.

    Their light, and so the scores of all states, stay nearly what they were.

    Args:
        raw: (N, 4, H, W) uint8. Shifted frames continue their border.
        rng: Draws the shift.
    """
    for axis in (2, 3):
        size = raw.shape[axis]
        most = int(size * _LARGEST_SHIFT)
        places = np.arange(size) + rng.integers(-most, most + 1)
        raw = np.take(raw, np.clip(places, 0, size - 1), axis=axis)
    return np.ascontiguousarray(raw[..., ::-1]) if rng.random() < 0.5 else raw
