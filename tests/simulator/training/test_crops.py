"""Batches of pairs and crops, and the losses that they are given to."""

import itertools
import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from torch import nn

from simulator import CameraSettings, get_camera
from simulator.networks.aperture_module import DEAD_ZONE, ApertureModule
from simulator.networks.exposure_module import ExposureModule
from simulator.networks.noise_module import NoiseModule
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.optics.discs import DiscBank
from simulator.reference.reference_camera import ReferenceCamera
from simulator.reference.sequences import Sequence
from simulator.settings import exposure_ratio
from simulator.training import crops as crops_module
from simulator.training import losses
from simulator.training.crops import Batch, DetailCrops, DetailPicture, NoiseBatch, ReferencePairs
from tests.simulator.training.scenes import REFERENCE, scene

Z6, CANON = get_camera("nikon_z6"), get_camera("canon_70d")
DARK = CameraSettings(6400, 1 / 2048, 5.6)
LIGHT = CameraSettings(100, 1 / 16, 4)


def pairs(*settings: CameraSettings, seed: int = 0, **scene_changes: object) -> ReferencePairs:
    sequence = Sequence(scene(**scene_changes), settings or (DARK, LIGHT))
    return ReferencePairs([sequence], ReferenceCamera(Z6), "exposure", seed=seed)


def test_batches_and_sequences_are_those_of_their_seed_and_index():
    made = pairs()
    batches = [made.batch(0, 4, 16), made.batch(1, 4, 16), made.batch(0, 4, 16, process=1)]
    batches.append(pairs(seed=1).batch(0, 4, 16))
    for one, other in itertools.combinations(batches, 2):
        assert not torch.equal(one.source, other.source)
        assert not torch.equal(one.defocus, other.defocus)  # not only the noise: crops, too
    torch.manual_seed(77)
    assert all(map(torch.equal, batches[1], pairs().batch(1, 4, 16)))  # the first that it draws
    draw = partial(crops_module.draw_sequences, [scene(), scene()], Z6)
    first, again, other = (draw(seed) for seed in (0, 0, 1))
    assert [s.settings for s in first] == [s.settings for s in again]
    assert first[1].settings != first[0].settings != other[0].settings
    with pytest.raises(ValueError, match="`sequences`"):
        ReferencePairs([], ReferenceCamera(Z6), "aperture")


def test_source_and_sample_have_the_noise_that_is_stated():
    source, target = CameraSettings(1600, 1 / 512, 4), CameraSettings(400, 1 / 256, 4)
    made = pairs(source, target, size=64, depth=False)
    made.pairs = [p for p in made.pairs if p.source == 0]
    batch = made.batch(0, 12, 64)
    light = scene(size=64, depth=False).light
    ratio = exposure_ratio(REFERENCE, target)
    assert float(batch.ratio[0]) == pytest.approx(0.5)  # a quarter of the gain, twice the time
    # The crop is the whole frame, half of the time transposed: G1 and G2 change places.
    ways = [light, light.transpose(1, 2)[[0, 2, 1, 3]]]
    found = [[torch.allclose(t, ratio * way) for way in ways] for t in batch.target]
    assert {tuple(f) for f in found} == {(True, False), (False, True)}
    assert batch.shot[0].tolist() == pytest.approx(Z6.nlf(1600).shot)
    assert batch.read[0].tolist() == pytest.approx(Z6.nlf(1600).read)
    for drawn, mean, nlf in (
        (batch.source, batch.target / batch.ratio[:, None, None, None], Z6.nlf(1600)),
        (batch.sample, batch.target, Z6.nlf(400)),
    ):
        shot, read = (torch.tensor(v)[:, None, None].double() for v in (nlf.shot, nlf.read))
        z = (drawn.double() - mean) / (read + shot * mean).sqrt()
        assert float(z.mean()) == pytest.approx(0.0, abs=5 / math.sqrt(z.numel()))
        assert float(z.var()) == pytest.approx(1.0, abs=0.02)


def test_everything_of_a_pair_shows_the_same_crop():
    """The light tells the depth of its pixel, so target, source and defocus must agree on it."""
    near = torch.rand(48, 48, generator=torch.Generator().manual_seed(0)) < 0.5
    depth = torch.where(near, 2.0, 8.0)
    light = torch.where(near, 0.2, 0.6).expand(4, -1, -1).contiguous()
    settings = LIGHT, replace(LIGHT, exposure_time=1 / 17)
    sequence = Sequence(replace(scene(size=48), light=light, depth=depth), settings)
    made = ReferencePairs([sequence], ReferenceCamera(Z6), "exposure")
    made._blurred_light = dict.fromkeys(made._blurred_light, light)  # sharp
    batch = made.batch(0, 6, 24)
    far = batch.target[:, 0] / batch.target.amax((1, 2, 3))[:, None, None] > 0.7
    assert torch.equal(batch.defocus > 0, far)
    bright = batch.source.mean(1) > batch.source.mean((1, 2, 3))[:, None, None]
    assert torch.equal(bright, far)
    assert not torch.equal(far[0], far[1])


def test_settings_of_a_pair_and_defocus_at_the_sources_aperture():
    batch = pairs(DARK, LIGHT).batch(0, 8, 32)
    stop = 2**2.5  # f/5.6
    forward = [6, -11, 2.5, 0, -4, 2]
    brightens = batch.ratio > 1
    assert brightens.unique().numel() == 2
    for i, brighter in enumerate(brightens.tolist()):
        expected = forward if brighter else forward[3:] + forward[:3]
        assert batch.parameters[i].tolist() == pytest.approx(expected)
        assert float(batch.ratio[i]) == pytest.approx(4.0 if brighter else 0.25)
        stops = float(batch.f_source[i]), float(batch.f_target[i])
        assert stops == pytest.approx((stop, 4.0) if brighter else (4.0, stop))
    # Defocus is f^2 / N (1/s - 1/z) / (1 - f/s), in packed pixels of 2 x 5.9 micrometres or so.
    blur = 0.035**2 / batch.f_source * (1 / 2 - 1 / 8) / (1 - 0.035 / 2)
    expected = blur / (2e-6 * Z6.pixel_pitch_um)
    np.testing.assert_allclose(batch.defocus.amax((1, 2)), expected, rtol=1e-4)
    assert not batch.defocus.amin((1, 2)).any()
    assert ((batch.defocus > 0).float().mean((1, 2)) == 0.5).all()
    # The target is clipped as the camera clips.
    bright = CameraSettings(100, 1, 4)  # 16 x the light: most of it beyond white
    batch = pairs(LIGHT, bright, depth=False).batch(0, 8, 32)
    assert float(batch.target.max()) == float(batch.sample.max()) == 1.0
    assert bool((batch.target[batch.ratio > 1] == 1.0).float().mean() > 0.5)


def picture(*size: int, seed: int = 0, **named: object) -> DetailPicture:
    light = torch.rand(size, generator=torch.Generator().manual_seed(seed))
    given = {"name": "a", "group": "a", "kind": "radiance", "light": light} | named
    return DetailPicture(**given)


def flat(level: float = 0.5, side: int = 64, **named: object) -> DetailPicture:
    """A recorded mosaic without detail: nothing mixes its planes."""
    return picture(4, side, side, light=torch.full((4, side, side), level), kind="mosaic", **named)


def test_a_step_gives_the_same_batch_and_another_one_another() -> None:
    pictures = [picture(3, 200, 180), picture(3, 220, 160, seed=1, kind="leaves")]
    crops, again, other = (DetailCrops(pictures, [Z6, CANON], seed=s) for s in (3, 3, 4))
    others = crops.batch(8, 3, 24), crops.batch(7, 3, 24, process=1), other.batch(7, 3, 24)
    first = crops.batch(7, 3, 24)
    assert [t.shape for t in first] == 2 * [(3, 4, 24, 24)] + 2 * [(3, 4)]
    assert all(map(torch.equal, first, again.batch(7, 3, 24)))
    assert not any(torch.equal(first.clean, other.clean) for other in others)
    captures = crops.captures(2, 4, 24)
    assert all(torch.equal(part, part[:1].expand_as(part)) for part in captures[1:])
    assert not torch.equal(captures.noisy[0], captures.noisy[1])
    # A tenth of the crops has coinciding planes; there alone the greens are equal.
    clean = DetailCrops([picture(3, 128, 128)], [Z6]).batch(0, 200, 16).clean
    equal = [torch.equal(each[1], each[2]) for each in clean]
    assert np.mean(equal) == pytest.approx(0.1, abs=0.085)  # four standard errors


def test_recorded_noise_has_the_variance_that_is_stated() -> None:
    """shot x + read in each plane, of 24 x 64^2 samples: within four errors, 1.8 %."""
    crops, seen = DetailCrops([flat(side=128)], [Z6, CANON]), 0
    for index in range(6):
        batch = crops.captures(index, 24, 64)
        clean, shot, read = batch.clean[0, :, 0, 0], batch.shot[0], batch.read[0]
        variance = (shot * clean + read).double()
        if bool((clean + 6 * variance.sqrt() < 1).all()):
            error = (batch.noisy - batch.clean).double().transpose(0, 1).flatten(1)
            np.testing.assert_allclose(error.var(dim=1), variance, rtol=0.02)
            assert bool((error.mean(dim=1).abs() < 5 * (variance / error.shape[1]).sqrt()).all())
            seen += 1
    assert seen > 2
    # A picture too small to be averaged: each sample is one of the camera's digital numbers.
    bright = DetailCrops([picture(3, 70, 70)], [CANON]).batch(0, 40, 32)
    numbers = bright.noisy.double() * torch.tensor(CANON.span)[:, None, None]
    assert float((numbers - numbers.round()).abs().max()) < 1e-2
    assert float(bright.noisy.max()) == 1.0
    assert bool((bright.noisy >= -torch.tensor(CANON.pedestal)[:, None, None] - 1e-6).all())
    levels = bright.clean.mean(dim=(1, 2, 3)).log2()
    assert -11.1 < float(levels.min()) < -7
    assert -3 < float(levels.max()) < -0.5


def test_a_mosaic_is_transposed_with_its_greens() -> None:
    """Green 1 is right of red and green 2 below it: whichever way light grows, so do they."""
    row, column = torch.meshgrid(torch.arange(24.0), torch.arange(24.0), indexing="ij")
    light = torch.stack([column, column + 0.5, column, column + 0.5]) + 1 + 0 * row
    crops, turned = DetailCrops([picture(4, 24, 24, light=light)], [Z6]), 0
    for each in crops.batch(0, 40, 16).clean:
        along = (each[0, 0, 1] - each[0, 0, 0]).abs() > (each[0, 1, 0] - each[0, 0, 0]).abs()
        ahead, level = (1, 2) if along else (2, 1)
        assert torch.equal(each[level], each[0])
        assert bool((each[ahead] >= each[0]).all())
        assert not torch.equal(each[ahead], each[0])
        turned += not along
    assert 8 < turned < 32


def test_a_recorded_mosaic_serves_only_where_it_is_quiet() -> None:
    """Its own noise, brought to the crop's light, is at most a sixteenth of what is added."""
    own = NoiseLevelFunction((2e-6,) * 4, (2e-8,) * 4)
    batch = DetailCrops([flat(0.5, side=31, nlf=own)], [Z6, CANON]).batch(0, 100, 16)
    scale = batch.clean.mean(dim=(1, 2, 3))[:, None] / 0.5
    assert bool((batch.shot >= 16 * 2e-6 * scale * (1 - 1e-5)).all())
    assert bool((batch.read >= 16 * 2e-8 * scale**2 * (1 - 1e-5)).all())
    clean = DetailCrops([flat(0.5, side=31)], [Z6, CANON]).batch(0, 100, 16)
    level = clean.clean.mean(dim=(1, 2, 3))[:, None] / 0.5
    assert not bool((clean.shot >= 16 * 2e-6 * level).all())  # the rule did leave some out
    # No crop is larger than the largest picture.
    crops = DetailCrops([flat(side=40), picture(3, 96, 100)], [Z6])
    assert crops.batch(0, 2, 48).noisy.shape == (2, 4, 48, 48)
    with pytest.raises(ValueError, match="`crop`"):
        crops.batch(0, 1, 49)


SHOT, READ = 4e-4, 1e-6


class Fixed(nn.Module):
    """A network whose output is known; one parameter, so that it can be trained."""

    def __init__(self, output):
        super().__init__()
        self.output, self.shift = output, nn.Parameter(torch.zeros(()))

    def forward(self, *given):
        return self.output(*given) + self.shift


def batch(level: float = 0.2, ratio: float = 2.0, noise: bool = True) -> Batch:
    deviation = math.sqrt(READ + SHOT * level) if noise else 0.0
    drawn = np.random.default_rng(0).normal(level, deviation, (2, 4, 32, 32))
    target = torch.full((2, 4, 32, 32), level * ratio)
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
        defocus=torch.full((2, 32, 32), 2.0),
    )


def denoiser(output, preset="nano"):
    made = NoiseModule(preset)
    made.network = Fixed(output)
    return made


def noise_batch(level: float = 0.2, noise: bool = True) -> NoiseBatch:
    flat = batch(level=level, ratio=1.0, noise=noise)
    return NoiseBatch(flat.source, flat.target, flat.shot, flat.read)


def test_exposure_is_the_mean_error_of_what_is_not_over_exposed():
    data, loss = batch(noise=False), losses.ExposureLoss(ExposureModule())
    data.source[:, :, :16] = 0.995  # half the pixels; their error would be large
    assert loss(data)["loss"].item() == pytest.approx(0.01, rel=1e-4)
    data.source[:] = 1.0
    assert loss(data)["loss"].item() == 0.0  # not NaN
    baseline = losses.BaselineLoss(Fixed(lambda image, parameters: image + parameters.sum()))
    values = baseline(batch(noise=False))  # source 0.2, compared with the sample, 0.41
    assert values["loss"].item() == pytest.approx(0.21, rel=1e-5)
    # The noise goes with the exposure.
    module, data = ExposureModule(), batch()
    module.load_state_dict({"w": torch.tensor(1.5), "b": torch.full((4,), 0.1)})
    exposed, shot, read = losses.expose(module, data)
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
        values = losses.NoiseLoss(denoiser(lambda image, *_, to=halfway: to(image)))(data)
        assert values["loss"].item() == pytest.approx(loss, abs=0.05)
        gain = 60.0 if left == 0.0 else -20 * math.log10(left)  # at most a million times
        assert float(values["gain_db"]) == pytest.approx(gain, abs=1e-4)
    paper = losses.NoiseLoss(denoiser(lambda both: torch.zeros_like(both[:, :4]), "paper"))
    wanted = math.sqrt(2 / math.pi * (SHOT * level + READ))
    assert paper(data)["loss"].item() == pytest.approx(wanted, rel=0.03)


def test_the_noise_loss_counts_each_pixels_noise_and_that_of_the_whole_crop():
    """An error of 0.01 where the noise is 0.02 and 0.005: 0.25 and 4 times its variance."""
    data = noise_batch(0.0)
    data.shot.fill_(0.0)
    data.read[:, :2], data.read[:, 2:] = 4e-4, 25e-6
    loss = losses.NoiseLoss(denoiser(lambda *_: data.clean + 0.01))(data)["loss"].item()
    each, pooled = (0.25 + 4) / 2, 1e-4 / ((4e-4 + 25e-6) / 2)
    expected = sum(math.log(p + 3e-4) + 2 * max(p - 0.9, 0) for p in (each, pooled)) / 2
    assert loss == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("level", [0.0, 1.0, 1e4])
@pytest.mark.parametrize("preset", ["nano", "paper"])
def test_black_and_blown_out_batches_teach_finite_gradients(level, preset):
    module = NoiseModule(preset)
    for noise in (0.0, SHOT):
        data = noise_batch(level, noise=False)
        data.clean.clamp_(max=1.0)
        data.shot.fill_(noise)
        data.read.fill_(noise / 100)
        module.zero_grad()
        assert_finite(losses.NoiseLoss(module)(data), module)


def assert_finite(values, module):
    values["loss"].backward()
    gradients = [p.grad for p in module.parameters() if p.grad is not None]
    assert all(bool(value.isfinite().all()) for value in (*values.values(), *gradients))


def opened(data: Batch) -> Batch:
    """The target is what the wider aperture makes of the source, by the true map."""
    texture = torch.rand(2, 4, 32, 32, generator=torch.Generator().manual_seed(3)) * 0.4
    diameter = (data.defocus.square() - DEAD_ZONE**2).sqrt() * math.sqrt(3)
    target = DiscBank(texture).blurred(diameter[:, None])
    return data._replace(source=texture, target=target, ratio=torch.ones(2))


def aperture_loss(log_blur):
    module = ApertureModule("compact")
    module.network.forward = Fixed(log_blur).forward
    return losses.ApertureLoss(ExposureModule(), denoiser(lambda image, *_: image), module)


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
    loss = losses.ApertureLoss(ExposureModule(), NoiseModule("nano"), ApertureModule(preset))
    same = opened(batch())._replace(f_target=torch.full((2,), 8.0))
    white = opened(batch())._replace(source=torch.ones(2, 4, 32, 32))
    for data in (same, white):
        loss.zero_grad()
        assert_finite(loss(data), loss)


def test_seven_pixels_around_clipping_are_left_out():
    source, target = torch.zeros(1, 4, 40, 40), torch.zeros(1, 4, 40, 40)
    source[0, 2, 10, 10] = 0.995
    target[0, 0, 30, 39] = 1.0
    used = losses.away_from_clipping(source, target)
    left_out = torch.zeros(40, 40, dtype=torch.bool)
    left_out[3:18, 3:18] = left_out[23:38, 32:] = True
    assert torch.equal(used[0, 0], ~left_out)
