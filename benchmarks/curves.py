"""Scores of every learner of configs/learners against frames and seconds of training.

Runs of `examples/learners.py` that are not in ``runs/learners``, or are there with other frames or
settings, are trained first.
"""

import runpy
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import bootstrap, trim_mean

from benchmarks.harness import Part, Report, Row, benchmark, table
from benchmarks.isolated import ROOT

RUNS, SEEDS, KEYS = ROOT / "runs" / "learners", 5, ("frames", "cpu_seconds", "score")
STILL, MOVING = ("dqn", "qrdqn", "ppo", "a2c", "sac"), ("ppo_video", "recurrent_ppo", "drl_ae")
DRAWN = ("ppo", "dqn", "sac", "ppo_video", "drl_ae")
COLUMNS = """learner = {learner} | light = {light} | frames = {frames:,} |
CPU minutes = {minutes:.2f} | score = {iqm:.3f} | 95 % = {low:.3f} to {high:.3f} |
worst seed = {worst:.3f} | seeds = {seeds}"""


def trained(learner: str, seed: int, quick: bool) -> list[Row]:
    train = runpy.run_path(str(ROOT / "examples" / "learners.py"))["train"]
    out, found = RUNS / "quick" if quick else RUNS, []
    short: Row = {"frames": 2_048, "exam": ("bundled", "test", 8)} if quick else {}
    for s in range(seed, seed + (2 if quick else SEEDS)):
        points = train(learner, s, out=out, **short)
        columns = {key: [point[key] for point in points] for key in KEYS}
        found.append({"learner": learner, "seed": s, **columns})
    return found


def parts(seed: int, quick: bool) -> list[Part]:
    return [Part(name, trained, {"learner": name}, 1) for name in (*STILL, *MOVING)]


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    figure, shown = Figure(figsize=(9, 3.6), dpi=90, layout="constrained"), list[Row]()
    axes = figure.subplots(1, 2, sharey=True)
    for learner, own in results.items():
        light = "still" if learner in STILL else "moving"
        scores = np.array([row["score"] for row in own])  # (seeds, checkpoints)
        mean = partial(trim_mean, proportiontocut=0.25)  # of the quartiles between
        low, high = bootstrap((scores,), mean, method="percentile", rng=0).confidence_interval
        x = {k: np.mean([row[k] for row in own], axis=0) for k in KEYS}
        row: Row = {"learner": learner, "light": light, "frames": int(x["frames"][-1])}
        row |= {"minutes": x["cpu_seconds"][-1] / 60.0, "iqm": mean(scores)[-1], "low": low[-1]}
        shown.append(row | {"high": high[-1], "worst": scores[:, -1].min(), "seeds": len(own)})
        for axis, key in zip(axes, KEYS if learner in DRAWN else (), strict=False):
            axis.plot(x[key], mean(scores), label=f"{learner}, {light} light")
            axis.fill_between(x[key], low, high, alpha=0.2)
            axis.set(xlabel=key.replace("cpu_", "CPU "))
    axes[0].set(ylabel="score: 0 random, 1 oracle")
    axes[1].legend(fontsize=7)
    rows = [row for own in results.values() for row in own]
    return Report(rows, {"learners": table(shown, COLUMNS)}, figures={"curves.png": figure})


run = benchmark("curves", parts, report)
