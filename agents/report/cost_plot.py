"""Score against time: which policy is worth its milliseconds."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from pathlib import Path

from agents.report.convergence_plot import line_style
from simulator.utils.files import write_atomically


def pareto_front(costs: Mapping[str, float], scores: Mapping[str, float]) -> list[str]:
    """Names that no other beats in both cost and score, the cheapest first.

    >>> pareto_front({"a": 1.0, "b": 2.0, "c": 3.0}, {"a": 0.5, "b": 0.4, "c": 0.9})
    ['a', 'c']
    """
    front: list[str] = []
    for name in sorted(costs, key=lambda n: (costs[n], -scores[n])):
        if not front or scores[name] > scores[front[-1]]:
            front.append(name)
    return front


def plot_cost(
    path: str | os.PathLike[str], costs: Mapping[str, float], scores: Mapping[str, float]
) -> Path:
    """Draw normalised score against the time of one decision and write it as PNG.

    Args:
        path: File to write.
        costs: Time in `act` for one camera alone by policy [ms].
        scores: Normalised score by policy, the best first.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 4.6), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    front = pareto_front(costs, scores)
    axes.step(
        [costs[n] for n in front],
        [scores[n] for n in front],
        where="post",
        color="0.6",
        lw=1.0,
        label="nothing else is both faster and better",
    )
    for i, name in enumerate(scores):
        colour = line_style(i)["color"]
        axes.plot(costs[name], scores[name], "o", color=colour, markersize=6)
        axes.annotate(
            name,
            (costs[name], scores[name]),
            xytext=(5, 3 if i % 2 else -9),
            textcoords="offset points",
            fontsize=7,
        )
    axes.set_xscale("log")
    axes.margins(x=0.18)
    axes.set_xlabel("time of a decision for one camera alone [ms]")
    axes.set_ylabel("normalised score (random 0, oracle 1)")
    axes.grid(color="0.93")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8, loc="lower right")
    picture = io.BytesIO()
    canvas.print_png(picture)
    return write_atomically(path, picture.getvalue())
