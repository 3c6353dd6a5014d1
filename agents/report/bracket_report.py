"""An evaluation of brackets written down: results.json and report.md."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from agents.evaluation.bracket_plan import MEASURES, BracketPlan, BracketResult
from agents.report.markdown import code_block, escape, markdown_table
from simulator.utils.files import result_meta, write_atomically, write_results

#: Headings of the measures of a budget.
_HEAD = ["policy", "quality", "95 % interval", "to the best", "error [EV]", "unseen", "frames"]


def rows_by_budget(
    plan: BracketPlan, results: Sequence[BracketResult]
) -> tuple[list[str], list[list[str]]]:
    """Head and body of a table: the quality that each policy reaches in each budget."""
    head = ["policy", "all", "95 % interval", *(f"{budget:g} s" for budget in plan.budgets)]
    body = []
    for result in results:
        pair = result.score().pair
        interval = "too few groups" if pair is None else f"{pair[0]:.4f} to {pair[1]:.4f}"
        single = (f"{result.score(budget=i).value:.4f}" for i in range(len(plan.budgets)))
        body.append([result.policy, f"{result.score().value:.4f}", interval, *single])
    return head, body


def write_bracket_report(
    plan: BracketPlan, results: Sequence[BracketResult], out: Path, *, command: str
) -> dict[str, Path]:
    """Writes ``results.json`` and ``report.md`` into `out`; the files by name.

    Args:
        plan: The plan.
        results: The best policy first.
        out: Folder, which exists.
        command: The command line that repeats the evaluation.
    """
    rows: list[dict[str, Any]] = []
    blocks = []
    for i, budget in enumerate(plan.budgets):
        body = []
        for result in results:
            own, best = result.score(budget=i), result.score(results[0], budget=i)
            means = {name: float(result.values[name][:, i].mean()) for name in MEASURES}
            rows.append(
                {
                    "policy": result.policy,
                    "budget": budget,
                    "ci95": own.pair,
                    "to_best": best.value,
                    "to_best_ci95": best.pair,
                    "num_groups": len(result.groups),
                    "training_seeds": len(result.values["quality"]),
                    **means,
                }
            )
            interval = "-" if own.pair is None else f"{own.pair[0]:.4f} to {own.pair[1]:.4f}"
            apart = "-" if result is results[0] else str(best)
            numbers = (
                f"{means['log_error']:.4f}",
                f"{means['unseen']:.2%}",
                f"{means['frames']:.2f}",
            )
            body.append(
                [
                    escape(result.policy),
                    f"{own.value:.4f}",
                    interval,
                    escape(apart),
                    *numbers,
                    f"{means['frames']:.2f}",
                ]
            )
        blocks.append(f"## {budget:g} s\n\n{markdown_table(_HEAD, body)}")
    meta = result_meta(command, plan.seeds[0]) | {"plan": plan.protocol()}
    scenes = plan.environment.get("scenes", "bundled")
    text = [
        f"# Brackets compared: {plan.name}",
        code_block(command),
        f"{len(results[0].groups)} source groups of {scenes!r}; {len(plan.seeds)} episodes of each "
        f"scene; up to {plan.max_frames} frames, merged. Quality is 1 - mean error / 2 EV; the "
        "error is that of the log radiance of the samples that a frame shows, unseen the share "
        "that is white in all. Intervals: paired bootstrap over source groups and training seeds.",
        *blocks,
    ]
    return {
        "results.json": write_results(out / "results.json", rows, meta),
        "report.md": write_atomically(out / "report.md", "\n\n".join(text) + "\n"),
    }
