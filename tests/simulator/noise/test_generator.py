"""Noise of frames: keys, the bank, exact draws; against published vectors and Python's integers.

Every bound is a sampling error of white noise.
"""

import functools
import itertools
import math
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from simulator.capture.sensor import (
    Noise,
    frame_normals,
    noise_bank,
    noise_keys,
    single_normals,
    sweep_keys,
)
from simulator.noise.generator import BLOCK, drawn_normals, noise_generator, philox
from simulator.settings import CameraSettings

SHAPE = (4, 128, 128)
PIXELS = math.prod(SHAPE)
STEP, MASK = 0x9E3779B97F4A7C15, 2**64 - 1

both = pytest.mark.parametrize("kind", ["exact", "bank"])


def mixed(word: int) -> int:
    """The finaliser of splitmix64."""
    word = (word ^ word >> 30) * 0xBF58476D1CE4E5B9 & MASK
    word = (word ^ word >> 27) * 0x94D049BB133111EB & MASK
    return word ^ word >> 31


def bits(number: float) -> int:
    return int(struct.unpack("<Q", struct.pack("<d", number))[0])


def key_of(seed: int, *numbers: float) -> int:
    key = mixed(seed + STEP & MASK)
    for number in numbers:
        key = mixed((key ^ bits(number)) + STEP & MASK)
    return key


of_sweep = functools.partial(sweep_keys, states=[])


def frames(kind: Noise, count: int) -> np.ndarray:
    """(count, 4, 128, 128) noise of one rollout."""
    keys = noise_keys(1, np.arange(count))
    return np.stack([frame_normals(int(k), SHAPE, kind) for k in keys]).astype(np.float64)


@both
def test_frames_have_the_moments_of_a_normal(kind: Noise) -> None:
    noise = frames(kind, 50)
    n = noise.size
    assert abs(noise.mean()) < 5.0 / math.sqrt(n)
    # Standard errors of the k-th moment: sqrt(E x^2k - (E x^k)^2), 15 = E x^6 and so on.
    assert abs((noise**2).mean() - 1.0) < 5.0 * math.sqrt(2.0 / n)
    assert abs((noise**3).mean()) < 5.0 * math.sqrt(15.0 / n)
    assert abs((noise**4).mean() - 3.0) < 5.0 * math.sqrt(96.0 / n)


def test_the_bank_makes_frames_white_in_space_in_time_and_over_planes() -> None:
    noise = frames("bank", 50)
    pairs = [(noise[lag:], noise[:-lag]) for lag in (1, 2, 7)] + [(noise[:, 1:], noise[:, :-1])]
    for rows, columns in [(0, 1), (0, 2), (0, 16), (1, 0), (1, 1), (2, 0), (2, 3), (4, 0), (64, 0)]:
        pairs.append((noise[..., rows:, columns:], noise[..., : 128 - rows, : 128 - columns]))
    for first, second in pairs:
        assert abs((first * second).mean()) < 5.0 / math.sqrt(first.size)


# -- keys ------------------------------------------------------------------------------------------


def test_keys_are_those_of_splitmix64() -> None:
    """The first two outputs that its authors publish for the seed 1234567."""
    keys = noise_keys(np.array([1234567, 1234567 + STEP], np.uint64))
    assert keys.tolist() == [6457827717110365317, 3203168211198807973]


@given(st.integers(0, MASK), st.lists(st.floats(allow_nan=False), max_size=4), st.integers(2, 40))
def test_keys_are_of_seed_and_numbers_alone(seed: int, numbers: list[float], n: int) -> None:
    expected = key_of(seed, *numbers)
    batch = noise_keys(np.full(n, seed, np.uint64), *(np.full(n, v) for v in numbers))
    assert batch.dtype == np.uint64
    assert batch.tolist() == [expected] * n
    last = np.arange(float(n))
    assert noise_keys(seed, *numbers, last).tolist() == [key_of(seed, *numbers, x) for x in last]


def test_frames_of_a_sweep_differ_by_each_setting_and_the_seed() -> None:
    given = [(100, 1 / 64, 4.0), (200, 1 / 64, 4.0), (100, 1 / 32, 4.0), (100, 1 / 64, 5.6)]
    states = [CameraSettings(*values) for values in given]
    for seed in (7, np.int64(8), MASK):
        keys = sweep_keys(seed, states)
        assert keys.tolist() == [key_of(int(seed), *values) for values in given]
    assert len(sweep_keys(7, [])) == 0


@pytest.mark.parametrize(
    ("make", "seed"),
    [
        *itertools.product((of_sweep, noise_generator, noise_keys), (-1, 1.5, "1", None)),
        *itertools.product((of_sweep, noise_generator), [True]),
        (of_sweep, 2**64),
    ],
)
def test_bad_seeds_are_named(make: Callable[[Any], object], seed: object) -> None:
    with pytest.raises(ValueError, match=r"`seeds?`"):
        make(seed)


# -- the bank itself ------------------------------------------------------------------------------


def test_the_bank_is_every_quantile_once_in_a_fixed_order() -> None:
    bank = noise_bank()
    assert (bank.shape, bank.dtype, bank.flags.writeable) == ((2**20 + 256,), np.float32, False)
    np.testing.assert_array_equal(bank[2**20 :], bank[:256])
    quantiles = stats.norm.ppf((np.arange(2**20) + 0.5) / 2**20)
    np.random.default_rng(20210616).shuffle(quantiles)
    np.testing.assert_allclose(bank[: 2**20], quantiles, rtol=1e-6)


@pytest.mark.parametrize("shape", [(2, 3, 200), (4, 1, 1)])
def test_frames_and_single_normals_are_looked_up_in_it(shape: tuple[int, int, int]) -> None:
    key, bank = key_of(5, 2.0), noise_bank()
    size, turn = shape[1] * shape[2], 0
    for plane in frame_normals(key, shape, "bank").reshape(shape[0], size):
        for start in range(0, size, 256):
            turn += 1
            word = mixed(key + turn * STEP & MASK)
            values = bank[word % 2**16 * 16 :][: min(256, size - start)]
            np.testing.assert_array_equal(plane[start : start + 256], values * (-1) ** (word >> 63))
    words = [mixed((key ^ 0x5851F42D4C957F2D) + turn * STEP & MASK) for turn in (1, 2, 3)]
    expected = [float(bank[word % 2**20]) * (-1) ** (word >> 63) for word in words]
    assert single_normals(np.array([key], np.uint64), 3).tolist() == [expected]


# -- exact draws -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "vector",  # counter, key and words, from the test vectors of Random123 (Salmon et al. 2011)
    """
    00000000 00000000 00000000 00000000 00000000 00000000 6627e8d5 e169c58d bc57ac4c 9b00dbd8
    ffffffff ffffffff ffffffff ffffffff ffffffff ffffffff 408f276d 41c83b0e a20bc7c6 6d5451fd
    243f6a88 85a308d3 13198a2e 03707344 a4093822 299f31d0 d16cfe09 94fdcceb 5001e420 24126ea1
    """.strip().splitlines(),
)
def test_words_are_those_of_philox(vector: str) -> None:
    *given, first, second, third, fourth = (int(word, 16) for word in vector.split())
    assert philox(*map(np.uint32, given)) == (first, second, third, fourth)


def test_normals_are_the_transform_of_the_words() -> None:
    """Box and Muller in float64: the length from the first word of a pair, the angle from the
    second, of which the sign, one bit that swaps sine and cosine, and an angle up to pi / 4."""
    key, blocks = 0x0123456789ABCDEF, 50
    found = drawn_normals(key, (1, blocks, BLOCK))[0].reshape(blocks, 2, 2, BLOCK // 4)
    low, high = np.uint32(key & 0xFFFFFFFF), np.uint32(key >> 32)
    zero = np.uint32(0)
    counters = np.arange(blocks * BLOCK // 4, dtype=np.uint32)
    words = np.array([philox(c, zero, zero, zero, low, high) for c in counters], np.uint64)
    words = words.reshape(blocks, BLOCK // 4, 2, 2).transpose(0, 2, 3, 1)
    length, angle = words[:, :, 0], words[:, :, 1]
    radius = np.sqrt(-2.0 * np.log(((length >> 1) + 0.5) / 2.0**31))
    sign = np.where(angle >> 31, -1.0, 1.0)
    part = (angle & 0x3FFFFFFF).astype(np.int64)
    part = np.where(part >= 2**29, part - 2**30, part) / 2.0**29 * np.pi / 4
    swapped = (angle >> 30) & 1 > 0
    first = np.where(swapped, np.sin(part), np.cos(part))
    second = np.where(swapped, np.cos(part), np.sin(part))
    # The length is that of a float32: near 0, where it is the root of 1 - u, to 1e-4.
    np.testing.assert_allclose(found[:, :, 0], sign * radius * first, atol=2e-4)
    np.testing.assert_allclose(found[:, :, 1], sign * radius * second, atol=2e-4)
    large = radius > 0.1
    error = np.abs(found[:, :, 0] - sign * radius * first)[large]
    assert error.max() < 3e-6
    whole, part = (drawn_normals(5, (2, 1, 2 * BLOCK - left)) for left in (0, 37))
    np.testing.assert_array_equal(part, whole[..., :-37])  # frames end inside a block


# -- generators of torch ---------------------------------------------------------------------


@pytest.mark.parametrize("key", [(), (100.0, 1 / 64), (1 / 64, 100.0), (0.0,), (-0.0,)])
@pytest.mark.parametrize("seed", [0, 7, np.int64(7)])
def test_generators_are_seeded_by_numpys_mixture_of_the_key(seed: int, key: tuple) -> None:
    words = [int(seed), *map(bits, key)]
    (state,) = np.random.SeedSequence(words).generate_state(1, np.uint64)
    assert noise_generator(seed, *key).initial_seed() == int(state) // 2
