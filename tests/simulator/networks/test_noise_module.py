"""The noise module: the noise level that its networks see, and how it scales with exposure."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import uniform_filter
from torch import Tensor, nn

from simulator import get_camera
from simulator.networks.noise_module import NoiseModule, Preset, smoothed, variance_map

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
    read = torch.full((1, 4), 5e-9)  # 0 in float16
    tiny = variance_map(torch.zeros(1, 4, 2, 2, dtype=torch.float16), read * 0, read)
    assert tiny.dtype == torch.float32
    assert tiny.flatten().tolist() == pytest.approx([5e-9] * 16, rel=1e-5)


@pytest.mark.parametrize("preset", ["compact", "paper"])
def test_the_networks_see_image_and_deviation(preset: Preset) -> None:
    """The compact one that of the smoothed signal; the paper's gives a residual."""
    module, image = NoiseModule(preset), noisy()
    module.network = Seen(0.125)
    residual = image if preset == "paper" else torch.zeros_like(image)
    assert torch.equal(module(image, SHOT, READ), residual + 0.125)
    seen, deviation = torch.cat(module.network.given, dim=1).split(4, dim=1)
    assert torch.equal(seen, image)
    signal = image.double().numpy()
    if preset == "compact":
        signal = uniform_filter(signal, (1, 1, 5, 5), mode="nearest")
    shot, read = (np.array(v)[:, None, None] for v in (NLF.shot, NLF.read))
    expected = np.sqrt(read + shot * signal[0].clip(min=0))
    tolerance = 1e-5 if preset == "paper" else 1e-4
    np.testing.assert_allclose(deviation[0].numpy(), expected, rtol=tolerance)


@pytest.mark.parametrize("exponent", [-12, -1, 5, 12])
def test_compact_commutes_with_exposure(exponent: int) -> None:
    """Exposing by c turns the noise level function into (c shot, c^2 read)."""
    torch.manual_seed(0)
    module = NoiseModule("compact").eval().requires_grad_(False)
    module.network.tail.weight.mul_(30.0)
    # One bias anywhere would end this once training moved it from 0.
    assert all(parameter.ndim == 4 for parameter in module.network.parameters())
    c, image = 2.0**exponent, noisy()
    after = module(image, SHOT, READ)
    assert (after - image).abs().mean() > 0.01  # the network does something
    assert torch.equal(module(image * c, SHOT * c, READ * c * c), after * c)


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
