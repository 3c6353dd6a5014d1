from __future__ import annotations

import numpy as np

from agents.metering.reading import frame_ev100
from agents.metering.reference_frames import ReferenceFrames

RAMP = np.geomspace(0.1, 6.0, 64)[None] * np.ones((64, 1))


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


def test_cameras_are_apart(context, photograph):
    grid = context.grid
    states = [grid.nearest(10.0), grid.nearest(13.0)]
    reference = ReferenceFrames(context.camera)
    reference.update(photograph(RAMP, 9.0, states))
    kept = frame_ev100(reference.update(photograph(RAMP, 9.0, states[::-1])))
    np.testing.assert_allclose(kept, grid.ev100[[states[0]] * 2], atol=0.05)


def test_frames_that_are_handed_in_may_be_written_over(context, photograph):
    frame = photograph(RAMP, 9.0, context.grid.nearest(9.0))
    reference = ReferenceFrames(context.camera)
    first = {k: v.copy() for k, v in reference.update(frame).items()}
    frame["raw"][:] = 0
    again = photograph(RAMP, 9.0, context.grid.nearest(2.0))
    np.testing.assert_array_equal(reference.update(again)["raw"], first["raw"])
