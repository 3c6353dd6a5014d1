"""Means, intervals and pictures of the local features."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure

from agents.evaluation.intervals import score_interval
from benchmarks.features import judging, training
from benchmarks.features.detector import mutual_matches
from benchmarks.features.pairs import mapped
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
_COST_COLUMNS: dict[str, Any] = {
    "augmentation": lambda row: LABELS[row["arm"]],
    "80 x 80 [ms]": "{ms_80:.2f}",
    "512 x 512 [ms]": "{ms_512:.1f}",
    "training [s]": "{seconds:.0f}",
    "steps": "{steps}",
}
#: Tables by gap: their content.
_BY_GAP: dict[str, Any] = {
    "repeatability": "{repeatability:.3f}",
    "accuracy": "{accuracy_1:.3f} / {accuracy_3:.3f} / {accuracy_5:.3f}",
    "auc": "{auc_3:.3f} / {auc_5:.3f} / {auc_10:.3f}",
    "matches": "{matches:.0f}",
}


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    """Means, differences with intervals, times."""
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
    return Report(
        [*costs, *means, *by_iso, *differences],
        tables(costs, means, by_iso, differences),
        figures={"features.webp": picture(means, meta)},
    )


def tables(
    costs: list[Row], means: list[Row], by_iso: list[Row], differences: list[Row]
) -> dict[str, str]:
    """The tables of the page, of the four kinds of rows."""
    line: Any = "augmentation", _COST_COLUMNS["augmentation"]
    found = {"costs": table(costs, _COST_COLUMNS)}
    for name, content in _BY_GAP.items():
        found[name] = pivot(means, line=line, columns=_gaps, contents={"": content})
    contents = {"accuracy": "{accuracy:.3f}", "AUC 5 px": "{auc_5:.3f}"}
    found["by-iso"] = pivot(by_iso, line=line, columns="ISO {isos[0]:g}", contents=contents)
    line = "measure", lambda row: JUDGED[row["measure"]]
    blocks = sections(
        differences,
        lambda row: f"{LABELS[row['arm']]} against {LABELS[row['against']]}".replace("*", ""),
        lambda own: pivot(own, line=line, columns=_gaps, contents={"": _interval}),
    )
    return found | {"differences": "\n\n".join(blocks)}


def _gaps(row: Row) -> str:
    return " and ".join(f"{gap:g}" for gap in row["gaps"]) + " EV"


def _interval(row: Row) -> str:
    value = f"{row['difference']:+.3f}"
    if row["interval"] is None:
        return value
    low, high = row["interval"]
    text = f"{value} [{low:+.3f}, {high:+.3f}]"
    return f"**{text}**" if row["beyond"] else text


# -- rows -----------------------------------------------------------------------------------------


def _frame(runs: list[dict[str, Any]], split: str) -> pd.DataFrame:
    """All pairs of a split, a line for each training that they were judged with."""
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
    row: Row = {"arm": arm, "part": "cost", **times}
    if own[0]["seconds"] is not None:
        row["seconds"] = float(np.median([run["seconds"] for run in own]))
        row["steps"] = own[0]["steps"]
    if "validation" in own[0]:
        row["validation"] = float(_frame(own, "validation")["accuracy"].mean())
    return row


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
    for measure in MEASURES:
        values = _by_group(frame, arm, measure, gaps, isos)
        row[measure] = float(values.mean())
        row[f"{measure}_seeds"] = values.mean(axis=1).tolist()
    return row


def _difference(
    frame: pd.DataFrame, pair: tuple[str, str], measure: str, gaps: list[float], seed: int
) -> Row:
    first, second = (_by_group(frame, arm, measure, gaps, None) for arm in pair)
    found = score_interval(first - second, np.ones(first.shape[1]), seed=seed)
    row = {"part": "difference", "arm": pair[0], "against": pair[1], "gaps": gaps}
    row |= {"measure": measure, "difference": found.value, "interval": found.pair}
    return row | {"beyond": found.significant}


# -- picture --------------------------------------------------------------------------------------


def picture(means: list[Row], meta: dict[str, Any]) -> Figure:
    """Curves against the gap; below them matches of one hard pair, plain scaling and ours."""
    figure = Figure(figsize=(10.0, 7.0), dpi=100, layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=(1.0, 1.0))
    axes = upper.subplots(1, 3)
    for axis, (measure, title) in zip(
        axes,
        (
            ("repeatability", "repeatability (2 px)"),
            ("accuracy", "matching accuracy, mean of 1 to 5 px"),
            ("auc_5", "homography AUC, 5 px"),
        ),
        strict=True,
    ):
        for arm in dict.fromkeys(row["arm"] for row in means):
            own = [row for row in means if row["arm"] == arm]
            gaps = [row["gaps"][0] for row in own]
            (line,) = axis.plot(gaps, [row[measure] for row in own], "o-", ms=3)
            line.set_label(LABELS[arm].replace("*", ""))
            seeds = np.array([row[f"{measure}_seeds"] for row in own])
            axis.fill_between(
                gaps, seeds.min(1), seeds.max(1), color=line.get_color(), alpha=0.15, lw=0
            )
        axis.set_xlabel("exposure gap [EV]")
        axis.set_title(title, fontsize=9)
        axis.set_ylim(0.0)
    axes[0].legend(fontsize=7)
    quick = bool(meta.get("quick"))
    steps = training.QUICK_STEPS if quick else training.STEPS
    limit = 4 if quick else 12
    (condition,) = judging.conditions((4.0,), (12800.0,))[1:]
    # The pair with the median number of right matches under plain scaling, of the first twelve.
    scaled = training.train("scaling", meta["seed"], steps, limit)[0]
    pairs = list(judging.held_out_pairs("test", [condition], meta["seed"], limit))
    found = [_matches(scaled, pair) for pair in pairs]
    middle = int(np.argsort([match[2].sum() for match in found], kind="stable")[len(found) // 2])
    for axis, arm in zip(lower.subplots(1, 2), ("scaling", "full"), strict=True):
        model = training.train(arm, meta["seed"], steps, limit)[0]
        _draw(axis, pairs[middle], _matches(model, pairs[middle]), LABELS[arm].replace("*", ""))
    return figure


def _matches(
    model: training.Detector, pair: judging.HeldOutPair
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of both pictures that match, and whether each match is right."""
    first, second = model.detect(pair.pictures, judging.KEYPOINTS)
    i, j = mutual_matches(first.descriptors, second.descriptors)
    a, b = first.points[i].double().numpy(), second.points[j].double().numpy()
    return a, b, np.linalg.norm(mapped(a, pair.homography) - b, axis=1) <= 3.0


def _draw(
    axis: Any,
    pair: judging.HeldOutPair,
    matches: tuple[np.ndarray, np.ndarray, np.ndarray],
    label: str,
) -> None:
    size, (a, b, right) = judging.SIZE, matches
    # Each as bright as can be seen: the detectors see them as they were taken.
    shown = [p / max(float(torch.quantile(p, 0.99)), 1e-3) for p in pair.pictures]
    both = torch.cat(shown, dim=2).clamp(0.0, 1.0).permute(1, 2, 0)
    axis.imshow(both.numpy())
    for is_right, colour in ((False, "tab:red"), (True, "lime")):
        for (x1, y1), (x2, y2) in zip(a[right == is_right], b[right == is_right], strict=True):
            axis.plot([x1, x2 + size], [y1, y2], color=colour, lw=0.5, alpha=0.7)
    axis.set_title(
        f"{label}: {int(right.sum())} of {len(right)} matches right "
        f"(0 and -{pair.condition.gap:g} EV, ISO {pair.condition.iso:g})",
        fontsize=8,
    )
    axis.axis("off")
