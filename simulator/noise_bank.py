"""Sensor noise looked up instead of drawn: a bank of standard normals, read in hashed pieces.

Drawing 4 x 128 x 128 normals takes 150 to 300 microseconds, everything else that a capture needs
about 40. The bank holds the 2**20 quantiles (i + 1/2) / 2**20 of the normal distribution in a fixed
random order. A frame reads it in blocks of 256 samples; where each block starts (any multiple of
16) and its sign come from a hash of the frame's key and the block's number, so that a frame is a
function of its key alone. Every start is as likely as any other, so each sample has the bank's
distribution exactly, and two samples share a value only by the chance that blocks overlap.
"""

from __future__ import annotations

import functools

import numpy as np
from scipy.special import ndtri

#: Number of different normals.
BANK_SIZE = 2**20
#: Samples that are read in one piece; blocks do not reach over the end of a plane.
BLOCK = 256
#: A block starts at a multiple of this: one cache line of float32.
STRIDE = 16
_SHUFFLE_SEED = 20210616
# splitmix64 (Steele, Lea and Flood 2014).
_STEP = np.uint64(0x9E3779B97F4A7C15)
_MIX_1, _MIX_2 = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_SINGLES = np.uint64(0x5851F42D4C957F2D)  # keeps single normals apart from a frame's blocks


@functools.cache
def noise_bank() -> np.ndarray:
    """The bank, read-only: (BANK_SIZE + BLOCK,) float32; the end repeats the beginning."""
    quantiles = ndtri((np.arange(BANK_SIZE) + 0.5) / BANK_SIZE).astype(np.float32)
    np.random.default_rng(_SHUFFLE_SEED).shuffle(quantiles)
    bank = np.concatenate([quantiles, quantiles[:BLOCK]])
    bank.flags.writeable = False
    return bank


def _mixed(words: np.ndarray) -> np.ndarray:
    """The finaliser of splitmix64: a bijection of 64 bits."""
    words = (words ^ (words >> np.uint64(30))) * _MIX_1
    words = (words ^ (words >> np.uint64(27))) * _MIX_2
    return words ^ (words >> np.uint64(31))


def noise_keys(seeds: np.ndarray, *numbers: np.ndarray | float) -> np.ndarray:
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
    seeds = np.atleast_1d(np.asarray(seeds))
    if seeds.dtype.kind not in "iu" or (seeds.dtype.kind == "i" and seeds.min(initial=0) < 0):
        raise ValueError(f"`seeds` (={seeds!r}) must be integers >= 0")
    keys = _mixed(seeds.astype(np.uint64) + _STEP)
    for number in numbers:
        bits = np.atleast_1d(np.asarray(number, np.float64)).view(np.uint64)
        keys = _mixed((keys ^ bits) + _STEP)
    return keys


def single_normals(keys: np.ndarray, count: int) -> np.ndarray:
    """(B, count) float64: `count` standard normals for each key, apart from its frame's noise."""
    turns = np.arange(1, count + 1, dtype=np.uint64) * _STEP
    words = _mixed((keys[:, None] ^ _SINGLES) + turns)
    values = noise_bank()[words & np.uint64(BANK_SIZE - 1)].astype(np.float64)
    return np.where(words >> np.uint64(63), -values, values)


def frame_noise(key: int, shape: tuple[int, int, int]) -> np.ndarray:
    """The standard normals that a frame of `shape` (P, H, W) reads, float32.

    What `simulator.kernels` adds, as an array of its own: for other devices, and for tests.
    """
    planes, samples = shape[0], shape[1] * shape[2]
    blocks = -(-samples // BLOCK)
    turns = np.arange(1, planes * blocks + 1, dtype=np.uint64) * _STEP
    words = _mixed(np.uint64(key) + turns)
    starts = (words & np.uint64(BANK_SIZE // STRIDE - 1)).astype(np.int64) * STRIDE
    signs = np.where(words >> np.uint64(63), np.float32(-1), np.float32(1))
    values = noise_bank()[starts[:, None] + np.arange(BLOCK)] * signs[:, None]
    return values.reshape(planes, blocks * BLOCK)[:, :samples].reshape(shape)
