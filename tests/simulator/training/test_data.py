import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from simulator import CameraSettings, get_camera
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.reference.camera import ReferenceCamera
from simulator.reference.sequences import Sequence
from simulator.settings import exposure_ratio
from simulator.training.data import (
    Batch,
    DetailCrops,
    DetailPicture,
    ReferencePairs,
    draw_sequences,
)
from tests.simulator.training.scenes import REFERENCE, scene

Z6, CANON = get_camera("nikon_z6"), get_camera("canon_70d")
DARK = CameraSettings(6400, 1 / 2048, 5.6)
LIGHT = CameraSettings(100, 1 / 16, 4)


def pairs(*settings: CameraSettings, seed: int = 0, **scene_changes: object) -> ReferencePairs:
    sequence = Sequence(scene(**scene_changes), settings or (DARK, LIGHT))
    return ReferencePairs([sequence], ReferenceCamera(Z6), "exposure", seed=seed)


def test_a_batch_is_that_of_its_step_process_and_seed_alone():
    made = pairs()
    batches = [made.batch(0, 4, 16), made.batch(1, 4, 16), made.batch(0, 4, 16, process=1)]
    batches.append(pairs(seed=1).batch(0, 4, 16))
    for one, other in itertools.combinations(batches, 2):
        assert not torch.equal(one.source, other.source)
        assert not torch.equal(one.defocus, other.defocus)  # not only the noise: crops, too
    torch.manual_seed(77)
    again = pairs().batch(1, 4, 16)  # the first that it draws
    for name in Batch._fields:
        assert torch.equal(getattr(batches[1], name), getattr(again, name))


def test_the_target_is_clipped_as_the_camera_clips():
    bright = CameraSettings(100, 1, 4)  # 16 x the light: most of it beyond white
    batch = pairs(LIGHT, bright, depth=False).batch(0, 8, 32)
    assert float(batch.target.max()) == float(batch.sample.max()) == 1.0
    assert bool((batch.target[batch.ratio > 1] == 1.0).float().mean() > 0.5)


def test_sequences_are_drawn_by_seed_and_index():
    scenes = [scene("a"), scene("b")]
    first, again, other = (draw_sequences(scenes, Z6, seed) for seed in (0, 0, 1))
    assert [s.settings for s in first] == [s.settings for s in again]
    assert first[0].settings != first[1].settings
    assert first[0].settings != other[0].settings
    assert [s.scene.scene_id for s in first] == ["a", "b"]
    with pytest.raises(ValueError, match="`illuminance`"):
        draw_sequences([replace(scene(), illuminance=None)], Z6, 0)
    with pytest.raises(ValueError, match="stage 'aperture'"):
        ReferencePairs([], ReferenceCamera(Z6), "aperture")
    with pytest.raises(ValueError, match="`crop`"):
        pairs().batch(0, 1, 33)


def test_source_and_sample_have_the_noise_that_is_stated():
    """Standardised by the noise level function, both have mean 0 and variance 1."""
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


def test_settings_of_a_pair():
    batch = pairs(DARK, LIGHT).batch(0, 8, 16)
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


def test_defocus_is_the_thin_lens_at_the_sources_aperture():
    """f^2 / N (1/s - 1/z) / (1 - f/s), in packed pixels of 2 x 5.9 micrometres or so."""
    batch = pairs(DARK, LIGHT).batch(0, 8, 32)
    blur = 0.035**2 / batch.f_source * (1 / 2 - 1 / 8) / (1 - 0.035 / 2)
    expected = blur / (2e-6 * Z6.pixel_pitch_um)
    np.testing.assert_allclose(batch.defocus.amax((1, 2)), expected, rtol=1e-4)
    assert not batch.defocus.amin((1, 2)).any()
    assert ((batch.defocus > 0).float().mean((1, 2)) == 0.5).all()


def picture(*size: int, seed: int = 0, **named: object) -> DetailPicture:
    light = torch.rand(size, generator=torch.Generator().manual_seed(seed))
    given = {"name": "a", "group": "a", "kind": "radiance", "light": light} | named
    return DetailPicture(**given)


def flat(level: float = 0.5, side: int = 64, **named: object) -> DetailPicture:
    """A recorded mosaic without detail: nothing mixes its planes."""
    return picture(4, side, side, light=torch.full((4, side, side), level), kind="mosaic", **named)


def test_a_step_gives_the_same_batch_and_another_one_another() -> None:
    pictures = [picture(3, 200, 180), picture(3, 220, 160, seed=1, kind="leaves")]
    crops, again = (DetailCrops(pictures, [Z6, CANON], seed=3) for _ in range(2))
    first = crops.batch(7, 3, 24)
    assert [t.shape for t in first] == 2 * [(3, 4, 24, 24)] + 2 * [(3, 4)]
    crops.batch(8, 3, 24)
    assert all(map(torch.equal, first, again.batch(7, 3, 24)))
    others = crops.batch(8, 3, 24), crops.batch(7, 3, 24, process=1)
    others += (DetailCrops(pictures, [Z6, CANON], seed=4).batch(7, 3, 24),)
    assert not any(torch.equal(first[1], other.clean) for other in others)
    assert bool((first[1] <= 1.0).all())
    captures = crops.captures(2, 4, 24)
    assert all(torch.equal(part, part[:1].expand_as(part)) for part in captures[1:])
    assert not torch.equal(captures.noisy[0], captures.noisy[1])


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


def test_what_is_recorded_is_clipped_and_whole_numbers() -> None:
    """A picture too small to be averaged: each sample is one of the camera's digital numbers."""
    bright = DetailCrops([picture(3, 70, 70)], [CANON]).batch(0, 40, 32)
    numbers = bright.noisy.double() * torch.tensor(CANON.span)[:, None, None]
    assert float((numbers - numbers.round()).abs().max()) < 1e-2
    assert float(bright.noisy.max()) == 1.0
    assert bool((bright.noisy >= -torch.tensor(CANON.pedestal)[:, None, None] - 1e-6).all())
    levels = bright.clean.mean(dim=(1, 2, 3)).log2()
    assert -11.1 < float(levels.min()) < -7
    assert -3 < float(levels.max()) < -0.5


def test_planes_are_sampled_at_their_own_places_but_for_some_crops() -> None:
    """A tenth of the crops has coinciding planes; there alone the greens are equal."""
    clean = DetailCrops([picture(3, 128, 128)], [Z6]).batch(0, 200, 16).clean
    equal = [torch.equal(each[1], each[2]) for each in clean]
    assert np.mean(equal) == pytest.approx(0.1, abs=0.085)  # four standard errors


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


def test_no_crop_is_larger_than_the_largest_picture() -> None:
    crops = DetailCrops([flat(side=40), picture(3, 96, 100)], [Z6])
    assert crops.batch(0, 2, 48).noisy.shape == (2, 4, 48, 48)
    with pytest.raises(ValueError, match="`crop`"):
        crops.batch(0, 1, 49)
