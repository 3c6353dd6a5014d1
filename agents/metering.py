"""Reflected-light metering of raw frames: what exposure value does the frame in hand suggest?

Every meter undoes the observation's companding, measures the linear green signal against the
calibration of the exposure scale (an 18 % card is recorded at 0.12 of sensor white when the state's
EV equals that of the incident light) and adds the EV100 at which the frame was taken.
"""

from __future__ import annotations

import difflib
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ae_env.observation import decode_observation, decode_settings
from agents.policy import METERS, Observations
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
#: Metered weight from which a frame is all white.
ALL_SATURATED = 0.999
#: Share of a centre-weighted meter's reading that comes from the central circle, and the circle's
#: diameter in frame heights (12 mm of 24 mm).
CENTRE_SHARE, CENTRE_DIAMETER = 0.75, 0.5
#: Part of the frame's area that a spot meter reads.
SPOT_AREA = 0.04
#: Matrix metering: zones a side, standard deviation of their centre weighting [zones], and the
#: levels between which the brightest 2 % of the pixels should lie, corrected by so many EV at most.
#: Chosen among ten or so settings on the bundled training scenes.
MATRIX_ZONES, MATRIX_SIGMA = 5, 1.0
TOP_SHARE, TOP_AT_LEAST, TOP_AT_MOST, CONSTRAINT_LIMIT_EV = 0.02, 0.5, 0.8, 3.0
#: What the zones' logarithms and the constraints together read too low on the ordinary (not hard)
#: training scenes, against the incident light [EV].
MATRIX_CALIBRATION_EV = 0.7


@dataclass(frozen=True)
class Reading:
    """What a meter makes of one frame of each camera.

    Args:
        ev100: Metered EV100, shape ``(N,)``.
        saturated: Share of the metered weight that is saturated, ``(N,)``: the reading is a lower
            bound in so far.
        black: Whether nothing was recorded, ``(N,)``: the reading is an upper bound.
    """

    ev100: NDArray[np.float64]
    saturated: NDArray[np.float64]
    black: NDArray[np.bool_]


Meter = Callable[[Observations], Reading]


def make_meter(name: str, camera: CameraProfile) -> Meter:
    """The meter called `name`, average, centre_weighted, matrix or spot, for `camera`.

    Raises:
        ValueError: If there is none; the message proposes the nearest name.
    """
    if name not in METERS:
        near = difflib.get_close_matches(str(name), METERS, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"`meter` (={name!r}) must be one of {', '.join(METERS)}{hint}")
    if name == "matrix":
        return functools.partial(matrix_reading, camera=camera)
    return functools.partial(weighted_reading, camera=camera, name=name)


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
    """Signal of observed frames, white is 1, whatever the kind of observation.

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


def weight_map(name: str, height: int, width: int) -> NDArray[np.float32]:
    """Metering weights of the pixels, ``(height, width)``, summing to 1.

    Args:
        name: ``"average"``; ``"centre_weighted"``: 75 % of the weight in the central circle of half
            the frame's height (the classic 12 mm circle of 35 mm cameras), the rest around it;
            ``"spot"``: a central circle of 4 % of the area.
        height: Rows.
        width: Columns.

    >>> round(float(weight_map("centre_weighted", 64, 64)[16:48, 16:48].sum()), 2)
    0.77
    """
    y = (np.arange(height) + 0.5) / height - 0.5
    x = ((np.arange(width) + 0.5) - 0.5 * width) / height
    radius = np.hypot(y[:, None], x[None, :])
    if name == "average":
        weights = np.ones((height, width))
    elif name == "centre_weighted":
        inside = radius <= CENTRE_DIAMETER / 2
        weights = np.where(
            inside, CENTRE_SHARE / inside.sum(), (1 - CENTRE_SHARE) / (~inside).sum()
        )
    else:
        area = SPOT_AREA * height * width / height**2  # in frame heights squared
        weights = (radius <= np.sqrt(area / np.pi)).astype(np.float64)
    return (weights / weights.sum()).astype(np.float32)


def weighted_reading(observations: Observations, camera: CameraProfile, name: str) -> Reading:
    """EV of the weighted mean signal, with the weights of `weight_map`."""
    signal = linear_signal(observations["raw"], camera, GREEN)
    weights = weight_map(name, *signal.shape[-2:]).ravel() / 2
    flat = signal.reshape(len(signal), 2, -1)
    mean = np.einsum("ncp,p->n", flat, weights, dtype=np.float64)
    saturated = np.einsum("ncp,p->n", (flat >= WHITE_SIGNAL).astype(np.float32), weights)
    return _reading(mean, saturated.astype(np.float64), frame_ev100(observations))


def matrix_reading(observations: Observations, camera: CameraProfile) -> Reading:
    """Multi-zone metering: contrast-aware zones, then highlight and shadow constraints.

    The frame is cut into 5 x 5 zones, as in modern AGCs. The reading is the centre-weighted mean of
    the zones' *log2* signals, so a lamp or the sun in one zone does not darken the rest. Then, as
    in the ``normal`` and ``highlight`` constraint modes of the Raspberry Pi's AGC, the brightest
    2 % of the pixels should be recorded between 0.5 and 0.8 of white at the
    metered EV: snow is lifted, a lit figure in front of the dark is held.
    """
    signal = linear_signal(observations["raw"], camera, GREEN).mean(axis=1)  # (N, h, w)
    ev = frame_ev100(observations)
    level = np.log2(np.maximum(_zone_means(signal), BLACK_SIGNAL))
    weights = _zone_weights()
    saturated = _zone_means(signal >= WHITE_SIGNAL) @ weights
    reading = _reading(np.exp2(level @ weights), saturated, ev)
    # Signal of the top pixels if the frame were taken at the metered EV.
    top = np.quantile(signal.reshape(len(ev), -1), 1.0 - TOP_SHARE, axis=1)
    top_level = np.log2(np.maximum(top, BLACK_SIGNAL)) + (ev - reading.ev100)
    # A saturated top is brighter than it says, so it cannot be known to be too dark.
    too_bright = np.maximum(top_level - np.log2(TOP_AT_MOST), 0.0)
    too_dark = np.where(top < WHITE_SIGNAL, np.minimum(top_level - np.log2(TOP_AT_LEAST), 0.0), 0.0)
    correction = np.clip(too_bright + too_dark, -CONSTRAINT_LIMIT_EV, CONSTRAINT_LIMIT_EV)
    correction += MATRIX_CALIBRATION_EV
    return Reading(reading.ev100 + correction, reading.saturated, reading.black)


def _zone_means(images: NDArray[Any]) -> NDArray[np.float64]:
    """Means over the zones, ``(N, zones)``, row by row."""
    for axis in (1, 2):
        size = images.shape[axis]
        starts = np.arange(MATRIX_ZONES) * size // MATRIX_ZONES
        counts = np.diff(np.append(starts, size))
        shape = (1, -1, 1) if axis == 1 else (1, 1, -1)
        sums = np.add.reduceat(images, starts, axis=axis, dtype=np.float64)
        images = sums / counts.reshape(shape)
    return images.reshape(len(images), -1)


def _zone_weights() -> NDArray[np.float64]:
    """Centre weighting of the zones, summing to 1."""
    offset = np.arange(MATRIX_ZONES) - (MATRIX_ZONES - 1) / 2
    profile = np.exp(-0.5 * (offset / MATRIX_SIGMA) ** 2)
    weights: NDArray[np.float64] = np.outer(profile, profile).ravel()
    return weights / weights.sum()


def _reading(
    mean: NDArray[np.float64], saturated: NDArray[np.float64], ev: NDArray[np.float64]
) -> Reading:
    level = np.log2(np.maximum(mean, BLACK_SIGNAL) / TARGET_SIGNAL)
    black = mean <= BLACK_SIGNAL * 1.001
    return Reading(ev + level + SATURATED_STEP_EV * saturated, saturated, black)


class EVTracker:
    """Continuous metered EV of each camera over the frames of an episode.

    A reading far from the estimate replaces it; within a stop the two are averaged, which settles
    what would otherwise flip between neighbouring states. A mostly saturated frame only says that
    the light is not below a bound, a black one that it is not above: an estimate that agrees with
    the bound is kept. A frame that is all white or all black moves any other estimate half of the
    way to the end of the range.

    Args:
        num_envs: Cameras.
        ev_range: Lowest and highest EV100 of the camera's exposure states.
    """

    def __init__(self, num_envs: int, ev_range: tuple[float, float]) -> None:
        self.ev100 = np.full(num_envs, np.nan)
        self.ev_range = ev_range

    def update(self, reading: Reading) -> NDArray[np.float64]:
        """Take in one frame's reading; returns the estimates, ``(N,)``."""
        old, new = self.ev100, reading.ev100
        low, high = self.ev_range
        bound = new - SATURATED_STEP_EV * reading.saturated
        agrees = (reading.saturated > 0.5) & (old >= bound) | reading.black & (old <= new)
        white = reading.saturated >= ALL_SATURATED
        new = np.where(reading.black, np.minimum(new, 0.5 * (new + low)), new)
        new = np.where(white, np.maximum(new, 0.5 * (bound + high)), new)
        blended = np.where(np.abs(new - old) > 1.0, new, 0.5 * (new + old))
        self.ev100 = np.where(np.isnan(old), new, np.where(agrees, old, blended))
        return self.ev100.copy()
