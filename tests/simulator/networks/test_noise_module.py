"""The noise module: the noise level that its networks see, and how it scales with exposure."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import uniform_filter
from torch import Tensor, nn

from simulator import get_camera
from simulator.networks.noise_module import (
    CompactDenoiser,
    NoiseModule,
    Preset,
    smoothed,
    variance_map,
)

NLF = get_camera("nikon_z6").nlf(6400)
SHOT, READ = torch.tensor([NLF.shot]), torch.tensor([NLF.read])


class Seen(nn.Module):
    """A network that keeps what it is given and returns a constant."""

    def __init__(self, value: float) -> None:
        super().__init__()
        self.value, self.given = value, ()

    def forward(self, *given: Tensor) -> Tensor:
        self.given = given
        return torch.full_like(given[0][:, :4], self.value)


def noisy(height: int = 16, width: int = 18) -> Tensor:
    values = np.random.default_rng(0).normal(0.05, 0.06, (1, 4, height, width))
    return torch.from_numpy(values.astype(np.float32))


@pytest.mark.parametrize("preset", ["compact", "paper"])
@pytest.mark.parametrize("size", [(16, 16), (13, 17), (2, 3), (1, 1)])
def test_both_presets_take_every_size(preset: Preset, size: tuple[int, int]) -> None:
    torch.manual_seed(0)
    module = NoiseModule(preset).requires_grad_(False)
    output = module(noisy(*size), SHOT, READ)
    assert output.shape == (1, 4, *size)
    assert output.dtype == torch.float32
    assert bool(output.isfinite().all())


def test_unknown_preset() -> None:
    with pytest.raises(ValueError, match=r"`preset` \(='tiny'\) must be one of"):
        NoiseModule("tiny")  # type: ignore[arg-type]


def test_variance_by_hand_and_below_zero() -> None:
    """read + shot * max(x, 0): a negative pixel must not lower the variance, let alone below 0."""
    signal = torch.tensor([-0.5, 0.0, 0.25, 1.5]).reshape(1, 1, 2, 2).expand(2, 4, 2, 2)
    shot = torch.arange(1.0, 9.0).reshape(2, 4) * 1e-4
    read = torch.arange(8.0, 0.0, -1.0).reshape(2, 4) * 1e-6
    result = variance_map(signal, shot, read)
    for item in range(2):
        for plane in range(4):
            s, r = float(shot[item, plane]), float(read[item, plane])
            expected = [r, r, r + 0.25 * s, r + 1.5 * s]
            assert result[item, plane].flatten().tolist() == pytest.approx(expected, rel=1e-6)


def test_tiny_variances_survive_half_precision_input() -> None:
    """Read noise of 5e-9 is 0 in float16."""
    read = torch.full((1, 4), 5e-9)
    result = variance_map(torch.zeros(1, 4, 2, 2, dtype=torch.float16), read * 0, read)
    assert result.dtype == torch.float32
    assert result.flatten().tolist() == pytest.approx([5e-9] * 16, rel=1e-5)


def test_smoothing_is_scipys_uniform_filter() -> None:
    image = noisy(9, 12)
    expected = uniform_filter(image.double().numpy(), (1, 1, 5, 5), mode="nearest")
    np.testing.assert_allclose(smoothed(image).numpy(), expected, atol=1e-6)


def test_the_paper_network_sees_image_and_level_and_gives_a_residual() -> None:
    module = NoiseModule("paper")
    module.network = Seen(0.125)
    image = noisy()
    assert torch.equal(module(image, SHOT, READ), image + 0.125)
    (planes,) = module.network.given
    assert planes.shape == (1, 8, 16, 18)
    assert torch.equal(planes[:, :4], image)
    signal = image.clamp(min=0)[0].double().numpy()
    variance = np.array(NLF.read)[:, None, None] + np.array(NLF.shot)[:, None, None] * signal
    np.testing.assert_allclose(planes[0, 4:].numpy(), np.sqrt(variance), rtol=1e-5)


def test_the_compact_network_sees_the_deviation_of_the_smoothed_signal() -> None:
    module = NoiseModule("compact")
    module.network = Seen(0.5)
    image = noisy()
    assert bool((module(image, SHOT, READ) == 0.5).all())  # its residual is inside the network
    seen, deviation = module.network.given
    assert torch.equal(seen, image)
    signal = uniform_filter(image.double().numpy(), (1, 1, 5, 5), mode="nearest").clip(min=0)[0]
    variance = np.array(NLF.read)[:, None, None] + np.array(NLF.shot)[:, None, None] * signal
    np.testing.assert_allclose(deviation[0].numpy(), np.sqrt(variance), rtol=1e-4)


@pytest.mark.parametrize("exponent", [-12, -1, 5, 12])
def test_compact_commutes_with_exposure(exponent: int) -> None:
    """Exposing by c turns the noise level function into (c shot, c^2 read)."""
    torch.manual_seed(0)
    module = NoiseModule("compact").eval().requires_grad_(False)
    c = 2.0**exponent
    image = noisy()
    after = module(image, SHOT, READ) * c
    before = module(image * c, SHOT * c, READ * c * c)
    assert torch.equal(before, after)


# The gate


@pytest.mark.parametrize("preset", ["compact", "paper"])
def test_the_gate_is_each_images_own_and_changes_no_other(preset: Preset) -> None:
    torch.manual_seed(0)
    module = NoiseModule(preset).requires_grad_(False)
    image = noisy().expand(3, -1, -1, -1)
    factor = torch.tensor([[1.0], [0.0], [2.0]])
    together = module(image, factor * SHOT, factor * READ)
    assert torch.equal(together[1], image[1])
    for i in (0, 2):
        inputs = image[i : i + 1], factor[i] * SHOT, factor[i] * READ
        if preset == "compact":
            deviation = variance_map(smoothed(inputs[0]), *inputs[1:]).sqrt()
            expected = module.network(inputs[0], deviation)
        else:
            level = variance_map(*inputs).sqrt()
            expected = inputs[0] + module.network(torch.cat([inputs[0], level], dim=1))
        torch.testing.assert_close(together[i : i + 1], expected, rtol=1e-5, atol=1e-6)


# The compact network


def network() -> CompactDenoiser:
    """Random weights, the last ones large enough that the network does something."""
    torch.manual_seed(0)
    made = CompactDenoiser((8, 12, 16)).eval().requires_grad_(False)
    made.tail.weight.mul_(30.0)
    return made


def image_and_noise(*size: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    image = torch.rand(2, 4, *size, generator=generator)
    return image, 0.02 + 0.1 * torch.rand(2, 4, *size, generator=generator)


@pytest.mark.parametrize("exponent", [-12, 12])
def test_powers_of_two_pass_through_exactly(exponent: int) -> None:
    image, deviation = image_and_noise(17, 22)
    net, factor = network(), 2.0**exponent
    output = net(image, deviation)
    assert (output - image).abs().mean() > 0.01  # the network does something
    assert torch.equal(net(factor * image, factor * deviation), factor * output)


def test_no_parameter_is_a_bias() -> None:
    """One bias anywhere would end the homogeneity once training moved it from 0."""
    assert all(parameter.ndim == 4 for parameter in CompactDenoiser().parameters())
