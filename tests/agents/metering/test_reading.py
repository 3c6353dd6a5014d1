"""What the readings of several frames say together."""

import numpy as np
import pytest

from agents.metering.meters import make_meter
from agents.metering.reading import (
    EVTracker,
    Reading,
    ReferenceFrames,
    ZoneMatcher,
    frame_ev100,
    light_change,
    zone_signals,
)

#: Stripes from 5 stops below to 2 stops above a grey card, and a flat one.
STRIPES = np.repeat(2.0 ** np.linspace(-5.0, 2.0, 16), 4)[None, :] * np.ones((64, 1))
RAMP = np.geomspace(0.1, 6.0, 64)[None] * np.ones((64, 1))


def _reading(ev, saturated=0.0, black=False):
    return Reading(np.array([ev]), np.array([saturated]), np.array([black]))


def _match(matcher, reading, frame, camera):
    return matcher.match(reading, zone_signals(frame["raw"], camera), frame_ev100(frame))


def test_tracker_jumps_far_averages_near_and_respects_bounds():
    tracker = EVTracker(1, (-1.0, 17.0))
    assert tracker.update(_reading(8.0))[0] == 8.0
    assert tracker.update(_reading(8.5))[0] == 8.25
    assert tracker.update(_reading(12.0))[0] == 12.0
    assert tracker.update(_reading(9.0, saturated=0.8))[0] == 12.0  # 12 is above the bound
    assert tracker.update(_reading(13.0, black=True))[0] == 12.0  # and below this one
    assert tracker.update(_reading(16.0, saturated=0.8))[0] == 16.0  # 12 is below 16 - 2.4
    assert tracker.update(_reading(5.0, black=True))[0] == 2.0  # half of the way to -1
    white = EVTracker(1, (-1.0, 17.0)).update(_reading(9.0, saturated=1.0))
    assert white[0] == 0.5 * (9.0 - 3.0 + 17.0)


def test_damping_keeps_its_share_of_the_distance_in_ev():
    tracker = EVTracker(1, (-1.0, 17.0), damping=0.75)
    assert tracker.update(_reading(4.0))[0] == 4.0  # nothing to keep yet
    found = [tracker.update(_reading(12.0))[0] for _ in range(6)]
    np.testing.assert_allclose(found, [12.0 - 8.0 * 0.75**n for n in range(1, 7)])


def _kept(reference, observations):
    return frame_ev100(reference.update(observations))[0]


def test_the_brightest_frame_that_hides_nothing_is_kept(context, photograph):
    grid = context.grid
    dark, fair, bright = (grid.nearest(ev) for ev in (13.0, 10.0, 6.0))
    reference = ReferenceFrames(context.camera)
    for state, best in ((dark, dark), (fair, fair), (bright, fair), (dark, fair), (fair, fair)):
        found = _kept(reference, photograph(RAMP, 9.0, state))
        assert abs(found - grid.ev100[best]) < 0.05


def test_another_light_is_noticed_at_once(context, photograph):
    grid = context.grid
    for change in (-6.0, -4.0, -1.0, 1.0, 4.0):
        reference = ReferenceFrames(context.camera)
        _kept(reference, photograph(RAMP, 9.0, grid.nearest(9.0)))
        later = photograph(RAMP, 9.0 + change, grid.nearest(11.0))
        assert abs(_kept(reference, later) - grid.ev100[grid.nearest(11.0)]) < 0.05


@pytest.mark.parametrize("stops", [4.0, 3.0, -2.0])
def test_a_jump_is_read_from_the_shadows(context, photograph, stops):
    """The light is known: 9 EV before, and so much more in two frames after, as the first's."""
    meter, state = make_meter("average", context.camera), context.grid.nearest(9.0)
    matched = ZoneMatcher()
    before = photograph(STRIPES, 9.0, state)
    first = _match(matched, meter(before), before, context.camera)
    for late in (state, context.grid.nearest(11.0), context.grid.nearest(9.0 + stops)):
        after = photograph(STRIPES, 9.0 + stops, late)
        reading = _match(matched, meter(after), after, context.camera)
        assert reading.ev100 - first.ev100 == pytest.approx(stops, abs=0.1)
        assert reading.saturated[0] <= 0.02


def test_a_frame_without_shadows_keeps_its_reading(context, photograph):
    meter, state = make_meter("average", context.camera), context.grid.nearest(9.0)
    matched = ZoneMatcher()
    for light in (9.0, 15.0):
        frame = photograph(np.ones((64, 64)), light, state)
        plain, reading = meter(frame), _match(matched, meter(frame), frame, context.camera)
        np.testing.assert_array_equal(reading.ev100, plain.ev100)
        np.testing.assert_array_equal(reading.saturated, plain.saturated)
    assert reading.saturated[0] == 1.0


def test_only_zones_that_both_show_are_compared():
    before = np.array([0.02, 0.1, 0.3, np.nan, 0.5])
    now = np.array([0.08, 0.4, np.nan, 0.9, np.nan])
    stops, enough = light_change(before, now)
    assert stops == pytest.approx(2.0)
    assert enough
    for dark in (np.full(5, 1e-4), np.full(5, np.nan)):
        stops, enough = light_change(dark, now)
        assert (stops, enough) == (0.0, False)
