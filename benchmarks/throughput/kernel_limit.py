"""The machine's limit: the arithmetic of a frame in one loop, on arrays that are there already.

Multiply by the exposure ratio, add noise of the signal's variance, clip, compand. Nothing else: no
scene, no blur, no score, no info. Nothing of the library is in it but what draws exact normals:
nothing else at hand draws them as fast (torch's generator takes three times as long).
"""

import math
from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
import torch

from benchmarks.isolated import CORES
from simulator.noise.generator import draw_block

_F = np.float32
_ZERO, _ONE, _HALF = _F(0), _F(1), _F(0.5)
_PEDESTAL = _F(1 / 1024)
_CODES = _F(255 / math.sqrt(1 + 1 / 1024))
#: Samples that are worked on at a time, and to which the start of each such run is rounded.
_RUN, _GRAIN = 256, 16
_BANK = 2**20

_compiled = numba.njit(
    nogil=True, fastmath={"nnan", "ninf", "nsz", "contract"}, error_model="numpy"
)


@_compiled
def _codes(x, ratio, shot, read, z, y):  # type: ignore[no-untyped-def]
    for i in range(x.size):
        signal = x[i] * ratio
        bright = signal if signal > _ZERO else _ZERO
        signal += np.sqrt(bright * shot + read) * z[i] + _PEDESTAL
        signal = signal if signal > _ZERO else _ZERO
        signal = signal if signal < _ONE + _PEDESTAL else _ONE + _PEDESTAL
        y[i] = np.uint8(np.int32(np.sqrt(signal) * _CODES + _HALF))


@_compiled
def _loop(  # type: ignore[no-untyped-def]
    begin, end, lights, chosen, ratios, shot, read, bank, exact, state, out
):
    """Frames (4, N) from `begin` to before `end`, `_RUN` samples at a time."""
    planes, samples = lights.shape[1:]
    starts = np.uint64(bank.size - _RUN - 1)
    words, drawn = np.empty((4, _RUN // 4), np.uint32), np.empty(_RUN, np.float32)
    for frame in range(begin, end):
        light, ratio = lights[chosen[frame]], ratios[frame]
        for p in range(planes):
            for first in range(0, samples, _RUN):
                size = min(_RUN, samples - first)
                state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
                normals = drawn[:size]
                if exact:
                    draw_block(state, 0, words, drawn)
                else:  # anywhere in the bank
                    start = np.int64(((state >> np.uint64(20)) % starts) & ~np.uint64(_GRAIN - 1))
                    normals = bank[start : start + size]
                x, y = light[p, first : first + size], out[frame, p, first : first + size]
                _codes(x, ratio, shot[p], read[p], normals, y)
    return state


class KernelLimit:
    """The bare loop over a batch of frames, shared out among as many threads as torch uses.

    Frames of a step are exposed from `lights` (S, 4, H, W), drawn at random. With the noise
    ``"bank"`` normals are read from a table, with ``"exact"`` new ones are drawn.
    """

    def __init__(self, lights: np.ndarray, num_frames: int, *, noise: str, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._lights = np.ascontiguousarray(lights.reshape(*lights.shape[:2], -1))
        self._exact = noise == "exact"
        self._out = np.empty((num_frames, *lights.shape[1:]), np.uint8)
        self._flat = self._out.reshape(num_frames, 4, -1)
        self._bank = self._rng.standard_normal(_BANK, dtype=_F)
        self._states = [np.uint64(seed + i + 1) for i in range(CORES)]
        # Variances of the order of those of a camera at ISO 400.
        self._shot, self._read = np.full(4, 1e-4, _F), np.full(4, 1e-6, _F)
        self._pool = ThreadPoolExecutor(CORES)

    def step(self) -> np.ndarray:
        """Makes all frames, (B, 4, H, W), in an array that the next step overwrites."""
        count = len(self._flat)
        self._chosen = self._rng.integers(len(self._lights), size=count)
        self._ratios = self._rng.uniform(0.1, 2.0, count).astype(_F)
        threads = torch.get_num_threads()
        list(self._pool.map(self._share, [threads] * threads, range(threads)))
        return self._out

    def _share(self, threads: int, thread: int) -> None:
        count, state = len(self._flat), self._states[thread]
        part = count * thread // threads, count * (thread + 1) // threads
        noise = self._shot, self._read, self._bank, self._exact
        args = (*part, self._lights, self._chosen, self._ratios, *noise, state, self._flat)
        self._states[thread] = np.uint64(_loop(*args))
