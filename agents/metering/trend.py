"""Where the light goes: the EV of frames to come, from those that were metered."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agents.metering.reading import SATURATED_STEP_EV, Reading

Floats = NDArray[np.float64]

#: Shares of a surprise that correct the level and the rate, and the share of the rate that is left
#: after a frame. Chosen on the training kinds of moving light (`ae-env bench foresight`).
ALPHA, BETA, DAMPING = 0.85, 0.7, 0.8
#: A surprise beyond this is another light, whose rate is not known yet [EV].
JUMP_EV = 2.5
#: Rates beyond this are taken to be this [EV per frame].
MAX_RATE = 1.5


class TrendTracker:
    """An alpha-beta filter of the metered EV of each camera: its level and its rate.

    A frame's reading corrects the level by `alpha` of the surprise and the rate by `beta` of it
    (constant-velocity model). The rate is expected to die away: after each frame a share of
    `damping` of it is left (Gardner and McKenzie 1985). A mostly saturated frame only says that the
    light is not below a bound, a black one that it is not above: what was expected stays if it
    agrees.

    Args:
        num_envs: Cameras.
        ev_range: Lowest and highest EV100 of the camera's exposure states.
        alpha: In (0, 1].
        beta: In [0, 1]; 0 for no trend.
        damping: In [0, 1].
    """

    def __init__(
        self,
        num_envs: int,
        ev_range: tuple[float, float],
        alpha: float = ALPHA,
        beta: float = BETA,
        damping: float = DAMPING,
    ) -> None:
        self.ev_range, self.alpha, self.beta, self.damping = ev_range, alpha, beta, damping
        self.ev100, self.rate = np.full(num_envs, np.nan), np.zeros(num_envs)

    def update(self, reading: Reading, exposed_at: Floats) -> None:
        """Take in one frame's reading, and the EV100 that it was taken at, ``(N,)``."""
        low, high = self.ev_range
        expected = self.ev100 + self.damping * self.rate
        bound = reading.ev100 - SATURATED_STEP_EV * reading.saturated
        agrees = (reading.saturated > 0.5) & (expected >= bound)
        agrees |= reading.black & (expected <= reading.ev100)
        # Nothing is known of the light beyond what the camera can be set to.
        metered = np.where(reading.black, np.minimum(reading.ev100, low), reading.ev100)
        surprise = np.where(agrees, 0.0, metered - expected)
        jumped = np.abs(surprise) > JUMP_EV
        rate = self.damping * self.rate + self.beta * surprise
        level = expected + np.where(jumped, 1.0, self.alpha) * surprise
        first = np.isnan(expected)
        self.ev100 = np.clip(np.where(first, metered, level), low - 4.0, high + 4.0)
        rate = np.where(first | jumped, 0.0, rate)
        self.rate = np.clip(rate, -MAX_RATE, MAX_RATE)

    def ahead(self, frames: int) -> tuple[Floats, Floats]:
        """See `LightTracker.ahead`; how far off it may be is not known."""
        weight = sum(self.damping**k for k in range(1, frames + 1))
        return self.ev100 + weight * self.rate, np.zeros_like(self.rate)
