"""Noise level functions: their arithmetic, and the variance of images."""

from __future__ import annotations

import math
from dataclasses import FrozenInstanceError

import numpy as np
import pytest
import torch

from simulator.noise.noise_level_function import NoiseLevelFunction, noise_variance

CLEAN = NoiseLevelFunction((1e-5, 2e-5, 3e-5, 4e-5), (1e-8, 2e-8, 3e-8, 4e-8))


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


def test_noise_level_function_arithmetic() -> None:
    nlf = NoiseLevelFunction((4e-5, 3e-5, 3e-5, 2e-5), (4e-8, 3e-8, 3e-8, 2e-8))
    assert nlf.exposed(8).shot == pytest.approx((32e-5, 24e-5, 24e-5, 16e-5))
    assert nlf.exposed(8).read == pytest.approx((256e-8, 192e-8, 192e-8, 128e-8))
    assert nlf.scaled(1 / 16).shot == pytest.approx((2.5e-6, 1.875e-6, 1.875e-6, 1.25e-6))
    assert nlf.scaled(1 / 16).read == pytest.approx((2.5e-9, 1.875e-9, 1.875e-9, 1.25e-9))
    assert NoiseLevelFunction.zero().is_zero
    assert nlf.zero().is_zero
    assert not nlf.is_zero
    assert not NoiseLevelFunction((0,) * 4, (0, 0, 0, 1e-12)).is_zero
    with pytest.raises(FrozenInstanceError):
        nlf.source = "other"  # type: ignore[misc]
    most = NoiseLevelFunction((1.0,) * 4, (1.0,) * 4).exposed(1e30)
    assert (most.shot, most.read) == ((1e24,) * 4, (1e24,) * 4)
    larger = nlf.at_least(NoiseLevelFunction((3e-5,) * 4, (1e-8, 4e-8, 3e-8, 3e-8)))
    assert larger.shot == (4e-5, 3e-5, 3e-5, 3e-5)
    assert larger.read == (4e-8, 4e-8, 3e-8, 3e-8)


@pytest.mark.parametrize(
    "value",
    [
        (1e-5,) * 3,
        (-1e-9,) * 4,
        (math.nan,) * 4,
        (math.inf,) * 4,
        1,
        "abcd",
        None,
        (1e-5,) * 5,
        (1e-5, 1e-5, -1e-5, 1e-5),
    ],
)
@pytest.mark.parametrize("name", ["shot", "read"])
def test_bad_noise_level_function(name: str, value: object) -> None:
    arguments = {"shot": (1e-5,) * 4, "read": (1e-8,) * 4, name: value}
    with pytest.raises(ValueError, match=rf"`{name}` \(=.*\) must be 4 finite values >= 0"):
        NoiseLevelFunction(**arguments)  # type: ignore[arg-type]
