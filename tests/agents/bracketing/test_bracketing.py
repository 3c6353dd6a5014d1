"""Schedules, and the policies that follow them."""

import functools
import itertools
import math

import numpy as np
import pytest
import torch

from ae_env import ExposureGrid
from ae_env.merging import log_error, merge
from ae_env.observation import encode_sensors
from ae_env.utils.user_files import UserCodeError
from agents.bracketing import policies as brackets
from agents.bracketing.policies import BINS, FixedBracket, Schedules, run_brackets
from agents.policy import BracketLimits, Policy, PolicyContext
from agents.policy_names import make_policy
from simulator.camera import get_camera
from tests.ae_env import environments

CAMERA = get_camera("nikon_z6")
GRID = ExposureGrid((100, 1600), (1 / 1000, 1 / 60, 1 / 4), (4,))
LIMITS = BracketLimits(budget=0.3, max_frames=2, box_factor=4)

TASK = {"task": "ae_env/ExposureBracket-v0", "autoreset_mode": "DISABLED"}
make_envs = functools.partial(environments.make_envs, **TASK)


def test_every_schedule_that_fits_is_there_once() -> None:
    """By hand, each pair and each single state whose time is at most 0.3 s."""
    schedules = Schedules(GRID, CAMERA, LIMITS)
    times = [1 / 1000, 1 / 60, 1 / 4] * 2
    expected = [(-1, -1)] + [(s, -1) for s in range(6)]
    for pair in itertools.combinations_with_replacement(range(6), 2):
        if times[pair[0]] + times[pair[1]] + 1 / 60 <= 0.3:
            expected.append(pair)
    assert sorted(map(tuple, schedules.states.tolist())) == sorted(expected)
    # With 1/60 s taken, and 0.26 s left: what holds it and needs no more.
    fits = schedules.completions(np.array([1]), 0.26)
    found = {tuple(row) for row in schedules.states[fits].tolist()}
    assert found == {(1, -1), *((min(1, s), max(1, s)) for s in range(6))}
    fits = schedules.completions(np.array([1]), 0.1)
    assert {tuple(r) for r in schedules.states[fits].tolist()} == found - {(1, 2), (1, 5)}


def test_expected_errors_are_those_of_merged_frames() -> None:
    """Against the environment's own merging of 10,000 noisy samples in four lights."""
    schedules = Schedules(GRID, CAMERA, LIMITS)
    reference, floor = 6.0, -6.0
    generator = torch.Generator().manual_seed(1)
    for states in ((0, -1), (1, 3), (2, 3)):
        row = schedules.states.tolist().index(list(states))
        chosen = [GRID[s] for s in states if s >= 0]
        gains = torch.tensor([[2.0**s.log2_exposure for s in chosen]])
        nlfs = [CAMERA.nlf(s.iso).scaled(1 / 16) for s in chosen]
        values = ([n.shot for n in nlfs], [n.read for n in nlfs])
        noise = [torch.tensor([[[np.mean(v)] * 4 for v in each]]) for each in values]
        expected = schedules.noise_error(reference, floor)[row]
        for place in (18, 28, 34, 44):
            light = 2.0 ** float(BINS[place] + reference)
            mean = (gains * light)[:, :, None, None, None].expand(1, -1, 4, 50, 50)
            variance = noise[0][..., None, None] * mean + noise[1][..., None, None]
            draws = torch.randn(mean.shape, generator=generator)
            signals = (mean + variance.sqrt() * draws).clamp(max=1.0).float()
            merged = merge(signals, gains, noise[0], noise[1])
            truth = torch.full((1, 4, 50, 50), light)
            error = log_error(*merged, truth, torch.tensor([2.0**floor]))
            deviation = float(error.std()) / math.sqrt(error.numel())
            # Five standard errors; eleven quantiles cut the tails of the noise off by 4 %.
            wanted = float(expected[place])
            bound = 5 * deviation + 0.05 * wanted + 1e-4
            assert float(error.mean()) == pytest.approx(wanted, abs=bound)


def test_fixed_steps_around_the_metered_state() -> None:
    """EV100 10 metered: 1/60 s at ISO 100; +-4 EV are 1/1000 s and 1/4 s, in 0.301 s together."""
    context = PolicyContext.from_envs(make_envs(4, budget=0.31))
    policy, grid = FixedBracket(context, step=4), context.grid
    wanted = policy._plan(np.array([grid.ev100[grid.index(0, 3, 0)] + d for d in (0, 4, -4)]))
    assert wanted.tolist() == [grid.index(0, 3, 0), grid.index(0, 1, 0), grid.index(0, 5, 0)]
    short = FixedBracket(PolicyContext.from_envs(make_envs(4, budget=0.1)), step=4)
    chosen = short._plan(np.array([10.0, 14.0, 6.0]))
    times = [grid[int(s)].exposure_time for s in chosen]
    assert sum(times) + 2 / 60 <= 0.1
    np.testing.assert_allclose(grid.ev100[chosen], [10.0, 14.0, 6.0], atol=0.2)


def test_hasinoff_takes_the_largest_ratio_in_the_worst_light() -> None:
    """A scene of two lights, 12 stops apart: over all schedules, tried one by one."""
    envs = make_envs(1)
    context = PolicyContext.from_envs(envs)
    policy = make_policy("bracket:hasinoff?headroom=0&longest=1/4", context)
    policy.reset(1)
    policy._range = lambda camera: (1.0, 13.0)  # log2 of the luminances
    policy._reference[0] = 8.0
    policy._frames[0] = [(0, np.zeros((4, 36, 36), np.uint8))]
    first = policy.choose(0, 0.3, 0.0)
    lights = 2.0 ** np.arange(1.0, 13.01, 0.5)
    precisions = []
    for s in context.grid:
        nlf, gain = CAMERA.nlf(s.iso).scaled(1 / 16), 2.0**s.log2_exposure
        shown = np.where(gain * lights < 0.97, gain**2, 0.0)
        precisions.append(shown / (np.mean(nlf.shot) * gain * lights + np.mean(nlf.read)))

    def worst(states):
        return float((lights * np.sqrt(sum(precisions[s] for s in states))).min())

    every = (itertools.combinations_with_replacement(range(24), count) for count in (1, 2, 3))
    times = [s.exposure_time + 1 / 60 for s in context.grid]  # there is a gap after each but one
    fits = [s for s in itertools.chain(*every) if sum(times[i] for i in s) <= 0.3 + 1 / 60]
    chosen = max(fits, key=worst)
    plan = policy.schedules.states[policy._plans[0]]
    assert sorted(s for s in plan.tolist() if s >= 0) == sorted(chosen)
    assert first in chosen


def test_what_frames_show_is_counted_by_hand() -> None:
    light = np.array([1.0, 4.0, 4.0, 0.0, 0.01])
    precision = np.array([100.0, 100.0, 100.0, 0.0, 1.0])  # white where 0; the last is noise
    found = brackets.light_shares(light, precision, limit=6.0, reference=2.0)
    # Clear, and noisy at its standard deviation, 1; clear twice; white.
    assert dict(zip(BINS[found > 0], found[found > 0], strict=True)) == {-2: 0.4, 0: 0.4, 4: 0.2}


def test_only_the_planner_that_knows_blur_shortens_the_exposures_of_a_shaken_camera() -> None:
    envs = make_envs(8)
    context, (observations, _) = PolicyContext.from_envs(envs), envs.reset(seed=1)
    shaken = encode_sensors(np.full(8, 2.0), np.zeros(8), np.zeros((8, 2)))
    times = np.array([*(s.exposure_time for s in context.grid), 0.0])
    longest = {}
    for name in ("bracket", "bracket:planned"):
        policy = make_policy(name, context)
        policy.reset(8)
        longest[name] = times[policy.act({**observations, "sensors": shaken})]
    assert (longest["bracket"] <= longest["bracket:planned"]).all()
    assert longest["bracket"].mean() < 0.5 * longest["bracket:planned"].mean()


def test_the_agent_that_ships_is_ahead_of_the_schedule_on_unseen_scenes() -> None:
    envs = make_envs(16, split="test", resolution=64)
    context = PolicyContext.from_envs(envs)
    schedule = make_policy("bracket:hasinoff?headroom=6&longest=1/15", context)
    policies = make_policy("bracket", context), schedule
    ours, theirs = (run_brackets(p, envs, count=1)["quality"].mean() for p in policies)
    assert ours > theirs


def test_mistakes_are_named() -> None:
    context = PolicyContext.from_envs(make_envs(4))
    other = PolicyContext(context.grid, context.camera, context.observation_space)
    statistics = PolicyContext.from_envs(make_envs(4, observation="statistics"))
    for name, where, message in (
        ("bracket", other, "ExposureBracket-v0"),
        ("bracket:planned", statistics, "`observation`='uint8'"),
        ("bracket:fixed?step=-1", context, "`step`"),
    ):
        with pytest.raises(ValueError, match=message):
            make_policy(name, where)
    schedule = make_policy("bracket:hasinoff", context)
    schedule.reset(4)
    with pytest.raises(ValueError, match="fit"):
        schedule.act(make_envs(4).reset(seed=0)[0])
    policy = Policy(context)
    policy.act = lambda observations, masks=None: np.full(4, 999)
    with pytest.raises(UserCodeError, match=r"'mine': state 999 is not in \[0, 25\)"):
        run_brackets(policy, make_envs(4), name="mine")
