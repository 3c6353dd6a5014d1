"""The noise of one frame: drawn for it alone, or looked up in a bank of normals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Literal, get_args

import numpy as np

from simulator.settings import CameraSettings

#: How the noise of a capture is made: drawn (`simulator.normal_kernels`), or looked up in a bank of
#: normals (`simulator.noise_bank`).
Noise = Literal["exact", "bank"]


@dataclass(frozen=True)
class FrameNoise:
    """Standard normals of a frame, as a function of a key.

    Args:
        key: 64 bits, from `simulator.noise_keys.noise_keys`.
        kind: How the key becomes normals.
    """

    key: int
    kind: Noise = "exact"

    def normals(self, shape: tuple[int, ...]) -> np.ndarray:
        """(P, H, W) float32, what `simulator.kernels` adds."""
        from simulator.noise_bank import bank_normals  # numba, both
        from simulator.normal_kernels import drawn_normals

        planes, height, width = shape
        make = bank_normals if self.kind == "bank" else drawn_normals
        return make(self.key, (planes, height, width))


def sweep_keys(seed: int, states: Sequence[CameraSettings]) -> np.ndarray:
    """(S,) uint64 keys of the noise of a sweep's frames, which differ by their settings.

    Raises:
        ValueError: Unless `seed` is an integer >= 0 of at most 64 bits.
    """
    if isinstance(seed, bool) or not isinstance(seed, Integral) or not 0 <= seed < 2**64:
        raise ValueError(f"`seed` (={seed!r}) must be an integer >= 0, below 2**64")
    from simulator.noise_keys import noise_keys  # numba: only where there is a capture

    numbers = np.array([(s.iso, s.exposure_time, s.f_number) for s in states], np.float64)
    return noise_keys(int(seed), *numbers.reshape(-1, 3).T)


def check_noise(noise: str) -> None:
    """Raises a `ValueError` unless `noise` is a kind of noise."""
    if noise not in get_args(Noise):
        raise ValueError(f"`noise` (={noise!r}) must be one of {list(get_args(Noise))}")
