"""Noise of frames: keys, the bank, exact draws; against closed forms and published vectors.

Every bound is a sampling error of white noise.
"""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from simulator.noise.generator import (
    BANK_SIZE,
    BLOCK,
    STRIDE,
    Noise,
    bank_normals,
    drawn_normals,
    frame_normals,
    noise_bank,
    noise_generator,
    noise_keys,
    philox,
    single_normals,
    sweep_keys,
)
from simulator.settings import CameraSettings

SHAPE = (4, 128, 128)
PIXELS = math.prod(SHAPE)

both = pytest.mark.parametrize("kind", ["exact", "bank"])


def frames(kind: Noise, count: int, seed: int = 1) -> np.ndarray:
    """(count, 4, 128, 128) noise of one rollout."""
    return np.stack([normals(k, kind) for k in noise_keys(seed, np.arange(count))])


def normals(key: int, kind: Noise, shape: tuple[int, int, int] = SHAPE) -> np.ndarray:
    """Of one frame."""
    return frame_normals(int(key), shape, kind)


@both
def test_a_frame_is_a_function_of_its_key_in_every_process(kind: Noise) -> None:
    key = int(noise_keys(5, 2)[0])
    np.testing.assert_array_equal(normals(key, kind), normals(key, kind))
    assert (normals(key, kind) != normals(key + 1, kind)).mean() > 0.99
    code = (
        "from simulator.noise.generator import frame_normals, noise_keys\n"
        f"noise = frame_normals(int(noise_keys(5, 2)[0]), (4, 16, 16), {kind!r})\n"
        "print(noise.tobytes().hex())"
    )
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert bytes.fromhex(other.stdout.strip()) == normals(key, kind, (4, 16, 16)).tobytes()


@both
def test_frames_have_the_moments_of_a_normal(kind: Noise) -> None:
    noise = frames(kind, 100).astype(np.float64)
    n = noise.size
    assert abs(noise.mean()) < 5.0 / math.sqrt(n)
    # Standard errors of the k-th moment: sqrt(E x^2k - (E x^k)^2), 15 = E x^6 and so on.
    assert abs((noise**2).mean() - 1.0) < 5.0 * math.sqrt(2.0 / n)
    assert abs((noise**3).mean()) < 5.0 * math.sqrt(15.0 / n)
    assert abs((noise**4).mean() - 3.0) < 5.0 * math.sqrt(96.0 / n)


@both
def test_one_frame_is_normally_distributed(kind: Noise) -> None:
    """Distance of the distribution functions of a frame: 1.95 / sqrt(n) is its 99.9 % bound."""
    for key in noise_keys(9, np.arange(5)):
        distance = stats.kstest(normals(key, kind).ravel(), "norm").statistic
        assert distance < 1.95 / math.sqrt(PIXELS)


@both
def test_frames_are_white_in_space(kind: Noise) -> None:
    noise = frames(kind, 50).astype(np.float64)
    for rows, columns in [(0, 1), (0, 2), (0, 16), (1, 0), (1, 1), (2, 0), (2, 3), (4, 0), (64, 0)]:
        first = noise[..., rows:, columns:]
        second = noise[..., : 128 - rows, : 128 - columns]
        assert abs((first * second).mean()) < 5.0 / math.sqrt(first.size)


@both
def test_frames_are_white_in_time_and_over_planes(kind: Noise) -> None:
    noise = frames(kind, 100).astype(np.float64)
    for lag in (1, 2, 7):
        pairs = noise[lag:] * noise[:-lag]
        assert abs(pairs.mean()) < 5.0 / math.sqrt(pairs.size)
    across = noise[:, 1:] * noise[:, :-1]
    assert abs(across.mean()) < 5.0 / math.sqrt(across.size)


@both
def test_no_shift_makes_two_frames_alike(kind: Noise) -> None:
    """Largest correlation of two frames over all 65,536 shifts, against that of white noise.

    The largest of n standard normals is near sqrt(2 ln n) = 4.7. A pair of blocks that share
    their samples adds 256 to a sum whose standard deviation is sqrt(65,536) = 256: one unit more.
    """
    noise = frames(kind, 20).astype(np.float64).reshape(20, -1)
    spectra = np.fft.rfft(noise)
    for i in range(19):
        correlation = np.fft.irfft(spectra[i].conj() * spectra[i + 1], n=PIXELS)
        peak = np.abs(correlation).max() / math.sqrt(PIXELS)
        assert peak < math.sqrt(2.0 * math.log(PIXELS)) + 2.0


# -- keys of sweeps -------------------------------------------------------------------------------


def test_frames_of_a_sweep_differ_by_each_setting_and_the_seed() -> None:
    base = CameraSettings(100, 1 / 64, 4.0)
    others = [CameraSettings(200, 1 / 64, 4.0), CameraSettings(100, 1 / 32, 4.0)]
    others.append(CameraSettings(100, 1 / 64, 5.6))
    keys = [*sweep_keys(7, [base, *others]), *sweep_keys(8, [base, *others])]
    assert len(set(keys)) == 8
    assert sweep_keys(np.int64(7), [others[1]])[0] == keys[2]
    assert sweep_keys(2**64 - 1, [base]).dtype == np.uint64
    assert len(sweep_keys(7, [])) == 0


@pytest.mark.parametrize("seed", [-1, 1.5, "1", None, True, 2**64])
def test_bad_seeds_are_named(seed: object) -> None:
    with pytest.raises(ValueError, match="`seed`"):
        sweep_keys(seed, [CameraSettings(100, 1 / 64, 4.0)])  # type: ignore[arg-type]


def test_a_key_is_a_function_of_its_numbers() -> None:
    keys = noise_keys(np.array([3, 4, 3]), np.array([0, 0, 1]))
    assert keys.dtype == np.uint64
    assert len(set(keys.tolist())) == 3
    assert keys[0] == noise_keys(3, 0)[0] == noise_keys(np.int64(3), 0.0)[0]
    assert noise_keys(7, 100.0, 1 / 64, 4.0) != noise_keys(7, 100.0, 4.0, 1 / 64)
    many = noise_keys(np.arange(1000).repeat(50), np.tile(np.arange(50), 1000))
    assert len(np.unique(many)) == 50_000


@pytest.mark.parametrize("seed", [-1, 1.5, "a"])
def test_seeds_are_checked(seed: object) -> None:
    with pytest.raises(ValueError, match="`seeds`"):
        noise_keys(seed, 0)  # type: ignore[arg-type]


# -- the bank itself ------------------------------------------------------------------------------


def test_bank_holds_every_quantile_once() -> None:
    bank = noise_bank()
    assert bank.shape == (BANK_SIZE + BLOCK,)
    assert bank.dtype == np.float32
    assert not bank.flags.writeable
    np.testing.assert_array_equal(bank[BANK_SIZE:], bank[:BLOCK])
    # The inverse of the distribution function, from another library, at a few of its quantiles.
    ordered, at = np.sort(bank[:BANK_SIZE]), [0, 1, 1000, BANK_SIZE // 2, BANK_SIZE - 1]
    quantiles = stats.norm.isf((np.array(at) + 0.5) / BANK_SIZE)[::-1]
    np.testing.assert_allclose(ordered[BANK_SIZE - 1 - np.array(at)][::-1], quantiles, rtol=1e-6)


# -- repetition ------------------------------------------------------------------------------------


def test_blocks_repeat_as_often_as_chance_has_it() -> None:
    """Pairs of blocks with the same start: n (n - 1) / 2 pairs, 65,536 starts."""
    count = 40
    blocks = frames("bank", count).reshape(count * PIXELS // BLOCK, BLOCK)
    firsts = np.abs(blocks[:, :4]).astype(np.float64) @ [1.0, 1e3, 1e6, 1e9]
    _, times = np.unique(firsts, return_counts=True)
    pairs = (times * (times - 1) // 2).sum()
    expected = len(blocks) * (len(blocks) - 1) / 2 / (BANK_SIZE // STRIDE)
    assert pairs == pytest.approx(expected, abs=5.0 * math.sqrt(expected))


# -- single normals -------------------------------------------------------------------------------


def test_single_normals_are_normal_and_apart_from_the_frames() -> None:
    keys = noise_keys(4, np.arange(20_000))
    values = single_normals(keys, 2)
    assert values.shape == (20_000, 2)
    np.testing.assert_array_equal(values[7], single_normals(keys[7:8], 2)[0])
    assert stats.kstest(values.ravel(), "norm").statistic < 1.95 / math.sqrt(values.size)
    assert abs((values[:, 0] * values[:, 1]).mean()) < 5.0 / math.sqrt(len(values))
    firsts = np.array([bank_normals(int(k), (1, 1, 1)).item() for k in keys[:4000]])
    assert abs((firsts * values[:4000, 0]).mean()) < 5.0 / math.sqrt(4000)


# From the test vectors that come with Random123 (Salmon et al. 2011).
@pytest.mark.parametrize(
    ("counter", "key", "words"),
    [
        (
            "00000000 00000000 00000000 00000000",
            "00000000 00000000",
            "6627e8d5 e169c58d bc57ac4c 9b00dbd8",
        ),
        (
            "ffffffff ffffffff ffffffff ffffffff",
            "ffffffff ffffffff",
            "408f276d 41c83b0e a20bc7c6 6d5451fd",
        ),
        (
            "243f6a88 85a308d3 13198a2e 03707344",
            "a4093822 299f31d0",
            "d16cfe09 94fdcceb 5001e420 24126ea1",
        ),
    ],
)
def test_words_are_those_of_philox(counter: str, key: str, words: str) -> None:
    given = [np.uint32(int(word, 16)) for word in f"{counter} {key}".split()]
    assert " ".join(f"{word:08x}" for word in philox(*given)) == words


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


def test_frames_end_inside_a_block() -> None:
    whole = drawn_normals(5, (2, 1, 2 * BLOCK))
    part = drawn_normals(5, (2, 1, 2 * BLOCK - 37))
    np.testing.assert_array_equal(part, whole[..., : 2 * BLOCK - 37])


def test_tails_are_those_of_a_normal() -> None:
    """Samples beyond 3, 4 and 5 standard deviations: their number is Poisson distributed."""
    normals = np.abs(drawn_normals(2, (4, 2048, 2048)))
    for limit, share in ((3.0, 2.6998e-3), (4.0, 6.3342e-5), (5.0, 5.7330e-7)):
        expected = share * normals.size
        assert (normals > limit).sum() == pytest.approx(expected, abs=5.0 * expected**0.5)


# -- generators of torch ---------------------------------------------------------------------


def test_the_same_key_gives_the_same_draws() -> None:
    first, second = noise_generator(7, 100.0, 1 / 64), noise_generator(7, 100.0, 1 / 64)
    assert torch.equal(torch.randn(100, generator=first), torch.randn(100, generator=second))


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ((7,), (8,)),
        ((7, 100.0, 200.0), (7, 200.0, 100.0)),
        ((7, 1.0), (7, math.nextafter(1.0, 2.0))),
        ((7, 0.0), (7, -0.0)),
    ],
)
def test_different_keys_give_independent_draws(
    first: tuple[int, ...], second: tuple[int, ...]
) -> None:
    n = 10_000
    a = torch.randn(n, generator=noise_generator(*first), dtype=torch.float64)
    b = torch.randn(n, generator=noise_generator(*second), dtype=torch.float64)
    assert abs(float((a * b).mean())) < 5 / math.sqrt(n)


def test_numpy_integers_are_seeds() -> None:
    assert noise_generator(np.int64(5)).initial_seed() == noise_generator(5).initial_seed()
    assert all(noise_generator(seed).initial_seed() < 2**63 for seed in range(8))


@pytest.mark.parametrize("seed", [-1, 1.5, "1", None, True])
def test_bad_seeds_of_generators_are_named(seed: object) -> None:
    with pytest.raises(ValueError, match="`seed`"):
        noise_generator(seed)  # type: ignore[arg-type]


# -- for any input --------------------------------------------------------------------


@given(
    st.integers(0, 2**64 - 1),
    st.lists(st.floats(allow_nan=False), max_size=4),
    st.integers(2, 40),
)
def test_noise_keys_are_of_seed_and_numbers_alone(seed: int, numbers: list[float], n: int) -> None:
    (key,) = noise_keys(seed, *numbers)
    batch = noise_keys(np.full(n, seed, np.uint64), *(np.full(n, v) for v in numbers))
    assert bool((batch == key).all())
    others = np.arange(n, dtype=np.uint64) ^ np.uint64(seed)
    keys = noise_keys(others, *numbers)
    assert len(set(keys.tolist())) == n
    assert keys[0] == key
    if numbers:  # another last number, another key
        last = np.arange(float(n))
        assert len(set(noise_keys(seed, *numbers[:-1], last).tolist())) == n
        assert noise_keys(seed, *numbers[:-1])[0] != key
    planes = bank_normals(int(key), (4, 1, n))
    assert np.array_equal(planes[:, 0, :1], bank_normals(int(key), (4, 1, 1))[:, 0])
