"""Write an evaluation down: results.json, scenes.csv, report.md, scores.png."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agents.evaluation import metrics
from agents.evaluation.result import EvaluationResult
from agents.evaluation.result_table import (
    best_meter,
    difference,
    oracle_histogram,
    result_rows,
    scenes_csv,
)
from agents.evaluation.statistics import MIN_GROUPS
from agents.report.score_plot import plot_scores
from simulator.settings import format_exposure_time
from simulator.utils.files import write_atomically
from simulator.utils.results import result_meta, write_results

_TABLE = (
    ("policy", "policy", ""),
    ("normalised", "normalised_score", ".3f"),
    ("95 % interval", "ci95", ".3f"),
    ("mean score", "mean_score", ".3f"),
    ("regret", "regret", ".3f"),
    ("EV error, median", "ev_error_median", ".2f"),
    ("P95", "ev_error_p95", ".2f"),
    ("within 1/3 EV", "ev_within_third", ".0%"),
    ("frames to converge", "frames_to_converge", ".1f"),
    ("overshoot [EV]", "overshoot", ".2f"),
    ("reversals", "reversals", ".2f"),
    ("flicker", "flicker", ".4f"),
    ("clipped high", "clipped_high", ".1%"),
    ("clipped low", "clipped_low", ".1%"),
    ("ms/decision", "ms_per_decision", ".3f"),
)


def write_report(
    result: EvaluationResult,
    out: str | os.PathLike[str],
    *,
    command: str,
    source: str,
    split: str,
    next_commands: Sequence[str] = (),
    extra_meta: Mapping[str, Any] | None = None,
) -> dict[str, Path]:
    """Write ``results.json``, ``scenes.csv``, ``report.md`` and ``scores.png`` into `out`.

    Args:
        result: What `evaluate` returns.
        out: Folder, made where missing.
        command: The command line that repeats the evaluation.
        source: Where the scenes come from, such as ``"bundled"``.
        split: ``"test"``, ``"train"`` or ``"all"``.
        next_commands: Command lines for the reader to try next.
        extra_meta: Further entries of the JSON's ``meta``, such as training seeds.

    Returns:
        The files by name.
    """
    folder = Path(out)
    rows = result_rows(result, source=source, split=split)
    best = best_meter(result)
    differences = [] if best is None else differences_to(result, best)
    meta = {
        **result_meta(command, result.seed),
        "episodes": len(result.scene_ids),
        "scenes": len(set(result.scene_ids.tolist())),
        "frames": result.scores.shape[1],
        "oracle_histogram": oracle_histogram(result),
        "best_meter": best,
        "differences_to_best_meter": differences,
        **(extra_meta or {}),
    }
    text = report_markdown(result, rows, meta, differences, next_commands)
    title = f"{source}, {split} split: {meta['scenes']} scenes"
    return {
        "results.json": write_results(folder / "results.json", rows, meta),
        "scenes.csv": write_atomically(folder / "scenes.csv", scenes_csv(result)),
        "scores.png": plot_scores(folder / "scores.png", rows, title),
        "report.md": write_atomically(folder / "report.md", text),
    }


def differences_to(
    result: EvaluationResult, best: str, *, resamples: int = 10_000
) -> list[dict[str, Any]]:
    """Every other policy minus the best meter, in each condition that has scenes."""
    rows = []
    for condition in result.conditions:
        for policy in result.tracks:
            if policy == best:
                continue
            interval = difference(result, policy, best, condition, resamples=resamples)
            rows.append(
                {
                    "policy": policy,
                    "minus": best,
                    "condition": condition,
                    "difference": interval.value,
                    "ci95": interval.pair,
                    "num_groups": interval.num_groups,
                    "num_training_seeds": interval.num_seeds,
                }
            )
    return rows


def report_markdown(
    result: EvaluationResult,
    rows: Sequence[Mapping[str, Any]],
    meta: Mapping[str, Any],
    differences: Sequence[Mapping[str, Any]],
    next_commands: Sequence[str] = (),
) -> str:
    """The report as Markdown; see `write_report`."""
    groups = rows[0]["num_groups"]
    parts = [
        "# Exposure policies compared",
        f"`{meta['command']}`, {meta['date']}, commit {meta['commit'] or 'unknown'}.",
        f"{meta['scenes']} scenes of {rows[0]['source']!r} ({rows[0]['split']} split) from "
        f"{groups} source groups, {meta['episodes']} episodes of {meta['frames']} frames, seed "
        f"{result.seed}. Normalised score: 0 is a random policy, 1 the oracle, which knows the "
        "expected score of every state. Intervals: paired bootstrap over source groups"
        f"{seeds_note(result)}. How everything is defined: `docs/evaluation.md`.",
        "![Scores](scores.png)",
    ]
    for condition in result.conditions:
        own = [r for r in rows if r["condition"] == condition]
        parts += [f"## Scenes: {condition} ({own[0]['num_groups']} groups)", score_table(own)]
    if groups < MIN_GROUPS:
        parts += [
            "## Every source group",
            f"Fewer than {MIN_GROUPS} source groups: no intervals, but every value (mean score).",
            markdown_table(*group_values(result)),
        ]
    if differences:
        parts += [
            f"## Difference to the best meter, `{differences[0]['minus']}`",
            "Paired on the same episodes: difference of the normalised scores.",
            difference_table(differences),
        ]
    parts += [
        "## What the oracle chooses",
        "Share of the episodes; where one value dominated, the control would not matter.",
        histogram_table(meta["oracle_histogram"]),
    ]
    if next_commands:
        parts += ["## Next", "```\n" + "\n".join(next_commands) + "\n```"]
    return "\n\n".join(parts) + "\n"


def seeds_note(result: EvaluationResult) -> str:
    """End of a sentence on what is resampled."""
    seeds = max(len(track.states) for track in result.tracks.values())
    return f" and {seeds} training seeds" if seeds > 1 else " (one training seed each)"


def markdown_table(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """A Markdown table; columns but the first are aligned to the right."""
    rule = ["---", *["---:"] * (len(head) - 1)]
    return "\n".join("| " + " | ".join(line) + " |" for line in (head, rule, *body))


def score_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows of one condition with every metric, the best first."""
    order = sorted(rows, key=lambda r: -r["normalised_score"])
    body = [[cell(r[key], form) for _, key, form in _TABLE] for r in order]
    return markdown_table([title for title, _, _ in _TABLE], body)


def cell(value: Any, form: str) -> str:
    """A number, a pair or nothing as text."""
    if value is None:
        return "-"
    if isinstance(value, list):
        return f"{value[0]:{form}} to {value[1]:{form}}"
    return f"{value:{form}}"


def difference_table(differences: Sequence[Mapping[str, Any]]) -> str:
    """Differences to one policy as a table."""
    body = [
        [d["policy"], d["condition"], f"{d['difference']:+.3f}", cell(d["ci95"], "+.3f")]
        for d in differences
    ]
    return markdown_table(["policy", "scenes", "difference", "95 % interval"], body)


def group_values(result: EvaluationResult) -> tuple[list[str], list[list[str]]]:
    """Mean score of every source group: the header, and a row of cells per group."""
    columns = {"oracle q": result.oracle, "random q": result.random}
    for name in result.tracks:
        columns[name] = result.episode_metrics(name)["score"].mean(axis=0)
    names = metrics.group_means(result.oracle, result.groups)[1]
    values = [metrics.group_means(v, result.groups)[0] for v in columns.values()]
    body = [[str(n), *(f"{v[i]:.3f}" for v in values)] for i, n in enumerate(names)]
    return ["source group", *columns], body


def histogram_table(histogram: Mapping[str, Mapping[str, float]]) -> str:
    """How often each value of each control is the oracle's, as a table."""
    labels = {
        "iso": lambda v: f"ISO {v:g}",
        "exposure_time": format_exposure_time,
        "f_number": lambda v: f"f/{v:g}",
    }
    body = [
        [
            name.replace("_", " "),
            ", ".join(
                f"{labels[name](float(value))}: {share:.0%}" for value, share in shares.items()
            ),
        ]
        for name, shares in histogram.items()
    ]
    return markdown_table(["control", "share"], body)


def training_seed_rows(result: EvaluationResult) -> list[dict[str, Any]]:
    """Normalised score per policy, training seed and condition, for those with several seeds."""
    rows = []
    for condition in result.conditions:
        for policy, track in result.tracks.items():
            if len(track.states) < 2:
                continue
            gains, span = result.group_gains(policy, condition)
            for k, value in enumerate(np.sum(gains, axis=1) / np.sum(span)):
                rows.append(
                    {
                        "policy": policy,
                        "condition": condition,
                        "training_run": k,
                        "normalised_score": float(value),
                    }
                )
    return rows
