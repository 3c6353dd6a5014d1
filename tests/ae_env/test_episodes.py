"""Running episodes: frames of the simulator, rewards, copies; one and many are the same."""

import contextlib
import copy
import math
import pickle
import signal
from dataclasses import replace
from unittest.mock import Mock

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import NumpyToTorch

from ae_env.episodes.state import Episodes
from ae_env.observation import encode_observation
from ae_env.scenes.load import _LOADED
from ae_env.scorers import make_scorer
from ae_env.scorers.captures import SceneCaptures, prepare_scene
from simulator.camera import get_camera
from simulator.capture.sensor import clip_and_quantise
from simulator.noise.generator import frame_normals, noise_keys
from simulator.noise.noise_level_function import ReadNoise
from simulator.optics.flicker_integral import MainsLamp, PulsedLamp
from simulator.reference.reference_camera import ReferenceCamera, ReferenceScene
from tests.ae_env.environments import assert_equal, check_parity, make_env, make_envs
from tests.ae_env.scorer_images import CAMERA, Own, make_scene


def _frames(env):
    rng = np.random.default_rng(0)
    shown = [env.reset(seed=3)]
    shown += [env.step(rng.integers(64, size=3))[::4] for _ in range(10)]
    return [(o["raw"], info["clipped_high"], info["excess_noise"]) for o, info in shown]


def test_rows_of_the_read_noise_show_where_asked_for() -> None:
    """R and G1 share their rows, G2 has others."""
    known = get_camera("canon_70d")
    camera = replace(known, read_noise_by_iso={100.0: ReadNoise(0.9, 0.1)})
    envs = make_envs(noise="sensor", camera=camera, motion="none", observation="linear")
    darkest = [max(envs.core.grid, key=lambda s: (s.iso, -s.exposure_time, s.f_number))] * 3
    envs.reset(seed=3)
    actions = np.array([list(envs.core.grid).index(state) for state in darkest])
    first, *others = (envs.step(actions)[0]["raw"] for _ in range(6))
    rows = np.stack([(other - first).mean(axis=-1) for other in others])  # (5, 3, 4, H)
    correlation = np.corrcoef(rows.transpose(2, 0, 1, 3).reshape(4, -1))
    assert correlation[0, 1] > 0.5 < correlation[2, 3]
    assert np.abs(correlation[:2, 2:]).max() < 5 * math.sqrt(2 / rows[:, :, 0].size)
    with pytest.raises(ValueError, match="has no calibration of row noise"):
        make_envs(noise="sensor")


@pytest.mark.parametrize("noise", ["bank", "exact"])
@pytest.mark.parametrize("tolerance", [0.0, 0.1])
@pytest.mark.parametrize("lighting", ["static", "sine"])
def test_frames_are_those_of_the_simulator(noise, tolerance, lighting):
    """Light of `PreparedScene`, noise from the bank or drawn, step by step in float64."""
    envs = make_envs(noise=noise, tolerance=tolerance, lighting=lighting, observation="dn")
    core = envs.core
    span = np.array(core.camera.span)[:, None, None]
    black = np.array(core.camera.black_level)[:, None, None]
    rng = np.random.default_rng(1)
    envs.reset(seed=2)
    different = total = 0
    for _ in range(9):
        observation, *_ = envs.step(rng.integers(64, size=3))
        for i in range(3):
            episode, raw = core.episode(i), observation["raw"][i]
            state = core.grid[episode.state]
            gain = core.episodes.lighting.gain(episode.frame, state.exposure_time, episode.phase)
            scene = core.scenes[episode.scene]
            prepared = replace(prepare_scene(scene, core.camera, **episode.moves), gain=gain)
            prepared = replace(prepared, tolerance=tolerance)
            light = prepared.expected(state).double().numpy()
            key = int(noise_keys(episode.noise_seed, episode.frame)[0])
            normals = frame_normals(key, (4, 36, 36), noise)
            nlf = core.camera.nlf(state.iso).scaled(1.0 / prepared.box_factor**2)
            shot, read = (np.array(v)[:, None, None] for v in (nlf.shot, nlf.read))
            read = read - 1.0 / (12.0 * span**2)  # what rounding adds
            variance = np.maximum(np.maximum(light, 0) * shot + read, 0)
            noisy = light + np.sqrt(variance) * normals
            numbers = np.clip(np.rint(noisy * span + black), 0, core.camera.white_level)
            assert np.abs(raw - numbers).max() <= 1
            different, total = different + (raw != numbers).sum(), total + raw.size
    assert different < 1e-3 * total  # float32 against float64, where rounding is close


def test_scorers_that_look_at_images_see_the_frames_that_are_observed(monkeypatch) -> None:
    seen: list[torch.Tensor] = []

    def watch(images, captures):
        seen.append(images.clone())
        return torch.full((len(images),), 0.5)

    watched = _frames(make_envs(scorer=Own(watch)))
    monkeypatch.setattr("ae_env.episodes.core.CHUNK_SAMPLES", 1)  # frame by frame
    assert_equal(watched, _frames(make_envs()))
    _frames(make_envs(scorer=Own(watch), scenes="bundled:small", source="raw"))  # noisy light
    first, codes = encode_observation(seen[0]), torch.from_numpy(watched[0][0])
    assert float(seen[0].min()) >= 0.0
    assert (first.int() - codes.int()).clamp(max=0).max() == 0  # shadows below black show as black
    assert torch.equal(first[codes > 20], codes[codes > 20])


def test_white_is_1_whatever_the_black_level() -> None:
    """In float32 (1023 - 103.34) / (1023 - 103.34) is 1.0000001."""
    camera = replace(CAMERA, black_level=(103.34,) * 4, white_level=1023.0)
    envs = make_envs(camera=camera, observation="linear", depth="far", motion="none")
    observation, info = envs.reset(seed=0, options={"state": 63})
    assert info["clipped_high"].max() > 0
    assert observation["raw"].max() == 1.0
    assert envs.observation_space.contains(observation)


@pytest.mark.parametrize(
    "arguments",
    [{"motion": "none", "depth": "far"}, {}, {"scorer": {"sharpness": 1, "brightness": 1}}],
)
def test_expected_rewards_are_those_of_the_running_episodes(arguments):
    arguments = {"autoreset_mode": "SAME_STEP", "reward": "expected", **arguments}
    envs = make_envs(8, max_episode_steps=2, **arguments)
    core, rng = envs.core, np.random.default_rng(0)
    envs.reset(seed=0)
    for _ in range(4):
        info = envs.step(rng.integers(64, size=8))[4]
        for i in range(8):
            episode = core.episode(i)
            wanted = core.task.tables.table(core.scenes[episode.scene], **episode.moves)
            for name, scores in wanted.parts.items():
                assert info[f"rewards.{name}"][i] == pytest.approx(scores[episode.state], abs=1e-12)
            assert info["rewards.score"][i] == pytest.approx(wanted.mean[episode.state], abs=1e-12)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda envs: pickle.loads(pickle.dumps(envs))])
@pytest.mark.parametrize(
    "given",
    [
        {"motion": 0.5, "depth": 2.0, "delay": 1},
        {"task": "ae_env/ExposureBracket-v0"},
        {"device": "cpu", "observation": "dn", "autoreset_mode": "DISABLED"},
    ],
)
def test_a_copy_goes_on_like_the_original(given, copied):
    envs = make_envs(3, **given)
    envs.reset(seed=0)
    envs.step(np.array([0, 1, 6]))
    other = copied(envs)
    for actions in (np.array([2, 3, 4]), np.array([7, 1, 20])):
        assert_equal(envs.step(actions), other.step(actions))
    light = sum(scene.light.nbytes for scene in envs.scenes)
    assert len(pickle.dumps(envs)) < 0.5 * light  # no scenes that have a name


class _Interrupted:
    """A scorer that is interrupted in the batch of its `number`."""

    domain, number, calls = "raw", 5, 0

    def __call__(self, images, captures):
        self.calls += 1
        if self.calls == self.number:
            raise KeyboardInterrupt
        return images.mean(dim=(1, 2, 3)).clamp(0.0, 1.0)


def test_an_interrupt_leaves_rewards_that_are_numbers():
    """In the first frames of new episodes, whose change is a cost, and where these are set up."""
    given = {"costs": {"flicker": 1.0}, "max_episode_steps": 3}
    envs = make_envs(2, scorer=_Interrupted(), **given)
    envs.reset(seed=0)
    for step in range(6):
        with pytest.raises(KeyboardInterrupt) if step == 3 else contextlib.nullcontext():
            assert np.isfinite(envs.step(np.array([5, 6]))[1]).all()
    envs = make_envs(2, autoreset_mode="SAME_STEP", max_episode_steps=1)
    envs.reset(seed=0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Episodes, "_set_light_index", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            envs.step(np.array([5, 6]))
    with pytest.raises(gym.error.ResetNeeded):
        envs.step(np.array([5, 6]))


def _scene(allowed, scene_id="holes"):
    return make_scene(np.full((4, 40, 40), 0.12), 640.0, scene_id=scene_id, allowed=allowed)


def test_forbidden_states_are_masked_never_best_and_never_drawn() -> None:
    free = _scene(None, "free")
    best = int(np.argmax(make_envs(1, scenes=[free]).core.task.tables.table(free).mean))
    allowed = np.ones(64, bool)
    allowed[[best, 0, 1, 2, 63]] = False
    holes = _scene(allowed)
    envs = make_envs(64, scenes=[free, holes], motion="none", depth="far", with_oracle=True)
    assert envs.action_masks().all()  # before the first reset
    _, info = envs.reset(seed=0)
    shows_holes = info["scene_id"] == envs.scene_ids.index("holes")
    assert 10 < shows_holes.sum() < 54
    wanted = np.where(shows_holes[:, None], allowed, True)
    np.testing.assert_array_equal(envs.action_masks(), wanted)
    assert allowed[envs.states[shows_holes]].all()
    assert len(np.unique(envs.states[shows_holes])) > 5
    table = envs.score_table(int(np.flatnonzero(shows_holes)[0]))
    assert table.oracle != best
    assert table.oracle == np.argmax(np.where(allowed, table.mean, -1.0))
    assert info["oracle_state"].tolist() == np.where(shows_holes, table.oracle, best).tolist()
    assert envs.score_table(int(np.flatnonzero(~shows_holes)[0])).oracle == best
    envs.step(np.zeros(64, np.int64))  # forbidden, but a mask is advice
    assert (envs.states == 0).all()
    for bad in (np.ones(63, bool), np.zeros(64, bool), np.ones(64), np.ones((4, 16), bool)):
        with pytest.raises(ValueError, match="`allowed`"):
            make_envs(1, scenes=[_scene(bad)])


LED = {"kind": "flicker", "frequency": 250.0, "duty": 0.3, "frame_rate": 24.0}


def _grey():
    light = 0.05 + 0.3 * np.random.default_rng(0).random((4, 40, 40), np.float32)
    return make_scene(light, 640.0, scene_id="grey", box_factor=4)


def _env(**arguments):
    given = {"scenes": [_grey()], "resolution": 40, "motion": "none", "depth": "far"}
    return make_env(**{**given, **arguments}).unwrapped


@pytest.mark.parametrize(
    ("lighting", "make_lamp"),
    [
        ({"kind": "flicker", "depth": 1.0}, lambda phase: MainsLamp(100.0, 1.0, phase)),
        (LED, lambda phase: PulsedLamp(250.0, 0.3, phase)),
    ],
)
def test_frames_are_those_of_the_reference_camera(lighting, make_lamp):
    env, scene = _env(lighting=lighting, noise=False, observation="linear"), _grey()
    reference = ReferenceCamera(CAMERA, box_factor=4)
    native = scene.light.repeat_interleave(4, 1).repeat_interleave(4, 2)
    before = ReferenceScene("grey", "grey", "test", native, scene.reference)
    env.reset(seed=4)
    rate = lighting.get("frame_rate", 30.0)
    for frame, state in enumerate((0, 17, 22, 37, 50, 63), start=1):
        observation, *_ = env.step(state)
        lamp = make_lamp(env.episode().phase)
        wanted = reference.capture(before, env.grid[state], 0, lamp=lamp, start=frame / rate).mean
        step = 1.0 / min(CAMERA.span)  # the mean is not rounded to digital numbers
        np.testing.assert_allclose(observation["raw"], wanted, atol=0.51 * step)


@pytest.mark.parametrize("scorer", ["balanced", {"balanced": 0.7, "banding": 0.3}])
def test_scores_of_all_states_have_their_own_exposures_light(scorer):
    given = {"with_oracle": True, "motion": 0.05, "depth": 0.5, "noise": False}
    env = _env(lighting=LED, scorer=scorer, reward="expected", **given)
    env.reset(seed=0)
    _, reward, _, _, info = env.step(18)
    lamp, scene = PulsedLamp(250.0, 0.3, env.episode().phase), _grey()
    q = env.expected_scores()
    for state in (0, 9, 18, 30, 63):
        settings = env.grid[state]
        rows = lamp.row_light(1 / 24, settings.exposure_time, 40, CAMERA.row_time, 8)
        blur = {"speed": np.array([0.05]), "defocus": np.array([0.5])}
        gains = {"gain": np.array([rows.mean()]), "row_gain": rows[None] / rows.mean()}
        captures = SceneCaptures(CAMERA, [settings], noisy=False).of([scene], **blur, **gains)
        images = clip_and_quantise(captures.light, CAMERA).clamp(0.0, 1.0)
        wanted = float(make_scorer(scorer)(images, captures))
        assert q[state] == pytest.approx(wanted, abs=2e-3)  # rows at the edge of a code
    assert reward == pytest.approx(q[18], abs=1e-9)
    assert info["regret"] == pytest.approx(q.max() - q[18], abs=1e-6)


RICH = {"with_oracle": True, "observation": "linear", "lighting": "sine", "delay": 1}
RICH["costs"] = {"flicker": 0.1, "switch": 0.1}
BANDED = {"with_oracle": True, "scorer": {"balanced": 0.7, "banding": 0.3}, "delay": 2}
BANDED["lighting"] = {"kind": "flicker", "frequency": 500, "duty": 0.2}
EXPECTED = {"with_subject": True, "reward": "expected", "lighting": "flicker"}


@pytest.mark.parametrize(
    ("mode", "extra"),
    [
        *((mode.name, RICH) for mode in AutoresetMode),
        *(("SAME_STEP", extra) for extra in (BANDED, {"noise": "exact"}, EXPECTED)),
    ],
)
def test_parity_with_sync_vector_env(mode, extra):
    check_parity(11, 9, mode, max_episode_steps=3, **extra)


def test_rewards_do_not_depend_on_how_many_there_are() -> None:
    one, many = make_env(), make_envs(40)
    many.reset(seed=0)
    alone = [(one.reset(seed=i), one.step(i)[1])[1] for i in range(40)]
    np.testing.assert_array_equal(many.step(np.arange(40))[1], alone)


def test_delayed_settings_meet_the_light_of_their_frame() -> None:
    """The light of a frame does not wait; `info` and the score are of the settings in force."""
    extra = {"lighting": "sine", "motion": "none", "depth": "far", "max_episode_steps": None}
    delayed, direct = make_envs(delay=3, **extra), make_envs(**extra)
    start = np.array([3, 20, 41])
    for envs in (delayed, direct):
        envs.reset(seed=9, options={"state": start})
    actions = np.random.default_rng(2).integers(64, size=(5, 3))
    in_force = np.concatenate([np.tile(start, (3, 1)), actions])
    for frame in range(5):
        mine, theirs = delayed.step(actions[frame]), direct.step(in_force[frame])
        np.testing.assert_array_equal(mine[4]["state"], in_force[frame])
        times = [delayed.unwrapped.grid[s].exposure_time for s in in_force[frame]]
        np.testing.assert_array_equal(mine[4]["exposure_time"], times)
        assert_equal(mine, theirs, f"frame {frame}", rtol=1e-15)


def test_modes_are_those_of_gymnasiums_enum_and_frames_become_tensors() -> None:
    for mode in AutoresetMode:
        for given_as in (mode, mode.value):
            envs = make_envs(autoreset_mode=given_as, max_episode_steps=1)
            assert envs.metadata["autoreset_mode"] is mode
    # Gymnasium's `final_obs` of SAME_STEP is an array of objects; everything else is a number.
    envs = NumpyToTorch(make_envs(max_episode_steps=1, autoreset_mode="NEXT_STEP"))
    assert envs.reset(seed=0)[1]["modules"].dtype == torch.int64
    assert envs.step(torch.tensor([5, 6, 7]))[4]["rewards.score"].shape == (3,)


def test_resets_that_are_needed_and_options_of_each_environment() -> None:
    envs = make_envs(autoreset_mode="DISABLED", max_episode_steps=1, render_mode="rgb_array")
    first = {"options": {"reset_mask": np.array([True, False, True])}}
    for early in (envs.render, lambda: envs.step([0] * 3), lambda: envs.reset(**first)):
        with pytest.raises(gym.error.ResetNeeded):
            early()
    envs.reset(seed=0)
    envs.step([0] * 3)
    with pytest.raises(gym.error.ResetNeeded, match="reset_mask"):
        envs.step([0] * 3)
    envs = make_envs()
    ids = [envs.unwrapped.scenes[i].scene_id for i in (0, 2, 4)]
    _, info = envs.reset(seed=0, options={"scene": ids, "state": [1, 2, 3]})
    names = envs.unwrapped.scene_ids
    assert [names[i] for i in info["scene_id"]] == ids
    np.testing.assert_array_equal(envs.unwrapped.states, [1, 2, 3])
    _, info = envs.reset(options={"scene": ids[1], "state": 9})
    assert [names[i] for i in info["scene_id"]] == [ids[1]] * 3
    assert info["state"].tolist() == [9] * 3
    states = torch.tensor([4, 5, 6])
    for own, wanted in ((states, [4, 5, 6]), (states[0], [4] * 3)):
        envs.reset(options={"state": own})
        np.testing.assert_array_equal(envs.unwrapped.states, wanted)


@pytest.mark.parametrize("mode", [mode.name for mode in AutoresetMode])
def test_a_masked_reset_shows_the_others_as_they_were(mode: str) -> None:
    """Also where the caller has written to the arrays meanwhile."""
    envs = make_envs(autoreset_mode=mode)
    shown = [envs.reset(seed=0)[0]]
    for mask in ([True, False, False], [False, True, False]):
        shown.append(envs.step(np.array([1, 2, 3]))[0])
        wanted = {name: values.copy() for name, values in shown[-1].items()}
        for observation in shown:
            for values in observation.values():
                values[...] = 0
        shown.append(envs.reset(options={"reset_mask": np.array(mask)})[0])
        for name, values in wanted.items():
            others = ~np.array(mask)
            np.testing.assert_array_equal(shown[-1][name][others], values[others])


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_workers_that_are_forked_from_a_process_with_environments(tmp_path, monkeypatch) -> None:
    """Gymnasium's default: torch's threads do not survive the fork, a worker must not need them.

    Not even to draw the scenes, as nothing is cached yet.
    """
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path))
    given = {"scenes": "bundled:snow", "split": "test", "resolution": 36}
    torch.set_num_threads(2)
    torch.ones(2**20).exp()  # they run
    make_env(**given).reset(seed=0)
    _LOADED.clear()

    def give_up(*_: object) -> None:
        raise TimeoutError("a worker hangs")

    signal.signal(signal.SIGALRM, give_up)
    signal.alarm(300)
    try:
        envs = make_envs(2, vectorization_mode="async", **given)
        envs.reset(seed=0)
        assert envs.step(np.array([3, 40]))[1].shape == (2,)
        envs.close()
    finally:
        signal.alarm(0)
