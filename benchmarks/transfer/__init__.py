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

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from agents.cli.console import print_files
from benchmarks.harness import RUNS, FinishedParts, Row, rounded
from benchmarks.isolated import ROOT
from benchmarks.transfer.agents import agent_rows
from benchmarks.transfer.report import FILES, write_page
from benchmarks.transfer.tables import table_rows
from benchmarks.transfer.worlds import QUICK, TransferPlan, has_weights, training_set
from simulator.utils.files import result_meta, write_results

PARTS = tuple(FILES)
#: What the score tables depend on.
_CODE = ("simulator", "ae_env", "benchmarks/transfer")


def run(
    out: Path,
    *,
    seed: int = 0,
    quick: bool = False,
    part: str | None = None,
    plan: TransferPlan | None = None,
    folder: Path | None = None,
) -> None:
    """Trains, judges, predicts tables; writes a JSON for each half and the page.

    Args:
        out: Folder of results.
        seed: Of the evaluation and the tables; the training seeds are the plan's.
        quick: A few frames and scenes, to see that everything runs.
        part: ``"agents"`` or ``"tables"``; both by default.
        plan: Another one than the real or the quick one.
        folder: Of the trained agents; by default ``runs/bench_transfer``.
    """
    plan = plan or (QUICK if quick else TransferPlan())
    folder = folder or ROOT / "runs" / ("bench_transfer_quick" if quick else "bench_transfer")
    finished = FinishedParts(RUNS / "transfer", seed, code=_CODE)
    measures: dict[str, Callable[[], list[Row]]] = {
        "agents": lambda: agent_rows(plan, folder, seed=seed),
        "tables": lambda: table_rows(plan, finished, seed=seed),
    }
    for name in PARTS if part is None else (part,):
        command = f"ae-env bench transfer --part {name}{' --quick' * quick}"
        rows = measures[name]()
        meta = result_meta(command, seed) | {"quick": quick, "plan": asdict(plan)}
        meta |= {"training_set": training_set(plan), "left_out": _left_out(plan, name)}
        path = write_results(out / FILES[name], [rounded(row) for row in rows], meta)
        print_files({f"numbers of the {name}": path})
        if name == "tables":  # the next run measures again
            finished.forget()
    print_files({"page": write_page(out)})


def _left_out(plan: TransferPlan, half: str) -> list[str]:
    """Worlds or simulators whose networks are not there."""
    used = (name for part in plan.tables for name in part.simulators)
    names = plan.worlds if half == "agents" else dict.fromkeys(used)
    return [name for name in names if not has_weights(name)]
