"""Stiff and extreme cases: errors against float64, declared limits, bad input, long runs.

    ae-env bench stability

Each group of cases yields rows (`benchmarks.stability.case.Row`); a row that is not ok is a defect.
A run that was stopped goes on with the group where it was.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from agents.cli.console import print_files, progress_bars
from benchmarks.keeping import Kept
from benchmarks.stability import (
    control,
    draws,
    exposures,
    fuzz,
    lamps,
    long_runs,
    networks,
    noise_levels,
    scores,
    signals,
)
from benchmarks.stability.case import Row
from benchmarks.stability.plots import draw
from benchmarks.stability.report import markdown
from simulator.utils.files import write_atomically
from simulator.utils.results import result_meta, write_results

#: Groups of a run that was stopped.
FOLDER = Path("runs/stability")
#: The code that is measured.
MEASURED = ("simulator", "ae_env", "agents", "benchmarks/stability")
#: ``rows(seed, quick)`` of each group, in the order of the page.
GROUPS: dict[str, Callable[[int, bool], Iterator[Row]]] = {
    "exposure ratios": exposures.rows,
    "signals": signals.rows,
    "noise level functions": noise_levels.rows,
    "noise draws": draws.rows,
    "networks": networks.rows,
    "stiff light": lamps.rows,
    "stiff control": control.rows,
    "scores": scores.rows,
    "fuzzing": fuzz.rows,
    "long runs": long_runs.rows,
}


def run(out: Path, seed: int = 0, quick: bool = False) -> None:
    """Measures and writes ``stability.json``, ``.md`` and ``.png`` under `out`.

    Args:
        out: Folder of results.
        seed: Of every random number.
        quick: Fewer points, inputs and steps, about two minutes.
    """
    kept = Kept(FOLDER / ("quick" if quick else "full"), seed, code=MEASURED)
    meta = result_meta(f"ae-env bench stability{' --quick' * quick}", seed)
    rows: list[dict[str, Any]] = []
    with progress_bars() as progress, progress("cases") as task:
        for i, (name, measure) in enumerate(GROUPS.items()):
            task(i, len(GROUPS), name)
            rows += _measured(name, measure, seed, quick, kept)
        task(1, 1)
    files = {
        "numbers": write_results(out / "stability.json", rows, meta),
        "report": write_atomically(out / "stability.md", markdown(rows, meta)),
        "plot": draw(out / "stability.png", rows),
    }
    kept.forget()
    print_files(files)


def _measured(
    name: str,
    measure: Callable[[int, bool], Iterator[Row]],
    seed: int,
    quick: bool,
    kept: Callable[[str, Callable[[], list[dict[str, Any]]]], list[dict[str, Any]]],
) -> list[dict[str, Any]]:
    """The rows of a group; one that fails has those until then and the failure, and is not kept."""
    rows: list[dict[str, Any]] = []

    def collect() -> list[dict[str, Any]]:
        for row in measure(seed, quick):
            rows.append(row.json())
        return rows

    try:
        return kept(name, collect)
    except Exception as error:
        note = " ".join(f"{type(error).__name__}: {error}".split())
        return [
            *rows,
            Row(name, "the group itself", None, dtype="", finite=False, note=note).json(),
        ]
