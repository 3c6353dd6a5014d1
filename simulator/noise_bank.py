"""Sensor noise looked up instead of drawn: a bank of standard normals, read in hashed pieces.

Drawing 4 x 128 x 128 normals (`simulator.normal_kernels`) takes about 70 microseconds, everything
else that a capture needs about 30. The bank holds the 2**20 quantiles (i + 1/2) / 2**20 of the
normal distribution in a fixed random order. A frame reads it in blocks of 256 samples; where each
block starts (any multiple of 16) and its sign come from a hash of the frame's key and the block's
number, so that a frame is a function of its key alone. Every start is as likely as any other, so
each sample has the bank's distribution exactly, and two samples share a value only by the chance
that blocks overlap.
"""

from __future__ import annotations

import functools

import numpy as np
from scipy.special import ndtri

from simulator.jit import kernel
from simulator.noise_keys import KEY_STEP, mixed, mixed_word

#: Number of different normals.
BANK_SIZE = 2**20
#: Samples that are read in one piece; blocks do not reach over the end of a plane.
BLOCK = 256
#: A block starts at a multiple of this: one cache line of float32.
STRIDE = 16
_SHUFFLE_SEED = 20210616
_SINGLES = np.uint64(0x5851F42D4C957F2D)  # keeps single normals apart from a frame's blocks


@functools.cache
def noise_bank() -> np.ndarray:
    """The bank, read-only: (BANK_SIZE + BLOCK,) float32; the end repeats the beginning."""
    quantiles = ndtri((np.arange(BANK_SIZE) + 0.5) / BANK_SIZE).astype(np.float32)
    np.random.default_rng(_SHUFFLE_SEED).shuffle(quantiles)
    bank = np.concatenate([quantiles, quantiles[:BLOCK]])
    bank.flags.writeable = False
    return bank


@kernel()
def _singles(keys, bank, out):  # type: ignore[no-untyped-def]
    for i in range(len(out)):
        for j in range(out.shape[1]):
            word = mixed_word((keys[i] ^ _SINGLES) + KEY_STEP * np.uint64(j + 1))
            value = np.float64(bank[word & np.uint64(BANK_SIZE - 1)])
            out[i, j] = -value if word >> np.uint64(63) else value


def single_normals(keys: np.ndarray, count: int) -> np.ndarray:
    """(B, count) float64: `count` standard normals for each key, apart from its frame's noise."""
    out = np.empty((len(keys), count))
    _singles(keys, noise_bank(), out)
    return out


def bank_normals(key: int, shape: tuple[int, int, int]) -> np.ndarray:
    """The standard normals that a frame of `shape` (P, H, W) reads, float32.

    What `simulator.kernels` adds, as an array of its own: for other devices, and for tests.
    """
    planes, samples = shape[0], shape[1] * shape[2]
    blocks = -(-samples // BLOCK)
    turns = np.arange(1, planes * blocks + 1, dtype=np.uint64) * KEY_STEP
    words = mixed(np.uint64(key) + turns)
    starts = (words & np.uint64(BANK_SIZE // STRIDE - 1)).astype(np.int64) * STRIDE
    signs = np.where(words >> np.uint64(63), np.float32(-1), np.float32(1))
    values = noise_bank()[starts[:, None] + np.arange(BLOCK)] * signs[:, None]
    return values.reshape(planes, blocks * BLOCK)[:, :samples].reshape(shape)
