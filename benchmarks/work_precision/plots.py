"""The pictures: error against time, predicted against measured, which modules run."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from simulator.utils.files import write_atomically

Row = dict[str, Any]

#: Okabe and Ito's colour-blind-safe palette, by the beginning of a method's name.
_COLOURS = {
    "exposure+nlf": "#E69F00",
    "exposure": "#999999",
    "non-local means": "#CC79A7",
    "compact full": "#56B4E9",
    "compact": "#0072B2",
    "paper": "#D55E00",
    "pc": "#009E73",
    "dl": "#000000",
}
_MODULES = ("noise_reduction", "aperture", "defocus", "motion_blur", "noise")
_MODULE_COLOURS = ("#0072B2", "#D55E00", "#E69F00", "#009E73", "#999999")
#: Predictions and distances below this are drawn here.
_SMALLEST = 1e-4
#: Methods whose PSNR is this far below the best [dB] are off the README's picture.
_REACH = 6.0


def draw_headline(path: Path, rows: Sequence[Row]) -> Path:
    """One panel for the README: error against time at 128 x 128 in float32, the front marked."""
    figure = _figure(8.0, 5.0)
    axes = figure.add_subplot()
    own = _of(rows, 128, 128)
    own = [row for row in own if row["dtype"] == "float32"]
    _scatter(axes, own, "psnr_db", names=True)
    axes.set_ylabel("PSNR against the noise-free truth [dB]  (better: up)", fontsize=11)
    axes.set_xlabel("time per state, 4 x 128 x 128 raw, 64-state sweep [ms]", fontsize=11)
    axes.set_title("Error against run time (2 CPU threads, float32)", loc="left", fontsize=12)
    return _written(figure, path)


def draw_all(path: Path, rows: Sequence[Row]) -> Path:
    """Error against time at every size, predictions against measurements, shares of modules."""
    sizes = list(dict.fromkeys((r["height"], r["width"]) for r in rows if r["part"] == "precision"))
    figure = _figure(4.4 * len(sizes), 12.5)
    grid = figure.add_gridspec(3, len(sizes), height_ratios=(1.0, 1.0, 0.9))
    fields = {
        "psnr_db": "PSNR of the expected value [dB]",
        "capture_error": "capture error [noise of the target]",
    }
    for line, (field, label) in enumerate(fields.items()):
        for column, (height, width) in enumerate(sizes):
            axes = figure.add_subplot(grid[line, column])
            _scatter(axes, _of(rows, height, width), field, names=False)
            if field == "capture_error":
                axes.set_yscale("log")
                axes.set_xlabel("time per state [ms]")
            else:
                axes.set_title(f"{height} x {width}", loc="left")
            if column == 0:
                axes.set_ylabel(label)
            if column == len(sizes) - 1 and line == 0:
                axes.legend(fontsize=8, frameon=False, loc="best")
    half = max(1, len(sizes) // 2)
    _draw_bound(figure.add_subplot(grid[2, :half]), [r for r in rows if r["part"] == "bound"])
    _draw_left_out(figure.add_subplot(grid[2, half:]), [r for r in rows if r["part"] == "left_out"])
    return _written(figure, path)


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=100, layout="constrained")


def _written(figure: Any, path: Path) -> Path:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer)
    return write_atomically(path, buffer.getvalue())


def _of(rows: Sequence[Row], height: int, width: int) -> list[Row]:
    return [
        r for r in rows if r["part"] == "precision" and (r["height"], r["width"]) == (height, width)
    ]


def _colour(name: str) -> str:
    return next(colour for start, colour in _COLOURS.items() if name.startswith(start))


def _scatter(axes: Any, rows: Sequence[Row], field: str, *, names: bool) -> None:
    """A mark per method, filled in float32 and hollow in bfloat16, the front as a line."""
    from matplotlib.ticker import FuncFormatter

    rows = [row for row in rows if row[field]]
    front = sorted((r["ms_per_state"], r[field]) for r in rows if _is_best(r, rows, field))
    axes.plot(*zip(*front, strict=True), color="0.75", lw=5, zorder=0, solid_capstyle="round")
    shown: set[str] = set()
    for row in rows:
        colour, half = _colour(row["method"]), row["dtype"] == "bfloat16"
        family = next(start for start in _COLOURS if row["method"].startswith(start))
        axes.plot(
            row["ms_per_state"],
            row[field],
            linestyle="none",
            marker="o" if row["mode"] == "shared" else "s",
            markersize=8 if names else 6,
            color=colour,
            markerfacecolor="white" if half else colour,
            label=None if family in shown else family,
        )
        shown.add(family)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.grid(color="0.92")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    if names:
        times = [row["ms_per_state"] for row in rows]
        axes.set_xlim(min(times) / 1.5, max(times) * 6.0)
        _focus(axes, rows, field)
        _label(axes, rows, field)
        axes.plot([], [], color="0.75", lw=5, label="Pareto front")
        axes.plot([], [], "o", color="0.4", label="shared by the 64 states")
        axes.plot([], [], "s", color="0.4", label="per transition")
        handles, labels = axes.get_legend_handles_labels()
        kept = [(h, text) for h, text in zip(handles, labels, strict=True) if " " in text]
        kept = [(h, text) for h, text in kept if text not in _COLOURS]
        axes.legend(*zip(*kept, strict=True), frameon=False, fontsize=10, loc=(0.3, 0.1))


def _focus(axes: Any, rows: Sequence[Row], field: str) -> None:
    """Limits the axis to what is within `_REACH` of the best; the rest sits at its lower end."""
    best = max(row[field] for row in rows)
    near = [row[field] for row in rows if row[field] > best - _REACH]
    room = best - min(near)
    low = min(near) - 0.25 * room
    axes.set_ylim(low, best + 0.12 * room)
    for row in rows:
        if row[field] <= best - _REACH:
            axes.plot(
                row["ms_per_state"], low, "v", color=_colour(row["method"]), ms=9, clip_on=False
            )


def _is_best(row: Row, rows: Sequence[Row], field: str) -> bool:
    """Whether no other row is as fast and better, by what `field` is."""
    if field == "psnr_db":
        return bool(row["pareto"])
    return not any(
        other["ms_per_state"] <= row["ms_per_state"] and other[field] < row[field] for other in rows
    )


def _label(axes: Any, rows: Sequence[Row], field: str) -> None:
    """Names beside the marks, each where it covers neither a mark nor another name."""
    low, high = axes.get_ylim()
    left, right = np.log10(axes.get_xlim())

    def place(row: Row) -> tuple[float, float]:
        x = (np.log10(row["ms_per_state"]) - left) / (right - left)
        return float(x), float((max(row[field], low) - low) / (high - low))

    taken = [(x - 0.012, y, 0.024) for x, y in map(place, rows)]
    for name, own in _merged(rows, place).items():
        x, y = place(own[0])
        if field == "psnr_db" and own[0][field] < low:
            name += f": {own[0][field]:.0f} dB"
        width, at = 0.0112 * len(name), (x + 0.02, y)
        for shift in (0.0, 0.05, -0.05, 0.1, -0.1, 0.15, -0.15, 0.2, -0.2, 0.25, -0.25):
            at = (x + 0.02, y + shift)
            crowded = any(
                abs(at[1] - b) < 0.042 and at[0] < a + w and a < at[0] + width for a, b, w in taken
            )
            if not crowded and 0.02 < at[1] < 0.98:
                break
        taken.append((*at, width))
        axes.annotate(
            name,
            xy=(x, y),
            xycoords="axes fraction",
            xytext=at,
            textcoords="axes fraction",
            va="center",
            fontsize=10.5,
            color=_colour(own[0]["method"]),
            weight="bold" if any(row["pareto"] for row in own) else "normal",
            arrowprops=None if at[1] == y else {"arrowstyle": "-", "color": "0.75", "lw": 0.8},
        )


def _merged(
    rows: Sequence[Row], place: Callable[[Row], tuple[float, float]]
) -> dict[str, list[Row]]:
    """Rows by name; tolerances whose marks nearly coincide share one."""
    groups: list[list[Row]] = []
    for row in rows:
        near = groups and all(
            abs(a - b) < 0.04 for a, b in zip(place(groups[-1][-1]), place(row), strict=True)
        )
        alike = row["mode"] == "shared" and row["tolerance"] is not None
        if groups and alike and near and groups[-1][-1]["tolerance"] is not None:
            groups[-1].append(row)
        else:
            groups.append([row])
    named = {}
    for own in groups:
        name = own[0]["method"]
        if own[0]["tolerance"] is not None and own[0]["mode"] == "shared":
            name = "compact, tolerance " + ", ".join(f"{row['tolerance']:g}" for row in own)
        named[name] = own
    return named


def _draw_bound(axes: Any, rows: Sequence[Row]) -> None:
    """Predicted against measured difference; below the line, the bound holds."""
    tolerances = sorted({row["tolerance"] for row in rows})
    colours = ("#999999", "#56B4E9", "#0072B2", "#E69F00", "#D55E00")
    for tolerance, colour in zip(tolerances, colours, strict=False):
        own = [row for row in rows if row["tolerance"] == tolerance]
        axes.plot(
            [max(_SMALLEST, row["predicted_difference"]) for row in own],
            [max(_SMALLEST, row["measured"]) for row in own],
            ".",
            color=colour,
            label=f"tolerance {tolerance:g}",
        )
    values = [v for r in rows for v in (r["predicted_difference"], r["measured"])]
    ends = (_SMALLEST, max([1.0, *values]) * 1.5)
    axes.plot(ends, ends, color="0.5", lw=1)
    axes.set(xscale="log", yscale="log", xlim=ends, ylim=ends)
    axes.set_xlabel("predicted difference from the full run [noise of the target]")
    axes.set_ylabel("measured")
    axes.set_title("below the line the prediction bounds what was measured", loc="left")
    axes.legend(frameon=False, fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)


def _draw_left_out(axes: Any, rows: Sequence[Row]) -> None:
    """Share of the 64 states in which each module runs, by kind of scene."""
    height = 0.8 / len(_MODULES)
    for number, (module, colour) in enumerate(zip(_MODULES, _MODULE_COLOURS, strict=True)):
        places = np.arange(len(rows)) + (number - (len(_MODULES) - 1) / 2) * height
        shares = [100.0 * row["share"].get(module, 0.0) for row in rows]
        axes.barh(places, shares, height, color=colour, label=module.replace("_", " "))
    axes.set_yticks(range(len(rows)), [row["kind"] for row in rows])
    axes.invert_yaxis()
    axes.set_xlim(0, 100)
    axes.set_xlabel("states of 64 in which a module runs [%]")
    axes.set_title("what each kind of scene needs", loc="left")
    axes.legend(frameon=False, fontsize=9, ncols=5, loc="upper center", bbox_to_anchor=(0.5, -0.12))
    axes.spines[["top", "right"]].set_visible(False)
