"""The tables of the rows, and the picture."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from benchmarks.harness import Report, Row, data_root, sections, table
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
_MOST, _LEAST, _QUANTILES = 0.9, 0.02, {"low": 0.1, "middle": 0.5, "high": 0.9}
#: Least factor that a sweep is to be faster by, and by how much its PSNR may be lower [dB].
TARGETS = {"paper, no repetition": (100.0, 0.0), "paper full": (200.0, 0.0)}


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    rows: list[Row] = []
    for own in results.values():
        rows += own if isinstance(own, list) else [own]
    precise, bounds, kinds = (
        [r for r in rows if r["part"] == part] for part in ("precision", "bound", "left_out")
    )
    tests, chosen = ([r for r in bounds if r["split"] == s] for s in ("test", "validation"))
    targets = list(_targets(precise))
    tables = {
        "targets": table(targets, _TARGET),
        "precision": "\n\n".join(
            sections(
                precise,
                "{height} x {width}: {scenes} scenes, {states_per_scene} states of each, two "
                "photographs; floor of the noise: {noise_variance_floor:.1%}",
                lambda own: table(own, _PRECISION),
            )
        ),
        "bound": "\n\n".join(
            sections(_by_tolerance(tests), "{kind}", lambda own: table(own, _BOUND))
        ),
        "factors": table(_by_part(chosen), _FACTORS),
        "left-out": table(kinds, _LEFT_OUT),
    }
    figures: dict[Any, Figure] = {QUICK if meta["quick"] else HEADLINE: _headline(precise)}
    more = {"threads": CORES, "real_files": data_root() is not None, "targets": targets}
    return Report(rows, tables, meta=more, figures=figures)


# -- tables ---------------------------------------------------------------------------------------


def _ms(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def _sweep(row: Row) -> str:
    return _ms(row["ms_per_sweep"]) if row["mode"] == "shared" else f"({row['ms_per_sweep']:,.0f})"


_TARGET: dict[str, Any] = {
    "sweep with": "{method}",
    "at": "{height} x {width}",
    "against": "{against}",
    "times faster": "{ratio:,.0f}",
    "asked": "{faster:g}",
    "PSNR [dB]": "{gain_db:+.2f}",
    "asked at least": "-{lower:g}",
    "verdict": "{verdict}",
}
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


def _by_tolerance(rows: list[Row]) -> list[Row]:
    """Predicted and measured errors of each kind of scene and tolerance."""
    frame, found = pd.DataFrame(rows), []
    frame["covered"] = frame["measured"] <= frame["bound"]
    errors = frame["errors"].map(lambda own: np.hypot(own["left out"], own["network"]))
    frame["said"] = errors <= frame["tolerance"]
    for (kind, tolerance), own in frame.groupby(["kind", "tolerance"]):
        shares = own["network"].fillna("none").value_counts(normalize=True)
        kept = own["measured"][own["said"]] <= tolerance
        row = {"kind": kind, "tolerance": tolerance, "cases": len(own)}
        row["networks"] = ", ".join(f"{name} {share:.0%}" for name, share in shares.items())
        row |= own[["predicted", "measured"]].median().to_dict()
        row |= own[["covered", "said"]].mean().to_dict()
        found.append(row | {"ci95": _interval(own), "kept": kept.mean() if len(kept) else None})
    return found


def _by_part(rows: list[Row]) -> list[Row]:
    """Measured over predicted error by the part that the error is predicted from."""
    cases = {
        part: [r for r in rows if r["errors"][part] > max(_MOST * r["predicted"], _LEAST)]
        for part in rows[0]["errors"]
    }
    small = f"less than {_LEAST:g} predicted: error measured"
    cases[small] = [r for r in rows if r["predicted"] <= _LEAST]
    found = []
    for part, own in ((part, own) for part, own in cases.items() if own):
        ratios = [r["measured"] / (1.0 if part == small else r["predicted"]) for r in own]
        row: Row = {"part": part, "cases": len(own)}
        row |= {name: np.quantile(ratios, share) for name, share in _QUANTILES.items()}
        found.append(row | {"covered": np.mean([r["measured"] <= r["bound"] for r in own])})
    return found


def _interval(rows: pd.DataFrame) -> list[float]:
    """95 % bootstrap interval of the median error over scenes."""
    groups = [own.to_numpy() for _, own in rows.groupby("scene", sort=False)["measured"]]
    rng = np.random.default_rng(0)
    medians = [
        np.median(np.concatenate([groups[i] for i in rng.integers(len(groups), size=len(groups))]))
        for _ in range(1000)
    ]
    return [float(q) for q in np.quantile(medians, [0.025, 0.975])]


# -- picture --------------------------------------------------------------------------------------


def _headline(rows: list[Row]) -> Figure:
    """One panel for the README: error against time at 128 x 128 in float32, the front marked."""
    figure = Figure(figsize=(8.0, 5.0), dpi=100, layout="constrained")
    axes = figure.add_subplot(xscale="log")
    own = [row for row in rows if row["height"] == 128 and row["dtype"] == "float32"]
    front = sorted((r["ms_per_state"], r["psnr_db"]) for r in own if r["pareto"])
    axes.plot(*zip(*front, strict=True), color="0.75", lw=5, zorder=0)
    best = max(row["psnr_db"] for row in own)
    low = min(row["psnr_db"] for row in own if row["psnr_db"] > best - _REACH) - 0.5
    axes.set_ylim(low, best + 0.6)
    named: set[tuple[int, int]] = set()
    for row in own:
        colour = next(c for start, c in _COLOURS.items() if row["method"].startswith(start))
        mark = "o" if row["mode"] == "shared" else "s"
        axes.plot(row["ms_per_state"], row["psnr_db"], mark, color=colour)
        x, y = row["ms_per_state"], max(row["psnr_db"], low)
        at = round(4 * float(np.log10(x))), round(4 * y)
        if at in named:  # marks that nearly coincide share a name
            continue
        named.add(at)
        text = row["method"] if y > low else f"{row['method']}: {row['psnr_db']:.0f} dB"
        weight = "bold" if row["pareto"] else "normal"
        axes.annotate(text, (x, y), (7, 3), textcoords="offset points", color=colour, weight=weight)
    axes.grid(color="0.92")
    axes.set_ylabel("PSNR against the noise-free truth [dB]  (better: up)")
    axes.set_xlabel("time per state, 4 x 128 x 128 raw, 64-state sweep [ms]")
    axes.set_title(f"Error against run time ({CORES} CPU threads, float32)", loc="left")
    marks = [axes.plot([], [], mark, color="0.4")[0] for mark in "os"]
    axes.legend(marks, ["shared by the 64 states", "per transition"], frameon=False)
    return figure
