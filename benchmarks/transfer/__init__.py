"""Do agents that were trained on the simulator do as well in the truth?

    ae-env bench transfer                  # both halves
    ae-env bench transfer --part agents    # trains in every world, judges in the truth
    ae-env bench transfer --part tables    # score tables predicted from one raw

Each half has a result file of its own, ``transfer.json`` and ``transfer_tables.json``; the page
``transfer.md`` is written anew from those that are there. Trained agents lie under
``runs/bench_transfer``, so that a second run continues where the first was stopped and trains
nothing twice. They are known by their configuration: remove the folder after a change of the code
that they depend on.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from agents.cli.console import print_files
from benchmarks.harness import RUNS, FinishedParts, Row, filled_page, origin, rounded
from benchmarks.isolated import ROOT
from benchmarks.transfer.agents import (
    QUICK,
    TransferPlan,
    agent_rows,
    agent_tables,
    has_weights,
    training_set,
)
from benchmarks.transfer.tables import score_tables, table_rows
from simulator.utils.files import result_meta, write_atomically, write_results

#: Result file of each half, and its tables.
HALVES: dict[str, tuple[str, Callable[[list[Row]], dict[str, str]]]] = {
    "agents": ("transfer.json", agent_tables),
    "tables": ("transfer_tables.json", score_tables),
}


def run(
    out: Path,
    *,
    seed: int = 0,
    quick: bool = False,
    part: str | None = None,
    plan: TransferPlan | None = None,
    folder: Path | None = None,
) -> None:
    """Trains, judges, predicts tables; writes a JSON for each half and the page."""
    plan = plan or (QUICK if quick else TransferPlan())
    folder = folder or ROOT / "runs" / ("bench_transfer_quick" if quick else "bench_transfer")
    simulators = [name for one in plan.tables for name in one.simulators]
    for name in HALVES if part is None else (part,):
        command = f"ae-env bench transfer --part {name}{' --quick' * quick}"
        finished = FinishedParts(RUNS / "transfer", seed)
        if name == "agents":
            rows = agent_rows(plan, folder, seed=seed)
        else:
            rows = table_rows(plan, finished, seed=seed)
        meta: dict[str, Any] = result_meta(command, seed) | {"quick": quick, "plan": asdict(plan)}
        used = plan.worlds if name == "agents" else tuple(dict.fromkeys(simulators))
        meta |= {"training_set": training_set(plan)}
        meta |= {"left_out": [one for one in used if not has_weights(one)]}
        path = write_results(out / HALVES[name][0], [rounded(row) for row in rows], meta)
        print_files({f"numbers of the {name}": path})
        if name == "tables":  # the next run measures again
            finished.forget()
    print_files({"page": write_page(out)})


def write_page(out: Path) -> Path:
    """Writes ``transfer.md`` of those result files that are in `out`."""
    found = dict.fromkeys((*HALVES, *(f"{half}-origin" for half in HALVES), "verdicts"), "")
    for half, (name, tables) in HALVES.items():
        if (out / name).is_file():
            content = json.loads((out / name).read_text(encoding="utf-8"))
            found |= {f"{half}-origin": origin(content["meta"])} | tables(content["rows"])
    shown = {name: text or "Not measured in this run." for name, text in found.items()}
    return write_atomically(out / "transfer.md", filled_page("transfer", shown))
