"""Error against run time: every method, the plan's predictions, what is left out.

Needs the paper's networks, which are trained once where ``runs/simulator`` does not hold them.

Work against precision: every scene is photographed twice; each pair of a scene and a photograph is
a round in which all methods take their turn, in another order each time.
"""

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from torch import Tensor

from agents.report.plots import pareto_front
from benchmarks import harness
from benchmarks.fidelity.models import train_missing
from benchmarks.harness import Part, Report, Row, benchmark, clipped, psnr, sections, table
from benchmarks.isolated import CORES, ROOT, timed
from benchmarks.work_precision import plans
from benchmarks.work_precision.methods import DEFAULT, Method, all_methods
from benchmarks.work_precision.plans import GRID, SIZES, Trial, trials
from simulator import CameraProfile, CameraSettings, NoiseLevelFunction, RawImage
from simulator.noise.noise_level_function import noise_variance
from simulator.utils.files import data_folder

#: Processes among which the scenes of the plan's predictions are shared out, by split.
_SHARES = {"validation": 4, "test": 8}
#: States of each scene at which all methods are compared, by height; quick: scenes and states.
STATES, QUICK_SCENES = {128: 4, 512: 2}, {128: (2, 2), 512: (1, 1)}
#: Name of what the reference camera's own captures measure as.
REFERENCE = "reference camera"
#: Pixels whose mean is this many deviations from either clip show all of their noise.
_CLEAR = 4.0
#: Levels of the signal, each with as many pixels, and the fewest pixels of one.
_LEVELS, _FEWEST = 8, 200
#: PSNRs that differ by less are the same [dB].
_SAME_DB = 0.01


def measure(size: Sequence[int], seed: int, quick: bool) -> list[Row]:
    """One row per method."""
    height, width = size
    chosen, count, methods = trials((height, width)), STATES[height], all_methods()
    if quick:
        scenes, count = QUICK_SCENES[height]
        chosen, methods = chosen[:scenes], methods[: None if height < 512 else 9]
    records: dict[str, dict[str, list[Any]]] = defaultdict(lambda: defaultdict(list))
    small = trials((128, 128))[0]
    for method in methods:  # warm-up
        _captured(method, small.raw(seed), small.states(1), seed)
    for index, trial in enumerate(chosen):
        _one_trial(records, methods, trial, trial.states(count), seed + 1000 * index, index)
    floor, rows = float(np.median(records.pop(REFERENCE)["noise"] or np.nan)), []
    for method in methods:
        own = records[method.key]
        low, middle, high = harness.quartiles(own["ms"])
        row: Row = {"part": "precision", "method": method.name, "height": height, "width": width}
        row |= {"dtype": method.dtype, "tolerance": method.tolerance}
        row |= {"mode": "transition" if method.prepare is None else "shared"}
        row |= {"ms_per_state": middle, "ms_spread": (high - low) / 2}
        row |= {"ms_per_sweep": len(GRID) * middle, "psnr_db": float(np.mean(own["psnr"]))}
        row |= {"psnr_db_worst": min(own["psnr"]), "relative_rmse_worst": max(own["rmse"])}
        row |= {f"psnr_db_{n}_percent": float(np.percentile(own["psnr"], n)) for n in (10, 90)}
        row |= {"relative_rmse": float(np.mean(own["rmse"])), "noise_variance_floor": floor}
        row |= {"noise_variance_error": float(np.median(own["noise"] or np.nan))}
        rows.append(row | {"scenes": len(chosen), "states_per_scene": count})
    front = _front(rows)
    return [row | {"pareto": row in front} for row in rows]


def _front(rows: Sequence[Row]) -> list[Row]:
    """Rows that no other beats, the fastest first: faster and, to a hundredth of a dB, as good."""
    ms, db = ({str(i): r[k] for i, r in enumerate(rows)} for k in ("ms_per_state", "psnr_db"))
    return [rows[int(i)] for i in pareto_front(ms, db, _SAME_DB)]


def _one_trial(
    records: dict[str, dict[str, list[Any]]],
    methods: Sequence[Method],
    trial: Trial,
    states: Sequence[CameraSettings],
    seed: int,
    turn: int,
) -> None:
    means, camera = {s: trial.mean(s) for s in states}, trial.camera.camera
    captures: dict[str, list[list[Tensor]]] = {m.key: [] for m in methods}
    for photograph in range(2):
        raw = trial.raw(seed + photograph)
        first = (2 * turn + photograph) * 5 % len(methods)
        for method in (*methods[first:], *methods[:first]):
            frames, expected, times = _captured(method, raw, states, seed + photograph)
            captures[method.key].append(frames)
            records[method.key]["ms"] += times
            for image, s in zip(expected, states, strict=True):
                for name, value in mean_error(image, means[s], camera).items():
                    records[method.key][name].append(value)
    captures[REFERENCE] = [[trial.sample(s, seed + 500 + i) for s in states] for i in range(2)]
    for key, (one, other) in captures.items():
        for pair, s in zip(zip(one, other, strict=True), states, strict=True):
            ratios = noise_ratios(pair, means[s], camera.nlf(s.iso), camera)
            if ratios:
                records[key]["noise"].append(float(np.abs(np.array(ratios) - 1.0).mean()))


def _captured(
    method: Method, raw: RawImage, states: Sequence[CameraSettings], seed: int
) -> tuple[list[Tensor], list[Tensor], list[float]]:
    """Captures at `states`, the same without noise, and times per state [ms]."""
    found: list[Any] = []
    if method.prepare is not None:
        prepare = method.prepare

        def whole_sweep() -> None:
            found.append(prepare(raw))
            found.append(found[0].expose(GRID, seed=seed))

        times = [1e3 * timed(whole_sweep) / len(GRID)]
        prepared, frames = found
        images = [frames[GRID.states.index(s)] for s in states]
        return images, [prepared.expected(s) for s in states], times
    shoot = method.shoot
    assert shoot is not None
    times = [1e3 * timed(lambda s=s: found.append(shoot(raw, s, seed))) for s in states]  # type: ignore[misc]
    return [capture for capture, _ in found], [light for _, light in found], times


# -- measures -------------------------------------------------------------------------------------


def mean_error(expected: Tensor, mean: Tensor, camera: CameraProfile) -> dict[str, float]:
    """``psnr`` [dB] against white and ``rmse`` over the RMS signal, of an expected value."""
    image, truth = clipped(expected, camera).double(), mean.double()
    scale = truth.square().mean().sqrt().clamp(min=1e-12)
    rmse = float((image - truth).square().mean().sqrt() / scale)
    return {"psnr": psnr(image, truth), "rmse": rmse}


def noise_ratios(
    captures: tuple[Tensor, Tensor], mean: Tensor, nlf: NoiseLevelFunction, camera: CameraProfile
) -> list[float]:
    """Variance of the noise over the noise level function's, at every level with enough pixels.

    Of pixels that are clear of both clips.
    """
    wanted = noise_variance(mean, nlf)
    margin = _CLEAR * wanted.sqrt()
    black = torch.tensor(camera.pedestal).to(mean)[:, None, None]
    clear = (mean + margin < 1.0) & (mean - margin > -black)
    first, second = captures
    found = 0.5 * (first - second).double().square()[clear]
    wanted = wanted[clear].double()
    levels = wanted.argsort().tensor_split(_LEVELS)
    return [float(found[at].mean() / wanted[at].mean()) for at in levels if len(at) >= _FEWEST]


# -- report ---------------------------------------------------------------------------------------

#: The picture, which the README shows too; a quick run leaves it alone.
HEADLINE, QUICK = ROOT / "docs" / "images" / "work_precision.png", "work_precision.png"
#: Okabe and Ito's colour-blind-safe palette, by the beginning of a method's name.
_COLOURS = {
    "exposure+nlf": "#E69F00",
    "exposure": "#999999",
    "VST + NLM": "#CC79A7",
    "BM3D": "#AA4499",
    "large full": "#56B4E9",
    "large": "#0072B2",
    "compact": "#4477AA",
    "nano": "#88CCEE",
    "paper": "#D55E00",
}
#: Methods whose PSNR is this far below the best [dB] sit at the lower end of the README's picture.
_REACH = 6.0
_QUANTILES = {"low": 0.1, "middle": 0.5, "high": 0.9}

_PRECISION = """method = {name:md} | type = {dtype} | ms per state = {each} ± {spread} |
ms per sweep = {sweep} | PSNR [dB] = {psnr_db:.2f} |
10 to 90 % = {psnr_db_10_percent:.1f} to {psnr_db_90_percent:.1f} |
worst [dB] = {psnr_db_worst:.1f} | relative RMSE = {relative_rmse:.4f} |
worst = {relative_rmse_worst:.3f} | noise = {noise_variance_error:.1%}"""
_SCENES = """{height} x {width}: {scenes} scenes, {states_per_scene} states of each, two \
photographs; floor of the noise: {noise_variance_floor:.1%}"""
_BOUND = """tolerance = {tolerance:g} | cases = {cases} | networks = {networks} |
predicted = {predicted:.3g} | measured = {measured:.3g} |
90 % bound holds = {covered:.0%} | kept = {said:.0%} | truly = {kept:.0%}"""
_FACTORS = """scenes = {scenes} | led by = {led by} | places = {places} | cases = {cases} |
10 % = {low:.2f} | median = {middle:.2f} | 90 % = {high:.2f} | worst = {worst:.2f} |
bound holds = {covered:.1%} | of places left out = {new:.1%}"""
_LEFT_OUT = """kind = {kind} | noise reduction = {share[noise_reduction]:.0%} |
aperture = {share[aperture]:.0%} | defocus = {share[defocus]:.0%} |
motion blur = {share[motion_blur]:.0%} | noise = {share[noise]:.0%} |
ms per sweep = {ms_per_sweep:,.0f} | full [ms] = {full_ms_per_sweep:,.0f} |
times faster = {times:,.0f} | predicted error = {predicted_mean:.3f}, {predicted_largest:.3f}"""


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    rows = [r for own in results.values() for r in (own if isinstance(own, list) else [own])]
    precise, bounds, kinds = (
        [r for r in rows if r["part"] == part] for part in ("precision", "bound", "left_out")
    )
    tests, shown = [r for r in bounds if r["split"] == "test"], []
    for row in precise:
        sweep, name = row["ms_per_sweep"], row["method"]
        texts = {"each": _ms(row["ms_per_state"]), "spread": _ms(row["ms_spread"])}
        texts["sweep"] = _ms(sweep) if row["mode"] == "shared" else f"({sweep:,.0f})"
        shown.append(row | texts | {"name": f"**{name}**" if row["pareto"] else name})
    tables = {
        "precision": sections(shown, _SCENES, lambda own: table(own, _PRECISION)),
        "bound": sections(_by_tolerance(tests), "{kind}", lambda own: table(own, _BOUND)),
        "factors": table(_by_part(bounds), _FACTORS),
        "left-out": table(kinds, _LEFT_OUT),
    }
    figures: dict[Any, Figure] = {QUICK if meta["quick"] else HEADLINE: _headline(precise)}
    more = {"threads": CORES, "real_files": data_folder() is not None}
    return Report(rows, tables, meta=more, figures=figures)


def _ms(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def _by_tolerance(rows: list[Row]) -> list[Row]:
    """Predicted and measured errors of each kind of scene and tolerance."""
    frame, found = pd.DataFrame(rows), []
    frame["covered"] = frame["measured"] <= frame["bound"]
    errors = frame["errors"].map(lambda own: np.hypot(own["left out"], own["network"]))
    frame["said"] = errors <= frame["tolerance"]
    for (kind, tolerance), own in frame.groupby(["kind", "tolerance"]):
        shares = own["network"].fillna("none").value_counts(normalize=True)
        kept = own["measured"][own["said"]] <= tolerance
        row: Row = {"kind": kind, "tolerance": tolerance, "cases": len(own)}
        row["networks"] = ", ".join(f"{name} {share:.0%}" for name, share in shares.items())
        row |= {key: own[key].median() for key in ("predicted", "measured")}
        row |= {key: own[key].mean() for key in ("covered", "said")}
        found.append(row | {"kept": kept.mean() if len(kept) else None})
    return found


def _by_part(rows: list[Row]) -> list[Row]:
    """Measured error over its bound by the part that leads the predicted error."""
    frame, found = pd.DataFrame([row for row in rows if row["tolerance"] == DEFAULT]), []
    frame["led by"] = [max(own, key=own.__getitem__) for own in frame["errors"]]
    frame["share"] = frame["measured"] / frame["bound"]
    for scenes, some in {"maps": frame[frame["kind"] == "radiance"], "all": frame}.items():
        for part, own in some.groupby("led by"):
            row: Row = {"scenes": scenes, "led by": part, "cases": len(own)}
            row |= {name: own["share"].quantile(q) for name, q in _QUANTILES.items()}
            row |= {"worst": own["share"].max(), "covered": (own["share"] <= 1.0).mean()}
            found.append(row | {"places": own["place"].nunique(), "new": _of_new_places(own)})
    return found


def _of_new_places(frame: pd.DataFrame) -> float:
    """Share of the cases below the bound that conformal prediction finds on all other places."""
    held = 0
    for place, own in frame.groupby("place"):
        others = np.sort(np.append(frame["share"][frame["place"] != place], np.inf))
        held += (own["share"] <= others[int(np.ceil(0.9 * len(others))) - 1]).sum()
    return held / len(frame)


def _headline(rows: list[Row]) -> Figure:
    """Error against time at 128 x 128 in float32, the front marked."""
    figure = Figure(figsize=(8.0, 5.0), dpi=100, layout="constrained")
    axes = figure.add_subplot(xscale="log")
    own = [row for row in rows if row["height"] == 128 and row["dtype"] == "float32"]
    front = [(row["ms_per_state"], row["psnr_db"]) for row in _front(own)]
    axes.plot(*zip(*front, strict=True), color="0.75", lw=5, zorder=0)
    best = max(row["psnr_db"] for row in own)
    low = min(row["psnr_db"] for row in own if row["psnr_db"] > best - _REACH) - 0.5
    named: set[tuple[int, int]] = set()
    for row in own:
        colour = next(c for start, c in _COLOURS.items() if row["method"].startswith(start))
        x, y = row["ms_per_state"], max(row["psnr_db"], low)
        axes.plot(x, row["psnr_db"], "o" if row["mode"] == "shared" else "s", color=colour)
        at = round(4 * float(np.log10(x))), round(4 * y)
        if at in named:  # marks that nearly coincide share a name
            continue
        named.add(at)
        text = row["method"] if y > low else f"{row['method']}: {row['psnr_db']:.0f} dB"
        axes.annotate(text, (x, y), (7, 3), textcoords="offset points", color=colour)
    axes.grid(color="0.92")
    time = "time per state, 4 x 128 x 128 raw, 64-state sweep [ms]"
    error = "PSNR against the noise-free truth [dB]  (better: up)"
    axes.set(
        ylim=(low, best + 0.6),
        xlim=(None, 4 * max(row["ms_per_state"] for row in own)),
        xlabel=time,
        ylabel=error,
    )
    axes.set_title(f"Error against run time ({CORES} CPU threads, float32)", loc="left")
    marks = [axes.plot([], [], mark, color="0.4")[0] for mark in "os"]
    axes.legend(marks, ["shared by the 64 states", "per transition"], frameon=False)
    return figure


def parts(seed: int, quick: bool) -> list[Part]:
    """Parts to measure; a full run first trains the networks that are missing."""
    if not quick:
        train_missing(["paper"])
    found = [Part(f"precision {size[0]}", measure, {"size": size}) for size in SIZES]
    for split, shares in _SHARES.items():
        for share in range(1 if quick else shares):
            arguments = {"split": split, "share": share, "shares": shares}
            found.append(Part(f"bound {split} {share}", plans.bound, arguments))
    return found + [Part(kind, plans.left_out, {"kind": kind}) for kind in plans.KINDS]


run = benchmark("work-precision", parts, report)
