"""What is promised in the frames that a decision is in effect in, and what light is expected."""

import dataclasses
from itertools import product

import numpy as np
import pytest

from agents.foresight import POINTS, Foresight, TrendTracker
from agents.metering.reading import Reading
from agents.policy_names import make_policy


class Known:
    """A tracker that is told the light of one camera and how sure it is."""

    def __init__(self, ev100, spread=0.0):
        self.ev100_ahead, self.spread = ev100, spread

    def update(self, reading, exposed_at): ...

    def ahead(self, frames):
        return np.array([float(self.ev100_ahead(frames))]), np.array([self.spread])


def _reading(ev100, saturated=0.0, black=False):
    ev100 = np.atleast_1d(np.asarray(ev100, float))
    return Reading(ev100, np.full(len(ev100), saturated), np.full(len(ev100), black))


def test_every_control_is_chosen_for_the_first_frame_that_has_it(context, photograph):
    """Against all decisions: ISO for frame 2 beside what was asked for, the rest for frame 3."""
    grid = context.grid
    tables = {2.0: np.random.default_rng(2).random(64), 3.0: np.random.default_rng(3).random(64)}
    delayed = dataclasses.replace(context, delays=(1, 2, 2))
    foresight = Foresight(delayed, Known(lambda frames: frames))
    start, asked = 21, 62
    foresight.observe(_reading(9.0), photograph(np.ones((64, 64)), 9.0, start))
    foresight.record_action(np.array([asked]))
    foresight.observe(_reading(9.0), photograph(np.ones((64, 64)), 9.0, start))
    found = foresight.utility(lambda ev: tables[float(ev[0])][None])[0]

    def promise(iso, time, aperture):
        _, asked_time, asked_aperture = grid.controls(asked)
        second = tables[2.0][grid.index(iso, asked_time, asked_aperture)]
        return second + max(tables[3.0][grid.index(free, time, aperture)] for free in range(4))

    expected = [promise(*controls) for controls in product(range(4), repeat=3)]
    np.testing.assert_allclose(found, expected)
    # Without delay it is the best state of the next frame.
    foresight = Foresight(context, Known(lambda frames: frames))
    foresight.observe(_reading(9.0), photograph(np.ones((64, 64)), 9.0, 3))
    table = np.random.default_rng(0).random((1, 64))
    np.testing.assert_array_equal(foresight.utility(lambda ev: ev[0] * table), table)


def test_scores_are_averaged_over_what_the_light_may_be(context, photograph):
    """The points have the mean and the variance of a normal distribution with that error."""
    points, weights = POINTS
    moments = [weights @ points**power for power in (0, 1, 2)]
    # The last is (standard deviation / mean error)^2.
    assert moments == pytest.approx([1.0, 0.0, np.pi / 2], rel=1e-4)
    foresight = Foresight(context, Known(lambda frames: 5.0, spread=2.0))
    foresight.observe(_reading(9.0), photograph(np.ones((64, 64)), 9.0, 3))
    found = foresight.utility(lambda ev: np.repeat(ev[:, None] ** 2, 64, axis=1))
    np.testing.assert_allclose(found, 25.0 + 4.0 * np.pi / 2, rtol=1e-4)


def test_a_steady_ramp_is_foreseen_and_a_rest_after_it_too():
    tracker = TrendTracker(1, (-2.0, 18.0), alpha=0.5, beta=0.3, damping=1.0)
    light = np.concatenate([np.arange(40) * 0.25, np.full(40, 9.75)])
    for ev in light[:40]:
        tracker.update(_reading(ev), np.zeros(1))
    assert tracker.ahead(3)[0] == pytest.approx(9.75 + 0.75, abs=1e-3)
    for ev in light[40:]:
        tracker.update(_reading(ev), np.zeros(1))
    assert tracker.ahead(3)[0] == pytest.approx(9.75, abs=1e-3)


def test_a_trend_follows_jumps_at_once_and_clipped_frames_only_where_they_contradict():
    tracker = TrendTracker(3, (0.0, 16.0))
    for _ in range(3):
        tracker.update(_reading([8.0, 8.0, 8.0]), np.zeros(3))
    dark = Reading(np.array([3.0, 11.0, 9.0]), np.array([0.0, 1.0, 1.0]), np.zeros(3, bool))
    tracker.update(dark, np.zeros(3))
    # Jumped; white says 8 or more (3 of 11 are the meter's guess); white says 6 or more.
    assert tracker.ahead(2)[0] == pytest.approx([3.0, 8.0, 8.0])


@pytest.mark.parametrize(
    ("name", "low", "high"), [("average:P", 2.0, np.inf), ("average:P?foresight=trend", -1.3, 1.3)]
)
def test_a_meter_with_foresight_is_ahead_of_a_ramp(context, photograph, name, low, high):
    """Light that falls by a stop a frame, settings three frames late: what is asked for is right
    for the frame that has it, where the plain meter is three stops too dark.
    """
    policy = make_policy(name, dataclasses.replace(context, delays=(2, 2, 2)))
    policy.reset(1)
    asked = [context.grid.nearest(14.0)] * 3
    for frame in range(12):
        taken = photograph(np.ones((64, 64)), 14.0 - frame, asked[frame])
        asked.append(int(policy.act(taken)[0]))
    assert low < context.grid.ev100[asked[11 + 3]] - (14.0 - 11 - 3) < high
