"""The map of the circle of confusion: what it depends on, and what it must not depend on."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch

from simulator.networks.aperture_module import LARGEST, DefocusMap, band_features, to_diameter
from simulator.optics.blur import disc_blur


@pytest.fixture(scope="module")
def network() -> DefocusMap:
    torch.manual_seed(3)
    made = DefocusMap(width=8).eval().requires_grad_(False)
    made.tail.weight.mul_(20.0)  # random, yet far from constant
    return made


def textured(*size: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    image = 0.1 + torch.rand(2, 4, *size, generator=generator)
    return image, torch.full_like(image, 0.01)


def test_exposure_does_not_matter(network: DefocusMap) -> None:
    image, deviation = textured(24, 30)
    expected = network(image, deviation)
    assert float(expected.std()) > 0.05
    for exponent in (-6, 3, 10):  # powers of two: only the tiny constant floor rounds differently
        factor = 2.0**exponent
        result = network(factor * image, factor * deviation)
        torch.testing.assert_close(result, expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize("level", [0.0, 1e-6, 0.3, 1.0, 1e4])
@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_constant_images_give_finite_maps_and_gradients(level: float, noise: float) -> None:
    torch.manual_seed(0)
    net = DefocusMap(width=8)
    image = torch.full((1, 4, 16, 16), level)
    diameter = net.diameter(image, torch.full_like(image, noise))
    diameter.sum().backward()
    assert bool(diameter.isfinite().all())
    assert all(bool(p.grad.isfinite().all()) for p in net.parameters() if p.grad is not None)


@pytest.mark.parametrize("size", [(1, 1), (1, 6), (3, 2), (16, 16), (17, 23)])
def test_every_size(network: DefocusMap, size: tuple[int, int]) -> None:
    log_blur = network(*textured(*size))
    assert log_blur.shape == (2, *size)
    assert bool(log_blur.isfinite().all())
    assert network.diameter(*textured(*size)).shape == (2, *size)


def test_diameters_are_in_range_and_invert_the_logarithm() -> None:
    diameters = torch.tensor([0.0, 0.5, 3.0, 11.9])
    torch.testing.assert_close(to_diameter(torch.log(diameters + 0.3)), diameters)
    extremes = to_diameter(torch.tensor([-1e4, 1e4, 88.0]))
    assert extremes.tolist() == [0.0, LARGEST, LARGEST]


def test_gradient_beyond_the_range_is_finite() -> None:
    log_blur = torch.tensor([-200.0, 0.0, 500.0], requires_grad=True)
    to_diameter(log_blur).sum().backward()
    assert log_blur.grad is not None
    assert bool(log_blur.grad.isfinite().all())


def test_blur_lowers_the_finest_band_relative_to_the_others() -> None:
    """The cue itself: the finest band's share of white noise's energy falls with the disc."""
    image = torch.from_numpy(np.random.default_rng(0).random((1, 4, 64, 64), dtype=np.float32))
    deviation = torch.full_like(image, 1e-4)
    relative = [
        band_features(disc_blur(image, diameter), deviation)[0, 4, 16:-16, 16:-16].mean()
        for diameter in (0.0, 1.5, 3.0, 6.0)
    ]
    assert relative == sorted(relative, reverse=True)
    assert relative[0] - relative[-1] > 0.5


def test_noise_is_told_from_texture() -> None:
    """On a flat field the last plane says that the contrast is nothing but noise."""
    image = torch.full((1, 4, 32, 32), 0.5)
    features = band_features(image, torch.full_like(image, 0.01))
    assert features.shape == (1, 9, 32, 32)
    assert features[:, 8].mean() == pytest.approx(1.0, abs=1e-3)  # log(1) * 0.3 + 1
    assert features[:, :4].abs().max() < 1e-3
    assert features[:, 4].mean() == pytest.approx(1.0 + 0.3 * math.log(1e-5), abs=1e-2)


def test_the_noise_of_four_planes_averages() -> None:
    """The floor is the variance of their mean: a quarter of one plane's, measured."""
    field = torch.from_numpy(np.random.default_rng(2).normal(0, 0.01, (1, 4, 200, 200))).float()
    deviation = torch.full_like(field, 0.01)
    noise_plane = band_features(field, deviation)[:, 8]
    # Bands 0 - 1.5 - 3 - 5.5 - 10 px of white noise: their energies, from the kernels' own pixels.
    kernel = torch.zeros(41, 41)
    kernel[20, 20] = 1.0
    discs = [disc_blur(kernel, d) for d in (0.0, 1.5, 3.0, 5.5, 10.0)]
    energy = sum(float((a - b).square().sum()) for a, b in itertools.pairwise(discs))
    expected = 1.0 + 0.3 * math.log(1 / (1 + energy))
    assert float(noise_plane[..., 20:-20, 20:-20].mean()) == pytest.approx(expected, abs=0.01)
