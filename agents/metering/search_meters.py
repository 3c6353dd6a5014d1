"""Meters that look for an exposure: on the histogram, or where gradients are strongest.

They simulate other exposures of the frame in hand: the signal is multiplied, clipped at white and
encoded as sRGB. A code of the observation stands for all signals that round to it, so in a
histogram its pixels are spread evenly over them: brightening does not tear holes into it.

Shim's and Zhang's meters improve on the estimate that the controller holds, a step at each frame.
The frame is exposed again at that estimate first: so the steps add up on a grid of whole stops, and
with a delay no step is taken twice.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ae_env.observation import PEDESTAL
from agents.metering.reading import (
    BLACK_SIGNAL,
    CODE_SIGNALS,
    CODES,
    GREEN,
    SATURATED_SEEN,
    SATURATED_STEP_EV,
    TARGET_SIGNAL,
    WHITE_SIGNAL,
    Reading,
    frame_ev100,
    inside,
    signal_codes,
)
from agents.policy import Bools, Floats, Observations
from simulator.camera import CameraProfile

#: Quantile of the largest of the four planes that is exposed to the right, and how bright; a frame
#: whose highlights are saturated counts as saturated by at least the third.
HIGHLIGHT_QUANTILE, HIGHLIGHT_SIGNAL, HIGHLIGHT_SATURATED = 0.99, 0.9, 0.51
#: Exposures that a search tries, in EV from the frame in hand, positive is brighter; and bins of
#: the simulated histogram.
SEARCH_EV, BINS = np.arange(-6.0, 6.01, 0.25), 256
#: An 18 % card is shown at 0.18: the picture's signal relative to the raw's.
_DEVELOPED_GAIN = 0.18 / TARGET_SIGNAL
#: Gammas that Shim's search tries; below 1 brightens.
GAMMAS = (0.1, 0.5, 0.8, 1.0, 1.2, 1.5, 1.9)
#: Speed K_p and shape d of Shim's update, and the least factor of the exposure in one step of it.
SHIM_SPEED, SHIM_SHAPE, SHIM_LEAST = 2.0, 1.0, 0.125
#: Zhang's step: EV per relative change of the metric and EV; its bound [EV]; half of the distance
#: of the two exposures from which the derivative is taken [EV].
ZHANG_RATE, ZHANG_LIMIT_EV, ZHANG_DELTA_EV = 3.0, 2.0, 0.25
#: How often a step that lowers the metric is halved before it is given up; and by how many EV the
#: frame in hand is exposed again at most.
HALVINGS, SIMULATED_EV = 4, 4.0
#: From a saturated share s of 0.1 on, a frame is too bright by 4 (s - 0.1) EV or more.
SATURATED_LIMIT, SATURATED_SLOPE_EV = 0.1, 4.0
#: A frame without a gradient that is so far below the target is exposed for it, in steps of at
#: most so much [EV].
DARK_FROM_EV, DARK_STEP_EV = 1.0, 2.0
#: Metric below which there is no gradient to follow.
_NO_GRADIENT = 1e-9


def highlight_weighted_reading(
    observations: Observations, estimate: Floats | None = None, *, camera: CameraProfile
) -> Reading:
    """Expose to the right: EV that puts the 99th percentile of the highlights at 0.9 of white.

    Of each pixel the brightest of its four planes counts. A frame in which more than 1 % of the
    pixels are saturated says only that the light is brighter than that: it reads 1.5 to 3 EV more.
    """
    shares = _shares(signal_codes(inside(observations), camera).max(axis=1))
    top = CODE_SIGNALS[np.argmax(np.cumsum(shares, axis=1) >= HIGHLIGHT_QUANTILE - 1e-12, axis=1)]
    blown = shares[:, CODE_SIGNALS >= WHITE_SIGNAL].sum(axis=1)
    share = HIGHLIGHT_SATURATED + (1.0 - HIGHLIGHT_SATURATED) * blown
    saturated = np.where(top >= WHITE_SIGNAL, share, 0.0)
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
    shares = _shares(signal_codes(inside(observations), camera, GREEN))
    exposed = _exposed(shares, SEARCH_EV, _DEVELOPED_GAIN)  # (N, K, BINS)
    centres = (np.arange(BINS) + 0.5) / BINS - encoded(np.array(0.18))
    moment = np.cbrt(exposed @ centres**3)  # (N, K), rising with the exposure
    crossing = np.array([np.interp(0.0, row, SEARCH_EV) for row in moment])
    return _search_reading(shares, frame_ev100(observations), crossing)


def entropy_reading(
    observations: Observations, estimate: Floats | None = None, *, camera: CameraProfile
) -> Reading:
    """EV at which the histogram of 256 grey levels has the highest entropy.

    Noise counts as detail: entropy likes gain.
    """
    shares = _shares(signal_codes(inside(observations), camera, GREEN))
    exposed = _exposed(shares, SEARCH_EV)  # (N, K, BINS)
    entropy = -(exposed * np.log2(np.maximum(exposed, 1e-30))).sum(axis=2)
    return _search_reading(shares, frame_ev100(observations), peak(entropy, SEARCH_EV))


def peak(values: Floats, positions: Floats, best: NDArray[np.intp] | None = None) -> Floats:
    """Where each row of `values` (N, K) is highest: the top of the parabola through its best three.

    `positions` (K,) ascend. `best` (N,) are the indices of the highest values; by default, of equal
    ones, that at the position nearest to 0.
    """
    if best is None:
        best = np.argmax(values.round(9) - 1e-9 * np.abs(positions), axis=1)
    inner = np.clip(best, 1, len(positions) - 2)
    left, middle, right = (positions[inner + i] for i in (-1, 0, 1))
    low, top, high = (values[np.arange(len(values)), inner + i] for i in (-1, 0, 1))
    rise, fall = (top - low) / (middle - left), (high - top) / (right - middle)
    curved = (fall - rise) / (right - left)
    fits = (best == inner) & (curved < -1e-12)
    found = 0.5 * (left + middle - rise / np.where(fits, curved, -1.0))
    return np.where(fits, np.clip(found, left, right), positions[best])


def _shares(codes: NDArray[np.uint8]) -> Floats:
    """Share of each code, ``(N, 256)``."""
    flat = codes.reshape(len(codes), -1)
    counts = [np.bincount(row, minlength=CODES) for row in flat]
    return np.array(counts, np.float64).reshape(-1, CODES) / flat.shape[1]


def _exposed(shares: Floats, evs: Floats, gain: float = 1.0) -> Floats:
    """Histograms ``(N, K, BINS)`` of sRGB codes at other exposures, ``(K,)`` [EV], of `_shares`."""
    below, rest = _edges(tuple(evs), gain)
    cumulated = np.pad(np.cumsum(shares, axis=1), ((0, 0), (1, 0)))
    lower = cumulated[:, below]
    at_edges = lower + rest * (cumulated[:, below + 1] - lower)  # (N, K, BINS - 1)
    return np.diff(at_edges, axis=2, prepend=0.0, append=1.0)


@functools.lru_cache(maxsize=8)
def _edges(evs: tuple[float, ...], gain: float) -> tuple[NDArray[np.intp], Floats]:
    """The code below each inner edge of the simulated bins (K, BINS - 1), and its part."""
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
    """The reading of a search that wants the frame `found` EV brighter, ``(N,)``."""
    # What is saturated cannot be seen at a lower exposure: it adds as for any meter.
    saturated = shares[:, CODE_SIGNALS >= WHITE_SIGNAL].sum(axis=1)
    black = shares @ CODE_SIGNALS <= BLACK_SIGNAL
    return Reading(ev - found + SATURATED_STEP_EV * saturated, saturated, black)


def encoded(linear: NDArray[Any]) -> Floats:
    """Linear light in [0, 1] as sRGB, see `simulator.raw.develop.srgb_encode`."""
    import torch

    from simulator.raw.develop import srgb_encode

    return np.asarray(srgb_encode(torch.from_numpy(np.asarray(linear, np.float64))))


def shim_reading(
    observations: Observations, estimate: Floats | None = None, *, camera: CameraProfile
) -> Reading:
    """One update of Shim's controller: it goes to the gamma that shows most gradient.

    The picture (sRGB luma in [0, 1]) is raised to the powers gamma of `GAMMAS`; that with the most
    gradient information (`ae_env.scorers.measures.shim_gradient`; between the powers, the top of a
    parabola) is g. The exposure is multiplied by ``1 + a K_p (R - 1)`` with
    ``R = 1 + d tan((1 - g) arctan(1 / d))``, a = 1/2 where g >= 1, else 1, K_p = 2, d = 1. A step
    that lowers the metric itself is halved: otherwise scenes with two peaks never come to rest.
    Where no gamma shows a gradient, a picture that is 1 EV or more below the average meter's target
    goes to it, at most 2 EV a frame.

    Source: I. Shim et al., IROS 2014 (metric and search); the nonlinear update is that of their
    "Gradient-based camera exposure control for outdoor mobile platforms", IEEE TCSVT 29(6), 2019.
    """
    import torch

    from ae_env.scorers.measures import shim_gradient

    frame = _Frame(observations, estimate, camera)
    base = _table(frame.shift)  # (N, CODES)
    shown = [torch.from_numpy(frame.luma(base**gamma)) for gamma in GAMMAS]
    metric = np.stack([shim_gradient(luma, frame.mask).numpy() for luma in shown], axis=1)
    found = peak(metric, np.array(GAMMAS), metric.argmax(axis=1))
    gamma = np.where(metric.max(axis=1) > _NO_GRADIENT, found, 1.0)
    ratio = SHIM_SHAPE * np.tan((1.0 - gamma) * math.atan(1.0 / SHIM_SHAPE))  # R - 1
    factor = 1.0 + np.where(gamma >= 1.0, 0.5, 1.0) * SHIM_SPEED * ratio
    here = metric[:, GAMMAS.index(1.0)]
    step = np.log2(np.maximum(factor, SHIM_LEAST))
    rising = frame.rising(step, here, frame.metric(shim_gradient))
    return frame.reading(frame.lifted(rising, metric.max(axis=1)))


def zhang_reading(
    observations: Observations, estimate: Floats | None = None, *, camera: CameraProfile
) -> Reading:
    """One gradient step of Zhang's controller on the soft percentile of the squared gradient.

    With M = `ae_env.scorers.measures.zhang_gradient` of the picture (sRGB luma), the EV moves by
    ``3 d ln M / d EV``, at most 2 EV; the derivative is the difference of the frame exposed a
    quarter of an EV brighter and darker, through the known response (sRGB, clipped). A step that
    lowers M is halved: M has a kink where pixels begin to clip. Where M is 0, a picture that
    is 1 EV or more below the average meter's target goes to it.

    Source: Z. Zhang, C. Forster, D. Scaramuzza, ICRA 2017 (p 0.7, k 5); relative to M, because its
    size differs between scenes by orders of magnitude.
    """
    from ae_env.scorers.measures import zhang_gradient

    frame = _Frame(observations, estimate, camera)
    metric = frame.metric(zhang_gradient)
    zero = np.zeros(len(frame.ev))
    here = metric(zero)
    brighter, darker = metric(zero + ZHANG_DELTA_EV), metric(zero - ZHANG_DELTA_EV)
    rise = np.where(frame.shows(zero - ZHANG_DELTA_EV), 0.5 * (brighter - darker), brighter - here)
    slope = rise / (ZHANG_DELTA_EV * np.maximum(here, _NO_GRADIENT))
    step = np.clip(ZHANG_RATE * slope, -ZHANG_LIMIT_EV, ZHANG_LIMIT_EV)
    return frame.reading(frame.lifted(frame.rising(step, here, metric), np.maximum(here, brighter)))


class _Frame:
    """The frames in hand, to be exposed again at the controller's estimate."""

    def __init__(
        self, observations: Observations, estimate: Floats | None, camera: CameraProfile
    ) -> None:
        self.ev = frame_ev100(observations)
        held = self.ev if estimate is None else np.where(np.isnan(estimate), self.ev, estimate)
        #: How much brighter than the frame its simulation is [EV].
        self.shift = np.clip(self.ev - held, -SIMULATED_EV, SIMULATED_EV)
        self.codes = signal_codes(observations["raw"], camera, GREEN)
        #: Pixels that count, (h, w) bool; None for all.
        self.mask = observations.get("mask")
        shown = inside({**observations, "raw": self.codes})
        signal = CODE_SIGNALS.astype(np.float32)[shown].reshape(len(self.codes), -1)
        self._mean = signal.mean(axis=1, dtype=np.float64)
        self._share = (signal >= WHITE_SIGNAL).mean(axis=1)

    def luma(self, tables: Floats) -> NDArray[np.float32]:
        """Luma of the frames ``(N, h, w)`` through a table of their own each, ``(N, CODES)``."""
        shown = zip(tables.astype(np.float32), self.codes, strict=True)
        return np.stack([table[codes].mean(axis=0) for table, codes in shown])

    def metric(self, function: Callable[..., Any]) -> Callable[[Floats], Floats]:
        """`function` of the luma, as one of how much brighter than the estimate it is [EV]."""
        import torch

        def measure(brighter: Floats) -> Floats:
            luma = torch.from_numpy(self.luma(_table(self.shift + brighter)))
            return np.asarray(function(luma, self.mask))

        return measure

    def shows(self, brighter: Floats) -> Bools:
        """Whether the simulation is true at `brighter` than the estimate [EV], ``(N,)``.

        What a saturated frame would show at less exposure than its own is not known.
        """
        return np.asarray((self._share < SATURATED_SEEN) | (self.shift + brighter >= 0.0))

    def rising(self, step: Floats, here: Floats, metric: Callable[[Floats], Floats]) -> Floats:
        """The steps [EV], halved where the metric would be below that `here` and known, or 0."""
        for _ in range(HALVINGS + 1):
            falls = (metric(step) < here) & ((step > 0.0) | self.shows(step))
            if not falls.any():
                return step
            step = np.where(falls, 0.5 * step, step)
        return np.where(falls, 0.0, step)

    def lifted(self, step: Floats, gradient: Floats) -> Floats:
        """The steps [EV], upwards in the dark where there is no `gradient`, all ``(N,)``."""
        missing = np.log2(TARGET_SIGNAL / np.maximum(self._mean, BLACK_SIGNAL)) - self.shift
        dark = (missing >= DARK_FROM_EV) & (gradient <= _NO_GRADIENT)
        return np.where(dark, np.minimum(missing, DARK_STEP_EV), step)

    def reading(self, brighter: Floats) -> Reading:
        """The reading of a step that makes the picture `brighter` by so many EV, ``(N,)``."""
        share, limit = self._share, SATURATED_LIMIT
        bound = np.where(share >= limit, self.ev + SATURATED_SLOPE_EV * (share - limit), -np.inf)
        ev = np.maximum(self.ev - self.shift - brighter, bound)
        black = self._mean <= BLACK_SIGNAL
        dark = self.ev + math.log2(BLACK_SIGNAL / TARGET_SIGNAL)
        return Reading(np.where(black, dark, ev), share, black)


def _table(shift: Floats) -> Floats:
    """sRGB of each code of the observation at `shift` EV more exposure, ``(N, CODES)``."""
    return encoded(np.clip(CODE_SIGNALS * np.exp2(shift)[:, None], 0.0, 1.0))
