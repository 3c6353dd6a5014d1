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


def test_the_papers_network_sees_image_and_deviation_and_gives_a_residual() -> None:
    module, image = NoiseModule("paper"), noisy()
    module.network = Seen(0.125)
    assert torch.equal(module(image, SHOT, READ), image + 0.125)
    seen, deviation = module.network.given[0].split(4, dim=1)
    assert torch.equal(seen, image)
    shot, read = (np.array(v)[:, None, None] for v in (NLF.shot, NLF.read))
    expected = np.sqrt(read + shot * image.double().numpy()[0].clip(min=0))
    np.testing.assert_allclose(deviation[0].numpy(), expected, rtol=1e-5)
    smooth = uniform_filter(image.double().numpy(), (1, 1, 5, 5), mode="nearest")
    np.testing.assert_allclose(smoothed(image).numpy(), smooth, atol=1e-6)


# Presets


@pytest.mark.parametrize(
    ("preset", "limit"), [("nano", 100_000), ("compact", 1_000_000), ("large", 6_000_000)]
)
def test_sizes_of_the_family(preset: Preset, limit: int) -> None:
    module = NoiseModule(preset)
    assert limit / 2 < sum(p.numel() for p in module.parameters()) <= limit
    assert module.commutes
    assert module.residual is None
    with pytest.raises(ValueError, match="`preset`"):
        NoiseModule("tiny")  # type: ignore[arg-type]


def test_operations_by_hand() -> None:
    """Two per weight and place; a level has a quarter of the places of the one before."""
    convolutions = [(1, 9, 16, 16), (1, 9, 16, 4)]  # head and tail
    convolutions += 4 * [(1, 9, 16, 16)] + 4 * [(4, 9, 24, 24)] + 4 * [(16, 9, 32, 32)]  # blocks
    convolutions += [(4, 4, 16, 24), (16, 4, 24, 32)]  # down: 2 x 2, to a quarter of the places
    convolutions += [(1, 1, 24, 16), (4, 1, 32, 24)]  # up: each place has one weight of 2 x 2
    expected = sum(2 * taps * wide * out / places for places, taps, wide, out in convolutions)
    assert NoiseModule("nano").operations == round(expected) == 41_472
    assert not NoiseModule("paper").commutes
    assert NoiseModule("paper").operations > 100_000


# The gate


@pytest.mark.parametrize("preset", ["nano", "paper"])
def test_the_gate_is_each_images_own_and_changes_no_other(preset: Preset) -> None:
    module = NoiseModule(preset).eval().requires_grad_(False)
    torch.nn.init.normal_(module.network.tail.weight)
    image = noisy().expand(3, -1, -1, -1)
    factor = torch.tensor([[1.0], [0.0], [2.0]])
    together = module(image, factor * SHOT, factor * READ)
    assert torch.equal(together[1], image[1])
    for i in (0, 2):
        inputs = image[i : i + 1], factor[i] * SHOT, factor[i] * READ
        if preset == "paper":
            level = variance_map(*inputs).sqrt()
            expected = inputs[0] + module.network(torch.cat([inputs[0], level], dim=1))
        else:
            expected = module.network(*inputs)
        torch.testing.assert_close(together[i : i + 1], expected, rtol=1e-5, atol=1e-5)
        assert not torch.equal(together[i], image[i])
