"""A light meter with a program: the controllers ``METER:PROGRAM``, such as ``matrix:A``."""

import copy
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Self

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from ae_env.observation import SENSOR_RANGES, decode_sensors
from agents.foresight import make_foresight
from agents.metering.meters import make_meter
from agents.metering.programs import ProgramOptions, StateChooser, check_used, program_cost
from agents.metering.reading import EVTracker, ReferenceFrames, Region, read_part
from agents.policy import Bools, Floats, Ints, Observations, Policy, PolicyContext, masked_argmax
from agents.policy_names import PROGRAMS
from agents.rollouts import RolloutPlan, expected_scores, scenes_of, shown_to
from simulator.networks.weights import read_weights
from simulator.utils.cache import cache_key, disk_cache
from simulator.utils.checks import check_word
from simulator.utils.files import read_bounded, write_atomically

#: Meters whose reading is the most exposure that may be given: no state above it is chosen.
CEILING_METERS = ("highlight_weighted",)
#: Meters that try other exposures on a frame, and so need one that shows the scene well.
SEARCH_METERS = ("skewness", "entropy", "shim", "zhang")
#: Advantage of the last state in a tuned program [score], and in program P; there the square of a
#: stop counts 1/4 to 1.
HYSTERESIS_SCORE, HYSTERESIS_COST = 0.002, 0.1
#: Episodes (of both passes, over as many scenes as that allows; of one scene in a pass at most the
#: second) and frames per episode from which a tuned program learns; three times as many take 35 s
#: and did not score higher on unseen scenes.
FIT_EPISODES, FIT_PER_SCENE, FIT_FRAMES = 1600, 4, 4
#: Distance of the second pass's seeds from the first's: other episodes of the same scenes.
SECOND_PASS = 1_000_000
#: What a meter may foresee.
FORESIGHTS = ("none", "trend", "model", "learnt")
#: Fits of this process by key, see `MeteringPolicy.fit_once`: no folder need be writable.
_FITS: "dict[str, ScoreRegression]" = {}


class MeteringPolicy(Policy):
    """A light meter and a program that splits its EV between ISO, shutter and aperture.

    Args:
        context: The camera, see `Policy`.
        meter: One of `agents.policy_names.METERS`, such as ``"average"``.
        program: ``"P"``, ``"A"`` (aperture priority), ``"S"`` (shutter priority), ``"M"`` (aperture
            and shutter by hand), ``"tuned"`` or ``"tuned_blind"`` (never uses the sensors).
        compensation: Exposure compensation [EV], positive is brighter.
        damping: Share of the distance to the metered EV that remains after a frame, in [0, 0.999].
        shutter_cap: Longest exposure time that may be used [s].
        iso_cap: Highest ISO speed that may be used.
        f_number: Aperture that A and M keep, in the grid's range; None: f/8.
        exposure_time: Shutter that S and M keep [s]; None: 1/125.
        iso: ISO speed that M keeps; None: it follows the meter.
        weights: File of a tuned program, as `save` writes it.
        roi, mask: Pixels that are metered, see `Region`; by default all.
        foresight: ``"none"``; ``"trend"``: the program works on the EV that is expected in the
            first frame that has all of the decision (an alpha-beta filter); ``"model"``, of a tuned
            program: the trend is rolled through the delay of each control, and the state is taken
            that promises most (`Foresight`); ``"learnt"``: the same with the forecasters that come
            with the package in place of the trend.
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
        iso_cap: float | None = None,
        f_number: float | None = None,
        exposure_time: float | None = None,
        iso: float | None = None,
        weights: str | os.PathLike[str] | None = None,
        foresight: str = "none",
        roi: str | Sequence[float] | None = None,
        mask: str | NDArray[np.bool_] | None = None,
    ) -> None:
        super().__init__(context)
        check_word("program", program, PROGRAMS)
        self.program = program
        check_word("foresight", foresight, FORESIGHTS)
        if foresight in FORESIGHTS[2:] and not program.startswith("tuned"):
            raise ValueError(f"`foresight` (={foresight!r}) needs a tuned program, not {program}")
        if foresight != "none" and damping:
            raise ValueError(f"`damping` (={damping!r}) must be 0 with `foresight`")
        self.foresight = foresight
        self._forecasters: list[Any] = []
        if foresight == "learnt":
            from agents.learning.forecaster import load_forecasters  # imports torch's networks

            self._forecasters = load_forecasters(foresight, context)
        by_hand = {"f_number": f_number, "exposure_time": exposure_time, "iso": iso}
        check_used(program, weights=weights, **by_hand)
        given = {name: value for name, value in by_hand.items() if value is not None}
        self.options = ProgramOptions(compensation, damping, shutter_cap, iso_cap=iso_cap, **given)
        for name in given:
            value, values = getattr(self.options, name), getattr(context.grid, f"{name}s")
            if not 0.9 * values[0] < value < 1.1 * values[-1]:  # nominal values are rounded
                rule = f"must be in the grid's {values[0]:g} to {values[-1]:g}"
                raise ValueError(f"`{name}` (={value:g}) {rule}")
        self.meter = make_meter(meter, context.camera)
        self.region = Region(roi, mask, context.observation_space["raw"].shape)
        self.needs_subject = self.region.of_subject
        self._meter_name = meter
        self.name = f"{meter}:{program}"
        self.uses_sensors = context.has_sensors and program != "tuned_blind"
        self.regression = None if weights is None else ScoreRegression.load(weights, "weights")
        #: Whether `fit` has something to learn.
        self.learns = program.startswith("tuned") and weights is None
        self._chooser = StateChooser(context.grid, program, self.options, meter in CEILING_METERS)
        self.reset(0)

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Forget the past of `num_envs` cameras; nothing here is random, so `seed` is unused."""
        super().reset(num_envs, seed)
        ev100 = self.context.grid.ev100
        ev_range = (float(ev100.min()), float(ev100.max()))
        options = self.options
        self._tracker = EVTracker(num_envs, ev_range, options.damping, options.compensation)
        given = self.foresight, self.context, num_envs, self._forecasters
        self._foresight = make_foresight(*given)
        searches = self._meter_name in SEARCH_METERS
        self._reference = ReferenceFrames(self.context.camera) if searches else None
        self._sensor_sum = np.zeros((num_envs, 2))
        self._frames = 0
        self._previous: Ints | None = None

    def act(self, observations: Observations, action_masks: Bools | None = None) -> Ints:
        """Meter `observations`, then choose by the program; `action_masks` as of `Policy.act`."""
        readings = self.observe(observations)
        foresight = self._foresight
        if foresight is not None and self.foresight in FORESIGHTS[2:]:
            utility = foresight.utility(
                lambda ev: self._tuned_utility(np.column_stack([ev, readings[:, 1:]]))
            )
        else:
            if foresight is not None:
                readings[:, 0] = foresight.ev100(max(foresight.leads))
            tuned = self.program.startswith("tuned")
            utility = self._tuned_utility(readings) if tuned else self._program_utility(readings)
        self._previous = masked_argmax(utility, action_masks)
        if foresight is not None:
            foresight.record_action(self._previous)
        return self._previous.copy()

    def observe(self, observations: Observations) -> Floats:
        """Take in `observations`; returns EV100, log2 speed, log2 defocus, ``(N, 1 or 3)``.

        The sensors are averaged, in stops, over the frames of the episode.
        """
        self.check_reset(observations)
        self._frames += 1
        masks, metered = self.region.masks(observations), observations
        if self._reference is not None:
            metered = self._reference.update(observations, masks)
        held = np.clip(self._tracker.ev100, *self._tracker.ev_range)  # no farther than can be set
        reading = read_part(self.meter, metered, held, masks)
        ev = self._tracker.update(reading)
        if self._foresight is not None:
            self._foresight.observe(reading, observations)
        if not self.uses_sensors:
            return ev[:, None]
        speed, defocus = decode_sensors(observations["sensors"])
        values = np.stack([np.maximum(speed, 2.0 ** SENSOR_RANGES[0, 0]), defocus], axis=1)
        self._sensor_sum += np.log2(values)
        return np.concatenate([ev[:, None], self._sensor_sum / self._frames], axis=1)

    def _program_utility(self, readings: Floats) -> Floats:
        chooser = self._chooser
        target = readings[:, 0] - self.options.compensation
        cost = program_cost(self.program, chooser, readings) + np.zeros((len(readings), 1))
        if self._previous is not None and self.program == "P":
            cost[np.arange(len(cost)), self._previous] -= HYSTERESIS_COST
        return chooser.utility(chooser.with_hysteresis(target, self._previous), cost)

    def _tuned_utility(self, readings: Floats) -> Floats:
        if self.regression is None:
            raise ValueError(
                f"policy {self.name!r} learns from scenes first: call fit(envs), or give `weights`"
            )
        fitted = self.regression.features.shape[1]
        if fitted != readings.shape[1]:
            raise ValueError(
                f"policy {self.name!r} was fitted on {fitted} readings but sees "
                f"{readings.shape[1]}: the environments must agree on `sensors`"
            )
        known, states = self.regression.scores.shape[1], len(self.context.grid)
        if known != states:
            raise ValueError(f"policy {self.name!r} was fitted on {known} states, not on {states}")
        compensated = readings - np.eye(1, readings.shape[1]) * self.options.compensation
        scores = self.regression.predict(compensated) - 10.0 * self._chooser.over_cap
        if self._previous is not None:
            scores[np.arange(len(scores)), self._previous] += HYSTERESIS_SCORE
        return scores

    def fit(self, envs: gym.vector.VectorEnv[Any, Any, Any], seed: int = 0) -> None:
        """Tune on the scenes of `envs`, in episodes of `seed`: tuned programs without `weights`.

        Episodes, which must not end within 4 frames, run twice: led by program P, then by what was
        learnt from those, so that the readings are those of the frames that the tuned program
        itself takes.
        """
        if self.learns:
            self.regression = self._fit(envs, seed)

    def _fit(self, envs: gym.vector.VectorEnv[Any, Any, Any], seed: int) -> "ScoreRegression":
        leader = copy.copy(self)
        leader.program, leader.foresight = "P", "none"  # the light of these episodes stays
        per_scene = FIT_EPISODES // (2 * len(scenes_of(envs)))
        per_scene = min(max(per_scene, 1), FIT_PER_SCENE)
        first = leader._gather(envs, seed, per_scene)
        leader.program, leader.regression = self.program, ScoreRegression.fit(*first)
        second = leader._gather(envs, seed + SECOND_PASS, per_scene)
        both = [np.concatenate(pair) for pair in zip(first, second, strict=True)]
        return ScoreRegression.fit(*both)

    def fit_once(
        self, envs: gym.vector.VectorEnv[Any, Any, Any], seed: int, env_options: Mapping[str, Any]
    ) -> None:
        """`fit` with `seed`, or what it found before, in this run or an earlier one.

        `env_options` are the arguments that `envs` were made with, JSON values.
        """
        context, sizes = self.context, (FIT_EPISODES, FIT_PER_SCENE, FIT_FRAMES)
        own = (self._meter_name, self.program, self.options, self.uses_sensors, self.region.key)
        seen = (context.grid, context.camera, context.observation_space)
        key = cache_key("fits", [repr((own, seen, sizes)), dict(env_options), seed])
        if key not in _FITS:
            stored = disk_cache().get(key)
            _FITS[key] = self._fit(envs, seed) if stored is None else ScoreRegression(**stored)
            if stored is None:
                disk_cache().put(key, vars(_FITS[key]))
        self.regression = _FITS[key]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a tuned program to `path` (`ValueError` without one); ``weights=path`` loads it."""
        if self.regression is None:
            raise ValueError(f"policy {self.name!r} has nothing to save before fit(envs)")
        self.regression.save(path)

    def _gather(
        self, envs: gym.vector.VectorEnv[Any, Any, Any], seed: int, per_scene: int
    ) -> tuple[Floats, Floats, NDArray[Any]]:
        """Readings after the meter has settled, scores of all states, source groups."""
        found = []
        drawn = RolloutPlan.of_each_scene(
            scenes_of(envs), count=per_scene, seed=seed, most=FIT_EPISODES // 2
        )
        for batch in drawn.batches(envs):
            self.reset(envs.num_envs)
            shown = shown_to(self, batch.observations, batch.info)
            for _ in range(FIT_FRAMES - 1):
                observations, _, _, _, info = envs.step(self.act(shown, batch.action_masks))
                shown = shown_to(self, observations, info)
            columns = self.observe(shown), expected_scores(envs), batch.groups
            found.append([column[batch.valid] for column in columns])
        features, scores, groups = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return features, scores, groups


# -- the regression of tuned programs: from readings to the expected scores of all states ----------

#: Bandwidths tried for EV and, in the same units (stops), for speed and defocus.
EV_BANDWIDTHS = (0.35, 0.6, 1.0)
SENSOR_BANDWIDTHS = (1.0, 1.5, 2.2)
FOLDS = 8
#: Bandwidths whose criterion [score] is this near to the best are as good.
INDIFFERENCE = 0.001
#: Weight of the prior that the local fit shrinks to: the fit with all bandwidths widened.
SHRINKAGE = 1.0
WIDER = 3.0
#: Ridge on the slopes of the local fit, relative to the kernel's weight.
RIDGE = 0.05


@dataclass(frozen=True)
class ScoreRegression:
    """Kernel regression of the scores of all states on a few readings (Fan and Gijbels 1996).

    A local linear fit, weighted by a Gaussian kernel; where few training samples are near, it
    shrinks to the same fit with three times the bandwidths, and that one to the mean.
    """

    features: Floats  # (n, d) readings of the training episodes [stops]
    scores: Floats  # (n, S) expected score of every state there
    bandwidths: Floats  # (d,) standard deviation of the kernel [stops]

    @classmethod
    def fit(cls, features: Floats, scores: Floats, groups: NDArray[Any]) -> Self:
        """Choose the bandwidths by cross-validation over source `groups` (n,): one is never split.

        The criterion is the mean score of the state that the regression picks for the groups left
        out (8 folds); the bandwidth of the EV, the first feature, is chosen first, then that of the
        sensors. Of those within 0.001 of the best the widest is taken: the criterion is flat,
        narrow kernels are not safe where few scenes are near.
        """
        dimensions = features.shape[1]
        folds = np.unique(groups, return_inverse=True)[1] % FOLDS

        def bandwidths(ev: float, sensors: float) -> Floats:
            return np.array([ev, *[sensors] * (dimensions - 1)])

        def criterion(candidate: Floats) -> float:
            """Mean score of the states picked for each fold by the regression on the others."""
            total = 0.0
            for fold in np.unique(folds):
                held = folds == fold
                if held.all():  # a single group: nothing to choose by
                    return float(scores.mean())
                model = cls(features[~held], scores[~held], candidate)
                picked = model.predict(features[held]).argmax(axis=1)
                total += float(np.take_along_axis(scores[held], picked[:, None], axis=1).sum())
            return total / len(scores)

        sensors = SENSOR_BANDWIDTHS[1]
        ev = _widest_good(EV_BANDWIDTHS, [criterion(bandwidths(b, sensors)) for b in EV_BANDWIDTHS])
        if dimensions > 1:
            found = [criterion(bandwidths(ev, b)) for b in SENSOR_BANDWIDTHS]
            sensors = _widest_good(SENSOR_BANDWIDTHS, found)
        return cls(features, scores, bandwidths(ev, sensors))

    def predict(self, features: Floats) -> Floats:
        """Expected scores of all states at these readings, ``(N, S)``.

        Readings outside the range of the training ones (an overexposed frame may read any EV) are
        taken to be at its end: a local fit must not extrapolate.
        """
        features = np.clip(features, self.features.min(axis=0), self.features.max(axis=0))
        prior = np.broadcast_to(self.scores.mean(axis=0), (len(features), self.scores.shape[1]))
        for widen in (WIDER, 1.0):
            prior = self._local_fit(features, self.bandwidths * widen, prior)
        return prior

    def _local_fit(self, features: Floats, bandwidths: Floats, prior: Floats) -> Floats:
        """Ridge-regularised local linear fit around each query, shrunk to `prior`."""
        known, query = self.features / bandwidths, features / bandwidths
        # Squared distances through the inner product: no (N, n, d) array.
        square = (query**2).sum(1)[:, None] + (known**2).sum(1)[None] - 2.0 * query @ known.T
        weights = np.exp(-0.5 * np.maximum(square, 0.0))  # (N, n)
        count, d = len(features), known.shape[1]
        design = np.concatenate([np.ones((len(known), 1)), known], axis=1)  # (n, d + 1)
        products = (design[:, :, None] * design[:, None, :]).reshape(len(known), -1)
        gram = (weights @ products).reshape(count, d + 1, d + 1)
        targets = (design[:, :, None] * self.scores[:, None, :]).reshape(len(known), -1)
        moment = (weights @ targets).reshape(count, d + 1, -1)
        # Move the origin to the query: z - z_q, so that the intercept is the prediction.
        shift = np.broadcast_to(np.eye(d + 1), (count, d + 1, d + 1)).copy()
        shift[:, 1:, 0] = -query
        gram = shift @ gram @ shift.transpose(0, 2, 1)
        moment = shift @ moment
        gram[:, 0, 0] += SHRINKAGE
        moment[:, 0] += SHRINKAGE * prior
        diagonal = np.arange(1, d + 1)
        gram[:, diagonal, diagonal] += RIDGE * gram[:, :1, 0] + 1e-9
        return np.linalg.solve(gram, moment)[:, 0]

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the regression as a safetensors file."""
        from safetensors.numpy import save

        content = save({name: np.ascontiguousarray(v) for name, v in vars(self).items()})
        return write_atomically(path, content)

    @classmethod
    def load(cls, path: str | os.PathLike[str], name: str = "path") -> Self:
        """Read what `save` wrote; a `ValueError`, where `name` names the file, if it is none."""
        try:
            found = read_weights(read_bounded(Path(path), 2**30))
            names = [field.name for field in fields(cls)]
            if sorted(found) != sorted(names):
                raise ValueError(f"it must hold {', '.join(names)}")
            features, scores, bandwidths = (found[name].double().numpy() for name in names)
            fits = features.ndim == scores.ndim == 2 and bandwidths.shape == features.shape[1:]
            if not (fits and len(features) == len(scores) and features.size and scores.size):
                shapes = features.shape, scores.shape, bandwidths.shape
                raise ValueError(f"its shapes {shapes} are not (n, d), (n, S) and (d,)")
            if not (bandwidths > 0.0).all():
                raise ValueError("its bandwidths must be > 0")
            return cls(features, scores, bandwidths)
        except (OSError, ValueError) as error:
            raise ValueError(f"`{name}` (={str(path)!r}) holds no tuned program: {error}") from None


def _widest_good(bandwidths: Sequence[float], criteria: Sequence[float]) -> float:
    best = max(criteria)
    return max(b for b, c in zip(bandwidths, criteria, strict=True) if c >= best - INDIFFERENCE)
