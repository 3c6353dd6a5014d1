"""The photon transfer curve of simulated cameras, measured as EMVA 1288 (release 4.0) measures it.

Pairs of flat fields at a ladder of exposure times, dark ones included, of every built-in camera at
a few ISOs, from the reference camera and from the transition engine. Measured are green planes:

- mean and temporal variance of a pair; half the variance of its difference, so that what does not
  change from frame to frame drops out;
- the system gain K, digital numbers per electron: the slope, through the origin, of variance over
  mean, both less their dark values, from 0 to 70 % of saturation, where the variance is highest;
- the dark noise: the square root of the dark variance, in digital numbers, rounding included;
- the row noise: the variance of the means of sensor rows in a difference of dark frames, less the
  share that the noise of single pixels has in it. (EMVA 1288 has no temporal row noise.)
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from time import perf_counter
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from scipy.stats import t as student

from benchmarks.harness import Benchmark, Part, Report, Row, pivot, table
from simulator.camera import CameraProfile, get_camera, list_cameras
from simulator.camera_simulator import CameraSimulator
from simulator.capture.prepared_scene import PreparedScene
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.reference.camera import ReferenceCamera, ReferenceScene
from simulator.settings import CameraSettings

ISOS = (100.0, 800.0, 6400.0)
PATHS = ("reference camera", "transition engine")
SIZE = 128
#: Signals of the ladder: 21 steps to just above white, and darkness.
LADDER = (0.0, *np.linspace(0.05, 1.05, 21))
#: Up to this share of the saturation K is fitted (EMVA 1288).
FITTED = 0.7
_WHITE_TIME = 1 / 64  # exposure time [s] that the ladder's 1 stands for
QUANTITIES = {"gain": "K [DN/e-]", "dark": "dark noise [DN]", "row": "row noise [DN]"}
COVERAGE = {"": "{case}"} | {v: f"{{{k}}} of {{all}}" for k, v in QUANTITIES.items()}
COVERAGE["ms a frame"] = "{ms:.2f}"


def flat_fields(camera: CameraProfile, iso: float, path: str, rows: bool, seed: int) -> np.ndarray:
    """One frame of each step of the ladder, (21 + 1, 4, SIZE, SIZE) digital numbers above black."""
    base = CameraSettings(iso, _WHITE_TIME, 4.0)
    states = [replace(base, exposure_time=_WHITE_TIME * max(level, 0.01)) for level in LADDER]
    lights = [torch.full((4, SIZE, SIZE), float(level > 0)) for level in LADDER]
    if path == "reference camera":
        body = ReferenceCamera(camera, sensor_noise=rows)
        scenes = [ReferenceScene("flat", "flat", "flat", light, base) for light in lights]
        pairs = zip(scenes, states, strict=True)
        frames = torch.stack([body.capture(scene, s, seed).sample for scene, s in pairs])
    else:
        clean, simulator = NoiseLevelFunction.zero(), CameraSimulator(device="cpu", cache=None)
        dark, lit = (PreparedScene(light, base, camera, clean) for light in lights[:2])
        kind: Any = "sensor" if rows else "exact"
        parts = ((dark, states[:1]), (lit, states[1:]))
        frames = torch.cat(
            [simulator.prepare(s).expose(some, seed=seed, noise=kind) for s, some in parts]
        )
    return (frames.double() * torch.tensor(camera.span).double()[:, None, None]).numpy()


def row_variance(dark: np.ndarray) -> float:
    """Variance that a sensor row shares, of frames (4, H, W); R, G1 are one row, G2, B another."""
    rows = np.concatenate([np.concatenate(dark[pair], axis=1) for pair in ([0, 1], [2, 3])])
    alone = rows.var(axis=1, ddof=1).mean() / rows.shape[1]
    return float(rows.mean(axis=1).var(ddof=1) - alone)


def transfer(camera: CameraProfile, iso: float, path: str, rows: bool, seed: int) -> Row:
    """One photon transfer curve: its points, and what is read from them."""
    begun = perf_counter()
    first, second = (flat_fields(camera, iso, path, rows, 2 * seed + i) for i in (0, 1))
    ms = 1e3 * (perf_counter() - begun) / (2 * len(LADDER))
    green = slice(1, 3)
    mean = (first + second)[:, green].mean(axis=(1, 2, 3)) / 2
    variance = (first - second)[:, green].var(axis=(2, 3), ddof=1).mean(axis=1) / 2
    fitted = mean - mean[0] <= FITTED * (mean[variance.argmax()] - mean[0])
    x, y = (mean - mean[0])[fitted], (variance - variance[0])[fitted]
    shared = row_variance((first - second)[0] / np.sqrt(2))
    measured = {"gain": x @ y / (x @ x), "dark": np.sqrt(variance[0]), "row_variance": shared}
    return measured | {"ms": ms, "mean": mean.tolist(), "variance": variance.tolist()}


def put_in(camera: CameraProfile, iso: float, rows: bool) -> Row:
    """What the profile says of its green planes: K, dark noise and row noise."""
    nlf, span = camera.nlf(iso), camera.span[1]
    dark = span * np.mean(nlf.read[1:3]) ** 0.5
    row = camera.read_noise(iso).row * dark if rows else 0.0
    return {"gain": span * np.mean(nlf.shot[1:3]), "dark": dark, "row": row}


def measure(camera: str, repetitions: int, seed: int) -> list[Row]:
    """Rows of one camera, of every ISO, path and kind of noise."""
    body, found = get_camera(camera), []
    kinds = (False, True) if body.read_noise_by_iso else (False,)
    for iso, rows, path in product(ISOS, kinds, PATHS):
        runs = [transfer(body, iso, path, rows, seed + n) for n in range(repetitions)]
        row: Row = {"camera": camera, "iso": iso, "path": path, "row_noise": rows}
        row["put_in"] = put_in(body, iso, rows)
        row["ms_per_frame"] = np.median([run["ms"] for run in runs])
        for name in ("gain", "dark", "row_variance"):
            values = np.array([run[name] for run in runs])
            half = student.ppf(0.975, repetitions - 1) * values.std(ddof=1) / repetitions**0.5
            key, ends = name, values.mean() + half * np.array([0, -1, 1])
            if name == "row_variance":  # its root, negative where less than nothing was found
                key, ends = "row", np.sign(ends) * np.abs(ends) ** 0.5
            row |= {key: ends[0], f"{key}_ci95": ends[1:].tolist()}
        curves = {k: np.mean([run[k] for run in runs], axis=0) for k in ("mean", "variance")}
        found.append(row | {k: curve.tolist() for k, curve in curves.items()})
    return found


def parts(seed: int, quick: bool) -> list[Part]:
    """One part for each camera."""
    given = {"repetitions": 3 if quick else 20}
    return [
        Part(name, measure, {"camera": name, **given, "seed": 1000 * (100 * seed + n)}, 1)
        for n, name in enumerate(list_cameras())
    ]


def curves(rows: list[Row]) -> Figure:
    """Variance over mean, measured and put in: a panel for each camera."""
    names = list(dict.fromkeys(row["camera"] for row in rows))
    figure = Figure(figsize=(10, 6), layout="constrained")
    for name, axis in zip(names, figure.subplots(2, 3, sharex=True).flat, strict=True):
        for row in (r for r in rows if r["camera"] == name):
            colour = f"C{ISOS.index(row['iso'])}"
            mean, given = np.array(row["mean"][1:]), row["put_in"]
            marker = "o" if row["path"] == PATHS[0] else "x"
            axis.plot(mean, row["variance"][1:], marker, color=colour, ms=4, fillstyle="none")
            if row["path"] == PATHS[0]:
                line = given["dark"] ** 2 + given["gain"] * mean
                axis.plot(mean, line, color=colour, lw=0.8, label=f"ISO {row['iso']:g}")
        axis.set(title=name, yscale="log", xlabel="mean [DN]", ylabel="variance [DN²]")
        axis.set_ylim(bottom=30)  # below it only saturated steps
    axis.legend(loc="lower center")
    return figure


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    """The report, of the results by camera."""
    rows: list[Row] = [row for own in results.values() for row in own]
    known = {row["camera"] for row in rows if row["row_noise"]}
    shown = [row for row in rows if row["row_noise"] == (row["camera"] in known)]
    coverage = [_coverage(rows, *case) for case in product(PATHS, (True, False))]
    tables = {"coverage": table(coverage, COVERAGE)}
    for key in QUANTITIES:
        own = [row for row in shown if key != "row" or row["camera"] in known]
        true = {"path": "put in", f"{key}_ci95": None}
        given = [row | true | {key: row["put_in"][key]} for row in own]
        tables[key] = _table(given + own, key)
    meta = {"fitted": FITTED, "size": SIZE}
    return Report(rows, tables, meta=meta, figures={"ptc.png": curves(shown)})


def _table(rows: list[Row], key: str) -> str:
    def value(row: Row) -> str:
        ends = row[f"{key}_ci95"]
        return f"{row[key]:.4g}" + (f" ({ends[0]:.4g} to {ends[1]:.4g})" if ends else "")

    return pivot(
        rows, line=("camera", "{camera}, ISO {iso:g}"), columns="{path}", contents={"": value}
    )


def _coverage(rows: list[Row], path: str, rows_on: bool) -> Row:
    own = [row for row in rows if (row["path"], row["row_noise"]) == (path, rows_on)]
    held = {
        key: sum(low <= r["put_in"][key] <= high for r in own for low, high in [r[f"{key}_ci95"]])
        for key in QUANTITIES
    }
    held |= {"all": len(own), "ms": np.median([row["ms_per_frame"] for row in own])}
    return {"case": f"{path}, row noise {'on' if rows_on else 'off'}", **held}


BENCHMARK = Benchmark(
    name="ptc",
    title="Photon transfer curves of the simulated cameras",
    parts=parts,
    report=report,
    code=("simulator", "benchmarks/ptc"),
)
run = BENCHMARK.run
