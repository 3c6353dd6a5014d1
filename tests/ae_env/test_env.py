"""The environment contract, its arguments and pictures, registration, presets, users' files."""

import gc
import inspect
import math
import os
import pickle
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path
from unittest.mock import Mock

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from matplotlib import colormaps
from PIL import Image
from stable_baselines3.common.env_checker import check_env as check_sb3

import ae_env
from ae_env import AutoExposureEnv, AutoExposureVectorEnv, contact_sheet
from ae_env.first_frame import compile_beside
from ae_env.grid import ExposureGrid
from ae_env.observation import decode_observation
from ae_env.options import EnvOptions
from ae_env.rendering import _Sheet
from ae_env.scenes.load import BUNDLED, BUNDLED_PARTS
from ae_env.scorers import make_scorer
from ae_env.scorers.score_table import ScoreTables
from ae_env.utils.user_files import find_config, load_from_file
from simulator import develop
from tests.ae_env.environments import SMALL, assert_equal, make_env, make_envs, rollout
from tests.ae_env.scorer_images import CAMERA, Own, make_scene

#: Pages of memory of this process.
STATM = Path("/proc/self/statm")
INFO_KEYS = {
    *("scene_id", "state", "iso", "exposure_time", "f_number", "ev100"),
    *("clipped_high", "clipped_low", "excess_noise", "predicted_error", "modules"),
    "illuminance_spread",
}


@pytest.mark.parametrize("task", [name for name in gym.registry if name.startswith("ae_env/")])
@pytest.mark.parametrize("kind", ["uint8", "statistics", "linear", "dn"])
def test_both_checkers_have_nothing_to_say(task: str, kind: str) -> None:
    env = make_env(task, render_mode="rgb_array", observation=kind).unwrapped
    check_env(env)  # warnings are errors
    if kind == "uint8":
        check_sb3(env)


@pytest.mark.skipif(not STATM.is_file(), reason="the memory of a process is Linux's to tell")
def test_a_long_run_takes_no_more_memory() -> None:
    env, rng, pages = make_env(max_episode_steps=None), np.random.default_rng(0), list[int]()
    for episode in range(30):
        env.reset(seed=episode)
        for _ in range(30):
            env.step(rng.integers(64))
        if episode in (10, 29):
            gc.collect()
            pages.append(int(STATM.read_text().split()[1]))
    assert (pages[1] - pages[0]) * os.sysconf("SC_PAGE_SIZE") < 8 * 2**20


def test_spaces_and_infos_are_as_documented() -> None:
    env = make_env(resolution=40)
    box, space = gym.spaces.Box, env.observation_space
    assert space["raw"] == box(0, 255, (4, 40, 40), np.uint8)
    assert (space["sensors"], space["settings"]) == (box(-1, 1, (2,)), box(-1, 1, (3,)))
    linear, dn = (make_env(observation=kind).observation_space["raw"] for kind in ("linear", "dn"))
    assert (linear.dtype, dn.dtype) == (np.float32, np.uint16)
    assert dn.high.max() == env.unwrapped.camera.white_level
    assert env.action_space == gym.spaces.Discrete(64)
    assert env.get_wrapper_attr("action_masks")().tolist() == [True] * 64
    env = make_env(with_oracle=True)
    _, first = env.reset(seed=0)
    _, reward, terminated, truncated, second = env.step(5)
    names = ("brightness", "highlights", "shadows", "noise", "sharpness", "score")
    parts = {f"rewards.{name}" for name in names}
    for info in (first, second):
        assert set(info) == INFO_KEYS | {"oracle_state", "regret"} | parts
        assert all(isinstance(v, int | float | str) for v in info.values())
    assert (type(reward), type(terminated), type(truncated)) == (float, bool, bool)
    assert (second["state"], second["iso"], second["f_number"]) == (5, 100.0, 5.6)
    assert second["ev100"] == pytest.approx(np.log2(5.6**2 / second["exposure_time"]))
    assert second["modules"].startswith("exposure")


def test_reset_options_choose_scene_state_and_frame() -> None:
    env = make_env(lighting={"kind": "step", "stops": -3, "at": 5})
    scene = env.unwrapped.scenes[3].scene_id
    for chosen in (scene, 3):
        info = env.reset(seed=0, options={"scene": chosen, "state": 17})[1]
        assert (info["scene_id"], info["state"]) == (scene, 17)
    shown, episodes = [], []
    for frame in (0, 5):
        options = {"scene": 3, "state": 17, "frame": frame}
        shown.append(env.reset(seed=1, options=options)[0]["raw"].mean())
        episodes.append(env.unwrapped.episode())
    assert shown[1] < shown[0]
    # The draws do not depend on the options: the episode is the same otherwise.
    assert len({(e.speed, e.defocus, e.noise_seed) for e in episodes}) == 1


def test_returned_arrays_are_never_reused() -> None:
    env = make_env(with_oracle=True)
    frames = [env.reset(seed=0)]
    frames += [env.step(9)[::4] for _ in range(5)]
    arrays = [array for observation, _ in frames for array in observation.values()]
    copies = [array.copy() for array in arrays]
    env.step(60)
    env.reset()
    for i, (array, copy) in enumerate(zip(arrays, copies, strict=True)):
        np.testing.assert_array_equal(array, copy)
        assert not any(np.shares_memory(array, other) for other in arrays[i + 1 :])
    assert len({id(info) for _, info in frames}) == len(frames)


def test_costs_are_subtracted_and_shown() -> None:
    costs = {"flicker": 0.5, "switch": 0.25}
    env, free = make_env(costs=costs), make_env()
    _, info = env.reset(seed=0, options={"state": 0})
    free.reset(seed=0, options={"state": 0})
    assert (info["rewards.flicker"], info["rewards.switch"]) == (0.0, 0.0)
    before = env.reset(seed=0, options={"state": 0})[0]["raw"].mean() / 255.0
    for state, changed in ((0, 0.0), (1, 1 / 3), (63, 1.0)):  # state 1 to 63: all but none alike
        observation, reward, _, _, info = env.step(state)
        score = free.step(state)[1]
        mean = observation["raw"].mean() / 255.0
        assert info["rewards.switch"] == pytest.approx(changed)
        assert info["rewards.flicker"] == pytest.approx(abs(mean - before), abs=1e-6)
        expected = score - 0.5 * abs(mean - before) - 0.25 * changed
        assert reward == pytest.approx(expected, abs=1e-6)
        assert info["rewards.score"] == pytest.approx(score)
        before = mean


def test_motion_and_depth_can_be_switched_off() -> None:
    env = make_env(motion="none", depth="far", noise=False)
    for seed in range(4):
        observation, info = env.reset(seed=seed)
        assert info["modules"] == "exposure"
        assert observation["sensors"][0] == -1.0
        assert info["rewards.sharpness"] == 1.0
    moving = make_env(motion=0.5, depth=2.0)
    longest = max(moving.unwrapped.grid.states, key=lambda s: s.exposure_time / s.f_number)
    state = moving.unwrapped.grid.states.index(longest)
    info = moving.reset(seed=0, options={"state": state})[1]
    assert info["modules"] == "exposure+defocus+motion_blur+noise"


def test_a_third_of_the_episodes_stands_still_and_defocus_stays_in_range() -> None:
    core = make_envs(400).unwrapped.core
    core.begin(np.arange(400), [np.random.default_rng(seed) for seed in range(400)])
    episodes = core.episodes
    shakes, subject_moves = episodes.speed > 0.0, episodes.subject_speed > 0.0
    assert np.mean(~shakes & ~subject_moves) == pytest.approx(1 / 3, abs=0.08)  # 3.4 sigma
    assert np.mean(subject_moves) == pytest.approx(1 / 3, abs=0.08)
    assert np.mean(subject_moves & ~shakes) == pytest.approx(0.1, abs=0.05)
    assert 0.1 <= episodes.defocus.min() < episodes.defocus.max() <= 8.0
    assert np.median(episodes.defocus) == pytest.approx(1.0, rel=0.25)


def test_cached_light_changes_nothing_and_random_states_are_left_alone(monkeypatch) -> None:
    cached = rollout(5, depth=3.0, motion=0.5)
    monkeypatch.setattr("simulator.capture.blurred_frames.BlurredFrames.is_full", True)
    assert_equal(rollout(5, depth=3.0, motion=0.5), cached)
    unseen = make_env(sensors=False, depth=3.0, motion=0.5)
    assert set(unseen.observation_space) == {"raw", "settings"}
    np.testing.assert_array_equal(unseen.reset(seed=5)[0]["raw"], cached[0][0]["raw"])
    drawn = []
    for work in (lambda: None, lambda: rollout(1)):
        torch.manual_seed(0)
        np.random.seed(0)  # noqa: NPY002
        work()
        drawn.append((float(torch.rand(1)), np.random.rand()))  # noqa: NPY002
    assert drawn[0] == drawn[1]


FEW = ExposureGrid((100, 1600), (1 / 500, 1 / 30), (4, 8))


def _env(**arguments):
    return make_env(**{"resolution": 64, "render_mode": "rgb_array", **arguments})


def _scene():
    return make_scene(np.random.default_rng(0).random((4, 64, 64)), 2560.0)


@pytest.mark.parametrize("kind", ["uint8", "linear", "dn"])
def test_frame_is_the_developed_capture_enlarged(kind: str) -> None:
    env = _env(observation=kind)
    raw = env.reset(seed=1, options={"state": 21})[0]["raw"]
    picture, scene = env.render(), env.unwrapped.scene()
    assert (picture.dtype, picture.shape) == (np.uint8, (256, 256, 3))
    if kind == "uint8":
        raw = decode_observation(raw)
    elif kind == "dn":
        black = np.array(CAMERA.black_level)[:, None, None]
        raw = (raw - black) / (CAMERA.white_level - black)
    signal = torch.from_numpy(raw.astype(np.float32))[None]
    expected = develop(signal, scene.white_balance, CAMERA.colour_matrix)[0]
    expected = (expected.permute(1, 2, 0).numpy() * 255).round()
    above_the_caption = slice(2, 200, 4)
    difference = picture[above_the_caption, 2::4].astype(int) - expected[: 200 // 4]
    assert np.abs(difference).max() <= 1


def test_paths_are_drawn_in_their_own_colours_and_hide_no_picture() -> None:
    captures = []
    for paths in ({}, {"first": [0, 7], "second": [3, 3, 4]}):
        sheet = np.asarray(contact_sheet(_scene(), grid=FEW, path=paths)) @ [2**16, 2**8, 1]
        assert np.isin([0x0072B2, 0xD55E00], sheet).tolist() == [bool(paths)] * 2
        layout = _Sheet(FEW, None, [Image.new("RGB", (64, 64))], paths)  # private, as below
        corners = map(layout.corner, range(8))
        captures.append(np.stack([sheet[y : y + 104, x : x + 104] for x, y in corners]))
    np.testing.assert_array_equal(*captures)
    for path in ([0, 64], [], {"mine": [1.5]}):
        with pytest.raises(ValueError, match=r"path|mine|states"):
            contact_sheet(_scene(), path=path)
    with pytest.raises(ValueError, match="at most 256"):
        contact_sheet(_scene(), grid=ExposureGrid.third_stop())
    for name, value in (("speed", -1), ("speed", 1e9), ("defocus", math.nan), ("movement", 5)):
        with pytest.raises(ValueError, match=f"`{name}`"):
            contact_sheet(_scene(), **{name: value})


def test_caption_and_size_of_a_frame(caplog: pytest.LogCaptureFixture) -> None:
    env = _env(resolution=40)
    env.reset(seed=1, options={"state": 0})
    first = env.render()
    assert first.shape == (280, 280, 3)  # seven times 40
    env.reset(seed=1, options={"state": 3})
    band = slice(-20, None)
    assert (first[band] != env.render()[band]).any()
    assert first[band].max() > 200  # the ink
    first[:] = 0  # the caller may write to it
    assert env.render().max() > 0
    without = make_env().unwrapped
    without.reset(seed=0)
    assert without.render() is None
    assert "render_mode='rgb_array'" in caplog.text


def test_border_shows_the_score_and_the_oracle_is_framed() -> None:
    scene = _scene()
    sheet = np.asarray(contact_sheet(scene, grid=FEW, seed=3))
    table = ScoreTables(FEW, CAMERA, make_scorer("balanced")).table(scene)
    # Private: where each state's picture is.
    layout = _Sheet(FEW, table, [Image.new("RGB", (64, 64))] * 8, {})
    corners = np.array([layout.corner(state) for state in range(8)])
    apart = np.abs(corners[:, None] - corners[None]).max(-1) >= min(layout.thumb)
    assert (apart | np.eye(8, dtype=bool)).all()  # no picture covers another
    for state, (x, y) in enumerate(corners):
        assert (sheet[y - 1, x + 40].min() > 200) == (state == table.oracle)
        if state != table.oracle:
            expected = colormaps["viridis"](table.mean[state] / table.mean.max(), bytes=True)[:3]
            assert sheet[y + 2, x + 40].tolist() == [int(v) for v in expected]


NAN, INF, HUGE, ARRAY = math.nan, math.inf, 10**30, np.array([1, 2])
ODD = [None, True, "x", 1.5, -1, NAN, INF, [], {}, object(), HUGE, b"x", ["x"], [0.5], ARRAY]
#: Values of `ODD` that an argument takes.
TAKES = {
    **{key: [] for key in ("split", "scorer", "observation", "resolution", "crop")},
    **{key: [] for key in ("lighting", "delay", "camera", "reward", "source")},
    **{key: [True] for key in ("sensors", "noise", "with_oracle", "with_subject")},
    **{key: [1.5] for key in ("motion", "depth")},
    **{key: [None] for key in ("grid", "simulator", "render_mode", "device", "lens")},
    "blur_memory": [1.5],
    "costs": [None, {}],
    "tolerance": [1.5, HUGE],
}
TAKES_VECTOR = {"num_envs": [], "max_episode_steps": [None, HUGE], "autoreset_mode": []}


class Work(Exception):
    """Scenes were loaded."""


@pytest.fixture
def idle(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(self: EnvOptions) -> None:
        raise Work

    monkeypatch.setattr(EnvOptions, "scenes_on_demand", load)


@pytest.mark.usefixtures("idle")
@pytest.mark.parametrize(("name", "takes"), [*TAKES.items(), *TAKES_VECTOR.items()])
def test_odd_values_are_refused_but_those_that_an_argument_takes(name, takes):
    assert {"scenes", *TAKES} == {*EnvOptions.__dataclass_fields__, "render_mode"}
    for value in ODD:
        taken = any(type(known) is type(value) and known == value for known in takes)
        with pytest.raises(Work if taken else ValueError, match=None if taken else f"`{name}"):
            AutoExposureVectorEnv(**{**SMALL, name: value})


GRID = {"isos": [100, 200], "exposure_times": [0.01, 0.1], "f_numbers": [4, 8]}
BAD_AXES = [None, "100", [], [100, "x"], [True, 200], [NAN, 1], [2, 1], [1, 1], 100, [100, INF]]


@pytest.mark.usefixtures("idle")
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        *(
            ({"costs": {"flicker": value}}, r"`costs\['flicker'\]`")
            for value in (None, True, "x", -1, NAN, INF, [], [1.0])
        ),
        *(({"costs": {"FLICKER": 1}}, "did you mean 'flicker'"), ({"costs": {3: 1.0}}, "`costs`")),
        *(({"grid": {**GRID, "isos": value}}, "`grid.*iso") for value in BAD_AXES),
        ({"grid": {**GRID, "isos": range(100, 50_000)}}, "at most 65536 states"),
        *(({"grid": {"iso": [100]}}, "did you mean 'isos'"), ({"grid": {"isos": [100]}}, "`grid`")),
        *(({"scorer": {"noise": v}}, "`scorer`") for v in (None, True, "x", 0, -1, NAN, INF, [1])),
        ({"scorer": {"noise": 1.0, "mine:noise": 1.0}}, "differ behind the colon"),
        ({"depth": 300.0, "resolution": 128}, "`depth`.*256"),
        *(({"delay": {"iso": value}}, r"`delay\['iso'\]`") for value in (17, True)),
        *(({"resolution": 35}, "`resolution`"), ({"motion": 1e3 + 1}, "`motion`")),
        *(({"num_envs": 2**16 + 1}, "`num_envs`"), ({"noise": ["bank"]}, "`noise`")),
        *(({"max_episode_steps": 0}, "`max_ep"), ({"split": "val"}, "did you mean 'validation'")),
    ],
)
def test_what_else_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        AutoExposureVectorEnv(**{**SMALL, **arguments})


BAD_SEEDS = [True, "x", 1.5, -1, NAN, {}, object(), b"x", np.array(3.0)]
BAD_OPTIONS = [True, "x", 1.5, [], object(), ["state"], {"stat": 1}, {1: 1}]
BAD_CHOICES = [True, 1.5, -1, NAN, {}, object(), HUGE, "x", b"x"]


def _refused_resets(for_many):
    lists = [[0, 1], [0, 1, True], [0, 1, "x"], ARRAY, np.zeros(3)] if for_many else [[], [1, 2]]
    refused = [({"seed": seed}, "`seed") for seed in [*BAD_SEEDS, *lists]]
    refused += [({"options": options}, "`options`") for options in BAD_OPTIONS]
    for name in ("scene", "state", "frame"):
        match = rf"`options\['{name}'\]`"
        refused += [({"options": {name: v}}, match) for v in [*BAD_CHOICES, *lists]]
    masks = (True, [True] * 3, np.ones(2, bool), np.zeros(3, bool), np.ones(3)) if for_many else ()
    refused += [({"options": {"reset_mask": mask}}, "reset_mask") for mask in masks]
    return refused


BAD_ACTIONS = [None, True, "x", 1.5, 2.0, -1, 64, NAN, [], {}, object(), HUGE, 2**63, [[1], [2, 3]]]


@pytest.mark.parametrize("for_many", [False, True])
def test_refused_resets_and_steps_change_nothing(for_many: bool) -> None:
    """The twin is asked nothing odd; the episode and the one after it must be the same."""
    make, many = AutoExposureEnv, {}
    bad = [*BAD_ACTIONS, [1], np.zeros(1, int), np.True_]
    if for_many:
        make, many = AutoExposureVectorEnv, {"num_envs": 3}
        rows = [[0, 1, action] for action in BAD_ACTIONS if action is not True]  # numpy makes it 1
        bad = [*BAD_ACTIONS, *rows, [0, 1], [[0, 1, 2]], np.ones(3, bool)]
    env, twin = (make(**SMALL, **many) for _ in range(2))
    for one in (env, twin):
        one.reset(seed=7)
    for arguments, match in _refused_resets(for_many):
        with pytest.raises(ValueError, match=match):
            env.reset(**arguments)
    for action in bad:
        with pytest.raises(ValueError, match=r"`actions?`"):
            env.step(action)
    good = [5] * 3 if for_many else 5
    assert_equal(env.step(good), twin.step(good))
    assert_equal(env.reset(), twin.reset())
    for seed in (np.int64(11), 2**64, 2**100):
        first, second = ([0, s, 5] if for_many else s for s in (seed, int(seed)))
        assert_equal(env.reset(seed=first), twin.reset(seed=second))


def test_scenes_are_loaded_once_for_each_camera_and_splits_are_disjoint() -> None:
    train = EnvOptions(**SMALL).load_scenes()
    EnvOptions(**SMALL).load_scenes().clear()  # a list of one's own
    again = EnvOptions(**SMALL).load_scenes()
    assert all(a is b for a, b in zip(again, train, strict=True))
    test, both = (EnvOptions(split=split, **SMALL).load_scenes() for split in ("test", "all"))
    assert {s.group for s in train}.isdisjoint({s.group for s in test})
    assert [s.scene_id for s in both] == [s.scene_id for s in train + test]
    other = replace(CAMERA, colour_matrix=CAMERA.colour_matrix[::-1])
    for one in (CAMERA, other):
        assert EnvOptions(camera=one, **SMALL).load_scenes()[0].camera == one
    with pytest.raises(ValueError, match=r"unknown argument `scorrer`.*did you mean `scorer`"):
        EnvOptions.from_kwargs({"scorrer": "noise"})


def test_a_black_scene_in_unknown_light_is_refused_by_name() -> None:
    black = make_scene(np.zeros((4, 40, 40)), None, scene_id="cap")
    with pytest.raises(ValueError, match=r"scene 'cap': `light` is 0 .* give `illuminance`"):
        EnvOptions(scenes=[black], resolution=36).load_scenes()
    lit = replace(black, illuminance=10.0)
    assert EnvOptions(scenes=[lit], resolution=36).load_scenes()[0].ev100 == 2.0
    for value in ODD:
        with pytest.raises(ValueError, match="scenes"):
            AutoExposureEnv(scenes=value)


# -- registration, presets of ``configs/env``, and classes from users' files -----------------------


def test_spec_round_trips_and_in_process_arguments_say_so() -> None:
    given = {"observation": "linear", "costs": {"switch": 0.1}, "lighting": {"kind": "ramp"}}
    env = make_env(scorer="ae_env.scorers.terms:Noise", **given)
    env.reset(seed=3)
    expected = env.step(11)
    for spec in (EnvSpec.from_json(env.spec.to_json()), pickle.loads(pickle.dumps(env.spec))):
        assert spec == env.spec
        again = gym.make(spec)
        again.reset(seed=3)
        assert_equal(again.step(11), expected)
    env = make_env(scorer=Own())
    env.reset(seed=0)
    assert 0.0 <= env.step(0)[1] <= 1.0
    with pytest.raises(ValueError, match=r"`scorer`.*this process only.*package\.module"):
        env.spec.to_json()


def test_public_names_resolve_and_import_is_light() -> None:
    assert dir(ae_env) == sorted(ae_env.__all__)
    assert all(getattr(ae_env, name).__doc__ for name in ae_env.__all__)
    assert {kind.__name__ for kind in ae_env.lighting.KINDS.values()} <= {*ae_env.__all__}
    with pytest.raises(AttributeError, match="nonsense"):
        _ = ae_env.nonsense
    code = (
        "import sys, simulator; assert not {'torch', 'numpy'} & set(sys.modules);"
        "import gymnasium, ae_env, ae_env.registration as r; r.register_envs(); dir(ae_env);"
        "assert 'ae_env/AutoExposure-v0' in gymnasium.registry; "
        "sys.exit(bool({'torch', 'numba', 'yaml', 'matplotlib'} & set(sys.modules)))"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True)


@pytest.mark.parametrize("kind", [ae_env.AutoExposureEnv, ae_env.AutoExposureVectorEnv])
def test_constructors_list_their_arguments(kind):
    """With the defaults of `EnvOptions`; an unknown one raises Python's own error."""
    parameters = inspect.signature(kind).parameters
    assert all(p.kind is not p.VAR_KEYWORD and p.annotation for p in parameters.values())
    options = EnvOptions()
    for field in fields(EnvOptions):
        default = parameters[field.name].default
        assert (default or {} if field.name == "costs" else default) == getattr(options, field.name)
    message = r"got an unexpected keyword argument 'scorrer'; did you mean 'scorer'\?"
    with pytest.raises(TypeError, match=message):
        kind(scorrer="noise")
    with pytest.raises(TypeError, match="got an unexpected keyword argument 'frameskip'"):
        make_env(frameskip=4)  # the wording that TorchRL looks for


PRESETS = ae_env.list_presets()
ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("name", PRESETS)
def test_presets_run_on_small_scenes(name: str) -> None:
    arguments = ae_env.load_preset(name)
    assert arguments["scenes"] in {*BUNDLED, *BUNDLED_PARTS}
    steps = arguments["max_episode_steps"]
    env = make_env(**arguments | SMALL)
    check_env(env.unwrapped, skip_render_check=True)
    env.reset(seed=0)
    ended = [env.step(env.action_space.sample())[3] for _ in range(steps)]
    assert ended == [False] * (steps - 1) + [True]


def test_errors_and_files_of_ones_own(tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    for name in ("tunel", None, ["snow"], "", own):
        with pytest.raises(ValueError, match=r"`env` \(=.*(snow|did you mean|no such file)"):
            ae_env.load_preset(name)
    own.write_text("lighting: sine\nmax_episode_steps: 4\n")
    expected = {"lighting": "sine", "max_episode_steps": 4}
    assert ae_env.load_preset(own) == ae_env.load_preset(str(own)) == expected
    for text in ("- 1\n", "a: ["):
        own.write_text(text)
        with pytest.raises(ValueError, match=r"`env` \(='.*own\.yaml'\)"):
            ae_env.load_preset(str(own))


def test_configs_are_found_from_anywhere(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    shipped = find_config(Path("configs/simulator/nano.yaml"))
    assert shipped.is_file()
    for own in ("configs/none.yaml", "configs/../configs/ppo.yaml", "ppo.yaml"):
        assert find_config(Path(own)) == Path(own)
    mine = Path("configs/ppo.yaml")
    mine.parent.mkdir()
    mine.touch()
    assert find_config(mine) == mine


def test_a_foreign_package_of_a_common_name_is_named(tmp_path: Path) -> None:
    (tmp_path / "simulator").mkdir()
    (tmp_path / "simulator" / "__init__.py").touch()
    code = f"import sys; sys.path[:0] = [{str(tmp_path)!r}, {str(ROOT)!r}]; import ae_env"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert found.returncode == 1
    message = found.stderr.strip().splitlines()[-1]
    assert message.startswith("ImportError: ae-env needs its own package 'simulator'")
    assert str(tmp_path / "simulator") in message
    assert str(ROOT / "simulator") in message


ARGUMENT = "`thing` (='mine.py:Mine')"


def test_files_are_run_once_until_they_change_and_imports_once(tmp_path, monkeypatch):
    file = tmp_path / "my file-1.py"
    file.write_text("class Mine:\n    number = 1\n")
    first = load_from_file(str(file), "Mine", ARGUMENT)
    monkeypatch.chdir(tmp_path)
    assert load_from_file("my file-1.py", "Mine", ARGUMENT) is first
    monkeypatch.setenv("HOME", str(tmp_path))
    assert load_from_file("~/my file-1.py", "Mine", ARGUMENT) is first
    file.write_text("class Mine:\n    number = 2\n")  # in the same second, of the same length
    assert load_from_file(str(file), "Mine", ARGUMENT).number == 2
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "on_the_path.py").write_text("class Base: ...")
    for name in ("one", "two"):
        (tmp_path / f"{name}.py").write_text("from on_the_path import Base as Mine")
    one, two = (load_from_file(str(tmp_path / f"{n}.py"), "Mine", ARGUMENT) for n in ("one", "two"))
    assert one is two
    monkeypatch.delitem(sys.modules, "on_the_path")


def test_helpers_beside_a_file_are_found_and_not_mixed_up(tmp_path: Path) -> None:
    before, path = set(sys.modules), list(sys.path)
    for number in (1, 2):
        folder = tmp_path / str(number)
        (folder / "own_package").mkdir(parents=True)
        (folder / "own_helper.py").write_text(f"number = {number}")
        (folder / "own_package" / "__init__.py").write_text("")
        part = folder / "own_package" / "part.py"
        part.write_text(f"from own_helper import number as n{number}")
        text = f"from own_package.part import n{number} as n\nclass Mine:\n    number = n\n"
        (folder / "mine.py").write_text(text)
    files = [str(tmp_path / str(number) / "mine.py") for number in (1, 2)]
    assert [load_from_file(f, "Mine", ARGUMENT).number for f in (*files, files[0])] == [1, 2, 1]
    (tmp_path / "1" / "own_helper.py").write_text("number = 333")
    with open(files[0], "a") as file:
        file.write("# changed")
    assert load_from_file(files[0], "Mine", ARGUMENT).number == 333
    assert sys.path == path
    for name in set(sys.modules) - before:
        del sys.modules[name]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("import a_module_that_is_not_there", "ModuleNotFoundError: No module named 'a_module"),
        ("def (:", "SyntaxError"),
        *(("raise SystemExit(3)", "SystemExit: 3"), ("raise SystemExit(0)", "SystemExit: 0")),
        ("x = 1\n1 / 0", r"mine\.py cannot be loaded: ZeroDivisionError: .* \(line 2\)"),
        ("class Mime: ...", "no class 'Mine' there; found Mime; did you mean 'Mime'"),
        ("x = 3", "no class 'Mine' there; found no class at all"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "mine.py"
    file.write_text(text)
    before = set(sys.modules)
    with pytest.raises(ValueError, match=message) as caught:
        load_from_file(str(file), "Mine", ARGUMENT)
    assert str(caught.value).startswith(ARGUMENT)
    left = [name for name in set(sys.modules) - before if name.startswith("ae_env_user_")]
    assert len(left) == ("class" in message)  # what failed to load is not kept
    for path, name in ((tmp_path / "none.py", "Mine"), (file, "")):
        with pytest.raises(ValueError, match=r"`thing` \(='mine.py:Mine'\)"):
            load_from_file(str(path), name, ARGUMENT)


def test_a_second_process_compiles_where_nothing_was_compiled(monkeypatch) -> None:
    started = Mock()
    monkeypatch.setattr("ae_env.first_frame.subprocess.Popen", started)
    monkeypatch.setattr("torch.get_num_threads", lambda: 2)
    monkeypatch.setattr("ae_env.first_frame._started", False)
    for compiled, children in ((True, 0), (False, 1), (False, 1)):  # once
        monkeypatch.setattr("ae_env.first_frame.is_compiled", lambda known=compiled: known)
        compile_beside()
        assert started.call_count == children


def test_the_subjects_pixels_are_told_where_asked():
    env, envs = make_env(with_subject=True), make_envs(2, with_subject=True)
    together = envs.reset(seed=0)[1]["subject"]
    for seed in range(2):
        info = env.reset(seed=seed)[1]
        scene = env.unwrapped.scenes[env.unwrapped.scene_ids.index(info["scene_id"])]
        np.testing.assert_array_equal(info["subject"], scene.layout.subject.numpy())
        np.testing.assert_array_equal(together[seed], info["subject"])
