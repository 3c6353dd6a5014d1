"""One evaluation as rows: per policy and condition, and per policy and scene."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.evaluation import metrics
from agents.evaluation.result import EvaluationResult
from agents.evaluation.statistics import Interval, difference_interval, score_interval
from agents.policy import is_metering

#: Metrics that are averaged over the episodes of a source group, then over source groups.
_AVERAGED = (
    "frames_to_converge",
    "overshoot",
    "reversals",
    "flicker",
    "clipped_high",
    "clipped_low",
)
SCENE_COLUMNS = (
    *("policy", "scene_id", "group", "kind", "hard", "episodes", "score", "oracle", "random"),
    *(
        "regret",
        "regret_delayed",
        "regret_given_ev",
        "ev_error_median",
        "ev_error_p95",
        "ev_within_third",
    ),
    *("frames_to_converge", "converged", "overshoot", "reversals", "flicker"),
    *("clipped_high", "clipped_low", "final_state", "oracle_state"),
)


def result_rows(
    result: EvaluationResult,
    *,
    source: str,
    split: str,
    resamples: int = 10_000,
    conditions: Sequence[str] | None = None,
) -> list[dict[str, Any]]:
    """A row per policy and condition (see `EvaluationResult.conditions`).

    Args:
        result: What `evaluate` returns.
        source: Where the scenes come from, such as ``"bundled"``.
        split: ``"test"``, ``"train"`` or ``"all"``.
        resamples: Bootstrap resamples of the interval.
        conditions: Of those, the ones to give; all by default.

    Returns:
        Rows with the columns of the project's result files. `ci95` is the 95 % interval of
        `normalised_score`, None below 15 source groups; `ms_per_decision` is amortised over a
        batch of cameras.
    """
    return [
        _row(result, policy, condition, source, split, resamples)
        for condition in conditions or result.conditions
        for policy in result.tracks
    ]


def _row(
    result: EvaluationResult, policy: str, condition: str, source: str, split: str, resamples: int
) -> dict[str, Any]:
    members = result.condition(condition)
    groups = result.groups[members]
    values = {k: v[:, members] for k, v in result.episode_metrics(policy).items()}

    def mean(key: str) -> float:
        return float(metrics.group_means(values[key], groups)[0].mean())

    interval = score_of(result, policy, condition, resamples=resamples)
    errors = values["ev_error"]
    weights = _frame_weights(errors.shape, groups)
    track = result.tracks[policy]
    within = float(np.sum(weights * (errors <= metrics.THIRD_EV)))
    return {
        "policy": policy,
        "condition": condition,
        "source": source,
        "split": split,
        "num_groups": interval.num_groups,
        "seed": result.seed,
        "mean_score": mean("score"),
        "normalised_score": interval.value,
        "regret": mean("regret"),
        "ci95": interval.pair,
        "ev_error_median": weighted_quantile(errors, weights, 0.5),
        "ev_error_p95": weighted_quantile(errors, weights, 0.95),
        "ev_within_third": within,
        **{key: mean(key) for key in _AVERAGED},
        "captures_per_decision": track.captures_per_decision,
        "ms_per_decision": track.ms_per_decision,
    }


def score_of(
    result: EvaluationResult, policy: str, condition: str = "all", *, resamples: int = 10_000
) -> Interval:
    """Normalised score of `policy` with its interval."""
    gains, span = result.group_gains(policy, condition)
    return score_interval(gains, span, resamples=resamples)


def difference(
    result: EvaluationResult,
    policy: str,
    other: str,
    condition: str = "all",
    *,
    resamples: int = 10_000,
) -> Interval:
    """Paired difference of the normalised scores, `policy` minus `other`, with its interval."""
    gains, span = result.group_gains(policy, condition)
    return difference_interval(
        gains, result.group_gains(other, condition)[0], span, resamples=resamples
    )


def best_meter(result: EvaluationResult) -> str | None:
    """The metering policy with the best score over all scenes evaluated; None if there is none."""
    meters = [name for name in result.tracks if is_metering(name)]
    return max(meters, key=lambda name: result.group_gains(name)[0].sum(1).mean(), default=None)


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


def scene_rows(result: EvaluationResult) -> list[dict[str, Any]]:
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
    text = io.StringIO()
    writer = csv.DictWriter(text, SCENE_COLUMNS, lineterminator="\n")
    writer.writeheader()
    for row in scene_rows(result):
        writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()})
    return text.getvalue()


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
