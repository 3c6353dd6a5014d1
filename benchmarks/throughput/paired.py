"""Two checkouts of this project timed in turns on one machine: this one and one from before.

    python -m benchmarks.throughput.paired ../before

One process per checkout (`worker`, with ``PYTHONPATH`` set to it) is started and stays; in each
round both run the same case for the same time, one right after the other, and the order swaps from
round to round. Every launch starts both processes again, because where memory happens to lie makes
a process faster or slower for as long as it lives. The ratio is the median over all rounds.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import Row, table
from benchmarks.isolated import ROOT
from benchmarks.throughput.worker import STEPS, SWEEPS
from simulator.utils.cache import CACHE_VARIABLE

#: Launches, rounds of each, and seconds that a case runs in a round.
QUICK, FULL = (1, 4, 0.1), (3, 12, 0.3)
CASES = (*STEPS, *SWEEPS)
#: Columns of the table.
COLUMNS: dict[str, Any] = {
    "case": "{case}",
    "threads": "{threads}",
    "before [1/s]": "{steps_per_second_before:,.1f}",
    "now [1/s]": "{steps_per_second:,.1f}",
    "ratio": "{ratio_to_before:.3f}",
    "quartiles": "{ratio_quartiles[0]:.3f} to {ratio_quartiles[1]:.3f}",
    "smallest to largest": "{ratio_min:.2f} to {ratio_max:.2f}",
    "of processor time": "{ratio_cpu:.3f}",
    "frames differ by": "{max_difference:.2g}",
}
#: Seconds per frame, by kind of time.
Times = dict[str, float]


class Worker:
    """A process that measures one checkout.

    Args:
        checkout: Its folder.
        threads: Threads that it may use.

    Raises:
        RuntimeError: If it does not start, or runs another checkout's packages.
    """

    def __init__(self, checkout: Path, threads: int) -> None:
        self.checkout = checkout.resolve()
        self._folder = tempfile.TemporaryDirectory()
        cache = self.checkout / "runs" / "paired_cache"  # neither reads what the other computed
        environment = {
            "PYTHONPATH": str(self.checkout),
            CACHE_VARIABLE: str(cache),
            "OMP_NUM_THREADS": str(threads),
            "MKL_NUM_THREADS": str(threads),
        }
        script = Path(__file__).with_name("worker.py")
        self._process = subprocess.Popen(
            # -P: the script's own folder is not on the path
            [sys.executable, "-P", str(script), str(threads), self._folder.name],
            cwd=self.checkout,
            env=os.environ | environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        started = self._answer()
        for package, file in started.items():
            if not Path(file).is_relative_to(self.checkout):
                self.stop()
                raise RuntimeError(f"{package} was imported from {file}, not {self.checkout}")

    def time(self, case: str, seconds: float) -> dict[str, float]:
        """Time per frame of `case` [s], ``wall`` and ``cpu``, run for `seconds`."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"case": case, "seconds": seconds}) + "\n")
        self._process.stdin.flush()
        return self._answer()

    def first_frames(self) -> np.ndarray:
        """Frames that the case timed for the first time made with fixed seeds and states."""
        return np.load(Path(self._folder.name) / "first.npy")

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


def measure_paired(
    against: str,
    *,
    threads: int = 1,
    cases: Sequence[str] = CASES,
    quick: bool = False,
) -> list[Row]:
    """One row per case: speeds of both checkouts and their ratio."""
    launches, rounds, seconds = QUICK if quick else FULL
    times: dict[str, list[tuple[Times, Times]]] = {case: [] for case in cases}
    differences: dict[str, float] = {}
    for launch in range(launches):
        own, other = (Worker(path, threads) for path in (ROOT, Path(against)))
        try:
            for number, case in enumerate(cases):
                print(f"{launch}/{launches}, {number}/{len(cases)}: {case}", file=sys.stderr)
                for worker in (own, other):  # makes the case and warms it up
                    worker.time(case, seconds)
                first, second = (w.first_frames().astype(float) for w in (own, other))
                differences[case] = float(np.abs(first - second).max())
                for turn in range(rounds):
                    if turn % 2:
                        after, before = own.time(case, seconds), other.time(case, seconds)
                    else:
                        before, after = other.time(case, seconds), own.time(case, seconds)
                    times[case].append((before, after))
        finally:
            own.stop()
            other.stop()
    return [_row(case, threads, pairs, differences[case]) for case, pairs in times.items()]


def _row(case: str, threads: int, pairs: list[tuple[Times, Times]], difference: float) -> Row:
    before, after = ([pair[side]["wall"] for pair in pairs] for side in (0, 1))
    ratios = [old / new for old, new in zip(before, after, strict=True)]
    low, high = np.quantile(ratios, (0.25, 0.75))
    return {
        "case": case,
        "num_envs": STEPS[case][0] if case in STEPS else None,
        "threads": threads,
        "size": SWEEPS[case][0] if case in SWEEPS else 64,
        "steps_per_second": 1.0 / statistics.median(after),
        "steps_per_second_before": 1.0 / statistics.median(before),
        "ratio_to_before": statistics.median(ratios),
        "ratio_quartiles": [float(low), float(high)],
        "ratio_min": min(ratios),
        "ratio_max": max(ratios),
        # Processor time suffers less from other programs.
        "ratio_cpu": statistics.median(old["cpu"] / new["cpu"] for old, new in pairs),
        "rounds": len(pairs),
        "max_difference": difference,
    }


def main() -> None:
    """Measures and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("against", help="folder of the other checkout")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--only", default="", help="part of the cases' names")
    given = parser.parse_args()
    rows = measure_paired(
        given.against,
        threads=given.threads,
        cases=[case for case in CASES if given.only in case],
        quick=given.quick,
    )
    print(table(rows, COLUMNS))


if __name__ == "__main__":
    main()
