"""Real cameras with counted photons (EMVA 1288), and the simulator as each of them.

A folder holds a ``.npz`` for each camera, see `simulator.camera_files.read_flat_fields`. The
quantities are those of EMVA 1288 (release 4.0, linear model); intervals are Student's over 16 parts
of the frames. A simulated camera is made of gain, responsivity, dark signal, dark noise, PRNU and
dark current. The package `emva1288` (LGPL) stands beside them where it is installed.
"""

import math
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import t as student

from benchmarks.harness import Part, Report, Row, benchmark, panels, real_files, sections, table
from simulator import CameraProfile, CameraSettings, CameraSimulator, get_camera
from simulator.camera_files import FITTED, FlatFields, pair_moments, read_flat_fields
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
    "PRNU1288": ("PRNU [%]", "{:.2f}", 0.43),
    "u_I_mean": ("dark current [e-/s]", "{:.4g}", 28.0),
}
KINDS = ("real", "simulated")
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


def estimate(stack: FlatFields) -> Row:
    (mean, variance), (dark, _) = pair_moments(stack.bright), pair_moments(stack.dark)
    full, signal, photons, gain = variance.argmax(), mean - dark, stack.photons, stack.gain()
    fit = signal <= FITTED * signal[full]
    response = photons[fit] @ signal[fit] / (photons[fit] @ photons[fit])
    judged = (signal >= 0.05 * signal[full]) & (signal <= 0.95 * signal[full])
    x, y = photons[judged], signal[judged]
    errors = 100 * (y / np.polyval(np.polyfit(x, y, 1, w=1 / y), x) - 1)
    noise, most = stack.dark_variance, photons[full]
    electrons = (noise - 1 / 12) ** 0.5 / gain, most, most * response / gain
    values = gain, 100 * response / gain, noise**0.5, *electrons, errors.min(), errors.max()
    pixels = 100 * stack.prnu, stack.dark_current[0]
    return dict(zip(QUANTITIES, map(float, values + pixels), strict=True))


def simulated(camera: CameraProfile, stack: FlatFields, response: float, seed: int) -> FlatFields:
    """The same exposures by the transition engine; `response` is in DN per photon."""
    size, base = [n // 2 for n in stack.bright.shape[2:]], CameraSettings(100, 1 / 64, 4)
    simulator, clean = CameraSimulator(device="cpu", cache=None), NoiseLevelFunction.zero()
    found, rng = [], np.random.default_rng(seed)
    each = response * stack.photons / camera.span[0], np.maximum(stack.times, 1) * 1e-9
    for light in (torch.ones(4, *size), torch.zeros(4, *size)):
        scene = simulator.prepare(PreparedScene(light, base, camera, clean))
        for signal, time in np.repeat(np.stack([*each], axis=1), 2, axis=0):
            state, gain = replace(base, exposure_time=time), base.exposure_time / time * signal
            frame = scene.expose([state], seed=int(rng.integers(2**31)), gain=np.array([gain]))
            found.append(np.rint(frame.double().numpy() * camera.span[0] + camera.black_level[0]))
    frames = np.reshape(found, (2, *stack.bright.shape))
    return stack._replace(bright=frames[0], dark=frames[1])


def by_package(stack: FlatFields) -> Row:
    vars(np).setdefault("asfarray", partial(np.asarray, dtype=float))  # it was written for NumPy 1
    try:
        from emva1288.process import Data1288, Results1288, routines
    except ImportError:
        return {}
    spatial, temporal = {}, {}
    for bright, dark, light, time in zip(*stack, strict=True):
        pair = {p: routines.get_int_imgs(list(f)) for p, f in ((light, bright), (0.0, dark))}
        spatial[time] = pair
        temporal[time] = {p: {k: np.sum(v) for k, v in one.items()} for p, one in pair.items()}
    middle, (height, width) = stack.times[len(spatial) // 2], stack.bright.shape[2:]
    data = {"temporal": temporal, "spatial": {middle: spatial[middle]}}
    results = Results1288(Data1288({**data, "height": height, "width": width}).data)
    return {name: float(getattr(results, name)) for name in QUANTITIES}


def measured(stack: FlatFields) -> Row:
    (mean, variance), own = pair_moments(stack.bright), estimate(stack)
    high, wide = (size // 4 for size in stack.bright.shape[2:])
    corners = [(high * i, wide * j) for i in range(4) for j in range(4)]
    cuts = [(..., slice(y, y + high), slice(x, x + wide)) for y, x in corners]
    parts = [stack._replace(bright=stack.bright[c], dark=stack.dark[c]) for c in cuts]
    half = HALF * np.std([[*estimate(part).values()] for part in parts], axis=0, ddof=1)
    step = np.diff(stack.photons).max()  # the saturation is that of a step
    half[[4, 5]] += step, step * own["QE"] / 100
    spread = HALF * np.std([pair_moments(part.bright)[1] for part in parts], axis=0, ddof=1)
    found = {"estimate": own, "package": by_package(stack), "half": half.tolist()}
    found |= {"signal": (mean - pair_moments(stack.dark)[0]).tolist()}
    return found | {"variance": variance.tolist(), "variance_half": spread.tolist()}


def measure(path: str, seed: int, quick: bool) -> Row:
    step = slice(None, None, 4 if quick else 1)
    real = FlatFields(*(values[step] for values in read_flat_fields(path)))
    camera, found = get_camera(f"emva:{path}"), estimate(real)
    made = simulated(camera, real, found["QE"] / 100 * found["K"], seed)
    row = {"camera": Path(path).stem, "real": measured(real), "simulated": measured(made)}
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
    for row, (kind, colour, marker) in product(rows, zip(KINDS, ("C0", "C1"), ".,", strict=True)):
        x, y, style = row[kind]["signal"], row[kind]["variance"], {"c": colour, "marker": marker}
        drawn.append({"panel": row["camera"], "x": x, "y": y, "label": kind, "style": style})
    figure = panels(drawn, 5.0, xlabel="signal [DN]", ylabel="temporal variance [DN²]")
    blocks = sections(rows, "{camera}", lambda own: table(quantities(own[0]), _TABLE))
    judged = [steps(row, *e) for row in rows for e in ((0.05, 0.35), (0.35, 0.7), (0.7, 0.95))]
    tables = {"quantities": blocks, "steps": table(judged, _STEPS)}
    return Report(rows, tables, figures={"emva.png": figure})


run = benchmark("emva", parts, report)
