"""From what a state is worth in some light to what to choose for the light to come.

Settings reach a sensor frames late, each control after its own delay. A policy with foresight knows
its earlier decisions, expects what the light will be when its decision is in effect
(`LightTracker`), and asks what each state is worth in that light.
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from agents.metering.reading import (
    SATURATED_STEP_EV,
    Reading,
    ZoneMatcher,
    frame_ev100,
    frame_states,
    zone_signals,
)
from agents.policy import Floats, Ints, Observations, PolicyContext

#: Points [mean absolute errors] and weights over which a forecast is averaged: those of Gauss and
#: Hermite for a normal distribution, whose standard deviation is 1.25 of its mean absolute error.
POINTS = (1.2533 * 3.0**0.5 * np.array([-1.0, 0.0, 1.0]), np.array([1.0, 4.0, 1.0]) / 6.0)
#: Shares of a surprise that correct the level and the rate, and the share of the rate that is left
#: after a frame. Chosen on the training kinds of moving light.
ALPHA, BETA, DAMPING = 0.85, 0.7, 0.8
#: A surprise beyond this is another light, whose rate is not known yet [EV].
JUMP_EV = 2.5
#: Rates beyond this are taken to be this [EV per frame].
MAX_RATE = 1.5


class LightTracker(Protocol):
    """Expects the light of frames to come."""

    def update(self, reading: Reading, exposed_at: Floats) -> None:
        """Take in what a meter reads in one frame of each camera, taken at EV100 `exposed_at`."""

    def ahead(self, frames: int) -> tuple[Floats, Floats]:
        """EV100 that the meter is expected to read `frames` after the last one, ``(N,)``, and the
        mean absolute error expected of that; 0 where it is not known.
        """


class TrendTracker:
    """An alpha-beta filter of the metered EV of each camera: its level and its rate.

    A surprise corrects the level by a share of `ALPHA` and the rate by one of `BETA`; of the rate a
    share of `DAMPING` is left after each frame (Gardner and McKenzie 1985). A mostly saturated
    frame only says that the light is not below a bound, a black one that it is not above: what was
    expected stays if it agrees. `ev_range` is that of the exposure states [EV100].
    """

    def __init__(self, num_envs: int, ev_range: tuple[float, float]) -> None:
        self.ev_range = ev_range
        self.ev100, self.rate = np.full(num_envs, np.nan), np.zeros(num_envs)

    def update(self, reading: Reading, exposed_at: Floats) -> None:
        """See `LightTracker.update`."""
        low, high = self.ev_range
        expected = self.ev100 + DAMPING * self.rate
        bound = reading.ev100 - SATURATED_STEP_EV * reading.saturated
        agrees = (reading.saturated > 0.5) & (expected >= bound)
        agrees |= reading.black & (expected <= reading.ev100)
        # Nothing is known of the light beyond what the camera can be set to.
        metered = np.where(reading.black, np.minimum(reading.ev100, low), reading.ev100)
        surprise = np.where(agrees, 0.0, metered - expected)
        jumped = np.abs(surprise) > JUMP_EV
        rate = DAMPING * self.rate + BETA * surprise
        level = expected + np.where(jumped, 1.0, ALPHA) * surprise
        first = np.isnan(expected)
        self.ev100 = np.clip(np.where(first, metered, level), low - 4.0, high + 4.0)
        rate = np.where(first | jumped, 0.0, rate)
        self.rate = np.clip(rate, -MAX_RATE, MAX_RATE)

    def ahead(self, frames: int) -> tuple[Floats, Floats]:
        """See `LightTracker.ahead`; how far off it may be is not known."""
        weight = sum(DAMPING**k for k in range(1, frames + 1))
        return self.ev100 + weight * self.rate, np.zeros_like(self.rate)


class Foresight:
    """Rolls the light that a `tracker` expects through the delays of each camera's controls."""

    def __init__(self, context: PolicyContext, tracker: LightTracker) -> None:
        self.grid, self._camera, self._tracker = context.grid, context.camera, tracker
        self._matcher = ZoneMatcher()
        #: Frames from the one in hand to the first that has this decision's ISO, time, aperture.
        self.leads = tuple(1 + delay for delay in context.delays)
        self._actions: list[Ints] = []  # the newest last

    def observe(self, reading: Reading, observations: Observations) -> Reading:
        """Take in a frame of each camera; returns its reading, where it clips by `ZoneMatcher`."""
        zones = zone_signals(observations["raw"], self._camera)
        exposed_at = frame_ev100(observations)
        reading = self._matcher.match(reading, zones, exposed_at)
        self._tracker.update(reading, exposed_at)
        if not self._actions:  # what the first frame was taken with stays until a decision is there
            self._actions = [frame_states(observations, self.grid)] * max(self.leads)
        return reading

    @property
    def pending_action(self) -> Ints:
        """States of the last decision, ``(N,)``."""
        return self._actions[-1]

    def ev100(self, frames: int) -> Floats:
        """EV100 that a meter is expected to read `frames` after the frame in hand, ``(N,)``."""
        return self._tracker.ahead(frames)[0]

    def utility(self, scores: Callable[[Floats], Floats]) -> Floats:
        """Expected score of each state in the first frames that have its controls, ``(N, S)``.

        A control that is in effect earlier than another is free in the other's frame, as the next
        decision will choose it; one that is in effect later is that of an earlier decision there.
        `scores` are those of every state, ``(N, S)``, at the metered EV100 of a frame, ``(N,)``.
        """
        total: Floats = np.zeros((len(self._actions[0]), 1, 1, 1))
        for frame in sorted(set(self.leads)):
            ev100, spread = self._tracker.ahead(frame)
            if spread.any():  # the mean over what the light may be
                points = zip(*POINTS, strict=True)
                found = np.sum([w * scores(ev100 + step * spread) for step, w in points], axis=0)
            else:
                found = scores(ev100)
            promised = found.reshape(-1, *self.grid.shape)
            for axis, lead in enumerate(self.leads):
                if lead < frame:
                    promised = promised.max(axis=1 + axis, keepdims=True)
                elif lead > frame:
                    pending = self.grid.controls(self._actions[frame - lead])[:, axis]
                    index = pending.reshape(-1, 1, 1, 1)
                    promised = np.take_along_axis(promised, index, axis=1 + axis)
            total = total + promised
        return total.reshape(len(total), -1)

    def record_action(self, states: Ints) -> None:
        """Remember the decision after the frame in hand, ``(N,)`` states."""
        self._actions = [*self._actions[1:], states]


def make_foresight(
    name: str, context: PolicyContext, num_envs: int, forecasters: Sequence[Any]
) -> Foresight | None:
    """The foresight called `name`, by `forecasters` or else a trend; None of ``"none"``."""
    if name == "none":
        return None
    if forecasters:
        from agents.learning.forecaster import LearntTracker  # imports torch's networks

        return Foresight(context, LearntTracker(num_envs, forecasters))
    ev100 = context.grid.ev100
    return Foresight(context, TrendTracker(num_envs, (float(ev100.min()), float(ev100.max()))))
