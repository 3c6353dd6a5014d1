"""Predicted errors of a network against closed forms: flat fields, white noise, waves."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
import torch

from simulator.capture import residual as residual_module
from simulator.capture.residual import Residual, ResidualStatistics, wiener_error
from simulator.noise.noise_level_function import NoiseLevelFunction


def nlf(shot: float, read: float) -> NoiseLevelFunction:
    return NoiseLevelFunction((shot,) * 4, (read,) * 4)


def leaves(bias: float, variance: float, *, detailed: float = 0.0) -> Residual:
    """Squared bias and variance of a network without detail, and squared bias with much of it."""
    tables = np.array([bias, detailed]), np.full(2, variance)
    return Residual(np.array([0.0, 1.0]), *tables, 1.0)


@pytest.mark.parametrize("variance", [0.0, 0.3, 3.0])
def test_noise_that_is_left_in_a_flat_field_and_in_white_noise(variance: float) -> None:
    """A standard deviation of 1 becomes sqrt(1 + v); without noise on top, sqrt(v) is left."""
    noise, rng = nlf(0.0, 4e-6), np.random.default_rng(0)
    white = torch.from_numpy(rng.normal(0.5, 2e-3, (4, 64, 64)).astype(np.float32))
    for light in (white, torch.full((4, 64, 64), 0.5), torch.full((4, 3, 5), 0.5)):
        found, network = ResidualStatistics(light, noise), leaves(0.0, variance)
        expected = math.sqrt(1.0 + variance) - 1.0
        assert found.error(network, 1.0, noise) == pytest.approx(expected)
        alone = found.error(network, 1.0, noise, noise=False)
        assert alone == pytest.approx(math.sqrt(variance))


def test_exposure_and_target_by_hand() -> None:
    """Noise 1e-4 * 0.05 + 1e-6 times 8^2 on top of 2e-4 * 0.4 + 1e-5; squared bias of 0.09."""
    relative = (1e-4 * 0.05 + 1e-6) * 64 / (2e-4 * 0.4 + 1e-5)
    found = ResidualStatistics(torch.full((4, 16, 24), 0.05), nlf(1e-4, 1e-6))
    network, target = leaves(0.09, 0.5, detailed=0.09), nlf(2e-4, 1e-5)
    expected = math.hypot(0.3 * math.sqrt(relative), math.sqrt(1 + 0.5 * relative) - 1)
    assert found.error(network, 8.0, target) == pytest.approx(expected)
    expected = math.sqrt((0.09 + 0.5) * relative)
    assert found.error(network, 8.0, target, noise=False) == pytest.approx(expected)
    assert found.error(network, 64.0, target) == 0.0  # a white frame
    assert found.error(network, 64.0, target, noise=False) > 1.0
    again = pickle.loads(pickle.dumps(found))
    assert again.error(network, 8.0, target, noise=False) == pytest.approx(expected)


def test_levels_of_light_count_by_their_share() -> None:
    """Read noise against shot noise: in units of the target's, light of 0.1 and 0.4, half each."""
    light = torch.full((4, 64, 48), 0.1)
    light[:, 32:] = 0.4
    found = ResidualStatistics(light, nlf(0.0, 1e-6))
    squares = [0.25 * 1e-6 / (1e-5 * level) for level in (0.1, 0.4)]
    error = found.error(leaves(0.25, 0.0, detailed=0.25), 1.0, nlf(1e-5, 0.0))
    assert error == pytest.approx(math.sqrt(sum(squares) / 2), rel=1e-5)


@pytest.mark.parametrize("amplitude", [0.0004, 0.002, 0.05])
@pytest.mark.parametrize("size", [(32, 128), (90, 128)])
def test_wiener_error_of_waves_by_hand(amplitude: float, size: tuple[int, int]) -> None:
    """Octave by octave: S / (1 + S) of the noise, for shares 3/4, 3/16, 3/64 and the rest.

    The mean of a wave over n pixels has sin(nk/2) / (n sin(k/2)) of its amplitude, the Laplacian of
    a cos(nkx) is 2 a (1 - cos nk) cos(nkx), and that of noise has 20 variances.
    """
    k, variance, expected = 2 * math.pi / 32, 1e-6 * 0.3 + 1e-7, 0.0
    for n, share in ((1, 3 / 4), (2, 3 / 16), (4, 3 / 64), (8, 1 / 64)):
        left = amplitude * math.sin(n * k / 2) / (n * math.sin(k / 2))
        energy = (2 * left * (1 - math.cos(n * k))) ** 2 / 2
        excess = max(energy / (20 * variance / n**2) - 1.0, 0.0)
        expected += share * excess / (1.0 + excess)
    wave = torch.cos(k * (torch.arange(128, dtype=torch.float64) + 0.5)).float()
    light = (0.3 + amplitude * wave).expand(4, *size)
    error = wiener_error(light, nlf(1e-6, 1e-7))
    assert error.shape == tuple(n // 8 for n in size)
    np.testing.assert_allclose(error.numpy(), max(expected, 2 / math.prod(size)), rtol=2e-3)
    assert (expected > 0.01) == (amplitude > 0.001)


def test_wiener_error_of_noise_is_hardly_any_and_of_too_much_noise_is_its_excess() -> None:
    """Twice the deviation is four times the energy: S is 3, whatever the octave."""
    rng, noise = np.random.default_rng(1), nlf(0.0, 1e-6)
    for scale, least, most in ((1e-3, 0.0, 0.005), (2e-3, 0.745, 0.755)):
        light = torch.from_numpy(rng.normal(0.2, scale, (4, 256, 256)).astype(np.float32))
        assert least <= float(wiener_error(light, noise).mean()) <= most


def test_wiener_error_is_that_of_the_place() -> None:
    """Noise that is taken for detail in one half of the frame does not count in the other."""
    rng = np.random.default_rng(2)
    scale = np.where(np.arange(192) < 64, 1e-3, 8e-3)
    light = torch.from_numpy(rng.normal(0.2, scale, (4, 100, 192)).astype(np.float32))
    error = wiener_error(light, nlf(0.0, 1e-6))
    assert error.shape == (12, 24)
    assert float(error[:, :4].max()) < 0.02  # the next window borders on the other half
    assert float(error[:, 8:].min()) > 0.95
    assert torch.equal(error[11], error[8])  # the rest belongs to the last window


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (5, 3), (17, 64)])
def test_wiener_error_of_small_frames(size: tuple[int, int]) -> None:
    """Few samples cannot be averaged: n keep about an nth of their noise, however flat it is."""
    error = wiener_error(torch.full((4, *size), 0.2), nlf(0.0, 1e-6))
    assert error.shape == tuple(max(1, n // 8) for n in size)
    assert torch.equal(error, torch.full_like(error, min(1.0, 2.0 / math.prod(size))))


def test_tables_are_read_by_the_logarithm_of_the_wiener_error() -> None:
    """0.097, 0.197, 0.397 and the 0.003 that is there by chance: 0.1, 0.2, 0.4."""
    table = np.array([0.2, 0.6]), np.array([1.0, 0.0])
    residual = Residual(np.array([0.097, 0.397]), *table, 1.0)
    bias, variance = residual.at(np.array([0, 0.097, 0.197, 0.397, 1]))
    np.testing.assert_allclose(bias, [0.2, 0.2, 0.4, 0.6, 0.6])
    np.testing.assert_allclose(variance, [1.0, 1.0, 0.5, 0.0, 0.0], atol=1e-12)


def test_of_a_large_frame_some_rows_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    light = torch.rand(1, 1, 64, generator=torch.Generator().manual_seed(0)).expand(4, 256, 64)
    network, noise = leaves(0.0, 0.2, detailed=3.0), nlf(1e-3, 1e-5)
    whole = ResidualStatistics(light, noise).error(network, 2.0, noise)
    monkeypatch.setattr(residual_module, "_BLOCKS", 32)
    monkeypatch.setattr(residual_module, "wiener_error", seen := Spy())
    assert ResidualStatistics(light, noise).error(network, 2.0, noise) == pytest.approx(whole)
    assert seen.rows == 32


class Spy:
    rows = 0

    def __call__(self, light: torch.Tensor, noise: NoiseLevelFunction) -> torch.Tensor:
        self.rows += light.shape[1]
        return wiener_error(light, noise)


CARD = {"wiener_error": [0.0, 0.5], "bias": [0.5, 0.25], "variance": [1.0, 0.75], "spread": 1.25}


def test_cards() -> None:
    assert Residual.from_card(CARD).to_card() == CARD
    for change, rule in (
        ({"spread": None}, "must be a calibration"),
        ({"bias": ["a", 1]}, "must be a calibration"),
        ({"bias": [1.0]}, "must be three lists of one length"),
        ({"variance": [1.0, math.nan]}, "must be finite and >= 0, its spread >= 1"),
        ({"variance": [1.0, -1.0]}, "must be finite and >= 0"),
        ({"spread": 0.9}, "its spread >= 1"),
    ):
        with pytest.raises(ValueError, match=rf"`residual` \(=.*\) {rule}|{rule}"):
            Residual.from_card(CARD | change)
