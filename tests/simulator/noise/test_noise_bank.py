"""The bank of normals against closed forms: every bound is a sampling error of white noise."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from simulator.noise.generator import (
    BANK_SIZE,
    BLOCK,
    STRIDE,
    bank_normals,
    noise_bank,
    noise_keys,
    single_normals,
)

SHAPE = (4, 128, 128)
PIXELS = math.prod(SHAPE)


def frames(count: int, seed: int = 1) -> np.ndarray:
    """(count, 4, 128, 128) noise of one rollout."""
    return np.stack([bank_normals(k, SHAPE) for k in noise_keys(seed, np.arange(count))])


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


# -- repetition ------------------------------------------------------------------------------------


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
    firsts = np.array([bank_normals(int(k), (1, 1, 1)).item() for k in keys[:4000]])
    assert abs((firsts * values[:4000, 0]).mean()) < 5.0 / math.sqrt(4000)


@pytest.mark.parametrize("shape", [(4, 1, 1), (1, 16, 16), (4, 37, 53), (4, 16, 17)])
def test_any_size(shape: tuple[int, int, int]) -> None:
    noise = bank_normals(11, shape)
    assert noise.shape == shape
    assert noise.dtype == np.float32
