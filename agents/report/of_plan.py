"""The report of an evaluation plan: results.json, tables, plots, report.md and report.html."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from agents.evaluation.evaluation_plan import EvaluationPlan, digest
from agents.evaluation.other_scorers import other_scores
from agents.evaluation.plan_run import PlanRun
from agents.evaluation.ranking import Rank
from agents.evaluation.result import EvaluationResult
from agents.evaluation.result_table import best_meter, oracle_histogram, scenes_csv
from agents.evaluation.statistics import MIN_GROUPS
from agents.report.convergence_plot import plot_convergence
from agents.report.cost_plot import plot_cost
from agents.report.html import html_report
from agents.report.of_evaluation import (
    cell,
    difference_table,
    differences_to,
    group_values,
    histogram_table,
    markdown_table,
    score_table,
    seeds_note,
    training_seed_rows,
)
from agents.report.path_sheet import path_sheets
from agents.report.score_plot import plot_scores
from agents.report.tables import (
    metrics_csv,
    overall_ranking,
    plan_rows,
    ranking_rows,
    static_condition,
)
from simulator.utils.files import write_atomically
from simulator.utils.results import result_meta, write_results

Rows = list[dict[str, Any]]


def write_plan_report(
    run: PlanRun,
    results: Mapping[str, EvaluationResult],
    out: Path,
    *,
    command: str,
    resamples: int = 10_000,
    extra_meta: Mapping[str, Any] | None = None,
) -> dict[str, Path]:
    """Write everything that an evaluation shows into `out`.

    Args:
        run: The plan that was run.
        results: What `run_plan` returns.
        out: Folder, made where missing.
        command: The command line that repeats the evaluation.
        resamples: Bootstrap resamples.
        extra_meta: Further entries of the JSON's ``meta``.

    Returns:
        The files by name.
    """
    plan = run.plan
    static = static_condition(plan)
    result = results[static]
    rows = plan_rows(results, plan, resamples=resamples)
    ranking = overall_ranking(results, resamples=resamples)
    best = best_meter(result)
    differences = [] if best is None else differences_to(result, best, resamples=resamples)
    meta = {
        **result_meta(command, plan.seeds[0]),
        "plan": {**plan.model_dump(mode="json"), "sha256": digest(plan.protocol())},
        "episodes": len(result.scene_ids),
        "scenes": len(run.scenes),
        "frames": plan.frames,
        "ranking": ranking_rows(ranking),
        "oracle_histogram": oracle_histogram(result),
        "best_meter": best,
        "differences_to_best_meter": differences,
        "training_seeds": training_seed_rows(result),
        "ms_alone": {name: track.ms_alone for name, track in result.tracks.items()},
        "other_scorers": _other_scores(run, results),
        **(extra_meta or {}),
    }
    order = [one.policy for one in ranking]
    order += [name for name in result.tracks if name not in order]
    files = {
        "results.json": write_results(out / "results.json", rows, meta),
        "scenes.csv": write_atomically(out / "scenes.csv", scenes_csv(result)),
        "metrics.csv": write_atomically(out / "metrics.csv", metrics_csv(results, plan, rows)),
        "scores.png": _plot_scores(out / "scores.png", rows, ranking, plan, len(results)),
        "ev_error.png": plot_convergence(out / "ev_error.png", results, order),
    }
    costs = {n: t.ms_alone for n, t in result.tracks.items() if t.ms_alone}
    scores = {r.policy: r.score.value for r in ranking if r.policy in costs}
    if scores:
        costs = {name: costs[name] for name in scores}
        files["cost.png"] = plot_cost(out / "cost.png", costs, scores)
    blur = run.blur(plan.all_conditions[static])
    files |= path_sheets(out, run, result, blur, order)
    text = plan_markdown(run, results, rows, meta, ranking, sorted(files))
    files["report.md"] = write_atomically(out / "report.md", text)
    page = html_report(text, out, f"Exposure policies compared: {plan.name}")
    files["report.html"] = write_atomically(out / "report.html", page)
    return files


def _other_scores(
    run: PlanRun, results: Mapping[str, EvaluationResult]
) -> dict[str, dict[str, float]]:
    """`other_scores` in the static condition; kept, since image scorers take their time."""
    static = static_condition(run.plan)
    condition, result = run.plan.all_conditions[static], results[static]
    if not run.plan.other_scorers:
        return {}
    key = run.scorers_key(condition, result)
    known = run.store.load(key)
    if known is not None:
        return dict(known[1])
    found = other_scores(run, result, run.blur(condition), run.plan.other_scorers)
    run.store.save(key, {}, found)
    return found


def _plot_scores(
    path: Path, rows: Rows, ranking: Sequence[Rank], plan: EvaluationPlan, conditions: int
) -> Path:
    shown = list(rows)
    if conditions > 1 and ranking:
        groups = ranking[0].score.num_groups
        shown += [
            {
                "policy": one.policy,
                "condition": "all conditions",
                "normalised_score": one.score.value,
                "ci95": one.score.pair,
                "num_groups": groups,
            }
            for one in ranking
        ]
    return plot_scores(path, shown, plan.name)


def plan_markdown(
    run: PlanRun,
    results: Mapping[str, EvaluationResult],
    rows: Rows,
    meta: Mapping[str, Any],
    ranking: Sequence[Rank],
    pictures: Sequence[str],
) -> str:
    """The report as Markdown; see `write_plan_report`."""
    plan = run.plan
    static = static_condition(plan)
    result = results[static]
    groups = rows[0]["num_groups"]
    parts = [
        f"# Exposure policies compared: {plan.name}",
        f"`{meta['command']}`, {meta['date']}, commit {meta['commit'] or 'unknown'}.",
        f"{meta['scenes']} scenes of {rows[0]['source']!r} ({rows[0]['split']} split) from "
        f"{groups} source groups; {len(results)} conditions of {meta['episodes']} episodes and "
        f"{plan.frames} frames each; starts: {', '.join(plan.starts)}; seeds: "
        f"{', '.join(map(str, plan.seeds))}. Normalised score: 0 is a random policy, 1 the oracle, "
        "which knows the expected score of every state. Intervals: paired bootstrap over source "
        f"groups{seeds_note(result)}. How everything is defined: `docs/evaluation.md`.",
        *_ranking_part(ranking, len(results)),
        "![Scores with intervals](scores.png)",
        "*Frames to converge*: an episode that never converges counts with all its frames.",
    ]
    for part in result.conditions:
        own = [r for r in rows if r["condition"] == part]
        parts += [f"## {static}, scenes: {part} ({own[0]['num_groups']} groups)", score_table(own)]
    if groups < MIN_GROUPS:
        parts += [
            "## Every source group",
            f"Fewer than {MIN_GROUPS} source groups: no intervals, but every value (mean score).",
            markdown_table(*group_values(result)),
        ]
    parts += _conditions_part(results, rows, static, [one.policy for one in ranking])
    parts += _cost_part(result, ranking, pictures)
    parts += _clipping_part(results, rows, static)
    parts += _scorers_part(meta["other_scorers"], run)
    sheets = [name for name in pictures if name.startswith("contact_sheet")]
    if sheets:
        text = "The states of one scene, the oracle's starred, with what each policy chose from "
        text += f"the start {plan.starts[0]!r}, frame by frame."
        parts += ["## Paths", text, *(f"![States and paths]({name})" for name in sheets)]
    if meta["differences_to_best_meter"]:
        parts += [
            f"## Difference to the best meter, `{meta['best_meter']}` ({static})",
            "Paired on the same episodes; intervals of single differences, not simultaneous.",
            difference_table(meta["differences_to_best_meter"]),
        ]
    parts += [
        "## What the oracle chooses",
        "Share of the episodes; where one value dominated, the control would not matter.",
        histogram_table(meta["oracle_histogram"]),
        *_protocol_part(plan),
    ]
    return "\n\n".join(parts) + "\n"


def _ranking_part(ranking: Sequence[Rank], conditions: int) -> list[str]:
    if not ranking:
        return []
    over = f"all {conditions} conditions, each with the same weight" if conditions > 1 else "scenes"
    body = []
    for one in ranking:
        changes = []
        for change in (one.to_best, one.to_next):
            if change is None:
                changes.append("-")
                continue
            mark = " \\*" if change.significant else ""
            pair = None if change.low is None else [change.low, change.high]
            interval = "" if pair is None else f" ({cell(pair, '+.3f')})"
            changes.append(f"{change.value:+.3f}{interval}{mark}")
        tier = "-" if one.tier is None else str(one.tier)
        score = f"{one.score.value:.3f}"
        body.append([tier, one.policy, score, cell(one.score.pair, ".3f"), *changes])
    head = ["tier", "policy", "normalised", "95 % interval", "minus the best", "minus the next"]
    return [
        "## Ranking",
        f"Over {over}. Differences are paired; their 95 % intervals hold for all pairs at once, "
        "and \\* marks those that leave out zero. Policies of one tier are not significantly worse "
        "than its first.",
        markdown_table(head, body),
    ]


def _conditions_part(
    results: Mapping[str, EvaluationResult], rows: Rows, static: str, order: Sequence[str]
) -> list[str]:
    if len(results) < 2:
        return ["## EV error over time", "![EV error over time](ev_error.png)"]
    names = [*order, *(p for p in next(iter(results.values())).tracks if p not in order)]
    by = {(r["policy"], static if r["condition"] == "all" else r["condition"]): r for r in rows}
    parts = ["## Conditions", "![EV error over time](ev_error.png)"]
    for title, key, form in (
        ("Normalised score", "normalised_score", ".3f"),
        ("EV error, P95 [EV]", "ev_error_p95", ".1f"),
        ("Frames to converge, from the last change of the light on", "frames_to_converge", ".1f"),
        ("Overshoot [EV]", "overshoot", ".2f"),
    ):
        body = [[c, *(f"{by[p, c][key]:{form}}" for p in names)] for c in results]
        parts += [f"### {title}", markdown_table(["condition", *names], body)]
    share = [
        [c, *(f"{r.episode_metrics(p)['converged'].mean():.0%}" for p in names)]
        for c, r in results.items()
    ]
    return [
        *parts,
        "### Share of episodes that converge",
        markdown_table(["condition", *names], share),
    ]


def _cost_part(
    result: EvaluationResult, ranking: Sequence[Rank], pictures: Sequence[str]
) -> list[str]:
    scores = {one.policy: one.score.value for one in ranking}
    body = [
        [
            name,
            "-" if name not in scores else f"{scores[name]:.3f}",
            f"{track.ms_per_decision:.3f}",
            cell(track.ms_alone, ".3f"),
            f"{track.captures_per_decision:g}",
        ]
        for name, track in result.tracks.items()
    ]
    head = ["policy", "normalised", "ms, in batches", "ms, one camera alone", "captures"]
    picture = ["![Score against time](cost.png)"] if "cost.png" in pictures else []
    text = "Time in `act` per decision. The plot shows that of one camera alone."
    return ["## Score against time", text, *picture, markdown_table(head, body)]


def _clipping_part(results: Mapping[str, EvaluationResult], rows: Rows, static: str) -> list[str]:
    names = list(next(iter(results.values())).tracks)
    by = {(r["policy"], static if r["condition"] == "all" else r["condition"]): r for r in rows}
    body = []
    for name in names:
        line = [name]
        for key in ("clipped_high", "clipped_low"):
            worst = max(results, key=lambda c: by[name, c][key])
            line += [f"{by[name, static][key]:.2%}", f"{by[name, worst][key]:.2%} ({worst})"]
        body.append(line)
    head = ["policy", f"white, {static}", "white, worst", f"black, {static}", "black, worst"]
    return ["## Clipping", "Share of the pixels at white and at black.", markdown_table(head, body)]


def _scorers_part(table: Mapping[str, Mapping[str, float]], run: PlanRun) -> list[str]:
    if not table:
        return []
    names = list(next(iter(table.values())))
    body = [[name, *(f"{own[name]:.3f}" for own in table.values())] for name in names]
    count = min(run.plan.other_scorer_scenes, len(run.scenes))
    text = (
        f"Mean expected score of the chosen states of {count} scenes under scorers that nothing "
        "was trained on. Scorers that read noise as detail rise with gain: see `docs/scorers.md`."
    )
    return ["## Under other scorers", text, markdown_table(["policy", *table], body)]


def _protocol_part(plan: EvaluationPlan) -> list[str]:
    body = [
        [name, str(condition.lighting).replace("|", "\\|"), str(condition.delay)]
        for name, condition in plan.all_conditions.items()
    ]
    text = f"Environment: `{plan.environment}`. sha256 of the plan: `{digest(plan.protocol())}`."
    return ["## What was run", text, markdown_table(["condition", "lighting", "delay"], body)]
