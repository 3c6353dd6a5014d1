"""The auto exposure and gain control of libcamera for the Raspberry Pi.

`LibcameraAgc` works on continuous settings. It is written from libcamera's published behaviour
("Raspberry Pi Camera Algorithm and Tuning Guide", and its tuning of the imx477), and held to
recordings of libcamera's own, frame by frame (``tests/agents/metering``). `RpiAgc` takes the
nearest states of a grid. The numbers of that tuning come first; a file has others (`read_tuning`).
"""

import functools
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, BeforeValidator, Field, ValidationError

from ae_env.observation import linear_signal
from agents.metering.programs import PRIORITY_TIME, ProgramOptions, StateChooser, check_used
from agents.metering.reading import GREEN, TARGET_SIGNAL, Region, frame_ev100, parts_of
from agents.policy import Bools, Floats, Ints, Observations, Policy, PolicyContext, masked_argmax
from agents.policy_names import MANUAL_PROGRAMS
from simulator.utils.checks import check_integer, check_number, check_word
from simulator.utils.config_file import one_line
from simulator.utils.files import read_bounded

# -- tuning files ---------------------------------------------------------------------------------

#: Within this of the target the filter goes with the square root of its speed.
NEAR = 0.2
#: Zones a side on the Pi 5.
PISP_SIDE = 15


def _check_zones(weights: list[float]) -> list[float]:
    if len(weights) not in (15, PISP_SIDE**2) or not sum(weights) > 0.0:
        raise ValueError(f"must be 15 or {PISP_SIDE**2} weights, one of them above 0")
    return weights


def _check_pairs(numbers: list[float]) -> list[float]:
    if len(numbers) % 2 or not numbers or any(a >= b for a, b in pairwise(numbers[::2])):
        raise ValueError("must be pairs of illuminance and signal, sorted by illuminance")
    return numbers


def _in_seconds(ladder: "Ladder") -> "Ladder":
    """`ladder` with times in seconds, from microseconds."""
    alike = len(ladder.shutter) == len(ladder.gain) >= 2 and 0.0 not in ladder.gain
    if not alike or list(ladder.shutter) != sorted(ladder.shutter):
        raise ValueError("must have as many times as gains, two or more, above 0, the times sorted")
    return Ladder(tuple(time / 1e6 for time in ladder.shutter), ladder.gain)


_Number = Annotated[float, Field(ge=0.0, lt=np.inf)]
_Share = Annotated[float, Field(ge=0.0, le=1.0)]
_Name = Annotated[str, AfterValidator(lambda name: name.replace("-", "_"))]
#: Signal aimed at, 1 is white, by illuminance [lux]: pairs; linear between, constant outside.
_Target = Annotated[list[_Number], AfterValidator(_check_pairs)]
_Weights = Annotated[list[_Number], AfterValidator(_check_zones)]


@dataclass(frozen=True)
class Ladder:
    """How an exposure mode splits an exposure: the shutter up to a rung, then the gain, and so on.

    Rungs are exposure times [s], and gains that are 1 at ISO 100.
    """

    shutter: tuple[_Number, ...]
    gain: tuple[_Number, ...]


@dataclass(frozen=True)
class Constraint:
    """The mean of the pixels between two quantiles is at least (LOWER), or at most, a target."""

    bound: Annotated[Literal["LOWER", "UPPER"], BeforeValidator(lambda word: str(word).upper())]
    q_lo: _Share
    q_hi: _Share
    y_target: _Target


class Tuning(BaseModel, frozen=True):
    """``rpi.agc`` of a tuning file, with libcamera's defaults; the first mode of each is the usual.

    In memory times are in seconds, in the file in microseconds. Weights are of 15 zones, the centre
    first, or row by row of the 15 x 15 of the Pi 5.
    """

    metering_modes: dict[_Name, dict[Literal["weights"], _Weights]] = Field(min_length=1)
    exposure_modes: dict[_Name, Annotated[Ladder, AfterValidator(_in_seconds)]]
    constraint_modes: dict[_Name, list[Constraint]] = Field(min_length=1)
    y_target: _Target
    #: Share of the distance to the target that the filter goes per frame, and frames of the start,
    #: in which it goes all of the way.
    speed: float = Field(0.2, gt=0.0, le=1.0)
    startup_frames: int = Field(10, ge=0)
    base_ev: float = Field(1.0, gt=0.0, lt=np.inf)  # factor of all targets
    stable_region: _Share = 0.02  # within this of the target the filter stays
    #: A target above this that the picture exceeds is approached from below, at this part of the
    #: exposure.
    fast_reduce_threshold: _Share = 0.4


_TOP = Constraint("LOWER", 0.98, 1.0, [0.0, 0.3])
_GAINS = (1.0, 2.0, 4.0, 6.0, 16.0)
#: That of the imx477.
IMX477 = Tuning.model_construct(
    metering_modes={
        "centre_weighted": {"weights": [3, 3, 3, 2, 2, 2, 2, 1, 1, 1, 1, 0, 0, 0, 0]},
        "spot": {"weights": [2, 1, 1] + [0] * 12},
        "matrix": {"weights": [1] * 15},
    },
    exposure_modes={
        "normal": Ladder((100e-6, 10e-3, 30e-3, 60e-3, 66.666e-3), _GAINS),
        "short": Ladder((100e-6, 5e-3, 10e-3, 20e-3, 66.666e-3), _GAINS),
        "long": Ladder((100e-6, 10e-3, 30e-3, 60e-3, 120e-3), _GAINS),
    },
    constraint_modes={
        "normal": [_TOP],
        "highlight": [_TOP, Constraint("UPPER", 0.98, 1.0, [0.0, 0.8])],
        "shadows": [Constraint("LOWER", 0.0, 0.5, [0.0, 0.17])],
    },
    y_target=[0.0, 0.16, 1000.0, 0.165, 10000.0, 0.17],
)
#: Illuminance that is assumed where none is known [lux].
DEFAULT_LUX = 400.0
#: No target is above this, whatever the compensation: close to white a mean says nothing.
TARGET_LIMIT = 0.9
#: Bins of the histogram that constraints read.
HISTOGRAM_BINS = 128
#: Passes in which the gain is found (zones saturate), the most that one may add, and when to stop.
GAIN_PASSES, GAIN_LIMIT, GAIN_DONE = 8, 10.0, 1.01
#: Added to a mean by which a target is divided.
_LEAST_SIGNAL = 1e-3


def read_tuning(path: str | os.PathLike[str]) -> Tuning:
    """That of a tuning file of the Raspberry Pi's libcamera, of its first channel.

    A `ValueError` names the file, and the entry that is missing or wrong.
    """
    name, prefix = f"`tuning` (={os.fspath(path)!r})", "rpi.agc."
    try:
        content: Any = json.loads(read_bounded(Path(path).expanduser()))
        entries = content.get("algorithms", [content])  # files of version 1 have no list
        found = next(e["rpi.agc"] for e in entries if isinstance(e, dict) and "rpi.agc" in e)
        if "channels" in found:
            found, prefix = found["channels"][0], f"{prefix}channels.0."
        return Tuning.model_validate(found)
    except ValidationError as error:
        raise ValueError(f"{name}: {one_line(error, prefix)}") from error
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{name} must be a JSON file: {error}") from error
    except (AttributeError, LookupError, TypeError, StopIteration):
        rule = "an entry 'rpi.agc' in its 'algorithms', with one of 'channels' if it has them"
        raise ValueError(f"{name} must have {rule}") from None


@dataclass
class LibcameraAgc:
    """The algorithm for `num_cameras` N: statistics of a frame in, the next exposure out.

    Each frame: the mean of 15 weighted zones gives a gain, which the constraints on the brightest
    or darkest pixels may change; the gain and the exposure *of that frame* give the target; a
    filter moves a continuous exposure towards it; the ladder of the exposure mode splits that into
    shutter and gain. Settings reach a sensor frames later, which the algorithm allows for as it
    counts from what each frame was taken with. What has no comment is as of `RpiAgc`.
    """

    num_cameras: int
    _: KW_ONLY
    tuning: Tuning = IMX477
    metering: str = "centre_weighted"  # name of the tuning's `metering_modes`
    constraint: str = "normal"  # name of the tuning's `constraint_modes`
    ladder: Ladder = IMX477.exposure_modes["normal"]  # a tuning's, or of one's own
    compensation: float = 0.0
    max_exposure_time: float = np.inf  # longest that the sensor or the user allows [s]
    exposure_time: float | None = None  # a fixed one [s], in place of the ladder's
    gain: float | None = None  # a fixed one, in place of the ladder's
    flicker_period: float | None = None

    def __post_init__(self) -> None:
        #: Of the zones, (Z,); or (N, Z), of each camera's own.
        self.weights = np.array(self.tuning.metering_modes[self.metering]["weights"], np.float64)
        self.all_weights = self.weights
        self._filtered, self._frames = np.full(self.num_cameras, np.nan), 0

    def update(
        self, zones: Floats, histogram: Floats, exposure: Floats, lux: Floats | float = DEFAULT_LUX
    ) -> Floats:
        """Takes in one frame of each camera; returns the exposure [s] that is wanted, ``(N,)``.

        Of the frame are the mean signal of each of `zones` ``(N, Z)``, where white is 1; the
        `histogram` of all signals from 0 to 1, counts ``(N, bins)``; the `exposure` ``(N,)`` that
        it was taken with, time x gain [s]; and the illuminance.
        """
        brighter = self.tuning.base_ev * 2.0**self.compensation

        def aim(target: list[float]) -> Floats:
            aimed = np.broadcast_to(np.interp(lux, target[::2], target[1::2]), len(zones))
            return np.asarray(np.minimum(aimed * brighter, TARGET_LIMIT))

        wanted = aim(self.tuning.y_target)
        factor = zone_factor(zones, self.weights, wanted)
        for constraint in self.tuning.constraint_modes[self.constraint]:
            bound = aim(constraint.y_target)
            other = bound / inter_quantile_mean(histogram, constraint.q_lo, constraint.q_hi)
            adopted = other > factor if constraint.bound == "LOWER" else other < factor
            factor, wanted = np.where(adopted, other, factor), np.where(adopted, bound, wanted)
        time = self.ladder.shutter[-1] if self.exposure_time is None else self.exposure_time
        gain = self.ladder.gain[-1] if self.gain is None else self.gain
        most = min(time, self.max_exposure_time) * gain
        self._follow(np.minimum(exposure * factor, most))
        fast = self.tuning.fast_reduce_threshold
        reduce = (wanted > fast) & (factor < np.sqrt(wanted))
        return self._filtered * np.where(reduce, fast, 1.0)

    def _follow(self, target: Floats) -> None:
        """Moves the filtered exposure by `speed` of the (linear) distance to `target`, ``(N,)``.

        By the square root of it within 20 % of the target, not at all within 2 %, and all of the
        way in the first frames.
        """
        self._frames += 1
        old = self._filtered
        near = (old < (1.0 + NEAR) * target) & (old > (1.0 - NEAR) * target)
        tuning, stays = self.tuning, self.tuning.stable_region
        speed = np.where(near, np.sqrt(tuning.speed), tuning.speed)
        moved = speed * target + (1.0 - speed) * old
        stable = (old * (1.0 - stays) < target) & (old * (1.0 + stays) > target)
        begins = np.isnan(old) | (self._frames <= tuning.startup_frames)
        self._filtered = np.where(begins, target, np.where(stable, old, moved))

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


def zone_factor(zones: Floats, weights: Floats, wanted: Floats) -> Floats:
    """Factor that brings the weighted mean of `zones` (N, Z) to the signals `wanted`, ``(N,)``.

    A zone that saturates gives no more, so the factor is raised in several passes.
    """
    factor = np.ones(len(zones))
    done = np.zeros(len(zones), bool)
    for _ in range(GAIN_PASSES):
        mean = (np.minimum(zones * factor[:, None], 1.0) * weights).sum(axis=1)
        mean /= weights.sum(axis=-1)
        extra = np.minimum(GAIN_LIMIT, wanted / (mean + _LEAST_SIGNAL))
        factor = np.where(done, factor, factor * extra)
        done |= extra < GAIN_DONE
        if done.all():
            break
    return factor


def signal_histogram(signals: NDArray[Any]) -> Floats:
    """``(N, HISTOGRAM_BINS)`` counts of `signals` ``(N, P)`` in bins from 0 to 1."""
    bins = np.clip(signals * HISTOGRAM_BINS, 0, HISTOGRAM_BINS - 1).astype(np.int64)
    return np.array([np.bincount(row, minlength=HISTOGRAM_BINS) for row in bins], np.float64)


def inter_quantile_mean(histogram: Floats, low: float, high: float) -> Floats:
    """Mean signal of the pixels between two quantiles, at least one of them, ``(N,)``.

    `histogram` ``(N, bins)`` counts the signals from 0 to 1; those of a bin are at its middle.
    """
    bins = histogram.shape[1]
    above = np.cumsum(histogram, axis=1)
    total = above[:, -1:]
    begin = np.minimum(np.floor(low * total), total - 1.0)
    end = np.maximum(np.floor(high * total), begin + 1.0)
    counted = np.clip(above, begin, end) - np.clip(above - histogram, begin, end)
    return np.asarray(counted @ (np.arange(bins) + 0.5) / (counted.sum(axis=1) * bins))


#: Least signal from which the light is estimated.
_DARKEST = 1e-3
#: How near to whole periods a flicker-free exposure time is, as a part of it.
_PERIOD_TOLERANCE = 0.02
#: Advantage of the last state; the square of a stop counts 1.
_STAYS = 0.1
#: Cost of a state whose shutter lets lamps flicker where one nearby does not; the EV counts 1000
#: per stop. A state is nearby within this of the EV [EV], or where none is nearer.
_FLICKERS, _NEARBY_EV = 1e5, 0.5


class RpiAgc(Policy):
    """The Raspberry Pi's AGC (`LibcameraAgc`): the state of the grid that is nearest to it.

    Args:
        program: ``"P"``: the ladder, at an aperture of `f_number`; ``"A"``: the same, and no other
            aperture; ``"S"``: shutter by hand, the gain follows, and the aperture where the gain
            alone comes less near to the EV; ``"M"``: aperture and shutter by hand.
        tuning: A tuning file of libcamera (`read_tuning`); by default that of the imx477.
        metering: ``"centre_weighted"``, ``"spot"`` or ``"matrix"``: weights of the zones. Of this
            and the next two, a file may have others; the default is its first.
        mode: ``"normal"``, ``"short"`` or ``"long"``: the ladder.
        constraint: ``"normal"``, ``"highlight"`` or ``"shadows"``.
        compensation, damping, shutter_cap, iso_cap, exposure_time, iso: As of `MeteringPolicy`.
        f_number: Aperture of the lens; by default the widest of the grid, which is nearest to the
            f/1.8 and f/2 of the Raspberry Pi's own cameras.
        max_gain: Gain at the end of the ladder, 1 at ISO 100; by default the tuning's.
        flicker_period: Period of the lamps' light [s], such as 0.01: shutters of a period and more
            are whole periods, and the gain makes up for it (P and A). None: lamps are steady.
        speed: Share of the distance to the target that the filter goes per frame, in (0, 1]; by
            default the tuning's.
        startup_frames: Frames of an episode in which it goes all of the way; likewise.
        roi, mask: Pixels that are metered, see `Region`; the zones are those of the box around.
    """

    def __init__(
        self,
        context: PolicyContext,
        program: str = "P",
        *,
        tuning: str | os.PathLike[str] | None = None,
        metering: str | None = None,
        mode: str | None = None,
        constraint: str | None = None,
        compensation: float = 0.0,
        damping: float = 0.0,
        shutter_cap: float | None = None,
        iso_cap: float | None = None,
        f_number: float | None = None,
        exposure_time: float | None = None,
        iso: float | None = None,
        max_gain: float | None = None,
        flicker_period: float | None = None,
        speed: float | None = None,
        startup_frames: int | None = None,
        roi: str | Sequence[float] | None = None,
        mask: str | NDArray[np.bool_] | None = None,
    ) -> None:
        super().__init__(context)
        check_word("program", program, MANUAL_PROGRAMS)
        check_used(program, exposure_time=exposure_time, iso=iso, flicker_period=flicker_period)
        found = IMX477 if tuning is None else read_tuning(tuning)
        metering = _chosen("metering", metering, found.metering_modes)
        mode = _chosen("mode", mode, found.exposure_modes)
        constraint = _chosen("constraint", constraint, found.constraint_modes)
        own = {"speed": speed, "startup_frames": startup_frames}
        found = found.model_copy(update={n: v for n, v in own.items() if v is not None})
        check_number("speed", found.speed, 1e-3, 1.0)
        check_integer("startup_frames", found.startup_frames, 0)
        time = PRIORITY_TIME if exposure_time is None else exposure_time
        lens = context.grid.f_numbers[0] if f_number is None else f_number
        self.options = ProgramOptions(compensation, damping, shutter_cap, lens, time, iso, iso_cap)
        gains = found.exposure_modes[mode].gain
        most = gains[-1] if max_gain is None else check_number("max_gain", max_gain, 1.0, 1e5)
        most = min(most, np.inf if iso_cap is None else iso_cap / 100.0)
        if flicker_period is not None:
            check_number("flicker_period", flicker_period, 1e-6, 10.0)
        self.name = f"rpi_agc:{program}"
        self.region = Region(roi, mask, context.observation_space["raw"].shape)
        self.needs_subject = self.region.of_subject
        gains = tuple(min(g, most) for g in (*gains[:-1], most))
        self.agc = LibcameraAgc(
            0,
            tuning=found,
            metering=metering,
            constraint=constraint,
            ladder=Ladder(found.exposure_modes[mode].shutter, gains),
            compensation=compensation,
            max_exposure_time=np.inf if shutter_cap is None else shutter_cap,
            exposure_time=time if program in ("S", "M") else None,
            gain=None if iso is None else iso / 100.0,
            flicker_period=flicker_period,
        )
        self._chooser = StateChooser(context.grid, program, self.options)
        self.reset(0)

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Begin the start-up frames of `num_envs` cameras."""
        super().reset(num_envs, seed)
        self.agc = replace(self.agc, num_cameras=num_envs)
        self._damped = np.full(num_envs, np.nan)
        self._previous: Ints | None = None

    def act(self, observations: Observations, action_masks: Bools | None = None) -> Ints:
        """Meter the frames, filter the exposure, split it."""
        self.check_reset(observations)
        parts = parts_of(observations, self.region.masks(observations))
        found = [self._statistics(cut) for _, cut in parts]
        zones, weights, histogram = map(np.concatenate, zip(*found, strict=True))
        frame_ev, self.agc.weights = frame_ev100(observations), weights
        brightness = (zones * weights).sum(axis=1) / weights.sum(axis=1)
        light = np.log2(np.maximum(brightness, _DARKEST) / TARGET_SIGNAL)
        lux = 2.5 * np.exp2(frame_ev + light)
        # As exposure time x gain at the lens's own f-number, which may not be the frame's.
        area = self.options.f_number**2
        exposure = self.agc.update(zones, histogram, area * np.exp2(-frame_ev), lux)
        ev = -np.log2(exposure / area)
        states = self.context.grid.ev100
        before = np.clip(self._damped, states.min(), states.max())
        distance = self.options.damping * (before - ev)
        self._damped = ev + np.where(np.isnan(distance), 0.0, distance)
        self._previous = masked_argmax(self._utility(self._damped), action_masks)
        return self._previous.copy()

    def _statistics(self, observations: Observations) -> tuple[Floats, ...]:
        """Means of the zones (n, Z), their weights (n, Z), and histograms of n frames."""
        signal = linear_signal(observations["raw"], self.context.camera, GREEN).mean(axis=1)
        places = _zone_members(*signal.shape[1:], len(self.agc.all_weights))
        seen = observations.get("mask", np.ones(signal.shape[1:], bool))
        pixels = np.maximum(signal, 0.0)[:, seen]
        some = places[seen.ravel()]
        share = some.sum(axis=0) / np.maximum(places.sum(axis=0), 1.0)
        weights = self.agc.all_weights * share
        weights = weights if weights.any() else share
        zones = pixels @ (some / np.maximum(some.sum(axis=0), 1.0))
        return zones, np.tile(weights, (len(pixels), 1)), signal_histogram(pixels)

    def _utility(self, ev: Floats) -> Floats:
        """How well each state fits the exposures and the ladder, ``(N, S)``."""
        chooser = self._chooser
        target = chooser.with_hysteresis(ev, self._previous)
        time, gain = self.agc.split(self.options.f_number**2 * np.exp2(-target))
        aperture = chooser.aperture - 2.0 * np.log2(self.options.f_number)
        slower = np.log2(time)[:, None] + chooser.time[None]  # stops shorter than the ladder's
        higher = chooser.speed[None] - 5.0 - np.log2(gain)[:, None]
        cost = slower**2 + 0.25 * higher**2 + 4.0 * (aperture**2)[None]
        if self._previous is not None:  # of nominally equal exposures the last one stays
            cost[np.arange(len(cost)), self._previous] -= _STAYS
        return chooser.utility(target, cost) - _FLICKERS * self._flickers(time, target)

    def _flickers(self, time: Floats, target: Floats) -> Any:
        """1.0 where lamps flicker in a state but not in one near the EV, ``(N, S)``.

        Shutters of whole periods are looked for where that of the ladder is one, up to its longest.
        """
        period = self.agc.flicker_period
        if period is None:
            return 0.0
        times = np.exp2(-self._chooser.time)
        periods = times / period
        tolerance = _PERIOD_TOLERANCE * periods
        whole = (np.abs(periods - np.round(periods)) <= tolerance) & (periods > 0.5)
        whole &= times <= self.agc.ladder.shutter[-1] * (1.0 + _PERIOD_TOLERANCE)
        steady = self._chooser.nearby(target, _NEARBY_EV) & whole
        found = (time >= period) & steady.any(axis=1)
        return (found[:, None] & ~steady).astype(np.float64)


#: Where the zones lie: the tuning names them by their order only, centre first. The outer ones are
#: a sixth of the frame wide and high; within them are three rows and five columns.
ZONE_LAYOUT = np.array(
    [
        [11, 7, 7, 7, 7, 7, 12],
        [9, 3, 3, 3, 3, 3, 10],
        [9, 5, 1, 0, 2, 6, 10],
        [9, 4, 4, 4, 4, 4, 10],
        [13, 8, 8, 8, 8, 8, 14],
    ]
)


def _chosen(name: str, word: str | None, known: Mapping[str, Any]) -> str:
    """`word`, an argument called `name`; the first of those `known` where it is None."""
    found = next(iter(known)) if word is None else str(word).replace("-", "_")
    check_word(name, found, tuple(known))
    return found


def zone_map(height: int, width: int, zones: int = 15) -> Ints:
    """Zone of each pixel, ``(height, width)``: 0 to 14, or row by row of the Pi 5's 15 x 15."""
    if zones != 15:
        rows, columns = (np.arange(size) * PISP_SIDE // size for size in (height, width))
        return np.asarray(rows[:, None] * PISP_SIDE + columns)
    places = []
    for size, inner in ((height, 3), (width, 5)):
        place = (np.arange(size) + 0.5) / size
        within = np.floor((place - 1 / 6) * (1.5 * inner)).astype(np.int64)
        places.append(1 + within.clip(-1, inner))
    return ZONE_LAYOUT[np.ix_(*places)]


@functools.lru_cache(maxsize=8)
def _zone_members(height: int, width: int, zones: int) -> Floats:
    """Whether each pixel is in each zone, ``(height * width, zones)``, 1 or 0."""
    places = zone_map(height, width, zones).ravel()
    return (places[:, None] == np.arange(zones)).astype(np.float64)
