from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from ae_env.grid import ExposureGrid
from agents.metering.programs import MeteringPolicy
from agents.metering.tuned import ScoreRegression
from agents.policy import PROGRAMS, make_policy

GREY = np.ones((64, 64))


def _run(policy, photograph, scene_ev, *, frames=5, start=0, masks=None, **blur):
    policy.reset(1, seed=0)
    state = np.array([start])
    path = []
    for _ in range(frames):
        state = policy.act(photograph(GREY, scene_ev, state, **blur), masks)
        path.append(int(state[0]))
    return path


@pytest.mark.parametrize("program", ["P", "A", "S"])
@pytest.mark.parametrize("scene_ev", [2.0, 6.0, 10.0, 14.0])
@pytest.mark.parametrize("start", [0, 63])
def test_programs_reach_the_ev_of_a_grey_card_and_stay(
    context, photograph, program, scene_ev, start
):
    policy = make_policy(f"average:{program}", context)
    path = _run(policy, photograph, scene_ev, start=start)
    reachable = context.grid.ev100
    if program == "S":  # 1/125 s alone reaches EV 5 to 14
        reachable = reachable[np.isclose([s.exposure_time for s in context.grid], 1 / 125)]
    elif program == "A":  # f/8 alone reaches some EVs less closely
        reachable = reachable[np.isclose([s.f_number for s in context.grid], 8.0)]
    nearest = np.abs(reachable - scene_ev).min()
    assert abs(context.grid.ev100[path[-1]] - scene_ev) < nearest + 0.25
    assert path[-1] == path[-2] == path[-3]


def test_priorities_are_kept(context, photograph):
    for ev in (3.0, 9.0, 15.0):
        aperture = _run(make_policy("spot:A", context), photograph, ev)
        shutter = _run(make_policy("spot:S", context), photograph, ev)
        assert {context.grid[s].f_number for s in aperture} == {8.0}
        assert {context.grid[s].exposure_time for s in shutter} == {1 / 125}


def test_aperture_priority_takes_an_option_and_raises_iso_only_against_shake(context, photograph):
    policy = make_policy("average:A", context, f_number=4.0)
    bright = context.grid[_run(policy, photograph, 11.0, speed=0.5)[-1]]
    assert (bright.f_number, bright.iso) == (4.0, 100.0)  # 1/125 s
    moving = context.grid[_run(policy, photograph, 5.0, speed=2.0)[-1]]
    steady = context.grid[_run(policy, photograph, 5.0, speed=0.0)[-1]]
    assert steady.iso < moving.iso
    assert steady.exposure_time > moving.exposure_time


def test_program_p_follows_the_sensors(context, photograph):
    def choose(ev, **blur):
        return context.grid[_run(make_policy("average:P", context), photograph, ev, **blur)[-1]]

    still, fast = (choose(7.0, speed=v, defocus=0.1) for v in (0.0, 4.0))
    assert fast.exposure_time < still.exposure_time
    sharp, deep = (choose(11.0, speed=0.0, defocus=d) for d in (0.1, 4.0))
    assert deep.f_number > sharp.f_number


def test_compensation_is_in_ev_and_positive_is_brighter(context, photograph):
    plain = _run(make_policy("average:P", context), photograph, 9.0)[-1]
    brighter = _run(make_policy("average:P", context, compensation=2.0), photograph, 9.0)[-1]
    assert context.grid.ev100[plain] - context.grid.ev100[brighter] == pytest.approx(2.0, abs=0.2)


@pytest.mark.parametrize("program", ["P", "A", "S"])
def test_masked_states_are_never_chosen(context, photograph, program):
    policy = make_policy(f"matrix:{program}", context)
    free = _run(policy, photograph, 8.0)
    masks = np.ones((1, len(context.grid)), bool)
    masks[0, free] = False
    assert not set(_run(policy, photograph, 8.0, masks=masks)) & set(free)


def _fitted(context, program="tuned"):
    """Best state = (ISO by EV, shutter by speed, aperture by defocus): known by construction."""
    rng = np.random.default_rng(0)
    features = np.stack(
        [rng.uniform(0, 16, 4000), rng.uniform(-9, 3, 4000), rng.uniform(-3, 3, 4000)], axis=1
    )
    best = _best_state(context.grid, features)
    scores = np.exp(-0.5 * (np.arange(64) != best[:, None]))
    columns = features if program == "tuned" else features[:, :1]
    return ScoreRegression(columns, scores, np.full(columns.shape[1], 0.3))


def _best_state(grid: ExposureGrid, features):
    iso = np.where(features[:, 0] > 8, 0, 3)
    time = np.where(features[:, 1] > -3, 0, 3)
    aperture = np.where(features[:, 2] > 0, 3, 0)
    return np.array([grid.index(*c) for c in zip(iso, time, aperture, strict=True)])


def test_tuned_program_uses_ev_speed_and_defocus(context, photograph, tmp_path):
    _fitted(context).save(tmp_path / "tuned.safetensors")
    policy = make_policy("average:tuned", context, weights=tmp_path / "tuned.safetensors")
    for ev, speed, defocus in ((12.0, 2.0, 4.0), (4.0, 0.004, 0.25), (12.0, 0.004, 4.0)):
        wanted = _best_state(context.grid, np.log2([[2.0**ev, speed, defocus]]))[0]
        path = _run(policy, photograph, ev, speed=speed, defocus=defocus, start=wanted)
        assert path[-1] == wanted


def test_tuned_needs_a_fit_and_the_same_readings(context, photograph, tmp_path):
    with pytest.raises(ValueError, match="call fit"):
        _run(make_policy("average:tuned", context), photograph, 8.0)
    with pytest.raises(ValueError, match="nothing to save"):
        make_policy("average:tuned", context).save(tmp_path / "x.safetensors")
    _fitted(context).save(tmp_path / "three.safetensors")
    blind = make_policy("average:tuned_blind", context, weights=tmp_path / "three.safetensors")
    with pytest.raises(ValueError, match="agree on `sensors`"):
        _run(blind, photograph, 8.0)


def test_sensors_are_averaged_over_the_frames(context, photograph):
    policy = MeteringPolicy(context, "average", "P")
    policy.reset(1)
    for speed in (0.5, 2.0, 1.0):
        readings = policy.observe(photograph(GREY, 8.0, 20, speed=speed, defocus=1.0))
    assert readings[0, 1] == pytest.approx(0.0, abs=1e-5)  # mean of -1, 1, 0 stops
    policy.reset(1)
    again = policy.observe(photograph(GREY, 8.0, 20, speed=0.5, defocus=1.0))
    assert again[0, 1] == pytest.approx(-1.0, abs=1e-5)


def test_arguments_are_checked(context):
    with pytest.raises(ValueError, match="`program`"):
        MeteringPolicy(context, "average", "X")
    with pytest.raises(ValueError, match="`f_number`"):
        MeteringPolicy(context, f_number=0.0)
    with pytest.raises(ValueError, match=r"`weights` \(='/no/file'\) cannot be read"):
        MeteringPolicy(context, "average", "tuned", weights="/no/file")
    for program in PROGRAMS:
        assert MeteringPolicy(context, "average", program).program == program


@pytest.mark.parametrize(
    ("name", "option"),
    [
        *[(f"spot:{p}", "f_number") for p in ("P", "S", "tuned", "tuned_blind")],
        *[(f"spot:{p}", "exposure_time") for p in ("P", "A", "tuned")],
        *[(f"spot:{p}", "iso") for p in ("P", "A", "S", "tuned")],
        *[(f"spot:{p}", "weights") for p in ("P", "A", "S", "M")],
        *[("rpi_agc:P", "exposure_time"), ("rpi_agc:A", "iso"), ("rpi_agc:M", "flicker_period")],
    ],
)
def test_options_of_other_programs_are_refused(context, name, option):
    with pytest.raises(ValueError, match=rf"`{option}` \(=4\) is an option of programs? .* only"):
        make_policy(f"{name}?{option}=4", context)


def test_a_policy_that_was_not_reset_says_so(context, photograph):
    frame = photograph(GREY, 9.0, [1, 2])
    for name in ("matrix:P", "shim:A", "rpi_agc"):
        policy = make_policy(name, context)
        with pytest.raises(ValueError, match=r"are of 2: call reset\(num_envs\) first"):
            policy.act(frame)


UNEVEN = ExposureGrid((100, 800), (1 / 4000, 1 / 500, 1 / 400, 1 / 30), (2.8, 16))


@pytest.mark.parametrize("program", ["P", "A", "S", "M"])
@pytest.mark.parametrize("grid", [ExposureGrid.default(), UNEVEN])
@pytest.mark.parametrize("masked", [False, True])
def test_highlights_have_a_ceiling_on_uneven_grids(context, photograph, program, grid, masked):
    """A frame-filling card at 0.12 * 2^d: never above 0.9 of white where a darker state is left."""
    policy = make_policy(f"highlight_weighted:{program}", dataclasses.replace(context, grid=grid))
    masks = np.random.default_rng(0).random((1, len(grid))) < (0.5 if masked else 2.0)
    allowed = policy._chooser._allowed & masks[0]  # by the program and the masks
    for scene_ev in np.arange(2.0, 16.0, 0.7):
        reading = scene_ev - np.log2(0.9 / 0.12)
        policy.reset(1)
        start = context.grid.nearest(scene_ev)
        for drift in (0.0, 0.1, -0.1):  # hysteresis must not lead above it
            frame = photograph(GREY, scene_ev + drift, start)
            chosen = grid.ev100[policy.act(frame, masks)[0]]
            darker = grid.ev100[allowed & (grid.ev100 > reading + 0.2)]
            if len(darker):
                assert chosen > reading + min(drift, 0.0) - 0.06  # half a code
                assert chosen <= darker.min() + 0.4 * policy._chooser.step
    assert allowed.any()


def test_p_keeps_a_state_while_the_sensors_waver(context):
    """Of two states of one exposure the better one may change with every look at the motion."""
    policy = make_policy("average:P", context)

    def choose(speed):
        readings = np.array([[7.0, speed, -1.0]])
        return int(policy._program_utility(readings).argmax())

    policy.reset(1)
    speeds = np.arange(-8.0, 3.0, 0.01)
    chosen = [choose(speed) for speed in speeds]
    borders = [s for s, (a, b) in zip(speeds, itertools.pairwise(chosen), strict=False) if a != b]
    assert len(borders) >= 2
    for border in borders:
        policy.reset(1)
        path = []
        for k in range(6):
            path.append(choose(border + (0.02 if k % 2 else -0.02)))
            policy._previous = np.array(path[-1:])
        assert len(set(path)) == 1


def test_compensation_moves_the_reading_of_a_tuned_program(context, photograph, tmp_path):
    """Above EV 8 the best ISO is 100, below 6400: at EV 9, 2 EV brighter is looked up at 7."""
    _fitted(context).save(tmp_path / "tuned.safetensors")
    weights = tmp_path / "tuned.safetensors"
    for compensation, iso in ((0.0, 100.0), (2.0, 6400.0)):
        policy = make_policy("average:tuned", context, weights=weights, compensation=compensation)
        path = _run(policy, photograph, 9.0, speed=2.0, defocus=4.0, start=20)
        assert context.grid[path[-1]].iso == iso


def test_shutter_cap_holds_in_a_tuned_program(context, photograph, tmp_path):
    _fitted(context).save(tmp_path / "tuned.safetensors")
    policy = make_policy(
        "average:tuned?shutter_cap=1/100", context, weights=tmp_path / "tuned.safetensors"
    )
    path = _run(policy, photograph, 4.0, speed=0.004, defocus=0.25)  # the best is 1/2 s
    assert all(context.grid[s].exposure_time <= 1 / 100 for s in path)
