"""Reflected-light metering of raw frames: what exposure value does the frame in hand suggest?

Every meter undoes the observation's companding, measures the linear green signal against the
calibration of the exposure scale (an 18 % card is recorded at 0.12 of sensor white when the state's
EV equals that of the incident light) and adds the EV100 at which the frame was taken. The first
meters weigh pixels or zones. The others simulate other exposures of the frame on its histogram: the
signal is multiplied, clipped at white, encoded as sRGB and counted again. A code of the observation
stands for all signals that round to it, so its pixels are spread evenly over them: brightening does
not tear holes into the histogram. Those of `gradient_meters` follow gradients.
"""

from __future__ import annotations

import functools
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ae_env.observation import PEDESTAL
from agents.metering.reading import (
    BLACK_SIGNAL,
    CODE_SIGNALS,
    CODES,
    GREEN,
    SATURATED_STEP_EV,
    TARGET_SIGNAL,
    WHITE_SIGNAL,
    Floats,
    Meter,
    Reading,
    frame_ev100,
    linear_signal,
    mean_reading,
    signal_codes,
)
from agents.policy import Observations
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
TOP_SHARE, TOP_AT_LEAST, TOP_AT_MOST, CONSTRAINT_LIMIT_EV = 0.02, 0.5, 0.8, 3.0
#: What the zones' logarithms and the constraints together read too low on the ordinary (not hard)
#: training scenes, against the incident light [EV].
MATRIX_CALIBRATION_EV = 0.7
#: Quantile of the largest of the four planes that is exposed to the right, and how bright.
HIGHLIGHT_QUANTILE, HIGHLIGHT_SIGNAL = 0.99, 0.9
#: A frame whose highlights are saturated counts as saturated by at least this share.
HIGHLIGHT_SATURATED = 0.51
#: Exposures that a search tries, in EV from the frame in hand, positive is brighter.
SEARCH_EV = np.arange(-6.0, 6.01, 0.25)
#: Bins of the simulated histogram.
BINS = 256
#: An 18 % card is shown at 0.18: the picture's signal relative to the raw's.
_DEVELOPED_GAIN = 0.18 / TARGET_SIGNAL


def make_meter(name: str, camera: CameraProfile) -> Meter:
    """The meter called `name`, one of `agents.policy_names.METERS`, for `camera`.

    Raises:
        ValueError: If there is none; the message proposes the nearest name.
    """
    check_word("meter", name, METERS)
    if name in ("average", "centre_weighted", "spot"):
        return functools.partial(weighted_reading, camera=camera, name=name)
    module: Any = sys.modules[__name__]
    if name in ("shim", "zhang"):
        from agents.metering import gradient_meters as module
    return functools.partial(getattr(module, f"{name}_reading"), camera=camera)


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
    normalised: NDArray[np.float32] = (weights / weights.sum()).astype(np.float32)
    return normalised


def weighted_reading(
    observations: Observations,
    estimate: Floats | None = None,
    *,
    camera: CameraProfile,
    name: str,
) -> Reading:
    """EV of the weighted mean signal, with the weights of `weight_map`."""
    signal = linear_signal(observations["raw"], camera, GREEN)
    weights = weight_map(name, *signal.shape[-2:]).ravel() / 2
    flat = signal.reshape(len(signal), 2, -1)
    mean = np.einsum("ncp,p->n", flat, weights, dtype=np.float64)
    saturated = np.einsum("ncp,p->n", (flat >= WHITE_SIGNAL).astype(np.float32), weights)
    return mean_reading(mean, saturated.astype(np.float64), frame_ev100(observations))


def matrix_reading(
    observations: Observations,
    estimate: Floats | None = None,
    *,
    camera: CameraProfile,
) -> Reading:
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
    reading = mean_reading(np.exp2(level @ weights), saturated, ev)
    # Signal of the top pixels if the frame were taken at the metered EV.
    top = np.quantile(signal.reshape(len(ev), -1), 1.0 - TOP_SHARE, axis=1)
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
        size = images.shape[axis]
        starts = np.arange(MATRIX_ZONES) * size // MATRIX_ZONES
        counts = np.diff(np.append(starts, size))
        shape = (1, -1, 1) if axis == 1 else (1, 1, -1)
        sums = np.add.reduceat(images, starts, axis=axis, dtype=np.float64)
        images = sums / counts.reshape(shape)
    return images.reshape(len(images), -1)


def _zone_weights() -> Floats:
    """Centre weighting of the zones, summing to 1."""
    offset = np.arange(MATRIX_ZONES) - (MATRIX_ZONES - 1) / 2
    profile = np.exp(-0.5 * (offset / MATRIX_SIGMA) ** 2)
    weights: Floats = np.outer(profile, profile).ravel()
    weights /= weights.sum()
    return weights


# -- meters that look at the histogram -------------------------------------------------------------


def highlight_weighted_reading(
    observations: Observations, estimate: Floats | None = None, *, camera: CameraProfile
) -> Reading:
    """Expose to the right: EV that puts the 99th percentile of the highlights at 0.9 of white.

    Of each pixel the brightest of its four planes counts. A frame in which more than 1 % of the
    pixels are saturated says only that the light is brighter than that: it reads 1.5 to 3 EV more.
    """
    codes = signal_codes(observations["raw"], camera).max(axis=1)
    shares = _shares(codes)
    top = _quantile_signal(np.cumsum(shares, axis=1), HIGHLIGHT_QUANTILE)
    white = top >= WHITE_SIGNAL
    blown = shares[:, CODE_SIGNALS >= WHITE_SIGNAL].sum(axis=1)
    saturated = np.where(white, HIGHLIGHT_SATURATED + (1.0 - HIGHLIGHT_SATURATED) * blown, 0.0)
    level = np.log2(np.maximum(top, BLACK_SIGNAL) / HIGHLIGHT_SIGNAL)
    ev = frame_ev100(observations) + level + SATURATED_STEP_EV * saturated
    return Reading(ev, saturated, top <= BLACK_SIGNAL)


def skewness_reading(
    observations: Observations, estimate: Floats | None = None, *, camera: CameraProfile
) -> Reading:
    """EV at which the histogram leans neither way: no skewness about mid-grey.

    The third moment of the sRGB code about that of an 18 % card, ``E[(z - z0)^3]``, is negative for
    a dark picture, positive for a bright one, and rises with the exposure; the exposure at which it
    is 0 is looked for. (About the *mean*, as textbooks have it, the skewness of a power-law code
    does not depend on the exposure until something clips.)
    """
    shares, ev = _green_shares(observations, camera), frame_ev100(observations)
    exposed = _exposed(shares, SEARCH_EV, _DEVELOPED_GAIN)  # (N, K, BINS)
    centres = (np.arange(BINS) + 0.5) / BINS - encoded(np.array(0.18))
    moment = np.cbrt(exposed @ centres**3)  # (N, K), rising with the exposure
    crossing = np.array([np.interp(0.0, row, SEARCH_EV) for row in moment])
    return _search_reading(shares, ev, crossing)


def entropy_reading(
    observations: Observations, estimate: Floats | None = None, *, camera: CameraProfile
) -> Reading:
    """EV at which the histogram of 256 grey levels has the highest entropy.

    Noise counts as detail: entropy likes gain.
    """
    shares, ev = _green_shares(observations, camera), frame_ev100(observations)
    exposed = _exposed(shares, SEARCH_EV)  # (N, K, BINS)
    entropy = -(exposed * np.log2(np.maximum(exposed, 1e-30))).sum(axis=2)
    return _search_reading(shares, ev, peak(entropy, SEARCH_EV))


def peak(values: Floats, positions: Floats) -> Floats:
    """Where each row of `values` is highest: the top of the parabola through its best three.

    Args:
        values: ``(N, K)`` at evenly spaced `positions`; of equal ones that nearest to 0 counts.
        positions: ``(K,)``.

    Returns:
        ``(N,)``, within `positions`.
    """
    best = np.argmax(values.round(9) - 1e-9 * np.abs(positions), axis=1)
    inner = np.clip(best, 1, len(positions) - 2)[:, None]
    left, middle, right = (np.take_along_axis(values, inner + i, axis=1)[:, 0] for i in (-1, 0, 1))
    curvature = left - 2.0 * middle + right
    found: Floats = positions[best].astype(np.float64)
    fits = (curvature < -1e-12) & (best == inner[:, 0])
    offset = 0.5 * (left - right) / np.where(fits, curvature, -1.0)
    found += np.where(fits, offset, 0.0) * (positions[1] - positions[0])
    return found


def _green_shares(observations: Observations, camera: CameraProfile) -> Floats:
    return _shares(signal_codes(observations["raw"], camera, GREEN))


def _shares(codes: NDArray[np.uint8]) -> Floats:
    """Share of each code, ``(N, 256)``."""
    flat = codes.reshape(len(codes), -1)
    counts = [np.bincount(row, minlength=CODES) for row in flat]
    shares: Floats = np.array(counts, np.float64).reshape(-1, CODES) / flat.shape[1]
    return shares


def _quantile_signal(cumulated: Floats, quantile: float) -> Floats:
    """Signal below which `quantile` of the pixels lie, ``(N,)``."""
    index = np.argmax(cumulated >= quantile - 1e-12, axis=1)
    signal: Floats = CODE_SIGNALS[index]
    return signal


def _exposed(shares: Floats, evs: Floats, gain: float = 1.0) -> Floats:
    """Histograms of sRGB codes of the frames at other exposures, ``(N, K, BINS)``.

    Args:
        shares: Share of each code of the observation, ``(N, 256)``.
        evs: Exposures relative to the frame's [EV], ``(K,)``.
        gain: Factor that is also applied to the signal.
    """
    below, rest = _edges(tuple(evs), gain)
    cumulated = np.concatenate([np.zeros((len(shares), 1)), np.cumsum(shares, axis=1)], axis=1)
    lower = cumulated[:, below]
    at_edges = lower + rest * (cumulated[:, below + 1] - lower)  # (N, K, BINS - 1)
    ends = np.broadcast_to([0.0, 1.0], (*at_edges.shape[:2], 2))
    return np.diff(np.concatenate([ends[..., :1], at_edges, ends[..., 1:]], axis=2), axis=2)


@functools.lru_cache(maxsize=8)
def _edges(evs: tuple[float, ...], gain: float) -> tuple[NDArray[np.intp], Floats]:
    """Where the inner edges of the simulated bins lie among those of the observation's codes.

    Returns:
        ``(K, BINS - 1)``: the code below, and the part of it.
    """
    import torch

    from ae_env.scorers.luma import srgb_decode

    # What the edge is of the exposed picture.
    linear = srgb_decode(torch.arange(1, BINS, dtype=torch.float64) / BINS).numpy()
    signal = linear / (gain * np.exp2(np.array(evs))[:, None])
    position = (CODES - 1) * np.sqrt((signal + PEDESTAL) / (1.0 + PEDESTAL)) + 0.5
    position = np.minimum(position, CODES - 1e-9)
    below = position.astype(np.intp)
    return below, position - below


def _search_reading(shares: Floats, ev: Floats, found: Floats) -> Reading:
    """The reading of a search that wants the frame `found` EV brighter, ``(N,)``.

    What is saturated cannot be seen at a lower exposure: it adds to the reading as for any meter.
    """
    saturated = shares[:, CODE_SIGNALS >= WHITE_SIGNAL].sum(axis=1)
    black = shares @ CODE_SIGNALS <= BLACK_SIGNAL
    return Reading(ev - found + SATURATED_STEP_EV * saturated, saturated, black)


def encoded(linear: NDArray[Any]) -> Floats:
    """Linear light in [0, 1] as sRGB, see `simulator.raw.develop.srgb_encode`."""
    import torch

    from simulator.raw.develop import srgb_encode

    return np.asarray(srgb_encode(torch.from_numpy(np.asarray(linear, np.float64))))
