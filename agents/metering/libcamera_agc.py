"""The auto exposure and gain control of libcamera for the Raspberry Pi, on continuous settings.

Written from its published behaviour ("Raspberry Pi Camera Algorithm and Tuning Guide", libcamera
and its tuning of the imx477), and held to recordings of libcamera's own, frame by frame
(``ae-env bench libcamera``). The numbers of that tuning come first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: Weights of the 15 zones in each metering mode; the first is the centre.
ZONE_WEIGHTS = {
    "centre_weighted": (3, 3, 3, 2, 2, 2, 2, 1, 1, 1, 1, 0, 0, 0, 0),
    "spot": (2, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0),
    "matrix": (1,) * 15,
}


@dataclass(frozen=True)
class Ladder:
    """How an exposure mode splits an exposure: the shutter up to a rung, then the gain, and so on.

    Args:
        shutter: Rungs of the exposure time [s].
        gain: Rungs of the gain, 1 at ISO 100.
    """

    shutter: tuple[float, ...]
    gain: tuple[float, ...]


LADDERS = {
    "normal": Ladder((100e-6, 10e-3, 30e-3, 60e-3, 66.666e-3), (1.0, 2.0, 4.0, 6.0, 16.0)),
    "short": Ladder((100e-6, 5e-3, 10e-3, 20e-3, 66.666e-3), (1.0, 2.0, 4.0, 6.0, 16.0)),
    "long": Ladder((100e-6, 10e-3, 30e-3, 60e-3, 120e-3), (1.0, 2.0, 4.0, 6.0, 16.0)),
}


@dataclass(frozen=True)
class Constraint:
    """The mean of the pixels between two quantiles must not be below, or above, a target.

    Args:
        lower: Whether the target is a lower bound.
        quantiles: Between which the pixels are averaged.
        target: Signal, white is 1.
    """

    lower: bool
    quantiles: tuple[float, float]
    target: float


_TOP = Constraint(True, (0.98, 1.0), 0.3)
CONSTRAINTS = {
    "normal": (_TOP,),
    "highlight": (_TOP, Constraint(False, (0.98, 1.0), 0.8)),
    "shadows": (Constraint(True, (0.0, 0.5), 0.17),),
}

#: Illuminance [lux] and the mean signal aimed at; linear between, constant outside.
TARGET_LUX, TARGET_SIGNALS = (0.0, 1000.0, 10000.0), (0.16, 0.165, 0.17)
#: Illuminance that is assumed where none is known [lux].
DEFAULT_LUX = 400.0
#: No target is above this, whatever the compensation: close to white a mean says nothing.
TARGET_LIMIT = 0.9
#: Bins of the histogram that constraints read.
HISTOGRAM_BINS = 128
#: Share of the distance to the target that the filter goes per frame.
SPEED = 0.2
#: Within this of the target the filter goes with the square root of its speed.
NEAR = 0.2
#: Within this of the target it stays.
STABLE = 0.02
#: Frames of the start, in which it goes all of the way.
STARTUP_FRAMES = 10
#: A target above this that the picture exceeds is approached from below, at this part of the
#: exposure.
FAST_REDUCE = 0.4
#: Passes in which the gain is found (zones saturate), the most that one may add, and when to stop.
GAIN_PASSES, GAIN_LIMIT, GAIN_DONE = 8, 10.0, 1.01
#: Added to a mean by which a target is divided.
_LEAST_SIGNAL = 1e-3


class LibcameraAgc:
    """The algorithm for N cameras: statistics of a frame in, the next exposure out.

    Each frame: the mean of 15 weighted zones gives a gain, which the constraints on the brightest
    or darkest pixels may change; the gain and the exposure *of that frame* give the target; a
    filter moves a continuous exposure towards it; the ladder of the exposure mode splits that into
    shutter and gain. Settings reach a sensor frames later, which the algorithm allows for as it
    counts from what each frame was taken with.

    Args:
        num_cameras: N.
        metering: A name of `ZONE_WEIGHTS`.
        constraint: A name of `CONSTRAINTS`.
        ladder: An exposure mode, of `LADDERS` or of one's own.
        compensation: Exposure compensation [EV], positive is brighter.
        max_exposure_time: Longest that the sensor or the user allows [s].
        exposure_time: Fixed exposure time [s], in place of the ladder's.
        gain: Fixed gain, in place of the ladder's.
        flicker_period: Period of the lamps' light [s], such as 0.01: exposure times of a period
            and more are whole periods, and the gain makes up for it.
        speed: Share of the distance to the target that the filter goes per frame, in (0, 1].
        startup_frames: Frames at first in which it goes all of the way.
    """

    def __init__(
        self,
        num_cameras: int,
        *,
        metering: str = "centre_weighted",
        constraint: str = "normal",
        ladder: Ladder = LADDERS["normal"],
        compensation: float = 0.0,
        max_exposure_time: float | None = None,
        exposure_time: float | None = None,
        gain: float | None = None,
        flicker_period: float | None = None,
        speed: float = SPEED,
        startup_frames: int = STARTUP_FRAMES,
    ) -> None:
        self.weights = np.array(ZONE_WEIGHTS[metering], np.float64)
        self.constraints = CONSTRAINTS[constraint]
        self.ladder, self.compensation = ladder, compensation
        self.max_exposure_time = np.inf if max_exposure_time is None else max_exposure_time
        self.exposure_time, self.gain, self.flicker_period = exposure_time, gain, flicker_period
        self._filter = ExposureFilter(num_cameras, speed, startup_frames)

    def update(
        self,
        zones: Floats,
        histogram: Floats,
        exposure: Floats,
        lux: Floats | float = DEFAULT_LUX,
    ) -> Floats:
        """Takes in one frame of each camera; returns the exposure [s] that is wanted, ``(N,)``.

        Args:
            zones: Mean signal of each zone, ``(N, 15)``; white is 1.
            histogram: Of the signals of all pixels, from 0 to 1, ``(N, bins)`` counts.
            exposure: Exposure time x gain that the frame was taken with [s], ``(N,)``.
            lux: Illuminance, of each or of all.
        """
        factor, target_signal = self._factor(zones, histogram, lux)
        target = np.minimum(exposure * factor, self.most_exposure)
        filtered = self._filter.update(target)
        reduce = (target_signal > FAST_REDUCE) & (factor < np.sqrt(target_signal))
        return filtered * np.where(reduce, FAST_REDUCE, 1.0)

    @property
    def most_exposure(self) -> float:
        """The most exposure time x gain that the ladder and what is fixed allow [s]."""
        times, gains = self.ladder.shutter, self.ladder.gain
        time = times[-1] if self.exposure_time is None else self.exposure_time
        gain = gains[-1] if self.gain is None else self.gain
        return float(min(time, self.max_exposure_time) * gain)

    def _factor(
        self, zones: Floats, histogram: Floats, lux: Floats | float
    ) -> tuple[Floats, Floats]:
        """By what the exposure of the frames must change, and the signal it aims at, ``(N,)``."""
        wanted = self._compensated(
            np.broadcast_to(np.interp(lux, TARGET_LUX, TARGET_SIGNALS), len(zones))
        )
        factor = zone_factor(zones, self.weights, wanted)
        for constraint in self.constraints:
            bound = self._compensated(np.full(len(factor), constraint.target))
            other = bound / inter_quantile_mean(histogram, *constraint.quantiles)
            adopted = other > factor if constraint.lower else other < factor
            factor, wanted = np.where(adopted, other, factor), np.where(adopted, bound, wanted)
        return factor, wanted

    def _compensated(self, signal: Floats) -> Floats:
        target: Floats = np.minimum(signal * 2.0**self.compensation, TARGET_LIMIT)
        return target

    def split(self, exposure: Floats) -> tuple[Floats, Floats]:
        """Exposure time [s] and gain of `exposure` [s], ``(N,)`` each, by the ladder.

        A rung at a time: the shutter goes up to its next value, then the gain.
        """
        limit = self.max_exposure_time
        first_time = self.ladder.shutter[0] if self.exposure_time is None else self.exposure_time
        time = np.full_like(exposure, min(first_time, limit))
        gain = np.full_like(exposure, self.ladder.gain[0] if self.gain is None else self.gain)
        rungs = zip(self.ladder.shutter[1:], self.ladder.gain[1:], strict=True)
        for shutter_rung, gain_rung in rungs:
            if self.exposure_time is None:
                time = np.maximum(time, np.minimum(exposure / gain, min(shutter_rung, limit)))
            if self.gain is None:
                gain = np.maximum(gain, np.minimum(exposure / time, gain_rung))
        fixed = self.exposure_time is not None or self.gain is not None
        if self.flicker_period is not None and not fixed:
            periods = np.floor(time / self.flicker_period + 1e-9)
            whole = np.where(periods > 0, periods * self.flicker_period, time)
            time, gain = whole, np.minimum(gain * time / whole, max(self.ladder.gain))
        return time, gain


class ExposureFilter:
    """The AGC's filter: a continuous exposure that goes a part of the way at every frame.

    Args:
        num_cameras: Cameras.
        speed: Part of the (linear) distance that it goes; the square root of it within 20 % of the
            target, nothing within 2 %.
        startup_frames: Frames at first in which it goes all of the way.

    >>> follow = ExposureFilter(1, startup_frames=0)
    >>> [round(float(follow.update(np.array([x]))[0]), 3) for x in (1.0, 16.0, 16.0)]
    [1.0, 4.0, 6.4]
    """

    def __init__(
        self,
        num_cameras: int,
        speed: float = SPEED,
        startup_frames: int = STARTUP_FRAMES,
    ) -> None:
        self.exposure = np.full(num_cameras, np.nan)
        self.speed, self.startup_frames = speed, startup_frames
        self._frames = 0

    def update(self, target: Floats) -> Floats:
        """Take in the target of a frame, ``(N,)``; returns the exposures."""
        self._frames += 1
        old = self.exposure
        if self._frames <= self.startup_frames:
            new = target.copy()
        else:
            near = (old < (1.0 + NEAR) * target) & (old > (1.0 - NEAR) * target)
            speed = np.where(near, np.sqrt(self.speed), self.speed)
            new = speed * target + (1.0 - speed) * old
            stable = (old * (1.0 - STABLE) < target) & (old * (1.0 + STABLE) > target)
            new = np.where(np.isnan(old), target, np.where(stable, old, new))
        self.exposure = new
        return new.copy()


def zone_factor(zones: Floats, weights: Floats, wanted: Floats) -> Floats:
    """Factor that brings the weighted mean of the zones to `wanted`, ``(N,)``.

    A zone that saturates gives no more, so the factor is raised in several passes.

    Args:
        zones: Mean signal of each zone, ``(N, 15)``.
        weights: ``(15,)``.
        wanted: ``(N,)``.
    """
    factor = np.ones(len(zones))
    done = np.zeros(len(zones), bool)
    for _ in range(GAIN_PASSES):
        mean = np.minimum(zones * factor[:, None], 1.0) @ weights / weights.sum()
        extra = np.minimum(GAIN_LIMIT, wanted / (mean + _LEAST_SIGNAL))
        factor = np.where(done, factor, factor * extra)
        done |= extra < GAIN_DONE
        if done.all():
            break
    return factor


def signal_histogram(signals: NDArray[Any]) -> Floats:
    """``(N, HISTOGRAM_BINS)`` counts of `signals` ``(N, P)`` in bins from 0 to 1."""
    bins = np.clip(signals * HISTOGRAM_BINS, 0, HISTOGRAM_BINS - 1).astype(np.int64)
    rows = np.arange(len(bins))[:, None] * HISTOGRAM_BINS
    counts = np.bincount((bins + rows).ravel(), minlength=len(bins) * HISTOGRAM_BINS)
    return counts.reshape(len(bins), HISTOGRAM_BINS).astype(np.float64)


def inter_quantile_mean(histogram: Floats, low: float, high: float) -> Floats:
    """Mean signal of the pixels between two quantiles, ``(N,)``; those of a bin are at its middle.

    Args:
        histogram: ``(N, bins)`` counts of the signals from 0 to 1.
        low: Lower quantile.
        high: Upper quantile; at least one pixel is averaged.
    """
    bins = histogram.shape[1]
    above = np.cumsum(histogram, axis=1)
    total = above[:, -1:]
    begin = np.minimum(np.floor(low * total), total - 1.0)
    end = np.maximum(np.floor(high * total), begin + 1.0)
    counted = np.clip(above, begin, end) - np.clip(above - histogram, begin, end)
    mean: Floats = counted @ (np.arange(bins) + 0.5) / (counted.sum(axis=1) * bins)
    return mean
