"""What the first episode waits for where nothing has been compiled or drawn before."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

from benchmarks.harness import Row, quartiles
from benchmarks.isolated import CORES
from benchmarks.throughput.steps import ID
from simulator.utils.cache import CACHE_VARIABLE

#: Cases, and how often each is measured, quick and in full.
CASES = ("nothing cached", "all but scenes cached")
REPEATS = (1, 5)
#: Episodes after the first, in which motion comes up.
EPISODES = 8
#: The times of a row, in seconds.
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
for episode in range({EPISODES}):
    env.reset()
    for action in range(0, 64, 8):
        env.step(action)
lap()
print(json.dumps([after - before for before, after in zip(times, times[1:])] + [cpu]))
"""


def measure_cold_start(quick: bool) -> list[Row]:
    """A row for each of `CASES`: medians of the `TIMES` of fresh processes, and of their sum."""
    found: dict[str, list[dict[str, float]]] = {case: [] for case in CASES}
    for _ in range(REPEATS[not quick]):
        with tempfile.TemporaryDirectory() as folder:
            for case in CASES:
                found[case].append(_episode(Path(folder)))
    rows = []
    for case, runs in found.items():
        low, middle, high = quartiles([sum(run[name] for name in TIMES[:-1]) for run in runs])
        times = {f"{name}_s": median(run[name] for run in runs) for name in (*TIMES, "cpu")}
        row = {"case": case, "threads": CORES, "total_s": middle, **times}
        rows.append(row | {"spread": (high - low) / middle})
    return rows


def _episode(folder: Path) -> dict[str, float]:
    variables = {"NUMBA_CACHE_DIR": str(folder / "kernels"), CACHE_VARIABLE: str(folder / "cache")}
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM],
        env=os.environ | variables,
        capture_output=True,
        text=True,
        check=True,
    )
    return dict(zip((*TIMES, "cpu"), json.loads(done.stdout.splitlines()[-1]), strict=True))
