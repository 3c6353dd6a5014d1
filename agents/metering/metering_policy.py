"""A light meter with a program: the controllers ``METER:PROGRAM``, such as ``matrix:A``."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ae_env.observation import SENSOR_RANGES, decode_sensors
from agents.foresight import Foresight
from agents.metering.meters import make_meter
from agents.metering.programs import (
    ProgramOptions,
    StateChooser,
    check_program,
    check_used,
    program_cost,
)
from agents.metering.reading import (
    CODE_SIGNALS,
    GREEN,
    SATURATED_STEP_EV,
    WHITE_SIGNAL,
    Reading,
    frame_ev100,
    signal_codes,
)
from agents.metering.trend import TrendTracker
from agents.metering.tuned import ScoreRegression
from agents.policy import Observations, Policy, PolicyContext, masked_argmax
from agents.policy_names import PROGRAMS
from agents.rollouts import RolloutPlan, expected_scores, scenes_of
from simulator.utils.checks import check_word

if TYPE_CHECKING:
    import gymnasium as gym

    from simulator.camera import CameraProfile

Floats = NDArray[np.float64]

#: Meters whose reading is the most exposure that may be given: no state above it is chosen.
CEILING_METERS = ("highlight_weighted",)
#: Meters that try other exposures on a frame, and so need one that shows the scene well.
SEARCH_METERS = ("skewness", "entropy", "shim", "zhang")
#: Advantage of the last state in a tuned program [score], and in program P; there the square of a
#: stop counts 1/4 to 1.
HYSTERESIS_SCORE, HYSTERESIS_COST = 0.002, 0.1
#: Episodes (of both passes, over as many scenes as that allows) and frames per episode from which a
#: tuned program learns; three times as many take 35 s and did not score higher on unseen scenes.
FIT_EPISODES, FIT_FRAMES = 1600, 4
#: Episodes of one scene in a pass, at most.
FIT_PER_SCENE = 4
#: Distance of the second pass's seeds from the first's: other episodes of the same scenes.
SECOND_PASS = 1_000_000
#: What a meter may foresee.
FORESIGHTS = ("none", "trend", "model")
#: Metered weight from which a frame is all white.
ALL_SATURATED = 0.999
#: Quantiles in which frames are compared.
_QUANTILES = np.linspace(0.05, 0.95, 19)
#: The light is another one where the frames differ by more than these, in the square root of the
#: signal (mean of the quantiles), and in stops (median of those that both frames show well).
_TOLERANCE, _TOLERANCE_EV = 0.04, 0.3
_SHOWN = (0.004, 0.9)
#: Saturated share from which a frame hides something.
_SATURATED = 0.01


class MeteringPolicy(Policy):
    """A light meter and a program that splits its EV between ISO, shutter and aperture.

    Args:
        context: The camera, the grid and the observation.
        meter: One of `agents.policy_names.METERS`, such as ``"average"``.
        program: ``"P"``, ``"A"`` (aperture priority), ``"S"`` (shutter priority), ``"M"`` (aperture
            and shutter by hand), ``"tuned"`` or ``"tuned_blind"`` (never uses the sensors).
        compensation: Exposure compensation [EV], positive is brighter.
        damping: Share of the distance to the metered EV that remains after a frame, in [0, 1).
        shutter_cap: Longest exposure time that may be used [s].
        f_number: Aperture that A and M keep; None: f/8.
        exposure_time: Shutter that S and M keep [s]; None: 1/125.
        iso: ISO speed that M keeps; None: it follows the meter.
        weights: File of a tuned program, as `save` writes it.
        foresight: ``"none"``; ``"trend"``: the program works on the EV that is expected in the
            first frame that has all of the decision (an alpha-beta filter); ``"model"``, of a tuned
            program: the trend is rolled through the delay of each control, and the state is taken
            that promises most (`Foresight`).

    Raises:
        ValueError: If an argument is unknown, out of range or of another program.
    """

    def __init__(
        self,
        context: PolicyContext,
        meter: str = "centre_weighted",
        program: str = "P",
        *,
        compensation: float = 0.0,
        damping: float = 0.0,
        shutter_cap: float | None = None,
        f_number: float | None = None,
        exposure_time: float | None = None,
        iso: float | None = None,
        weights: str | os.PathLike[str] | None = None,
        foresight: str = "none",
    ) -> None:
        super().__init__(context)
        self.program = check_program(program, PROGRAMS)
        check_word("foresight", foresight, FORESIGHTS)
        if foresight == "model" and program not in ("tuned", "tuned_blind"):
            raise ValueError(
                "`foresight` (='model') needs the scores that a tuned program predicts; program is "
                f"{program}"
            )
        if foresight != "none" and damping:
            raise ValueError(f"`damping` (={damping!r}) must be 0 with `foresight`")
        self.foresight = foresight
        by_hand = {"f_number": f_number, "exposure_time": exposure_time, "iso": iso}
        check_used(program, **by_hand, weights=weights)
        given = {name: value for name, value in by_hand.items() if value is not None}
        self.options = ProgramOptions(compensation, damping, shutter_cap, **given)
        self.meter = make_meter(meter, context.camera)
        self._meter_name = meter
        self.name = f"{meter}:{program}"
        self.uses_sensors = context.has_sensors and program != "tuned_blind"
        self.regression = None if weights is None else ScoreRegression.load(weights, "weights")
        self._chooser = StateChooser(context.grid, program, self.options, meter in CEILING_METERS)
        self.reset(0)

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Forget the past of `num_envs` cameras."""
        super().reset(num_envs, seed)
        ev100 = self.context.grid.ev100
        ev_range = (float(ev100.min()), float(ev100.max()))
        options = self.options
        self._tracker = EVTracker(num_envs, ev_range, options.damping, options.compensation)
        self._foresight: Foresight | None = None
        if self.foresight != "none":
            self._foresight = Foresight(self.context, TrendTracker(num_envs, ev_range))
        searches = self._meter_name in SEARCH_METERS
        self._reference = ReferenceFrames(self.context.camera) if searches else None
        self._sensor_sum = np.zeros((num_envs, 2))
        self._frames = 0
        self._previous: NDArray[np.int64] | None = None

    def act(
        self, observations: Observations, action_masks: NDArray[np.bool_] | None = None
    ) -> NDArray[np.int64]:
        """Meter the frames, then choose by the program."""
        readings = self.observe(observations)
        foresight = self._foresight
        if foresight is not None and self.foresight == "model":
            utility = foresight.utility(
                lambda ev: self._tuned_utility(np.column_stack([ev, readings[:, 1:]]))
            )
        else:
            if foresight is not None:
                readings[:, 0] = foresight.ev100(max(foresight.leads))
            tuned = self.program in ("tuned", "tuned_blind")
            utility = self._tuned_utility(readings) if tuned else self._program_utility(readings)
        self._previous = masked_argmax(utility, action_masks)
        if foresight is not None:
            foresight.record_action(self._previous)
        return self._previous.copy()

    def observe(self, observations: Observations) -> NDArray[np.float64]:
        """Take in one frame; returns metered EV100, log2 speed, log2 defocus, ``(N, 1 or 3)``.

        The sensors are averaged, in stops, over the frames of the episode.
        """
        self.check_reset(observations)
        self._frames += 1
        metered = observations if self._reference is None else self._reference.update(observations)
        held = np.clip(self._tracker.ev100, *self._tracker.ev_range)  # no farther than can be set
        reading = self.meter(metered, held)
        ev = self._tracker.update(reading)
        if self._foresight is not None:
            self._foresight.observe(reading, observations)
        if not self.uses_sensors:
            return ev[:, None]
        speed, defocus = decode_sensors(observations["sensors"])
        values = np.stack([np.maximum(speed, 2.0 ** SENSOR_RANGES[0, 0]), defocus], axis=1)
        self._sensor_sum += np.log2(values)
        return np.concatenate([ev[:, None], self._sensor_sum / self._frames], axis=1)

    def _program_utility(self, readings: NDArray[np.float64]) -> NDArray[np.float64]:
        """Minus the cost of each state, by the program's priorities."""
        chooser = self._chooser
        target = readings[:, 0] - self.options.compensation
        cost = np.broadcast_to(
            program_cost(self.program, chooser, readings), (len(readings), len(chooser.ev100))
        )
        if self._previous is not None and self.program == "P":
            cost = cost.copy()
            cost[np.arange(len(cost)), self._previous] -= HYSTERESIS_COST
        return chooser.utility(chooser.with_hysteresis(target, self._previous), cost)

    def _tuned_utility(self, readings: NDArray[np.float64]) -> NDArray[np.float64]:
        if self.regression is None:
            raise ValueError(
                f"policy {self.name!r} learns from scenes first: call fit(envs), or give `weights`"
            )
        if self.regression.features.shape[1] != readings.shape[1]:
            raise ValueError(
                f"policy {self.name!r} was fitted on {self.regression.features.shape[1]} readings "
                f"but sees {readings.shape[1]}: the environments must agree on `sensors`"
            )
        compensated = readings - np.eye(1, readings.shape[1]) * self.options.compensation
        scores = self.regression.predict(compensated) - 10.0 * self._chooser.over_cap
        if self._previous is not None:
            scores[np.arange(len(scores)), self._previous] += HYSTERESIS_SCORE
        return scores

    def fit(self, envs: gym.vector.VectorEnv[Any, Any, Any], seed: int = 0) -> None:
        """Tune on the scenes of `envs` (tuned programs only; the others have nothing to learn).

        Episodes run twice: led by program P, then by what was learnt from those, so that the
        readings are those of the frames that the tuned program itself brings about.

        Args:
            envs: Training environments; their episodes must not end within 4 frames.
            seed: Decides the episodes.
        """
        if self.program not in ("tuned", "tuned_blind"):
            return
        tuned, self.program = self.program, "P"
        foresight, self.foresight = self.foresight, "none"  # the light of these episodes stays
        per_scene = FIT_EPISODES // (2 * len(scenes_of(envs)))
        per_scene = min(max(per_scene, 1), FIT_PER_SCENE)
        first = self._gather(envs, seed, per_scene)
        self.program = tuned
        self.regression = ScoreRegression.fit(*first)
        second = self._gather(envs, seed + SECOND_PASS, per_scene)
        both: Any = [np.concatenate(pair) for pair in zip(first, second, strict=True)]
        self.regression = ScoreRegression.fit(*both)
        self.foresight = foresight

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a tuned program; ``weights=path`` restores it.

        Raises:
            ValueError: If there is none yet.
        """
        if self.regression is None:
            raise ValueError(f"policy {self.name!r} has nothing to save before fit(envs)")
        self.regression.save(path)

    def _gather(
        self, envs: gym.vector.VectorEnv[Any, Any, Any], seed: int, per_scene: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[Any]]:
        """Readings after the meter has settled, scores of all states, source groups."""
        features, scores, groups = [], [], []
        drawn = RolloutPlan.of_each_scene(
            scenes_of(envs), count=per_scene, seed=seed, most=FIT_EPISODES // 2
        )
        for batch in drawn.batches(envs):
            self.reset(envs.num_envs)
            observations, masks = batch.observations, batch.action_masks
            for _ in range(FIT_FRAMES - 1):
                actions = self.act(observations, masks)
                observations = envs.step(actions)[0]
            readings = self.observe(observations)
            features.append(readings[batch.valid])
            scores.append(expected_scores(envs)[batch.valid])
            groups.append(batch.groups[batch.valid])
        self.reset(0)
        return np.concatenate(features), np.concatenate(scores), np.concatenate(groups)


class EVTracker:
    """Continuous metered EV of each camera over the frames of an episode.

    A reading far from the estimate replaces it; within a stop the two are averaged, which settles
    what would otherwise flip between neighbouring states. A mostly saturated frame only says that
    the light is not below a bound, a black one that it is not above: an estimate that agrees with
    the bound stays. A frame that is all white or all black moves any other estimate half of the
    way to the end of the range.

    With damping the EV that is handed out follows that estimate, keeping `damping` of its distance
    to it at every frame. It is a number of its own and never read back from the settings: a grid of
    whole stops does not hold it up. Its past never counts as lying beyond the range: light that
    comes back after a long night is followed at once.

    Args:
        num_envs: Cameras.
        ev_range: Lowest and highest EV100 of the camera's exposure states.
        damping: Share of the distance to the estimate [EV] that remains after a frame, in [0, 1).
        compensation: Exposure compensation [EV] that is taken off what is handed out: the range of
            that is so much higher.
    """

    def __init__(
        self,
        num_envs: int,
        ev_range: tuple[float, float],
        damping: float = 0.0,
        compensation: float = 0.0,
    ) -> None:
        self.ev100 = np.full(num_envs, np.nan)
        self.damped = np.full(num_envs, np.nan)
        self.ev_range = ev_range
        self.damping = damping
        self.compensation = compensation

    def update(self, reading: Reading) -> NDArray[np.float64]:
        """Take in one frame's reading; returns the estimates, ``(N,)``, damped."""
        old, new = self.ev100, reading.ev100
        low, high = self.ev_range
        bound = new - SATURATED_STEP_EV * reading.saturated
        agrees = (reading.saturated > 0.5) & (old >= bound) | reading.black & (old <= new)
        white = reading.saturated >= ALL_SATURATED
        new = np.where(reading.black, np.minimum(new, 0.5 * (new + low)), new)
        new = np.where(white, np.maximum(new, 0.5 * (bound + high)), new)
        blended = np.where(np.abs(new - old) > 1.0, new, 0.5 * (new + old))
        self.ev100 = np.where(np.isnan(old), new, np.where(agrees, old, blended))
        before = np.clip(self.damped, low + self.compensation, high + self.compensation)
        distance = self.damping * (before - self.ev100)
        self.damped = self.ev100 + np.where(np.isnan(distance), 0.0, distance)
        return self.damped.copy()


class ReferenceFrames:
    """Keeps, for each camera, the best frame of the present light.

    What a search finds on a saturated frame and on a dark one of the same scene differs, because
    neither shows what the other does: a controller that follows the frame in hand may go to and fro
    between the two for ever. So it continues to search on the better one for as long as new frames
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
        ranks = np.rint(_QUANTILES * (green.shape[1] - 1)).astype(np.intp)
        quantiles = CODE_SIGNALS[ordered[:, ranks]]
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
