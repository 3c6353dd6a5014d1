"""A light meter of ten parameters, made to be tuned: `examples/tune_meter.py` searches them.

ae-env evaluate --policy examples/parametric_meter.py:ParametricMeter --policy centre_weighted:P
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Self

import numpy as np

from ae_env.observation import SENSOR_RANGES, decode_sensors, frame_statistics, linear_signal
from agents.metering.metering_policy import HYSTERESIS_COST
from agents.metering.programs import (
    BLUR_LIMIT,
    HANDHELD_LIMIT,
    PROGRAM_F_NUMBER,
    ProgramOptions,
    StateChooser,
    program_cost,
)
from agents.metering.reading import (
    BLACK_SIGNAL,
    CODE_SIGNALS,
    GREEN,
    EVTracker,
    Reading,
    frame_ev100,
    mean_reading,
    signal_codes,
)
from agents.policy import Bools, Floats, Ints, Observations, Policy, PolicyContext, masked_argmax
from simulator.utils.checks import check_number, check_word

#: Contrasts [stops] at which highlights and shadows change nothing, their upper bound, and the
#: EV100 at which brightness does not.
TYPICAL_CONTRAST, LARGEST_CONTRAST, TYPICAL_EV100 = 2.5, 8.0, 8.0
#: Range of each parameter, in which a search may move.
RANGES = {
    "centre": (-2.0, 6.0),
    "upper": (-5.0, 3.0),
    "highlights": (-0.5, 1.0),
    "shadows": (-0.5, 1.0),
    "tail": (-3.0, -0.7),
    "compensation": (-2.0, 2.0),
    "brightness": (-0.25, 0.25),
    "share": (0.2, 1.0),
    "shutter": (-4.0, 4.0),
    "gain": (-4.0, 4.0),
}


@dataclass(frozen=True)
class Parameters:
    """The ten numbers; by default those of a centre-weighted meter with program P."""

    #: log2 of the weight of a zone in the central circle, half the frame's height wide, and in the
    #: upper third, against a zone elsewhere.
    centre: float = 3.6
    upper: float = 0.0
    #: EV darker per stop of contrast between the highlights and the mean above the typical one, and
    #: EV brighter per stop between the mean and the shadows.
    highlights: float = 0.0
    shadows: float = 0.0
    #: log10 of the share of the samples that are above the highlights, and below the shadows.
    tail: float = -1.7
    #: EV brighter always, and per EV of light above EV100 8.
    compensation: float = 0.0
    brightness: float = 0.0
    #: Share of the way to the metered EV per frame.
    share: float = 1.0
    #: Stops by which the slowest shutter is shorter than where motion blur reaches its limit.
    shutter: float = 0.0
    #: log2 of the cost of gain, against program P's.
    gain: float = 0.0

    def __post_init__(self) -> None:
        for name, (low, high) in RANGES.items():
            object.__setattr__(self, name, check_number(name, getattr(self, name), low, high))

    @classmethod
    def from_unit(cls, point: Sequence[float] | Floats) -> Self:
        """Parameters of a point (10,) of the unit cube, 0 and 1 the ends of their ranges."""
        ends = zip(RANGES.items(), np.clip(point, 0.0, 1.0), strict=True)
        return cls(**{name: low + float(x) * (high - low) for (name, (low, high)), x in ends})

    def to_unit(self) -> Floats:
        """The point (10,) of the unit cube; the inverse of `from_unit`."""
        low, high = np.array(list(RANGES.values())).T
        return np.asarray((np.array([getattr(self, name) for name in RANGES]) - low) / (high - low))

    @classmethod
    def load(cls, path: str | Path, run: str | None = None) -> Self:
        """Read a JSON file: a mapping of names to numbers, a list of ten, or a run of a search.

        A file that `tune_meter.py` wrote has ``runs``; `run` names one of them.
        """
        try:
            found: Any = json.loads(Path(path).read_text(encoding="utf-8"))
        except ValueError as error:
            raise ValueError(f"`parameters` (={path!r}) is no JSON file: {error}") from None
        if isinstance(found, Mapping) and "runs" in found:
            check_word("run", run, tuple(found["runs"]))
            found = found["runs"][run]["parameters"]
        return cls.of(found)

    @classmethod
    def of(cls, values: Mapping[str, float] | Sequence[float]) -> Self:
        """Parameters from a mapping of names to numbers, or from ten numbers in their order."""
        names = [field.name for field in fields(cls)]
        if not isinstance(values, Mapping):
            if len(values) != len(names):
                raise ValueError(f"`parameters` (={values!r}) must be {len(names)} numbers")
            values = dict(zip(names, values, strict=True))
        for name in values:
            check_word("parameters", name, tuple(names))
        return cls(**values)


class ParametricMeter(Policy):
    """Meters zones and histogram, then chooses as program P does, with ten `Parameters`.

    It needs no more than what an image processor hands to its auto exposure: means of 12 x 16
    zones, a histogram of 128 bins and the share of clipped samples.

    Args:
        parameters: `Parameters`, ten numbers in their order, or a file for `Parameters.load`.
        run: Name of a run in that file.
    """

    def __init__(
        self,
        context: PolicyContext,
        parameters: str | Parameters | Sequence[float] | None = None,
        run: str | None = None,
    ) -> None:
        super().__init__(context)
        if isinstance(parameters, str):
            parameters = Parameters.load(parameters, run)
        elif run is not None:
            raise ValueError(f"`run` (={run!r}) is one of a file's: give `parameters` too")
        elif not isinstance(parameters, Parameters):
            parameters = Parameters() if parameters is None else Parameters.of(parameters)
        self.parameters = parameters
        self._chooser = StateChooser(context.grid, "P", ProgramOptions())
        self.reset(0)

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Forget the past of `num_envs` cameras."""
        super().reset(num_envs, seed)
        ev = self.context.grid.ev100
        damping = min(1.0 - self.parameters.share, 0.999)
        self._tracker = EVTracker(num_envs, (float(ev.min()), float(ev.max())), damping)
        self._sensor_sum, self._frames = np.zeros((num_envs, 2)), 0
        self._previous: Ints | None = None

    def act(self, observations: Observations, action_masks: Bools | None = None) -> Ints:
        """Meter the frames, then choose the cheapest of the states with the metered EV."""
        self.check_reset(observations)
        target = self._tracker.update(self._meter(observations))
        chooser, rows = self._chooser, np.arange(self.num_envs)
        readings = np.column_stack([target, self._sensors(observations)])
        readings[:, 1] += self.parameters.shutter
        gain = chooser.speed - chooser.speed.min()
        cost = program_cost("P", chooser, readings)
        cost = cost + 0.25 * (2.0**self.parameters.gain - 1.0) * gain**2
        if self._previous is not None:
            cost[rows, self._previous] -= HYSTERESIS_COST
        held = chooser.with_hysteresis(target, self._previous)
        self._previous = masked_argmax(chooser.utility(held, cost), action_masks)
        return self._previous.copy()

    def _meter(self, observations: Observations) -> Reading:
        """EV100 that the frames ask for, with all compensations, ``(N,)``."""
        own, camera = self.parameters, self.context.camera
        if "histogram" not in observations:
            statistics = frame_statistics(signal_codes(observations["raw"], camera))
            observations = {**observations, **statistics}
        zones = linear_signal(observations["raw"], camera, GREEN).mean(axis=1)  # (N, 12, 16)
        mean = (zones * zone_weights(own, *zones.shape[1:])).sum(axis=(1, 2), dtype=np.float64)
        saturated = observations["clipped"][:, 0].astype(np.float64)
        ev = frame_ev100(observations)
        reading = mean_reading(mean, saturated, ev)
        level = np.log2(np.maximum(mean, BLACK_SIGNAL))
        dark, bright = histogram_levels(observations["histogram"], 10.0**own.tail)
        change = own.highlights * (_contrast(bright - level) - TYPICAL_CONTRAST)
        change -= own.shadows * (_contrast(level - dark) - TYPICAL_CONTRAST)
        change -= own.compensation + own.brightness * (reading.ev100 - TYPICAL_EV100)
        return Reading(reading.ev100 + change, reading.saturated, reading.black)

    def _sensors(self, observations: Observations) -> Floats:
        """log2 of speed and defocus, means over the episode; those of a camera in the hand."""
        if not self.context.has_sensors:
            defocus = np.log2(64 * BLUR_LIMIT) + np.log2(PROGRAM_F_NUMBER) - 2.0
            return np.tile([np.log2(BLUR_LIMIT / HANDHELD_LIMIT), defocus], (self.num_envs, 1))
        self._frames += 1
        speed, defocus = decode_sensors(observations["sensors"])
        values = np.stack([np.maximum(speed, 2.0 ** SENSOR_RANGES[0, 0]), defocus], axis=1)
        self._sensor_sum += np.log2(values)
        return self._sensor_sum / self._frames


def zone_weights(parameters: Parameters, rows: int, columns: int) -> Floats:
    """Weights of the zones (rows, columns) of a square frame, which sum to 1."""
    y = ((np.arange(rows) + 0.5) / rows - 0.5)[:, None]
    x = ((np.arange(columns) + 0.5) / columns - 0.5)[None]
    elsewhere = np.where(y + 0 * x < -1 / 6, parameters.upper, 0.0)
    weights = np.exp2(np.where(np.hypot(y, x) <= 0.25, parameters.centre, elsewhere))
    return np.asarray(weights / weights.sum())


def histogram_levels(histogram: Any, tail: float) -> tuple[Floats, Floats]:
    """log2 signal below and above which a share `tail` of the samples lies, each ``(N,)``."""
    cumulated = np.cumsum(histogram, axis=1, dtype=np.float64)
    signals = np.log2(
        np.maximum(CODE_SIGNALS.reshape(cumulated.shape[1], -1).mean(1), BLACK_SIGNAL)
    )
    dark = signals[(cumulated >= tail - 1e-6).argmax(axis=1)]
    return dark, signals[(cumulated >= 1.0 - tail - 1e-6).argmax(axis=1)]


def _contrast(stops: Floats) -> Floats:
    return np.clip(stops, 0.0, LARGEST_CONTRAST)
