"""The missing-noise formula: D(x) by hand, and what is added and left over."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from simulator.noise.noise_level_function import NoiseLevelFunction, noise_variance
from simulator.noise.top_up import missing_variance, top_up_table, top_up_variance

CLEAN = NoiseLevelFunction((1e-5, 2e-5, 3e-5, 4e-5), (1e-8, 2e-8, 3e-8, 4e-8))
NOISY = NoiseLevelFunction((5e-4, 4e-4, 4e-4, 3e-4), (5e-7, 4e-7, 4e-7, 3e-7))


def signal(*levels: float) -> torch.Tensor:
    return torch.tensor(levels, dtype=torch.float32).expand(4, 1, len(levels))


def test_top_up_is_the_difference_of_the_two_noises() -> None:
    levels = (-0.05, 0.0, 0.2, 0.9)
    missing, excess = top_up_variance(signal(*levels), CLEAN, NOISY)
    difference = noise_variance(signal(*levels), NOISY) - noise_variance(signal(*levels), CLEAN)
    np.testing.assert_allclose(missing.numpy(), difference.numpy(), rtol=1e-5)
    assert float(excess.abs().max()) == 0.0
    missing, excess = top_up_variance(signal(*levels), NOISY, CLEAN)
    np.testing.assert_allclose(excess.numpy(), difference.numpy(), rtol=1e-5)
    assert float(missing.abs().max()) == 0.0
    for needed in top_up_variance(signal(*levels), NOISY, NOISY):
        assert not needed.any()


def test_top_up_may_be_needed_in_the_shadows_only() -> None:
    """Less shot but more read noise in the target: the two cross at (4e-6 - 1e-6) / 1e-4 = 0.03."""
    source = NoiseLevelFunction((2e-4,) * 4, (1e-6,) * 4)
    target = NoiseLevelFunction((1e-4,) * 4, (4e-6,) * 4)
    missing, excess = top_up_variance(signal(0.01, 0.05), source, target)
    np.testing.assert_allclose(missing[:, 0].numpy(), [[2e-6, 0.0]] * 4, rtol=1e-5)
    np.testing.assert_allclose(excess[:, 0].numpy(), [[0.0, 2e-6]] * 4, rtol=1e-5)


def test_blur_makes_the_share_that_it_took_missing() -> None:
    """A quarter of the source's variance is left: three quarters are missing, too."""
    share = torch.tensor([[1.0, 0.25]])
    table = top_up_table([CLEAN], [NOISY])[0]
    missing = missing_variance(signal(0.5, 0.5), table, share)
    for plane in range(4):
        given = CLEAN.read[plane] + 0.5 * CLEAN.shot[plane]
        wanted = NOISY.read[plane] + 0.5 * NOISY.shot[plane]
        expected = [wanted - given, wanted - 0.25 * given]
        assert missing[plane, 0].tolist() == pytest.approx(expected, rel=1e-5)
        # One plane alone, by its column of the table.
        alone = missing_variance(signal(0.5, 0.5)[plane], table[:, plane], share)
        assert torch.equal(alone, missing[plane])
    lacking, excess = top_up_variance(signal(0.5, 0.5), NOISY, NOISY, share)
    assert lacking[:, 0, 0].tolist() == [0.0] * 4
    assert lacking[1, 0, 1] == pytest.approx(0.75 * (4e-7 + 0.5 * 4e-4), rel=1e-5)
    assert not excess.any()


def test_the_table_has_the_differences_in_float64() -> None:
    nearly = NoiseLevelFunction((1e-4 * (1 + 1e-12),) * 4, CLEAN.read)
    table = top_up_table([NoiseLevelFunction((1e-4,) * 4, CLEAN.read), CLEAN], [nearly, NOISY])
    assert table.shape == (2, 4, 4)
    assert table[0, 0] == pytest.approx(1e-16, rel=1e-3)
    assert table[0, 1].tolist() == [0.0] * 4
    np.testing.assert_allclose(table[1, 0], np.subtract(NOISY.shot, CLEAN.shot))
    assert table[1, 2].tolist() == list(CLEAN.shot)
    assert table[1, 3].tolist() == list(CLEAN.read)
    assert top_up_table([], []).shape == (0, 4, 4)
