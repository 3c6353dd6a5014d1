import math
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from simulator.networks.aperture_module import DEAD_ZONE, ApertureModule
from simulator.networks.exposure_module import ExposureModule
from simulator.networks.noise_module import NoiseModule, Preset
from simulator.optics.discs import DiscBank
from simulator.training.data import Batch, NoiseBatch
from simulator.training.losses import (
    ApertureLoss,
    BaselineLoss,
    ExposureLoss,
    NoiseLoss,
    away_from_clipping,
    expose,
)

SHOT, READ = 4e-4, 1e-6


class Fixed(nn.Module):
    """A network whose output is known; one parameter, so that it can be trained."""

    def __init__(self, output: Callable[..., Tensor]) -> None:
        super().__init__()
        self.output, self.shift = output, nn.Parameter(torch.zeros(()))

    def forward(self, *given: Tensor) -> Tensor:
        return self.output(*given) + self.shift


def batch(size: int = 32, level: float = 0.2, ratio: float = 2.0, noise: bool = True) -> Batch:
    """A flat field whose noise is drawn by NumPy, and its noise-free target."""
    deviation = math.sqrt(READ + SHOT * level) if noise else 0.0
    drawn = np.random.default_rng(0).normal(level, deviation, (2, 4, size, size))
    target = torch.full((2, 4, size, size), level * ratio)
    return Batch(
        source=torch.from_numpy(drawn.astype(np.float32)),
        target=target,
        sample=target + 0.01,
        ratio=torch.full((2,), ratio),
        shot=torch.full((2, 4), SHOT),
        read=torch.full((2, 4), READ),
        f_source=torch.full((2,), 8.0),
        f_target=torch.full((2,), 4.0),
        parameters=torch.zeros(2, 6),
        defocus=torch.full((2, size, size), 2.0),
    )


def denoiser(output: Callable[..., Tensor], preset: Preset = "nano") -> NoiseModule:
    made = NoiseModule(preset)
    made.network = Fixed(output)
    return made


def noise_batch(level: float = 0.2, noise: bool = True) -> NoiseBatch:
    flat = batch(level=level, ratio=1.0, noise=noise)
    return NoiseBatch(flat.source, flat.target, flat.shot, flat.read)


def test_exposure_is_the_mean_error_of_what_is_not_over_exposed():
    data, loss = batch(noise=False), ExposureLoss(ExposureModule())
    data.source[:, :, :16] = 0.995  # half the pixels; their error would be large
    assert loss(data)["loss"].item() == pytest.approx(0.01, rel=1e-4)
    data.source[:] = 1.0
    assert loss(data)["loss"].item() == 0.0  # not NaN
    baseline = BaselineLoss(Fixed(lambda image, parameters: image + parameters.sum()))
    values = baseline(batch(noise=False))  # source 0.2, compared with the sample, 0.41
    assert values["loss"].item() == pytest.approx(0.21, rel=1e-5)


def test_the_noise_goes_with_the_exposure():
    module, data = ExposureModule(), batch()
    module.load_state_dict({"w": torch.tensor(1.5), "b": torch.full((4,), 0.1)})
    exposed, shot, read = expose(module, data)
    torch.testing.assert_close(exposed, (data.source + 0.1) * 3.0)
    torch.testing.assert_close(shot, torch.full((2, 4), 3 * SHOT))
    torch.testing.assert_close(read, torch.full((2, 4), 9 * READ))
    assert not exposed.requires_grad | shot.requires_grad


@pytest.mark.parametrize("level", [0.01, 0.3])
def test_the_noise_loss_is_the_logarithm_of_what_is_left(level):
    """Mean square 1 in units of the noise costs log 1, and 2 (1 - 0.9) for being no better; half
    the error a quarter of it; none the floor of 3e-4. The paper's L1 is a half normal's mean
    times the deviation."""
    data = noise_batch(level)
    for left, loss in ((1.0, 0.2), (0.5, math.log(0.25)), (0.0, math.log(3e-4))):
        halfway = partial(torch.lerp, data.clean, weight=left)
        values = NoiseLoss(denoiser(lambda image, *_, to=halfway: to(image)))(data)
        assert values["loss"].item() == pytest.approx(loss, abs=0.05)
        gain = 60.0 if left == 0.0 else -20 * math.log10(left)  # at most a million times
        assert float(values["gain_db"]) == pytest.approx(gain, abs=1e-4)
    paper = NoiseLoss(denoiser(lambda both: torch.zeros_like(both[:, :4]), "paper"))
    assert paper(data)["loss"].item() == pytest.approx(
        math.sqrt(2 / math.pi * (SHOT * level + READ)), rel=0.03
    )


def test_the_noise_loss_counts_each_pixels_noise_and_that_of_the_whole_crop():
    """An error of 0.01 where the noise is 0.02 and 0.005: 0.25 and 4 times its variance."""
    data = noise_batch(0.0)
    data.shot.fill_(0.0)
    data.read[:, :2], data.read[:, 2:] = 4e-4, 25e-6
    loss = NoiseLoss(denoiser(lambda *_: data.clean + 0.01))(data)["loss"].item()
    each, pooled = (0.25 + 4) / 2, 1e-4 / ((4e-4 + 25e-6) / 2)
    expected = sum(math.log(p + 3e-4) + 2 * max(p - 0.9, 0) for p in (each, pooled)) / 2
    assert loss == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("level", [0.0, 1.0, 1e4])
@pytest.mark.parametrize("noise", [0.0, SHOT])
@pytest.mark.parametrize("preset", ["nano", "paper"])
def test_black_and_blown_out_batches_teach_finite_gradients(level, noise, preset):
    data = noise_batch(level, noise=False)
    data.clean.clamp_(max=1.0)
    data.shot.fill_(noise)
    data.read.fill_(noise / 100)
    module = NoiseModule(preset)
    values = NoiseLoss(module)(data)
    assert all(bool(value.isfinite()) for value in values.values())
    values["loss"].backward()
    gradients = [p.grad for p in module.parameters() if p.grad is not None]
    assert gradients
    assert all(bool(g.isfinite().all()) for g in gradients)


def opened(data: Batch) -> Batch:
    """The target is what the wider aperture makes of the source, by the true map."""
    texture = torch.rand(2, 4, 32, 32, generator=torch.Generator().manual_seed(3)) * 0.4
    diameter = (data.defocus.square() - DEAD_ZONE**2).sqrt() * math.sqrt(3)
    target = DiscBank(texture).blurred(diameter[:, None])
    return data._replace(source=texture, target=target, ratio=torch.ones(2))


def aperture_loss(log_blur: Callable[..., Tensor]) -> ApertureLoss:
    module = ApertureModule("compact")
    module.network.forward = Fixed(log_blur).forward
    return ApertureLoss(ExposureModule(), denoiser(lambda image, *_: image), module)


def test_the_true_map_costs_nothing_and_not_opening_all_of_the_change():
    """A map of no blur: relative error 1, and the map is off by log(2.3 / 0.3)."""
    data = opened(batch())
    values = aperture_loss(lambda *_: torch.log(data.defocus + 0.3))(data)
    assert values["map"].item() == 0.0
    assert float(values["relative"]) < 1e-5
    values = aperture_loss(lambda *_: torch.full((2, 32, 32), math.log(0.3)))(data)
    assert float(values["relative"]) == pytest.approx(1.0)
    assert values["map"].item() == pytest.approx(math.log(2.3 / 0.3), rel=1e-5)
    picture = values["loss"].item() - 0.1 * math.log(2.3 / 0.3)
    assert 0.8 < picture <= 1.0  # a little less: the unit includes a share of the noise


@pytest.mark.parametrize("preset", ["compact", "paper"])
def test_pairs_of_one_aperture_and_clipped_ones_are_no_trouble(preset):
    loss = ApertureLoss(ExposureModule(), NoiseModule("nano"), ApertureModule(preset))
    same = opened(batch())._replace(f_target=torch.full((2,), 8.0))
    white = opened(batch())._replace(source=torch.ones(2, 4, 32, 32))
    for data in (same, white):
        loss.zero_grad()
        value = loss(data)["loss"]
        value.backward()
        assert bool(value.isfinite())
        assert all(p.grad is None or bool(p.grad.isfinite().all()) for p in loss.parameters())


def test_seven_pixels_around_clipping_are_left_out():
    source, target = torch.zeros(1, 4, 40, 40), torch.zeros(1, 4, 40, 40)
    source[0, 2, 10, 10] = 0.995
    target[0, 0, 30, 39] = 1.0
    used = away_from_clipping(source, target)
    left_out = torch.zeros(40, 40, dtype=torch.bool)
    left_out[3:18, 3:18] = left_out[23:38, 32:] = True
    assert torch.equal(used[0, 0], ~left_out)
