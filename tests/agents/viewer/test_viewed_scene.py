"""What is shown of a scene: turned, cut, marked, measured."""

from __future__ import annotations

import io
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from ae_env.scenes import Scene
from agents.viewer.one_raw_page import wider_f_numbers
from agents.viewer.viewed_scene import WINDOW_SIZE, OpenedScene, View, ViewedScene, find_scenes
from simulator import CameraSettings, CameraSimulator, RawImage, get_camera, write_dng
from simulator.optics.discs import disc_blur

CAMERA = get_camera("nikon_z6")
SETTINGS = CameraSettings(100, 1 / 64, 4)


def viewed(light, flip=0):
    scene = Scene.from_array(light, SETTINGS, CAMERA, scene_id="made")
    raw = RawImage(light, SETTINGS, CAMERA, metadata={"flip": flip})
    return ViewedScene(OpenedScene(scene, raw), CameraSimulator(device="cpu"))


def image(picture):
    return np.asarray(Image.open(io.BytesIO(picture.jpeg))).astype(float)


@pytest.mark.parametrize("flip", range(8))  # LibRaw's codes
def test_the_window_lies_where_the_upright_picture_was_clicked(flip):
    light = torch.full((4, 700, 900), 0.02)
    light[:, 120:124, 700:704] = 0.9  # a spot
    seen = viewed(light, flip)
    whole = image(seen.picture(View(SETTINGS))).mean(axis=2)
    down, right = np.unravel_index(whole.argmax(), whole.shape)
    centre = ((down + 0.5) / whole.shape[0], (right + 0.5) / whole.shape[1])
    window = image(seen.picture(View(SETTINGS, centre=centre))).mean(axis=2)
    assert sorted(window.shape) == sorted(2 * side for side in WINDOW_SIZE)
    found = np.argwhere(window > 0.8 * window.max()).mean(axis=0)
    np.testing.assert_allclose(found, np.array(window.shape) / 2, atol=8)
    # The whole frame is averaged to the size of the page: thirds.
    seen = viewed(torch.zeros(4, 1025, 1100), flip)
    assert sorted(seen.picture(View(SETTINGS)).capture.shape) == [4, 341, 366]


def test_clipped_pixels_are_marked():
    light = torch.full((4, 64, 64), 0.1)
    light[:, :32, :32] = 3.0
    light[:, 32:, 32:] = -0.1
    shown = image(viewed(light).picture(View(SETTINGS, clipping=True)))
    assert shown[:28, :28].std(axis=(0, 1)).max() < 3
    np.testing.assert_allclose(shown[16, 16], (255, 0, 200), atol=8)
    np.testing.assert_allclose(shown[48, 48], (0, 120, 255), atol=8)
    assert np.ptp(shown[16, 48]) < 40  # grey stays grey


def test_numbers_of_a_flat_scene():
    seen = viewed(torch.full((4, 64, 64), 0.25))
    view = View(CameraSettings(100, 1 / 16, 4), speed=0.5, defocus=4.0)
    picture = seen.picture(view)
    readout = seen.readout(view, picture.capture)
    assert (readout.white, readout.black) == (pytest.approx(1.0, abs=0.6), 0.0)
    assert readout.motion == pytest.approx(0.5 * 64 / 16)  # speed, height, time
    assert readout.defocus == pytest.approx(4.0)
    large = viewed(torch.full((4, 512, 384), 0.1))
    for centre in (None, (0.5, 0.5)):  # a window moves as the frame does
        shown = replace(view, centre=centre)
        readout = large.readout(shown, large.picture(shown).capture)
        assert readout.motion == pytest.approx(0.5 * 512 / 16)
        assert readout.defocus == pytest.approx(4.0 * 512 / 64)
    dark = View(CameraSettings(100, 1 / 128, 4))
    readout = seen.readout(dark, seen.picture(dark).capture)
    assert readout.histogram.argmax(axis=1).tolist() == [8] * 4  # 0.125 of white, in 64 bins
    np.testing.assert_allclose(readout.histogram.sum(axis=1), 1.0)
    nlf = CAMERA.nlf(100)
    snr = 20 * math.log10(0.12 / math.sqrt(nlf.read[1] + nlf.shot[1] * 0.12))
    assert readout.snr == pytest.approx(snr)
    best = seen.best()
    scores = seen.table(View(best)).mean
    assert seen.table(View(best), best).mean[0] == pytest.approx(scores.max(), abs=1e-6)


def test_a_folder_opens_at_its_first_readable_raw_and_few_are_kept(tmp_path):
    for i in range(2):
        (tmp_path / f"0{i}.dng").write_bytes(b"no raw")
    with pytest.raises(ValueError, match=r"none can: 00\.dng: .*; 01\.dng: "):
        find_scenes(str(tmp_path))
    for i in range(1, 7):
        write_dng(tmp_path / f"{i}.dng", RawImage(torch.full((4, 8, 8), 0.1), SETTINGS, CAMERA))
    library = find_scenes(str(tmp_path))
    assert library.first == "1.dng"
    assert list(library.readers)[:2] == ["00.dng", "01.dng"]
    for i in range(1, 7):
        library.open(f"{i}.dng")
    for path in tmp_path.iterdir():
        path.unlink()
    for i in (6, 5, 4, 3):
        assert library.open(f"{i}.dng").scene.scene_id == f"{i}.dng"
    with pytest.raises((ValueError, OSError), match=r"2\.dng"):
        library.open("2.dng")


def test_a_scene_is_found_by_its_id_and_what_is_none_is_refused():
    other = list(find_scenes("bundled:small").readers)[5]
    found = find_scenes(other)
    assert (found.first, other in found.readers) == (other, True)
    for what in ("snow-9999", "no/such/folder", "recorded:no/such"):
        with pytest.raises(ValueError, match=f"`.*` .*{what.rpartition('/')[2]}"):
            find_scenes(what)


def test_a_recorded_grid_is_the_light_of_its_captures(tmp_path):
    for shutter, time in (("1-64s", 1 / 64), ("1-16s", 1 / 16)):
        light = torch.full((4, 8, 8), 6.4 * time)  # 0.1 at 1/64 s
        raw = RawImage(light, CameraSettings(100, time, 4), CAMERA, nlf=CAMERA.nlf(100))
        write_dng(tmp_path / f"iso100_{shutter}_f4.dng", raw)
    library = find_scenes(f"recorded:{tmp_path}")
    scene = library.open(library.first).scene
    assert float(scene.light.mean()) == pytest.approx(6.4 * scene.reference.exposure_time, rel=1e-3)


def soft_raw(f_number):
    """A raw, sharp on the left, soft on the right."""
    tiles = torch.rand(1, 24, 36, generator=torch.Generator().manual_seed(0)) * 0.6 + 0.05
    light = tiles.repeat_interleave(4, 1).repeat_interleave(4, 2).expand(4, 96, 144).clone()
    light[..., 72:] = disc_blur(light, 6.0)[..., 72:]
    return RawImage(light, CameraSettings(100, 1 / 64, f_number), CAMERA, nlf=CAMERA.nlf(100))


def test_what_is_soft_is_blurred_as_the_aperture_opens_where_depth_is_unknown():
    raw = soft_raw(8)
    simulator = CameraSimulator.from_pretrained("nano", device="cpu", cache=None)
    opened = OpenedScene(Scene.from_raw(raw, scene_id="made"))
    view = View(CameraSettings(100, 1 / 256, 4))
    seen = (ViewedScene(opened, simulator, depth=depth) for depth in ("far", "unknown"))
    far, unknown = (each.picture(view).capture for each in seen)
    sharp, soft = (1, slice(None), slice(60)), (1, slice(None), slice(84, None))
    assert float(unknown[sharp].std()) == pytest.approx(float(far[sharp].std()), rel=0.01)
    assert float(unknown[soft].std()) < 0.7 * float(far[soft].std())


def test_only_wider_f_numbers_than_the_raw_s_are_offered():
    for own, offered in ((2.8, 6), (8**0.5, 6), (1.4, 0), (2**0.5, 0), (4, 9)):
        raw = RawImage(torch.zeros(4, 2, 2), CameraSettings(100, 1, own), CAMERA)
        wider = (3.5, 3.2, 2.8, 2.5, 2.2, 2.0, 1.8, 1.6, 1.4)
        assert wider_f_numbers(raw) == wider[len(wider) - offered :]
