"""Keys of the noise of frames: 64 bits that depend on a seed and on numbers, on nothing else.

This module imports numba.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from simulator.jit import kernel

# splitmix64 (Steele, Lea and Flood 2014).
KEY_STEP = np.uint64(0x9E3779B97F4A7C15)
_MULTIPLIERS = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_SHIFTS = np.uint64(30), np.uint64(27), np.uint64(31)


def mixed(words: Any) -> Any:
    """The finaliser of splitmix64: a bijection of uint64, one or an array of them."""
    words = (words ^ (words >> _SHIFTS[0])) * _MULTIPLIERS[0]
    words = (words ^ (words >> _SHIFTS[1])) * _MULTIPLIERS[1]
    return words ^ (words >> _SHIFTS[2])


#: The same inside kernels.
mixed_word = kernel()(mixed)


@kernel()
def _fold(keys, bits):  # type: ignore[no-untyped-def]
    for frame in range(len(keys)):
        key = mixed_word(keys[frame] + KEY_STEP)
        for number in range(bits.shape[1]):
            key = mixed_word((key ^ bits[frame, number]) + KEY_STEP)
        keys[frame] = key


def noise_keys(seeds: np.ndarray | int, *numbers: np.ndarray | float) -> np.ndarray:
    """Keys of B frames.

    Args:
        seeds: (B,) or a single integer, >= 0.
        numbers: What the noise of the frames shall differ by, each (B,) or a single number:
            the step of an episode, the settings of a capture.

    Returns:
        (B,) uint64, each a function of its seed and its numbers and of nothing else.

    Raises:
        ValueError: If a seed is not an integer >= 0.
    """
    given = np.asarray(seeds)
    if given.dtype.kind not in "iu" or (given.dtype.kind == "i" and given.min(initial=0) < 0):
        raise ValueError(f"`seeds` (={seeds!r}) must be integers >= 0")
    columns = [np.asarray(number, np.float64) for number in numbers]
    count = next((len(values) for values in (given, *columns) if values.ndim), 1)
    keys, folded = np.empty(count, np.uint64), np.empty((count, len(columns)))
    keys[:] = given
    for place, values in enumerate(columns):
        folded[:, place] = values
    _fold(keys, folded.view(np.uint64))
    return keys
