"""What the first episode waits for where nothing has been compiled or drawn before."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from statistics import median

from benchmarks.harness import Row, quartiles
from benchmarks.isolated import CORES
from benchmarks.throughput.worker import ID
from simulator.utils.cache import CACHE_VARIABLE

#: Cases, and how often each is measured, quick and in full.
CASES, REPEATS = ("nothing cached", "all but scenes cached"), (1, 5)
#: The times of a row, in seconds; the last are more episodes, in which motion comes up.
TIMES = ("import", "make", "reset", "step", "episodes")
_PROGRAM = f"""
import json, time
times = [time.perf_counter()]
def lap(): times.append(time.perf_counter())
import gymnasium, ae_env
lap()
env = gymnasium.make({ID!r})
lap()
env.reset(seed=0)
lap()
env.step(0)
lap()
cpu = time.process_time()
for episode in range(8):
    env.reset()
    for action in range(0, 64, 8):
        env.step(action)
lap()
print(json.dumps([after - before for before, after in zip(times, times[1:])] + [cpu]))
"""


def measure_cold_start(quick: bool) -> list[Row]:
    """A row for each of `CASES`: medians of the `TIMES` of fresh processes, and of their sum."""
    found: dict[str, list[list[float]]] = {case: [] for case in CASES}
    for _ in range(REPEATS[not quick]):
        with tempfile.TemporaryDirectory() as folder:
            caches = {"NUMBA_CACHE_DIR": f"{folder}/kernels", CACHE_VARIABLE: f"{folder}/cache"}
            for case in CASES:
                output = subprocess.check_output(
                    [sys.executable, "-c", _PROGRAM], env=os.environ | caches
                )
                found[case].append(json.loads(output.splitlines()[-1]))
    rows = []
    for case, runs in found.items():
        low, middle, high = quartiles([sum(run[:4]) for run in runs])
        row: Row = {"case": case, "threads": CORES, "total_s": middle}
        row |= {
            f"{name}_s": median(run[i] for run in runs) for i, name in enumerate((*TIMES, "cpu"))
        }
        rows.append(row | {"spread": (high - low) / middle})
    return rows
