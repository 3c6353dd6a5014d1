"""A 24-megapixel raw through the simulator to a DNG, beside what LibRaw takes for the file.

Every run is a process of its own. The frame is a DNG of this library's making whose private note
has been blanked, so that it is read like any other camera's.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rawpy

from benchmarks.isolated import forget_peak, isolated, peak_memory, timed
from benchmarks.keeping import Kept
from benchmarks.throughput.frames import noisy_raw
from simulator import CameraSettings, CameraSimulator, read_raw, write_dng
from simulator.raw.dng import SOFTWARE_NAME

#: Packed height and width of 24 megapixels, and of the quick run's 1.5.
FULL, QUICK = (2000, 3000), (500, 750)
#: The same of the frame that loads all code: large enough for every thread.
SMALL = (256, 256)
#: Times that a process takes the file through everything; the first one counts by itself.
PASSES = 4
#: The synthetic raw was taken so; the targets follow.
SOURCE = CameraSettings(400, 1 / 64, 8.0)
#: Name: weights, depth, target, noise. The last needs both networks: it is cleaner, and opens.
CASES: dict[str, tuple[str | None, str, tuple[float, float, float], str]] = {
    "exposure + noise": (None, "far", (1600, 1 / 256, 8.0), "exact"),
    "exposure + noise from the bank": (None, "far", (1600, 1 / 256, 8.0), "bank"),
    "full model": ("compact", "unknown", (100, 1 / 64, 4.0), "exact"),
}
STAGES = ("read", "prepare", "simulate", "write")


def measure(
    kept: Kept, data: Path | None, *, threads: int, quick: bool, progress: Callable[[], None]
) -> list[dict[str, Any]]:
    """One row per file and case: seconds and peak memory of all and of each stage.

    Args:
        kept: Where results are kept.
        data: Folder of real files; None where there is none.
        threads: Threads to use.
        quick: A small frame, once.
        progress: Called after every case.
    """
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "frame.dng"
        write_foreign_dng(path, *(QUICK if quick else FULL))
        files = {"synthetic": (path, "")}
        photographs = [] if data is None else sorted((data / "canon_crw_cc0").glob("*.CRW"))
        if photographs and not quick:
            files["real"] = (photographs[0].absolute(), photographs[0].name)
        for kind, (file, name) in files.items():
            limits = kept(f"libraw {kind}", lambda f=file: _limits(f, threads, quick))
            for case in CASES:
                row = kept(
                    f"full frame {kind} {case}", lambda f=file, c=case: _row(f, c, threads, quick)
                )
                rows.append({"file": kind, "name": name, "case": case, **row, "limits": limits})
                progress()
    return rows


def write_foreign_dng(path: Path, height: int, width: int) -> None:
    """Writes a DNG that does not say that it comes from this library."""
    write_dng(path, noisy_raw(height, width, settings=SOURCE))
    note = SOFTWARE_NAME.encode()
    path.write_bytes(path.read_bytes().replace(note, b" " * len(note)))


def _limits(file: Path, threads: int, quick: bool) -> dict[str, float]:
    runs = [isolated(libraw, num_threads=threads, path=str(file)) for _ in range(1 if quick else 3)]
    return {key: statistics.median(run[key] for run in runs) for key in runs[0]}


def _row(file: Path, case: str, threads: int, quick: bool) -> dict[str, Any]:
    once = quick or CASES[case][0] is not None  # networks take long

    def repeated(task: Callable[..., Any]) -> list[dict[str, Any]]:
        arguments: dict[str, Any] = {"path": str(file), "case": case}
        arguments["passes"] = 1 if once else PASSES
        return [
            isolated(task, num_threads=threads, fresh_cache=True, **arguments)
            for _ in range(1 if once else 3)
        ]

    whole, stages = repeated(end_to_end), repeated(by_stage)
    seconds = [run["seconds"] for run in whole]
    return {
        "megapixels": whole[0]["megapixels"],
        "seconds": statistics.median(seconds),
        "first": statistics.median(run["first"] for run in whole),
        "spread": max(seconds) - min(seconds),
        "peak_mib": max(run["peak_mib"] for run in whole),
        "modules": stages[0]["modules"],
        "networks": CASES[case][0] is not None,
        "stages": {
            name: {
                key: statistics.median(run["stages"][name][key] for run in stages)
                for key in ("seconds", "peak_mib")
            }
            for name in STAGES
        },
    }


# -- run in processes of their own ----------------------------------------------------------------


def end_to_end(path: str, case: str, passes: int) -> dict[str, Any]:
    """`read_raw`, `simulate`, `write_dng`, with networks loaded and all code warm.

    ``first`` is the time of the process' first frame of that size, which the system has to give
    memory for; ``seconds`` the median of those that follow, if any.
    """
    weights, depth, target, noise = CASES[case]
    settings, simulator = CameraSettings(*target), _warm(weights, depth, noise)

    def run(folder: str) -> None:
        result = simulator.simulate(read_raw(path), settings, depth=depth, noise=noise)
        write_dng(Path(folder) / "out.dng", result)

    seconds = []
    for _ in range(passes):
        with tempfile.TemporaryDirectory() as folder:
            seconds.append(timed(lambda place=folder: run(place)))
    return {
        "megapixels": 4e-6 * read_raw(path).data[0].numel(),
        "first": seconds[0],
        "seconds": statistics.median(seconds[1:] or seconds),
        "peak_mib": peak_memory(),
    }


def by_stage(path: str, case: str, passes: int) -> dict[str, Any]:
    """The last pass step by step: seconds, and peak memory of the process during each."""
    weights, depth, target, noise = CASES[case]
    settings, simulator = CameraSettings(*target), _warm(weights, depth, noise)
    found: dict[str, dict[str, float]] = {}

    @contextmanager
    def stage(name: str) -> Iterator[None]:
        forget_peak()
        start = time.perf_counter()
        yield
        found[name] = {"seconds": time.perf_counter() - start, "peak_mib": peak_memory()}

    for _ in range(passes):
        with tempfile.TemporaryDirectory() as folder:
            with stage("read"):
                raw = read_raw(path)
            with stage("prepare"):
                prepared = simulator.prepare(raw, depth=depth)
            del raw
            with stage("simulate"):
                result = simulator.simulate(prepared, settings, noise=noise)
            modules = list(prepared.plan(settings).modules)
            del prepared
            with stage("write"):
                write_dng(Path(folder) / "out.dng", result)
            del result
    return {"stages": found, "modules": modules}


def libraw(path: str) -> dict[str, float]:
    """Seconds of LibRaw for the file: unpacking, writing as many bytes, developing.

    ``first`` is the first unpacking and writing of the process; the others are medians of those
    that follow.
    """

    def unpack() -> int:
        with rawpy.imread(path) as raw:
            return raw.raw_image_visible.copy().nbytes

    def develop() -> None:
        with rawpy.imread(path) as raw:
            raw.postprocess(use_camera_wb=True, no_auto_bright=True)

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "mosaic"
        unpacking = [timed(unpack) for _ in range(PASSES)]
        content = os.urandom(unpack())
        writing = [timed(lambda: file.write_bytes(content)) for _ in range(PASSES)]
    return {
        "first": unpacking[0] + writing[0],
        "unpack": statistics.median(unpacking[1:]),
        "write": statistics.median(writing[1:]),
        "develop": timed(develop),
    }


def _warm(weights: str | None, depth: str, noise: str) -> CameraSimulator:
    """A simulator that has taken a small file of the same kind through every step."""
    simulator = CameraSimulator()
    if weights is not None:
        simulator = CameraSimulator.from_pretrained(weights, cache=None)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "small.dng"
        write_foreign_dng(path, *SMALL)
        opened = CameraSettings(100, 1 / 16, 4.0)
        result = simulator.simulate(read_raw(path), opened, depth=depth, noise=noise)
        write_dng(path, result)
    return simulator
