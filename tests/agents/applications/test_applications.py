"""Refocusing against a thin lens, depth maps of all kinds; exposure fusion by its formulas."""

import importlib.util
import os
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from agents.applications import hdr
from agents.applications.hdr import expose_and_develop, fuse, linear_rgb, write_exr
from agents.applications.refocus import read_depth, refocus
from simulator import CameraSettings, CameraSimulator, RawImage, get_camera, render_srgb
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.reference.thin_lens import Lens

NO_NOISE = NoiseLevelFunction((1e-12,) * 4, (1e-12,) * 4)
#: Pixel pitch such that packed pixels are 10 um.
CAMERA = replace(get_camera("nikon_z6"), pixel_pitch_um=5.0)
LENS, SIMULATOR = Lens(0.05, 2.0), CameraSimulator(device="cpu")
SETTINGS = CameraSettings(100, 1 / 64, 5.6)


def make_raw(light: torch.Tensor) -> RawImage:
    """A raw of this light, of a sensor without noise."""
    return RawImage(light, SETTINGS, CAMERA.with_nlf(100, NO_NOISE), nlf=NO_NOISE)


def test_a_light_behind_the_focus_becomes_a_disc_that_keeps_its_energy() -> None:
    dark = 160.0 / CAMERA.span[0]  # whole digital numbers: rounding errors would add up
    light = torch.full((4, 161, 161), dark)
    light[:, 80, 80] = dark + 0.89
    raw = make_raw(light)
    out = refocus(raw, 1.4, depth=np.full((161, 161), 2.2), lens=LENS, simulator=SIMULATOR)
    disc = out.data[1, 68:93, 68:93].double() - dark
    assert out.settings.f_number == 1.4
    assert out.settings.exposure_time == pytest.approx(1 / 64 / 16)
    np.testing.assert_allclose(float(disc.sum()), 0.89, rtol=0.01)
    # c = f^2 / N (1/s - 1/z) / (1 - f/s) in packed pixels, less what f/5.6 has blurred already;
    # marked 5.6 stands for 4 sqrt 2, 1.4 for sqrt 2.
    disc_at_1 = 0.05**2 * (1 / 2 - 1 / 2.2) / (1 - 0.05 / 2) / 10e-6
    area = np.pi / 4 * disc_at_1**2 * (1 / 2 - 1 / 32)
    offset = torch.arange(25).double() - 12
    # A disc of area A has the second moment A / (4 pi) along each axis.
    for profile in (disc.sum(dim=0), disc.sum(dim=1)):
        moment = float((profile * offset**2).sum() / profile.sum())
        np.testing.assert_allclose(moment, area / (4 * np.pi), rtol=0.02)
    assert out.metadata["depth"] == "given"
    assert out.metadata["largest_disc_px"] == pytest.approx(np.sqrt(area / np.pi * 4), rel=1e-6)


def test_what_is_before_the_focus_spreads_over_its_neighbours_and_nothing_else() -> None:
    light = torch.full((4, 64, 96), 0.8)
    light[:, :, :48] = 0.02
    left, both = np.arange(96) < 48, {"lens": LENS, "simulator": SIMULATOR}
    depth = np.where(left, 2.0, 20.0).repeat(2)[None].repeat(128, 0)  # at the sensor's pitch
    out = refocus(make_raw(light), 1.4, depth=depth, **both)
    assert out.data[:, :, :48].equal(light[:, :, :48])  # kept bit by bit
    # Nor does the dark thing in front darken the wall behind it.
    np.testing.assert_allclose(out.data[:, :, 48:].numpy(), 0.8, atol=0.03)
    depth = np.where(left, 1.8, 2.0)[None].repeat(64, 0)
    profile = refocus(make_raw(light), 1.4, depth=depth, **both).data[0, 32].numpy()
    assert profile[49] < 0.6
    assert profile[45] > 0.1
    np.testing.assert_allclose(profile[-8:], 0.8, rtol=1e-6)


def test_what_is_blurred_has_the_noise_of_the_sensor() -> None:
    raw = RawImage(torch.full((4, 128, 128), 0.2), CameraSettings(6400, 1 / 64, 5.6), CAMERA)
    depth = np.full((128, 128), 9.0)
    out = refocus(raw, 1.4, depth=depth, lens=LENS, simulator=SIMULATOR, seed=1)
    nlf = CAMERA.nlf(6400)
    expected = np.array(nlf.shot) * 0.2 + nlf.read
    np.testing.assert_allclose(out.data.var(dim=(1, 2)), expected, rtol=0.05)


def test_the_source_s_own_aperture_and_a_sharp_picture_change_nothing() -> None:
    light = (torch.rand(4, 64, 64) * 0.5).round(decimals=1) + 0.05
    depth = np.full((64, 64), 9.0)
    same = refocus(make_raw(light), 5.6, depth=depth, lens=LENS, simulator=SIMULATOR)
    assert (same.settings, same.metadata["depth"]) == (SETTINGS, "given")
    networks = CameraSimulator.from_pretrained(device="cpu")
    sharp = refocus(make_raw(light), 1.4, simulator=networks)
    assert sharp.metadata["depth"] == "estimated"
    assert same.data.equal(light)
    assert sharp.data.equal(light)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"f_number": 8.0}, "f_number"),
        ({"depth": np.ones((32, 40))}, "depth"),
        ({"lens": LENS}, "lens"),
        ({}, "depth"),  # nor are there networks
        ({"depth": np.ones((40, 32)), "lens": LENS}, "depth"),
        ({"depth": np.full((32, 40), 0.04), "lens": LENS}, "depth"),
        ({"depth": np.full((32, 40), np.nan), "lens": LENS}, "depth"),
        ({"depth": np.full((32, 40), 9.0), "lens": LENS, "pitch": None}, "raw"),
    ],
)
def test_bad_arguments(arguments, named: str) -> None:
    given = {"f_number": 1.4, "simulator": SIMULATOR, **arguments}
    camera = replace(CAMERA, pixel_pitch_um=given.pop("pitch", 5.0))
    raw = replace(make_raw(torch.full((4, 32, 40), 0.1)), camera=camera)
    with pytest.raises(ValueError, match=f"`{named}`"):
        refocus(raw, **given)


def test_millimetres_with_a_hole_and_disparity(tmp_path) -> None:
    millimetres = np.array([[500, 1000, 0], [2000, 4000, 65535]], np.uint16)
    Image.fromarray(millimetres).save(tmp_path / "depth.png")
    depth = read_depth(tmp_path / "depth.png")
    np.testing.assert_allclose(depth[:, :2], [[0.5, 1.0], [2.0, 4.0]])
    assert depth[0, 2] in (1.0, 65.535)  # that of a neighbour
    np.testing.assert_allclose(read_depth(tmp_path / "depth.png", scale=0.01)[0, 0], 5.0)
    # Disparity is inverse distance.
    np.save(tmp_path / "disparity.npy", np.array([[0.0, 2.0], [4.0, np.nan]], np.float32))
    depth = read_depth(tmp_path / "disparity.npy", kind="disparity", scale=0.25)
    assert depth[0, 0] == np.inf
    np.testing.assert_allclose([depth[0, 1], depth[1, 0]], [2.0, 1.0])
    assert depth[1, 1] in (1.0, 2.0)


def test_bad_maps(tmp_path) -> None:
    Image.new("RGB", (4, 4)).save(tmp_path / "colour.png")
    Image.new("L", (4, 4)).save(tmp_path / "empty.png")
    Image.new("L", (4, 4), 9).save(tmp_path / "photo.jpg")
    (tmp_path / "text.npy").write_text("no array")
    (tmp_path / "text.exr").write_text("no picture")
    np.save(tmp_path / "pickle.npy", np.array([print], object), allow_pickle=True)
    np.save(tmp_path / "three.npy", np.ones((2, 2, 2)))
    np.lib.format.open_memmap(tmp_path / "large.npy", "w+", "u1", (2**14, 2**14 + 1))  # a hole
    lie = {"descr": "<f8", "fortran_order": False, "shape": (2**20, 2**22)}  # 32 TB
    with (tmp_path / "lie.npy").open("wb") as file:
        np.lib.format.write_array_header_1_0(file, lie)
    os.mkfifo(tmp_path / "pipe.npy")
    with pytest.raises(ValueError, match="does not exist"):
        read_depth(tmp_path / "missing.exr")
    names = {"missing.png", *(path.name for path in tmp_path.iterdir())}
    for name in names if importlib.util.find_spec("OpenEXR") else names - {"text.exr"}:
        with pytest.raises(ValueError, match=rf"`depth` \(='.*{name}'"):
            read_depth(tmp_path / name)
    for wrong in ({"kind": "metres"}, {"kind": "disparity"}, {"scale": 0.0}):
        with pytest.raises(ValueError, match=r"`(kind|scale)`"):
            read_depth(tmp_path / "photo.jpg", **wrong)


def test_pictures_that_are_alike_fuse_to_themselves() -> None:
    picture = torch.rand(3, 70, 91, generator=torch.Generator().manual_seed(0))
    # The pyramid is taken apart and put together again, whatever the weights.
    fused = fuse([picture] * 3)
    torch.testing.assert_close(fused, picture, atol=1e-5, rtol=0)
    assert fuse(lambda: iter([picture] * 3)).equal(fused)
    with pytest.raises(ValueError, match="`pictures`"):
        fuse([picture])


def test_pictures_weigh_as_the_formula_says() -> None:
    # Lee et al. 2018: w1 = exp(-(Y - (1 - m))^2 / (2 s^2)), s = 0.75 (m[n + 1] - m[n - 1]), twice
    # the only distance at the ends; all of a flat picture has one brightness, so w2 is the same.
    means = [0.1, 0.5, 0.7]
    widths = 0.75 * np.array([2 * 0.4, 0.6, 2 * 0.2])
    weights = np.exp(-((np.array(means) - (1 - np.array(means))) ** 2) / (2 * widths**2))
    expected = float((weights * means).sum() / weights.sum())
    fused = fuse([torch.full((3, 40, 50), mean) for mean in means])
    np.testing.assert_allclose(fused.numpy(), expected, atol=2e-4)

    # Rare brightnesses weigh more.
    luma = torch.full((10, 10), 0.2)
    luma[0, :5] = 0.4
    # Private: nothing shows the weights of a picture alone.
    weight = hdr._weight(luma, mean=0.7, width=0.5)
    # Both lie as far from 1 - 0.7 as each other; one is 19 times as frequent.
    np.testing.assert_allclose(float(weight[0, 0] / weight[5, 5]), 19.0, rtol=1e-4)


def test_a_large_flat_patch_stays_flat() -> None:
    light = torch.full((3, 1024, 1024), 0.02)
    light[:, 312:712, 312:712] = 0.45  # a bright patch of a chart, on black
    pictures = [(light * 2.0**ev).clamp(max=1.0).sqrt() for ev in (-4, -2, 0, 2, 4)]
    row = fuse(pictures)[0, 512]
    assert abs(float(row[500:524].mean() - row[330:360].mean())) < 0.03


def test_bracket_exposures_each_of_which_the_sensor_clips() -> None:
    assert len(hdr.bracket_exposures()) == 17
    np.testing.assert_allclose(hdr.bracket_exposures(1.0, 0.3), 0.3 * np.arange(-3, 4))
    for stops, step in ((0.0, 0.5), (11.0, 0.5), (1.0, 2.0), (1.0, 0.0)):
        with pytest.raises(ValueError, match=r"`(stops|step)`"):
            hdr.bracket_exposures(stops, step)
    half, eighth = (RawImage(torch.full((4, 8, 8), v), SETTINGS, CAMERA) for v in (0.5, 0.125))
    assert expose_and_develop(half, 2.0).min() == 1.0
    assert expose_and_develop(half, -2.0).equal(expose_and_develop(eighth))


def test_shadows_and_highlights_of_a_raw_show_their_detail() -> None:
    stripes = (torch.arange(96) // 8 % 2).float()[None, :, None]
    shadow, bright = 0.002 + 0.002 * stripes, 0.80 + 0.15 * stripes
    light = torch.cat([shadow.expand(4, 96, 64), bright.expand(4, 96, 64)], dim=2)
    raw = RawImage(light, SETTINGS, CAMERA)
    picture = hdr.hdr_picture(raw, simulator=SIMULATOR)
    single = render_srgb(raw).float() / 255.0
    for columns, least in ((slice(40, 88), 1.3), (slice(168, 216), 1.05)):
        contrast = [float(p[1, 20:-20, columns].std()) for p in (single, picture.fused)]
        assert contrast[1] > least * contrast[0]
    assert picture.fused[1, :, 168:216].mean() > picture.fused[1, :, 40:88].mean()


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
