"""Scenes by name, list and attribute; with trained networks, and photographed by the camera."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from ae_env.grid import ExposureGrid
from ae_env.scenes import Scene, load_scenes
from ae_env.scenes.load import ISO_RANGE, SceneNetworks, simulate_source_raw
from ae_env.scorers import make_scorer
from ae_env.scorers.score_table import ScoreTables
from simulator import CameraSettings, CameraSimulator, exposure_ratio, get_camera
from simulator.networks.aperture_module import BLUR_FACTOR, DEAD_ZONE
from simulator.networks.weights import build_modules, save_modules
from tests.ae_env.environments import assert_equal, check_parity, make_env, rollout
from tests.ae_env.scene_files import load, write_hdr
from tests.ae_env.scorer_images import random_scene

CAMERA = get_camera("nikon_z6")


def my_scenes(split: str, camera: object) -> list[Scene]:
    light = torch.full((4, 16, 16), 0.3 if split == "train" else 0.6)
    settings = CameraSettings(100, 0.01, 4)
    return [Scene.from_array(light, settings, CAMERA, scene_id=split)]


MINE = my_scenes("all", None)


def test_scenes_from_lists_and_attributes() -> None:
    for split in ("train", "test", "all"):
        assert [s.scene_id for s in load(MINE, split)] == ["all"]
        assert [s.scene_id for s in load(f"{__name__}:MINE", split)] == ["all"]
        assert [s.scene_id for s in load(f"{__name__}:my_scenes", split)] == [split]
    assert load(MINE, resolution=8)[0].box_factor == 2


def test_small_folder_is_zero_shot(tmp_path: Path) -> None:
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
        ("bundeld", r"did you mean 'bundled'"),
        ("bundled:smal", r"did you mean 'bundled:small'"),
        ("no/such/folder", r"`scenes` \(='no/such/folder'\) must name an existing file"),
        ("no_such_module:scenes", "cannot be loaded: ModuleNotFound"),
        (f"{__name__}:MINES", "did you mean 'MINE'"),
        ("math:pi", "must give a list of Scene, not float"),
        ([1], r"`scenes\[0\]` \(of type int\)"),
        ([], "at least one scene"),
        ([*MINE, *MINE], r"`scene_id` \(='all'\) must be unique"),
        (3, "`scenes`"),
        ({"lux": 3}, "must have a 'path'"),
        ({"path": "x", "illuminace": 3}, "did you mean 'illuminance'"),
        ({"path": "bundled", "kind": "snow"}, "give the name"),
    ],
)
def test_errors_name_the_value_and_the_rule(spec: object, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        load(spec)


#: Circle of confusion that the networks of these tests find everywhere [pixel].
FOUND = 4.0


#: What is left of it after the dead zone.
DIAMETER = BLUR_FACTOR * math.sqrt(FOUND**2 - DEAD_ZONE**2)


NOISY = CameraSettings(6400, 1 / 1024, 8)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> str:
    """An untrained denoiser, and a defocus map that is the same everywhere."""
    torch.manual_seed(0)
    modules = build_modules("compact")
    tail: Any = modules["aperture"].network.tail
    with torch.no_grad():
        tail.weight.zero_()
        tail.bias.fill_(math.log(FOUND + 0.3))
    path = tmp_path_factory.mktemp("weights") / "tiny"
    save_modules(path, modules, "compact", {})
    return str(path.with_suffix(".safetensors"))


def noisy_scenes() -> list[Scene]:
    """Photographs at ISO 6400, of 80 x 80 pixels."""
    rng = np.random.default_rng(0)
    nlf = CAMERA.nlf(NOISY.iso)
    scenes = []
    for i in range(2):
        light = 0.1 + 0.3 * rng.random((4, 80, 80))
        light += rng.normal(size=light.shape) * np.sqrt(nlf.read[0] + nlf.shot[0] * light)
        data = torch.from_numpy(light.astype(np.float32))
        scenes.append(Scene.from_array(data, NOISY, CAMERA, scene_id=f"noisy-{i}", nlf=nlf))
    return scenes


NOISY_SCENES = noisy_scenes()


NAMED = f"{__name__}:NOISY_SCENES"


def flat_scene(light: float, denoised: float | None = None) -> Scene:
    given: dict[str, Any] = {"scene_id": "flat", "illuminance": 640.0}
    if denoised is not None:
        given |= {"nlf": CAMERA.nlf(NOISY.iso), "denoised": torch.full((4, 40, 40), denoised)}
    return Scene.from_array(torch.full((4, 40, 40), light), NOISY, CAMERA, **given)


def _make(**arguments: Any) -> gym.Env:
    return make_env(**{"scenes": NOISY_SCENES, "resolution": 40, **arguments})


def _state(iso: float, time: float, f_number: float) -> int:
    return ExposureGrid.default().states.index(CameraSettings(iso, time, f_number))


def test_noise_free_scenes_neither_need_nor_notice_networks(tmp_path: Path) -> None:
    """The weights named here cannot be read: whoever loads them fails."""
    damaged = tmp_path / "damaged.safetensors"
    damaged.write_bytes(b"no weights")
    damaged.with_suffix(".json").write_text("{}")
    arguments = {"scenes": "bundled:small", "resolution": 36, "with_oracle": True}
    without = rollout(1, **arguments, simulator=None)
    assert_equal(rollout(1, **arguments, simulator=str(damaged)), without)
    assert_equal(rollout(1, **arguments), without)
    with pytest.raises(ValueError, match="damaged"):
        _make(simulator=str(damaged))


@pytest.mark.parametrize("reward", ["capture", "expected"])
def test_what_is_in_the_frame_moves_the_reward(weights: str, reward: str) -> None:
    """All at ISO 100 and 1/15 s, of one picture: rewards rise as frames have less noise."""
    generator = torch.Generator().manual_seed(0)
    picture = replace(
        flat_scene(0.05), light=0.05 * (1.0 + 0.1 * torch.rand(4, 40, 40, generator=generator))
    )
    noisy = replace(picture, nlf=CAMERA.nlf(NOISY.iso))

    def made(scene: Scene, **arguments: Any) -> tuple[float, dict[str, float]]:
        fixed = {"motion": "none", "depth": "far", "reward": reward, **arguments}
        env = _make(scenes=[scene], **{"simulator": None, **fixed})
        _, info = env.reset(seed=0, options={"state": _state(100, 1 / 15, 8)})
        return info["rewards"]["score"], info["rewards"]

    clean, terms = made(picture)
    assert made(picture, noise=False)[1]["noise"] == pytest.approx(1.0)
    assert terms["noise"] < 0.99
    left, its_terms = made(noisy)  # exposure and noise level function alone: the noise stays
    assert left < clean
    assert its_terms["noise"] < terms["noise"]
    denoised, _ = made(noisy, simulator=weights)
    assert left < denoised <= clean + 0.01
    assert made(noisy, simulator=weights, tolerance=1e6)[0] == left  # no network is needed


def test_denoised_light_is_scored_where_it_is_taken() -> None:
    """Where a target is cleaner than the source, it is the denoised light's score."""
    noisy = replace(flat_scene(0.2, denoised=0.1), nlf=CAMERA.nlf(6400))
    tables = ScoreTables(ExposureGrid.default(), CAMERA, make_scorer("balanced"))
    without, found = tables.table(flat_scene(0.1)).parts, tables.table(noisy).parts
    state = 9  # ISO 100, 1/15 s, f/5.6: denoised
    for name in ("highlights", "shadows", "noise"):
        assert found[name][state] == pytest.approx(without[name][state], abs=1e-5)
    raw = tables.table(replace(noisy, denoised=None)).parts
    assert raw["noise"][state] < found["noise"][state] - 0.1
    mapped = replace(noisy, denoised=None, defocus_map=torch.ones(40, 40))
    assert tables.table(mapped).parts["sharpness"][0] < raw["sharpness"][0]


def point_scene(size: int = 80) -> Scene:
    """A point of light, without noise, taken at f/8."""
    light = torch.zeros(4, size, size)
    light[:, size // 2 : size // 2 + 2, size // 2 : size // 2 + 2] = 0.9
    reference = CameraSettings(100, 1 / 125, 8)
    return Scene.from_array(light, reference, CAMERA, scene_id="point", illuminance=640.0)


def test_opening_grows_the_scenes_own_defocus(weights: str) -> None:
    """Found at 80 x 80 pixels, halved at 40 x 40; a disc's variance is its squared diameter / 16"""
    arguments = {"scenes": [point_scene()], "simulator": weights, "depth": "unknown"}
    env = _make(**arguments, motion="none", noise=False, observation="linear")
    for f_number, growth in ((4, 4.0 - 1.0), (5.6, 2.0 - 1.0), (8, 0.0), (11, 0.0)):
        options = {"state": _state(100, 1 / 125, f_number)}
        observation, info = env.reset(seed=0, options=options)
        raw = observation["raw"][0].astype(np.float64)
        assert info["modules"] == ("exposure+aperture" if growth else "exposure")
        if growth:
            columns = np.arange(40) - 20
            variance = np.average(columns**2, weights=raw.sum(axis=0))
            assert variance == pytest.approx((DIAMETER / 2.0) ** 2 * growth / 16.0, rel=0.03)
        else:  # closing leaves the blur: not a digital number differs
            sharp = np.zeros((40, 40))
            sharp[20, 20] = 0.9 * (1.0 if f_number == 8 else 0.5)
            np.testing.assert_allclose(raw, sharp, atol=1 / CAMERA.span[0])


def test_vector_environment_equals_single_ones(weights: str) -> None:
    arguments = {"scenes": NOISY_SCENES, "resolution": 40, "simulator": weights}
    check_parity(5, 5, depth="unknown", **arguments)


def test_map_of_a_crop_is_that_of_the_whole_frame(tmp_path: Path) -> None:
    """Only the middle of a large frame is looked at, with what the networks see around it."""
    torch.manual_seed(3)
    modules = build_modules("compact")
    tail: Any = modules["aperture"].network.tail
    with torch.no_grad():
        tail.bias.fill_(math.log(FOUND + 0.3))  # beyond the dead zone
    save_modules(tmp_path / "random", modules, "compact", {})
    networks = SceneNetworks(str(tmp_path / "random.safetensors"))
    light = 0.3 * torch.rand((4, 252, 244), generator=torch.Generator().manual_seed(1))
    scene = Scene.from_array(light, CameraSettings(100, 0.01, 8), CAMERA, scene_id="large")
    with torch.no_grad():
        whole = modules.eval()["aperture"].defocus(light[None], torch.zeros_like(light)[None])[0]
    native = networks.resized(scene, 16, "native")
    torch.testing.assert_close(native.defocus_map, whole[118:134, 114:130], rtol=1e-3, atol=1e-4)
    assert float(whole.std()) > 1e-3


def test_maps_are_kept_and_made_again_where_damaged(
    weights: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path))
    scene = NOISY_SCENES[0]
    first = SceneNetworks(weights).resized(scene, 40).defocus_map
    (file,) = (tmp_path / "defocus_maps").iterdir()
    for damage in (False, True):
        if damage:
            file.write_bytes(b"damaged")
        torch.testing.assert_close(
            SceneNetworks(weights).resized(scene, 40).defocus_map, first, rtol=0, atol=0
        )
        assert ("damaged" in caplog.text) == damage
    SceneNetworks(weights).resized(replace(scene, nlf=scene.nlf.scaled(0.5)), 40)
    assert len(list(file.parent.iterdir())) == 2


def test_every_source_of_scenes_is_seen_at_its_finest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_hdr(tmp_path / "map.hdr", height=96, width=100)
    bundled = [point_scene(256)]
    monkeypatch.setattr(
        "ae_env.scenes.load.bundled_scenes",
        lambda request, **size: bundled if request.resolution is None else [],
    )
    seen = []

    def resize(scene: Scene, resolution: int | None, crop: Any) -> Scene:
        seen.append(scene.light.shape[-1])
        return scene.resized(resolution, crop)

    for spec in (tmp_path, str(tmp_path), {"path": str(tmp_path)}, "bundled", NAMED, NOISY_SCENES):
        scenes = load_scenes(spec, "test", camera=CAMERA, resolution=40, resize=resize)
        assert {s.light.shape for s in scenes} == {(4, 40, 40)}
    assert seen == [80, 80, 80, 256, 80, 80, 80, 80]


def test_it_is_metered_by_its_mean():
    darker, metered, brighter = (
        simulate_source_raw(random_scene(), iso=100.0, ev=e) for e in (-1, 0, 1)
    )
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


def test_iso_and_exposure_are_drawn_by_name_and_seed():
    scenes = [random_scene(scene_id=f"scene-{i}") for i in range(40)]
    drawn = [simulate_source_raw(scene) for scene in scenes]
    isos = np.array([scene.reference.iso for scene in drawn])
    assert isos.min() >= ISO_RANGE[0]
    assert isos.max() <= ISO_RANGE[1]
    assert np.ptp(np.log2(isos)) > 4
    assert torch.equal(simulate_source_raw(scenes[3]).light, drawn[3].light)
    assert simulate_source_raw(scenes[3], seed=1).reference != drawn[3].reference


@pytest.mark.parametrize(
    ("options", "changes", "message"),
    [
        ({"iso": 0.0}, {}, "`iso`"),
        ({}, {"light": torch.zeros(4, 8, 8)}, "'cellar'.* is too dark"),
        ({}, {"nlf": CAMERA.nlf(400)}, "`scene`"),
    ],
)
def test_what_no_camera_can_photograph_is_refused(options, changes, message):
    with pytest.raises(ValueError, match=message):
        simulate_source_raw(replace(random_scene(scene_id="cellar"), **changes), **options)


def test_in_the_environment_everything_comes_from_the_raw():
    """The neural simulator takes part: cleaner states are denoised, and the plan says its error."""
    env = make_env(scenes="bundled:small", source="raw", motion="none", depth="far")
    truth = make_env(scenes="bundled:small", motion="none", depth="far")
    bare = make_env(
        scenes="bundled:small", source="raw", simulator=None, motion="none", depth="far"
    )
    scene = max(env.unwrapped.scenes, key=lambda s: s.reference.iso)
    assert not scene.noise_free
    options = {"scene": scene.scene_id, "state": 12}  # ISO 100, 1/2 s
    shown = [e.reset(seed=0, options=options) for e in (env, truth, bare)]
    (_, neural), (_, exact), (_, noisy) = shown
    assert "noise_reduction" in neural["modules"]
    assert "noise_reduction" not in noisy["modules"]
    assert neural["excess_noise"] < noisy["excess_noise"]
    # The network's own error is in it, as in a plan of the simulator.
    plan = CameraSimulator.from_pretrained("compact", cache=None).plan(
        scene, env.unwrapped.grid[12]
    )
    assert neural["predicted_error"] > 0.9 * plan.errors["network"] > 0.0
    assert neural["predicted_error"] < noisy["predicted_error"]
    assert exact["predicted_error"] == 0.0
    assert set(neural) == set(exact)


def test_raws_stay_the_raws_that_they_are(data_dir):
    loaded = load_scenes(data_dir / "canon_crw_cc0", "all", camera=CAMERA, resolution=64)
    env = make_env(scenes=str(data_dir / "canon_crw_cc0"), split="all", source="raw")
    assert [s.reference for s in env.unwrapped.scenes] == [s.reference for s in loaded]
