"""The picture of the page: growth of time and memory, and steps per second."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from benchmarks.isolated import CORES
from benchmarks.throughput.growth import MEMORY_FLOOR
from benchmarks.throughput.steps import DIGITAL_KERNEL, KERNEL, LOOKUP
from benchmarks.throughput.targets import SIZE, STEPS_PER_SECOND
from simulator.utils.files import write_atomically

_TITLES = {
    "pixels": "sensor pixels",
    "states": "states of a sweep",
    "environments": "environments",
    "scenes": "scenes",
}


def draw(path: Path, rows: list[dict[str, Any]], growth: list[dict[str, Any]]) -> Path:
    """Writes the picture as PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14.0, 11.0), dpi=110, layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=(1.2, 1.0))
    panels = upper.subplots(2, len(_TITLES), sharex="col")
    for column, (against, title) in enumerate(_TITLES.items()):
        own = [series for series in growth if series["against"] == against]
        for axis, keys in zip(
            panels[:, column], (("seconds", "preparation"), ("mib",)), strict=True
        ):
            _curves(axis, own, keys)
        panels[1, column].set_xlabel(title)
    panels[0, 0].set_ylabel("time [s]")
    panels[1, 0].set_ylabel("memory [MiB]")
    upper.suptitle("growth of cost, exponents of the upper decades; dotted: in proportion")
    _bars(lower.subplots(), rows)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return write_atomically(path, buffer.getvalue())


def _curves(axis: Any, series: list[dict[str, Any]], keys: tuple[str, ...]) -> None:
    axis.set_xscale("log")
    axis.set_yscale("log")
    lowest = []
    for own in series:
        for key in keys:
            floor = MEMORY_FLOOR / 8 if key == "mib" else 0.0  # less is chance
            points = [(p["x"], p[key]) for p in own["points"] if p.get(key, 0.0) > floor]
            if not points:
                continue
            x, y = zip(*points, strict=True)
            fit = own["exponents"].get(key)
            label = own["name"] if key != "preparation" else "preparation"
            label += "" if fit is None else f": {fit[0]:.2f} ± {fit[1]:.2f}"
            (line,) = axis.plot(x, y, "o-", ms=3.5, lw=1.3, label=label)
            guide = [y[-1] * value / x[-1] for value in x]  # in proportion to the last point
            axis.plot(x, guide, ":", color=line.get_color(), lw=1.0, alpha=0.7)
            lowest.append(min(y))
    if lowest:
        axis.set_ylim(bottom=min(lowest) / 2)
    axis.minorticks_off()
    axis.grid(alpha=0.3)
    axis.legend(fontsize=6.5)


def _bars(axis: Any, rows: list[dict[str, Any]]) -> None:
    own = [r for r in rows if r["size"] == SIZE and r["threads"] == CORES and r["case"] != LOOKUP]
    own.sort(key=lambda row: row["steps_per_second"])
    names = [f"{row['case']} ({row['num_envs']})" for row in own]
    speeds = [row["steps_per_second"] for row in own]
    kernels = {*KERNEL.values(), DIGITAL_KERNEL}
    colours = ["0.6" if row["case"] in kernels else "tab:blue" for row in own]
    axis.barh(names, speeds, color=colours)
    for row, speed in zip(own, speeds, strict=True):
        if row["case"] == KERNEL["bank"]:
            axis.axvline(speed, color="0.4", ls="--", lw=1.2, label="fused kernel, noise bank")
    axis.axvline(STEPS_PER_SECOND, color="tab:red", ls="--", lw=1.2, label="target")
    axis.set_xscale("log")
    axis.set_xlim(left=min(speeds) / 2)
    axis.set_xlabel(
        f"steps per second, {SIZE} x {SIZE}, {CORES} threads (environments in brackets)"
    )
    axis.tick_params(axis="y", labelsize=8)
    axis.grid(axis="x", alpha=0.3)
    axis.legend(fontsize=8, loc="lower right")
