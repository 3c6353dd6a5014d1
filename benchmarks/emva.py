"""Real cameras with counted photons (EMVA 1288), and the simulator as each of them.

A folder holds a ``.npz`` for each camera: ``bright`` and ``dark`` (exposures, 2, H, W) digital
numbers, ``bright_exposure_ns``, and ``bright_photons`` per pixel. The quantities are those of EMVA
1288 (release 4.0, linear model), see `benchmarks.ptc` for the gain; intervals are Student's over 16
parts of the frames. A simulated camera is made of gain, responsivity, dark signal and dark noise.
The package `emva1288` (LGPL) stands beside our estimates where it is installed.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.stats import norm
from scipy.stats import t as student

from benchmarks.harness import Part, Report, Row, benchmark, panels, real_files, table
from benchmarks.ptc import FITTED
from simulator import CameraProfile, CameraSettings, CameraSimulator
from simulator.capture.prepared_scene import PreparedScene
from simulator.noise.noise_level_function import NoiseLevelFunction

#: Quantities by their name in the package, how they are written, and the results of reference set
#: 1 (whole frames) in the package's documentation.
QUANTITIES = {
    "K": ("system gain K [DN/e-]", "{:.4f}", 0.280769),
    "QE": ("quantum efficiency [%]", "{:.2f}", 45.1356),
    "sigma_y_dark": ("dark noise [DN]", "{:.3f}", 3.07342),
    "sigma_d": ("dark noise [e-]", "{:.2f}", 10.8980),
    "u_p_sat": ("saturation [photons]", "{:.0f}", 30957.0),
    "u_e_sat": ("saturation [e-]", "{:.0f}", 13972.6),
    "LE_min": ("least linearity error [%]", "{:.2f}", -0.6158),
    "LE_max": ("greatest linearity error [%]", "{:.2f}", 0.4804),
}
KINDS = ("real", "simulated")
#: Dark variance [DN²] that the standard takes at least: rounding hides smaller ones.
LEAST = 0.24
#: Half of the 95 % interval of the mean of 16 values of standard deviation 1.
HALF = student.ppf(0.975, 15) / 4
_TABLE = """quantity = {quantity} | published = {published} | real, ours = {real} |
real, emva1288 = {real_package} | simulated, ours = {simulated} |
simulated, emva1288 = {simulated_package} | published in the interval = {known} |
simulated agrees = {agrees}"""
_STEPS = """camera = {camera} | of saturation = {part} | steps = {steps} |
signal, median [%] = {signal:.2f} | signal, largest [%] = {signal_most:.2f} |
variance, median [%] = {variance:.1f} | variance, largest [%] = {variance_most:.1f} |
variance within its noise [%] = {held:.0f}"""


class Stack(NamedTuple):
    """Pairs of frames of a camera: (exposures, 2, H, W) in DN, and the light of each exposure."""

    bright: np.ndarray
    dark: np.ndarray
    photons: np.ndarray
    times: np.ndarray


def moments(frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and temporal variance of each pair."""
    change = np.diff(frames.astype(float), axis=1)
    return frames.mean(axis=(1, 2, 3)), change.var(axis=(1, 2, 3)) / 2


def estimate(stack: Stack, dark_variance: float | None = None) -> Row:
    """The quantities; `dark_variance` [DN²] is for the gain, in place of the dark frames' own."""
    (mean, variance), (dark, noise), photons = *map(moments, stack[:2]), stack.photons
    full, signal = variance.argmax(), mean - dark
    fit = signal <= FITTED * signal[full]
    extra = variance - (noise if dark_variance is None else dark_variance)
    gain = signal[fit] @ extra[fit] / (signal[fit] @ signal[fit])
    response = photons[fit] @ signal[fit] / (photons[fit] @ photons[fit])
    floor = max(np.polyfit(stack.times, noise, 1)[1], LEAST)
    judged = (signal >= 0.05 * signal[full]) & (signal <= 0.95 * signal[full])
    x, y = photons[judged], signal[judged]
    errors = 100 * (y / np.polyval(np.polyfit(x, y, 1, w=1 / y), x) - 1)
    electrons = (floor - 1 / 12) ** 0.5 / gain, photons[full], photons[full] * response / gain
    values = gain, 100 * response / gain, floor**0.5, *electrons, errors.min(), errors.max()
    return dict(zip(QUANTITIES, map(float, values), strict=True))


def profile(name: str, stack: Stack) -> CameraProfile:
    """The camera; noise that rounding hides is that of the shares of the dark numbers."""
    dark, white = stack.dark, 2 ** int(stack.bright.max()).bit_length() - 1
    black, variance = dark.mean(), estimate(stack)["sigma_y_dark"] ** 2
    if variance <= LEAST:
        share = np.cumsum(np.bincount(dark.ravel())) / dark.size
        told = (share > 1e-3) & (share < 1 - 1e-3)
        slope, start = np.polyfit(np.flatnonzero(told) + 0.5, norm.ppf(share[told]), 1)
        # The mean of all frames shows what pixels differ by, which is no noise.
        black, variance = -start / slope, slope**-2 - dark.mean(axis=(0, 1)).var() + 1 / 12
    span, gain = white - black, estimate(stack, variance)["K"]
    nlf = {100.0: NoiseLevelFunction((gain / span,) * 4, (variance / span**2,) * 4)}
    fields: Any = {"cfa": "RGGB", "black_level": black, "white_level": white, "nlf_by_iso": nlf}
    return CameraProfile(name, bit_depth=white.bit_length(), **fields)


def simulated(camera: CameraProfile, stack: Stack, response: float, seed: int) -> Stack:
    """The same exposures by the transition engine; `response` is in DN per photon."""
    size, base = [n // 2 for n in stack.bright.shape[2:]], CameraSettings(100, 1 / 64, 4)
    simulator, clean = CameraSimulator(device="cpu", cache=None), NoiseLevelFunction.zero()
    found, rng = [], np.random.default_rng(seed)
    for level in (1.0, 0.0):
        light = torch.full((4, *size), level)
        scene = simulator.prepare(PreparedScene(light, base, camera, clean))
        for signal in np.repeat(response * stack.photons / camera.span[0], 2):
            state = [replace(base, exposure_time=max(signal, 1e-6) / 64)]
            frame = scene.expose(state, seed=int(rng.integers(2**31)), noise="exact")
            found.append(np.rint(frame.double().numpy() * camera.span[0] + camera.black_level[0]))
    frames = np.reshape(found, (2, len(stack.photons), 2, 2 * size[0], 2 * size[1]))
    return stack._replace(bright=frames[0], dark=frames[1])


def by_package(stack: Stack) -> Row:
    vars(np).setdefault("asfarray", partial(np.asarray, dtype=float))  # it was written for NumPy 1
    try:
        from emva1288.process import Data1288, Results1288, routines
    except ImportError:
        return {}
    lights, sums = [], []
    for light, bright, dark in zip(stack.photons, stack.bright, stack.dark, strict=True):
        pair = {p: routines.get_int_imgs(list(f)) for p, f in ((light, bright), (0.0, dark))}
        lights.append(pair)
        sums.append({p: {k: np.sum(v) for k, v in one.items()} for p, one in pair.items()})
    middle, (height, width) = len(lights) // 2, stack.bright.shape[2:]
    data: Row = {"temporal": dict(zip(stack.times, sums, strict=True)), "height": height}
    data |= {"spatial": {stack.times[middle]: lights[middle]}, "width": width}
    results = Results1288(Data1288(data).data)
    return {name: float(getattr(results, name)) for name in QUANTITIES}


def measured(stack: Stack) -> Row:
    found: Row = {"estimate": estimate(stack), "package": by_package(stack)}
    (*count, height, width), parts = stack.bright.shape, []
    blocks = [f.reshape(*count, 4, height // 4, 4, width // 4) for f in stack[:2]]
    for cut in ((..., i, slice(None), j, slice(None)) for i in range(4) for j in range(4)):
        parts.append(stack._replace(bright=blocks[0][cut], dark=blocks[1][cut]))
    half = HALF * np.std([[*estimate(part).values()] for part in parts], axis=0, ddof=1)
    step = np.diff(stack.photons).max()  # the saturation is that of a step
    half[[4, 5]] += step, step * found["estimate"]["QE"] / 100
    spread = HALF * np.std([moments(part.bright)[1] for part in parts], axis=0, ddof=1)
    (mean, variance), (dark, _) = map(moments, stack[:2])
    found |= {"half": half.tolist(), "signal": (mean - dark).tolist()}
    return found | {"variance": variance.tolist(), "variance_half": spread.tolist()}


def measure(path: str, seed: int, quick: bool) -> Row:
    with np.load(path) as file:
        names = ("bright", "dark", "bright_photons", "bright_exposure_ns")
        read = [file[name] for name in names]
    # Exposures for spatial measurements come after those that rise.
    rising = int(np.argmax(np.append(np.diff(read[-1]) <= 0, True))) + 1
    real = Stack(*(values[: rising : 4 if quick else 1] for values in read))
    camera, found = profile(Path(path).stem, real), estimate(real)
    made = simulated(camera, real, found["QE"] / 100 * found["K"], seed)
    row = {"camera": camera.name, "real": measured(real), "simulated": measured(made)}
    return row | {"levels": [camera.black_level[0], camera.white_level]}


def parts(seed: int, quick: bool, folder: Path | None = None) -> list[Part]:
    folder = real_files("emva1288") if folder is None else folder
    if not (files := sorted(folder.glob("*.npz"))):
        raise ValueError(f"`folder` (={str(folder)!r}) must hold .npz of cameras: there is none")
    return [Part(path.stem, measure, {"path": str(path)}, 1) for path in files]


def steps(row: Row, low: float, high: float) -> Row:
    """How far the simulated steps between two shares of the saturation are from the real ones."""
    real, made = ({k: np.array(v) for k, v in row[kind].items()} for kind in KINDS)
    share = real["signal"] / real["signal"][real["variance"].argmax()]
    own = (share >= low) & (share < high)
    noise = np.hypot(real["variance_half"], made["variance_half"])
    held = (np.abs(made["variance"] - real["variance"]) <= noise)[own]
    found = {"camera": row["camera"], "part": f"{100 * low:.0f} to {100 * high:.0f} %"}
    for key in ("signal", "variance"):
        off = 100 * np.abs(made[key][own] / real[key][own] - 1)
        found |= {key: np.median(off), f"{key}_most": off.max()}
    return found | {"steps": len(held), "held": 100 * held.mean()}


def quantities(row: Row) -> list[Row]:
    found, known = list[Row](), row["camera"] == "ccd_12bit"
    for n, (name, (title, form, published)) in enumerate(QUANTITIES.items()):
        here: Row = {"quantity": title, "published": form.format(published) if known else ""}
        ends = [(row[kind]["estimate"][name], row[kind]["half"][n]) for kind in KINDS]
        for kind, (x, half) in zip(KINDS, ends, strict=True):
            here[kind] = "{} ({} to {})".format(*map(form.format, (x, x - half, x + half)))
            package = row[kind]["package"]
            here[f"{kind}_package"] = form.format(package[name]) if package else ""
        (real, half), (made, other) = ends
        here["known"] = bool(abs(published - real) <= half) if known else ""
        found.append(here | {"agrees": bool(abs(made - real) <= math.hypot(half, other))})
    return found


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    rows, drawn = list(results.values()), list[Row]()
    for row in rows:
        gain = row["real"]["estimate"]["K"]
        for name, style in zip(KINDS, ({"c": "C0", "marker": "."}, {"c": "C1"}), strict=True):
            x, y = (np.array(row[name][k]) / gain**p for k, p in (("signal", 1), ("variance", 2)))
            drawn.append({"panel": row["camera"], "x": x, "y": y, "label": name, "style": style})
    figure = panels(drawn, 5.0, xlabel="signal [e-]", ylabel="temporal variance [e-²]")
    blocks = [f"### {row['camera']}\n\n{table(quantities(row), _TABLE)}" for row in rows]
    judged = [steps(row, *e) for row in rows for e in ((0.05, 0.35), (0.35, 0.7), (0.7, 0.95))]
    tables = {"quantities": "\n\n".join(blocks), "steps": table(judged, _STEPS)}
    return Report(rows, tables, figures={"emva.png": figure})


run = benchmark("emva", parts, report)
