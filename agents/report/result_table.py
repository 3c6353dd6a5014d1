"""The results of an evaluation as rows: per policy and condition, and per policy and scene."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

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
from agents.evaluation.result import CONDITIONS, EvaluationResult
from agents.policy_names import is_metering

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
