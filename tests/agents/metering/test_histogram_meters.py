import math

import numpy as np
import pytest

from agents.metering import meters as histogram_meters
from agents.metering.meters import make_meter

GREY = np.ones((64, 64))


def _srgb(x):
    return 12.92 * x if x <= 0.0031308 else 1.055 * x ** (1 / 2.4) - 0.055


def _linear(z):
    return z / 12.92 if z <= 0.04045 else ((z + 0.055) / 1.055) ** 2.4


def test_highlights_are_exposed_to_nine_tenths_of_white(context, photograph):
    light = GREY.copy()
    light.flat[: int(0.02 * light.size)] = 4.0  # 2 % of the pixels are highlights
    light.flat[int(0.02 * light.size) + 1] = 30.0  # and one a lamp, which does not count
    state = context.grid.nearest(9.0)
    reading = make_meter("highlight_weighted", context.camera)(photograph(light, 9.0, state))
    # 0.12 * 4 at EV 9; 0.9 at 9 + log2(0.48 / 0.9).
    assert reading.ev100[0] == pytest.approx(9.0 + math.log2(0.48 / 0.9), abs=0.03)
    assert reading.saturated[0] == 0.0


def test_the_brightest_plane_of_each_pixel_counts_in_every_frame(context, photograph):
    light = np.ones((4, 64, 64))
    light[3, :8] = 5.0  # blue, an eighth of the frame
    state = context.grid.nearest(9.0)
    frame = photograph(light, 9.0, [state, state])
    reading = make_meter("highlight_weighted", context.camera)(frame)
    np.testing.assert_allclose(reading.ev100, [9.0 + math.log2(0.6 / 0.9)] * 2, atol=0.03)
    assert reading.black.tolist() == [False, False]
    dark = photograph(GREY, -6.0, context.grid.nearest(17.0))
    assert make_meter("highlight_weighted", context.camera)(dark).black.tolist() == [True]


def test_blown_highlights_read_brighter_than_they_show(context, photograph):
    light = GREY.copy()
    light[:4] = 100.0
    state = context.grid.nearest(9.0)
    reading = make_meter("highlight_weighted", context.camera)(photograph(light, 9.0, state))
    share = 4 / 64
    step = 3.0 * (0.51 + 0.49 * share)
    ev = context.grid.ev100[state]
    assert reading.ev100[0] == pytest.approx(ev + math.log2(1.0 / 0.9) + step, abs=0.02)


def test_skewness_reads_the_incident_ev_of_a_grey_card(context, photograph):
    states = [context.grid.nearest(ev) for ev in (8.0, 9.0, 10.0)]
    reading = make_meter("skewness", context.camera)(photograph(GREY, 9.0, states))
    np.testing.assert_allclose(reading.ev100, 9.0, atol=0.06)


def test_skewness_balances_two_levels_about_mid_grey(context, photograph):
    """Half of the pixels 0.2 of the code below mid-grey, half as much above."""
    middle = _srgb(0.18)
    levels = [_linear(middle - 0.2) / 0.18, _linear(middle + 0.2) / 0.18]
    light = np.where(np.arange(64)[:, None] < 32, *levels) * np.ones((64, 64))
    for ev in (9.0, 10.0, 11.0):
        frame = photograph(light, 9.0, context.grid.nearest(ev))
        reading = make_meter("skewness", context.camera)(frame)
        assert reading.ev100[0] == pytest.approx(9.0, abs=0.08)


def test_entropy_finds_the_exposure_of_the_highest_entropy(context, photograph):
    """An sRGB ramp up to a level: all 256 greys are equally frequent where the top is white."""
    top = 0.35
    codes = (np.arange(4096) + 0.5) / 4096
    light = np.array([_linear(z) for z in codes]).reshape(64, 64) * top / 0.12
    state = context.grid.nearest(9.0)
    reading = make_meter("entropy", context.camera)(photograph(light, 9.0, state))
    # The frame has its top at 0.35 at EV 9, so at 1 at 9 - log2(1 / 0.35).
    assert reading.ev100[0] == pytest.approx(9.0 + math.log2(top), abs=0.15)


def test_simulated_histogram_is_that_of_the_exposed_frame():
    """A uniform density of the signal is uniform in linear light at every exposure."""
    codes = np.arange(256)
    edges = (np.clip(codes[:, None] + [-0.5, 0.5], 0, 255) / 255.0) ** 2 * (1 + 1 / 1024) - 1 / 1024
    shares = np.diff(np.clip(edges, 0.0, 1.0), axis=1)[:, 0]
    moved = histogram_meters._exposed(shares[None], np.array([-1.0, 0.0, 1.0]))[0]
    assert moved.shape == (3, 256)
    assert moved.sum(axis=1) == pytest.approx(1.0)
    share = moved[:, 128:].sum(axis=1)  # above half of the code: signal above 0.214
    border = _linear(0.5)
    assert share[1] == pytest.approx(1.0 - border, abs=5e-4)
    assert share[2] == pytest.approx(1.0 - border / 2, abs=5e-4)
    assert share[0] == pytest.approx(1.0 - border * 2, abs=1e-3)  # white lies at 0.5 there


def test_saturated_pixels_add_to_what_a_search_finds():
    shares = np.zeros((2, 256))
    shares[0, [100, 255]] = 0.75, 0.25
    shares[1, 0] = 1.0
    found = histogram_meters._search_reading(shares, np.array([8.0, 8.0]), np.array([-1.0, 2.0]))
    assert found.ev100.tolist() == [9.0 + 0.25 * 3.0, 6.0]
    assert found.saturated.tolist() == [0.25, 0.0]
    assert found.black.tolist() == [False, True]


def test_peak_is_the_top_of_a_parabola():
    x = np.arange(-3.0, 3.01, 0.5)
    tops = (0.7, -1.2, -3.2, 3.2)  # the last two lie beyond the ends
    values = np.stack([*(-((x - top) ** 2) for top in tops), x, np.zeros_like(x)])
    np.testing.assert_allclose(histogram_meters.peak(values, x), [0.7, -1.2, -3, 3, 3, 0])
