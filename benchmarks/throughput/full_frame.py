"""A 24-megapixel raw through the simulator to a DNG, beside what LibRaw takes for the file.

Every run is a process of its own. The frame is a DNG of this library's making whose private note
has been blanked, so that it is read like any other camera's.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import rawpy

from benchmarks.harness import RUNS, Part, Row, data_root
from benchmarks.isolated import peak_memory, timed
from benchmarks.throughput.growth import noisy_raw
from simulator import CameraSettings, CameraSimulator, read_raw, write_dng
from simulator.raw.dng import SOFTWARE_NAME

#: Packed height and width of 24 megapixels, of the quick run's 1.5, and of the frame that loads
#: all code: large enough for every thread.
FULL, QUICK, SMALL = (2000, 3000), (500, 750), (256, 256)
#: Times that a process takes the file through everything; the first one counts by itself.
PASSES = 4
#: Name: weights, depth, target, noise, of a source at ISO 400, 1/64 s, f/8. The last needs both
#: networks: it is cleaner, and opens.
CASES: dict[str, tuple[str | None, str, tuple[float, float, float], str]] = {
    "exposure + noise": (None, "far", (1600, 1 / 256, 8.0), "exact"),
    "exposure + noise from the bank": (None, "far", (1600, 1 / 256, 8.0), "bank"),
    "full model": ("compact", "unknown", (100, 1 / 64, 4.0), "exact"),
}
STAGES = ("read", "prepare", "simulate", "write")


def parts(quick: bool) -> Iterator[Part]:
    synthetic = RUNS / "throughput" / f"frame{'_quick' * quick}.dng"
    synthetic.parent.mkdir(parents=True, exist_ok=True)
    _write_foreign_dng(synthetic, *(QUICK if quick else FULL))
    data = data_root()
    real = sorted((data / "canon_crw_cc0").glob("*.CRW")) if data is not None else []
    for path in [synthetic, *(real[:1] if not quick else [])]:
        file = {"path": str(path.absolute())}
        yield Part(f"libraw|{path.name}", libraw, file)
        for case, (weights, *_) in CASES.items():
            passes = 1 if quick or weights is not None else PASSES  # networks take long
            arguments = {**file, "case": case, "passes": passes}
            yield Part(f"frame|{path.name}|{case}", simulate, arguments, fresh_cache=True)


def rows(results: dict[str, Any]) -> list[Row]:
    found = []
    for label, row in results.items():
        if label.startswith("frame|"):
            _, name, case = label.split("|")
            file = "synthetic DNG" if name.startswith("frame") else name
            found.append({"case": case, "file": file, **row, "libraw": results[f"libraw|{name}"]})
    return found


def _write_foreign_dng(path: Path, height: int, width: int) -> None:
    write_dng(path, noisy_raw(height, width))
    note = SOFTWARE_NAME.encode()
    path.write_bytes(path.read_bytes().replace(note, b" " * len(note)))


def simulate(path: str, case: str, passes: int) -> Row:
    """`read_raw`, `simulate`, `write_dng`, with networks loaded and all code warm.

    ``first`` is the time of the process's first frame of that size, which the system has to give
    memory for; ``seconds`` the median of those that follow, if any, and ``stages`` the last one's.
    """
    weights, depth, target, noise = CASES[case]
    settings, simulator = CameraSettings(*target), CameraSimulator()
    options: dict[str, Any] = {"noise": noise}
    if weights is not None:
        simulator = CameraSimulator.from_pretrained(weights, cache=None)
    seconds = []
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.dng"
        _write_foreign_dng(out, *SMALL)
        for file in (out, *[Path(path)] * passes):  # the first loads all code
            clock = [time.perf_counter()]
            raw = read_raw(file)
            clock.append(time.perf_counter())
            prepared = simulator.prepare(raw, depth=depth)  # type: ignore[arg-type]
            clock.append(time.perf_counter())
            result = simulator.simulate(prepared, settings, **options)
            clock.append(time.perf_counter())
            write_dng(out, result)
            clock.append(time.perf_counter())
            seconds.append(clock[-1] - clock[0])
            megapixels = 4e-6 * raw.data[0].numel()
            modules, peak = list(prepared.plan(settings).modules), peak_memory()
            del raw, prepared, result
    row: Row = {"megapixels": megapixels, "first": seconds[1], "peak_mib": peak, "modules": modules}
    row |= {"seconds": statistics.median(seconds[2:] or seconds[1:])}
    row |= {"stages": {name: clock[i + 1] - clock[i] for i, name in enumerate(STAGES)}}
    return row | {"networks": weights is not None}


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
    found = {"first": unpacking[0] + writing[0], "develop": timed(develop)}
    found["unpack"] = statistics.median(unpacking[1:])
    return found | {"write": statistics.median(writing[1:])}
