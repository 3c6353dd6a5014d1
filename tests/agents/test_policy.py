"""Policies by their names, those that look at no frame, and forecasts of the frames to come."""

import dataclasses
import textwrap
from contextlib import closing
from itertools import combinations, product
from pathlib import Path

import numpy as np
import pytest
import torch

import agents
from agents import evaluate, policy_names
from agents.evaluation.evaluation_plan import EvaluationPlan, plan_scenes
from agents.evaluation.jobs import named_content
from agents.foresight import POINTS, Foresight, TrendTracker
from agents.metering.reading import Reading
from agents.policy import PolicyContext
from agents.policy_names import PRETRAINED, make_policy, training_seeds
from agents.rollouts import make_envs
from examples import my_policy
from simulator import CameraSettings, RawImage, get_camera, write_dng


def test_every_listed_name_makes_a_policy(context):
    assert all(getattr(agents, name).__doc__ for name in agents.__all__)
    names = policy_names.list_policies()
    meters = len(policy_names.METERS) * len(policy_names.PROGRAMS) + 4  # and rpi_agc
    assert len(names) == len(set(names)) == 8 + meters
    heads = {name.partition(":")[0] for name in names}
    assert heads | {n for n in names if n.endswith(":video")} < policy_names.ABOUT.keys()
    for name in policy_names.ABOUT:
        policy_names.check_policy(name.replace("METER", "spot"))
    learnt = {"ppo", "regression", "ppo:video", "regression:video"}
    assert learnt < set(names)
    for name in set(names) - learnt:  # they come at one resolution, below
        policy = make_policy(name, context)
        assert policy.name == name
        assert policy.privileged == name.startswith("oracle:")
    for short, name in (("spot", "spot:P"), ("oracle", "oracle:last_frame")):
        assert make_policy(short, context).name == name


@pytest.mark.parametrize(
    ("name", "message"),
    [
        *(("matrx:P", "'matrix:P'"), ("matrix:Q", "one of matrix:P, .*blind$")),
        *(("recorded", "recorded:FOLDER"), ("mine.py", "class"), ("rpi-agc", "'rpi_agc'")),
        *((f"{n}:X", f"file {n!r}; .{{,60}}$") for n in ("no_such_pkg.mod", "p.png", "a/p.png")),
        *(("agents.baselines:Rundom", ".*Random"), ("spot?compensatio=1", "'compensation'")),
        *(("spot?damping=1", r"`damping` \(=1\) .* in \[0, 0\.999]"), ("spot:A?iso=100", "`iso`")),
        (f"ppo:{PRETRAINED}/video-regression-0", r"='ppo:/.* a ppo agent .*got 'regression'"),
        (f"ppo:{PRETRAINED}/../../simulator/pretrained/nano", "='ppo:/.* a ppo .*got 'nano'"),
        (f"ppo:{PRETRAINED}/ppo-1?nothing=1", r"\(='ppo\?nothing=1'\).*'nothing'"),
        *((f"recorded:{Path(__file__).parent}", "`path`"), ("spot?", "key=value")),  # holds no raw
        *(("regression?network=1", "`network`"), (f"spot?iso={'1' * 4096}", "YAML scalar")),
        *(("spot?foresight=trend&damping=.1", "`damping`"), ("spot?iso=1&iso=1", "'iso'.* twice")),
        ("rpi_agc?constraint=shadow", r"`constraint` \(='shadow'\)"),
        *((f"spot?foresight={word}", "`foresight`") for word in ("trends", "model")),
    ],
)
def test_bad_names_and_options_say_what_is_wrong(context, name, message):
    with pytest.raises(ValueError, match=f"^`policy` .*{message}"):
        make_policy(name, context)


def test_options_in_a_name(context):
    with pytest.raises(ValueError, match=r"option 'foo'; it takes foresight$"):
        policy_names.check_policy("regression?foo=1")  # before there is an environment
    name = "centre_weighted:P?compensation=-1&damping=0.5&shutter_cap=1/60"
    policy = make_policy(name, context)
    assert policy.name == name
    assert (policy.options.compensation, policy.options.damping) == (-1.0, 0.5)
    assert policy.options.shutter_cap == pytest.approx(1 / 60)
    assert make_policy("spot?compensation=+2/3", context).options.compensation == 2 / 3
    assert make_policy("rpi_agc:M?iso=400&mode=long", context).options.iso == 400.0
    assert make_policy("average:A", context, f_number=3.8).options.f_number == 3.8
    found = policy_names.split_options("spot?a=1e9999999&b=-inf&c=1 / 2&d=1/0&e=1e-3")[1]
    assert found == {"a": np.inf, "b": -np.inf, "c": 0.5, "d": "1/0", "e": 0.001}
    assert training_seeds("ppo:?a=1") == training_seeds("ppo?a=1")
    assert make_policy("spot:", context).program == "P"


MINE = """
    from dataclasses import dataclass
    import numpy as np
    from agents import Policy

    @dataclass
    class Helper:  # a dataclass looks its module up
        state: int

    class Constant(Policy):
        def __init__(self, context, state=7):
            super().__init__(context)
            self.helper = Helper(state)

        def act(self, observations, action_masks=None):
            return np.full(len(observations["raw"]), self.helper.state)

    class Forgetful(Policy): ...

    class Duck:
        def reset(self, num_envs, seed=None): ...
"""


def test_own_file(context, photograph, tmp_path):
    file = tmp_path / "my file.py"
    file.write_text(textwrap.dedent(MINE))
    frame = photograph(np.ones((64, 64)), 8.0, [1, 2])
    for name, options, state in (("", {"state": 9}, 9), ("?state=11", {}, 11)):
        policy = make_policy(f"{file}:Constant{name}", context, **options)
        policy.reset(2)
        assert policy.name.endswith(f"Constant{name}")
        assert policy.act(frame).tolist() == [state, state]
    for name, message in (("Mine", "Helper"), ("Forgetful", "act"), ("Duck", "act")):
        with pytest.raises(ValueError, match=f"`policy` .*{name}.*{message}"):
            make_policy(f"{file}:{name}", context)
    file.write_text("import a_module_that_is_not_there\n")
    with pytest.raises(ValueError, match="a_module_that_is_not_there"):
        make_policy(f"{file}:Mine", context)


def test_policies_that_look_at_no_frame(context):
    """Random is seeded, uniform and masked; others need a fit, or to be told the best state."""
    policy, frames = make_policy("random", context), {"raw": np.zeros((500, 4, 8, 8), np.uint8)}
    masks = np.zeros((500, 64), bool)
    masks[:, 10:14] = True
    policy.reset(500, seed=3)
    first, second = policy.act(frames, masks), policy.act(frames, masks)
    assert set(first) == {10, 11, 12, 13}
    assert np.bincount(first)[10:].min() > 90  # 125 expected, standard deviation 9.7
    assert not np.array_equal(first, second)
    policy.reset(500, seed=3)
    np.testing.assert_array_equal(policy.act(frames, masks), first)
    fixed, oracle = (make_policy(name, context) for name in ("best_fixed", "oracle"))
    with pytest.raises(ValueError, match="call fit"):
        fixed.act(frames)
    with pytest.raises(ValueError, match="with_oracle=True"):
        oracle.act({})


@pytest.mark.parametrize("delay", [0, 1])
def test_a_recording_is_replayed_on_its_own_raws(tmp_path, delay):
    """Every frame of the sequence is shot at the settings that its raw was recorded at."""
    # ISO 1600 and 6400 are as near to 3200; the EV decides with 1/15.
    recorded = (100, 1 / 1000, 4.0), (400, 1 / 125, 5.6), (3200, 1 / 16, 11.0)
    for i, settings in enumerate(recorded):
        light = torch.full((4, 40, 40), 0.1)
        raw = RawImage(light, CameraSettings(*settings), get_camera("nikon_z6"))
        write_dng(tmp_path / f"frame_{i:02d}.dng", raw)
    (tmp_path / "notes.txt").write_text("not a raw")
    options = {"scenes": {"sequence": str(tmp_path)}, "split": "test", "resolution": 36}
    options |= {"delay": delay, "depth": "far"}
    with closing(make_envs(options, num_envs=1, frames=1)) as envs:
        policy = make_policy(f"recorded:{tmp_path}", PolicyContext.from_envs(envs))
    result = evaluate({"recorded": policy}, options, frames=4)
    for frame in range(delay, 4):
        found = result.grid[result.tracks["recorded"].states[0, 0, frame]]
        _, time, f_number = recorded[min(frame + 1, 2)]
        assert found.f_number == f_number
        assert found.exposure_time == pytest.approx(time, rel=0.07)
    # The raws show light of 10, 6 and 1.1 EV, and the last one stays.
    assert len(np.unique(result.scores[0], axis=0)) == 2
    np.testing.assert_array_equal(result.scores[0, 1], result.scores[0, 3])


SCENES = {"scenes": "bundled:small", "split": "test", "resolution": 64}


def _mean_gains(names, options, context, frames, scenes):
    """Gains over a random policy, a mean over so many scenes."""
    plan = EvaluationPlan(environment=SCENES, max_scenes=scenes)
    policies, options = {n: make_policy(n, context) for n in names}, dict(options)
    options["scenes"] = plan_scenes(plan)
    result = evaluate(policies, options, frames=frames, batch=16)
    return {name: result.group_gains(name)[0].mean() for name in policies}


def test_shipped_agents_beat_a_plain_meter_and_differ_by_their_seed():
    context = PolicyContext.from_envs(make_envs(SCENES, num_envs=1, frames=1))
    agents = ("regression", "ppo")
    gains = _mean_gains((*agents, "centre_weighted:P"), SCENES, context, frames=4, scenes=16)
    for name in agents:
        assert gains[name] > gains["centre_weighted:P"]
        seeds = [make_policy(own, context) for own in training_seeds(name)]
        weights = [next(iter(p.network.parameters())) for p in seeds]
        assert len(seeds) == 3
        assert not any((a == b).all() for a, b in combinations(weights, 2))


@pytest.mark.parametrize("name", ["ppo", "regression", "matrix:P"])
def test_masks_that_do_not_fit_or_allow_nothing_are_refused(name):
    with closing(make_envs({"scenes": "bundled:small"}, num_envs=2, frames=1)) as envs:
        policy = make_policy(training_seeds(name)[0], PolicyContext.from_envs(envs))
        (seen, _), masks = envs.reset(seed=0), np.ones((2, len(policy.context.grid)), bool)
    policy.reset(2)
    for wrong in (masks[:1], masks[:, 1:], masks[0], masks & [[1], [0]]):
        with pytest.raises(ValueError, match="`action_masks`"):
            policy.act(seen, wrong)


def test_agents_for_moving_light_come_with_their_forecasts():
    """They foresee with what ships, and refuse a grid that they were not trained on."""
    video = {**SCENES, "grid": "video", "delay": {"iso": 1, "exposure_time": 2, "f_number": 2}}
    video["lighting"] = {"kind": "moving", "kinds": "sines"}
    context = PolicyContext.from_envs(make_envs(video, num_envs=1, frames=1))
    names = ("regression:video", "regression:video?foresight=learnt", "ppo:video", "average:P")
    gains = _mean_gains(names, video, context, frames=16, scenes=4)
    assert gains["regression:video?foresight=learnt"] > 1.2 * gains["regression:video"]
    assert gains["ppo:video"] > 1.2 * gains["average:P"]
    # A stored evaluation is of these files: each other one decides another result.
    content = {n: named_content(n) for n in ("regression", *names)}
    assert len(set(content.values())) == 5
    assert content["average:P"] == ""
    late = dataclasses.replace(context, delays=(4, 4, 4))
    still = PolicyContext.from_envs(make_envs(SCENES, num_envs=1, frames=1))
    for options, where, message in (
        ("?foresight=runs/none", context, r"`foresight` \(='runs/none'\)"),
        ("?foresight=", context, r"`foresight` \(=None\)"),
        ("?foresight=learnt", late, "delay of 4"),
        ("", still, "exposure_times"),
    ):
        with pytest.raises(ValueError, match=message):
            make_policy(f"regression:video{options}", where)


def test_a_pattern_names_the_training_seeds(tmp_path):
    for file in ("ppo-1.safetensors", "ppo-0.safetensors", "ppo-0.json", "other.safetensors"):
        (tmp_path / file).touch()
    expected = [f"ppo:{tmp_path}/ppo-{seed}" for seed in (0, 1)]
    assert training_seeds(f"ppo:{tmp_path}/ppo-*") == expected
    assert training_seeds(f"ppo:{tmp_path}/ppo-0") == [f"ppo:{tmp_path}/ppo-0"]
    with pytest.raises(ValueError, match=r"no \.safetensors file fits"):
        training_seeds(f"regression:{tmp_path}/regression-*")


class Known:
    """A tracker that is told the light of one camera and how sure it is."""

    def __init__(self, ev100, spread=0.0):
        self.ev100_ahead, self.spread = ev100, spread

    def update(self, reading, exposed_at): ...

    def ahead(self, frames):
        return np.array([float(self.ev100_ahead(frames))]), np.array([self.spread])


def _reading(ev100, saturated=0.0, black=False):
    ev100 = np.atleast_1d(np.asarray(ev100, float))
    return Reading(ev100, np.full(len(ev100), saturated), np.full(len(ev100), black))


def test_every_control_is_chosen_for_the_first_frame_that_has_it(context, photograph):
    """Against all decisions: ISO for frame 2 beside what was asked for, the rest for frame 3."""
    grid = context.grid
    tables = {2.0: np.random.default_rng(2).random(64), 3.0: np.random.default_rng(3).random(64)}
    delayed = dataclasses.replace(context, delays=(1, 2, 2))
    foresight = Foresight(delayed, Known(lambda frames: frames))
    start, asked = 21, 62
    foresight.observe(_reading(9.0), photograph(np.ones((64, 64)), 9.0, start))
    foresight.record_action(np.array([asked]))
    foresight.observe(_reading(9.0), photograph(np.ones((64, 64)), 9.0, start))
    found = foresight.utility(lambda ev: tables[float(ev[0])][None])[0]

    def promise(iso, time, aperture):
        _, asked_time, asked_aperture = grid.controls(asked)
        second = tables[2.0][grid.index(iso, asked_time, asked_aperture)]
        return second + max(tables[3.0][grid.index(free, time, aperture)] for free in range(4))

    expected = [promise(*controls) for controls in product(range(4), repeat=3)]
    np.testing.assert_allclose(found, expected)
    # Without delay it is the best state of the next frame.
    foresight = Foresight(context, Known(lambda frames: frames))
    foresight.observe(_reading(9.0), photograph(np.ones((64, 64)), 9.0, 3))
    table = np.random.default_rng(0).random((1, 64))
    np.testing.assert_array_equal(foresight.utility(lambda ev: ev[0] * table), table)


def test_scores_are_averaged_over_what_the_light_may_be(context, photograph):
    """The points have the mean and the variance of a normal distribution with that error."""
    points, weights = POINTS
    moments = [weights @ points**power for power in (0, 1, 2)]
    # The last is (standard deviation / mean error)^2.
    assert moments == pytest.approx([1.0, 0.0, np.pi / 2], rel=1e-4)
    foresight = Foresight(context, Known(lambda frames: 5.0, spread=2.0))
    foresight.observe(_reading(9.0), photograph(np.ones((64, 64)), 9.0, 3))
    found = foresight.utility(lambda ev: np.repeat(ev[:, None] ** 2, 64, axis=1))
    np.testing.assert_allclose(found, 25.0 + 4.0 * np.pi / 2, rtol=1e-4)


def test_a_trend_foresees_ramps_and_rests_and_follows_jumps_at_once(monkeypatch):
    for name, value in ("ALPHA", 0.5), ("BETA", 0.3), ("DAMPING", 1.0):
        monkeypatch.setattr(f"agents.foresight.{name}", value)
    tracker = TrendTracker(1, (-2.0, 18.0))
    light = np.concatenate([np.arange(40) * 0.25, np.full(40, 9.75)])
    for ev in light[:40]:
        tracker.update(_reading(ev), np.zeros(1))
    assert tracker.ahead(3)[0] == pytest.approx(9.75 + 0.75, abs=1e-3)
    for ev in light[40:]:
        tracker.update(_reading(ev), np.zeros(1))
    assert tracker.ahead(3)[0] == pytest.approx(9.75, abs=1e-3)
    # Clipped frames count only where they contradict.
    tracker = TrendTracker(3, (0.0, 16.0))
    for _ in range(3):
        tracker.update(_reading([8.0, 8.0, 8.0]), np.zeros(3))
    dark = Reading(np.array([3.0, 11.0, 9.0]), np.array([0.0, 1.0, 1.0]), np.zeros(3, bool))
    tracker.update(dark, np.zeros(3))
    # Jumped; white says 8 or more (3 of 11 are the meter's guess); white says 6 or more.
    assert tracker.ahead(2)[0] == pytest.approx([3.0, 8.0, 8.0])


@pytest.mark.parametrize(
    ("name", "low", "high"), [("average:P", 2.0, np.inf), ("average:P?foresight=trend", -1.3, 1.3)]
)
def test_a_meter_with_foresight_is_ahead_of_a_ramp(context, photograph, name, low, high):
    """Light that falls by a stop a frame, settings three frames late: what is asked for is right
    for the frame that has it, where the plain meter is three stops too dark.
    """
    policy = make_policy(name, dataclasses.replace(context, delays=(2, 2, 2)))
    policy.reset(1)
    asked = [context.grid.nearest(14.0)] * 3
    for frame in range(12):
        taken = photograph(np.ones((64, 64)), 14.0 - frame, asked[frame])
        asked.append(int(policy.act(taken)[0]))
    assert low < context.grid.ev100[asked[11 + 3]] - (14.0 - 11 - 3) < high


def test_the_policy_of_the_page_exposes_a_card_and_obeys_masks(context, photograph):
    """The example, which `docs/judge.md` prints: `test_docs` compares them."""
    policy = make_policy(f"{my_policy.__file__}:HalfGrey", context)
    states, masks = np.array([0, 63]), np.ones((2, 64), bool)
    for _ in range(6):
        states = policy.act(photograph(np.ones((64, 64)), 9.0, states))
    np.testing.assert_allclose(context.grid.ev100[states], 9.0, atol=0.2)
    masks[:, states[0]] = False
    assert policy.act(photograph(np.ones((64, 64)), 9.0, states), masks)[0] != states[0]
