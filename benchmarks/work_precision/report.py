"""The page: tables of the rows, and the pictures."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.harness import Report, Row, bullets, cell, data_root, sections, table
from benchmarks.isolated import CORES, ROOT
from benchmarks.work_precision.methods import DEFAULT

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
    "pc": "#009E73",
    "dl": "#000000",
}
_MODULES = ("noise_reduction", "aperture", "defocus", "motion_blur", "noise")
#: Methods whose PSNR is this far below the best [dB] sit at the lower end of the README's picture.
_REACH = 6.0
#: A part makes up nearly all of an error beyond this share of it; smaller errors are not sorted.
_MOST, _LEAST, _QUANTILES = 0.9, 0.02, (0.1, 0.5, 0.9)
#: Least factor that a sweep is to be faster by, and by how much its PSNR may be lower [dB].
TARGETS = {"paper, no repetition": (100.0, 0.0), "paper full": (200.0, 0.0)}


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    """The report, of the results by name of the part."""
    rows: list[Row] = []
    for own in results.values():
        rows += own if isinstance(own, list) else [own]
    precise, bounds, kinds = (
        [r for r in rows if r["part"] == part] for part in ("precision", "bound", "left_out")
    )
    tests, chosen = ([r for r in bounds if r["split"] == s] for s in ("test", "validation"))
    targets, tolerances = list(_targets(precise)), _by_tolerance(tests)
    single = [row for row in tests if row["tolerance"] == DEFAULT]
    covered = float(np.mean([row["measured"] <= row["bound"] for row in single]))
    scenes = len({row["scene"] for row in tests})
    page = [
        f"{CORES} threads. The truth is the reference camera "
        "(`simulator/reference/camera.py`), here without hidden errors of its body. "
        "Scenes are of the test split: procedural ones with and without depth, photographs and "
        "views into radiance maps; the simulator is not told their depth. Sources are at f/8, "
        "ISO 100 to 6400 and up to 2 EV less than incident light asks for, and exposed at the 64 "
        "states of the default grid.",
        "![Error against time](../images/work_precision.png)",
        "## Findings",
        bullets(
            [
                *(cell(row, _TARGET) for row in targets),
                *_fronts(precise),
                f"The plan's 90 % bound holds for {covered:.1%} of {len(single):,} transitions of "
                f"{scenes} test scenes.",
            ]
        ),
        "## Work against precision",
        "All methods get the same photographs and are compared at the same states, those within "
        "3 EV of the right exposure, evenly spread: few, because the slow methods would take hours "
        "for all 64. *Shared* methods do once per photograph what does not depend on the target; "
        "their time per state is that of the preparation and all 64 exposures, over 64. The others "
        "start from the raw for every state; their sweep, in brackets, is 64 times the median "
        "state. Nothing is cached. "
        "Methods take turns, in another order every round; ± is half the distance between "
        "quartiles.",
        "PSNR and relative RMSE are of the expected value, without noise. *Noise*: mean absolute "
        "deviation of the captures' variance from the noise level function, over 8 levels of "
        "signal, the median over scenes and states; its floor, from the finite number of pixels, "
        "is measured on the reference camera's own captures. **Bold**: on the Pareto front of time "
        "and PSNR.",
        *sections(
            precise,
            "{height} x {width}: {scenes} scenes, {states_per_scene} states of each, two "
            "photographs; floor of the noise: {noise_variance_floor:.1%}",
            lambda own: table(own, _PRECISION),
        ),
        "## Predicted and measured",
        f"`large` on {scenes} test scenes of 128 x 128, each "
        "photographed several times, at fair and at other states of the grid. Measured: the "
        "distance between the distributions of the simulated capture and of the reference "
        "camera's, given the scene, in units of the target's noise: the whole error. Pixels that "
        "are white in the scene at these settings count as equal. Median over the cases of each "
        "kind of scene, with the 95 % bootstrap interval over scenes. *Kept*: share of the cases "
        "whose plan says that the tolerance is kept, and of those the share in which the measured "
        "error is within it.",
        *sections(tolerances, "{kind}", lambda own: table(own, _BOUND)),
        "### The bound's factors",
        "What the constants of the plan were chosen on: "
        f"{len({r['scene'] for r in chosen})} scenes of the validation split, tolerance "
        f"{DEFAULT:g}. Cases in which one part makes up nearly all of the predicted error, and the "
        "measured error over the predicted.",
        table(_by_part(chosen), _FACTORS),
        "## What is left out",
        f"`compact` at 128 x 128, tolerance 0.1, {max(r['scenes'] for r in kinds)} scenes of each "
        "kind at most. Share of the 64 states in which a module runs; time of the sweep with the "
        "rest left out and shared, and of 64 full runs, of which some are timed; the predicted "
        "error, mean and largest over the states.",
        table(kinds, _LEFT_OUT),
    ]
    figures: dict[Any, Figure] = {QUICK if meta["quick"] else HEADLINE: _headline(precise)}
    more = {"threads": CORES, "real_files": data_root() is not None, "targets": targets}
    return Report(rows, page, more, figures)


# -- tables ---------------------------------------------------------------------------------------


def _ms(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def _sweep(row: Row) -> str:
    return _ms(row["ms_per_sweep"]) if row["mode"] == "shared" else f"({row['ms_per_sweep']:,.0f})"


_TARGET = (
    "Sweep with `{method}` at {height} x {width}: {ratio:,.0f} times faster than `{against}` "
    "(asked: {faster:g}), PSNR {gain_db:+.2f} dB (asked: at least -{lower:g}): {verdict}."
)
_PRECISION: dict[str, Any] = {
    "method": lambda r: f"**{r['method']}**" if r["pareto"] else r["method"],
    "type": "{dtype}",
    "ms per state": lambda r: f"{_ms(r['ms_per_state'])} ± {_ms(r['ms_spread'])}",
    "ms per sweep": _sweep,
    "PSNR [dB]": "{psnr_db:.2f}",
    "10 to 90 %": "{psnr_db_10_percent:.1f} to {psnr_db_90_percent:.1f}",
    "relative RMSE": "{relative_rmse:.4f}",
    "noise": "{noise_variance_error:.1%}",
}
_BOUND: dict[str, Any] = {
    "tolerance": "{tolerance:g}",
    "cases": "{cases}",
    "networks": "{networks}",
    "predicted": "{predicted:.3g}",
    "measured": "{measured:.3g} ({ci95[0]:.2g} to {ci95[1]:.2g})",
    "90 % bound holds": "{covered:.0%}",
    "kept": "{said:.0%}",
    "truly": "{kept:.0%}",
}
_FACTORS: dict[str, Any] = {
    "part": "{part}",
    "cases": "{cases}",
    "10 %": "{low:.2f}",
    "median": "{middle:.2f}",
    "90 %": "{high:.2f}",
    "90 % bound holds": "{covered:.0%}",
}
_LEFT_OUT: dict[str, Any] = {
    "kind": "{kind}",
    **{module.replace("_", " "): f"{{share[{module}]:.0%}}" for module in _MODULES},
    "ms per sweep": "{ms_per_sweep:,.0f}",
    "full [ms]": "{full_ms_per_sweep:,.0f}",
    "times faster": "{times:,.0f}",
    "predicted error": "{predicted_mean:.3f}, {predicted_largest:.3f}",
}


def _targets(rows: list[Row]) -> Iterator[Row]:
    """Every planned sweep in float32 against the full runs, by size."""
    rows = [row for row in rows if row["dtype"] == "float32"]
    for row, other in itertools.product(rows, rows):
        shared = row["tolerance"] == DEFAULT and row["mode"] == "shared"
        if not shared or row["height"] != other["height"] or other["method"] not in TARGETS:
            continue
        faster, lower = TARGETS[other["method"]]
        ratio = other["ms_per_sweep"] / row["ms_per_sweep"]
        gain = row["psnr_db"] - other["psnr_db"]
        target = {key: row[key] for key in ("method", "height", "width")}
        target |= {"against": other["method"], "ratio": ratio, "gain_db": gain, "faster": faster}
        met = ratio >= faster and gain >= -lower
        yield target | {"lower": lower, "verdict": "reached" if met else "missed"}


def _fronts(rows: list[Row]) -> list[str]:
    lines = []
    for height in dict.fromkeys(row["height"] for row in rows):
        front = sorted(
            (r for r in rows if r["pareto"] and r["height"] == height),
            key=lambda r: r["ms_per_state"],
        )
        named = ", ".join(cell(row, "`{method}` ({dtype})") for row in front)
        lines.append(f"Pareto front at height {height}, fastest first: {named}.")
    return lines


def _by_tolerance(rows: list[Row]) -> list[Row]:
    found = []
    for kind, tolerance in sorted({(row["kind"], row["tolerance"]) for row in rows}):
        own = [r for r in rows if (r["kind"], r["tolerance"]) == (kind, tolerance)]
        measured, bounds = (np.array([r[n] for r in own]) for n in ("measured", "bound"))
        said = [r for r in own if _avoidable(r) <= tolerance]
        counts = Counter(r["network"] or "none" for r in own)
        found.append(
            {
                "kind": kind,
                "tolerance": tolerance,
                "cases": len(own),
                "networks": ", ".join(f"{n} {c / len(own):.0%}" for n, c in counts.most_common()),
                "predicted": np.median([r["predicted"] for r in own]),
                "measured": np.median(measured),
                "ci95": _interval(own),
                "covered": np.mean(measured <= bounds),
                "said": len(said) / len(own),
                "kept": np.mean([r["measured"] <= tolerance for r in said]) if said else None,
            }
        )
    return found


def _by_part(rows: list[Row]) -> list[Row]:
    """Measured over predicted error by the part that the error is predicted from."""
    found = []
    for part in dict.fromkeys(name for row in rows for name in row["errors"]):
        own = [r for r in rows if r["errors"][part] > max(_MOST * r["predicted"], _LEAST)]
        if own:
            ratios = [r["measured"] / r["predicted"] for r in own]
            quantiles = dict(
                zip(("low", "middle", "high"), np.quantile(ratios, _QUANTILES), strict=True)
            )
            covered = np.mean([r["measured"] <= r["bound"] for r in own])
            found.append({"part": part, "cases": len(own), "covered": covered, **quantiles})
    small = [r["measured"] for r in rows if r["predicted"] <= _LEAST]
    if small:
        quantiles = dict(
            zip(("low", "middle", "high"), np.quantile(small, _QUANTILES), strict=True)
        )
        covered = np.mean([r["measured"] <= r["bound"] for r in rows if r["predicted"] <= _LEAST])
        name = f"less than {_LEAST:g} predicted: error measured"
        found.append({"part": name, "cases": len(small), "covered": covered, **quantiles})
    return found


def _avoidable(row: Row) -> float:
    return float(np.hypot(row["errors"]["left out"], row["errors"]["network"]))


def _interval(rows: list[Row]) -> list[float]:
    """95 % bootstrap interval of the median error over scenes."""
    scenes: dict[str, list[float]] = {}
    for row in rows:
        scenes.setdefault(row["scene"], []).append(row["measured"])
    groups, rng = list(scenes.values()), np.random.default_rng(0)
    medians = [
        np.median(np.concatenate([groups[i] for i in rng.integers(len(groups), size=len(groups))]))
        for _ in range(1000)
    ]
    return [float(q) for q in np.quantile(medians, [0.025, 0.975])]


# -- pictures -------------------------------------------------------------------------------------


def _headline(rows: list[Row]) -> Figure:
    """One panel for the README: error against time at 128 x 128 in float32, the front marked."""
    figure = Figure(figsize=(8.0, 5.0), dpi=100, layout="constrained")
    axes = figure.add_subplot()
    own = [row for row in rows if row["height"] == 128 and row["dtype"] == "float32"]
    _scatter(axes, own, "psnr_db")
    best = max(row["psnr_db"] for row in own)
    low = min(row["psnr_db"] for row in own if row["psnr_db"] > best - _REACH) - 0.5
    axes.set_ylim(low, best + 0.6)
    named: set[tuple[int, int]] = set()
    for row in own:
        x, y = row["ms_per_state"], max(row["psnr_db"], low)
        at = round(4 * float(np.log10(x))), round(4 * y)
        if at in named:  # marks that nearly coincide share a name
            continue
        named.add(at)
        text = row["method"] if y > low else f"{row['method']}: {row['psnr_db']:.0f} dB"
        colour, weight = _colour(row["method"]), "bold" if row["pareto"] else "normal"
        axes.annotate(text, (x, y), (7, 3), textcoords="offset points", color=colour, weight=weight)
    axes.set_ylabel("PSNR against the noise-free truth [dB]  (better: up)")
    axes.set_xlabel("time per state, 4 x 128 x 128 raw, 64-state sweep [ms]")
    axes.set_title(f"Error against run time ({CORES} CPU threads, float32)", loc="left")
    marks = [axes.plot([], [], mark, color="0.4")[0] for mark in "os"]
    axes.legend(marks, ["shared by the 64 states", "per transition"], frameon=False)
    return figure


def _colour(name: str) -> str:
    return _COLOURS[next(start for start in _COLOURS if name.startswith(start))]


def _scatter(axes: Any, rows: list[Row], field: str) -> None:
    """A mark per method, filled in float32 and hollow in bfloat16, the front as a line."""
    front = sorted((r["ms_per_state"], r[field]) for r in rows if r["pareto"])
    axes.plot(*zip(*front, strict=True), color="0.75", lw=5, zorder=0, label="Pareto front")
    shown: set[str] = set()
    for row in rows:
        colour = _colour(row["method"])
        family = next(start for start in _COLOURS if row["method"].startswith(start))
        axes.plot(
            row["ms_per_state"],
            row[field],
            "o" if row["mode"] == "shared" else "s",
            color=colour,
            markerfacecolor="white" if row["dtype"] == "bfloat16" else colour,
            label=None if family in shown else family,
        )
        shown.add(family)
    axes.set_xscale("log")
    axes.grid(color="0.92")
