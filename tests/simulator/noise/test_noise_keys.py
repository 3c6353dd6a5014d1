"""Keys of noise: functions of their numbers, as good as random."""

from __future__ import annotations

import math

import numpy as np
import pytest

from simulator.noise.generator import noise_keys


def test_a_key_is_a_function_of_its_numbers() -> None:
    keys = noise_keys(np.array([3, 4, 3]), np.array([0, 0, 1]))
    assert keys.dtype == np.uint64
    assert len(set(keys.tolist())) == 3
    assert keys[0] == noise_keys(3, 0)[0] == noise_keys(np.int64(3), 0.0)[0]
    assert noise_keys(7, 100.0, 1 / 64, 4.0) != noise_keys(7, 100.0, 4.0, 1 / 64)
    many = noise_keys(np.arange(1000).repeat(50), np.tile(np.arange(50), 1000))
    assert len(np.unique(many)) == 50_000


def test_flipping_a_bit_of_the_seed_flips_half_of_the_key() -> None:
    seeds = np.arange(2000)
    for bit in (0, 1, 5, 40, 61):
        changed = noise_keys(seeds, 3) ^ noise_keys(seeds ^ (1 << bit), 3)
        flipped = np.bitwise_count(changed).mean()
        assert flipped == pytest.approx(32.0, abs=5.0 * 4.0 / math.sqrt(len(seeds)))


@pytest.mark.parametrize("seed", [-1, 1.5, "a"])
def test_seeds_are_checked(seed: object) -> None:
    with pytest.raises(ValueError, match="`seeds`"):
        noise_keys(seed, 0)  # type: ignore[arg-type]
