"""The noise module: noise levels, stabilised noise, any exposure, a mean that stays."""

import numpy as np
import pytest
import torch
from scipy.ndimage import uniform_filter
from torch import Tensor, nn

from simulator import get_camera
from simulator.networks.noise_module import (
    SIZES,
    Denoiser,
    NoiseModule,
    Preset,
    Stabiliser,
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
        NoiseModule("tiny")


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


# The family


def stabiliser(shot: float, read: float) -> Stabiliser:
    return Stabiliser.of(torch.full((1, 4), shot), torch.full((1, 4), read))


def flat_field(level: float = 0.2, side: int = 64, seed: int = 0) -> Tensor:
    """A flat field with the noise of the Z6 at ISO 6400, drawn by NumPy, (1, 4, side, side)."""
    rng, shape = np.random.default_rng(seed), (1, 4, side, side)
    shot, read = (np.array(v)[:, None, None] for v in (NLF.shot, NLF.read))
    drawn = rng.poisson(level / shot, shape) * shot + rng.normal(size=shape) * np.sqrt(read)
    return torch.from_numpy(drawn.astype(np.float32))


def random_network(size: str = "nano", *, shift: float = 0.0) -> Denoiser:
    made = Denoiser(size).eval().requires_grad_(False)
    torch.nn.init.normal_(made.tail.weight, std=0.1)
    torch.nn.init.constant_(made.tail.bias, shift)
    return made


# Stabilising


@pytest.mark.parametrize("read", [1e-9, 1e-6, 1e-3])
@pytest.mark.parametrize("shot", [1e-2, 1e-5, 1e-9, 1e-12, 0.0])
def test_the_generalised_anscombe_transform_exact_for_any_shot(shot: float, read: float) -> None:
    """2 / s (sqrt(s y + c) - sqrt(c)) with c = 3/8 s^2 + r, in double precision; its two terms
    cancel as s goes to 0, where it is y / sigma."""
    y, shot, read = (
        np.float32([0.0, 1e-7, 1e-4, 0.03, 1.0, 50.0]),
        np.float32(shot),
        np.float32(read),
    )
    exact, cancelled = y / np.sqrt(np.float64(read)), 0.0
    if shot > 0:
        slope = np.float64(shot)
        c = 0.375 * slope**2 + read
        exact = 2 / slope * (np.sqrt(slope * y + c) - np.sqrt(c))
        cancelled = 1e-15 * np.sqrt(c) / slope
    found = stabiliser(shot, read).forward(torch.from_numpy(y).expand(1, 4, 1, -1))[0, 0, 0]
    np.testing.assert_allclose(found.double().numpy(), exact, rtol=1e-5, atol=cancelled)


def test_the_inverse_and_other_exposures() -> None:
    y = torch.tensor([-3.0, -1e-4, 0.0, 1e-6, 0.02, 1.0, 300.0]).expand(1, 4, 1, -1)
    for shot, read in ((1e-3, 1e-6), (1e-6, 1e-3), (1e-4, 0.0), (0.0, 1e-5)):
        made = stabiliser(shot, read)
        torch.testing.assert_close(made.inverse(made.forward(y)), y, rtol=2e-6, atol=1e-9)
        for c in (1 / 83, 0.3, 64.0):
            other = stabiliser(c * shot, c * c * read).forward(c * y)
            torch.testing.assert_close(other, made.forward(y), rtol=3e-6, atol=0)
    assert float(stabiliser(0.0, 1e-4).linearity[0, 0]) == 1.0
    assert float(stabiliser(1e-2, 1e-12).linearity[0, 0]) < 0.5


# The network


@pytest.mark.parametrize("size", SIZES)
def test_an_untrained_network_changes_nothing(size: str) -> None:
    image = flat_field(side=33)
    for made in (Denoiser(size).eval(), Denoiser(size).train()):
        torch.testing.assert_close(made(image, SHOT, READ), image, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("c", [1 / 83, 0.3, 64.0])
def test_it_commutes_with_exposure(size: str, c: float) -> None:
    """Light c y has the noise (c shot, c^2 read); compared in units of the noise."""
    made, image = random_network(size), flat_field()
    sigma = (READ + SHOT * 0.2).sqrt()[..., None, None]
    after = made(image, SHOT, READ)
    assert float(((after - image) / sigma).std()) > 0.05  # it does something
    brighter = made(c * image, c * SHOT, c * c * READ) / c
    assert float(((brighter - after) / sigma).abs().max()) < 2e-4
    assert float(((brighter - after) / sigma).square().mean().sqrt()) < 3e-5


@pytest.mark.parametrize("level", [0.01, 0.4])
@pytest.mark.parametrize("side", [16, 136, 203])
def test_the_mean_stays_whatever_is_taken(level: float, side: int) -> None:
    """Of a flat field of which a network takes 0.8 standard deviations too much; or gives that in
    one half, which is corrected where it is. Not in training: it must cost something there."""
    made, image = random_network(shift=-0.8), flat_field(level, side)
    torch.nn.init.zeros_(made.tail.weight)
    sigma = (READ + SHOT * level).sqrt()
    kept, trained = (
        (made.train(t)(image, SHOT, READ) - image).mean(dim=(2, 3)) / sigma for t in (False, True)
    )
    assert float(kept.abs().max()) < 1e-4
    assert float(trained.max()) < -0.7
    wide = flat_field(level, 512)[..., :side, :]
    wrong = torch.where(
        torch.arange(512) < 256, level - 0.8 * sigma[..., None], level + 0.8 * sigma[..., None]
    )
    wrong = wrong[:, :, None].expand_as(wide)
    error = (made.corrected(wrong, wide, SHOT, READ) - wide) / sigma[..., None, None]
    for part in (error[..., :180], error[..., -180:]):
        assert float(part.mean(dim=(2, 3)).abs().max()) < 0.05


def test_no_pixel_changes_by_more_than_five_standard_deviations() -> None:
    image, made = flat_field(), Stabiliser.of(SHOT, READ)
    for shift in (1e6, -1e6):
        network = random_network(shift=shift)
        far = network.surroundings(image, SHOT, READ)
        changed = made.forward(network.uncorrected(image, far, SHOT, READ)) - made.forward(image)
        torch.testing.assert_close(changed.abs(), torch.full_like(changed, 5.0), rtol=0, atol=1e-3)


def test_surroundings_are_the_mean_over_nine_cells_of_eight() -> None:
    """A step: 36 pixels on each side of a cell's centre, so half of it at the edge."""
    image = torch.zeros(1, 4, 64, 160)
    image[..., 80:] = 1.0
    shot, read = torch.zeros(1, 4), torch.ones(1, 4)  # the stabilised picture is the picture
    far = Denoiser("nano").surroundings(image, shot, read)
    for column, expected in ((0, 0.0), (40, 0.0), (79.5, 0.5), (119, 1.0), (159, 1.0)):
        found = far[..., [int(np.floor(column)), int(np.ceil(column))]].mean()
        assert float(found) == pytest.approx(expected, abs=1e-6)
    assert bool((far.diff(dim=-1) >= -1e-6).all())
