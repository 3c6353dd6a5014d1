"""The compact denoiser: commutes with exposure, takes any size, and starts near the identity."""

from __future__ import annotations

import pytest
import torch

from simulator.networks.noise_module import CompactDenoiser


def network(seed: int = 0, gain: float = 30.0) -> CompactDenoiser:
    """Random weights, the last ones large enough that the network does something."""
    torch.manual_seed(seed)
    made = CompactDenoiser((8, 12, 16)).eval().requires_grad_(False)
    made.tail.weight.mul_(gain)
    return made


def noisy(*size: int, seed: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(2, 4, *size, generator=generator)
    return image, 0.02 + 0.1 * torch.rand(2, 4, *size, generator=generator)


@pytest.mark.parametrize("exponent", [-12, -3, 1, 12])
def test_powers_of_two_pass_through_exactly(exponent: int) -> None:
    image, deviation = noisy(17, 22)
    net, factor = network(), 2.0**exponent
    output = net(image, deviation)
    assert (output - image).abs().mean() > 0.01  # the network does something
    assert torch.equal(net(factor * image, factor * deviation), factor * output)


@pytest.mark.parametrize("factor", [1 / 4095.3, 0.3, 3.7, 1234.5])
def test_any_factor_passes_through_within_rounding(factor: float) -> None:
    image, deviation = noisy(17, 22)
    net = network()
    expected = factor * net(image, deviation)
    error = (net(factor * image, factor * deviation) - expected).abs().max()
    assert error <= 2e-6 * expected.abs().max()


def test_no_parameter_is_a_bias() -> None:
    """One bias anywhere would end the homogeneity once training moved it from 0."""
    assert all(parameter.ndim == 4 for parameter in CompactDenoiser().parameters())


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (2, 3), (16, 16), (17, 19), (20, 31)])
def test_every_size(size: tuple[int, int]) -> None:
    output = network()(*noisy(*size))
    assert output.shape == (2, 4, *size)
    assert bool(output.isfinite().all())


def test_padding_does_not_reach_into_the_image_from_afar() -> None:
    """A size that is no multiple of 4 gives, away from its new edge, what a larger frame gives."""
    image, deviation = noisy(32, 64)
    net = network()
    whole, part = net(image, deviation), net(image[..., :61], deviation[..., :61])
    torch.testing.assert_close(part[..., :20], whole[..., :20], atol=1e-5, rtol=0)


def test_a_new_network_starts_near_the_identity() -> None:
    """The last layer's small weights: without them the change is 14 times the image."""
    torch.manual_seed(0)
    image, deviation = noisy(16, 16)
    change = CompactDenoiser()(image, deviation) - image
    assert 0 < change.abs().mean() < 0.5 * image.mean()


def test_the_deviation_map_matters() -> None:
    image, deviation = noisy(16, 16)
    net = network()
    assert (net(image, deviation) - net(image, 2 * deviation)).abs().mean() > 1e-3
