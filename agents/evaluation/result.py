"""Everything that an evaluation measured in one condition, and the rows of its tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ae_env.grid import ExposureGrid
from ae_env.scenes import Scene
from agents.evaluation import intervals, metrics
from agents.evaluation.evaluation_plan import PARTS, EvaluationPlan
from agents.policy import Bools, Floats, Ints
from agents.policy_names import is_metering
from simulator.optics.motion import Movement
from simulator.utils.checks import check_word

#: By condition.
Results = Mapping[str, "EvaluationResult"]

#: Columns of `results.json`, in its order, and those that `metrics.csv` has besides.
ROW_COLUMNS = (
    *("policy", "condition", "source", "split", "num_groups", "seed", "mean_score"),
    *("normalised_score", "regret", "ci95", "ev_error_median", "ev_error_p95"),
    *("ev_within_third", "frames_to_converge", "overshoot", "reversals", "flicker", "jump"),
    *("clipped_high", "clipped_low", "captures_per_decision", "ms_per_decision"),
)
MORE_COLUMNS = ("regret_given_ev", "regret_delayed", "converged", "ms_alone", "training_seeds")
SCENE_COLUMNS = (
    *("policy", "scene_id", "group", "kind", "hard", "episodes", "score", "oracle", "random"),
    *("regret", "regret_delayed", "regret_given_ev", "ev_error_median", "ev_error_p95"),
    *("ev_within_third", "frames_to_converge", "converged", "overshoot", "reversals", "flicker"),
    *("jump", "frames_to_settle", "clipped_high", "clipped_low", "final_state", "oracle_state"),
)
#: What an episode of a bracket is measured by.
BRACKET_METRICS = ("quality", "log_error", "unseen", "frames", "seconds")
#: Metrics of a row that are means over episodes of a source group, then over source groups.
_MEANS = (
    *("regret", "frames_to_converge", "overshoot", "reversals", "flicker", "jump"),
    *("clipped_high", "clipped_low", "regret_given_ev", "regret_delayed", "converged"),
)


@dataclass(frozen=True)
class Track:
    """States and measurements of one policy in all episodes.

    Leading axis K: training seeds (1 where there is nothing to train).
    """

    #: By name. Of frames, ``(K, E, T)``: ``states`` of the frames after each action (with a delay
    #: those that were chosen earlier); ``image_mean``, their mean linear signal; ``code_mean``, the
    #: mean of the companded frame in [0, 1]; ``clipped_high`` and ``clipped_low``, shares of
    #: saturated and of black pixels. Of brackets, ``(K, E)``: `BRACKET_METRICS`.
    arrays: Mapping[str, NDArray[Any]]
    ms_per_decision: float  # time in `act` per camera and frame [ms], in batches
    captures_per_decision: float  # frames taken for one decision
    privileged: bool  # whether the policy was told the best states
    #: Time in `act` for one camera alone [ms]; None where it was not measured.
    ms_alone: float | None = None

    @property
    def states(self) -> Ints:
        """States of the frames after each action, ``(K, E, T)``."""
        return self.arrays["states"]

    @property
    def num_seeds(self) -> int:
        """Number of training seeds, K."""
        return len(next(iter(self.arrays.values())))

    @classmethod
    def of_seeds(cls, tracks: Sequence[Self]) -> Self:
        """The tracks of several training seeds as one."""
        alone = [track.ms_alone for track in tracks if track.ms_alone is not None]
        return cls(
            {name: np.concatenate([t.arrays[name] for t in tracks]) for name in tracks[0].arrays},
            ms_per_decision=float(np.mean([t.ms_per_decision for t in tracks])),
            captures_per_decision=tracks[0].captures_per_decision,
            privileged=tracks[0].privileged,
            ms_alone=float(np.mean(alone)) if alone else None,
        )


@dataclass(frozen=True)
class EvaluationResult:
    """Everything measured in one condition; `E` episodes, `T` frames, `S` states.

    Scene, source group and kind of each episode are ``(E,)``; tracks are by policy.
    """

    grid: ExposureGrid  #: its S states
    scene_ids: NDArray[Any]  #: scene of each episode, ``(E,)`` texts
    groups: NDArray[Any]  #: source group of each episode's scene, ``(E,)`` texts
    kinds: NDArray[Any]  #: kind of each episode's scene, ``(E,)`` texts
    hard: Bools  #: whether the episode's scene is in the hard part, ``(E,)``
    start_states: Ints  #: state of the reset frame; empty for brackets, as `scores` and `allowed`
    scores: Floats  #: q of every state, ``(E, T, S)``
    allowed: Bools  #: action masks of every frame, ``(E, T, S)``
    tracks: dict[str, Track]  #: states and measurements by policy
    plan: EvaluationPlan  #: the plan that the condition belongs to
    #: Frames between a decision and the frame that has its ISO, its exposure time and its aperture.
    delays: tuple[int, int, int] = (0, 0, 0)
    scenes: Sequence[Scene] = ()  #: scenes that episodes drew from
    speed: Floats | None = None  #: image speed of each episode [frame heights per second], ``(E,)``
    #: Blur diameter of each episode at f/4 [pixel of a 64-pixel frame], ``(E,)``.
    defocus: Floats | None = None
    #: Fields of each episode's `simulator.optics.motion.Movement`, ``(E, 4)``.
    movement: Floats | None = None
    #: Mean score of the states that each policy chose under scorers that nothing was trained on: by
    #: scorer, then by policy.
    other_scores: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @property
    def measure(self) -> str:
        """``"score"`` of frames, or ``"quality"`` of brackets: the metric that decides."""
        return self.plan.measure

    def moves(self, episode: int) -> dict[str, Any]:
        """What the blur of an `episode` depends on, for `ae_env.scorers.captures.prepare_scene`."""
        drawn = () if self.movement is None else self.movement[episode].tolist()
        return {
            "speed": 0.0 if self.speed is None else float(self.speed[episode]),
            "defocus": 0.0 if self.defocus is None else float(self.defocus[episode]),
            "movement": Movement(*drawn),
        }

    @cached_property
    def oracle(self) -> Floats:
        """Mean q of the oracle over the frames, ``(E,)``; a bracket's quality is at most 1."""
        if self.measure == "quality":
            return np.ones(len(self.groups))
        return metrics.oracle_score(self.scores, self.allowed).mean(axis=-1)

    @cached_property
    def _best(self) -> Ints:
        """The oracle's state in every frame, ties to the lower index, ``(E, T)``."""
        return np.where(self.allowed, self.scores, -np.inf).argmax(axis=-1)

    @property
    def oracle_states(self) -> Ints:
        """The oracle's state in the last frame, ``(E,)``."""
        return self._best[:, -1]

    @cached_property
    def delayed_oracle(self) -> Floats:
        """Mean q of the oracle whose decisions take effect after `delays`, ``(E,)``."""
        late = (metrics.delayed_states(self._best, self.start_states, d) for d in self.delays)
        return metrics.score_of(self.scores, self.grid.mixed(*late)).mean(axis=-1)

    @cached_property
    def random(self) -> Floats:
        """Exact mean q of a random policy over the frames, ``(E,)``; 0 for brackets."""
        if self.measure == "quality":
            return np.zeros(len(self.groups))
        return metrics.random_score(self.scores, self.allowed).mean(axis=-1)

    def episode_metrics(self, policy: str) -> dict[str, NDArray[Any]]:
        """Every metric of `policy` per training seed and episode, ``(K, E)``.

        `ev_error` is per frame, ``(K, E, T)``: its median and percentiles are over frames.
        """
        return self._metrics[policy]

    @cached_property
    def _metrics(self) -> dict[str, dict[str, NDArray[Any]]]:
        return {policy: self._measured(policy) for policy in self.tracks}

    def _measured(self, policy: str) -> dict[str, NDArray[Any]]:
        arrays = self.tracks[policy].arrays
        if self.measure == "quality":
            return dict(arrays)
        states, ev100, allowed = self.tracks[policy].states, self.grid.ev100, self.allowed
        score = metrics.score_of(self.scores, states).mean(axis=-1)
        errors = metrics.ev_error(self.scores, states, ev100, allowed)
        settled = metrics.settling(self.scores)
        frames, converged = metrics.frames_to_converge(errors, since=settled)
        start = np.broadcast_to(self.start_states[:, None], (*states.shape[:-1], 1))
        evs = ev100[np.concatenate([start, states], axis=-1)]
        static = np.all(self.scores[:, 1:] == self.scores[:, :-1], axis=-1)  # (E, T - 1)
        of_split = metrics.regret_given_ev(self.scores, states, ev100, allowed)
        return {
            "score": score,
            "regret": self.oracle - score,
            "regret_delayed": self.delayed_oracle - score,
            "regret_given_ev": of_split.mean(axis=-1),
            "ev_error": errors,
            "frames_to_converge": frames,
            "converged": converged,
            "frames_to_settle": metrics.frames_to_settle(evs, since=settled),
            "overshoot": metrics.overshoot(evs, since=settled),
            "ev_within_third": (errors <= metrics.THIRD_EV).mean(axis=-1),
            "reversals": metrics.reversals(evs),
            "flicker": metrics.flicker(arrays["image_mean"], static),
            "jump": metrics.jump(arrays["code_mean"]),
            "clipped_high": arrays["clipped_high"].mean(axis=-1),
            "clipped_low": arrays["clipped_low"].mean(axis=-1),
        }

    @property
    def parts(self) -> tuple[str, ...]:
        """Parts that have scenes: always ``"all"``, and both others or neither."""
        return PARTS if self.hard.any() and not self.hard.all() else PARTS[:1]

    def part(self, name: str) -> Bools:
        """Which episodes belong to the part `name`: all, hard or rest, ``(E,)`` bool."""
        check_word("part", name, PARTS)
        return {"all": np.ones_like(self.hard), "hard": self.hard, "rest": ~self.hard}[name]

    def mean(self, policy: str, key: str, episodes: Bools | None = None) -> float:
        """Mean of the metric `key` of `policy` over a group's episodes, then over groups and seeds;
        of the `episodes` that are True, ``(E,)``, or of all.
        """
        members = self.part("all") if episodes is None else episodes
        values = self.episode_metrics(policy)[key][:, members]
        return float(metrics.group_means(values, self.groups[members]).mean())

    def group_gains(self, policy: str, part: str | Bools = "all") -> tuple[Floats, Floats]:
        """Gains over random and the span to the oracle per source group: ``(K, G)``, ``(G,)``.

        Of `policy` in the episodes of `part`, a name or a mask ``(E,)``.
        """
        members = self.part(part) if isinstance(part, str) else part
        gains = (self.episode_metrics(policy)[self.measure] - self.random)[:, members]
        span = (self.oracle - self.random)[members]
        groups = self.groups[members]
        return metrics.group_means(gains, groups), metrics.group_means(span, groups)

    def normalised(self, policy: str, part: str | Bools = "all") -> float:
        """Normalised score of `policy` over its training seeds; `part` as of `group_gains`."""
        gains, span = self.group_gains(policy, part)
        return float(gains.mean(axis=0).sum() / span.sum())


# -- rows -----------------------------------------------------------------------------------------


def as_results(results: EvaluationResult | Results) -> Results:
    """Results by condition, of a single one too."""
    if isinstance(results, EvaluationResult):
        return {results.plan.static_condition: results}
    return results


def static_condition(results: Results) -> str:
    """Name of the condition of unchanging light without delay; of the first where there is none."""
    return next(iter(results.values())).plan.static_condition


def result_rows(
    results: EvaluationResult | Results,
    *,
    source: str | None = None,
    split: str | None = None,
    resamples: int = intervals.RESAMPLES,
) -> pd.DataFrame:
    """A row per policy and condition of `results`: `ROW_COLUMNS` and `MORE_COLUMNS`.

    The static condition gives rows ``"all"``, ``"hard"`` and ``"rest"`` (see
    `EvaluationResult.parts`), every other one a row with its own name. `source` and `split` are
    those of the plan by default. `ci95` is the 95 % bootstrap interval (`resamples`) of
    `normalised_score`, None below 15 source groups; `ms_per_decision` is the mean over a batch.
    """
    results = as_results(results)
    static, rows = static_condition(results), []
    for name, result in results.items():
        environment = result.plan.environment
        scenes = environment.get("scenes", "bundled")
        if not isinstance(scenes, str):  # those that have no name
            scenes = str(scenes) if isinstance(scenes, Mapping) else f"{len(scenes)} scenes"
        for part in result.parts if name == static else PARTS[:1]:
            for policy in result.tracks:
                row = {
                    "policy": policy,
                    "condition": part if name == static else name,
                    "source": source or scenes,
                    "split": split or str(environment.get("split", "test")),
                }
                rows.append(row | _row(result, policy, part, resamples))
    return pd.DataFrame(rows, columns=[*ROW_COLUMNS, *MORE_COLUMNS])


def _row(result: EvaluationResult, policy: str, part: str, resamples: int) -> dict[str, Any]:
    members, track = result.part(part), result.tracks[policy]
    gains, span = result.group_gains(policy, part)
    interval = intervals.score_interval(gains, span, resamples=resamples)
    errors = result.episode_metrics(policy)["ev_error"][:, members]
    # Every source group has the same share of the frames.
    _, index, counts = np.unique(result.groups[members], return_inverse=True, return_counts=True)
    share = 1.0 / (len(counts) * counts[index])
    seeds, _, frames = errors.shape
    weights = np.broadcast_to(share[None, :, None], errors.shape) / (seeds * frames)
    return {
        "num_groups": interval.num_groups,
        "seed": result.plan.seeds[0],
        "mean_score": result.mean(policy, "score", members),
        "normalised_score": interval.value,
        "ci95": interval.pair,
        "ev_error_median": weighted_quantile(errors, weights, 0.5),
        "ev_error_p95": weighted_quantile(errors, weights, 0.95),
        "ev_within_third": float(np.sum(weights * (errors <= metrics.THIRD_EV))),
        **{key: result.mean(policy, key, members) for key in _MEANS},
        "captures_per_decision": track.captures_per_decision,
        "ms_per_decision": track.ms_per_decision,
        "ms_alone": track.ms_alone,
        "training_seeds": track.num_seeds,
    }


def bracket_rows(results: Results, ranking: pd.DataFrame) -> pd.DataFrame:
    """A row per budget and policy of an evaluation of brackets, the best policy first.

    `quality` has its 95 % interval `ci95`; `to_best`, with `to_best_ci95`, is the paired difference
    to the best policy over all budgets; the other metrics are means.
    """
    names, rows = ranking.policy.tolist(), []
    budgets = next(iter(results.values())).plan.budgets or ()
    for budget, result in zip(budgets, results.values(), strict=True):
        best = result.group_gains(names[0])[0]
        for policy in names:
            gains, span = result.group_gains(policy)
            change = intervals.difference_interval(gains, best, span)
            row = {
                "policy": policy,
                "budget": budget,
                "ci95": intervals.score_interval(gains, span).pair,
                "to_best": change.value,
                "to_best_ci95": change.pair,
                "num_groups": len(span),
                "training_seeds": len(gains),
            }
            rows.append(row | {key: result.mean(policy, key) for key in BRACKET_METRICS})
    return pd.DataFrame(rows)


def weighted_quantile(values: NDArray[Any], weights: NDArray[Any], quantile: float) -> float:
    """Least value at which the cumulated weight reaches `quantile` of the whole.

    >>> weighted_quantile(np.array([3.0, 1.0, 2.0]), np.array([0.2, 0.2, 0.6]), 0.8)
    2.0
    """
    order = np.argsort(values, axis=None)
    cumulated = np.cumsum(weights.ravel()[order])
    index = int(np.searchsorted(cumulated, quantile * cumulated[-1] * (1 - 1e-12)))
    return float(values.ravel()[order][index])


def scene_rows(result: EvaluationResult) -> pd.DataFrame:
    """A row per policy and scene: means over the scene's episodes and the training seeds."""
    of_scene = {
        "scene_id": result.scene_ids,
        "group": result.groups,
        "kind": result.kinds,
        "hard": result.hard.astype(int),
        "oracle_state": result.oracle_states,
    }
    # Of the first episode: a mean of indices would mean nothing.
    first = dict.fromkeys((*of_scene, "final_state"), "first")
    found = []
    for policy, track in result.tracks.items():
        values = {k: v.mean(axis=0) for k, v in result.episode_metrics(policy).items()}
        values |= {"oracle": result.oracle, "random": result.random}
        errors = result.episode_metrics(policy)["ev_error"]
        del values["ev_error"]
        frame = pd.DataFrame({**of_scene, **values, "final_state": track.states[0, :, -1]})
        scenes = frame.groupby("scene_id", sort=False)
        rows = scenes.agg({str(name): first.get(str(name), "mean") for name in frame})
        own = [errors[:, result.scene_ids == name] for name in rows.index]
        found.append(
            rows.assign(
                policy=policy,
                episodes=scenes.size(),
                ev_error_median=[np.median(e) for e in own],
                ev_error_p95=[np.percentile(e, 95) for e in own],
            )
        )
    return pd.concat(found, ignore_index=True)[list(SCENE_COLUMNS)]


def group_rows(result: EvaluationResult) -> pd.DataFrame:
    """Mean score of every source group: a row per group, a column per policy."""
    values = {"oracle q": result.oracle, "random q": result.random}
    for name in result.tracks:
        values[name] = result.episode_metrics(name)["score"].mean(axis=0)
    frame = pd.DataFrame(values)
    return frame.groupby(pd.Series(result.groups, name="source group").astype(str)).mean()


# -- comparisons ----------------------------------------------------------------------------------


def best_meter(result: EvaluationResult) -> str | None:
    """The metering policy with the best score over all scenes evaluated; None if there is none."""
    meters = [name for name in result.tracks if is_metering(name)]
    return max(meters, key=lambda name: result.group_gains(name)[0].sum(1).mean(), default=None)


def difference_rows(
    result: EvaluationResult, minus: str, *, resamples: int = intervals.RESAMPLES
) -> pd.DataFrame:
    """Paired differences of every other policy's normalised score to that of `minus`, by part."""
    rows = []
    for part in result.parts:
        other, span = result.group_gains(minus, part)
        for policy in (name for name in result.tracks if name != minus):
            gains = result.group_gains(policy, part)[0]
            interval = intervals.difference_interval(gains, other, span, resamples=resamples)
            counts = interval.num_groups, interval.num_seeds
            rows.append((policy, minus, part, interval.value, interval.pair, *counts))
    columns = ["policy", "minus", "condition", "difference", "ci95"]
    return pd.DataFrame(rows, columns=[*columns, "num_groups", "num_training_seeds"])


def overall_ranking(results: Results, *, resamples: int = intervals.RESAMPLES) -> pd.DataFrame:
    """`rank` of unprivileged policies by score over all conditions, each of the same weight."""
    first = next(iter(results.values()))
    names = [name for name, track in first.tracks.items() if not track.privileged]
    if not names:
        return pd.DataFrame(columns=list(intervals.RANK_COLUMNS))
    gains = {name: overall_gains(results, name)[0] for name in names}
    return intervals.rank(gains, overall_gains(results, names[0])[1], resamples=resamples)


def overall_gains(results: Results, policy: str, part: str = "all") -> tuple[Floats, Floats]:
    """Means over all conditions of what `EvaluationResult.group_gains` gives for each."""
    gains, spans = zip(*(r.group_gains(policy, part) for r in results.values()), strict=True)
    return np.mean(gains, axis=0), np.mean(spans, axis=0)


def training_seed_rows(result: EvaluationResult) -> pd.DataFrame:
    """Normalised score per policy, training seed and part, for those with several seeds."""
    rows = []
    for part in result.parts:
        for policy in (name for name, track in result.tracks.items() if track.num_seeds > 1):
            gains, span = result.group_gains(policy, part)
            for k, value in enumerate(gains.sum(axis=1) / span.sum()):
                rows.append((policy, part, k, value))
    return pd.DataFrame(rows, columns=["policy", "condition", "training_run", "normalised_score"])


def oracle_histogram(result: EvaluationResult) -> dict[str, dict[str, float]]:
    """Share of the episodes in which each value of each control is the oracle's.

    ``{"iso": {"100": 0.4, ...}, "exposure_time": {...}, "f_number": {...}}``.
    """
    grid = result.grid
    controls = grid.controls(result.oracle_states)  # (E, 3)
    axes = {"iso": grid.isos, "exposure_time": grid.exposure_times, "f_number": grid.f_numbers}
    return {
        name: {f"{v:g}": float((controls[:, i] == j).mean()) for j, v in enumerate(values)}
        for i, (name, values) in enumerate(axes.items())
    }


def scores_by_kind(result: EvaluationResult) -> dict[str, dict[str, float]]:
    """Normalised score by kind of scene and policy; of a kind, ``groups`` counts source groups."""
    found: dict[str, dict[str, float]] = {}
    for kind in dict.fromkeys(result.kinds.tolist()):
        own = result.kinds == kind
        found[kind] = {"groups": len(set(result.groups[own]))}
        found[kind] |= {name: result.normalised(name, own) for name in result.tracks}
    return found
