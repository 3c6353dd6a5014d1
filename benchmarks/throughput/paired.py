"""Two checkouts of this project timed in turns on one machine: this one and one from before.

One process per checkout (`worker`, with ``PYTHONPATH`` set to it) is started and stays; in each
round both run the same case for the same time, one right after the other, and the order swaps from
round to round. Every launch starts both processes again, because where memory happens to lie makes
a process faster or slower for as long as it lives. The ratio is the median over all rounds.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import Row, quartiles
from benchmarks.isolated import ROOT
from benchmarks.throughput.worker import STEPS, SWEEPS
from simulator.utils.cache import CACHE_VARIABLE

#: Launches, rounds of each, and seconds that a case runs in a round.
QUICK, FULL = (1, 4, 0.1), (3, 12, 0.3)
COLUMNS = """case = {case} | threads = {threads} | before [1/s] = {steps_per_second_before:,.1f} |
now [1/s] = {steps_per_second:,.1f} | ratio = {ratio_to_before:.3f} |
quartiles = {ratio_quartiles:.3f} | smallest to largest = {ratio_min:.2f} to {ratio_max:.2f} |
frames differ by = {max_difference:.2g}"""


def checkout(against: Path) -> Path:
    """The folder of another checkout."""
    if not (against / "simulator" / "__init__.py").is_file():
        rule = "must be a checkout of this project (git worktree add makes one of a commit)"
        raise ValueError(f"`against` (={str(against)!r}) {rule}")
    return against.absolute()


class Worker:
    """A process that measures one checkout with so many threads."""

    def __init__(self, checkout: Path, threads: int) -> None:
        self.checkout = checkout.resolve()
        self._folder = tempfile.TemporaryDirectory()
        cache = self.checkout / "runs" / "paired_cache"  # neither reads what the other computed
        variables = {"PYTHONPATH": str(self.checkout), CACHE_VARIABLE: str(cache)}
        variables |= {name: str(threads) for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS")}
        script = Path(__file__).with_name("worker.py")
        self._process = subprocess.Popen(
            # -P: the script's own folder is not on the path
            [sys.executable, "-P", str(script), str(threads), self._folder.name],
            cwd=self.checkout,
            env=os.environ | variables,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for package, file in self._answer().items():
            if not Path(file).is_relative_to(self.checkout):
                self.stop()
                raise RuntimeError(f"{package} was imported from {file}, not {self.checkout}")

    def time(self, case: str, seconds: float) -> float:
        """Time per frame of `case` [s], run for `seconds`."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"case": case, "seconds": seconds}) + "\n")
        self._process.stdin.flush()
        return float(self._answer()["seconds"])

    def first_frames(self) -> np.ndarray:
        """Frames that the case timed for the first time made with fixed seeds and states."""
        return np.load(Path(self._folder.name) / "first.npy").astype(float)

    def stop(self) -> None:
        """Ends the process."""
        self._process.kill()
        self._process.communicate()
        self._folder.cleanup()

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self.stop()
            raise RuntimeError(f"the measuring process of {self.checkout} ended, see above")
        return json.loads(line)


def measure_paired(against: str, threads: int, quick: bool) -> list[Row]:
    """One row per case: speeds of both checkouts and their ratio."""
    launches, rounds, seconds = QUICK if quick else FULL
    # Times per frame (before, now) of every case, and by how much its frames differ.
    times: dict[str, list[tuple[float, float]]] = {}
    differences: dict[str, float] = {}
    for _ in range(launches):
        own, other = (Worker(path, threads) for path in (ROOT, Path(against)))
        try:
            for case in (*STEPS, *SWEEPS):
                for worker in (own, other):  # makes the case and warms it up
                    worker.time(case, seconds)
                apart = np.abs(own.first_frames() - other.first_frames()).max()
                differences[case] = float(apart)
                for turn in range(rounds):
                    turns = (own, other) if turn % 2 else (other, own)
                    found = {worker: worker.time(case, seconds) for worker in turns}
                    times.setdefault(case, []).append((found[other], found[own]))
        finally:
            own.stop()
            other.stop()
    rows = []
    for case, pairs in times.items():
        then, now = map(statistics.median, zip(*pairs, strict=True))
        ratios = [old / new for old, new in pairs]
        low, middle, high = quartiles(ratios)
        row: Row = {"case": case, "threads": threads, "ratio_to_before": middle}
        row |= {"steps_per_second": 1.0 / now, "steps_per_second_before": 1.0 / then}
        row |= {"ratio_quartiles": [low, high], "max_difference": differences[case]}
        row |= {"ratio_min": min(ratios), "ratio_max": max(ratios)}
        rows.append(row | {"rounds": len(pairs)})
    return rows
