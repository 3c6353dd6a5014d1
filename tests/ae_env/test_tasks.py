"""The tasks: their rules, one and many of them; light that changes by a rule, list or file."""

import inspect
import json
import math
from dataclasses import fields

import gymnasium as gym
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import ae_env
from ae_env import ExposureGrid
from ae_env.lighting import KINDS, MAX_STOPS, Lighting, RollingShutter, make_lighting
from ae_env.lighting.moving import KIND_SETS, MOVES
from ae_env.merging import log_error, merge
from ae_env.tasks import move_subject
from simulator import CameraSettings
from simulator.camera import get_camera
from simulator.capture.blurred_frames import Layout
from simulator.optics.flicker_integral import MainsLamp, PulsedLamp
from simulator.radiance.light import WHITE_SIGNAL
from tests.ae_env.environments import SMALL, assert_equal, check_parity, make_env, make_envs
from tests.ae_env.scorer_images import make_scene
from tests.strategies import log_uniform

ID = "ae_env/ExposureBracket-v0"
GRID = ExposureGrid.bracket()
STOP = len(GRID)


def bracket(**arguments):
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


def two_lights(low, high):
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
    for action in (STOP, long):
        with pytest.raises(gym.error.ResetNeeded):
            env.step(action)
    env.reset(seed=0)
    env.step(long)


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
VIDEO = {
    "grid": "video",
    "lighting": "moving",
    "delay": {"iso": 1, "exposure_time": 2, "f_number": 2},
    "costs": {"flicker": 1.0},
}


def test_it_is_the_other_environment_with_its_defaults():
    """The same frames as `AutoExposure-v0` with these arguments; 96 steps; defaults may change."""
    video = gym.make_vec(VIDEO_ID, num_envs=3, **SMALL)
    plain = make_envs(3, max_episode_steps=96, **VIDEO)
    assert_equal(video.reset(seed=5), plain.reset(seed=5))
    for action in (7, 40, 63):
        assert_equal(video.step(np.full(3, action)), plain.step(np.full(3, action)))
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
        for own, wanted in (({}, kinds), ({"lighting": pans}, ("pans",))):
            core = gym.make(VIDEO_ID, split=split, **own, **SMALL).unwrapped.core
            assert core.episodes.lighting.drawn_from == wanted


# -- light that changes ----------------------------------------------------------------------------


def _gains(spec: object, frames: int, phase: float = 0.0) -> list[float]:
    lighting = make_lighting(spec)
    return [lighting.gain(frame, 0.01, phase) for frame in range(frames)]


@pytest.mark.parametrize(
    ("spec", "stops"),
    [
        *(({"kind": "step", "stops": 3, "at": at}, [0, 0, 3, 3]) for at in (2, 2.0, np.int64(2))),
        ({"kind": "ramp", "stops": -2, "stops_per_frame": 0.5}, [0, -0.5, -1, -1.5, -2, -2, -2]),
        (
            {"kind": "tunnel", "stops": -6, "enter": 2, "leave": 6, "edge": 2},
            [0, 0, 0, -3, -6, -6, -6, -3, 0, 0],
        ),
        # It begins after the named frame, or without an edge at it.
        ({"kind": "tunnel", "enter": 2, "leave": 5, "edge": 0}, [0, 0, -6, -6, -6, 0, 0, 0]),
        ({"kind": "tunnel", "enter": 2, "leave": 5, "edge": 1}, [0, 0, 0, -6, -6, -6, 0, 0]),
        ({"kind": "lens_cap", "on": 1, "off": 3}, [0, -20, -20, 0]),
        ({"kind": "sine", "stops": 2, "period": 4}, [0, 2, 0, -2, 0]),
    ],
)
def test_light_follows_its_rule(spec, stops):
    assert _gains(spec, len(stops)) == pytest.approx([2.0**s for s in stops], rel=1e-12)
    sine = {"kind": "sine", "stops": 2, "period": 8}
    assert _gains(sine, 5, phase=0.25) == pytest.approx(_gains(sine, 7)[2:])


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        *(("stepp", "did you mean 'step'"), (None, "`lighting`"), ({"stops": 3}, "'kind'")),
        *(({"kind": "step", "stops": v}, r"`lighting\['stops'\]`") for v in (math.nan, -2000)),
        *(({"kind": "step", "at": v}, r"`lighting\['at'\]`") for v in (True, 1.5, 2.0**32)),
        *(({"kind": "sine", "period": 0}, "'period'"), ({"kind": "tunnel", "edge": -1}, "'edge'")),
        ({"kind": "tunnel", "enter": 5, "leave": 4}, "'leave'.*'enter'"),
        *(({"kind": "flicker", "frequency": value}, "'frequency'") for value in (0, None)),
        *(({"kind": kind, "frame_rate": 0.0}, "frame_rate") for kind in ("flicker", "moving")),
        *(({"kind": "schedule", "ev": ev}, "'ev'") for ev in (None, [], "0 1", np.zeros((2, 2)))),
        *(({"kind": "schedule", "ev": [0, v]}, r"'ev'\]\[1\]") for v in (65, math.nan)),
        ({"kind": "schedule", "ev": [0], "file": "light.csv"}, "only one of them"),
        ({"kind": "schedule", "file": "/dev/zero"}, "cannot be read: .* no ordinary file"),
        ({"kind": "static", "foo": 1}, "'foo': it has none"),
        # The text of a file of a schedule.
        *(("ev\n", "length 0"), ("0\none\n", "row 2"), ("0\ninf\n", "row 2")),
        *(("a,b\n1,2\n", "columns"), ("frame,ev\n0,1\n1\n", "row 3")),
    ],
)
def test_bad_lightings_are_refused(tmp_path, spec, message):
    if isinstance(spec, str) and "\n" in spec:
        (tmp_path / "light.csv").write_text(spec)
        spec = {"kind": "schedule", "file": tmp_path / "light.csv"}
    with pytest.raises(ValueError, match=message):
        make_lighting(spec)


def test_a_subclass_is_known_by_its_name() -> None:
    class Dimmed(Lighting):
        name = "test_dimmed"

        def gain(self, frame: int, exposure_time: float, phase: float) -> float:
            return 0.5

    found = _gains("test_dimmed", 2), _gains("static", 2)
    del KINDS["test_dimmed"]
    assert found == ([0.5, 0.5], [1.0, 1.0])


@st.composite
def lightings(draw):
    stops, frames = st.floats(-MAX_STOPS, MAX_STOPS), st.integers(-(2**31), 2**31)
    values = {"period": log_uniform(1e-3, 2**31), "stops": stops}
    values |= {"stops_per_frame": st.floats(0, MAX_STOPS), "edge": st.integers(0, 2**31)}
    values |= {"frequency": log_uniform(1e-3, 1e6), "frame_rate": log_uniform(1e-3, 1e6)}
    values |= {"depth": st.floats(0, 1), "duty": st.none() | st.floats(1e-6, 1)}
    values |= {"ev": st.lists(stops, min_size=1, max_size=3), "file": st.none()}
    values |= {"kinds": st.sampled_from([*KIND_SETS, "all"])}
    kind = draw(st.sampled_from(sorted(KINDS)))
    drawn = {f.name: draw(values.get(f.name, frames)) for f in fields(KINDS[kind])}
    for first, last in (("enter", "leave"), ("on", "off")):
        if first in drawn:
            drawn[first], drawn[last] = sorted((drawn[first], drawn[last]))
    return {"kind": kind, **drawn}


@given(lightings(), st.integers(0, 2**31 - 1), log_uniform(1e-5, 100), st.floats(0, 1 - 2**-53))
def test_light_is_positive_and_finite_in_every_frame(spec, frame, exposure_time, phase):
    lighting = make_lighting(spec)
    gain = lighting.gain(frame, exposure_time, phase)
    assert 0.0 < gain < math.inf
    known = {"flicker": MAX_STOPS, "schedule": max(map(abs, spec.get("ev", [0.0])))}
    most = known.get(spec["kind"], abs(spec.get("stops", 0.0)))
    assert abs(math.log2(gain)) <= most + 1e-9
    assert make_lighting(json.loads(json.dumps(spec))) == lighting


def test_each_frame_has_its_stops_and_the_last_holds(tmp_path):
    wanted = [1.0, 0.5, 4.0, 4.0, 4.0]
    same = make_lighting({"kind": "schedule", "ev": [0, -1, 2]})
    for ev in ((0, -1, 2.0), np.array([0, -1, 2]), np.array([0, -1, 2], np.float32)):
        assert _gains({"kind": "schedule", "ev": ev}, 5) == wanted
        assert make_lighting({"kind": "schedule", "ev": ev}) == same
    for text in ("0\n-1\n2\n", "\ufeff 0 \n\n-1\n2", "frame,ev,note\n0,0,a\n1,-1,b\n2,2,c\n"):
        (tmp_path / "light.csv").write_text(text, encoding="utf-8")
        assert _gains({"kind": "schedule", "file": str(tmp_path / "light.csv")}, 5) == wanted


SHUTTER = RollingShutter(rows=40, row_time=2e-5, sensor_rows=8)


@pytest.mark.parametrize(
    ("spec", "lamp"),
    [
        ({}, MainsLamp(100.0, 0.8, phase=0.3)),
        ({"frequency": 400, "duty": 0.25, "depth": 0.5}, PulsedLamp(400.0, 0.25, phase=0.3)),
    ],
)
@pytest.mark.parametrize("time", [1 / 1000, 1 / 320, 1 / 30])
def test_rows_are_integrated_over_their_own_exposures(spec, lamp, time: float) -> None:
    lighting = make_lighting({"kind": "flicker", "frame_rate": 24, **spec})
    share = spec.get("depth", 1)
    gain, rows = lighting.rows(7, time, 0.3, SHUTTER)
    starts = (7 / 24 + 2e-5 * np.arange(320)).reshape(40, 8)
    wanted = 1 - share + share * np.vectorize(lamp.mean_light)(starts, time)
    np.testing.assert_allclose(gain * rows, wanted.mean(axis=1), atol=2e-4)
    assert rows.mean() == pytest.approx(1.0, abs=1e-12)
    assert lighting.gain(7, time, 0.3) == pytest.approx(wanted[0, 0], abs=2e-4)


@pytest.mark.parametrize(
    ("frequency", "times"), [(100, (1 / 100, 1 / 50, 1 / 25, 1 / 2)), (120, (1 / 120, 1 / 60))]
)
@pytest.mark.parametrize("duty", [None, 0.1])
def test_whole_periods_have_no_bands(frequency: float, times, duty: float | None) -> None:
    lighting = make_lighting({"kind": "flicker", "frequency": frequency, "duty": duty})
    for time in times:
        for frame, phase in ((0, 0.0), (3, 0.37), (100_000, 0.9)):
            assert lighting.rows(frame, time, phase, SHUTTER) == (1.0, None)
    assert lighting.rows(0, 1 / 90, 0.0, SHUTTER)[1] is not None


def test_a_batch_has_rows_of_ones_own() -> None:
    flicker = KINDS["flicker"]

    class Dimmed(flicker):  # type: ignore[misc, valid-type]
        def rows(self, *given):
            gain, rows = super().rows(*given)
            return gain / 16, rows

    given = np.array([7, 8]), np.array([1 / 1000, 1 / 30]), np.array([0.3, 0.1])
    gains, rows = flicker().batch(*given, SHUTTER)
    for own, wanted in zip(Dimmed().batch(*given, SHUTTER), (gains / 16, rows), strict=True):
        np.testing.assert_array_equal(own, wanted)
    Dimmed.rows = lambda self, *given: (1.0, np.ones(3))
    with pytest.raises(ValueError, match="`rows` of lighting 'flicker'"):
        Dimmed().batch(*given, SHUTTER)


def test_rows_of_a_batch_average_those_of_their_own_scenes() -> None:
    light, reference = torch.full((4, 80, 80), 0.1), CameraSettings(400, 1 / 250, 4.0)
    both = {"1": light[:, :40, :40].contiguous(), "2": light}  # of 2 and 4 sensor rows a row
    given = {"camera": get_camera("nikon_z6")}
    scenes = [ae_env.Scene.from_array(v, reference, scene_id=k, **given) for k, v in both.items()]
    options = {"scenes": scenes, "resolution": 40, "lighting": "flicker"}
    envs = gym.make_vec("ae_env/AutoExposure-v0", num_envs=2, **options).unwrapped
    envs.reset(seed=0, options={"scene": [0, 1]})
    episodes = envs.core.episodes
    _, rows = episodes.gains(np.arange(2), np.full(2, 1 / 1000))
    for i, sensor_rows in enumerate((2, 4)):
        shutter = RollingShutter(40, episodes.camera.row_time, sensor_rows)
        _, wanted = episodes.lighting.rows(0, 1 / 1000, episodes.phase.item(i), shutter)
        np.testing.assert_array_equal(rows[i], wanted)


PHASES = np.random.default_rng(0).random(40)
#: Most stops away from where the light begins (sines begin anywhere), most stops between frames.
BOUNDS = {"ramps": (6.0, 1.5), "sines": (3.5, np.pi), "tunnels": (7.0, 7.0 / 3.0)}
BOUNDS |= {"steps": (3.0, 6.0), "drifts": (6.0, 1.5), "lamps": (0.0, 0.0), "shadows": (5.0, 5.0)}
BOUNDS |= {"clouds": (5.0, 5.0), "pans": (4.0, 6.0 * 0.6)}


@pytest.mark.parametrize("kind", MOVES)
def test_kinds_stay_within_their_bounds_and_move(kind: str) -> None:
    lighting = make_lighting({"kind": "moving", "kinds": kind})
    traces = np.stack([lighting.stops(phase) for phase in PHASES])
    most, fastest = BOUNDS[kind]
    assert np.abs(traces).max() <= most + 1e-9
    assert np.abs(np.diff(traces, axis=1)).max() <= fastest + 1e-9
    if kind != "lamps":  # in the frames of an episode
        assert np.median(np.ptp(traces[:, :96], axis=1)) > 0.5


def test_the_phase_decides_every_kind_is_drawn_and_lamps_are_those_of_the_mains():
    lighting = make_lighting({"kind": "moving", "kinds": "all"})
    kinds = [lighting.kind(phase) for phase in PHASES]
    assert set(kinds) == set(MOVES) == {*KIND_SETS["train"], *KIND_SETS["test"]}
    again = make_lighting({"kind": "moving", "kinds": ["train", "test"]})
    for phase, kind in zip(PHASES, kinds, strict=True):
        found = [lighting.gain(frame, 0.01, phase) for frame in range(0, 200, 7)]
        assert found == [again.gain(frame, 0.01, phase) for frame in range(0, 200, 7)]
        if kind != "lamps":
            stops = lighting.stops(phase)[0:200:7]
            np.testing.assert_allclose(np.log2(found), stops, atol=1e-12)
    assert lighting.gain(10**6, 0.01, PHASES[0]) == lighting.gain(1023, 0.01, PHASES[0])
    # Whole periods of 100 or of 120 Hz have no ripple; 1/500 s has that of the depth drawn.
    lighting = make_lighting({"kind": "moving", "kinds": ["lamps"]})
    most = 0.0
    for hertz in (100.0, 120.0):
        lamp = make_lighting({"kind": "flicker", "frequency": hertz, "frame_rate": 29.97})
        most = max(most, *(np.ptp([lamp.gain(n, 0.002, p) for n in range(40)]) for p in PHASES))
    for phase in PHASES[:20]:
        whole = [lighting.gain(n, 0.05, phase) for n in range(30)]  # 5 and 6 periods
        np.testing.assert_allclose(whole, 1.0, atol=1e-9)
        assert 0.0 < np.ptp([lighting.gain(n, 0.002, phase) for n in range(40)]) <= most
