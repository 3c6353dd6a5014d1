"""Scene: normalisation, colours, resizing."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from skimage.color import rgb2xyz

from ae_env.scenes import Scene
from ae_env.scenes.load import ISO_RANGE, SceneNetworks, simulate_source_raw
from ae_env.scorers.captures import SceneCaptures, ShownScenes
from simulator import CameraSettings, CameraSimulator, NoiseLevelFunction, exposure_ratio
from simulator.camera import CameraProfile, get_camera
from simulator.capture.blurred_frames import Layout
from simulator.networks.aperture_module import BLUR_FACTOR, DEAD_ZONE
from simulator.networks.weights import build_modules, save_modules
from simulator.radiance.light import camera_from_srgb, temperature_tint
from tests.ae_env.environments import assert_equal, make_env, rollout
from tests.ae_env.scene_files import load, write_hdr
from tests.ae_env.scorer_images import random_scene
from tests.strategies import SEEDS, lights

CAMERA = get_camera("nikon_z6")
PLAIN = CameraProfile("plain", "RGGB", 0, 1023, 10)
ONES = torch.ones(4, 8, 4)


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
    assert scene.incident_light.spread == 0.0
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
    assert scene.incident_light.reflected_ev100 == pytest.approx(7.5, abs=1e-5)
    assert abs(scene.ev100 - 7.5) < 1.5
    assert scene.incident_light.spread > 0.5
    rgb = np.ones((3, 10, 10), np.float32)
    rgb[:, 0, 0] = 1e6  # a sun, one pixel in a hundred: clipped it counts 1, the others share 0.11
    scene = radiance_scene(rgb, PLAIN)
    assert scene.light[1, 5, 5].item() == pytest.approx((0.12 * 100 - 1) / 99, rel=1e-5)


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
    # A scene's own blur grows with the aperture and never shrinks.
    diameter = torch.tensor([[1.0, 7.0], [5.0, 5.0]])  # mean square 25
    scene = array_scene(torch.ones(4, 2, 2), defocus_map=diameter)  # at f/4
    assert scene.own_blur(2.0) == pytest.approx(10.0)
    assert scene.own_blur(4.0) == scene.own_blur(11.0) == pytest.approx(5.0)
    assert array_scene(torch.ones(4, 2, 2)).own_blur(2.0) == 0.0
    states = [CameraSettings(100.0, 1 / 60, f_number) for f_number in (2.0, 4.0)]
    shown = ShownScenes([scene], SceneCaptures(get_camera("nikon_z6"), states))
    for state, wanted in ((1, 5.0), (0, 10.0), (1, 5.0)):
        one = np.zeros(1, np.int64)
        found = shown.blur(one, one + state, 0.0 * one, 0.0 * one, np.zeros((1, 4)))
        assert found[0].item() == pytest.approx(wanted, rel=0.02)  # effective f-numbers


@pytest.mark.parametrize(
    ("make", "words"),
    [
        *(
            (lambda name=name, value=value: array_scene(ONES, **{name: value}), f"`{name}`")
            for name, value in (
                *(("illuminance", 0.0), ("white_balance", (1.0, -1.0, 1.0)), ("box_factor", 0)),
                *(("median_speed", -1.0), ("group", ""), ("allowed", np.zeros(3, bool))),
                *(("saturated", np.zeros((2, 2), bool)), ("saturated", torch.zeros(2, 2))),
                *(("denoised", torch.zeros(4, 2, 3)), ("layout", Layout(torch.zeros(2, 3)))),
                *(("defocus_map", torch.full((8, 4), v)) for v in (-1.0, math.inf)),
                *(("nlf", "nikon_z6"), ("saturated", ONES.bool()), ("defocus_map", ONES[:1])),
            )
        ),
        *((lambda n=n: array_scene(ONES).resized(n), rf"`resolution` \(={n}\)") for n in (0, 5)),
        (lambda: radiance_scene(np.zeros((3, 2, 2))), "no exposure brings its mean"),
        (lambda: radiance_scene(np.ones((3, 2, 2)), illuminant=(1.0, 0.0, 1.0)), "`illuminant`"),
        (lambda: simulate_source_raw(array_scene(ONES * 0, illuminance=9.0)), "'s'.* too dark"),
        (lambda: simulate_source_raw(random_scene(nlf=CAMERA.nlf(400))), "`scene`"),
    ],
)
def test_what_is_wrong_with_a_scene_is_named(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_content_is_that_of_the_tensors() -> None:
    light, scene = 2.0 * ONES, array_scene(ONES)
    assert replace(scene, scene_id="t", light=ONES.clone()).content == scene.content
    others = [array_scene(light), array_scene(ONES, denoised=light)]
    others.append(array_scene(ONES, defocus_map=light[0]))
    assert len({s.content for s in [scene, *others]}) == 4
    assert array_scene(ONES, allowed=[True, False]).allowed.dtype == bool


@given(lights(st.floats(-1.0, 100.0, width=32)), st.data(), SEEDS)
def test_averaging_a_scene_down_keeps_its_mean(light, data, seed):
    size = min(light.shape[1:])
    resolution = data.draw(st.integers(1, size))
    nlf = NoiseLevelFunction((1e-3,) * 4, (1e-6,) * 4)
    marks = torch.from_numpy(np.random.default_rng(seed).random(light.shape[1:]) < 0.1)
    scene = array_scene(light, nlf=nlf, saturated=marks)
    small = scene.resized(resolution)
    k = small.box_factor
    assert k == size // resolution
    assert small.light.shape == (4, resolution, resolution)
    top, left = ((n - k * resolution) // 2 for n in light.shape[1:])
    window = slice(top, top + k * resolution), slice(left, left + k * resolution)
    part = light[:, window[0], window[1]].double()
    found, wanted = (planes.double().mean(dim=(1, 2)) for planes in (small.light, part))
    torch.testing.assert_close(found, wanted, rtol=2e-7, atol=1e-5)
    assert small.nlf.shot[0] == pytest.approx(1e-3 / k**2)
    found = torch.zeros(1) if small.saturated is None else small.saturated
    wanted = marks[window].reshape(resolution, k, resolution, k).amax(dim=(1, 3))
    assert torch.equal(found.expand_as(wanted).bool(), wanted)
    native = scene.resized(resolution, "native")
    top, left = ((n - resolution) // 2 for n in light.shape[1:])
    cut = light[:, top : top + resolution, left : left + resolution]
    assert torch.equal(native.light, cut)
    assert native.box_factor == 1


def my_scenes(split: str, camera: object) -> list[Scene]:
    light = torch.full((4, 16, 16), 0.3 if split == "train" else 0.6)
    return [Scene.from_array(light, CameraSettings(100, 0.01, 4), CAMERA, scene_id=split)]


MINE = my_scenes("all", None)
NONE = {"path": "no/such/folder"}


def test_scenes_from_lists_attributes_and_small_folders(tmp_path):
    for split in ("train", "test", "all"):
        assert [s.scene_id for s in load(MINE, split)] == ["all"]
        assert [s.scene_id for s in load(f"{__name__}:MINE", split)] == ["all"]
        assert [s.scene_id for s in load(f"{__name__}:my_scenes", split)] == [split]
    assert load(MINE, resolution=8)[0].box_factor == 2
    for i in (10, 2, 1):
        write_hdr(tmp_path / f"map{i}.hdr", i)
    for spec, split, names in (
        (tmp_path, "test", ["map1", "map2", "map10"]),
        (str(tmp_path), "all", ["map1", "map2", "map10"]),
        (str(tmp_path / "map1*.hdr"), "all", ["map1", "map10"]),
        (tmp_path / "map2.hdr", "all", ["map2"]),
    ):
        assert [(s.scene_id, s.group) for s in load(spec, split)] == [(n, n) for n in names]
    with pytest.raises(ValueError, match="has at most 3"):
        load(tmp_path, "train")


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("bundeld", "did you mean 'bundled'"),
        ("no/such/folder", "`scenes`"),
        ("no_such_module:scenes", "ModuleNotFound"),
        (f"{__name__}:MINES", "did you mean 'MINE'"),
        ("math:pi", "float"),
        *(([1], r"`scenes\[0\]`"), ([], "at least one"), ([*MINE, *MINE], "`scene_id`")),
        *(({"lux": 3}, "'path'"), ({"path": "bundled", "kind": "snow"}, "existing file")),
        # Options of folders and of recorded scenes, before anything is read.
        *(({**NONE, "illuminace": 3}, "'illuminance'"), ({**NONE, "on_error": "skp"}, "'skip'")),
        *(({**NONE, "on_eror": "skip"}, "'on_error'"), ({**NONE, "kind": 3}, "`kind`")),
        *(({**NONE, "illuminance": -1.0}, "`illuminance`"), ({**NONE, "hard": 1}, "`hard`")),
        *(({**NONE, "ev100": "bright"}, "`ev100`"), ({**NONE, "sequence": "here"}, "`scenes`")),
        ({"sequence": "here", "on_error": "skip"}, "`on_error`"),
        *(({"path": "recorded:here"}, "`scenes`"), ("recorded:none", "existing folder")),
        *((spec, r"`scenes\['recorded'\]`") for spec in ("recorded:", {"recorded": 3})),
        *(("recorded:a?iso=-3", "`iso`"), ("recorded:a?iso=fast", "number")),
        ({"recorded": "a", "isos": 3}, "did you mean 'iso'"),
    ],
)
def test_scenes_that_cannot_be_are_refused(spec: object, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        load(spec)


#: Circle of confusion that the networks of these tests find everywhere [pixel].
FOUND = 4.0
#: What is left of it after the dead zone.
DIAMETER = BLUR_FACTOR * math.sqrt(FOUND**2 - DEAD_ZONE**2)
NOISY = CameraSettings(6400, 1 / 1024, 8)


def save_networks(folder, *, even):
    """Untrained networks whose defocus map is around `FOUND`, or the same everywhere."""
    torch.manual_seed(3)
    modules = build_modules("compact")
    tail = modules["aperture"].network.tail
    with torch.no_grad():
        tail.bias.fill_(math.log(FOUND + 0.3))
        if even:
            tail.weight.zero_()
    save_modules(folder / "tiny", modules, "compact", {})
    return str(folder / "tiny.safetensors"), modules.eval()


def noisy_scene() -> Scene:
    rng = np.random.default_rng(0)
    nlf = CAMERA.nlf(NOISY.iso)
    light = 0.1 + 0.3 * rng.random((4, 80, 80))
    light += rng.normal(size=light.shape) * np.sqrt(nlf.read[0] + nlf.shot[0] * light)
    data = torch.from_numpy(light.astype(np.float32))
    return Scene.from_array(data, NOISY, CAMERA, scene_id="noisy", nlf=nlf)


def test_noise_free_scenes_neither_need_nor_notice_networks(tmp_path):
    """The weights named here cannot be read: whoever loads them fails."""
    damaged = tmp_path / "damaged.safetensors"
    damaged.write_bytes(b"no weights")
    damaged.with_suffix(".json").write_text("{}")
    arguments = {"scenes": "bundled:small", "resolution": 36, "with_oracle": True}
    without = rollout(1, **arguments, simulator=None)
    assert_equal(rollout(1, **arguments, simulator=str(damaged)), without)
    assert_equal(rollout(1, **arguments), without)
    with pytest.raises(ValueError, match="damaged"):
        make_env(scenes=[noisy_scene()], resolution=40, simulator=str(damaged))


def test_opening_grows_the_scenes_own_defocus(tmp_path) -> None:
    """Found at 80 x 80 pixels, halved at 40 x 40; a disc's variance is its squared diameter / 16"""
    weights, _ = save_networks(tmp_path, even=True)
    light = torch.zeros(4, 80, 80)
    light[:, 40:42, 40:42] = 0.9  # a point, without noise, taken at f/8
    reference = CameraSettings(100, 1 / 125, 8)
    scene = Scene.from_array(light, reference, CAMERA, scene_id="point", illuminance=640.0)
    fixed = {"motion": "none", "noise": False, "observation": "linear", "depth": "unknown"}
    env = make_env(scenes=[scene], simulator=weights, resolution=40, **fixed)
    for f_number, growth in ((4, 4.0 - 1.0), (5.6, 2.0 - 1.0), (8, 0.0), (11, 0.0)):
        state = env.unwrapped.grid.states.index(CameraSettings(100, 1 / 125, f_number))
        observation, info = env.reset(seed=0, options={"state": state})
        raw = observation["raw"][0].astype(np.float64)
        assert info["modules"] == ("exposure+aperture" if growth else "exposure")
        if growth:
            variance = np.average((np.arange(40) - 20) ** 2, weights=raw.sum(axis=0))
            assert variance == pytest.approx((DIAMETER / 2.0) ** 2 * growth / 16.0, rel=0.03)
        else:  # closing leaves the blur: not a digital number differs
            sharp = np.zeros((40, 40))
            sharp[20, 20] = 0.9 * (1.0 if f_number == 8 else 0.5)
            np.testing.assert_allclose(raw, sharp, atol=1 / CAMERA.span[0])


def test_map_of_a_crop_is_that_of_the_whole_frame(tmp_path):
    """Only the middle of a large frame is looked at, with what the networks see around it."""
    file, modules = save_networks(tmp_path, even=False)
    light = 0.3 * torch.rand((4, 252, 244), generator=torch.Generator().manual_seed(1))
    scene = Scene.from_array(light, CameraSettings(100, 0.01, 8), CAMERA, scene_id="large")
    with torch.no_grad():
        whole = modules["aperture"].defocus(light[None], torch.zeros_like(light)[None])[0]
    native = SceneNetworks(file).resized(scene, 16, "native")
    torch.testing.assert_close(native.defocus_map, whole[118:134, 114:130], rtol=1e-3, atol=1e-4)
    assert float(whole.std()) > 1e-3


def test_it_is_metered_by_its_mean_and_drawn_by_name_and_seed():
    drawn = [simulate_source_raw(random_scene(scene_id=f"scene-{i}")) for i in range(20)]
    isos = [scene.reference.iso for scene in drawn]
    assert ISO_RANGE[0] <= min(isos) < max(isos) / 16 < ISO_RANGE[1] / 16
    again, other = (simulate_source_raw(random_scene(scene_id="scene-3"), seed=s) for s in (0, 1))
    assert torch.equal(again.light, drawn[3].light)
    assert other.reference != drawn[3].reference
    exposed = (simulate_source_raw(random_scene(), iso=100.0, ev=e) for e in (-1, 0, 1))
    darker, metered, brighter = exposed
    assert metered.light[1:3].mean().item() == pytest.approx(0.12, rel=0.01)
    for taken, ev in ((darker, -1), (brighter, 1)):
        assert exposure_ratio(metered.reference, taken.reference) == pytest.approx(2.0**ev)
        assert taken.illuminance == random_scene().illuminance


@pytest.mark.parametrize("box_factor", [1, 4])
def test_its_noise_is_the_cameras_averaged(box_factor: int) -> None:
    """Against the exposed truth: variance read + shot x of a native pixel, over k^2."""
    scene = random_scene(box_factor=box_factor)
    taken = simulate_source_raw(scene, iso=3200.0, ev=-1.0)
    truth = scene.light * exposure_ratio(scene.reference, taken.reference)
    native = CAMERA.nlf(3200.0)
    shot, read = (torch.tensor(v)[:, None, None] for v in (native.shot, native.read))
    expected = (shot * truth + read) / box_factor**2
    clear = truth + 5 * expected.sqrt() < 1.0
    ratio = ((taken.light - truth).square() / expected)[clear].mean().item()
    assert ratio == pytest.approx(1.0, abs=0.06)  # 6,000 samples: 2 % each
    assert taken.nlf.shot == pytest.approx(native.scaled(1 / box_factor**2).shot)


def test_in_the_environment_everything_comes_from_the_raw():
    some = make_env().unwrapped.scenes[:4]
    given = {"scenes": some, "motion": "none", "depth": "far"}
    sources = ({"source": "raw"}, {}, {"source": "raw", "simulator": None})
    env, *others = (make_env(**given, **source) for source in sources)
    scene = max(env.unwrapped.scenes, key=lambda s: s.reference.iso)
    assert not scene.noise_free
    options = {"scene": scene.scene_id, "state": 12}  # ISO 100, 1/2 s
    neural, exact, noisy = (e.reset(seed=0, options=options)[1] for e in (env, *others))
    assert "noise_reduction" in neural["modules"]
    assert "noise_reduction" not in noisy["modules"]
    assert neural["excess_noise"] < noisy["excess_noise"]
    # The network's own error is in it, as in a plan of the simulator.
    simulator = CameraSimulator.from_pretrained("compact", cache=None)
    network = simulator.plan(scene, env.unwrapped.grid[12]).errors["network"]
    assert neural["predicted_error"] > 0.9 * network > 0.0
    assert neural["predicted_error"] < noisy["predicted_error"]
    assert exact["predicted_error"] == 0.0
