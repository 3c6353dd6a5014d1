"""The frame of each camera that tells most about the light as it is now."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agents.metering.reading import CODE_SIGNALS, GREEN, WHITE_SIGNAL, frame_ev100, signal_codes
from agents.policy import Observations
from simulator.camera import CameraProfile

#: Quantiles in which frames are compared.
_QUANTILES = np.linspace(0.05, 0.95, 19)
#: The light is another one where the frames differ by more than these, in the square root of the
#: signal (mean of the quantiles), and in stops (median of those that both frames show well).
_TOLERANCE, _TOLERANCE_EV = 0.04, 0.3
_SHOWN = (0.004, 0.9)
#: Saturated share from which a frame hides something.
_SATURATED = 0.01


class ReferenceFrames:
    """Keeps, for each camera, the best frame of the present light.

    What a search finds on a saturated frame and on a dark one of the same scene differs, because
    neither shows what the other does: a controller that follows the frame in hand may go to and fro
    between the two for ever. So it goes on searching on the better one for as long as new frames
    look as that one predicts. Of two frames the less saturated is better; of two that are not
    saturated, the brighter.

    Args:
        camera: The camera, for its black and white level.
    """

    def __init__(self, camera: CameraProfile) -> None:
        self.camera = camera
        self._raw: NDArray[np.uint8] | None = None  # (N, 4, h, w) codes
        self._settings: NDArray[np.floating] | None = None
        self._quantiles = np.empty((0, 0))
        self._saturated = np.empty(0)
        self._ev = np.empty(0)

    def update(self, observations: Observations) -> Observations:
        """Take in the frames in hand; returns the best ones, raw and settings."""
        raw = signal_codes(observations["raw"], self.camera)
        settings = np.asarray(observations["settings"])
        ev = frame_ev100(observations)
        green = raw[:, GREEN].reshape(len(raw), -1)
        ordered = np.sort(green, axis=1)
        places = np.rint(_QUANTILES * (green.shape[1] - 1)).astype(np.intp)
        quantiles = CODE_SIGNALS[ordered[:, places]]
        white = np.searchsorted(CODE_SIGNALS, WHITE_SIGNAL)
        saturated = (green >= white).mean(axis=1)
        if self._raw is None or self._settings is None:
            self._raw, self._settings = raw.copy(), settings.copy()
            self._quantiles, self._saturated, self._ev = quantiles, saturated, ev
            return {"raw": self._raw, "settings": self._settings}
        hides, hid = saturated >= _SATURATED, self._saturated >= _SATURATED
        better = np.where(
            hides | hid, saturated < self._saturated, ev <= self._ev
        )  # the same state again is a newer look at the same light
        replaced = better | self._changed(quantiles, ev)
        self._raw[replaced], self._settings[replaced] = raw[replaced], settings[replaced]
        self._quantiles[replaced], self._ev[replaced] = quantiles[replaced], ev[replaced]
        self._saturated[replaced] = saturated[replaced]
        return {"raw": self._raw, "settings": self._settings}

    def _changed(
        self, quantiles: NDArray[np.float64], ev: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Whether the frames in hand look other than predicted, ``(N,)``."""
        predicted = self._quantiles * np.exp2(self._ev - ev)[:, None]
        both = np.stack([predicted, quantiles]).clip(0.0, 1.0)
        apart = np.abs(np.diff(np.sqrt(both), axis=0)[0]).mean(axis=1) > _TOLERANCE
        shown = (both.min(axis=0) > _SHOWN[0]) & (both.max(axis=0) < _SHOWN[1])
        stops = np.abs(np.diff(np.log2(np.maximum(both, 1e-6)), axis=0)[0])
        known = shown.any(axis=1)
        middle = np.nanmedian(np.where(known[:, None] & ~shown, np.nan, stops), axis=1)
        changed: NDArray[np.bool_] = apart | known & (middle > _TOLERANCE_EV)
        return changed
