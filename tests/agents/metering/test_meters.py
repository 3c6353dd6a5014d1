from __future__ import annotations

import math

import numpy as np
import pytest

from ae_env.observation import decode_observation
from agents.metering.ev_tracker import EVTracker
from agents.metering.meters import make_meter, weight_map
from agents.metering.reading import GREEN, Reading, linear_signal
from agents.policy import METERS

GREY = np.ones((64, 64))


@pytest.mark.parametrize("compensation", [0.0, 3.0])
def test_damping_does_not_wind_up_in_the_dark(compensation):
    """A range of 0 to 10: of 40 frames that read -9, at most the last one counts beyond it."""
    tracker = EVTracker(1, (0.0, 10.0), 0.5, compensation)

    def read(ev):
        return Reading(np.array([ev]), np.zeros(1), np.zeros(1, bool))

    for _ in range(40):
        tracker.update(read(-9.0))
    low = compensation
    # 0.5 * -9 + 0.5 * low in the dark; that is clipped to low, and half of the way to 8 is left.
    assert tracker.damped[0] == pytest.approx(0.5 * (low - 9.0))
    assert tracker.update(read(8.0))[0] == pytest.approx(0.5 * (low + 8.0))


@pytest.mark.parametrize("name", ["average", "centre_weighted", "spot"])
def test_a_grey_card_reads_the_incident_ev(context, photograph, name):
    states = [int(np.argmin(np.abs(context.grid.ev100 - ev))) for ev in (7.0, 8.0, 9.0, 10.0)]
    reading = make_meter(name, context.camera)(photograph(GREY, 9.0, states))
    np.testing.assert_allclose(reading.ev100, 9.0, atol=0.06)  # half a code of the observation
    assert not reading.saturated.any()
    assert not reading.black.any()


@pytest.mark.parametrize("name", [m for m in METERS if m not in ("shim", "zhang")])
def test_twice_the_light_reads_one_ev_more(context, photograph, name):
    state = context.grid.nearest(9.0)
    light = np.linspace(0.5, 2.0, 64)[:, None] * np.linspace(0.7, 1.3, 64)[None]
    meter = make_meter(name, context.camera)
    dim, bright = (meter(photograph(light, ev, state)).ev100[0] for ev in (8.0, 9.0))
    assert bright - dim == pytest.approx(1.0, abs=0.03)


def test_weighted_mean_matches_a_direct_sum(context, photograph):
    rng = np.random.default_rng(0)
    light = rng.uniform(0.2, 3.0, (64, 64))
    state = context.grid.nearest(9.0)
    frame = photograph(light, 9.0, state)
    signal = 0.12 * light * 2.0 ** (9.0 - context.grid.ev100[state])
    y, x = np.mgrid[:64, :64]
    inside = np.hypot(x - 31.5, y - 31.5) <= 16
    mean = 0.75 * signal[inside].mean() + 0.25 * signal[~inside].mean()
    expected = context.grid.ev100[state] + math.log2(mean / 0.12)
    reading = make_meter("centre_weighted", context.camera)(frame)
    assert reading.ev100[0] == pytest.approx(expected, abs=0.02)


def test_weights_sum_to_one_and_spot_covers_four_percent():
    for name in ("average", "centre_weighted", "spot"):
        assert weight_map(name, 48, 64).sum() == pytest.approx(1.0, abs=1e-5)
    assert (weight_map("spot", 128, 128) > 0).mean() == pytest.approx(0.04, abs=0.002)


def test_matrix_holds_a_lit_figure_in_the_dark_where_the_average_burns_it(context, photograph):
    light = np.full((64, 64), 0.02)
    light[24:40, 24:40] = 1.0  # the subject, lit at EV 8
    frame = photograph(light, 8.0, context.grid.nearest(8.0))
    average = make_meter("average", context.camera)(frame).ev100[0]
    matrix = make_meter("matrix", context.camera)(frame).ev100[0]
    assert average < 8.0 - 3.0  # mean light 0.08
    assert abs(matrix - 8.0) < abs(average - 8.0) - 0.5


def test_matrix_lifts_snow(context, photograph):
    snow = np.full((64, 64), 4.5)  # 81 % reflectance
    frame = photograph(snow, 14.0, context.grid.nearest(16.0))
    average = make_meter("average", context.camera)(frame).ev100[0]
    matrix = make_meter("matrix", context.camera)(frame).ev100[0]
    assert average == pytest.approx(14.0 + math.log2(4.5), abs=0.05)
    assert 14.0 <= matrix < average - 1.0


def test_clipped_frames_are_lower_bounds_and_black_ones_upper_bounds(context, photograph):
    bright, dark = context.grid.nearest(-1.0), context.grid.nearest(17.0)
    meter = make_meter("average", context.camera)
    white = meter(photograph(GREY, 15.0, bright))
    assert white.saturated[0] == 1.0
    assert context.grid.ev100[bright] + 3 < white.ev100[0] < 15.0
    black = meter(photograph(GREY, -1.0, dark))
    assert black.black[0]
    assert -1.0 < black.ev100[0] < context.grid.ev100[dark] - 8


def test_every_kind_of_observation_gives_the_same_signal(context, photograph):
    frame = photograph(GREY * 2, 9.0, context.grid.nearest(9.0))
    signal = decode_observation(frame["raw"])
    span = np.array(context.camera.span)[:, None, None]
    black = np.array(context.camera.black_level)[:, None, None]
    numbers = np.rint(signal * span + black).astype(np.uint16)
    green = GREEN
    for raw in (frame["raw"], signal, numbers):
        found = linear_signal(raw, context.camera, green)
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, signal[:, 1:3], atol=1e-4)


@pytest.mark.parametrize("name", METERS)
def test_every_kind_of_observation_reads_the_same(context, photograph, name):
    light = np.geomspace(0.2, 3.0, 64)[None] * np.ones((64, 1))
    frame = photograph(light, 9.0, context.grid.nearest(9.0))
    signal = decode_observation(frame["raw"])
    span = np.array(context.camera.span)[:, None, None]
    black = np.array(context.camera.black_level)[:, None, None]
    numbers = np.rint(signal * span + black).astype(np.uint16)
    meter = make_meter(name, context.camera)
    found = [meter({**frame, "raw": raw}).ev100[0] for raw in (frame["raw"], signal, numbers)]
    np.testing.assert_allclose(found, found[0], atol=0.03)


def _reading(ev, saturated=0.0, black=False):
    return Reading(np.array([ev]), np.array([saturated]), np.array([black]))


def test_tracker_jumps_far_averages_near_and_respects_bounds():
    tracker = EVTracker(1, (-1.0, 17.0))
    assert tracker.update(_reading(8.0))[0] == 8.0
    assert tracker.update(_reading(8.5))[0] == 8.25
    assert tracker.update(_reading(12.0))[0] == 12.0
    assert tracker.update(_reading(9.0, saturated=0.8))[0] == 12.0  # 12 is above the bound
    assert tracker.update(_reading(13.0, black=True))[0] == 12.0  # and below this one
    assert tracker.update(_reading(16.0, saturated=0.8))[0] == 16.0  # 12 is below 16 - 2.4
    assert tracker.update(_reading(5.0, black=True))[0] == 2.0  # half of the way to -1


def test_tracker_goes_halfway_to_the_end_from_an_unreadable_frame():
    white = EVTracker(1, (-1.0, 17.0)).update(_reading(9.0, saturated=1.0))
    assert white[0] == pytest.approx(0.5 * (9.0 - 3.0 + 17.0))
    black = EVTracker(1, (-1.0, 17.0)).update(_reading(3.0, black=True))
    assert black[0] == pytest.approx(1.0)


def test_damping_keeps_its_share_of_the_distance_in_ev():
    tracker = EVTracker(1, (-1.0, 17.0), damping=0.75)
    assert tracker.update(_reading(4.0))[0] == 4.0  # nothing to keep yet
    found = [tracker.update(_reading(12.0))[0] for _ in range(6)]
    np.testing.assert_allclose(found, [12.0 - 8.0 * 0.75**n for n in range(1, 7)])


@pytest.mark.parametrize("damping", [1.0, -0.1, float("nan"), "half", True])
def test_damping_must_let_something_move(damping):
    with pytest.raises(ValueError, match=r"`damping` \(="):
        EVTracker(1, (-1.0, 17.0), damping=damping)


def test_unknown_meter_names_the_nearest():
    with pytest.raises(ValueError, match=r"`meter` \(='matric'\).*did you mean 'matrix'"):
        make_meter("matric", None)
