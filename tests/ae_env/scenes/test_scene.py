"""Scene: normalisation, colours, resizing."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from skimage.color import rgb2xyz

from ae_env.scenes import Scene
from simulator import CameraSettings, NoiseLevelFunction, get_camera
from simulator.camera import CameraProfile
from simulator.capture.prepared_scene import Layout
from simulator.radiance.light import camera_from_srgb, temperature_tint
from simulator.raw.image import RawImage
from tests.strategies import SEEDS, lights

CAMERA = get_camera("nikon_z6")
CAMERA_SETTINGS = CameraSettings(100, 0.01, 4)
PLAIN = CameraProfile("plain", "RGGB", 0, 1023, 10)


def radiance_scene(rgb: np.ndarray, camera: CameraProfile = CAMERA, **fields: object) -> Scene:
    return Scene.from_radiance(rgb, camera, scene_id="s", **fields)


def array_scene(light: torch.Tensor, **fields: object) -> Scene:
    settings = CameraSettings(100, 1 / 64, 4)
    return Scene.from_array(light, settings, PLAIN, scene_id="s", **fields)


@pytest.mark.parametrize("illuminance", [1.0, 320.0, 100_000.0])
@pytest.mark.parametrize("tint", [0.0, 1.0])
def test_grey_card_under_known_light(illuminance: float, tint: float) -> None:
    """ISO 12232: H = 0.65 L t / N^2 against H_sat = 78 / ISO, for L = R E / pi."""
    card = np.full((3, 4, 4), 0.18, np.float32)
    scene = radiance_scene(card, illuminance=illuminance, illuminant=temperature_tint(tint))
    ref = scene.reference
    luminance = 0.18 * illuminance / math.pi
    exposure = 0.65 * luminance * ref.exposure_time / ref.f_number**2
    assert scene.light[1].mean().item() == pytest.approx(exposure / (78 / ref.iso), rel=1e-5)
    assert scene.light[1].mean().item() == pytest.approx(0.119, abs=0.0006)
    assert -ref.log2_exposure == pytest.approx(math.log2(illuminance / 2.5), abs=1e-9)
    assert scene.ev100 == pytest.approx(math.log2(illuminance / 2.5), abs=1e-9)
    balanced = scene.light[[0, 1, 3], 0, 0].numpy() * np.array(scene.white_balance)
    np.testing.assert_allclose(balanced, balanced[1], rtol=1e-5)
    assert torch.equal(scene.light[1], scene.light[2])


def test_colours_go_through_xyz_to_the_camera() -> None:
    rng = np.random.default_rng(0)
    encoded = rng.uniform(0.3, 0.7, (1, 5, 3))
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    matrix, white = camera_from_srgb(CAMERA)
    raw = rgb2xyz(encoded)[0] @ np.array(CAMERA.colour_matrix).T
    raw_white = rgb2xyz(np.ones((1, 1, 3)))[0, 0] @ np.array(CAMERA.colour_matrix).T
    np.testing.assert_allclose(linear[0] @ matrix.T, raw / raw_white[1], rtol=2e-3)
    np.testing.assert_allclose(white, raw_white / raw_white[1], rtol=2e-3)


def test_unknown_light_is_anchored_to_the_mean() -> None:
    rgb = np.random.default_rng(2).uniform(0.5, 1.5, (3, 8, 8)).astype(np.float32) * 1e5
    scene = radiance_scene(rgb, PLAIN, ev100=7.5)
    assert scene.illuminance is None
    assert scene.light[1].mean().item() == pytest.approx(0.12, rel=1e-5)
    assert -scene.reference.log2_exposure == pytest.approx(7.5)
    assert scene.ev100 == pytest.approx(7.5, abs=1e-5)
    rgb = np.ones((3, 10, 10), np.float32)
    rgb[:, 0, 0] = 1e6  # a sun, one pixel in a hundred: clipped it counts 1, the others share 0.11
    scene = radiance_scene(rgb, PLAIN)
    assert scene.light[1, 5, 5].item() == pytest.approx((0.12 * 100 - 1) / 99, rel=1e-5)


def test_saturated_pixels_survive_resizing() -> None:
    data = torch.full((4, 8, 8), 0.5)
    data[3, 2, 5] = 1.0
    noise = NoiseLevelFunction((1e-4,) * 4, (1e-6,) * 4)
    raw = RawImage(data, CameraSettings(200, 0.01, 2.8), PLAIN, nlf=noise)
    scene = Scene.from_raw(raw, scene_id="r").resized(4)
    assert scene.saturated.nonzero().tolist() == [[1, 2]]
    assert scene.illuminance is None
    assert scene.nlf.shot[0] == pytest.approx(1e-4 / 4)
    assert scene.reference == raw.settings
    clean = RawImage(data.clamp(max=0.5), raw.settings, PLAIN, nlf=noise)
    assert Scene.from_raw(clean, scene_id="r").saturated is None


def test_resized_averages_what_the_networks_found() -> None:
    """Denoised light like light; blur by its second moment, in pixels of the new light."""
    rng = np.random.default_rng(0)
    light, denoised = (rng.uniform(0.0, 2.0, (4, 6, 9)).astype(np.float32) for _ in range(2))
    diameter = rng.uniform(0.0, 5.0, (6, 9)).astype(np.float32)
    found = {"denoised": torch.from_numpy(denoised), "defocus_map": torch.from_numpy(diameter)}
    scene = array_scene(torch.from_numpy(light), **found)
    small = scene.resized(2)
    mean = denoised[:, :, 1:7].reshape(4, 2, 3, 2, 3).mean(axis=(2, 4))
    np.testing.assert_allclose(small.denoised, mean, rtol=1e-5)
    square = (diameter[:, 1:7] ** 2).reshape(2, 3, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(small.defocus_map, np.sqrt(square) / 3, rtol=1e-5)
    native = scene.resized(2, "native")
    np.testing.assert_array_equal(native.defocus_map, diameter[2:4, 3:5])


def test_own_blur_grows_with_the_aperture_and_never_shrinks() -> None:
    diameter = torch.tensor([[1.0, 7.0], [5.0, 5.0]])  # mean square 25
    scene = array_scene(torch.ones(4, 2, 2), defocus_map=diameter)  # at f/4
    assert scene.own_blur(2.0) == pytest.approx(10.0)
    assert scene.own_blur(4.0) == scene.own_blur(11.0) == pytest.approx(5.0)
    assert array_scene(torch.ones(4, 2, 2)).own_blur(2.0) == 0.0


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("illuminance", 0.0),
        ("white_balance", (1.0, -1.0, 1.0)),
        ("median_speed", -1.0),
        ("box_factor", 0),
        ("group", ""),
        ("nlf", "nikon_z6"),
        ("saturated", np.zeros((2, 2), bool)),
        ("saturated", torch.zeros(2, 2)),
        ("denoised", torch.zeros(4, 2, 3)),
        ("defocus_map", torch.zeros(2, 3)),
        ("defocus_map", torch.full((2, 2), -1.0)),
        ("defocus_map", torch.full((2, 2), math.inf)),
        ("layout", Layout(torch.zeros(2, 3))),
        ("allowed", np.zeros(3, bool)),
        ("recorded", torch.zeros(3, 4, 2, 2)),
    ],
)
def test_invalid_fields_are_named(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=f"`{name}`"):
        array_scene(torch.ones(4, 2, 2), **{name: value})


ONES = torch.ones(4, 8, 4)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: array_scene(ONES).resized(5), r"`resolution` \(=5\)"),
        (lambda: array_scene(ONES).resized(0), r"`resolution` \(=0\)"),
        (lambda: array_scene(ONES).resized(2, crop="centre"), "`crop`"),
        (lambda: Scene.from_array(ONES, CAMERA_SETTINGS, "nikon_z6", scene_id="a"), "`camera`"),
        (lambda: radiance_scene(np.full((3, 2, 2), np.nan)), "`rgb`"),
        (lambda: radiance_scene(np.zeros((3, 2, 2), np.uint8)), "uint8"),
        (lambda: radiance_scene(np.zeros((3, 2, 2))), "no exposure brings its mean"),
        (lambda: radiance_scene(np.ones((3, 2, 2)), illuminant=(1.0, 0.0, 1.0)), "`illuminant`"),
    ],
)
def test_invalid_arrays_and_sizes_are_named(make: Callable[[], Scene], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make()


def test_content_is_that_of_the_tensors() -> None:
    light = torch.rand(4, 6, 8, generator=torch.Generator().manual_seed(0))
    scene = array_scene(light)
    same = [array_scene(light.clone()), replace(scene, scene_id="t", illuminance=5.0)]
    assert {s.content for s in same} == {scene.content}
    others = [
        array_scene(light * 2.0),
        array_scene(light, denoised=light),
        array_scene(light, defocus_map=light[0]),
    ]
    assert len({s.content for s in [scene, *others]}) == 1 + len(others)


@given(lights(st.floats(-1.0, 100.0, width=32)), st.data(), SEEDS)
def test_averaging_a_scene_down_keeps_its_mean(
    light: torch.Tensor, data: st.DataObject, seed: int
) -> None:
    size = min(light.shape[1:])
    resolution = data.draw(st.integers(1, size))
    nlf = NoiseLevelFunction((1e-3,) * 4, (1e-6,) * 4)
    marks = torch.from_numpy(np.random.default_rng(seed).random(light.shape[1:]) < 0.1)
    scene = Scene.from_array(
        light, CAMERA_SETTINGS, CAMERA, scene_id="any", nlf=nlf, saturated=marks
    )
    small = scene.resized(resolution)
    k = small.box_factor
    assert k == size // resolution
    assert small.light.shape == (4, resolution, resolution)
    top, left = ((n - k * resolution) // 2 for n in light.shape[1:])
    window = slice(top, top + k * resolution), slice(left, left + k * resolution)
    part = light[:, window[0], window[1]].double()
    torch.testing.assert_close(
        small.light.double().mean(dim=(1, 2)), part.mean(dim=(1, 2)), rtol=2e-7, atol=1e-5
    )
    assert small.nlf.shot[0] == pytest.approx(1e-3 / k**2)
    assert (small.saturated is None) == (not bool(marks[window].any()))
    native = scene.resized(resolution, "native")
    top, left = ((n - resolution) // 2 for n in light.shape[1:])
    cut = light[:, top : top + resolution, left : left + resolution]
    assert torch.equal(native.light, cut)
    assert native.box_factor == 1
