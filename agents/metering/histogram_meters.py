"""Meters that look at the histogram: of the frame, or of the frame exposed in another way.

Another exposure of the frame in hand is simulated on its histogram: the signal is multiplied,
clipped at white, encoded as sRGB and counted again. A code of the observation stands for all
signals that round to it, so its pixels are spread evenly over them: brightening does not tear holes
into the histogram.
"""

from __future__ import annotations

import functools
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
    Reading,
    frame_ev100,
    signal_codes,
)
from agents.policy import Observations
from simulator.camera import CameraProfile

Floats = NDArray[np.float64]

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
    moved = _exposed(shares, SEARCH_EV, _DEVELOPED_GAIN)  # (N, K, BINS)
    centres = (np.arange(BINS) + 0.5) / BINS - encoded(np.array(0.18))
    moment = np.cbrt(moved @ centres**3)  # (N, K), rising with the exposure
    crossing = np.array([np.interp(0.0, row, SEARCH_EV) for row in moment])
    return _search_reading(shares, ev, crossing)


def entropy_reading(
    observations: Observations, estimate: Floats | None = None, *, camera: CameraProfile
) -> Reading:
    """EV at which the histogram of 256 grey levels has the highest entropy.

    Noise counts as detail: entropy likes gain.
    """
    shares, ev = _green_shares(observations, camera), frame_ev100(observations)
    moved = _exposed(shares, SEARCH_EV)  # (N, K, BINS)
    entropy = -(moved * np.log2(np.maximum(moved, 1e-30))).sum(axis=2)
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

    from ae_env.scorers.measures import srgb_decode

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
