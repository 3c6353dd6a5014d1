"""The one figure of an evaluation: normalised scores with their intervals."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from simulator.utils.files import write_atomically

#: Okabe and Ito's colour-blind-safe palette, and a shape for print without colour.
_STYLE = {
    "all": ("#000000", "o"),
    "hard": ("#D55E00", "v"),
    "rest": ("#0072B2", "^"),
    "all conditions": ("#009E73", "s"),
}
_OFFSET = {"all": 0.0, "hard": 0.2, "rest": -0.2, "all conditions": 0.38}


def plot_scores(
    path: str | os.PathLike[str], rows: Sequence[Mapping[str, Any]], title: str = ""
) -> Path:
    """Draw the normalised score of each policy, a mark per condition, and write it as PNG.

    Args:
        path: File to write.
        rows: As `result_rows` returns them; those of other conditions are left out.
        title: Text above the figure.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    overall = {r["policy"]: r["normalised_score"] for r in rows if r["condition"] == "all"}
    names = sorted((n for n in overall if n != "oracle"), key=lambda n: overall[n])
    figure = Figure(figsize=(7.5, 1.6 + 0.42 * len(names)), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    conditions = [c for c in _STYLE if any(r["condition"] == c for r in rows)]
    for condition in conditions:
        colour, marker = _STYLE[condition]
        own = {r["policy"]: r for r in rows if r["condition"] == condition}
        offset = _OFFSET[condition] if len(conditions) > 1 else 0.0
        groups = next(iter(own.values()))["num_groups"]
        for i, name in enumerate(names):
            if name in own and own[name]["ci95"] is not None:
                axes.plot(own[name]["ci95"], [i + offset] * 2, color=colour, lw=1.6, alpha=0.6)
        axes.plot(
            [own[name]["normalised_score"] for name in names if name in own],
            [i + offset for i, name in enumerate(names) if name in own],
            color=colour,
            marker=marker,
            linestyle="none",
            markersize=6,
            label=f"{condition} ({groups} groups)",
        )
    axes.axvline(1.0, color="0.35", lw=1.0)
    axes.text(1.01, 0.02, "oracle", rotation=90, transform=axes.get_xaxis_transform())
    axes.axvline(0.0, color="0.75", lw=1.0, ls=":")
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(-0.6, len(names) - 0.4)
    axes.set_xlabel("normalised score (random 0, oracle 1); bars: 95 % interval")
    axes.grid(axis="x", color="0.92")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    columns = 2 if len(conditions) > 3 else 3
    axes.legend(loc="lower center", bbox_to_anchor=(0.4, 1.0), ncols=columns, frameon=False)
    if title:
        figure.suptitle(title, fontsize=11)
    picture = io.BytesIO()
    canvas.print_png(picture)
    return write_atomically(path, picture.getvalue())
