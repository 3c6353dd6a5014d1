"""How time and memory grow with pixels, and a 24-megapixel raw beside LibRaw.

Every point is measured in a process of its own, because its peak memory is wanted. Memory is the
peak less what the process held before it, with all libraries loaded and warm. The large frame is a
DNG of this library's making whose private note has been blanked, so that it is read like any other
camera's.
"""

import os
import statistics
import tempfile
import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import rawpy
import torch
from scipy.stats import linregress

import ae_env  # noqa: F401  registers the environment
from benchmarks.harness import RUNS, Part, Row
from benchmarks.isolated import forget_peak, peak_memory, timed
from simulator import CameraSettings, CameraSimulator, RawImage, get_camera, read_raw, write_dng
from simulator.optics.discs import disc_blur
from simulator.radiance.procedural import LeafStyle, dead_leaves
from simulator.raw.dng import SOFTWARE_NAME
from simulator.utils.files import data_folder

# -- growth ---------------------------------------------------------------------------------------

#: Packed heights and widths: 16 thousand to 24 million samples, which are the sensor's pixels.
PIXELS = ((64, 64), (128, 128), (256, 256), (512, 512), (1024, 1024), (2000, 3000))
#: Least seconds that a point is repeated for, quick and in full.
_LEAST = (0.1, 0.6)
#: Memory below this is that of the allocator's own steps [MiB].
MEMORY_FLOOR = 4.0
#: Side of the picture that is repeated, mirrored, over a larger frame [packed pixel], and diameter
#: of the circle of confusion where it is out of focus.
_TILE, _DEFOCUS = 512, 4.0


def growth_parts(quick: bool) -> Iterator[Part]:
    curves = {"exposure + noise": None, "full model": "compact"}
    for (curve, weights), (h, w) in product(curves.items(), PIXELS[1:4] if quick else PIXELS):
        arguments = {"curve": curve, "height": h, "width": w, "weights": weights}
        yield Part(f"growth|{curve}|{h}x{w}", measure_pixels, arguments, fresh_cache=True)


def curves(points: list[Row]) -> list[Row]:
    rows = []
    for curve, own in pd.DataFrame(points).groupby("curve", sort=False):
        exponents = {
            key: fitted_exponent(list(zip(own["x"], own[key], strict=True)), floor)
            for key, floor in (("seconds", 0.0), ("mib", MEMORY_FLOOR))
        }
        row: Row = {"curve": curve, "exponents": exponents}
        rows.append(row | {"points": own[["x", "seconds", "mib"]].to_dict("records")})
    return rows


def fitted_exponent(points: list[tuple[float, float]], floor: float) -> list[float] | None:
    """Exponent k of y ~ x^k over the upper two decades of x, and its standard error.

    Values at or below `floor` do not count; None with fewer than three points.
    """
    most = max(x for x, _ in points)
    used = [(x, y) for x, y in points if y > floor and 100 * x >= 0.999 * most]
    if len(used) < 3:
        return None
    fit = linregress(*np.log10(used).T)
    return [float(fit.slope), float(fit.stderr)]


# -- the points, each run in a process of its own --------------------------------------------------


def measure_pixels(curve: str, height: int, width: int, weights: str | None, quick: bool) -> Row:
    """`simulate` of one raw at one state: time and memory, the raw itself included."""
    simulator, settings, depth = CameraSimulator(), CameraSettings(1600, 1 / 256, 8.0), "far"
    if weights is not None:  # to cleaner settings and a wider aperture, so that both are needed
        simulator = CameraSimulator.from_pretrained(weights, cache=None)
        settings, depth = CameraSettings(100, 1 / 16, 4.0), "unknown"
    options: dict[str, Any] = {"depth": depth}
    simulator.simulate(noisy_raw(64, 64), settings, **options)
    forget_peak()
    before = peak_memory()
    raw = noisy_raw(height, width)
    forget_peak()
    seconds = [timed(lambda: simulator.simulate(raw, settings, **options))]
    memory = peak_memory() - before
    while sum(seconds) < _LEAST[not quick]:
        seconds.append(timed(lambda: simulator.simulate(raw, settings, **options)))
    row: Row = {"curve": curve, "x": 4.0 * height * width, "mib": memory}
    return row | {"seconds": float(np.median(seconds)), "ms": 1e3 * float(np.median(seconds))}


def noisy_raw(height: int, width: int) -> RawImage:
    """A raw of any size as a Nikon Z6 records it at ISO 400: mirrored dead leaves.

    In focus on the left of each tile, out of focus on the right.
    """
    settings = CameraSettings(400, 1 / 64, 8.0)
    camera, rng = get_camera("nikon_z6"), np.random.default_rng(0)
    red, green, blue = dead_leaves(rng, _TILE, LeafStyle())
    tile = torch.from_numpy(np.stack([red * 0.5, green, green, blue * 0.6]))  # a sensor's, roughly
    tile[..., _TILE // 2 :] = disc_blur(tile, _DEFOCUS)[..., _TILE // 2 :]
    noise, more = camera.nlf(settings.iso), [(0, max(0, n - _TILE)) for n in (height, width)]
    data = np.empty((4, height, width), np.float32)
    for plane, part in enumerate(data):  # little more memory than the raw itself
        part[:] = np.pad(tile[plane].numpy(), more, mode="symmetric")[:height, :width]
        normals = rng.standard_normal(part.shape, dtype=np.float32)
        part += np.sqrt(part * noise.shot[plane] + noise.read[plane]) * normals
        span, black = (np.float32(v[plane]) for v in (camera.span, camera.black_level))
        numbers = np.rint(part * span + black).clip(0, camera.white_level)
        part[:] = (numbers - black) / span
    return RawImage(torch.from_numpy(data), settings, camera)


# -- a raw of 24 megapixels -----------------------------------------------------------------------

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


def frame_parts(quick: bool) -> Iterator[Part]:
    synthetic = RUNS / "throughput" / f"synthetic{'_quick' * quick}.dng"
    synthetic.parent.mkdir(parents=True, exist_ok=True)
    _write_foreign_dng(synthetic, *(QUICK if quick else FULL))
    data = data_folder()
    real = sorted((data / "canon_crw_cc0").glob("*.CRW")) if data is not None else []
    for path in [synthetic, *(real[:1] if not quick else [])]:
        file = {"path": str(path.absolute())}
        yield Part(f"libraw|{path.name}", libraw, file)
        for case, (weights, *_) in CASES.items():
            passes = 1 if quick or weights is not None else PASSES  # networks take long
            arguments = {**file, "case": case, "passes": passes}
            yield Part(f"frame|{path.name}|{case}", simulate, arguments, fresh_cache=True)


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
            modules, peak = ", ".join(prepared.plan(settings).modules), peak_memory()
            del raw, prepared, result
    row: Row = {"case": case, "file": Path(path).name, "modules": modules}
    row |= {"megapixels": megapixels, "first": seconds[1], "peak_mib": peak}
    row |= {"seconds": statistics.median(seconds[2:] or seconds[1:])}
    return row | {"stages": {name: clock[i + 1] - clock[i] for i, name in enumerate(STAGES)}}


def libraw(path: str) -> Row:
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
    row: Row = {"file": Path(path).name, "first": unpacking[0] + writing[0]}
    unpacked, written = (statistics.median(times[1:]) for times in (unpacking, writing))
    return row | {"develop": timed(develop), "unpack": unpacked, "write": written}
