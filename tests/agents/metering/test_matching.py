"""Light of frames that clip, from what they do not clip."""

import numpy as np
import pytest

from agents.metering.meters import make_meter
from agents.metering.reading import MatchedReadings, light_change

#: Stripes from 5 stops below to 2 stops above a grey card, and a flat one.
STRIPES = np.repeat(2.0 ** np.linspace(-5.0, 2.0, 16), 4)[None, :] * np.ones((64, 1))


@pytest.mark.parametrize("stops", [4.0, 3.0, -2.0])
def test_a_jump_is_read_from_the_shadows(context, photograph, stops):
    """The light is known: 9 EV before, and so much more in two frames after, as the first's."""
    meter, state = make_meter("average", context.camera), context.grid.nearest(9.0)
    matched = MatchedReadings(context.camera)
    before = photograph(STRIPES, 9.0, state)
    first = matched.update(meter(before), before)
    for late in (state, context.grid.nearest(11.0), context.grid.nearest(9.0 + stops)):
        after = photograph(STRIPES, 9.0 + stops, late)
        reading = matched.update(meter(after), after)
        assert reading.ev100 - first.ev100 == pytest.approx(stops, abs=0.1)
        assert reading.saturated[0] <= 0.02


def test_a_frame_without_shadows_keeps_its_reading(context, photograph):
    meter, state = make_meter("average", context.camera), context.grid.nearest(9.0)
    matched = MatchedReadings(context.camera)
    for light in (9.0, 15.0):
        frame = photograph(np.ones((64, 64)), light, state)
        plain, reading = meter(frame), matched.update(meter(frame), frame)
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
