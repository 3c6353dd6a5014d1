"""Stiff and extreme cases that have a curve or a figure to read: error over what is varied.

    ae-env bench stability

What can only be right or wrong (bad input, damaged files, single extreme values) is in the tests.
Each group of cases yields rows (`benchmarks.stability.case.row`); a row that is not ok is a defect.
"""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure

from benchmarks.harness import Benchmark, Part, Report, Row, bullets, cell, sections, table
from benchmarks.stability import light, loops, noise

#: Groups, in the order of the page: what measures them, and the label of what is varied.
GROUPS: dict[str, tuple[Any, str]] = {
    "exposure ratios": (light.exposures, "exposure [stops]; transitions of a chain"),
    "signals": (light.signals, "exposure [stops]"),
    "stiff light": (light.lamps, "exposure time [s]"),
    "noise level functions": (noise.level_functions, "ISO"),
    "few electrons": (noise.electrons, "electrons"),
    "noise over signal": (noise.statistics, "signal [of white]"),
    "networks": (noise.networks, "exposure [stops]"),
    "stiff control": (loops.control, "delay [frames]"),
    "long runs": (loops.long_runs, "steps"),
}


def parts(seed: int, quick: bool) -> list[Part]:
    """One part for each group."""
    arguments = {"seed": seed, "quick": quick}
    return [Part(name, measure, arguments) for name, (measure, _) in GROUPS.items()]


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    """The report, of the results by group."""
    rows = [{"group": group, **row} for group, own in results.items() for row in own]
    wrong = [cell(row, "Defect: {group}, {case}.") for row in rows if not row["ok"]]
    page = [
        "![Error over what is varied](stability.png)",
        "## Findings",
        bullets([f"{len(rows)} cases, {len(rows) - len(wrong)} of them right.", *wrong]),
        "Errors are the largest of a curve, against closed forms, exact fractions, SciPy or the "
        "same steps in float64, unless the case names another reference. Curves are in the JSON. A "
        "case that cannot be right says how the result is declared.",
        *sections(rows, "{group}", lambda own: table(own, _COLUMNS)),
    ]
    return Report(rows, page, figures={"stability.png": _draw(results)})


_COLUMNS: dict[str, Any] = {
    "case": "{case}",
    "dtype": "{dtype}",
    "largest error": "{max_error:.3g} {error}",
    "allowed": "{limit:.3g}",
    "finite": lambda row: "yes" if row["finite"] else "**no**",
    "right": lambda row: "yes" if row["ok"] else "**no**",
    "note": "{note}",
}


def _draw(results: dict[str, list[Row]]) -> Figure:
    """A panel for each group: the curves of its cases, their limits dotted."""
    columns = 3
    figure = Figure(figsize=(14.0, 4.0 * -(-len(results) // columns)), dpi=80, layout="constrained")
    panels = figure.subplots(-(-len(results) // columns), columns, squeeze=False).ravel()
    for axis, (group, rows) in zip(panels, results.items(), strict=False):
        xs: list[float] = []
        ys: list[float] = []
        for row in rows:
            x, y = row["curve"]["x"], row["curve"]["y"]
            (line,) = axis.plot(x, y, ".-", ms=3, lw=0.9, label=row["case"][:56])
            if row["limit"]:
                axis.axhline(row["limit"], color=line.get_color(), ls=":", lw=0.8)
            xs, ys = [*xs, *x], [*ys, *y]
        axis.set(title=group, xlabel=GROUPS[group][1], ylabel=rows[0]["error"])
        if min(xs) > 0 and max(xs) > 50 * min(xs):
            axis.set_xscale("log")
        largest = max(ys + [row["limit"] or 0.0 for row in rows])
        if largest > 50 * (sorted(ys)[len(ys) // 2] or largest * 1e-4):
            axis.set_yscale("symlog", linthresh=1e-4 * largest)
        axis.set_ylim(bottom=0)
        axis.grid(alpha=0.3)
        if len(rows) <= 12:
            axis.legend(fontsize=5.5)
    for axis in panels[len(results) :]:
        axis.set_axis_off()
    return figure


BENCHMARK = Benchmark(
    name="stability",
    title="Stability",
    parts=parts,
    report=report,
    code=("simulator", "ae_env", "agents", "benchmarks/stability"),
)
run = BENCHMARK.run
