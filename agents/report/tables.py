"""The results of all conditions of a plan as rows."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from typing import Any

import numpy as np

from agents.evaluation import metrics
from agents.evaluation.evaluation_plan import EvaluationPlan
from agents.evaluation.ranking import Rank, rank
from agents.evaluation.result import EvaluationResult
from agents.evaluation.result_table import result_rows


def static_condition(plan: EvaluationPlan) -> str:
    """The condition of unchanging light without delay; the first one where there is none."""
    conditions = plan.all_conditions
    at_rest = [name for name, condition in conditions.items() if condition.at_rest]
    return (at_rest or list(conditions))[0]


def plan_rows(
    results: Mapping[str, EvaluationResult], plan: EvaluationPlan, *, resamples: int = 10_000
) -> list[dict[str, Any]]:
    """Rows with the columns of the project's result files.

    The static condition gives rows ``"all"``, ``"hard"`` and ``"rest"``, every other one a row
    called after it.

    Args:
        results: By condition.
        plan: The plan.
        resamples: Bootstrap resamples of the intervals.
    """
    shared: dict[str, Any] = {
        "source": str(plan.environment.get("scenes", "bundled")),
        "resamples": resamples,
    }
    shared["split"] = str(plan.environment.get("split", "test"))
    static, rows = static_condition(plan), []
    for name, result in results.items():
        if name == static:
            rows += result_rows(result, **shared)
        else:
            own = result_rows(result, conditions=("all",), **shared)
            rows += [{**row, "condition": name} for row in own]
    return rows


def overall_ranking(
    results: Mapping[str, EvaluationResult], *, resamples: int = 10_000
) -> list[Rank]:
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


def ranking_rows(ranking: list[Rank]) -> list[dict[str, Any]]:
    """A ranking as JSON values."""
    rows = []
    for place, one in enumerate(ranking, 1):
        row: dict[str, Any] = {
            "place": place,
            "policy": one.policy,
            "tier": one.tier,
            "normalised_score": one.score.value,
            "ci95": one.score.pair,
        }
        for key, change in (("to_best", one.to_best), ("to_next", one.to_next)):
            row[key] = None
            if change is not None:
                row[key] = {
                    "other": change.minus,
                    "difference": change.value,
                    "simultaneous_ci95": None if change.low is None else [change.low, change.high],
                    "significant": change.significant,
                }
        rows.append(row)
    return rows


def metrics_csv(
    results: Mapping[str, EvaluationResult], plan: EvaluationPlan, rows: list[dict[str, Any]]
) -> str:
    """Every metric of every policy in every condition as CSV, numbers with six digits.

    Beside the columns of `rows`: ``regret_given_ev``, ``regret_delayed``, ``converged`` (share of
    the episodes), ``ms_alone`` and ``training_seeds``.
    """
    static = static_condition(plan)
    lines = []
    for row in rows:
        part = row["condition"] if row["condition"] in ("all", "hard", "rest") else "all"
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
    text = io.StringIO()
    writer = csv.DictWriter(text, list(lines[0]), lineterminator="\n")
    writer.writeheader()
    for line in lines:
        writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in line.items()})
    return text.getvalue()
