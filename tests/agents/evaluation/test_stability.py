"""Loops of control: against roots of their polynomials, gaps by hand, and settling as published."""

import json

import numpy as np
import pandas as pd
import pytest

from agents.evaluation import stability
from agents.evaluation.stability import CENTRE_EV, DELAYS, FAULTS, Cases, Proportional, Request
from agents.policy_names import METERS


def cases(*columns):
    """Cases from fault, delay, gain [stops], step and light, of which scalars are repeated."""
    return Cases(*map(np.array, np.broadcast_arrays(np.zeros(1, int), *columns)[1:]))


def test_a_proportional_law_oscillates_from_the_gain_on_at_which_a_root_leaves_the_circle():
    """Without fault and anchor e[n + 1] = e[n] - K e[n - d]; near the limit a period is 4 d + 2."""
    law = Proportional(1.0)
    for delay in DELAYS:
        limit = stability.gain_limit(law, delay)
        for factor, stable in ((0.99, True), (1.01, False)):
            polynomial = np.array([1.0, -1.0, *[0.0] * (delay + 1)])
            polynomial[delay + 1] += factor * limit
            assert (np.abs(np.roots(polynomial[: delay + 2])).max() < 1.0) == stable
    assert 6.5 * stability.gain_limit(law, 6) == pytest.approx(np.pi / 2, rel=0.01)
    delays = np.repeat(DELAYS, 2)
    limits = [stability.gain_limit(law, delay) for delay in delays]
    gains = np.log2(limits * np.tile([0.98, 1.02], 7))
    evs = stability.run_loop(law, cases(0, delays, gains, 1.0, CENTRE_EV), 4000)
    amplitude, period = stability.limit_cycles(evs[:, -2000:])
    assert (amplitude > 0).tolist() == [False, True] * 7
    np.testing.assert_allclose(period[1::2], 4.0 * np.array(DELAYS) + 2.0, rtol=0.07)


def test_a_law_that_counts_from_the_frame_is_stable_up_to_a_gain_of_two_at_every_delay():
    """Its errors are e[n + 1] = (1 - K) e[n - d]."""
    law, gains = Proportional(1.0, anchored=True), np.log2([1.9, 2.1])
    grid = cases(0, np.repeat(DELAYS, 2), np.tile(gains, 7), 1.0, CENTRE_EV)
    amplitude, _ = stability.limit_cycles(stability.run_loop(law, grid, 1000)[:, -500:])
    assert (amplitude > 0).tolist() == [False, True] * 7


def test_no_exposure_fits_where_the_gain_does_not_make_up_for_whole_periods():
    """From 10 to 20 ms a gain of 1 stop is 0.85: from EV100 9.64 up, 0.15 EV are out of reach."""
    gap = 4.0 - np.log2(0.02), 4.0 - np.log2(0.01) - 0.85
    for fault, dead_zone, pulses in (
        ("banding and gain", 0.0, True),
        ("banding and gain", 0.1, False),  # the gap is 0.075 EV to either side
        ("banding", 0.0, False),
        ("gain", 0.0, False),
    ):
        end = cases(FAULTS.index(fault), 0, 0.0, 1.0, np.mean(gap) - 0.5)
        evs = stability.run_loop(Proportional(0.5, dead_zone), end)
        (amplitude,), _ = stability.limit_cycles(evs[:, -80:])
        assert (amplitude > 0.0) == pulses
        assert not pulses or 0.15 <= amplitude <= 0.15 * 1.5


def test_faults_by_hand():
    for fault, seconds, gain, shown, made_up, stops in (
        ("none", 1 / 60, 3.0, 1 / 60, 3.0, 3.0),
        ("gain", 1 / 60, 2.0, 1 / 60, 2.0, 1.7),
        ("lines", 1 / 1000, 0.0, 8 / 8192, 0.0, 0.0),
        ("banding", 0.025, 1.0, 0.02, 1.0 + np.log2(1.25), 1.0 + np.log2(1.25)),
        ("banding", 0.009, 1.0, 0.009, 1.0, 1.0),  # shorter than a period
        ("banding and gain", 0.02, 1.0, 0.02, 1.0, 0.85),
    ):
        asked, one = Request(np.log2([seconds]), np.array([gain])), FAULTS.index(fault)
        found, ev = stability.carry_out(asked, cases(one, 0, 0.0, 0.0, 0.0))
        expected = [[np.log2(shown)], [made_up], [4.0 - np.log2(shown) - stops]]
        np.testing.assert_allclose([*found, ev], expected)


def test_cycles_last_and_repeat():
    n = np.arange(80.0)
    curves = [0.5 * np.sin(2 * np.pi * n / 12), (n % 3 == 0) * 0.2, (-1.0) ** n]
    # It decays, drifts, rests; it swings irregularly.
    curves += [0.97**n * np.sin(n), 0.01 * n, 0.01 * (-1.0) ** n]
    curves += [np.random.default_rng(0).normal(size=80)]
    amplitude, period = stability.limit_cycles(np.array(curves))
    np.testing.assert_allclose(amplitude[:6], [1.0, 0.2, 2.0, 0.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(period, [12, 3, 2, *[np.nan] * 4])
    assert amplitude[6] > 1.0


def test_policies_see_the_frames_of_a_camera():
    """libcamera's filter leaves 0.8 of a (linear) distance; a policy without one needs two looks;
    meters come to rest with a long delay."""
    ends = cases(0, 0, 0.0, [4.0, -4.0], CENTRE_EV)
    agc = stability.run_loop(stability.make_controller("rpi_agc?max_gain=64"), ends)
    within = np.array([2 ** (1 / 3) - 1, 16 * (1 - 2 ** (-1 / 3))])  # 1/3 EV of 1, and of 16
    frames = np.log(within / 15) / np.log(0.8)
    np.testing.assert_allclose(stability.measure(ends, agc).settling, frames, atol=2)
    names = ("examples/my_policy.py:HalfGrey", *(f"{name}:P" for name in METERS))
    for name, delay in ((names[0], 0), *((name, 3) for name in names)):
        controller = stability.make_controller(name, delay)
        ends = cases(0, delay, 0.0, [4.0, -4.0], CENTRE_EV)
        found = stability.measure(ends, stability.run_loop(controller, ends, 80))
        assert found.settling.max() <= (2 * (1 + delay) if name == names[0] else 40)
        assert found.amplitude.max() == 0.0
        assert found.error.abs().max() < 1 / 3 or name in ("zhang:P", "shim:P", "entropy:P")


def test_what_a_law_comes_to(ae_env, tmp_path):
    code, text, error = ae_env("stability", "proportional:1", "--out", tmp_path / "a", "--seed", 1)
    assert (code, error) == (0, "")
    assert "with up to 1 frame" not in text  # at a delay of 1 the limit is 1: it oscillates
    assert "It settles after every step with no delay." in text
    content = json.loads((tmp_path / "a" / "results.json").read_text())
    rows = pd.DataFrame(content["rows"])
    assert len(rows) == len(FAULTS) * len(DELAYS)
    assert (tmp_path / "a" / "proportional_1.png").stat().st_size > 5000
    sound = rows[rows.fault == "none"].set_index("delay")
    theory = np.log2(2.0 * np.sin(np.pi / (4.0 * np.arange(7) + 2.0)))
    np.testing.assert_allclose(sound.analytic, theory)
    assert sound.gain_margin[0] == pytest.approx(theory[0], abs=0.126)  # eighths of a stop
    assert sound.settled.tolist() == [1.0, *[0.0] * 6]
