"""Crops of the noise stage: what is drawn, through which mosaic, with how much noise."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from simulator import get_camera
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.training.data import DetailCrops, DetailPicture

Z6, CANON = get_camera("nikon_z6"), get_camera("canon_70d")


def picture(*size: int, seed: int = 0, **named: object) -> DetailPicture:
    light = torch.rand(size, generator=torch.Generator().manual_seed(seed))
    given = {"name": "a", "group": "a", "kind": "radiance", "light": light} | named
    return DetailPicture(**given)  # type: ignore[arg-type]


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
    for index in range(12):
        batch = crops.captures(index, 24, 64)
        clean, shot, read = batch.clean[0, :, 0, 0], batch.shot[0], batch.read[0]
        variance = (shot * clean + read).double()
        if bool((clean + 6 * variance.sqrt() < 1).all()):
            error = (batch.noisy - batch.clean).double().transpose(0, 1).flatten(1)
            np.testing.assert_allclose(error.var(dim=1), variance, rtol=0.02)
            assert bool((error.mean(dim=1).abs() < 5 * (variance / error.shape[1]).sqrt()).all())
            seen += 1
    assert seen > 6


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
    clean = DetailCrops([picture(3, 128, 128)], [Z6]).batch(0, 400, 16).clean
    equal = [torch.equal(each[1], each[2]) for each in clean]
    assert 0.1 - 0.06 < np.mean(equal) < 0.1 + 0.06  # four standard errors


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
    batch = DetailCrops([flat(0.5, side=31, nlf=own)], [Z6, CANON]).batch(0, 200, 16)
    scale = batch.clean.mean(dim=(1, 2, 3))[:, None] / 0.5
    assert bool((batch.shot >= 16 * 2e-6 * scale * (1 - 1e-5)).all())
    assert bool((batch.read >= 16 * 2e-8 * scale**2 * (1 - 1e-5)).all())
    clean = DetailCrops([flat(0.5, side=31)], [Z6, CANON]).batch(0, 200, 16)
    level = clean.clean.mean(dim=(1, 2, 3))[:, None] / 0.5
    assert not bool((clean.shot >= 16 * 2e-6 * level).all())  # the rule did leave some out


def test_pictures_that_are_none() -> None:
    with pytest.raises(ValueError, match=r"`light` \(shape \(2, 8, 8\)\) of 'a' must be \(3, H, W"):
        picture(2, 8, 8)
    for pictures, bodies in (([], [Z6]), ([flat()], [])):
        with pytest.raises(ValueError, match="`pictures` and `cameras` must not be empty"):
            DetailCrops(pictures, bodies)


def test_a_crop_that_no_picture_holds() -> None:
    crops = DetailCrops([flat(side=40), picture(3, 96, 100)], [Z6])
    assert crops.batch(0, 2, 48).noisy.shape == (2, 4, 48, 48)
    with pytest.raises(ValueError, match=r"`crop` \(=49\) must not exceed the largest picture, 48"):
        crops.batch(0, 1, 49)
