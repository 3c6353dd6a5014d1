"""Programs: their arithmetic by hand, and in the loop with a meter; libcamera's AGC."""

import dataclasses
import functools
import json
import math
import os
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from ae_env.grid import ExposureGrid
from agents.metering import metering_policy, programs
from agents.metering.metering_policy import MeteringPolicy, ScoreRegression
from agents.metering.programs import ProgramOptions, StateChooser, program_cost
from agents.metering.rpi_agc import IMX477, LibcameraAgc, signal_histogram, zone_map
from agents.policy import PolicyContext
from agents.policy_names import METERS, make_policy
from agents.rollouts import make_envs
from simulator import get_camera

#: ISO 100 and 400, 1/64 and 1/4 s, f/4 and f/8: every value a power of two.
GRID = ExposureGrid((100, 400), (1 / 64, 1 / 4), (4, 8))
#: Av + Tv - (Sv - 5) of its states, in their order: ISO slowest, aperture fastest.
EV = [10.0, 12.0, 6.0, 8.0, 8.0, 10.0, 4.0, 6.0]


def chooser(program="P", ceiling=False, grid=GRID, **options) -> StateChooser:
    return StateChooser(grid, program, ProgramOptions(**options), ceiling)


def best(found: StateChooser, target: float, preference=0.0) -> list[int]:
    """All states of the highest utility."""
    cost = np.broadcast_to(np.asarray(preference, float), (len(EV),))
    utility = found.utility(np.array([target]), cost)[0]
    return np.flatnonzero(utility == utility.max()).tolist()


@pytest.mark.parametrize(
    ("program", "options", "target", "states"),
    [
        ("P", {}, 10.0, [0, 5]),
        ("P", {}, 9.2, [0, 5]),  # 0.8 from EV 10, 1.2 from 8
        ("P", {}, 9.05, [0, 3, 4, 5]),  # 0.95 and 1.05: within a sixth of an EV
        ("P", {}, 40.0, [1]),
        ("A", {"f_number": 4.0}, 10.0, [0]),
        ("A", {"f_number": 8.0}, 6.2, [7]),
        ("A", {"f_number": 5.0}, 10.0, [0]),  # 0.64 of a stop from f/4, 1.36 from f/8
        ("S", {"exposure_time": 1 / 4}, 8.0, [3]),
        ("S", {"exposure_time": 1 / 50}, 8.0, [4]),
        ("M", {"f_number": 4.0, "exposure_time": 1 / 4}, 12.0, [2]),
        ("M", {"f_number": 4.0, "exposure_time": 1 / 4, "iso": 400}, 12.0, [6]),
        ("M", {"f_number": 8.0, "exposure_time": 1 / 64, "iso": 199}, 0.0, [1]),
        ("M", {"f_number": 8.0, "exposure_time": 1 / 64, "iso": 201}, 20.0, [5]),  # border: 200
        ("P", {"f_number": 8.0}, 10.0, [0, 5]),  # set by hand in other programs only
        ("S", {"exposure_time": 1 / 4, "shutter_cap": 1 / 30}, 8.0, [4]),  # the cap comes first
        ("P", {"shutter_cap": 1 / 8}, 4.0, [4]),  # 1/64 s and as near as that allows
        ("P", {"shutter_cap": 1 / 1000}, 12.0, [1]),  # none is shorter: the shortest
        ("P", {"iso_cap": 200}, 8.0, [3]),  # ISO 100
        ("M", {"iso": 400, "iso_cap": 100}, 8.0, [1]),  # f/8 and 1/125 s by hand
        ("P", {"iso_cap": 100, "shutter_cap": 1 / 8}, 4.0, [0]),
    ],
)
def test_states_that_fit_best(program, options, target, states):
    assert best(chooser(program, **options), target) == states
    with pytest.raises(ValueError, match=r"`iso_cap` \(=50\) must be at least 100, the grid's low"):
        chooser(program, iso_cap=50)


def test_what_comes_first_in_the_choice_of_a_state():
    found, cost = chooser(), np.zeros(8)
    cost[0] = 1.0  # a preference decides among states of one exposure
    assert best(found, 10.0, cost) == [5]
    cost[[0, 5]] = 400.0  # 0.4 EV count as much: still nearer than the next exposure
    assert best(found, 10.0, cost) == [0, 5]
    # Of a ceiling the next darker state.
    found = chooser(ceiling=True)
    assert best(found, 8.5) == [0, 5]  # 8 is nearer, but brighter
    assert best(found, 8.0) == [3, 4]
    assert best(found, 20.0) == [1]  # none is darker
    assert best(chooser(), 8.5) == [3, 4]


def test_hysteresis_is_a_fifth_of_a_step():
    found = chooser()
    previous = np.array([0])  # EV 10; the border to 8 is at 9, that to 12 at 11
    for target, expected in ((8.81, 10.0), (8.79, 8.79), (11.19, 10.0), (11.21, 11.21)):
        assert found.with_hysteresis(np.array([target]), previous) == pytest.approx(expected)
    assert found.with_hysteresis(np.array([8.0]), None) == 8.0
    ceiling = chooser(ceiling=True)
    # Darker than the state: at once. Brighter: it stays while it is within 0.4 EV of the ceiling.
    for target, expected in ((10.1, 10.1), (9.7, 10.0), (9.5, 9.9)):
        assert ceiling.with_hysteresis(np.array([target]), previous) == pytest.approx(expected)


def test_limits_of_shutter_and_aperture():
    blind, seen = np.array([[8.0]]), np.array([[8.0, 1.0, 2.0]])  # 2 frame heights/s, 4 pixels
    np.testing.assert_allclose(programs.shutter_limit(blind), [[np.log2(60)]])
    # A 64th of a frame height.
    np.testing.assert_allclose(programs.shutter_limit(seen), [[np.log2(128)]])
    np.testing.assert_allclose(programs.aperture_limit(blind), [[2 * np.log2(5.6)]])
    # The blur 4 * 4 / N pixels is one at f/16: Av 8.
    np.testing.assert_allclose(programs.aperture_limit(seen), [[8.0]])


def test_costs_of_the_programs():
    found = chooser(grid=ExposureGrid((100, 800), (1 / 64, 1 / 4), (4, 8)))
    readings = np.array([[8.0, -1.0, 1.25]])  # Tv 5 and Av 6.5 are enough
    slow = np.array([0, 0, 3, 3, 0, 0, 3, 3.0])
    gain = np.array([0, 0, 0, 0, 3, 3, 3, 3.0])
    wide = np.array([2.5, 0.5] * 4)
    line = np.abs(np.array([4.0, 6.0] * 4) - 2 * np.log2(5.6))
    expected = slow**2 + wide**2 / 2 + gain**2 / 4 + line**2 / 20
    np.testing.assert_allclose(program_cost("P", found, readings)[0], expected)
    np.testing.assert_allclose(program_cost("A", found, readings)[0], 10 * slow + gain / 10)
    for program in ("S", "M"):
        np.testing.assert_allclose(program_cost(program, found, readings)[0], gain / 10)


def test_step_of_a_grid():
    assert (programs.ev_step(ExposureGrid.default()), programs.ev_step(GRID)) == (1.0, 2.0)
    # Nothing to step to; 1/60 is 1/64; the median.
    for places, step in (((6,), 1.0), ((6, 5.9, 3), 3.0), ((6, 5, 4, 1), 1.0)):
        grid = ExposureGrid((100,), tuple(2.0**-place for place in places), (4,))
        assert programs.ev_step(grid) == pytest.approx(step, abs=0.1)


@pytest.mark.parametrize(
    ("option", "low", "high"),
    [
        *(("compensation", -32.0, 32.0), ("damping", 0.0, 0.999), ("f_number", 0.1, 1000.0)),
        *(("exposure_time", 1e-7, 1e5), ("shutter_cap", 1e-7, 1e5), ("iso", 1.0, 1e7)),
        ("iso_cap", 1.0, 1e7),
    ],
)
def test_ranges_of_the_options(option, low, high):
    for value in (low, high):
        assert getattr(ProgramOptions(**{option: value}), option) == value
    for value in (low - 0.1, high * 1.01, float("nan"), "half", True):
        with pytest.raises(ValueError, match=f"`{option}`"):
            ProgramOptions(**{option: value})


def _samples(count=600, seed=0):
    rng = np.random.default_rng(seed)
    features = rng.uniform(-4, 4, (count, 2))
    peaks = np.linspace(-4, 4, 9)
    scores = np.exp(-0.5 * (features[:, :1] + 0.5 * features[:, 1:] - peaks) ** 2)
    return features, scores, np.arange(count) % 40


def test_a_linear_surface_is_reproduced_away_from_the_data_edge():
    rng = np.random.default_rng(1)
    features, query = rng.uniform(-2, 2, (4000, 2)), rng.uniform(-1.5, 1.5, (50, 2))
    scores, expected = (np.array([0.3, 0.5]) + x * [0.1, -0.05] for x in (features, query))
    model = ScoreRegression(features, scores, np.array([0.4, 0.4]))
    np.testing.assert_allclose(model.predict(query), expected, atol=0.01)


def test_outside_the_training_range_it_does_not_extrapolate():
    features, scores, _ = _samples()
    model = ScoreRegression(features, scores, np.array([0.3, 0.3]))
    far = model.predict(np.array([[500.0, -500.0], [1e9, 0.0]]))
    edge = model.predict(np.array([[features[:, 0].max(), features[:, 1].min()]]))
    np.testing.assert_allclose(far[0], edge[0])
    assert ((far > -0.2) & (far < 1.2)).all()


def test_fit_picks_nearly_the_best_state_of_unseen_samples():
    model = ScoreRegression.fit(*_samples())
    features, scores, _ = _samples(seed=7)
    picked = model.predict(features).argmax(axis=1)
    regret = scores.max(axis=1) - scores[np.arange(len(scores)), picked]
    assert regret.mean() < 0.01


def test_save_and_load_give_the_same_regression(tmp_path):
    model = ScoreRegression.fit(*_samples(200))
    again = ScoreRegression.load(model.save(tmp_path / "deep" / "tuned.safetensors"))
    query = np.array([[0.1, 0.2], [3.0, -3.0]])
    np.testing.assert_array_equal(model.predict(query), again.predict(query))
    (tmp_path / "text").write_text("no tensors here")
    os.mkfifo(tmp_path / "pipe")
    for name in ("missing.safetensors", "text", "pipe"):
        with pytest.raises(ValueError, match="`path`"):
            ScoreRegression.load(tmp_path / name)
    good, nan = vars(model), np.full_like(model.scores, np.nan)
    short, empty = np.zeros(2), np.zeros((0, 2))
    for changes in (
        *({"scores": v} for v in (nan, model.scores[1:], model.scores[:, 0], nan.astype(bool))),
        *({"bandwidths": v} for v in (short, np.ones(3), model.bandwidths.astype("c8"))),
        *({"features": empty, "scores": empty}, {"features": short[:0]}, {"more": short}),
    ):
        save_file({**good, **changes}, tmp_path / "x")
        with pytest.raises(ValueError, match=r"^`path` \(='[^']*x'\) holds no tuned program: .*\Z"):
            ScoreRegression.load(tmp_path / "x")


CONTROLLERS = (*METERS, "rpi_agc")
SMALL = {"scenes": "bundled:small", "split": "all", "resolution": 36}
COUNT = 7  # scenes of the loops: each sixth of the small ones
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
    for cap, limit in (("shutter_cap=1/100", (1 / 100, 6400)), ("iso_cap=100", (1, 100))):
        policy = make_policy(f"average:tuned?{cap}", context, weights=weights)
        path = _run(policy, photograph, 4.0, speed=0.004, defocus=0.25)  # the best is 1/2 s
        taken = [context.grid[s] for s in path]
        assert all(s.exposure_time <= limit[0] and s.iso <= limit[1] for s in taken)
    make_policy("average:P", context).fit(None)  # it has nothing to learn
    with pytest.raises(ValueError, match="call fit"):
        _run(make_policy("average:tuned", context), photograph, 8.0)
    with pytest.raises(ValueError, match="nothing to save"):
        make_policy("average:tuned", context).save(tmp_path / "x.safetensors")
    with pytest.raises(ValueError, match="`sensors`"):
        _run(make_policy("average:tuned_blind", context, weights=weights), photograph, 8.0)


def test_a_fit_is_found_again_by_another_run_and_by_nothing_else(context, tmp_path, monkeypatch):
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path))
    fits = iter([_fitted()])
    monkeypatch.setattr(MeteringPolicy, "_fit", lambda *_: next(fits))
    told = None, 0, {"scenes": "bundled"}
    for name in ("average:tuned", "average:tuned?foresight=model"):
        monkeypatch.setattr(metering_policy, "_FITS", {})  # as in another process
        policy = make_policy(name, context)
        policy.fit_once(*told)
        np.testing.assert_array_equal(policy.regression.scores, _fitted().scores)
    other = dataclasses.replace(context, camera=get_camera("canon_5d4"))
    for name, own in (("spot:tuned", context), ("average:tuned", other)):
        with pytest.raises(StopIteration):
            make_policy(name, own).fit_once(*told)


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
    cases = ("average", 0.0, False), ("highlight_weighted", math.log2(0.12 / 0.9), True)
    for name, metered, is_ceiling in cases:
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
def _loop(name, frames, start=None):
    """EVs of the grid's ends, of the states (E, T), and of the light (E,)."""
    options = {**SMALL, "motion": "none", "depth": "far"}
    with closing(make_envs(options, num_envs=COUNT, frames=frames)) as envs:
        base = envs.unwrapped
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


@pytest.mark.parametrize("name", ["matrix", "highlight_weighted", "zhang", "rpi_agc"])
def test_compensation_shifts_the_exposure_by_its_ev(name):
    low, high, plain, _ = _loop(f"{name}:P", 24)
    first, second = plain[:, -1], _loop(f"{name}:P?compensation=-2", 24)[2][:, -1]
    inside = (second < high - 0.6) & (first > low + 0.6)
    assert inside.sum() >= 4
    assert np.median((second - first)[inside]) == pytest.approx(2.0, abs=0.3)


# -- the Raspberry Pi's AGC: against libcamera's recordings, and on a grid -------------------------


def test_zones_cover_the_frame_with_the_first_in_the_middle():
    zones = zone_map(60, 90)
    assert np.unique(zones).tolist() == list(range(15))
    assert zones[30, 45] == 0
    counts = np.bincount(zones.ravel())
    assert counts[11:].tolist() == [10 * 15] * 4  # a sixth by a sixth
    assert {int(zones[30, x]) for x in range(90)} == {9, 5, 1, 0, 2, 6, 10}


def _wanted_ev(policy, frame):
    """EV100 that the policy would set if the grid held every exposure."""
    policy.reset(1)
    policy.act(frame)
    return policy._damped[0]


#: Weights of the zones as raspberrypi/libcamera has them in src/ipa/rpi/vc4/data/imx477.json.
ZONES = {"matrix": [1] * 15, "spot": [2, 1, 1] + [0] * 12}
ZONES["centre_weighted"] = [3, 3, 3, 2, 2, 2, 2, 1, 1, 1, 1, 0, 0, 0, 0]


@pytest.mark.parametrize("metering", ZONES)
@pytest.mark.parametrize(
    ("ev", "target"), [(7.0, 0.1616), (9.0, 0.165 + 0.005 * 280 / 9000), (12.0, 0.17)]
)
def test_zones_weigh_as_published(context, photograph, metering, ev, target):
    """Zones whose mean is 1 by these weights: it is put at the target of its illuminance.

    0.16 at 0 lux, 0.165 at 1000, 0.17 from 10,000 on; 2.5 * 2^EV100 lux at mean light 1."""
    for seed in (0, 6):  # a level close to 1 shows no weight: each is elsewhere in one of them
        levels = np.random.default_rng(seed).permutation(np.geomspace(0.25, 3.0, 15))
        levels /= np.average(levels, weights=ZONES[metering])
        frame = photograph(levels[zone_map(64, 64)], ev, context.grid.nearest(ev))
        found = _wanted_ev(make_policy(f"rpi_agc?metering={metering}", context), frame)
        assert found == pytest.approx(ev - math.log2(target / 0.12), abs=0.04)


def test_constraints(context, photograph):
    """Wide range: half of the frame dark, 4 % of it highlights in the corners."""
    light = np.full((64, 64), 1.3)
    light[:, 32:] = 0.2
    light[[0, 1, -1]] = 10.0
    state = context.grid.nearest(12.0)
    frame = photograph(light, 9.0, state)
    evs = {
        name: _wanted_ev(make_policy(f"rpi_agc?constraint={name}&metering=spot", context), frame)
        for name in ("normal", "highlight", "shadows")
    }
    # 0.12 * 10 * 2^(9 - EV) = 0.8 of white.
    assert evs["highlight"] == pytest.approx(9.0 - math.log2(0.8 / 1.2), abs=0.03)
    # Of the darker half, 61 x 32 pixels have 0.12 * 0.2 / 8 of white, in the first bin of 128, and
    # 96 have 0.12 * 1.3 / 8, in the third: their mean shall be at 0.17.
    shade = (61 * 32 * 0.5 + 96 * 2.5) / 128 / 2048
    ev = context.grid.ev100[state]
    assert evs["shadows"] == pytest.approx(ev - math.log2(0.17 / shade), abs=0.01)
    assert evs["highlight"] > evs["normal"] > evs["shadows"]


def test_ladder_splits_as_published(context):
    policy = make_policy("rpi_agc", context)
    exposures = np.array([0.004, 0.010, 0.015, 0.05, 0.12, 0.3, 1.0, 4.0])
    # 100 us..10 ms at 1; gain to 2; to 30 ms; gain to 4; to 60 ms; gain to 6; to 66.666 ms; to 16.
    times = [0.004, 0.010, 0.010, 0.025, 0.030, 0.060, 0.066666, 0.066666]
    gains = [1.0, 1.0, 1.5, 2.0, 4.0, 5.0, 1.0 / 0.066666, 16.0]
    np.testing.assert_allclose(policy.agc.split(exposures), [times, gains], rtol=1e-6)
    short = make_policy("rpi_agc?mode=short", context).agc.split(np.array([0.008]))
    np.testing.assert_allclose(np.ravel(short), [0.005, 1.6])
    long = make_policy("rpi_agc?mode=long&max_gain=64", context).agc.split(np.array([9.0]))
    np.testing.assert_allclose(np.ravel(long), [0.12, 64.0])  # 7.68 s at most


def test_lamps_do_not_flicker_on_a_grid_with_other_shutters(context):
    """1/60 and 1/120 s would suit the exposure, but are no whole periods of 100 Hz."""
    grid = ExposureGrid((100, 200, 400, 800, 1600), (1 / 120, 1 / 100, 1 / 60, 1 / 50), (5.6, 8))
    other = dataclasses.replace(context, grid=grid)
    evs = np.linspace(6.0, 11.0, 40)
    used = {}
    for name in ("rpi_agc", "rpi_agc?flicker_period=0.01"):
        policy = make_policy(name, other)
        states = policy._utility(evs).argmax(axis=1)
        used[name] = {grid[int(s)].exposure_time for s in states}
        assert np.abs(grid.ev100[states] - evs).max() < 1.1
    assert used["rpi_agc"] & {1 / 120, 1 / 60}
    assert used["rpi_agc?flicker_period=0.01"] <= {1 / 100, 1 / 50, 1 / 120}


#: A tuning file of one's own: a corner is metered, at 0.2 in the dark and 0.4 from 100 lux on.
CORNER = {
    "metering_modes": {"cor-ner": {"weights": [0] * 11 + [1, 0, 0, 0]}},
    "exposure_modes": {"slow": {"shutter": [500, 1000000], "gain": [1.0, 5.0]}},
    "constraint_modes": {"none": []},
    "y_target": [0, 0.2, 100, 0.4],
    "base_ev": 0.5,
}
PISP = CORNER | {"metering_modes": {"corner": {"weights": [1.0] + [0] * 224}}}


@pytest.mark.parametrize("agc", [CORNER, {"channels": [CORNER, {}]}, PISP])
def test_a_tuning_file_decides(context, photograph, tmp_path, agc):
    entries = [{"rpi.awb": {}}, {"rpi.agc": agc}]
    (tmp_path / "own.json").write_text(json.dumps({"version": 2.0, "algorithms": entries}))
    policy = make_policy(f"rpi_agc?tuning={tmp_path}/own.json", context)
    light = np.full((64, 64), 3.0)
    side = 5 if agc is PISP else 11  # of 64 / 15 and 64 / 6 pixels
    light[:side, :side] = 1.0
    # 2.5 * 2^9 lux; half of 0.4.
    frame = photograph(light, 9.0, context.grid.nearest(9.0))
    assert _wanted_ev(policy, frame) == pytest.approx(9.0 - math.log2(0.2 / 0.12), abs=0.03)
    # 100 lux are not reached: between 0.2 and 0.4.
    frame = photograph(light, 4.0, context.grid.nearest(4.0))
    target = 0.5 * (0.2 + 0.2 * 2.5 * 2.0**4 / 100)
    assert _wanted_ev(policy, frame) == pytest.approx(4.0 - math.log2(target / 0.12), abs=0.03)
    splits = policy.agc.split(np.array([1e-4, 0.01, 3.0, 9.0]))
    np.testing.assert_allclose(splits, [[5e-4, 0.01, 1.0, 1.0], [1.0, 1.0, 3.0, 5.0]])
    capped = make_policy(f"rpi_agc?tuning={tmp_path}/own.json&iso_cap=200", context)
    assert np.ravel(capped.agc.split(np.array([9.0]))).tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    ("agc", "message"),
    [
        ({**CORNER, "y_target": [0, 0.2, 0, 0.3]}, r"own.json'\): rpi.agc.y_target"),
        ({**CORNER, "exposure_modes": {"a": {"gain": [1]}}}, r"modes.a.shutter: Field req"),
        ({"channels": [{**CORNER, "speed": 2}]}, r"rpi.agc.channels.0.speed \(=2\)"),
        ({**CORNER, "metering_modes": {"a": {"weights": [1] * 16}}}, "a.weights .* 15 or 225"),
        *[(None, "must have an entry 'rpi.agc'"), ({"channels": []}, "one of 'channels' if")],
        (CORNER, r"`mode` \(='short'\) must be one of 'slow'"),
    ],
)
def test_errors_of_a_tuning_file_name_it_and_the_entry(context, tmp_path, agc, message):
    (tmp_path / "own.json").write_text(json.dumps({"algorithms": [{"rpi.agc": agc}]}))
    with pytest.raises(ValueError, match=message):
        make_policy("rpi_agc", context, tuning=tmp_path / "own.json", mode="short")


#: Six of the 36 recordings, so that nothing else is needed.
OURS = Path(__file__).with_name("libcamera_traces.json")


def _played(recording, zone_factors):
    """Exposure times [s] and gains of ours in the light of a recording, which it does not see.

    Its settings take effect as the sensor's do: a time three frames after its decision, a gain two.
    """
    agc = LibcameraAgc(
        1,
        metering=recording["metering"].replace("-", "_"),
        constraint=recording["constraint"],
        ladder=IMX477.exposure_modes[recording["exposure_mode"]],
        max_exposure_time=66e-3,
        flicker_period=recording["flicker_period_us"] * 1e-6 or None,
    )
    pixels = np.repeat(np.array(zone_factors, float)[:, None], 1000, axis=1)
    if recording["scene"] == "highlights":
        pixels[:, :50] *= 8.0
    times, gains = [1e-3] * 3, [1.0] * 2
    for frame in range(len(recording["gain"])):
        time, gain = min(max(times[frame], 60e-6), 66e-3), gains[frame]
        light = recording["light"][frame >= recording["step_at"]]
        signals = np.minimum(light * pixels * time * gain, 1.0)
        zones, histogram = signals.mean(axis=1)[None], signal_histogram(signals.reshape(1, -1))
        asked = agc.split(agc.update(zones, histogram, np.array([time * gain])))
        for own, value in zip((times, gains), asked, strict=True):
            own.append(float(value[0]))
    count = len(recording["gain"])
    return np.clip(times[:count], 60e-6, 66e-3), np.array(gains[:count])


@pytest.mark.parametrize("every", [False, True])
def test_every_frame_is_libcameras(every: bool, request: pytest.FixtureRequest) -> None:
    """Within 0.1 %; asked are 2 % with two frames of grace, and a settling within a frame."""
    file = request.getfixturevalue("data_dir") / "libcamera_agc" / "traces.json" if every else OURS
    recordings = json.loads(file.read_text())
    assert len(recordings["traces"]) >= (36 if every else 6)
    for recording in recordings["traces"]:
        times, gains = _played(recording, recordings["meta"]["zone_factors"][recording["scene"]])
        wanted = np.array(recording["exposure_s"]), np.array(recording["gain"])
        np.testing.assert_allclose(times, wanted[0], rtol=1e-3)
        np.testing.assert_allclose(times * gains, wanted[0] * wanted[1], rtol=1e-3)
