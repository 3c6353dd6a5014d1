"""The reading of a light meter, and the light that a frame shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ae_env.observation import PEDESTAL, decode_observation, decode_settings
from agents.policy import Observations
from simulator.camera import CameraProfile

#: The planes that carry luminance.
GREEN = slice(1, 3)
#: Mean signal, 1.0 at sensor white, that a meter aims at: 18 % grey under ISO 12232's
#: saturation-based speed, 0.1194 rounded.
TARGET_SIGNAL = 0.12
#: Below this mean the 8-bit code of the observation has no step left: the frame is black.
BLACK_SIGNAL = 2e-4
#: At and above this a pixel is saturated (the top code of the observation covers 0.996 to 1).
WHITE_SIGNAL = 0.99
#: A wholly saturated frame is counted this many EV above white, a partly saturated one in
#: proportion: its mean is only a lower bound of the light.
SATURATED_STEP_EV = 3.0
#: Codes of the 8-bit observation, and the signal of each.
CODES = 256
CODE_SIGNALS = (1.0 + PEDESTAL) * (np.arange(CODES) / (CODES - 1.0)) ** 2 - PEDESTAL


@dataclass(frozen=True)
class Reading:
    """A meter's result for one frame of each camera.

    Args:
        ev100: Metered EV100, shape ``(N,)``.
        saturated: Share of the metered weight that is saturated, ``(N,)``: the reading is a lower
            bound in so far.
        black: Whether nothing was recorded, ``(N,)``: the reading is an upper bound.
    """

    ev100: NDArray[np.float64]
    saturated: NDArray[np.float64]
    black: NDArray[np.bool_]


class Meter(Protocol):
    """A light meter for a batch of cameras."""

    def __call__(
        self, observations: Observations, estimate: NDArray[np.float64] | None = None
    ) -> Reading:
        """Meter the frames in hand.

        Args:
            observations: Of N cameras.
            estimate: EV100 that the controller holds, ``(N,)``, NaN in the first frame: where a
                meter that improves on it step by step continues. The others ignore it.
        """


def frame_ev100(observations: Observations) -> NDArray[np.float64]:
    """EV100 at which each frame in hand was taken, ``(N,)``: Av + Tv - (Sv - 5).

    Av is rounded to the third of a stop that a marked f-number stands for.
    """
    aperture, time, speed = (
        np.asarray(v, dtype=np.float64) for v in decode_settings(observations["settings"])
    )
    return np.round(3.0 * aperture) / 3.0 + time - (speed - 5.0)


def linear_signal(
    raw: NDArray[Any], camera: CameraProfile, planes: slice = slice(None)
) -> NDArray[np.float32]:
    """Signal of observed frames, white is 1, from any kind of observation.

    Args:
        raw: ``(N, 4, h, w)``: uint8 codes, float32 signal, or the camera's uint16 numbers.
        camera: The camera, for its black and white level.
        planes: Planes to take, of R, G1, G2, B.
    """
    chosen = raw[:, planes]
    if chosen.dtype == np.uint8:
        return decode_observation(chosen)
    if np.issubdtype(chosen.dtype, np.floating):
        return chosen.astype(np.float32)
    black, span = (np.array(v)[planes, None, None] for v in (camera.black_level, camera.span))
    signal: NDArray[np.float32] = ((chosen - black) / span).astype(np.float32)
    return signal


def signal_codes(
    raw: NDArray[Any], camera: CameraProfile, planes: slice = slice(None)
) -> NDArray[np.uint8]:
    """The 8-bit codes of observed frames, from any kind of observation.

    Args:
        raw: As for `linear_signal`.
        camera: As for `linear_signal`.
        planes: Planes to take, of R, G1, G2, B.
    """
    if raw.dtype == np.uint8:
        return raw[:, planes]
    signal = linear_signal(raw, camera, planes).clip(-PEDESTAL, 1.0)
    codes: NDArray[np.uint8] = np.rint(
        (CODES - 1.0) * np.sqrt((signal + PEDESTAL) / (1.0 + PEDESTAL))
    ).astype(np.uint8)
    return codes


def mean_reading(
    mean: NDArray[np.float64], saturated: NDArray[np.float64], ev: NDArray[np.float64]
) -> Reading:
    """The reading of frames with this mean signal, taken at `ev`, all ``(N,)``."""
    level = np.log2(np.maximum(mean, BLACK_SIGNAL) / TARGET_SIGNAL)
    black = mean <= BLACK_SIGNAL * 1.001
    return Reading(ev + level + SATURATED_STEP_EV * saturated, saturated, black)
