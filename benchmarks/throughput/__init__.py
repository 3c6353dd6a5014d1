"""Steps per second against what the machine could do, and how cost grows.

    ae-env bench throughput

Parts: environment steps beside a fused kernel, copies of the environment and a lookup; statistics
of the noise bank; growth of time and memory with pixels, states, environments and scenes; a
24-megapixel raw through the simulator beside LibRaw; where the time of a step goes; a GPU, where
there is one. The real files that ``AE_ENV_DATA`` names are used where they are. Every part runs in
processes of its own, and a run that was stopped goes on where it was.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from agents.cli.console import print_files, progress_bars
from benchmarks.isolated import CORES, isolated
from benchmarks.keeping import Kept
from benchmarks.simulator.scenes import data_root
from benchmarks.throughput import full_frame, growth
from benchmarks.throughput.gpu import measure_gpu
from benchmarks.throughput.noise_statistics import measure_noise
from benchmarks.throughput.plots import draw
from benchmarks.throughput.report import markdown
from benchmarks.throughput.step_profile import measure_profile
from benchmarks.throughput.steps import SCENES, measure_steps
from benchmarks.throughput.targets import check_targets
from simulator.utils.files import write_atomically
from simulator.utils.results import result_meta, write_results

#: Parts of a run that was stopped.
FOLDER = Path("runs/throughput")
#: The code that is measured.
MEASURED = ("simulator", "ae_env", "benchmarks/throughput")
#: Threads and frame sizes of the steps.
STEPS = ((CORES, 128), (CORES, 64), (1, 128))


def run(out: Path, seed: int = 0, quick: bool = False) -> None:
    """Measures and writes ``throughput.json``, ``.md`` and ``.png`` under `out`.

    Args:
        out: Folder of results.
        seed: Of episodes, actions and noise.
        quick: Fewer cases, points and repeats, about two minutes.
    """
    kept = Kept(FOLDER / ("quick" if quick else "full"), seed, code=MEASURED)
    meta = result_meta(f"ae-env bench throughput{' --quick' * quick}", seed)
    meta["scenes"] = SCENES
    with progress_bars() as progress:
        with progress("steps") as task:
            rows = list(_steps(kept, seed, quick, task))
        with progress("noise") as task:
            frames = 32 if quick else 128
            meta["noise"] = {}
            for i, noise in enumerate(("bank", "exact")):
                part = partial(measure_noise, noise=noise, frames=frames, seed=seed)
                meta["noise"][noise] = _kept(kept, f"noise {noise}", part, threads=1)
                task(i + 1, 2, noise)
        with progress("growth") as task:
            meta |= _growth(kept, quick, task)
        with progress("full frame") as task:
            done = _counter(task, len(full_frame.CASES) * (1 if quick else 2))
            meta["full_frame"] = full_frame.measure(
                kept, data_root(), threads=CORES, quick=quick, progress=done
            )
            task(1, 1)
        with progress("profile") as task:
            part = partial(measure_profile, threads=1, seconds=2.0 if quick else 8.0, seed=seed)
            meta["profile"] = _kept(kept, "profile", part, threads=1)
            meta["gpu"] = _kept(kept, "gpu", partial(measure_gpu, quick=quick), threads=CORES)
            task(1, 1)
    meta["targets"] = check_targets(rows, meta)
    files = {
        "numbers": write_results(out / "throughput.json", rows, meta),
        "report": write_atomically(out / "throughput.md", markdown(rows, meta)),
        "plot": draw(out / "throughput.png", rows, meta["growth"]),
    }
    kept.forget()
    print_files(files)


def _kept(kept: Kept, name: str, part: partial[Any], *, threads: int) -> Any:
    """What `part` returns from a process of its own, or has returned to a run that was stopped."""
    return kept(name, lambda: isolated(part.func, **part.keywords, num_threads=threads))


def _steps(kept: Kept, seed: int, quick: bool, task: Any) -> Iterator[dict[str, Any]]:
    combinations = list(dict.fromkeys(STEPS))[: 1 if quick else None]
    for i, (threads, size) in enumerate(combinations):
        task(i, len(combinations), f"{size} x {size}, {threads} threads")
        part = partial(measure_steps, threads=threads, size=size, seed=seed, quick=quick)
        yield from _kept(kept, f"steps {threads} {size}", part, threads=threads)
    task(1, 1)


def _growth(kept: Kept, quick: bool, task: Any) -> dict[str, Any]:
    series = list(growth.all_series(quick))
    sizes = growth.MARGINAL_SIZES[: 1 if quick else None]
    marginal = [(*size, noise) for size in sizes for noise in ("bank", "exact")]
    done = _counter(task, sum(len(s.points) for s in series) + len(marginal))
    curves = [
        growth.measure_series(s, kept, threads=CORES, quick=quick, progress=done) for s in series
    ]
    rows = []
    for height, width, noise in marginal:
        part = partial(
            growth.measure_marginal, height=height, width=width, noise=noise, quick=quick
        )
        rows.append(_kept(kept, f"marginal {height} {width} {noise}", part, threads=1))
        done()
    return {"growth": curves, "marginal": rows}


def _counter(task: Any, total: int) -> Callable[[], None]:
    """Moves the bar of `task` on by one of `total` with every call."""
    state = {"done": 0}

    def step() -> None:
        state["done"] += 1
        task(state["done"], total)

    task(0, total)
    return step
