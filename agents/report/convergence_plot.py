"""EV error over time, a small panel per condition and a line per policy."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agents.evaluation import metrics
from agents.evaluation.result import EvaluationResult
from simulator.utils.files import write_atomically

#: Okabe and Ito's colour-blind-safe palette, each with a dash pattern for the second round.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#B8A800")
_DASHES = ("-", "--", ":", "-.")
_COLUMNS = 4


def line_style(index: int) -> dict[str, str]:
    """Colour and dashes of the policy at a place of the ranking."""
    dashes = _DASHES[index // len(PALETTE) % len(_DASHES)]
    return {"color": PALETTE[index % len(PALETTE)], "linestyle": dashes}


def plot_convergence(
    path: str | os.PathLike[str], results: Mapping[str, EvaluationResult], order: Sequence[str]
) -> Path:
    """Draw the mean EV error of every frame and write it as PNG.

    Args:
        path: File to write.
        results: By condition.
        order: Policies, the best first.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(_COLUMNS, len(results))
    rows = -(-len(results) // columns)
    figure = Figure(figsize=(3.1 * columns + 1.0, 2.1 * rows + 1.2), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    panels = figure.subplots(rows, columns, sharey=True, sharex=True, squeeze=False)
    lines: list[Any] = []
    for panel, (name, result) in zip(panels.flat, results.items(), strict=False):
        lines = []
        for i, policy in enumerate(order):
            errors = result.episode_metrics(policy)["ev_error"].mean(axis=0)  # (E, T)
            means = metrics.group_means(errors.T, result.groups)[0].mean(axis=-1)
            frames = np.arange(1, len(means) + 1)
            lines += panel.plot(frames, means, lw=1.3, **line_style(i))
        panel.set_title(name, fontsize=9)
        panel.set_yscale("symlog", linthresh=1.0, linscale=1.0)
        panel.set_yticks([0, 1, 2, 4, 8, 16], ["0", "1", "2", "4", "8", "16"], fontsize=8)
        panel.set_ylim(0, None)
        panel.xaxis.get_major_locator().set_params(integer=True)
        panel.grid(color="0.93")
        panel.spines[["top", "right"]].set_visible(False)
        panel.tick_params(labelsize=8)
    for panel in panels.flat[len(results) :]:
        panel.set_visible(False)
    for panel in panels[-1]:
        panel.set_xlabel("frame", fontsize=9)
    figure.supylabel("mean EV error [EV]", fontsize=9)
    figure.legend(
        lines, list(order), loc="outside lower center", ncols=min(5, len(order)), fontsize=8
    )
    picture = io.BytesIO()
    canvas.print_png(picture)
    return write_atomically(path, picture.getvalue())
