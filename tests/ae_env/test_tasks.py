"""`ExposureBracket-v0` and `AutoExposureVideo-v0`: their rules, and one and many of them."""

import inspect
import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

import ae_env
from ae_env import ExposureGrid, Scene
from ae_env.lighting.moving import KIND_SETS
from ae_env.merging import log_error, merge
from ae_env.tasks import move_subject
from simulator.camera import get_camera
from simulator.capture.prepared_scene import Layout
from simulator.radiance.light import WHITE_SIGNAL
from tests.ae_env.environments import SMALL, assert_same, check_parity, make_env, make_envs
from tests.ae_env.scorer_images import make_scene

ID = "ae_env/ExposureBracket-v0"
GRID = ExposureGrid.bracket()
STOP = len(GRID)


def bracket(**arguments: Any) -> gym.Env:
    return make_env(ID, **arguments)


def four(values: list[float]) -> torch.Tensor:
    """(1, K, 4) numbers, the same for the four planes."""
    return torch.tensor(values)[None, :, None].expand(1, -1, 4)


def frames(*values: list[float]) -> torch.Tensor:
    """(B, K, 4, 1, 1) signals of one pixel."""
    return torch.tensor(values)[:, :, None, None, None].expand(-1, -1, 4, 1, 1)


def test_merging_weighs_by_the_inverse_of_the_noise() -> None:
    """By hand: light 0.1 at gains 1 and 4, read noise 1e-4 and 4e-4, no shot noise."""
    gains = torch.tensor([[1.0, 4.0]])
    noise = four([0.0, 0.0]), four([1e-4, 4e-4])
    light, precision = merge(frames([0.11, 0.38]), gains, *noise)
    weights = np.array([1.0 / 1e-4, 16.0 / 4e-4])
    expected = (weights * [0.11, 0.095]).sum() / weights.sum()
    np.testing.assert_allclose(light, expected, rtol=1e-6)
    np.testing.assert_allclose(precision, weights.sum(), rtol=1e-6)
    # White samples and missing frames have no weight.
    gains = torch.tensor([[1.0, 4.0], [1.0, 0.0]])
    noise = (four([1e-3, 1e-3]).expand(2, 2, 4),) * 2
    light, precision = merge(frames([0.3, 0.99], [0.99, 0.98]), gains, *noise)
    np.testing.assert_allclose(light[0], 0.3, rtol=1e-6)
    assert float(precision[0].min()) > 0.0
    assert not precision[1].any()
    assert not light[1].any()
    # Variance of the merged light over 40,000 draws, and no frame alone is better.
    generator = torch.Generator().manual_seed(3)
    light, gains = 0.02, torch.tensor([[1.0, 6.0, 20.0]])
    shot, read = four([2e-3, 8e-3, 8e-3]), four([4e-5, 1e-4, 1e-4])
    mean = (gains * light)[:, :, None, None, None].expand(1, 3, 4, 100, 100)
    variance = shot[..., None, None] * mean + read[..., None, None]
    signals = mean + variance.sqrt() * torch.randn(mean.shape, generator=generator)
    merged, precision = merge(signals, gains, shot, read)
    assert float(merged.mean()) == pytest.approx(light, rel=0.01)
    # Relative standard error of a variance from n draws: sqrt(2 / n); five of them.
    spread = float(merged.double().var())
    assert spread == pytest.approx(float((1.0 / precision).mean()), rel=5 * math.sqrt(2 / 40_000))
    alone = (variance / gains[:, :, None, None, None] ** 2)[0, :, 0, 0, 0]
    assert spread < float(alone.min())


def test_log_error_by_hand() -> None:
    light = torch.tensor([0.2, 0.05, 0.0, 9.0, 0.1]).view(1, 1, 1, 5).expand(1, 4, 1, 5)
    truth = torch.full((1, 4, 1, 5), 0.1)
    precision = torch.ones(1, 4, 1, 5)
    precision[..., 4] = 0.0
    error = log_error(light, precision, truth, torch.tensor([0.0]))[0, 0, 0]
    np.testing.assert_allclose(error, [1.0, 1.0, 2.0, 2.0, 2.0], rtol=1e-6)
    error = log_error(light, precision, truth, torch.tensor([0.1]))[0, 0, 0]
    np.testing.assert_allclose(error[2], 1.0, rtol=1e-6)  # (0 + 0.1) / (0.1 + 0.1)


def two_lights(low: float, high: float) -> Scene:
    """A scene at EV100 10: one half is `low` of white, the other `high`."""
    light = np.full((4, 36, 36), low * WHITE_SIGNAL)
    light[:, :, 18:] = high * WHITE_SIGNAL
    return make_scene(light, 2560.0, scene_id="two")


def test_rewards_add_up_to_the_quality_of_the_picture() -> None:
    """One frame shows half of the scene; the other half has the largest error, 2 EV of 2."""
    env = bracket(scenes=[two_lights(0.2, 40.0)], split="all", noise=False, motion="none")
    _, info = env.reset(seed=0)
    assert info["quality"] == info["frames"] == 0
    assert info["time_left"] == 0.3
    # EV100 10 is ISO 100, 1/60 s, f/4: white is at 0.85, so 0.2 at 0.17, and 40 needs 1/4000 s.
    long, short = GRID.index(0, 3, 0), GRID.index(0, 0, 0)
    observation, reward, ended, _, info = env.step(long)
    assert info["unseen"] == 0.5
    assert reward == info["quality"] == pytest.approx(0.5, abs=2e-3)
    assert info["time_left"] == pytest.approx(0.3 - 1 / 60 - 1 / 60)
    assert not ended
    shown = observation["bracket"].tolist()
    assert shown == pytest.approx([info["time_left"] / 0.3, 2 / 3, 0.5, 0.0], rel=1e-6)
    _, more, ended, _, info = env.step(short)
    assert info["unseen"] == 0.0
    assert not ended
    assert reward + more == pytest.approx(info["quality"])
    assert info["quality"] > 0.99
    _, nothing, ended, _, after = env.step(STOP)
    assert nothing == 0.0
    assert ended
    assert after["quality"] == info["quality"]
    assert after["frames"] == 2


def test_an_episode_ends_with_its_frames_or_its_time() -> None:
    env = bracket()
    env.reset(seed=0)
    assert [env.step(0)[2] for _ in range(3)] == [False, False, True]
    env.reset(seed=0)
    longest = GRID.index(0, 5, 0)
    assert not env.step(longest)[2]
    left = 0.3 - 0.25 - 1 / 60
    masks = env.unwrapped.action_masks()
    assert masks.tolist() == [s.exposure_time <= left for s in GRID] + [True]
    before = env.unwrapped.core.episode(0).frame
    *_, ended, _, info = env.step(longest)  # does not fit: no frame, and the end
    assert ended
    assert info["frames"] == 1
    assert env.unwrapped.core.episode(0).frame == before
    one = bracket(max_frames=1)
    one.reset(seed=0)
    assert one.step(0)[2]


def test_the_viewfinder_is_metered_and_noise_lowers_the_quality() -> None:
    env = bracket(scenes=[two_lights(0.14, 0.14)], split="all")
    # The mean is 0.14 of white, 0.12 of the sensor's, at EV100 10: ISO 100, 1/60 s.
    assert env.reset(seed=0)[1]["state"] == GRID.index(0, 3, 0)
    assert env.reset(seed=0, options={"state": 5})[1]["state"] == 5
    # The mean of |log2(1 + s z)| for a normal z is sqrt(2 / pi) s / ln 2 for a small s.
    scene = two_lights(0.5, 0.5)
    state = GRID.index(2, 1, 0)  # ISO 1600, 1/1000 s
    env = bracket(scenes=[scene], split="all", motion="none", noise="exact")
    env.reset(seed=1)
    *_, info = env.step(state)
    signal = 0.5 * WHITE_SIGNAL * 2.0 ** float(10.0 - GRID.ev100[state])
    nlf = get_camera("nikon_z6").nlf(1600)
    noise = np.sqrt(np.array(nlf.shot) * signal + np.array(nlf.read)) / signal
    expected = float((math.sqrt(2.0 / math.pi) * noise / math.log(2.0)).mean())
    # 5,184 samples; the standard deviation of |z| is 0.76 of its mean.
    assert info["log_error"] == pytest.approx(expected, rel=5 * 0.76 / math.sqrt(5184) + 0.01)
    assert info["quality"] == pytest.approx(1.0 - info["log_error"] / 2.0)


def test_a_subject_moves_between_frames_and_leaves_ghosts() -> None:
    mask = torch.zeros(36, 36, dtype=torch.bool)
    mask[10:20, 4:12] = True
    light = torch.where(mask, 0.4, 0.1).expand(4, -1, -1)
    scene = make_scene(light.numpy(), 2560.0, layout=Layout(torch.zeros(36, 36), mask))
    there = move_subject(scene, 3, -6)  # two columns of it leave the frame
    expected = torch.full((4, 36, 36), 0.1)
    expected[:, 13:23, 0:6] = 0.4
    np.testing.assert_allclose(there.light, expected, rtol=1e-6)
    assert there.layout.subject.sum() == 60
    assert move_subject(scene, 0, 40).layout.subject is None
    # Two frames of a subject that crosses the frame in a second are worse than one, as it is
    # elsewhere in the second; of one that stays, they are better.
    core = (env := bracket(scenes=[scene], split="all", motion="random")).unwrapped.core
    gains = []
    for speed in (0.0, 5.0):
        env.reset(seed=0)
        episodes = core.episodes
        episodes.speed[0], episodes.subject_speed[0], episodes.subject_direction[0] = 0, speed, 0
        # Private: no draw can be asked for a subject's speed alone.
        episodes._set_light_index(np.array([0]))
        env.step(GRID.index(1, 1, 0))
        gains.append(env.step(GRID.index(1, 1, 0))[1])
    assert gains[0] > 0.0 > gains[1]


def test_bad_arguments_are_refused() -> None:
    for name, value in (("budget", 0), ("budget", "long"), ("max_frames", 0)):
        with pytest.raises(ValueError, match=f"`{name}`"):
            bracket(**{name: value})
    for name in ("buget", "scorer", "lighting", "with_oracle"):
        with pytest.raises(TypeError, match=name):
            bracket(**{name: "balanced"})
    env = bracket()
    with pytest.raises(AttributeError, match="budget"):  # it would have no effect
        env.unwrapped.budget = 1e-3
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"`action` \(=25\)"):
        env.unwrapped.step(np.int64(25))
    with pytest.raises(ValueError, match="no score table"):
        env.unwrapped.expected_scores()


VIDEO_ID = "ae_env/AutoExposureVideo-v0"
VIDEO: dict[str, Any] = {
    "grid": "video",
    "lighting": "moving",
    "delay": {"iso": 1, "exposure_time": 2, "f_number": 2},
    "costs": {"flicker": 1.0},
}


def test_it_is_the_other_environment_with_its_defaults():
    """The same frames as `AutoExposure-v0` with these arguments; 96 steps; defaults may change."""
    video = gym.make_vec(VIDEO_ID, num_envs=3, **SMALL)
    plain = make_envs(3, max_episode_steps=96, **VIDEO)
    assert_same(video.reset(seed=5), plain.reset(seed=5))
    for action in (7, 40, 63):
        assert_same(video.step(np.full(3, action)), plain.step(np.full(3, action)))
    assert video.unwrapped.max_episode_steps == gym.spec(VIDEO_ID).max_episode_steps == 96
    for kind in (ae_env.AutoExposureVideoEnv, ae_env.AutoExposureVideoVectorEnv):
        shown = inspect.signature(kind).parameters
        assert {name: shown[name].default for name in VIDEO} == VIDEO
    changed = gym.make(VIDEO_ID, delay=0, grid="default", **SMALL)
    assert changed.unwrapped.delays == (0, 0, 0)
    same = dict.fromkeys(("iso", "exposure_time", "f_number"), 2)
    assert make_envs(1, delay=same).unwrapped.core.options.delay == 2
    assert changed.unwrapped.grid == ae_env.ExposureGrid.default()
    with pytest.raises(TypeError, match="did you mean 'lighting'"):
        gym.make(VIDEO_ID, lightning="moving")


def test_one_and_many_are_the_same() -> None:
    for mode in ("NEXT_STEP", "SAME_STEP", "DISABLED"):
        check_parity(3, 9, mode, task=ID, budget=0.1)
    check_parity(3, 7, max_episode_steps=4, with_oracle=True, **VIDEO)


def test_each_control_has_its_own_delay():
    """ISO in the frame after the next, exposure time and aperture in the one after that."""
    envs = make_envs(1, max_episode_steps=None, **(VIDEO | {"lighting": "static"}))
    grid = envs.unwrapped.grid
    envs.reset(seed=0, options={"state": [grid.index(0, 0, 0)]})
    actions = [(1, 1, 1), (2, 2, 2), (3, 3, 3), (0, 1, 2), (0, 0, 0)]
    # Frame n + 1 has the ISO of action n - 1, and the time and the aperture of action n - 2.
    expected = [(0, 0, 0), (1, 0, 0), (2, 1, 1), (3, 2, 2), (0, 3, 3)]
    for action, shown in zip(actions, expected, strict=True):
        info = envs.step(np.array([grid.index(*action)]))[4]
        assert grid.controls(info["state"][0]).tolist() == list(shown)
        state = grid[grid.index(*shown)]
        assert (info["iso"][0], info["exposure_time"][0]) == (state.iso, state.exposure_time)


def test_the_light_is_of_the_kinds_of_the_split() -> None:
    pans = {"kind": "moving", "kinds": ["pans"]}
    for split, kinds in KIND_SETS.items():
        for given, wanted in (({}, kinds), ({"lighting": pans}, ("pans",))):
            core = gym.make(VIDEO_ID, split=split, **given, **SMALL).unwrapped.core
            assert core.episodes.lighting.drawn_from == wanted
