"""Sweeps of all 64 states beside one with the paper's networks, which repeats nothing either."""

import statistics
from collections.abc import Iterator
from functools import partial

from benchmarks.harness import Part, Row
from benchmarks.isolated import timed
from benchmarks.work_precision.methods import DEFAULT, PaperSweep, simulator
from benchmarks.work_precision.plans import GRID, SIZES, trials
from simulator import CameraSimulator, RawImage

#: Sweeps that are timed before the paper's networks run, and as many behind them.
_REPEATS = 3


def sweep_parts(quick: bool) -> Iterator[Part]:
    for height, width in SIZES[: 1 if quick else None]:
        arguments = {"height": height, "width": width}
        yield Part(f"sweep|{height}x{width}", measure_sweeps, arguments, fresh_cache=True)


def measure_sweeps(height: int, width: int, seed: int, quick: bool) -> list[Row]:
    """A row for each scene; the paper's networks have random weights, which take the same time."""
    own, paper = simulator("compact"), CameraSimulator("paper", device="cpu", cache=None)

    def sweep(raw: RawImage) -> None:
        own.prepare(raw, depth="unknown", tolerance=DEFAULT).expose(GRID, seed=seed)

    rows = []
    for number, trial in enumerate(trials((height, width))[: 1 if quick else None]):
        raw = trial.raw(seed + number)
        sweep(raw)  # loads all code
        ours = [timed(partial(sweep, raw)) for _ in range(_REPEATS)]
        theirs = timed(lambda raw=raw: PaperSweep(paper, raw).expose(GRID, seed=seed))  # type: ignore[misc]
        ours += [timed(partial(sweep, raw)) for _ in range(_REPEATS)]
        middle = statistics.median(ours)
        row: Row = {"size": f"{height} x {width}", "kind": trial.scene.kind}
        row |= {"source": str(trial.source), "ms": 1e3 * middle, "paper_ms": 1e3 * theirs}
        rows.append(row | {"times": theirs / middle})
    return rows
