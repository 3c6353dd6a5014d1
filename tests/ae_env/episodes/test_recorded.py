"""Environments on recorded grids show the captures that there are, and nothing else."""

import pickle
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_for_sb3

from ae_env import contact_sheet, load_scenes
from ae_env.episodes.lookup import nearest_recorded
from ae_env.grid import ExposureGrid
from ae_env.observation import encode_observation
from ae_env.scenes import Scene
from simulator import CameraSettings, get_camera
from tests.ae_env.environments import ID, check_parity, make_env
from tests.ae_env.recorded_files import GRID, capture, write_raws, write_states, write_video

CAMERA = get_camera("nikon_z6")
#: States that scene "b" lacks: the brightest, and one with others as bright.
HOLES = (5, 6)


@pytest.fixture(scope="module")
def raws(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("raws")
    write_raws(folder / "a")
    write_raws(folder / "b", [s for i, s in enumerate(GRID) if i not in HOLES], seed=1)
    return folder


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("video")
    write_video(folder)
    return {"recorded": str(folder), "iso": 400, "f_number": 4}


def arguments(scenes: Any, **more: Any) -> dict[str, Any]:
    spec = f"recorded:{scenes}" if isinstance(scenes, Path) else scenes
    return {"scenes": spec, "split": "test", **more}


def test_every_observation_is_the_capture(raws: Path) -> None:
    black = np.array(CAMERA.black_level)[:, None, None]
    span = np.array(CAMERA.span)[:, None, None]
    envs = {kind: make_env(**arguments(raws, observation=kind)) for kind in ("linear", "dn")}
    envs["uint8"] = make_env(**arguments(raws))
    for kind, env in envs.items():
        env.reset(seed=0, options={"scene": "a", "state": 0})
        for state in (3, 7, 0):
            observation, _, _, _, info = env.step(state)
            data = central(GRID[state], 0)
            expected = {
                "linear": data.clamp(-1 / 1024, 1.0).numpy(),
                "dn": np.rint(data.numpy() * span + black).astype(np.uint16),
                "uint8": encode_observation(data[None])[0].numpy(),
            }[kind]
            np.testing.assert_array_equal(observation["raw"], expected)
            assert (info["state"], info["modules"]) == (state, "recorded")
            assert info["clipped_high"] == pytest.approx(float((data >= 1.0).float().mean()))
            assert info["excess_noise"] == 0.0


def test_states_without_a_capture_are_masked_and_never_shown(raws: Path) -> None:
    base: Any = make_env(**arguments(raws)).unwrapped
    assert base.action_space.n == len(GRID)
    for seed in range(8):  # no episode starts there
        _, info = base.reset(seed=seed, options={"scene": "b"})
        assert info["state"] not in HOLES
    assert np.flatnonzero(~base.action_masks()).tolist() == list(HOLES)
    # ISO 1600, 1/1000 s, f/8 is missing: ISO 100, 1/125 s, f/8 is a stop darker, others more off.
    for action, shown in ((5, 3), (6, 7)):
        observation, _, _, _, info = base.step(action)
        assert info["state"] == shown
        assert (info["iso"], info["exposure_time"]) == (GRID[shown].iso, GRID[shown].exposure_time)
        expected = encode_observation(central(GRID[shown], 1)[None])[0].numpy()
        np.testing.assert_array_equal(observation["raw"], expected)
    _, info = base.reset(seed=0, options={"scene": "b", "state": 5})
    assert info["state"] == 3
    # Of the 64 states those at f/4 and f/8 with ISO 100 or 1600 and 1/1000 or 1/125 s were taken.
    named: Any = make_env(**arguments(raws, grid="default")).unwrapped
    assert named.action_space.n == 64
    (whole,) = (scene for scene in named.scenes if scene.scene_id == "a")
    assert whole.allowed.sum() == 8


def test_the_nearest_capture_is_nearest_in_exposure_first() -> None:
    grid = ExposureGrid((100, 200, 400), (1 / 64, 1 / 32), (4,))
    fields = {"recorded": torch.zeros(6, 4, 4, 4), "allowed": np.array([1, 1, 0, 1, 1, 0], bool)}
    scene = Scene.from_array(torch.full((4, 4, 4), 0.1), grid[0], CAMERA, scene_id="a", **fields)
    # ISO 200, 1/64 s: ISO 100, 1/32 s is as bright. ISO 400, 1/32 s: a stop off are two, both a
    # stop away in one control; the lower ISO wins.
    assert nearest_recorded(scene, grid).tolist() == [0, 1, 1, 3, 4, 3]


def test_frames_of_a_video_follow_each_other_whatever_is_chosen(video: dict[str, Any]) -> None:
    env = make_env(**arguments(video))
    _, info = env.reset(seed=0, options={"scene": "street", "state": 0})
    shown = [info["scene_id"]]
    for action in (0, 2, 1, 1):
        observation, _, _, _, info = env.step(action)
        shown.append(info["scene_id"])
    assert shown == [f"street/frame_{i:04d}" for i in (0, 1, 2, 2, 2)]  # the last one stays
    expected = load_scenes(video, "all", camera=CAMERA, resolution=36)[2].recorded[1:2]
    np.testing.assert_array_equal(observation["raw"], encode_observation(expected)[0].numpy())
    _, info = env.reset(seed=0, options={"frame": 1})
    assert info["scene_id"] == "street/frame_0001"


def test_the_table_is_what_stepping_gives(raws: Path) -> None:
    """The oracle of a recorded grid is the best of the rewards that its captures earn."""
    for scorer in ("balanced", {"entropy": 0.5, "noise": 0.5}):
        env = make_env(**arguments(raws, scorer=scorer, with_oracle=True))
        base: Any = env.unwrapped
        env.reset(seed=0, options={"scene": "b"})
        rewards = np.full(len(GRID), -1.0)
        for state in np.flatnonzero(base.action_masks()):
            _, rewards[state], _, _, info = env.step(int(state))
        table = base.score_table()
        seen = rewards >= 0.0
        np.testing.assert_allclose(table.mean[seen], rewards[seen], atol=1e-6)
        assert not table.mean[~seen].any()
        assert info["oracle_state"] == rewards.argmax()


def test_native_vector_environments_show_the_same(raws: Path, video: dict[str, Any]) -> None:
    for scenes in (raws, video):
        given = arguments(scenes, with_oracle=True, costs={"flicker": 1.0})
        check_parity(0, 4, max_episode_steps=3, **given)


def test_the_checkers_find_nothing(raws: Path, tmp_path: Path, video: dict[str, Any]) -> None:
    write_states(tmp_path)
    for scenes in (raws, tmp_path, video):
        for kind in ("uint8", "statistics"):
            env = make_env(**arguments(scenes, observation=kind))
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                check_env(env.unwrapped)
                if kind == "uint8":  # the other is no image
                    check_for_sb3(env.unwrapped)


def test_environments_are_restored(raws: Path) -> None:
    env = make_env(**arguments(raws)).unwrapped
    for e in (env, copy := pickle.loads(pickle.dumps(env))):
        e.reset(seed=4)
    np.testing.assert_array_equal(env.step(1)[0]["raw"], copy.step(1)[0]["raw"])


def test_a_changed_folder_is_read_again(tmp_path: Path) -> None:
    write_raws(tmp_path / "a")
    assert len(make_env(**arguments(tmp_path)).unwrapped.scenes) == 1
    (tmp_path / "a" / "IMG_0007.dng").unlink()
    scene = make_env(**arguments(tmp_path)).unwrapped.scenes[0]
    assert scene.allowed is not None
    assert not scene.allowed[7]


def central(settings: CameraSettings, seed: int) -> torch.Tensor:
    """What the reference camera took, as written to the file; its middle 36 x 36 pixels."""
    return capture(settings, seed).data[:, 2:38, 2:38]


REAL = {"motion": 0.3, "depth": 1.0, "lighting": "step", "noise": "exact", "source": "raw"}


@pytest.mark.parametrize(("name", "value"), [*REAL.items(), ("noise", False)])
def test_nothing_of_real_captures_can_be_simulated(raws: Path, name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=rf"`{name}` .* must be .* for recorded"):
        make_env(**arguments(raws, **{name: value}))
    scenes = load_scenes(f"recorded:{raws}", "all", camera=CAMERA, resolution=36)
    with pytest.raises(ValueError, match=r"must name the folder of recorded scenes"):
        make_env(scenes=scenes)
    with pytest.raises(ValueError, match=r"`scenes` .* must not be recorded: of a bracket's"):
        make_env(ID.replace("AutoExposure-v0", "ExposureBracket-v0"), **arguments(raws))


def test_a_contact_sheet_leaves_holes_empty(raws: Path) -> None:
    scenes = load_scenes(f"recorded:{raws}", "all", camera=CAMERA, resolution=36)
    sheets = [np.asarray(contact_sheet(scene, grid=GRID)) for scene in scenes]
    background = sheets[0][0, 0]
    empty = [int((sheet == background).all(axis=2).sum()) for sheet in sheets]
    assert empty[1] - empty[0] > 2 * 90 * 90  # two pictures of about 100 x 100
