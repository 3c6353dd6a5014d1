"""Reflected-light metering of raw frames: what exposure value does the frame in hand suggest?

Every meter undoes the observation's companding, measures the linear green signal against the
calibration of the exposure scale (an 18 % card is recorded at 0.12 of sensor white when the state's
EV equals that of the incident light) and adds the EV100 at which the frame was taken. The meters
here weigh pixels or zones; those of `search_meters` look for an exposure.
"""

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ae_env.observation import linear_signal
from agents.metering.reading import (
    BLACK_SIGNAL,
    GREEN,
    WHITE_SIGNAL,
    Meter,
    Reading,
    frame_ev100,
    mean_reading,
)
from agents.policy import Floats, Observations
from agents.policy_names import METERS
from simulator.camera import CameraProfile
from simulator.utils.checks import check_word

#: Share of a centre-weighted meter's reading that comes from the central circle, and the circle's
#: diameter in frame heights (12 mm of 24 mm).
CENTRE_SHARE, CENTRE_DIAMETER = 0.75, 0.5
#: Part of the frame's area that a spot meter reads.
SPOT_AREA = 0.04
#: Matrix metering: zones a side, standard deviation of their centre weighting [zones], and the
#: levels between which the brightest 2 % of the pixels should lie, corrected by so many EV at most.
#: Chosen among ten or so settings on the bundled training scenes.
MATRIX_ZONES, MATRIX_SIGMA = 5, 1.0
_PROFILE = np.exp(-0.5 * ((np.arange(MATRIX_ZONES) - (MATRIX_ZONES - 1) / 2) / MATRIX_SIGMA) ** 2)
TOP_SHARE, TOP_AT_LEAST, TOP_AT_MOST, CONSTRAINT_LIMIT_EV = 0.02, 0.5, 0.8, 3.0
#: What the zones' logarithms and the constraints together read too low on the ordinary (not hard)
#: training scenes, against the incident light [EV].
MATRIX_CALIBRATION_EV = 0.7


def make_meter(name: str, camera: CameraProfile) -> Meter:
    """The meter called `name`, one of `agents.policy_names.METERS`; a `ValueError` if none is."""
    check_word("meter", name, METERS)
    if name in ("average", "centre_weighted", "spot"):
        return functools.partial(weighted_reading, camera=camera, name=name)
    if name == "matrix":
        return functools.partial(matrix_reading, camera=camera)
    from agents.metering import search_meters  # not all processes need torch

    return functools.partial(getattr(search_meters, f"{name}_reading"), camera=camera)


def weight_map(name: str, height: int, width: int) -> NDArray[np.float32]:
    """Metering weights of the pixels, ``(height, width)``, summing to 1.

    ``"centre_weighted"``: 75 % of the weight in the central circle of half the frame's height (the
    classic 12 mm circle of 35 mm cameras), the rest around it; ``"spot"``: a central circle of 4 %
    of the area; ``"matrix"``: the weights of the zones, of their logarithms.

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
        around = (1 - CENTRE_SHARE) / (~inside).sum()
        weights = np.where(inside, CENTRE_SHARE / inside.sum(), around)
    elif name == "matrix":
        row, column = (_PROFILE[np.arange(n) * MATRIX_ZONES // n] for n in (height, width))
        weights = np.outer(row, column)
    else:
        area = SPOT_AREA * height * width / height**2  # in frame heights squared
        weights = (radius <= np.sqrt(area / np.pi)).astype(np.float64)
    return np.asarray((weights / weights.sum()).astype(np.float32))


def weighted_reading(
    observations: Observations, estimate: Floats | None = None, *, camera: CameraProfile, name: str
) -> Reading:
    """EV of the weighted mean signal, with the weights of `weight_map`."""
    signal = linear_signal(observations["raw"], camera, GREEN)
    weights: NDArray[Any] = weight_map(name, *signal.shape[-2:])
    if (mask := observations.get("mask")) is not None:
        weights = weights * mask if (weights * mask).any() else mask.astype(np.float32)
        weights /= weights.sum()
    weights = weights.ravel() / 2
    flat = signal.reshape(len(signal), 2, -1)
    mean = np.einsum("ncp,p->n", flat, weights, dtype=np.float64)
    saturated = np.einsum("ncp,p->n", (flat >= WHITE_SIGNAL).astype(np.float32), weights)
    return mean_reading(mean, saturated.astype(np.float64), frame_ev100(observations))


def matrix_reading(
    observations: Observations, estimate: Floats | None = None, *, camera: CameraProfile
) -> Reading:
    """Multi-zone metering: contrast-aware zones, then highlight and shadow constraints.

    The frame is cut into 5 x 5 zones, as in modern AGCs. The reading is the centre-weighted mean of
    the zones' *log2* signals, so a lamp or the sun in one zone does not darken the rest. Then, as
    in the ``normal`` and ``highlight`` constraint modes of the Raspberry Pi's AGC, the brightest
    2 % of the pixels should be recorded between 0.5 and 0.8 of white at the
    metered EV: snow is lifted, a lit figure in front of the dark is held. Under a mask, a zone
    weighs by its share in it.
    """
    signal = linear_signal(observations["raw"], camera, GREEN).mean(axis=1)  # (N, h, w)
    ev = frame_ev100(observations)
    seen = observations.get("mask", np.ones(signal.shape[1:], bool))
    share = _zone_means(seen[None])  # (1, zones)
    known = np.where(share > 0.0, share, 1.0)
    level = np.log2(np.maximum(_zone_means(signal * seen) / known, BLACK_SIGNAL))
    weights = np.outer(_PROFILE, _PROFILE).ravel() * share[0]
    weights /= weights.sum()
    saturated = _zone_means((signal >= WHITE_SIGNAL) & seen) / known @ weights
    reading = mean_reading(np.exp2(level @ weights), saturated, ev)
    # Signal of the top pixels if the frame were taken at the metered EV.
    top = np.quantile(signal[:, seen], 1.0 - TOP_SHARE, axis=1)
    top_level = np.log2(np.maximum(top, BLACK_SIGNAL)) + (ev - reading.ev100)
    # A saturated top is brighter than it says, so it cannot be known to be too dark.
    too_bright = np.maximum(top_level - np.log2(TOP_AT_MOST), 0.0)
    too_dark = np.where(top < WHITE_SIGNAL, np.minimum(top_level - np.log2(TOP_AT_LEAST), 0.0), 0.0)
    correction = np.clip(too_bright + too_dark, -CONSTRAINT_LIMIT_EV, CONSTRAINT_LIMIT_EV)
    correction += MATRIX_CALIBRATION_EV
    return Reading(reading.ev100 + correction, reading.saturated, reading.black)


def _zone_means(images: NDArray[Any]) -> Floats:
    """Means over the zones, ``(N, zones)``, row by row."""
    for axis in (1, 2):
        if images.shape[axis] < MATRIX_ZONES:
            images = images.repeat(MATRIX_ZONES, axis=axis)
        size = images.shape[axis]
        starts = np.arange(MATRIX_ZONES) * size // MATRIX_ZONES
        counts = np.diff(starts, append=size)
        sums = np.add.reduceat(images, starts, axis=axis, dtype=np.float64)
        images = sums / np.expand_dims(counts, (0, 3 - axis))
    return images.reshape(len(images), -1)
