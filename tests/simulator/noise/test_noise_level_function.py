"""Noise level functions applied to images, and the generators that noise is drawn from."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from simulator.noise.generator import noise_generator
from simulator.noise.noise_level_function import NoiseLevelFunction, nlf_tensors, noise_variance
from simulator.noise.top_up import top_up_variance

CLEAN = NoiseLevelFunction((1e-5, 2e-5, 3e-5, 4e-5), (1e-8, 2e-8, 3e-8, 4e-8))
NOISY = NoiseLevelFunction((5e-4, 4e-4, 4e-4, 3e-4), (5e-7, 4e-7, 4e-7, 3e-7))


def signal(*levels: float) -> torch.Tensor:
    return torch.tensor(levels, dtype=torch.float32).expand(4, 1, len(levels))


def test_variance_is_read_plus_shot_times_signal() -> None:
    variance = noise_variance(signal(0.0, 0.5, 2.0), CLEAN)
    expected = [[r, r + 0.5 * s, r + 2 * s] for s, r in zip(CLEAN.shot, CLEAN.read, strict=True)]
    np.testing.assert_allclose(variance[:, 0].numpy(), expected, rtol=1e-6)


def test_negative_signals_carry_read_noise_only() -> None:
    """The square root of a negative variance is the classic NaN."""
    variance = noise_variance(signal(-0.07, -1e-9, -1e6), CLEAN)
    np.testing.assert_allclose(variance[:, 0].numpy(), np.array([CLEAN.read] * 3).T, rtol=1e-6)
    assert torch.isfinite(variance.sqrt()).all()


def test_variances_below_half_precision_are_kept() -> None:
    tiny = NoiseLevelFunction((0.0,) * 4, (5e-9,) * 4)
    half = signal(0.0, 0.1).to(torch.float16)
    assert noise_variance(half, tiny).dtype == torch.float32
    np.testing.assert_allclose(noise_variance(half, tiny).numpy(), 5e-9, rtol=1e-6)


def test_nlf_tensors_broadcast_over_planes() -> None:
    shot, read = nlf_tensors(CLEAN)
    assert shot.shape == read.shape == (4, 1, 1)
    assert shot[:, 0, 0].tolist() == pytest.approx(CLEAN.shot)
    assert read[:, 0, 0].tolist() == pytest.approx(CLEAN.read)


def test_top_up_is_the_difference_of_the_two_noises() -> None:
    levels = (-0.05, 0.0, 0.2, 0.9)
    missing, excess = top_up_variance(signal(*levels), CLEAN, NOISY)
    difference = noise_variance(signal(*levels), NOISY) - noise_variance(signal(*levels), CLEAN)
    np.testing.assert_allclose(missing.numpy(), difference.numpy(), rtol=1e-5)
    assert float(excess.abs().max()) == 0.0
    missing, excess = top_up_variance(signal(*levels), NOISY, CLEAN)
    np.testing.assert_allclose(excess.numpy(), difference.numpy(), rtol=1e-5)
    assert float(missing.abs().max()) == 0.0


def test_top_up_may_be_needed_in_the_shadows_only() -> None:
    """Less shot but more read noise in the target: the two cross at (4e-6 - 1e-6) / 1e-4 = 0.03."""
    source = NoiseLevelFunction((2e-4,) * 4, (1e-6,) * 4)
    target = NoiseLevelFunction((1e-4,) * 4, (4e-6,) * 4)
    missing, excess = top_up_variance(signal(0.01, 0.05), source, target)
    np.testing.assert_allclose(missing[:, 0].numpy(), [[2e-6, 0.0]] * 4, rtol=1e-5)
    np.testing.assert_allclose(excess[:, 0].numpy(), [[0.0, 2e-6]] * 4, rtol=1e-5)


def test_equal_noises_need_nothing() -> None:
    missing, excess = top_up_variance(signal(-1.0, 0.0, 0.5, 1e6), NOISY, NOISY)
    assert not missing.any()
    assert not excess.any()


def test_the_same_key_gives_the_same_draws() -> None:
    first, second = noise_generator(7, 100.0, 1 / 64), noise_generator(7, 100.0, 1 / 64)
    assert torch.equal(torch.randn(100, generator=first), torch.randn(100, generator=second))


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ((7,), (8,)),
        ((0, 1.0), (1, 0.0)),
        ((7, 100.0, 1 / 64), (7, 100.0, 1 / 65)),
        ((7, 100.0, 200.0), (7, 200.0, 100.0)),
        ((7, 0.0), (7, 1.0)),
        ((7, 1.0), (7, math.nextafter(1.0, 2.0))),
        ((2**40,), (2**40 + 1,)),
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


def test_consecutive_seeds_are_unrelated() -> None:
    n, seeds = 4000, 40
    draws = torch.stack([torch.randn(n, generator=noise_generator(s, 3)) for s in range(seeds)])
    correlation = np.corrcoef(draws.numpy())
    largest = np.abs(correlation - np.eye(seeds)).max()
    assert largest < 5.5 / math.sqrt(n)  # 780 pairs: 5.5 sigma is a chance of 3e-5


def test_the_global_generators_are_left_alone() -> None:
    before = torch.random.get_rng_state()
    noise_generator(3, 1.5)
    assert torch.equal(torch.random.get_rng_state(), before)


def test_numpy_integers_are_seeds() -> None:
    assert noise_generator(np.int64(5)).initial_seed() == noise_generator(5).initial_seed()


@pytest.mark.parametrize("seed", [-1, 1.5, "1", None, True])
def test_bad_seeds_are_named(seed: object) -> None:
    with pytest.raises(ValueError, match="`seed`"):
        noise_generator(seed)  # type: ignore[arg-type]
