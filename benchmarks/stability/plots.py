"""The picture of the page: the largest error of each case beside what is allowed."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from simulator.utils.files import write_atomically

#: Errors below this are drawn at it: a logarithmic axis has no zero.
_LEAST = 1e-17


def draw(path: Path, rows: list[dict[str, Any]]) -> Path:
    """Writes the picture as PNG."""
    from matplotlib.figure import Figure

    shown = [row for row in rows if row["max_error"] is not None and row["limit"]]
    figure = Figure(figsize=(11.0, 1.5 + 0.19 * len(shown)), dpi=100, layout="constrained")
    axis = figure.subplots()
    axis.set_xscale("log")
    groups = list(dict.fromkeys(row["group"] for row in shown))
    for place, row in enumerate(shown):
        colour = f"C{groups.index(row['group']) % 10}"
        error = max(row["max_error"], _LEAST)
        axis.plot([error, row["limit"]], [place, place], lw=0.8, color=colour, alpha=0.5)
        axis.plot(error, place, "o", ms=4, color=colour if row["ok"] else "red")
        axis.plot(row["limit"], place, "|", ms=8, color="black")
    axis.set_yticks(range(len(shown)), [_label(row) for row in shown], fontsize=7)
    axis.set_ylim(len(shown), -1)
    axis.set_xlabel("largest error (dot) and what is allowed (bar), each in its own unit")
    for group in groups:
        axis.plot([], [], "o", color=f"C{groups.index(group) % 10}", label=group)
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, 1.06), ncols=5, fontsize=7)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return write_atomically(path, buffer.getvalue())


def _label(row: dict[str, Any]) -> str:
    return f"{row['case']} ({row['dtype']})" if row["dtype"] else row["case"]
