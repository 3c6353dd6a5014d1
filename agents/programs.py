"""From a metered EV to one state of the grid: the programs P, A and S, and the tuned ones."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ae_env.observation import SENSOR_RANGES, decode_sensors
from agents.episodes import episode_batches, expected_scores, scenes_of
from agents.metering import EVTracker, make_meter
from agents.metrics import SAME_EV
from agents.policy import PROGRAMS, Observations, Policy, PolicyContext, masked_argmax
from agents.tuned import ScoreRegression

if TYPE_CHECKING:
    import gymnasium as gym

#: Longest shutter of a hand-held camera that knows nothing of its motion [s]; the rule of thumb
#: 1 / focal length for a normal lens.
HANDHELD_LIMIT = 1 / 60
#: With sensors: blur that programs accept, in frame heights (one pixel of a 64-pixel frame).
BLUR_LIMIT = 1 / 64
#: Aperture of program A, aperture that P tends to, and shutter of program S.
PRIORITY_F_NUMBER, PROGRAM_F_NUMBER, PRIORITY_TIME = 8.0, 5.6, 1 / 125
#: A program keeps its EV while the metered one is this near [EV]: half a grid step and a bit.
HYSTERESIS_EV = 0.6
#: Advantage of the last state in a tuned program [score].
HYSTERESIS_SCORE = 0.002
#: Episodes (in all, at least one per scene and pass) and frames per episode from which a tuned
#: program learns; three times as many take 35 s and did not score higher on unseen scenes.
FIT_EPISODES, FIT_FRAMES = 1600, 4
#: Episodes of one scene in a pass, at most.
FIT_PER_SCENE = 4
#: Distance of the second pass's seeds from the first's: other episodes of the same scenes.
SECOND_PASS = 1_000_000


class MeteringPolicy(Policy):
    """A light meter and a program that splits its EV between ISO, shutter and aperture.

    Args:
        context: The camera, the grid and the observation.
        meter: ``"average"``, ``"centre_weighted"``, ``"spot"`` or ``"matrix"``.
        program: ``"P"``, ``"A"`` (aperture priority), ``"S"`` (shutter priority), ``"tuned"`` or
            ``"tuned_blind"`` (never uses the sensors).
        compensation: Exposure compensation [EV], positive is brighter.
        f_number: Aperture that A keeps.
        exposure_time: Shutter that S keeps [s].
        weights: File of a tuned program, as `save` writes it.

    Raises:
        ValueError: If an argument is unknown or out of range.
    """

    def __init__(
        self,
        context: PolicyContext,
        meter: str = "centre_weighted",
        program: str = "P",
        *,
        compensation: float = 0.0,
        f_number: float = PRIORITY_F_NUMBER,
        exposure_time: float = PRIORITY_TIME,
        weights: str | os.PathLike[str] | None = None,
    ) -> None:
        super().__init__(context)
        if program not in PROGRAMS:
            raise ValueError(f"`program` (={program!r}) must be one of {', '.join(PROGRAMS)}")
        for key, value in (("f_number", f_number), ("exposure_time", exposure_time)):
            if not value > 0:
                raise ValueError(f"`{key}` (={value!r}) must be > 0")
        self.meter = make_meter(meter, context.camera)
        self.name = f"{meter}:{program}"
        self.program = program
        self.compensation = compensation
        self.f_number, self.exposure_time = f_number, exposure_time
        self.uses_sensors = context.has_sensors and program != "tuned_blind"
        self.regression = None if weights is None else ScoreRegression.load(weights)
        self._apex = np.array(
            [(s.aperture_stop / 3.0, s.time_value, s.speed_value) for s in context.grid.states]
        )
        self.reset(0)

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Forget the past of `num_envs` cameras."""
        super().reset(num_envs, seed)
        ev100 = self.context.grid.ev100
        self._tracker = EVTracker(num_envs, (float(ev100.min()), float(ev100.max())))
        self._sensor_sum = np.zeros((num_envs, 2))
        self._frames = 0
        self._previous: NDArray[np.int64] | None = None

    def act(
        self, observations: Observations, action_masks: NDArray[np.bool_] | None = None
    ) -> NDArray[np.int64]:
        """Meter the frames, then choose by the program."""
        readings = self.observe(observations)
        if self.program in ("tuned", "tuned_blind"):
            utility = self._tuned_utility(readings)
        else:
            utility = self._program_utility(readings)
        self._previous = masked_argmax(utility, action_masks)
        return self._previous.copy()

    def observe(self, observations: Observations) -> NDArray[np.float64]:
        """Take in one frame; returns metered EV100, log2 speed, log2 defocus, ``(N, 1 or 3)``.

        The sensors are averaged, in stops, over the frames of the episode.
        """
        self._frames += 1
        ev = self._tracker.update(self.meter(observations))
        if not self.uses_sensors:
            return ev[:, None]
        speed, defocus = decode_sensors(observations["sensors"])
        values = np.stack([np.maximum(speed, 2.0 ** SENSOR_RANGES[0, 0]), defocus], axis=1)
        self._sensor_sum += np.log2(values)
        return np.concatenate([ev[:, None], self._sensor_sum / self._frames], axis=1)

    def _program_utility(self, readings: NDArray[np.float64]) -> NDArray[np.float64]:
        """Minus the cost of each state; the order of the terms is the program's priority."""
        target = readings[:, :1] - self.compensation
        if self._previous is not None:
            kept = self.context.grid.ev100[self._previous][:, None]
            target = np.where(np.abs(target - kept) < HYSTERESIS_EV, kept, target)
        distance = np.abs(self.context.grid.ev100[None] - target)  # (N, S)
        # Nominal values are rounded (1/15 s for 1/16 s): states this near are the same exposure.
        distance = np.maximum(distance - distance.min(axis=1, keepdims=True) - SAME_EV, 0.0)
        aperture, time, speed = self._apex.T
        slow = np.maximum(self._shutter_limit(readings) - time[None], 0.0)  # stops too slow
        gain = speed - speed.min()
        if self.program == "A":
            off = np.abs(aperture - 2.0 * np.log2(self.f_number))
            return -(1e6 * _excess(off)[None] + 1e3 * distance + 1e1 * slow + 1e-1 * gain[None])
        if self.program == "S":
            off = np.abs(time + np.log2(self.exposure_time))
            return -(1e6 * _excess(off)[None] + 1e3 * distance + 1e-1 * gain[None])
        wide = np.maximum(self._aperture_limit(readings) - aperture[None], 0.0)
        line = np.abs(aperture - 2.0 * np.log2(PROGRAM_F_NUMBER))
        cost = slow**2 + 0.5 * wide**2 + 0.25 * gain[None] ** 2 + 0.05 * line[None] ** 2
        return -(1e3 * distance + cost)

    def _shutter_limit(self, readings: NDArray[np.float64]) -> NDArray[np.float64]:
        """Tv of the slowest shutter that keeps motion blur within the limit, ``(N, 1)``."""
        if not self.uses_sensors:
            return np.full((len(readings), 1), -np.log2(HANDHELD_LIMIT))
        limit: NDArray[np.float64] = readings[:, 1:2] - np.log2(BLUR_LIMIT)
        return limit

    def _aperture_limit(self, readings: NDArray[np.float64]) -> NDArray[np.float64]:
        """Av of the widest aperture that keeps defocus within the limit, ``(N, 1)``."""
        if not self.uses_sensors:
            return np.full((len(readings), 1), 2.0 * np.log2(PROGRAM_F_NUMBER))
        # Blur diameter at f-number N is 4 D / N pixels of a 64-pixel frame.
        limit: NDArray[np.float64] = 2.0 * (2.0 + readings[:, 2:3] - np.log2(64 * BLUR_LIMIT))
        return limit

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
        scores = self.regression.predict(readings)
        if self._previous is not None:
            scores[np.arange(len(scores)), self._previous] += HYSTERESIS_SCORE
        return scores

    def fit(self, envs: gym.vector.VectorEnv, seed: int = 0) -> None:
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
        per_scene = FIT_EPISODES // (2 * len(scenes_of(envs)))
        per_scene = min(max(per_scene, 1), FIT_PER_SCENE)
        first = self._gather(envs, seed, per_scene)
        self.program = tuned
        self.regression = ScoreRegression.fit(*first)
        second = self._gather(envs, seed + SECOND_PASS, per_scene)
        both: Any = [np.concatenate(pair) for pair in zip(first, second, strict=True)]
        self.regression = ScoreRegression.fit(*both)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a tuned program; ``weights=path`` restores it.

        Raises:
            ValueError: If there is none yet.
        """
        if self.regression is None:
            raise ValueError(f"policy {self.name!r} has nothing to save before fit(envs)")
        self.regression.save(path)

    def _gather(
        self, envs: gym.vector.VectorEnv, seed: int, episodes: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[Any]]:
        """Readings after the meter has settled, scores of all states, source groups."""
        features, scores, groups = [], [], []
        for batch in episode_batches(envs, episodes_per_scene=episodes, seed=seed):
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


def _excess(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far each value is above the least one."""
    excess: NDArray[np.float64] = values - values.min()
    return excess
