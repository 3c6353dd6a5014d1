"""The light of frames that clip: what they do not clip, against the same zones a frame before."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agents.metering.reading import GREEN, WHITE_SIGNAL, Reading, frame_ev100, linear_signal
from agents.policy import Observations
from simulator.camera import CameraProfile

Floats = NDArray[np.float64]

#: Zones a side, at most.
ZONES = 32
#: A meter's own reading stands up to this share of saturated weight.
TRUSTED_SATURATED = 0.02
#: Share of the zones that two frames must show unclipped to be compared, and the mean signal of
#: those in each.
LEAST_SHARE, LEAST_SIGNAL = 0.01, 0.004


class ZoneMatcher:
    """Replaces what a meter reads in frames that clip by how much brighter they are than the last.

    A frame that is exposed four stops too long is mostly white, and its mean is only a lower bound
    of the light. But its shadows are recorded: over the zones that clip nowhere, neither in this
    frame nor in the one before, the ratio of the signals is that of the exposures times that of the
    light (the comparametric principle of Mann 2000, on a linear sensor). Where too little is left
    to compare, the meter's reading stands, with its share of white as a warning.
    """

    def __init__(self) -> None:
        self._zones: Floats | None = None
        self._light, self._exposed_at = np.empty(0), np.empty(0)

    def match(self, reading: Reading, zones: Floats, exposed_at: Floats) -> Reading:
        """Take in one frame of each camera; what it reads, unsaturated where it was matched.

        Args:
            reading: What a meter reads in the frames, ``(N,)``.
            zones: Mean signals of their zones, ``(N, zones)``, NaN where a pixel clips.
            exposed_at: EV100 that they were taken at, ``(N,)``.
        """
        light, saturated = reading.ev100, reading.saturated
        if self._zones is not None:
            change, comparable = light_change(self._zones, zones)
            matched = comparable & (saturated > TRUSTED_SATURATED)
            change += exposed_at - self._exposed_at
            light = np.where(matched, self._light + change, light)
            saturated = np.where(matched, 0.0, saturated)
        self._zones, self._light, self._exposed_at = zones, light, exposed_at
        return Reading(light, saturated, reading.black)


class MatchedReadings(ZoneMatcher):
    """`ZoneMatcher` on the zones of observed frames.

    Args:
        camera: The camera, for its black and white level.
    """

    def __init__(self, camera: CameraProfile) -> None:
        super().__init__()
        self.camera = camera

    def update(self, reading: Reading, observations: Observations) -> Reading:
        """Take in one frame of each camera; what it reads, unsaturated where it was matched."""
        signal = linear_signal(observations["raw"], self.camera, GREEN)
        return self.match(reading, _zones(signal), frame_ev100(observations))


def light_change(before: Floats, now: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """How many stops more signal `now` has than `before`, over what both show.

    Args:
        before: Mean signals of zones, (..., zones), NaN where one clips.
        now: Likewise, of the same zones.

    Returns:
        Stops (...), and whether there was enough to compare; 0 where not.
    """
    both = ~np.isnan(before) & ~np.isnan(now)
    count = np.maximum(both.sum(axis=-1), 1)
    means = [np.where(both, zones, 0.0).sum(axis=-1) / count for zones in (before, now)]
    enough = (both.mean(axis=-1) >= LEAST_SHARE) & (np.minimum(*means) >= LEAST_SIGNAL)
    stops = np.diff(np.log2(np.maximum(means, LEAST_SIGNAL)), axis=0)[0]
    return np.where(enough, stops, 0.0), enough


def _zones(signal: NDArray[np.float32]) -> Floats:
    """Means over zones (N, zones) of the greens (N, 2, h, w); NaN where a pixel clips."""
    pixels = np.where(signal >= WHITE_SIGNAL, np.nan, signal).mean(axis=1)  # NaN if either does
    high, wide = (max(1, size // ZONES) for size in pixels.shape[1:])
    rows, columns = pixels.shape[1] // high, pixels.shape[2] // wide
    blocks = pixels[:, : rows * high, : columns * wide].reshape(-1, rows, high, columns, wide)
    return blocks.mean(axis=(2, 4), dtype=np.float64).reshape(len(signal), -1)
