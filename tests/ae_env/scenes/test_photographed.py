"""One photograph in place of a scene: metered, as noisy as the camera, and in the environment."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ae_env.scenes.load import ISO_RANGE, load_scenes, simulate_source_raw
from simulator import CameraSimulator, exposure_ratio, get_camera
from tests.ae_env.environments import make_env
from tests.ae_env.scorer_images import random_scene

CAMERA = get_camera("nikon_z6")


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
    with pytest.raises(ValueError, match=r"`scene` \(='scene-0'\) must be free of noise"):
        simulate_source_raw(drawn[0])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"iso_range": (6400.0, 100.0)}, r"`iso_range` \(=\(6400.0, 100.0\)\) must be ascending"),
        ({"iso": 0.0}, r"`iso` \(=0.0\) must be a number in"),
        ({"ev": float("nan")}, r"`ev` \(=nan\) must be a number in"),
    ],
)
def test_settings_that_no_camera_has_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        simulate_source_raw(random_scene(), **options)


def test_a_scene_too_dark_for_the_meter_is_named():
    black = replace(random_scene(scene_id="cellar"), light=torch.zeros(4, 8, 8))
    with pytest.raises(ValueError, match=r"'cellar'.* is too dark"):
        simulate_source_raw(black)


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
