"""The photon transfer curve of simulated cameras, measured as EMVA 1288 (release 4.0) measures it.

Measured are the green planes of pairs of flat fields at a ladder of exposure times:

- the temporal variance is half the variance of a pair's difference;
- the system gain K, digital numbers per electron: the slope, through the origin, of variance over
  mean, both less their dark values, from 0 to 70 % of saturation, where the variance is highest;
- the dark noise: the square root of the dark variance, in digital numbers, rounding included;
- the row noise: the variance of the means of sensor rows in a difference of dark frames, less the
  share that the noise of single pixels has in it. (EMVA 1288 has no temporal row noise.)
"""

from dataclasses import replace
from itertools import product
from time import perf_counter
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from scipy.stats import t as student

from benchmarks.harness import Part, Report, Row, benchmark, panels, pivot, table
from simulator import CameraProfile, CameraSettings, CameraSimulator, get_camera, list_cameras
from simulator.camera_files import FITTED
from simulator.capture.prepared_scene import PreparedScene
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.reference.reference_camera import ReferenceCamera, ReferenceScene

ISOS = (100.0, 800.0, 6400.0)
PATHS = ("reference camera", "transition engine")
SIZE = 128
#: Signals of the ladder: 21 steps to just above white, and darkness.
LADDER = (0.0, *np.linspace(0.05, 1.05, 21))
_WHITE_TIME = 1 / 64  # exposure time [s] that the ladder's 1 stands for
QUANTITIES = ("gain", "dark", "row")
_COVERAGE = """{case} | K [DN/e-] = {gain} of {all} | dark noise [DN] = {dark} of {all} |
row noise [DN] = {row} of {all} | ms a frame = {ms:.2f}"""


def flat_fields(camera: CameraProfile, iso: float, path: str, rows: bool, seed: int) -> np.ndarray:
    base = CameraSettings(iso, _WHITE_TIME, 4.0)
    states = [replace(base, exposure_time=_WHITE_TIME * max(level, 0.01)) for level in LADDER]
    dark, lit = torch.zeros(4, SIZE, SIZE), torch.ones(4, SIZE, SIZE)
    if path == "reference camera":
        body = ReferenceCamera(camera, sensor_noise=rows)
        scenes = [ReferenceScene("flat", "flat", "flat", light, base) for light in (dark, lit)]
        pairs = zip(LADDER, states, strict=True)
        frames = torch.stack([body.capture(scenes[int(x > 0)], s, seed).sample for x, s in pairs])
    else:
        clean, simulator = NoiseLevelFunction.zero(), CameraSimulator(device="cpu", cache=None)
        kind: Any = "sensor" if rows else "exact"
        shown = [
            simulator.prepare(PreparedScene(light, base, camera, clean)) for light in (dark, lit)
        ]
        steps = zip(shown, (states[:1], states[1:]), strict=True)
        frames = torch.cat([one.expose(some, seed=seed, noise=kind) for one, some in steps])
    return (frames.double() * torch.tensor(camera.span).double()[:, None, None]).numpy()


def row_variance(dark: np.ndarray) -> float:
    """Variance that a sensor row shares, of frames (4, H, W); R, G1 are one row, G2, B another."""
    rows = np.concatenate([np.concatenate(dark[pair], axis=1) for pair in ([0, 1], [2, 3])])
    alone = rows.var(axis=1, ddof=1).mean() / rows.shape[1]
    return float(rows.mean(axis=1).var(ddof=1) - alone)


def transfer(camera: CameraProfile, iso: float, path: str, rows: bool, seed: int) -> Row:
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
    nlf, span = camera.nlf(iso), camera.span[1]
    dark = span * np.mean(nlf.read[1:3]) ** 0.5
    row = camera.read_noise(iso).row * dark if rows else 0.0
    return {"gain": span * np.mean(nlf.shot[1:3]), "dark": dark, "row": row}


def measure(camera: str, repetitions: int, seed: int) -> list[Row]:
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
        for name in ("mean", "variance"):
            row[name] = np.mean([run[name] for run in runs], axis=0).tolist()
        found.append(row)
    return found


def parts(seed: int, quick: bool) -> list[Part]:
    found = []
    for n, name in enumerate(list_cameras()):
        own = {"camera": name, "seed": 1000 * (100 * seed + n)}
        found.append(Part(name, measure, {**own, "repetitions": 3 if quick else 20}, 1))
    return found


def curves(rows: list[Row]) -> Figure:
    drawn: list[Row] = []
    for row in rows:
        colour, (first, _) = f"C{ISOS.index(row['iso'])}", PATHS
        mean, given = np.array(row["mean"][1:]), row["put_in"]
        style = {"marker": "o" if row["path"] == first else "x", "ls": "", "fillstyle": "none"}
        common = {"panel": row["camera"], "x": mean, "label": "_"}
        drawn.append(common | {"y": row["variance"][1:], "style": style | {"c": colour, "ms": 4}})
        if row["path"] == first:
            line = {"y": given["dark"] ** 2 + given["gain"] * mean, "style": {"c": colour}}
            drawn.append(common | line | {"label": f"ISO {row['iso']:g}"})
    # Below a variance of 30 there are only saturated steps.
    labels: Row = {"xlabel": "mean [DN]", "ylabel": "variance [DN²]"}
    return panels(drawn, yscale="log", ylim=(30, None), **labels)


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    rows: list[Row] = [row for own in results.values() for row in own]
    known = {row["camera"] for row in rows if row["row_noise"]}
    shown = [row for row in rows if row["row_noise"] == (row["camera"] in known)]
    coverage = [_coverage(rows, *case) for case in product(PATHS, (True, False))]
    tables = {"coverage": table(coverage, _COVERAGE)}
    for key in QUANTITIES:
        own: list[Row] = []
        for row in (row for row in shown if key != "row" or row["camera"] in known):
            low, high = row[f"{key}_ci95"]
            own.append(row | {"path": "put in", "text": f"{row['put_in'][key]:.4g}"})
            own.append(row | {"text": f"{row[key]:.4g} ({low:.4g} to {high:.4g})"})
        tables[key] = pivot(own, "camera = {camera}, ISO {iso:g}", "{path}", "{text}")
    about = {"fitted": FITTED, "size": SIZE}
    return Report(rows, tables, meta=about, figures={"ptc.png": curves(shown)})


def _coverage(rows: list[Row], path: str, rows_on: bool) -> Row:
    own = [row for row in rows if (row["path"], row["row_noise"]) == (path, rows_on)]
    held: Row = {
        key: sum(low <= r["put_in"][key] <= high for r in own for low, high in [r[f"{key}_ci95"]])
        for key in QUANTITIES
    }
    held |= {"all": len(own), "ms": np.median([row["ms_per_frame"] for row in own])}
    return held | {"case": f"{path}, row noise {'on' if rows_on else 'off'}"}


run = benchmark("ptc", parts, report)
