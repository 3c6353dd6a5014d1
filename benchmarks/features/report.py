"""Means, intervals and pictures of the local features."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure

from agents.evaluation.intervals import score_interval
from benchmarks.features import judging, training
from benchmarks.harness import Report, Row, pivot, sections, table

#: Trainings under each augmentation.
SEEDS = 5
LABELS = {
    "none": "none",
    "jitter": "gamma and contrast",
    "scaling": "plain exposure scaling",
    "exposure": "ours, exposure only",
    "full": "**ours, in full**",
    "aliked": "ALIKED, given weights",
}
#: Measures of a row of results.
MEASURES = (
    "repeatability",
    *(f"accuracy_{k}" for k in judging.THRESHOLDS),
    *("accuracy", "matches"),
    *(f"auc_{px}" for px in judging.CORNER_ERRORS),
)
#: What differences are stated of.
JUDGED = {
    "repeatability": "repeatability",
    "accuracy_1": "matching accuracy, 1 px",
    "accuracy": "matching accuracy, mean of 1 to 5 px",
    "auc_5": "homography AUC, 5 px",
}
COMPARED = (
    ("full", "scaling"),
    ("full", "exposure"),
    ("exposure", "scaling"),
    ("scaling", "jitter"),
    ("scaling", "none"),
)


_COSTS = """augmentation = {label} | 80 x 80 [ms] = {ms_80:.2f} | 512 x 512 [ms] = {ms_512:.1f} |
training [s] = {seconds:.0f} | steps = {steps}"""
#: Tables by gap: their content.
_BY_GAP = {
    "repeatability": "{repeatability:.3f}",
    "accuracy": "{accuracy_1:.3f} / {accuracy_3:.3f} / {accuracy_5:.3f}",
    "auc": "{auc_3:.3f} / {auc_5:.3f} / {auc_10:.3f}",
    "matches": "{matches:.0f}",
}


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    times = {row["arm"]: row for row in results["time"]}
    runs = [run for name, found in results.items() if name != "time" for run in found]
    frame = _frame(runs, "test")
    arms = [arm for arm in LABELS if arm in set(frame["arm"])]
    gaps, isos = (sorted(set(frame[name].tolist())) for name in ("gap", "iso"))
    large = [gap for gap in gaps if gap >= 4.0]
    costs = [_cost(arm, runs, times.get(arm, {})) for arm in arms]
    means = [_mean(frame, arm, [gap], isos) for gap in gaps for arm in arms]
    by_iso = [_mean(frame, arm, large, [iso]) for iso in isos for arm in arms]
    differences = [
        _difference(frame, pair, measure, chosen, meta["seed"])
        for pair in COMPARED
        for chosen in [*([gap] for gap in gaps), large]
        for measure in JUDGED
    ]
    line = "augmentation = {label}"
    tables = {"costs": table(costs, _COSTS)}
    for name, content in _BY_GAP.items():
        tables[name] = pivot(means, line, "{at}", content)
    contents = "accuracy = {accuracy:.3f} | AUC 5 px = {auc_5:.3f}"
    tables["by-iso"] = pivot(by_iso, line, "ISO {isos[0]:g}", contents)
    tables["differences"] = sections(
        differences, "{pair}", lambda own: pivot(own, "measure = {judged}", "{at}", "{text}")
    )
    figures: dict[str | Path, Figure] = {"features.webp": picture(means, meta)}
    return Report([*costs, *means, *by_iso, *differences], tables, figures=figures)


# -- rows -----------------------------------------------------------------------------------------


def _frame(runs: list[dict[str, Any]], split: str) -> pd.DataFrame:
    frame = pd.DataFrame(
        [
            {"arm": run["arm"], "seed": run["seed"], **row}
            for run in runs
            for row in run.get(split, ())
        ]
    )
    frame["accuracy"] = frame[[f"accuracy_{k}" for k in judging.THRESHOLDS]].mean(axis=1)
    errors = frame["corner_error"].astype(float).fillna(np.inf).to_numpy()
    for px in judging.CORNER_ERRORS:
        frame[f"auc_{px}"] = judging.area_under(errors, px)
    return frame


def _cost(arm: str, runs: list[dict[str, Any]], times: Row) -> Row:
    own = [run for run in runs if run["arm"] == arm]
    row: Row = {"arm": arm, "label": LABELS[arm], "part": "cost", **times}
    if own[0]["seconds"] is not None:
        row["seconds"] = float(np.median([run["seconds"] for run in own]))
        row["steps"] = own[0]["steps"]
    if "validation" in own[0]:
        row["validation"] = float(_frame(own, "validation")["accuracy"].mean())
    return row


def _at(gaps: list[float]) -> str:
    return " and ".join(f"{gap:g}" for gap in gaps) + " EV"


def _by_group(
    frame: pd.DataFrame, arm: str, measure: str, gaps: list[float], isos: list[float] | None
) -> np.ndarray:
    """(K, G) means of a measure over the pairs of each seed and source group."""
    chosen = (frame["arm"] == arm) & frame["gap"].isin(gaps)
    if isos is not None:
        chosen &= frame["iso"].isin(isos)
    return frame[chosen].groupby(["seed", "group"])[measure].mean().unstack().to_numpy()


def _mean(frame: pd.DataFrame, arm: str, gaps: list[float], isos: list[float]) -> Row:
    row: Row = {"arm": arm, "part": "mean", "gaps": gaps, "isos": isos}
    row |= {"label": LABELS[arm], "at": _at(gaps)}
    for measure in MEASURES:
        values = _by_group(frame, arm, measure, gaps, isos)
        row |= {measure: float(values.mean()), f"{measure}_seeds": values.mean(axis=1).tolist()}
    return row


def _difference(
    frame: pd.DataFrame, pair: tuple[str, str], measure: str, gaps: list[float], seed: int
) -> Row:
    first, second = (_by_group(frame, arm, measure, gaps, None) for arm in pair)
    found = score_interval(first - second, np.ones(first.shape[1]), seed=seed)
    row: Row = {"part": "difference", "arm": pair[0], "against": pair[1], "gaps": gaps}
    row |= {"measure": measure, "difference": found.value, "interval": found.pair}
    ours, other = (LABELS[arm].replace("*", "") for arm in pair)
    row |= {"pair": f"{ours} against {other}", "at": _at(gaps), "judged": JUDGED[measure]}
    row["text"] = f"{found.value:+.3f}"
    if found.pair is not None:
        row["text"] += " [{:+.3f}, {:+.3f}]".format(*found.pair)
    mark = "**" if found.significant else ""
    return row | {"beyond": found.significant, "text": mark + row["text"] + mark}


# -- picture --------------------------------------------------------------------------------------


def picture(means: list[Row], meta: dict[str, Any]) -> Figure:
    figure = Figure(figsize=(10.0, 7.0), dpi=100, layout="constrained")
    upper, lower = figure.subfigures(2, 1)
    drawn = ("repeatability", "accuracy", "auc_5")
    for axis, measure in zip(upper.subplots(1, 3), drawn, strict=True):
        for arm in dict.fromkeys(row["arm"] for row in means):
            own = [row for row in means if row["arm"] == arm]
            gaps, seeds = (
                [r["gaps"][0] for r in own],
                np.array([r[f"{measure}_seeds"] for r in own]),
            )
            label = LABELS[arm].replace("*", "")
            (line,) = axis.plot(gaps, [row[measure] for row in own], "o-", ms=3, label=label)
            ends = seeds.min(1), seeds.max(1)
            axis.fill_between(gaps, *ends, color=line.get_color(), alpha=0.15, lw=0)
        axis.set(xlabel="exposure gap [EV]", ylim=(0.0, None))
        axis.set_title(JUDGED[measure], fontsize=9)
    axis.legend(fontsize=7)
    steps, limit = (training.QUICK_STEPS, 4) if meta["quick"] else (training.STEPS, 12)
    (condition,) = judging.conditions((4.0,), (12800.0,))[1:]
    models = {
        arm: training.train(arm, meta["seed"], steps, limit)[0] for arm in ("scaling", "full")
    }
    pairs = list(judging.held_out_pairs("test", [condition], meta["seed"], limit))
    matches = {
        arm: [
            judging.matched(*model.detect(p.pictures, judging.KEYPOINTS), p.homography)
            for p in pairs
        ]
        for arm, model in models.items()
    }
    # The pair with the median number of right matches under plain scaling.
    right = [(errors <= 3.0).sum() for *_, errors in matches["scaling"]]
    middle = int(np.argsort(right, kind="stable")[len(right) // 2])
    # Each as bright as can be seen: the detectors see them as they were taken.
    shown = [p / max(float(torch.quantile(p, 0.99)), 1e-3) for p in pairs[middle].pictures]
    both = torch.cat(shown, dim=2).clamp(0.0, 1.0).permute(1, 2, 0).numpy()
    for axis, arm in zip(lower.subplots(1, 2), models, strict=True):
        axis.imshow(both)
        a, b, errors = matches[arm][middle]
        for (x1, y1), (x2, y2), error in zip(a, b, errors, strict=True):
            colour = "lime" if error <= 3.0 else "tab:red"
            axis.plot([x1, x2 + judging.SIZE], [y1, y2], color=colour, lw=0.5, alpha=0.7)
        title = f"{LABELS[arm]}: {int((errors <= 3.0).sum())} of {len(errors)} matches right"
        where = f"(0 and -{condition.gap:g} EV, ISO {condition.iso:g})"
        axis.set_title(f"{title} {where}".replace("*", ""), fontsize=8)
        axis.axis("off")
    return figure
