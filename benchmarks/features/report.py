"""Tables, intervals and pictures of the local features."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from agents.evaluation.intervals import score_interval
from benchmarks.features import judging, training
from benchmarks.features.detector import mutual_matches
from benchmarks.features.pairs import mapped
from benchmarks.harness import Report, Row, pivot, table

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
#: Measures of a row of results, as functions of rows of pairs.
MEASURES: dict[str, Callable[[Row], float]] = {
    "repeatability": lambda row: row["repeatability"],
    **{
        f"accuracy_{k}": lambda row, k=k: row[f"accuracy_{k}"]  # type: ignore[misc]
        for k in judging.THRESHOLDS
    },
    "accuracy": lambda row: float(np.mean([row[f"accuracy_{k}"] for k in judging.THRESHOLDS])),
    "matches": lambda row: row["matches"],
    **{
        f"auc_{px}": lambda row, px=px: _area(row["corner_error"], px)  # type: ignore[misc]
        for px in judging.CORNER_ERRORS
    },
}
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


def _area(error: float | None, threshold: float) -> float:
    found = np.inf if error is None else error
    return float(judging.area_under(np.array(found), threshold))


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    """Means, differences with intervals, times."""
    times = {row["arm"]: row for row in results["time"]}
    runs = [run for name, found in results.items() if name != "time" for run in found]
    arms = [arm for arm in LABELS if any(run["arm"] == arm for run in runs)]
    costs = [_cost(arm, runs, times.get(arm, {})) for arm in arms]
    gaps = sorted({row["gap"] for run in runs for row in run["test"]})
    isos = sorted({row["iso"] for run in runs for row in run["test"]})
    means = [_mean(arm, runs, (gap,), isos) for gap in gaps for arm in arms]
    by_iso = [_mean(arm, runs, _large(gaps), [iso]) for iso in isos for arm in arms]
    differences = [
        _difference(pair, measure, runs, chosen, meta["seed"])
        for pair in COMPARED
        for chosen in [*((gap,) for gap in gaps), _large(gaps)]
        for measure in JUDGED
    ]
    groups = len({row["group"] for row in runs[0]["test"]})
    page = [
        _words(runs, groups),
        "## What the augmentations cost",
        table(costs, _cost_columns()),
        "Milliseconds for one picture on one thread, and seconds of the second stage of the "
        "training on one thread, on a machine that others used meanwhile.",
        "## Across the exposure gap",
        "![accuracy against the gap, and matches of one pair](features.webp)",
        *_by_gap(means),
        "## By ISO, gaps of 4 EV and more",
        *_by_iso(by_iso),
        "## Differences",
        f"With 95 % intervals (bootstrap over {groups} source groups and, crossed with them, the "
        "training seeds; both paired, as trainings of one seed share their first weights and "
        "crops); in bold where the interval leaves out zero.",
        *_differences(differences),
    ]
    rows = [*costs, *means, *by_iso, *differences]
    return Report(rows, page, figures={"features.webp": picture(means, runs, meta)})


def _large(gaps: Iterable[float]) -> tuple[float, ...]:
    return tuple(gap for gap in gaps if gap >= 4.0)


def _words(runs: list[dict[str, Any]], groups: int) -> str:
    seeds = len({run["seed"] for run in runs if run["arm"] == "none"})
    count = sum(p.numel() for p in training.Detector().parameters())
    low, high = training.STOPS
    steps = next(run["steps"] for run in runs if run["steps"])
    return (
        f"A detector and descriptor with {count:,} parameters (after SuperPoint, cells of 4 "
        f"pixels), trained from random weights on homographic pairs of {training.SIZE}-pixel crops "
        "of photographs and radiance maps: corners of the unchanged picture are the labels of the "
        "scores, InfoNCE trains the descriptors. Each seed is trained without augmentation first; "
        "these weights go on under each of the augmentations, for as many steps again. Every "
        f"picture is brought to the same mean and contrast, and {training.AUGMENTED:.0%} of the "
        "crops are augmented, the same ones in every row (of 15, 30 and 50%, the share with which "
        "plain scaling and ours in full, taken together, matched the validation scenes best). Only "
        "what is done to them differs: "
        f"nothing; gamma in [1/3, 3] and contrast in [0.5, 1.5]; linear light times 2 to "
        f"the power of {low:g} to {high:g}, clipped; `simulator.augment` with the same range of "
        f"exposures alone, and in full (ISO 100 to 12800, a little defocus and "
        f"motion). Same crops, twice {steps} steps of {training.BATCH} pairs, {seeds} seeds.\n\n"
        f"Judged on {groups} source groups that no training saw (photographs, maps, raws), each "
        f"photographed twice by the reference camera ({training.CAMERA}, Poisson noise, a mosaic, "
        "a body with hidden errors, a hand that shakes by half a pixel at the metered exposure), "
        f"{judging.SIZE} pixels a side with a homography between the views. A gap lies around the "
        "metered exposure in half of the pairs, and below it in the other half; both pictures have "
        f"the same ISO. {judging.KEYPOINTS} keypoints a picture, mutual nearest neighbours, RANSAC."
    )


# -- means ----------------------------------------------------------------------------------------


def _cost(arm: str, runs: list[dict[str, Any]], times: Row) -> Row:
    own = [run for run in runs if run["arm"] == arm]
    row: Row = {"arm": arm, "part": "cost", **times}
    if own[0]["seconds"] is not None:
        row["seconds"] = float(np.median([run["seconds"] for run in own]))
        row["steps"] = own[0]["steps"]
    if "validation" in own[0]:
        rows = [row for run in own for row in run["validation"]]
        row["validation"] = float(np.mean([MEASURES["accuracy"](r) for r in rows]))
    return row


def _cost_columns() -> dict[str, Any]:
    return {
        "augmentation": _label,
        "80 x 80 [ms]": "{ms_80:.2f}",
        "512 x 512 [ms]": "{ms_512:.1f}",
        "training [s]": "{seconds:.0f}",
        "steps": "{steps}",
    }


def _label(row: Row) -> str:
    return LABELS[row["arm"]]


def _chosen(run: dict[str, Any], gaps: Iterable[float], isos: Iterable[float]) -> list[Row]:
    gaps, isos = set(gaps), set(isos)
    return [row for row in run["test"] if row["gap"] in gaps and row["iso"] in isos]


def _by_group(
    arm: str, measure: str, runs: list[dict[str, Any]], gaps: Iterable[float], isos: Iterable[float]
) -> np.ndarray:
    """(K, G) means of a measure over the pairs of each seed and source group."""
    value, seeds = MEASURES[measure], []
    for run in (run for run in runs if run["arm"] == arm):
        groups: dict[str, list[float]] = {}
        for row in _chosen(run, gaps, isos):
            groups.setdefault(row["group"], []).append(value(row))
        seeds.append([float(np.mean(groups[name])) for name in sorted(groups)])
    return np.array(seeds)


def _mean(arm: str, runs: list[dict[str, Any]], gaps: tuple[float, ...], isos: list[float]) -> Row:
    row: Row = {"arm": arm, "part": "mean", "gaps": list(gaps), "isos": list(isos)}
    for measure in MEASURES:
        values = _by_group(arm, measure, runs, gaps, isos)
        row[measure] = float(values.mean())
        row[f"{measure}_seeds"] = values.mean(axis=1).tolist()
    return row


def _by_gap(means: list[Row]) -> list[str]:
    blocks = []
    for title, content in (
        ("Repeatability (2 px)", "{repeatability:.3f}"),
        ("Matching accuracy at 1 / 3 / 5 px", _accuracies),
        ("Homography AUC at 3 / 5 / 10 px", "{auc_3:.3f} / {auc_5:.3f} / {auc_10:.3f}"),
        ("Right matches (3 px)", "{matches:.0f}"),
    ):
        shown = pivot(means, line=("augmentation", _label), columns=_gaps, contents={"": content})
        blocks += [f"### {title}", shown]
    return blocks


def _accuracies(row: Row) -> str:
    return " / ".join(f"{row[f'accuracy_{k}']:.3f}" for k in (1, 3, 5))


def _by_iso(means: list[Row]) -> list[str]:
    contents = {"accuracy": "{accuracy:.3f}", "AUC 5 px": "{auc_5:.3f}"}
    shown = pivot(
        means, line=("augmentation", _label), columns="ISO {isos[0]:g}", contents=contents
    )
    return ["Matching accuracy is the mean of those at 1 to 5 px.", shown]


# -- differences ----------------------------------------------------------------------------------


def _difference(
    pair: tuple[str, str],
    measure: str,
    runs: list[dict[str, Any]],
    gaps: tuple[float, ...],
    seed: int,
) -> Row:
    isos = {row["iso"] for row in runs[0]["test"]}
    first, second = (_by_group(arm, measure, runs, gaps, isos) for arm in pair)
    found = score_interval(first - second, np.ones(first.shape[1]), seed=seed)
    return {
        "part": "difference",
        "arm": pair[0],
        "against": pair[1],
        "gaps": list(gaps),
        "measure": measure,
        "difference": found.value,
        "interval": found.pair,
        "beyond": found.significant,
    }


def _differences(rows: list[Row]) -> list[str]:
    blocks = []
    for first, second in COMPARED:
        own = [row for row in rows if (row["arm"], row["against"]) == (first, second)]
        names = (LABELS[name].replace("*", "") for name in (first, second))
        shown = pivot(own, line=("measure", _measure), columns=_gaps, contents={"": _interval})
        blocks += ["### " + " against ".join(names), shown]
    return blocks


def _gaps(row: Row) -> str:
    return " and ".join(f"{gap:g}" for gap in row["gaps"]) + " EV"


def _measure(row: Row) -> str:
    return JUDGED[row["measure"]]


def _interval(row: Row) -> str:
    value = f"{row['difference']:+.3f}"
    if row["interval"] is None:
        return value
    low, high = row["interval"]
    text = f"{value} [{low:+.3f}, {high:+.3f}]"
    return f"**{text}**" if row["beyond"] else text


# -- picture --------------------------------------------------------------------------------------


def picture(means: list[Row], runs: list[dict[str, Any]], meta: dict[str, Any]) -> Figure:
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
