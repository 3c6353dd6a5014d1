"""Exposure fusion against its formulas, and a bracket of one raw."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from agents.applications import hdr
from agents.applications.hdr import expose_and_develop, fuse, linear_rgb, write_exr
from simulator import CameraSettings, CameraSimulator, RawImage, get_camera, render_srgb

CAMERA = get_camera("nikon_z6")
SETTINGS = CameraSettings(100, 1 / 64, 8)


def test_pictures_that_are_alike_fuse_to_themselves() -> None:
    picture = torch.rand(3, 70, 91, generator=torch.Generator().manual_seed(0))
    # The pyramid is taken apart and put together again, whatever the weights.
    fused = fuse([picture] * 3)
    torch.testing.assert_close(fused, picture, atol=1e-5, rtol=0)
    assert fuse(lambda: iter([picture] * 3)).equal(fused)
    with pytest.raises(ValueError, match="`pictures`"):
        fuse([picture])


def test_flat_pictures_weigh_as_the_formula_says() -> None:
    # Lee et al. 2018: w1 = exp(-(Y - (1 - m))^2 / (2 s^2)), s = 0.75 (m[n + 1] - m[n - 1]), twice
    # the only distance at the ends; all of a flat picture has one brightness, so w2 is the same.
    means = [0.1, 0.5, 0.7]
    widths = 0.75 * np.array([2 * 0.4, 0.6, 2 * 0.2])
    weights = np.exp(-((np.array(means) - (1 - np.array(means))) ** 2) / (2 * widths**2))
    expected = float((weights * means).sum() / weights.sum())
    fused = fuse([torch.full((3, 40, 50), mean) for mean in means])
    np.testing.assert_allclose(fused.numpy(), expected, atol=2e-4)


def test_rare_brightnesses_weigh_more() -> None:
    luma = torch.full((10, 10), 0.2)
    luma[0, :5] = 0.4
    # Private: nothing shows the weights of a picture alone.
    weight = hdr._weight(luma, mean=0.7, width=0.5)
    # Both lie as far from 1 - 0.7 as each other; one is 19 times as frequent.
    np.testing.assert_allclose(float(weight[0, 0] / weight[5, 5]), 19.0, rtol=1e-4)


def test_a_mirrored_bracket_gives_the_mirrored_picture() -> None:
    # Pixel 0 of a coarser level lies on pixel 0 of the finer one: 2^n + 1 pixels are symmetric.
    light = torch.rand(3, 129, 257, generator=torch.Generator().manual_seed(2)).square()
    pictures = [(light * gain).clamp(max=1.0).sqrt() for gain in (0.2, 1.0, 5.0)]
    mirrored = fuse([picture.flip(1, 2) for picture in pictures])
    torch.testing.assert_close(mirrored.flip(1, 2), fuse(pictures), atol=2e-5, rtol=0)


def test_a_large_flat_patch_stays_flat() -> None:
    light = torch.full((3, 1024, 1024), 0.02)
    light[:, 312:712, 312:712] = 0.45  # a bright patch of a chart, on black
    pictures = [(light * 2.0**ev).clamp(max=1.0).sqrt() for ev in (-4, -2, 0, 2, 4)]
    row = fuse(pictures)[0, 512]
    assert abs(float(row[500:524].mean() - row[330:360].mean())) < 0.03


def test_bracket_exposures() -> None:
    assert len(hdr.bracket_exposures()) == 17
    np.testing.assert_allclose(hdr.bracket_exposures(1.0, 0.3), 0.3 * np.arange(-3, 4))
    for stops, step in ((0.0, 0.5), (11.0, 0.5), (1.0, 2.0), (1.0, 0.0)):
        with pytest.raises(ValueError, match=r"`(stops|step)`"):
            hdr.bracket_exposures(stops, step)


def test_shadows_and_highlights_of_a_raw_show_their_detail() -> None:
    stripes = (torch.arange(96) // 8 % 2).float()[None, :, None]
    shadow, bright = 0.002 + 0.002 * stripes, 0.80 + 0.15 * stripes
    light = torch.cat([shadow.expand(4, 96, 64), bright.expand(4, 96, 64)], dim=2)
    raw = RawImage(light, SETTINGS, CAMERA)
    picture = hdr.hdr_picture(raw, simulator=CameraSimulator(device="cpu"))
    single = render_srgb(raw).float() / 255.0
    for columns, least in ((slice(40, 88), 1.3), (slice(168, 216), 1.05)):
        contrast = [float(p[1, 20:-20, columns].std()) for p in (single, picture.fused)]
        assert contrast[1] > least * contrast[0]
    assert picture.fused[1, :, 168:216].mean() > picture.fused[1, :, 40:88].mean()


def test_the_sensor_clips_each_picture() -> None:
    half, eighth = (RawImage(torch.full((4, 8, 8), v), SETTINGS, CAMERA) for v in (0.5, 0.125))
    assert expose_and_develop(half, 2.0).min() == 1.0
    assert expose_and_develop(half, -2.0).equal(expose_and_develop(eighth))


def test_radiance_as_an_exr(tmp_path) -> None:
    openexr = pytest.importorskip("OpenEXR")
    raw = RawImage(torch.full((4, 6, 8), 0.1), SETTINGS, CAMERA, white_balance=(2.0, 1.0, 1.5))
    grey = torch.tensor([0.5, 1.0, 1.0, 2 / 3])[:, None, None].expand(4, 6, 8) * 3.0
    image = linear_rgb(raw, grey)
    np.testing.assert_allclose(image, 3.0, rtol=1e-5)  # grey stays grey, above white
    held = replace(raw, metadata={"flip": 6})  # LibRaw's code: turned right by a quarter
    ramp = grey * torch.linspace(0.1, 1.0, 8)
    upright = linear_rgb(held, ramp)
    assert upright.shape == (8, 6, 3)
    np.testing.assert_array_equal(upright, np.rot90(linear_rgb(raw, ramp), -1))
    path = write_exr(tmp_path / "out.exr", image)
    with openexr.File(str(path)) as file:
        np.testing.assert_array_equal(file.channels()["RGB"].pixels, image)
