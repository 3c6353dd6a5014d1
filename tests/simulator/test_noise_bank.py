"""The bank of normals against closed forms: every bound is a sampling error of white noise."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
from scipy import stats

from simulator.noise_bank import (
    BANK_SIZE,
    BLOCK,
    STRIDE,
    frame_noise,
    noise_bank,
    noise_keys,
    single_normals,
)

SHAPE = (4, 128, 128)
PIXELS = math.prod(SHAPE)


def frames(count: int, seed: int = 1) -> np.ndarray:
    """(count, 4, 128, 128) noise of one rollout."""
    return np.stack([frame_noise(k, SHAPE) for k in noise_keys(seed, np.arange(count))])


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


def test_bank_has_the_moments_of_a_normal_and_no_correlation() -> None:
    bank = noise_bank()[:BANK_SIZE].astype(np.float64)
    assert abs(bank.mean()) < 1e-7
    assert bank.var() == pytest.approx(1.0, abs=1e-5)
    assert (bank**4).mean() == pytest.approx(3.0, abs=1e-3)
    for lag in (1, 2, 3, 16, 128, 256):
        # 5 standard errors of the correlation of independent samples.
        assert abs((bank[:-lag] * bank[lag:]).mean()) < 5.0 / math.sqrt(BANK_SIZE)


# -- keys -----------------------------------------------------------------------------------------


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


def test_a_frame_is_a_function_of_its_key_in_every_process() -> None:
    key = int(noise_keys(5, 2)[0])
    np.testing.assert_array_equal(frame_noise(key, SHAPE), frame_noise(key, SHAPE))
    assert (frame_noise(key, SHAPE) != frame_noise(key + 1, SHAPE)).mean() > 0.99
    code = (
        "from simulator.noise_bank import *\n"
        "print(frame_noise(int(noise_keys(5, 2)[0]), (4, 16, 16)).tobytes().hex())"
    )
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert bytes.fromhex(other.stdout.strip()) == frame_noise(key, (4, 16, 16)).tobytes()


# -- frames ---------------------------------------------------------------------------------------


def test_frames_have_the_moments_of_a_normal() -> None:
    noise = frames(100).astype(np.float64)
    n = noise.size
    assert abs(noise.mean()) < 5.0 / math.sqrt(n)
    # Standard errors of the k-th moment: sqrt(E x^2k - (E x^k)^2), 15 = E x^6 and so on.
    assert abs((noise**2).mean() - 1.0) < 5.0 * math.sqrt(2.0 / n)
    assert abs((noise**3).mean()) < 5.0 * math.sqrt(15.0 / n)
    assert abs((noise**4).mean() - 3.0) < 5.0 * math.sqrt(96.0 / n)


def test_one_frame_is_normally_distributed() -> None:
    """Distance of the distribution functions of a frame: 1.95 / sqrt(n) is its 99.9 % bound."""
    for key in noise_keys(9, np.arange(5)):
        distance = stats.kstest(frame_noise(int(key), SHAPE).ravel(), "norm").statistic
        assert distance < 1.95 / math.sqrt(PIXELS)


def test_frames_are_white_in_space() -> None:
    noise = frames(50).astype(np.float64)
    for rows, columns in [(0, 1), (0, 2), (0, 16), (1, 0), (1, 1), (2, 0), (2, 3), (4, 0), (64, 0)]:
        first = noise[..., rows:, columns:]
        second = noise[..., : 128 - rows, : 128 - columns]
        assert abs((first * second).mean()) < 5.0 / math.sqrt(first.size)


def test_frames_are_white_in_time_and_over_planes() -> None:
    noise = frames(100).astype(np.float64)
    for lag in (1, 2, 7):
        pairs = noise[lag:] * noise[:-lag]
        assert abs(pairs.mean()) < 5.0 / math.sqrt(pairs.size)
    across = noise[:, 1:] * noise[:, :-1]
    assert abs(across.mean()) < 5.0 / math.sqrt(across.size)


def test_neighbouring_seeds_are_independent() -> None:
    first, second = frames(50, seed=100).astype(np.float64), frames(50, seed=101)
    assert abs((first * second).mean()) < 5.0 / math.sqrt(first.size)


def test_variance_over_time_is_the_same_everywhere() -> None:
    """No pixel is stuck: each one's variance over 200 frames is chi-squared."""
    noise = np.stack([frame_noise(k, (4, 32, 32)) for k in noise_keys(2, np.arange(200))])
    p = stats.kstest(199.0 * noise.var(axis=0, ddof=1).ravel(), "chi2", args=(199,)).pvalue
    assert p > 1e-3


# -- repetition -----------------------------------------------------------------------------------


def test_no_shift_makes_two_frames_alike() -> None:
    """Largest correlation of two frames over all 65,536 shifts, against that of white noise.

    The largest of n standard normals is near sqrt(2 ln n) = 4.7. A pair of blocks that share
    their samples adds 256 to a sum whose standard deviation is sqrt(65,536) = 256: one unit more.
    """
    noise = frames(20).astype(np.float64).reshape(20, -1)
    spectra = np.fft.rfft(noise)
    for i in range(19):
        correlation = np.fft.irfft(spectra[i].conj() * spectra[i + 1], n=PIXELS)
        peak = np.abs(correlation).max() / math.sqrt(PIXELS)
        assert peak < math.sqrt(2.0 * math.log(PIXELS)) + 2.0


def test_blocks_repeat_as_often_as_chance_has_it() -> None:
    """Pairs of blocks with the same start: n (n - 1) / 2 pairs, 65,536 starts."""
    count = 40
    blocks = frames(count).reshape(count * PIXELS // BLOCK, BLOCK)
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
    firsts = np.array([frame_noise(int(k), (1, 1, 1)).item() for k in keys[:4000]])
    assert abs((firsts * values[:4000, 0]).mean()) < 5.0 / math.sqrt(4000)


@pytest.mark.parametrize("shape", [(4, 1, 1), (1, 16, 16), (4, 37, 53), (4, 16, 17)])
def test_any_size(shape: tuple[int, int, int]) -> None:
    noise = frame_noise(11, shape)
    assert noise.shape == shape
    assert noise.dtype == np.float32
