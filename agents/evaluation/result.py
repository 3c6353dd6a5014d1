"""Everything that an evaluation measured in one condition, per episode and frame."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from agents.evaluation import metrics
from agents.evaluation.intervals import (
    RESAMPLES,
    Rank,
    difference_interval,
    rank,
    score_interval,
)
from agents.policy import is_metering
from simulator.optics.motion_path import Movement

if TYPE_CHECKING:
    from ae_env.grid import ExposureGrid
    from ae_env.scenes import Scene
    from agents.evaluation.plan import EvaluationPlan

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

CONDITIONS = ("all", "hard", "rest")


@dataclass(frozen=True)
class Track:
    """The states that one policy chose, and the frames that they gave.

    Leading axis K: training seeds (1 where there is nothing to train).

    Args:
        states: States of the frames after each action, ``(K, E, T)``; with a delay those that
            were chosen earlier.
        image_mean: Mean linear signal of each frame after an action, ``(K, E, T)``.
        code_mean: Mean of the companded frame, in [0, 1], ``(K, E, T)``.
        clipped_high: Share of saturated pixels, ``(K, E, T)``.
        clipped_low: Share of black pixels, ``(K, E, T)``.
        ms_per_decision: Time in `act` per camera and frame [ms], in batches.
        captures_per_decision: Frames taken for one decision.
        privileged: Whether the policy was told the best states.
        ms_alone: Time in `act` for one camera alone [ms]; None where it was not measured.
    """

    states: Ints
    image_mean: Floats
    code_mean: Floats
    clipped_high: Floats
    clipped_low: Floats
    ms_per_decision: float
    captures_per_decision: float
    privileged: bool
    ms_alone: float | None = None

    @classmethod
    def of_seeds(cls, tracks: Sequence[Track]) -> Track:
        """The tracks of several training seeds as one."""
        alone = [track.ms_alone for track in tracks if track.ms_alone is not None]
        return cls(
            states=np.concatenate([t.states for t in tracks]),
            image_mean=np.concatenate([t.image_mean for t in tracks]),
            code_mean=np.concatenate([t.code_mean for t in tracks]),
            clipped_high=np.concatenate([t.clipped_high for t in tracks]),
            clipped_low=np.concatenate([t.clipped_low for t in tracks]),
            ms_per_decision=float(np.mean([t.ms_per_decision for t in tracks])),
            captures_per_decision=tracks[0].captures_per_decision,
            privileged=tracks[0].privileged,
            ms_alone=float(np.mean(alone)) if alone else None,
        )


@dataclass(frozen=True)
class EvaluationResult:
    """Everything measured in one condition; `E` episodes, `T` frames, `S` states.

    Args:
        grid: The exposure states.
        scene_ids: Scene of each episode, ``(E,)``.
        groups: Source group of each episode.
        kinds: Kind of scene of each episode.
        hard: Whether the episode's scene is in the hard part.
        start_states: State of the reset frame.
        scores: q of every state, ``(E, T, S)``.
        allowed: Action masks of every frame, ``(E, T, S)``.
        tracks: By policy.
        seed: The plan's first seed.
        delays: Frames between a decision and the frame that has its ISO, its exposure time and
            its aperture.
        plan: The plan that the condition belongs to; None where a result was put together by hand,
            as everything below.
        scenes: Scene of each episode.
        speed: Image speed of each episode [frame heights per second], ``(E,)``.
        defocus: Blur diameter of each episode at f/4 [pixel of a 64-pixel frame], ``(E,)``.
        movement: Fields of each episode's `simulator.optics.motion_path.Movement`, ``(E, 4)``.
        other_scores: Mean score of the states that each policy chose under scorers that nothing was
            trained on: by scorer, then by policy.
    """

    grid: ExposureGrid
    scene_ids: NDArray[Any]
    groups: NDArray[Any]
    kinds: NDArray[Any]
    hard: NDArray[np.bool_]
    start_states: Ints
    scores: Floats
    allowed: NDArray[np.bool_]
    tracks: dict[str, Track]
    seed: int
    delays: tuple[int, int, int] = (0, 0, 0)
    plan: EvaluationPlan | None = None
    scenes: Sequence[Scene] = ()
    speed: Floats | None = None
    defocus: Floats | None = None
    movement: Floats | None = None
    other_scores: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def moves(self, episode: int) -> dict[str, Any]:
        """What blur depends on, as arguments of `ae_env.scorers.score_table.prepare_scene`."""
        known = {"speed": self.speed, "defocus": self.defocus}
        found: dict[str, Any] = {
            n: 0.0 if v is None else float(v[episode]) for n, v in known.items()
        }
        drawn = () if self.movement is None else self.movement[episode].tolist()
        return found | {"movement": Movement(*drawn)}

    @cached_property
    def oracle(self) -> Floats:
        """Mean q of the oracle over the frames, ``(E,)``."""
        mean: Floats = metrics.oracle_score(self.scores, self.allowed).mean(axis=-1)
        return mean

    @cached_property
    def delayed_oracle(self) -> Floats:
        """Mean q of the oracle whose decisions take effect after `delays`, ``(E,)``."""
        best = np.where(self.allowed, self.scores, -np.inf).argmax(axis=-1)
        late = (metrics.delayed_states(best, self.start_states, d) for d in self.delays)
        per_frame = metrics.score_of(self.scores, self.grid.mixed(*late))
        mean: Floats = per_frame.mean(axis=-1)
        return mean

    @cached_property
    def random(self) -> Floats:
        """Exact mean q of a random policy over the frames, ``(E,)``."""
        mean: Floats = metrics.random_score(self.scores, self.allowed).mean(axis=-1)
        return mean

    @cached_property
    def oracle_states(self) -> Ints:
        """The oracle's state in the last frame, ties to the lower index, ``(E,)``."""
        last = np.where(self.allowed[:, -1], self.scores[:, -1], -np.inf)
        best: Ints = last.argmax(axis=-1).astype(np.int64)
        return best

    def episode_metrics(self, policy: str) -> dict[str, NDArray[Any]]:
        """Every metric of `policy` per training seed and episode, ``(K, E)``.

        `ev_error` is per frame, ``(K, E, T)``: its median and percentiles are over frames.
        """
        if policy not in self._metrics:
            self._metrics[policy] = self._measured(policy)
        return self._metrics[policy]

    @cached_property
    def _metrics(self) -> dict[str, dict[str, NDArray[Any]]]:
        """Metrics that were asked for, by policy."""
        return {}

    @cached_property
    def settling(self) -> Ints:
        """Frame from which an episode's convergence counts, ``(E,)``; see `metrics.settling`."""
        return metrics.settling(self.scores)

    def _measured(self, policy: str) -> dict[str, NDArray[Any]]:
        track = self.tracks[policy]
        ev100, allowed = self.grid.ev100, self.allowed
        score = metrics.score_of(self.scores, track.states).mean(axis=-1)
        errors = metrics.ev_error(self.scores, track.states, ev100, allowed)
        frames, converged = metrics.frames_to_converge(errors, since=self.settling)
        start = np.broadcast_to(self.start_states[:, None], (*track.states.shape[:-1], 1))
        evs = ev100[np.concatenate([start, track.states], axis=-1)]
        static = np.all(self.scores[:, 1:] == self.scores[:, :-1], axis=-1)  # (E, T - 1)
        given = metrics.regret_given_ev(self.scores, track.states, ev100, allowed)
        return {
            "score": score,
            "regret": self.oracle - score,
            "regret_delayed": self.delayed_oracle - score,
            "regret_given_ev": given.mean(axis=-1),
            "ev_error": errors,
            "frames_to_converge": frames,
            "converged": converged,
            "frames_to_settle": metrics.frames_to_settle(evs, since=self.settling),
            "overshoot": metrics.overshoot(evs, since=self.settling),
            "ev_within_third": (errors <= metrics.THIRD_EV).mean(axis=-1),
            "reversals": metrics.reversals(evs),
            "flicker": metrics.flicker(track.image_mean, static),
            "jump": metrics.jump(track.code_mean),
            "clipped_high": track.clipped_high.mean(axis=-1),
            "clipped_low": track.clipped_low.mean(axis=-1),
        }

    @property
    def conditions(self) -> tuple[str, ...]:
        """``("all", "hard", "rest")``, or ``("all",)`` where one of the two parts has no scenes."""
        return CONDITIONS if self.hard.any() and not self.hard.all() else CONDITIONS[:1]

    def condition(self, name: str) -> NDArray[np.bool_]:
        """Which episodes belong to ``"all"``, ``"hard"`` or ``"rest"``, ``(E,)``."""
        masks = {"all": np.ones_like(self.hard), "hard": self.hard, "rest": ~self.hard}
        if name not in masks:
            raise ValueError(f"`condition` (={name!r}) must be one of {', '.join(masks)}")
        return masks[name]

    def group_gains(self, policy: str, condition: str = "all") -> tuple[Floats, Floats]:
        """Gains over random and the span to the oracle per source group: ``(K, G)``, ``(G,)``.

        These are the arguments of `agents.evaluation.intervals`.
        """
        members = self.condition(condition)
        gains = (self.episode_metrics(policy)["score"] - self.random)[:, members]
        span = (self.oracle - self.random)[members]
        groups = self.groups[members]
        return metrics.group_means(gains, groups)[0], metrics.group_means(span, groups)[0]


Rows = list[dict[str, Any]]
Results = Mapping[str, EvaluationResult]

#: Metrics that are averaged over the episodes of a source group, then over source groups.
_AVERAGED = (
    *("frames_to_converge", "overshoot", "reversals", "flicker", "jump"),
    *("clipped_high", "clipped_low"),
)
SCENE_COLUMNS = (
    *("policy", "scene_id", "group", "kind", "hard", "episodes", "score", "oracle", "random"),
    *("regret", "regret_delayed", "regret_given_ev", "ev_error_median", "ev_error_p95"),
    *("ev_within_third", "frames_to_converge", "converged", "overshoot", "reversals", "flicker"),
    *("jump", "frames_to_settle", "clipped_high", "clipped_low", "final_state", "oracle_state"),
)


def as_results(results: EvaluationResult | Results) -> Results:
    """Results by condition, of one result as well."""
    if not isinstance(results, EvaluationResult):
        return results
    plan = results.plan
    return {"static" if plan is None else plan.static_condition: results}


def static_condition(results: Results) -> str:
    """Name of the condition of unchanging light without delay; of the first where there is none."""
    first = next(iter(results))
    plan = results[first].plan
    return first if plan is None else plan.static_condition


def result_rows(
    results: EvaluationResult | Results,
    *,
    source: str | None = None,
    split: str | None = None,
    resamples: int = RESAMPLES,
) -> Rows:
    """Rows with the columns of the project's result files, one per policy and condition.

    The static condition gives rows ``"all"``, ``"hard"`` and ``"rest"`` (see
    `EvaluationResult.conditions`), every other one a row with its own name.

    Args:
        results: The result of one condition, or results by condition.
        source: Where the scenes come from, such as ``"bundled"``; by default as the plan says.
        split: ``"test"``, ``"train"`` or ``"all"``; by default as the plan says.
        resamples: Bootstrap resamples of the interval.

    Returns:
        `ci95` is the 95 % interval of `normalised_score`, None below 15 source groups;
        `ms_per_decision` is amortised over a batch of cameras.
    """
    results = as_results(results)
    static, rows = static_condition(results), []
    for name, result in results.items():
        environment = {} if result.plan is None else result.plan.environment
        scenes = environment.get("scenes", "bundled")
        fixed = {
            "source": source or (scenes if isinstance(scenes, str) else _shortened(scenes)),
            "split": split or str(environment.get("split", "test")),
        }
        for part in result.conditions if name == static else CONDITIONS[:1]:
            label = part if name == static else name
            rows += [
                {
                    "policy": policy,
                    "condition": label,
                    **fixed,
                    **_row(result, policy, part, resamples),
                }
                for policy in result.tracks
            ]
    return rows


def _shortened(scenes: Any) -> str:
    """Scenes that have no name as text."""
    return str(scenes) if isinstance(scenes, Mapping) else f"{len(scenes)} scenes"


def _row(result: EvaluationResult, policy: str, part: str, resamples: int) -> dict[str, Any]:
    members = result.condition(part)
    groups = result.groups[members]
    values = {k: v[:, members] for k, v in result.episode_metrics(policy).items()}

    def mean(key: str) -> float:
        return float(metrics.group_means(values[key], groups)[0].mean())

    gains, span = result.group_gains(policy, part)
    interval = score_interval(gains, span, resamples=resamples)
    errors = values["ev_error"]
    weights = _frame_weights(errors.shape, groups)
    track = result.tracks[policy]
    return {
        "num_groups": interval.num_groups,
        "seed": result.seed,
        "mean_score": mean("score"),
        "normalised_score": interval.value,
        "regret": mean("regret"),
        "ci95": interval.pair,
        "ev_error_median": weighted_quantile(errors, weights, 0.5),
        "ev_error_p95": weighted_quantile(errors, weights, 0.95),
        "ev_within_third": float(np.sum(weights * (errors <= metrics.THIRD_EV))),
        **{key: mean(key) for key in _AVERAGED},
        "captures_per_decision": track.captures_per_decision,
        "ms_per_decision": track.ms_per_decision,
    }


def weighted_quantile(values: NDArray[Any], weights: NDArray[Any], quantile: float) -> float:
    """Least value at which the cumulated weight reaches `quantile` of the whole.

    >>> weighted_quantile(np.array([3.0, 1.0, 2.0]), np.array([0.2, 0.2, 0.6]), 0.5)
    2.0
    """
    order = np.argsort(values, axis=None)
    cumulated = np.cumsum(weights.ravel()[order])
    index = int(np.searchsorted(cumulated, quantile * cumulated[-1] * (1 - 1e-12)))
    return float(values.ravel()[order][index])


def _frame_weights(shape: tuple[int, ...], groups: NDArray[Any]) -> NDArray[np.float64]:
    """Weights ``(K, E, T)`` that sum to 1 and give every source group the same share."""
    _, index, counts = np.unique(groups, return_inverse=True, return_counts=True)
    episode = 1.0 / (len(counts) * counts[index])
    return np.broadcast_to(episode[None, :, None], shape) / (shape[0] * shape[2])


# -- comparisons ----------------------------------------------------------------------------------


def best_meter(result: EvaluationResult) -> str | None:
    """The metering policy with the best score over all scenes evaluated; None if there is none."""
    meters = [name for name in result.tracks if is_metering(name)]
    return max(meters, key=lambda name: result.group_gains(name)[0].sum(1).mean(), default=None)


def difference_rows(result: EvaluationResult, minus: str, *, resamples: int = RESAMPLES) -> Rows:
    """Paired differences of every other policy's normalised score to that of `minus`.

    Args:
        result: The results of one condition.
        minus: The policy that is subtracted.
        resamples: Bootstrap resamples.

    Returns:
        One for each policy and part that has scenes.
    """
    rows = []
    for part in result.conditions:
        other = result.group_gains(minus, part)[0]
        for policy in result.tracks:
            if policy == minus:
                continue
            gains, span = result.group_gains(policy, part)
            interval = difference_interval(gains, other, span, resamples=resamples)
            rows.append(
                {
                    "policy": policy,
                    "minus": minus,
                    "condition": part,
                    "difference": interval.value,
                    "ci95": interval.pair,
                    "num_groups": interval.num_groups,
                    "num_training_seeds": interval.num_seeds,
                }
            )
    return rows


def overall_ranking(results: Results, *, resamples: int = RESAMPLES) -> list[Rank]:
    """Policies by their score over all conditions, each condition with the same weight.

    Privileged policies have no rank.

    Args:
        results: By condition.
        resamples: Bootstrap resamples.
    """
    first = next(iter(results.values()))
    names = [name for name, track in first.tracks.items() if not track.privileged]
    gains = {
        name: np.mean([r.group_gains(name)[0] for r in results.values()], axis=0) for name in names
    }
    if not gains:
        return []
    spans = [result.group_gains(names[0])[1] for result in results.values()]
    return rank(gains, np.mean(spans, axis=0), resamples=resamples)


def ranking_rows(ranking: Sequence[Rank]) -> Rows:
    """A ranking as JSON values."""
    names = [one.policy for one in ranking]
    rows = []
    for i, one in enumerate(ranking):
        row: dict[str, Any] = {
            "place": i + 1,
            "policy": one.policy,
            "tier": one.tier,
            "normalised_score": one.score.value,
            "ci95": one.score.pair,
        }
        for key, change, other in (("to_best", one.to_best, 0), ("to_next", one.to_next, i + 1)):
            row[key] = None
            if change is not None:
                row[key] = {
                    "other": names[other],
                    "difference": change.value,
                    "simultaneous_ci95": change.pair,
                    "significant": change.significant,
                }
        rows.append(row)
    return rows


def training_seed_rows(result: EvaluationResult) -> Rows:
    """Normalised score per policy, training seed and part, for those with several seeds."""
    rows = []
    for part in result.conditions:
        for policy, track in result.tracks.items():
            if len(track.states) < 2:
                continue
            gains, span = result.group_gains(policy, part)
            for k, value in enumerate(np.sum(gains, axis=1) / np.sum(span)):
                score = {"training_run": k, "normalised_score": float(value)}
                rows.append({"policy": policy, "condition": part, **score})
    return rows


def oracle_histogram(result: EvaluationResult) -> dict[str, dict[str, float]]:
    """Share of the episodes in which each value of each control is the oracle's.

    Returns:
        ``{"iso": {"100": 0.4, ...}, "exposure_time": {...}, "f_number": {...}}``.
    """
    controls = result.grid.controls(result.oracle_states)  # (E, 3)
    axes = {
        "iso": result.grid.isos,
        "exposure_time": result.grid.exposure_times,
        "f_number": result.grid.f_numbers,
    }
    return {
        name: {f"{v:g}": float((controls[:, i] == j).mean()) for j, v in enumerate(values)}
        for i, (name, values) in enumerate(axes.items())
    }


def scores_by_kind(result: EvaluationResult) -> dict[str, dict[str, float]]:
    """Normalised score by kind of scene and policy; of a kind, ``groups`` counts source groups."""
    found: dict[str, dict[str, float]] = {}
    for kind in dict.fromkeys(result.kinds.tolist()):
        own = result.kinds == kind
        groups = result.groups[own]
        span = metrics.group_means((result.oracle - result.random)[own], groups)[0]
        found[kind] = {"groups": len(span)}
        for name in result.tracks:
            score = result.episode_metrics(name)["score"].mean(axis=0)
            gain = metrics.group_means((score - result.random)[own], groups)[0]
            found[kind][name] = float(gain.sum() / span.sum())
    return found


def group_values(result: EvaluationResult) -> tuple[list[str], list[list[str]]]:
    """Mean score of every source group: the header, and a row of cells per group."""
    columns = {"oracle q": result.oracle, "random q": result.random}
    for name in result.tracks:
        columns[name] = result.episode_metrics(name)["score"].mean(axis=0)
    names = metrics.group_means(result.oracle, result.groups)[1]
    values = [metrics.group_means(v, result.groups)[0] for v in columns.values()]
    body = [[str(n), *(f"{v[i]:.3f}" for v in values)] for i, n in enumerate(names)]
    return ["source group", *columns], body


# -- files ----------------------------------------------------------------------------------------


def scene_rows(result: EvaluationResult) -> Rows:
    """A row per policy and scene: means over the scene's episodes and the training seeds."""
    rows = []
    for policy, track in result.tracks.items():
        values = result.episode_metrics(policy)
        for scene in dict.fromkeys(result.scene_ids):
            own = np.flatnonzero(result.scene_ids == scene)
            errors = values["ev_error"][:, own]
            means = {k: float(values[k][:, own].mean()) for k in values if k != "ev_error"}
            rows.append(
                {
                    **means,
                    "policy": policy,
                    "scene_id": str(scene),
                    "group": str(result.groups[own[0]]),
                    "kind": str(result.kinds[own[0]]),
                    "hard": int(result.hard[own[0]]),
                    "episodes": len(own),
                    "oracle": float(result.oracle[own].mean()),
                    "random": float(result.random[own].mean()),
                    "ev_error_median": float(np.median(errors)),
                    "ev_error_p95": float(np.percentile(errors, 95)),
                    "ev_within_third": float((errors <= metrics.THIRD_EV).mean()),
                    # Of the first episode: a mean of indices would mean nothing.
                    "final_state": int(track.states[0, own[0], -1]),
                    "oracle_state": int(result.oracle_states[own[0]]),
                }
            )
    return rows


def scenes_csv(result: EvaluationResult) -> str:
    """`scene_rows` as CSV, numbers with six digits."""
    return _csv(SCENE_COLUMNS, scene_rows(result))


def metrics_csv(results: Results, rows: Rows) -> str:
    """Every metric of every policy in every condition as CSV, numbers with six digits.

    Beside the columns of `rows`: ``regret_given_ev``, ``regret_delayed``, ``converged`` (share of
    the episodes), ``ms_alone`` and ``training_seeds``.

    Args:
        results: By condition.
        rows: As `result_rows` returns them.
    """
    static, lines = static_condition(results), []
    for row in rows:
        part = row["condition"] if row["condition"] in CONDITIONS else "all"
        result = results[static if part == row["condition"] else row["condition"]]
        members = result.condition(part)
        values, track = result.episode_metrics(row["policy"]), result.tracks[row["policy"]]
        more: dict[str, Any] = {
            key: float(
                metrics.group_means(values[key][:, members], result.groups[members])[0].mean()
            )
            for key in ("regret_given_ev", "regret_delayed", "converged")
        }
        low, high = row["ci95"] or (None, None)
        plain = {key: value for key, value in row.items() if key != "ci95"}
        more |= {"ms_alone": track.ms_alone, "training_seeds": len(track.states)}
        lines.append({**plain, "ci95_low": low, "ci95_high": high, **more})
    return _csv(list(lines[0]), lines)


def _csv(columns: Sequence[str], rows: Rows) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()})
    return text.getvalue()
