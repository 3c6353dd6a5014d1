"""A continuous estimate of the metered EV over the frames of an episode."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ae_env.utils.checks import check_number
from agents.metering.reading import SATURATED_STEP_EV, Reading

#: Metered weight from which a frame is all white.
ALL_SATURATED = 0.999


def check_damping(damping: float) -> float:
    """`damping` as a float.

    Raises:
        ValueError: Unless it is a number in [0, 1).
    """
    value = check_number("damping", damping, 0.0, 1.0)
    if value == 1.0:
        raise ValueError(f"`damping` (={damping!r}) must be below 1: nothing would ever move")
    return value


class EVTracker:
    """Continuous metered EV of each camera over the frames of an episode.

    A reading far from the estimate replaces it; within a stop the two are averaged, which settles
    what would otherwise flip between neighbouring states. A mostly saturated frame only says that
    the light is not below a bound, a black one that it is not above: an estimate that agrees with
    the bound is kept. A frame that is all white or all black moves any other estimate half of the
    way to the end of the range.

    With damping the EV that is handed out follows that estimate, keeping `damping` of its distance
    to it at every frame. It is a number of its own and never read back from the settings: a grid of
    whole stops does not hold it up. What is kept of it is never beyond the range: light that comes
    back after a long night is followed at once.

    Args:
        num_envs: Cameras.
        ev_range: Lowest and highest EV100 of the camera's exposure states.
        damping: Share of the distance to the estimate, in EV, that is kept per frame, in [0, 1).
        compensation: Exposure compensation [EV] that is taken off what is handed out: the range of
            that is so much higher.
    """

    def __init__(
        self,
        num_envs: int,
        ev_range: tuple[float, float],
        damping: float = 0.0,
        compensation: float = 0.0,
    ) -> None:
        self.ev100 = np.full(num_envs, np.nan)
        self.damped = np.full(num_envs, np.nan)
        self.ev_range = ev_range
        self.damping = check_damping(damping)
        self.compensation = compensation

    def update(self, reading: Reading) -> NDArray[np.float64]:
        """Take in one frame's reading; returns the estimates, ``(N,)``, damped."""
        old, new = self.ev100, reading.ev100
        low, high = self.ev_range
        bound = new - SATURATED_STEP_EV * reading.saturated
        agrees = (reading.saturated > 0.5) & (old >= bound) | reading.black & (old <= new)
        white = reading.saturated >= ALL_SATURATED
        new = np.where(reading.black, np.minimum(new, 0.5 * (new + low)), new)
        new = np.where(white, np.maximum(new, 0.5 * (bound + high)), new)
        blended = np.where(np.abs(new - old) > 1.0, new, 0.5 * (new + old))
        self.ev100 = np.where(np.isnan(old), new, np.where(agrees, old, blended))
        before = np.clip(self.damped, low + self.compensation, high + self.compensation)
        distance = self.damping * (before - self.ev100)
        self.damped = self.ev100 + np.where(np.isnan(distance), 0.0, distance)
        return self.damped.copy()
