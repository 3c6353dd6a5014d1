"""A meter and a program in the loop: with synthetic frames, and with the environment."""

import functools
import math
from contextlib import closing
from typing import Any

import numpy as np
import pytest

from agents.metering.metering_policy import MeteringPolicy
from agents.metering.tuned import ScoreRegression
from agents.policy import PolicyContext
from agents.policy_names import METERS, make_policy
from agents.rollouts import make_envs

CONTROLLERS = (*METERS, "rpi_agc")
SMALL = {"scenes": "bundled:small", "split": "all", "resolution": 36}
#: Scenes of the loops: each sixth of the small ones.
COUNT = 7
GREY = np.ones((64, 64))


def _run(policy, photograph, scene_ev, *, start=0, **blur):
    policy.reset(1, seed=0)
    path = [start]
    for _ in range(5):
        path.extend(policy.act(photograph(GREY, scene_ev, path[-1], **blur)).tolist())
    return path[1:]


def _fitted():
    """Best state = (ISO by EV, shutter by speed, aperture by defocus): known by construction."""
    features = np.random.default_rng(0).uniform([0, -9, -3], [16, 3, 3], (4000, 3))
    scores = np.exp(-0.5 * (np.arange(64) != _best_state(features)[:, None]))
    return ScoreRegression(features, scores, np.full(3, 0.3))


def _best_state(features):
    controls = (features[:, 0] <= 8, features[:, 1] <= -3, features[:, 2] > 0)
    return 3 * np.array([16, 4, 1]) @ controls  # 4 ISOs, times and apertures


def test_tuned_program_uses_its_readings_and_options(context, photograph, tmp_path):
    weights = tmp_path / "tuned.safetensors"
    _fitted().save(weights)
    for ev, speed, defocus, option, looked_up in (
        (12.0, 2.0, 4.0, "", 12.0),
        (4.0, 0.004, 0.25, "", 4.0),
        (12.0, 0.004, 4.0, "", 12.0),
        (9.0, 2.0, 4.0, "?compensation=2", 7.0),  # brighter: the best of a darker scene
        (12.0, 0.004, 4.0, "?foresight=trend", 12.0),
        (12.0, 0.004, 4.0, "?foresight=model", 12.0),  # of light that rests
    ):
        policy = make_policy(f"average:tuned{option}", context, weights=weights)
        wanted = _best_state(np.array([[looked_up, np.log2(speed), np.log2(defocus)]]))[0]
        path = _run(policy, photograph, ev, speed=speed, defocus=defocus, start=wanted)
        assert path[-1] == wanted
    policy = make_policy("average:tuned?shutter_cap=1/100", context, weights=weights)
    path = _run(policy, photograph, 4.0, speed=0.004, defocus=0.25)  # the best is 1/2 s
    assert all(context.grid[s].exposure_time <= 1 / 100 for s in path)
    make_policy("average:P", context).fit(None)  # it has nothing to learn
    with pytest.raises(ValueError, match="call fit"):
        _run(make_policy("average:tuned", context), photograph, 8.0)
    with pytest.raises(ValueError, match="nothing to save"):
        make_policy("average:tuned", context).save(tmp_path / "x.safetensors")
    with pytest.raises(ValueError, match="`sensors`"):
        _run(make_policy("average:tuned_blind", context, weights=weights), photograph, 8.0)


def test_sensors_are_averaged_over_the_frames(context, photograph):
    policy = MeteringPolicy(context, "average", "P")
    # Of -1, 1, 0 stops; what stands still counts as the slowest that the sensor tells.
    for speeds, mean in (((0.5, 2.0, 1.0), 0.0), ((0.5,), -1.0), ((0.0,), -9.0)):
        policy.reset(1)
        for speed in speeds:
            readings = policy.observe(photograph(GREY, 8.0, 20, speed=speed, defocus=1.0))
        assert readings[0, 1] == pytest.approx(mean, abs=1e-5)


@pytest.mark.parametrize(("program", "keeps"), [("P", True), ("A", False), ("tuned", True)])
def test_of_equal_states_some_programs_keep_the_last(context, photograph, tmp_path, program, keeps):
    """At the speed where another state becomes the best one: it has to be better by more."""
    weights = {"weights": _fitted().save(tmp_path / "tuned.safetensors")}
    policy = MeteringPolicy(context, "average", program, **(weights if program == "tuned" else {}))

    def chosen(*stops):
        """The last choice after frames of these speeds, of which the mean counts."""
        policy.reset(1)
        frames = [photograph(GREY, 7.0, 20, speed=2.0**s, defocus=0.5) for s in stops]
        return int([policy.act(frame)[0] for frame in frames][-1])

    low, high = -6.0, 2.0
    first = chosen(low)
    assert chosen(high) != first
    while high - low > 1e-4:
        middle = (low + high) / 2
        low, high = (middle, high) if chosen(middle) == chosen(low) else (low, middle)
    assert chosen(low, 2 * high - low) == (chosen(low) if keeps else chosen(high))
    assert chosen(low, high + 4.0) != chosen(low)  # by far more


def test_only_a_reading_of_highlights_is_a_ceiling(context, photograph):
    """Grey at 0.12 of white: at 0.9 where it is 2.9 EV darker; no choice is brighter than that."""
    for name, metered, is_ceiling in (
        ("average", 0.0, False),
        ("highlight_weighted", math.log2(0.12 / 0.9), True),
    ):
        policy, over = make_policy(f"{name}:P", context), []
        for ev in np.arange(6.0, 13.0, 0.5):
            policy.reset(1)
            (state,) = policy.act(photograph(GREY, ev, context.grid.nearest(ev)))
            over.append(ev + metered - context.grid.ev100[state])
        assert bool(max(over) < 0.2) is is_ceiling  # a sixth of a stop and the codes


def test_a_policy_that_was_not_reset_says_so(context, photograph):
    frame = photograph(GREY, 9.0, [1, 2])
    for name in ("matrix:P", "shim:A", "rpi_agc"):
        policy = make_policy(name, context)
        with pytest.raises(ValueError, match=r"are of 2: call reset\(num_envs\) first"):
            policy.act(frame)


@functools.cache
def _loop(name: str, frames: int, start: int | None = None, step: float | None = None) -> Any:
    """EVs of the grid's ends, of the states (E, T), and of the light at the start (E,)."""
    lighting = {"kind": "step", "stops": step, "at": 12}  # seen two frames later
    options = {**SMALL, "motion": "none", "depth": "far"}
    if step is not None:
        options |= {"lighting": lighting, "delay": 2}
    with closing(make_envs(options, num_envs=COUNT, frames=frames)) as envs:
        base: Any = envs.unwrapped
        scenes = range(0, len(base.scenes), 6)
        policy = make_policy(name, PolicyContext.from_envs(envs))
        policy.reset(COUNT, seed=0)
        where = {"scene": list(scenes)} | ({} if start is None else {"state": start})
        observations, _ = envs.reset(seed=0, options=where)
        states = []
        for _ in range(frames):
            states.append(policy.act(observations, base.action_masks()))
            observations, *_ = envs.step(states[-1])
        light = np.array([base.scenes[i].ev100 for i in scenes])
        ev100 = base.grid.ev100
        return ev100.min(), ev100.max(), ev100[np.stack(states, axis=1)], light


@pytest.mark.parametrize(
    ("name", "program", "start"),
    [
        *((name, "P", start) for name in CONTROLLERS for start in (None, 3, 60)),
        *((name, program, None) for name in ("matrix", "rpi_agc") for program in "ASM"),
    ],
)
def test_comes_to_rest_in_steady_light(name, program, start):
    """From a start of the environment's, from the darkest state (3) and from the brightest (60)."""
    _, _, ev, light = _loop(f"{name}:{program}", 24, start)
    # Shim's and Zhang's meters may still be on their way in the dark, but they do not turn back.
    moves = np.sign(np.diff(ev[:, -10:], axis=1).round(1))
    assert (np.abs(moves).sum(axis=1) == np.abs(moves.sum(axis=1))).all()
    assert (moves != 0).sum() <= (2 if name in ("shim", "zhang") else 0)
    if program == "P":
        median = np.median(ev[:, -1] - light)
        assert abs(median) < (3.5 if name in ("entropy", "shim", "zhang") else 1.5)


@pytest.mark.parametrize(
    ("name", "stops"),
    [*((n, -4.0) for n in CONTROLLERS), *((n, 4.0) for n in ("average", "zhang", "rpi_agc"))],
)
def test_comes_to_rest_after_a_step_with_delay(name, stops):
    low, high, ev, _ = _loop(f"{name}:P", 60, step=stops)
    assert np.ptp(ev[:, -8:], axis=1).max() < 0.1
    before, after = ev[:, 11], ev[:, -1]
    end = 4.6 if name == "rpi_agc" else low + 0.6  # of its ladder
    inside = (after > end) & (after < high - 0.6)
    assert np.median((after - before)[inside]) == pytest.approx(stops, abs=1.5)


@pytest.mark.parametrize("name", ["matrix", "highlight_weighted", "zhang", "rpi_agc"])
def test_compensation_shifts_the_exposure_by_its_ev(name):
    low, high, plain, _ = _loop(f"{name}:P", 24)
    first, second = plain[:, -1], _loop(f"{name}:P?compensation=-2", 24)[2][:, -1]
    inside = (second < high - 0.6) & (first > low + 0.6)
    assert inside.sum() >= 4
    assert np.median((second - first)[inside]) == pytest.approx(2.0, abs=0.3)
