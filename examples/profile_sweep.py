"""What holds a sweep of a small raw: its networks, and how fast they compute.

`python examples/profile_sweep.py [THREADS]` takes the 12 sweeps of 64 states at 128 x 128 of
`ae-env bench throughput`, on two threads by default. Each runs as there, and once more with the
results of its networks in memory: the difference is the networks' time. Beside it stand the
operations of their convolutions, and in turns two matrices of 1024 x 1024 are multiplied, which is
about the fastest that torch can compute.
"""

import sys
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.isolated import timed
from benchmarks.work_precision.methods import DEFAULT, simulator, weights
from benchmarks.work_precision.plans import GRID, trials
from simulator import CameraSimulator

ROUNDS, SIDE = 5, 1024


def main(threads=2):
    """Measures and prints a table."""
    torch.set_num_threads(threads)
    matrix, bare, rows = torch.rand(SIDE, SIDE), simulator("compact"), []

    def sweep(raw, own=bare):
        own.prepare(raw, depth="unknown", tolerance=DEFAULT).expose(GRID, seed=0)

    for number, trial in enumerate(trials((128, 128))):
        raw = trial.raw(number)
        kept = CameraSimulator.from_pretrained(Path(weights("compact")), device="cpu")
        sweep(raw, kept)
        with FlopCounterMode(display=False) as counted:
            sweep(raw)
        calls = partial(sweep, raw), partial(sweep, raw, kept), partial(torch.mm, matrix, matrix)
        times = [[timed(call) for call in calls] for _ in range(ROUNDS)]
        rows.append([counted.get_total_flops() / 1e9, *np.median(times, axis=0)])
    operations, whole, rest, product = np.array(rows).T
    networks = whole - rest
    print(f"{threads} threads, 128 x 128, {len(rows)} sweeps of {len(GRID)} states, medians")
    for name, values in (
        ("sweep [ms]", 1e3 * whole),
        ("without its networks [ms]", 1e3 * rest),
        ("its networks [ms]", 1e3 * networks),
        ("operations of their convolutions [1e9]", operations),
        ("the same in a second [1e9]", operations / networks),
        ("operations of a product of matrices in a second [1e9]", 2e-9 * SIDE**3 / product),
    ):
        print(f"{name:54} {np.median(values):7.1f}")


if __name__ == "__main__":
    number = sys.argv[1] if len(sys.argv) > 1 else "2"
    if len(sys.argv) > 2 or not number.isdecimal() or not 1 <= int(number) <= 64:
        sys.exit("usage: python examples/profile_sweep.py [THREADS]; THREADS is 1 to 64")
    main(int(number))
