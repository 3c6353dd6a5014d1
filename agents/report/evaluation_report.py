"""An evaluation written down: results.json, tables, plots, report.md and report.html."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agents.evaluation.evaluation_plan import NOT_OF_THE_PROTOCOL, EvaluationPlan, digest
from agents.evaluation.intervals import MIN_GROUPS, RESAMPLES, Rank
from agents.evaluation.result import EvaluationResult
from agents.report.markdown import cell, code, code_block, escape, html_report, markdown_table
from agents.report.plots import path_sheets, plot_convergence, plot_cost, plot_scores
from agents.report.result_table import (
    Results,
    Rows,
    as_results,
    best_meter,
    difference_rows,
    group_values,
    metrics_csv,
    oracle_histogram,
    overall_ranking,
    ranking_rows,
    result_rows,
    scenes_csv,
    scores_by_kind,
    static_condition,
    training_seed_rows,
)
from simulator.settings import format_exposure_time
from simulator.utils.files import result_meta, write_atomically, write_results

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
    results: EvaluationResult | Results,
    out: str | os.PathLike[str],
    *,
    command: str,
    source: str | None = None,
    split: str | None = None,
    next_commands: Sequence[str] = (),
    extra_meta: Mapping[str, Any] | None = None,
    resamples: int = RESAMPLES,
) -> dict[str, Path]:
    """Write everything that an evaluation shows into `out`.

    Those are ``results.json``, ``scenes.csv``, ``metrics.csv``, ``report.md``, ``report.html`` and
    pictures: ``scores.png``, ``ev_error.png``, ``cost.png`` where decisions of one camera were
    timed, ``contact_sheet.webp`` and so on where the scenes are known.

    Args:
        results: The return value of `evaluate` or `run_plan`.
        out: Folder, made where missing.
        command: The command line that repeats the evaluation.
        source: Where the scenes come from, such as ``"bundled"``; by default as the plan says.
        split: ``"test"``, ``"train"`` or ``"all"``; by default as the plan says.
        next_commands: Command lines for the reader to try next.
        extra_meta: Further entries of the JSON's ``meta``, such as training seeds.
        resamples: Bootstrap resamples.

    Returns:
        The files by name.
    """
    folder, results = Path(out), as_results(results)
    result = results[static_condition(results)]
    rows = result_rows(results, source=source, split=split, resamples=resamples)
    ranking = overall_ranking(results, resamples=resamples)
    meta = _meta(results, ranking, command, resamples) | dict(extra_meta or {})
    title = f"{rows[0]['source']}, {rows[0]['split']} split"
    title = title if result.plan is None else result.plan.name
    order = [one.policy for one in ranking]
    order += [name for name in result.tracks if name not in order]
    files = {
        "results.json": write_results(folder / "results.json", rows, meta),
        "scenes.csv": write_atomically(folder / "scenes.csv", scenes_csv(result)),
        "metrics.csv": write_atomically(folder / "metrics.csv", metrics_csv(results, rows)),
    }
    shown = [*rows, *(_overall_rows(ranking) if len(results) > 1 else [])]
    pictures = {
        "scores.png": plot_scores(folder / "scores.png", shown, title),
        "ev_error.png": plot_convergence(folder / "ev_error.png", results, order),
    }
    costs = {n: t.ms_alone for n, t in result.tracks.items() if t.ms_alone}
    scores = {r.policy: r.score.value for r in ranking if r.policy in costs}
    if scores:
        costs = {name: costs[name] for name in scores}
        pictures["cost.png"] = plot_cost(folder / "cost.png", costs, scores)
    pictures |= path_sheets(folder, result, order)
    text = _Report(results, rows, meta, ranking, list(pictures)).markdown(title, next_commands)
    page = html_report(text, pictures, f"Exposure policies compared: {title}")
    return {
        **files,
        **pictures,
        "report.md": write_atomically(folder / "report.md", text),
        "report.html": write_atomically(folder / "report.html", page),
    }


def _meta(
    results: Results, ranking: Sequence[Rank], command: str, resamples: int
) -> dict[str, Any]:
    result = results[static_condition(results)]
    plan, best = result.plan, best_meter(result)
    described = None
    if plan is not None:
        described = plan.describe()
        protocol = {k: v for k, v in described.items() if k not in NOT_OF_THE_PROTOCOL}
        described["sha256"] = digest(protocol)
    return {
        **result_meta(command, result.seed),
        "plan": described,
        "episodes": len(result.scene_ids),
        "scenes": len(set(result.scene_ids.tolist())),
        "frames": result.scores.shape[1],
        "ranking": ranking_rows(ranking),
        "by_kind": scores_by_kind(result),
        "oracle_histogram": oracle_histogram(result),
        "best_meter": best,
        "differences_to_best_meter": (
            [] if best is None else difference_rows(result, best, resamples=resamples)
        ),
        "training_seeds": training_seed_rows(result),
        "ms_alone": {name: track.ms_alone for name, track in result.tracks.items()},
        "other_scorers": result.other_scores,
    }


def _overall_rows(ranking: Sequence[Rank]) -> Rows:
    """Rows of all conditions together, for the plot of the scores."""
    return [
        {
            "policy": one.policy,
            "condition": "all conditions",
            "normalised_score": one.score.value,
            "ci95": one.score.pair,
            "num_groups": one.score.num_groups,
        }
        for one in ranking
    ]


class _Report:
    """The parts of ``report.md``."""

    def __init__(
        self,
        results: Results,
        rows: Rows,
        meta: Mapping[str, Any],
        ranking: Sequence[Rank],
        pictures: Sequence[str],
    ) -> None:
        self.results, self.rows, self.meta = results, rows, meta
        self.ranking, self.pictures = ranking, pictures
        self.static = static_condition(results)
        self.result = results[self.static]
        conditions = [self.static if r["condition"] == "all" else r["condition"] for r in rows]
        self.by = {(r["policy"], c): r for r, c in zip(rows, conditions, strict=True)}

    def markdown(self, title: str, next_commands: Sequence[str]) -> str:
        """The report as Markdown."""
        parts = [
            *self._introduction(title),
            *self._ranking(),
            "![Scores with intervals](scores.png)",
            "*Frames to converge*: an episode that never converges counts with all its frames.",
            *self._scores(),
            *self._conditions(),
            *self._cost(),
            *self._clipping(),
            *self._kinds(),
            *self._other_scorers(),
            *self._paths(),
            *self._differences(),
            "## What the oracle chooses",
            "Share of the episodes; where one value dominated, the control would not matter.",
            _histogram_table(self.meta["oracle_histogram"]),
        ]
        if self.result.plan is not None:
            parts += _plan_part(self.result.plan, self.meta["plan"])
        if next_commands:
            parts += ["## Next", code_block(next_commands)]
        return "\n\n".join(parts) + "\n"

    def _introduction(self, title: str) -> list[str]:
        meta, row, plan = self.meta, self.rows[0], self.result.plan
        seeds = max(len(track.states) for track in self.result.tracks.values())
        resampled = f" and {seeds} training seeds" if seeds > 1 else " (one training seed each)"
        starts = ["random"] if plan is None else plan.starts
        drawn = [self.result.seed] if plan is None else plan.seeds
        return [
            f"# Exposure policies compared: {escape(title)}",
            f"{code(meta['command'])}, {meta['date']}, commit {meta['commit'] or 'unknown'}.",
            f"{meta['scenes']} scenes of '{escape(row['source'])}' ({row['split']} split) from "
            f"{row['num_groups']} source groups; {len(self.results)} "
            f"condition{'s' * (len(self.results) > 1)} of {meta['episodes']} episodes and "
            f"{meta['frames']} frames each; starts: {', '.join(starts)}; seeds: "
            f"{', '.join(map(str, drawn))}. Normalised score: 0 is a random policy, 1 the oracle, "
            "which knows the expected score of every state. Intervals: paired bootstrap over "
            f"source groups{resampled}. How everything is defined: `docs/evaluation.md`.",
        ]

    def _ranking(self) -> list[str]:
        if not self.ranking:
            return []
        over = f"all {len(self.results)} conditions, each with the same weight"
        body = []
        for one in self.ranking:
            changes = []
            for change in (one.to_best, one.to_next):
                if change is None:
                    changes.append("-")
                    continue
                mark = " \\*" if change.significant else ""
                interval = "" if change.pair is None else f" ({cell(change.pair, '+.3f')})"
                changes.append(f"{change.value:+.3f}{interval}{mark}")
            tier = "-" if one.tier is None else str(one.tier)
            score = [f"{one.score.value:.3f}", cell(one.score.pair, ".3f")]
            body.append([tier, escape(one.policy), *score, *changes])
        head = ["tier", "policy", "normalised", "95 % interval", "minus the best", "minus the next"]
        return [
            "## Ranking",
            f"Over {'all scenes' if len(self.results) == 1 else over}. Differences are paired; "
            "their 95 % intervals hold for all pairs at once, and \\* marks those that leave out "
            "zero. Policies of one tier are not significantly worse than its first.",
            markdown_table(head, body),
        ]

    def _scores(self) -> list[str]:
        parts = []
        for part in self.result.conditions:
            own = [r for r in self.rows if r["condition"] == part]
            own.sort(key=lambda r: -r["normalised_score"])
            body = [[cell(r[key], form) for _, key, form in _TABLE] for r in own]
            parts += [
                f"## {self.static}, scenes: {part} ({own[0]['num_groups']} groups)",
                markdown_table([title for title, _, _ in _TABLE], body),
            ]
        if self.rows[0]["num_groups"] < MIN_GROUPS:
            head, body = group_values(self.result)
            names = [[escape(group), *values] for group, *values in body]
            parts += [
                "## Every source group",
                f"Fewer than {MIN_GROUPS} source groups: no intervals, but every value (mean "
                "score).",
                markdown_table([escape(name) for name in head], names),
            ]
        return parts

    def _conditions(self) -> list[str]:
        if len(self.results) < 2:
            return ["## EV error over time", "![EV error over time](ev_error.png)"]
        order = [one.policy for one in self.ranking]
        names = [*order, *(p for p in self.result.tracks if p not in order)]
        head = ["condition", *map(escape, names)]
        parts = ["## Conditions", "![EV error over time](ev_error.png)"]
        for title, key, form in (
            ("Normalised score", "normalised_score", ".3f"),
            ("EV error, P95 [EV]", "ev_error_p95", ".1f"),
            (
                "Frames to converge, from the last change of the light on",
                "frames_to_converge",
                ".1f",
            ),
            ("Overshoot [EV]", "overshoot", ".2f"),
            ("Visible jump (mean change of the companded picture)", "jump", ".4f"),
        ):
            body = [[c, *(f"{self.by[p, c][key]:{form}}" for p in names)] for c in self.results]
            parts += [f"### {title}", markdown_table(head, body)]
        settled = [
            [c, *(f"{np.median(r.episode_metrics(p)['frames_to_settle']):.1f}" for p in names)]
            for c, r in self.results.items()
        ]
        parts += ["### Frames until the exposure stays, median", markdown_table(head, settled)]
        share = [
            [c, *(f"{r.episode_metrics(p)['converged'].mean():.0%}" for p in names)]
            for c, r in self.results.items()
        ]
        return [*parts, "### Share of episodes that converge", markdown_table(head, share)]

    def _cost(self) -> list[str]:
        scores = {one.policy: one.score.value for one in self.ranking}
        body = [
            [
                escape(name),
                cell(scores.get(name), ".3f"),
                f"{track.ms_per_decision:.3f}",
                cell(track.ms_alone, ".3f"),
                f"{track.captures_per_decision:g}",
            ]
            for name, track in self.result.tracks.items()
        ]
        head = ["policy", "normalised", "ms, in batches", "ms, one camera alone", "captures"]
        picture = ["![Score against time](cost.png)"] if "cost.png" in self.pictures else []
        text = "Time in `act` per decision. The plot shows that of one camera alone."
        return ["## Score against time", text, *picture, markdown_table(head, body)]

    def _clipping(self) -> list[str]:
        def worst(name: str, key: str) -> Callable[[str], float]:
            return lambda condition: float(self.by[name, condition][key])

        body = []
        for name in self.result.tracks:
            line = [escape(name)]
            for key in ("clipped_high", "clipped_low"):
                most = max(self.results, key=worst(name, key))
                line += [f"{self.by[name, self.static][key]:.2%}"]
                line += [f"{self.by[name, most][key]:.2%} ({most})"]
            body.append(line)
        head = ["policy", f"white, {self.static}", "white, worst", f"black, {self.static}"]
        text = "Share of the pixels at white and at black."
        return ["## Clipping", text, markdown_table([*head, "black, worst"], body)]

    def _kinds(self) -> list[str]:
        kinds = self.meta["by_kind"]
        if len(kinds) < 2:
            return []
        head = [f"{escape(kind)} ({values['groups']})" for kind, values in kinds.items()]
        body = [
            [escape(name), *(f"{values[name]:.3f}" for values in kinds.values())]
            for name in self.result.tracks
        ]
        text = f"Normalised score ({self.static}); in brackets the source groups of each kind."
        return ["## By kind of scene", text, markdown_table(["policy", *head], body)]

    def _other_scorers(self) -> list[str]:
        table, plan = self.meta["other_scorers"], self.result.plan
        if not table or plan is None:
            return []
        body = [
            [escape(name), *(f"{own[name]:.3f}" for own in table.values())]
            for name in self.result.tracks
        ]
        count = min(plan.other_scorer_scenes, self.meta["scenes"])
        text = (
            f"Mean expected score of the chosen states of {count} scenes under scorers that "
            "nothing was trained on. Scorers that read noise as detail rise with gain: see "
            "`docs/scorers.md`."
        )
        return [
            "## Under other scorers",
            text,
            markdown_table(["policy", *map(escape, table)], body),
        ]

    def _paths(self) -> list[str]:
        sheets = [name for name in self.pictures if name.startswith("contact_sheet")]
        if not sheets or self.result.plan is None:
            return []
        text = (
            "The states of one scene, the oracle's starred, with those that each policy chose from "
            f"the start '{self.result.plan.starts[0]}', frame by frame."
        )
        return ["## Paths", text, *(f"![States and paths]({name})" for name in sheets)]

    def _differences(self) -> list[str]:
        found = self.meta["differences_to_best_meter"]
        if not found:
            return []
        body = [
            [
                escape(d["policy"]),
                d["condition"],
                f"{d['difference']:+.3f}",
                cell(d["ci95"], "+.3f"),
            ]
            for d in found
        ]
        return [
            f"## Difference to the best meter, {code(self.meta['best_meter'])} ({self.static})",
            "Paired on the same episodes; intervals of single differences, not simultaneous.",
            markdown_table(["policy", "scenes", "difference", "95 % interval"], body),
        ]


def _histogram_table(histogram: Mapping[str, Mapping[str, float]]) -> str:
    """Share of the episodes in which each value of each control is the oracle's, as a table."""
    labels: dict[str, Callable[[float], str]] = {
        "iso": lambda v: f"ISO {v:g}",
        "exposure_time": format_exposure_time,
        "f_number": lambda v: f"f/{v:g}",
    }
    body = [
        [
            name.replace("_", " "),
            ", ".join(f"{labels[name](float(v))}: {share:.0%}" for v, share in shares.items()),
        ]
        for name, shares in histogram.items()
    ]
    return markdown_table(["control", "share"], body)


def _plan_part(plan: EvaluationPlan, described: Mapping[str, Any]) -> list[str]:
    body = [
        [name, escape(condition.lighting), str(condition.delay)]
        for name, condition in plan.all_conditions.items()
    ]
    text = f"Environment: {code(described['environment'])}. sha256 of the plan: "
    head = ["condition", "lighting", "delay"]
    return ["## What was run", f"{text}`{described['sha256']}`.", markdown_table(head, body)]
