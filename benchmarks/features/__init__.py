"""A small local feature trained under five augmentations, judged across exposure gaps.

Detectors are judged on pairs that the reference camera takes of held-out scenes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from scipy.spatial.distance import cdist
from torch import Tensor

from agents.evaluation.intervals import score_interval
from benchmarks.features import training
from benchmarks.features.training import (
    CAMERA,
    Features,
    Source,
    finer,
    inside,
    mapped,
    mutual_matches,
    sources,
    training_view,
    two_crops,
    warped,
)
from benchmarks.harness import Part, Report, Row, benchmark, pivot, sections, table
from benchmarks.isolated import median_seconds
from simulator import CameraSettings, develop, get_camera
from simulator.noise.generator import noise_generator
from simulator.reference.reference_camera import BodyError, ReferenceCamera, ReferenceScene
from simulator.training.scenes import Split

#: Gaps [EV] and ISOs at which every pair is taken.
GAPS, ISOS = (0.0, 2.0, 4.0, 6.0), (100.0, 1600.0, 12800.0)
#: Where the gap lies: half above and half below the metered exposure, or all below it.
AROUND, BELOW = "around", "below"
#: Side of a picture [pixel], keypoints of a picture.
SIZE, KEYPOINTS = 160, 150
#: Thresholds of matches [pixel], of repeatability, of the homography's error.
THRESHOLDS = (1, 2, 3, 4, 5)
REPEATED, CORNER_ERRORS = 2.0, (3, 5, 10)
#: Shake of the hand: motion at the metered exposure [pixel].
_SHAKE = 0.5
_RANSAC_PX = 2.0
#: Places of a picture that are looked at for corners.
_PLACES = 6

#: From pictures and how many keypoints to find to the features of each picture.
Detect = Callable[[Tensor, int], list[Features]]


class Condition(NamedTuple):
    """How a pair is taken: gap between the exposures [EV], where it lies, and ISO of both."""

    gap: float
    kind: str
    iso: float

    @property
    def exposures(self) -> tuple[float, float]:
        """Of both pictures, relative to the metered one [EV]."""
        return (0.5 * self.gap, -0.5 * self.gap) if self.kind == AROUND else (0.0, -self.gap)


@dataclass(frozen=True)
class HeldOutPair:
    """Two pictures (2, 3, SIZE, SIZE) of one scene, sRGB in [0, 1] of 8 bits.

    `homography` (3, 3) is from the first to the second, `group` the source group.
    """

    name: str
    group: str
    condition: Condition
    pictures: Tensor
    homography: np.ndarray


def conditions(gaps: tuple[float, ...] = GAPS, isos: tuple[float, ...] = ISOS) -> list[Condition]:
    """All of them; without a gap both kinds are the same."""
    return [
        Condition(gap, kind, iso)
        for gap in gaps
        for kind in ((AROUND, BELOW) if gap else (AROUND,))
        for iso in isos
    ]


def held_out_pairs(
    split: Split, taken: list[Condition], seed: int, limit: int | None = None
) -> Iterator[HeldOutPair]:
    """A pair of one picture of each held-out group, in each condition."""
    camera = get_camera(CAMERA)
    reference = ReferenceCamera(camera, body=BodyError.draw(camera, seed))
    first = {s.group: s for s in reversed(sources(split, raws=split == "test", limit=limit))}
    for number, source in enumerate(reversed(first.values())):
        rng = np.random.default_rng([seed, number, 2])
        scenes, homography = _views(source, rng)
        lights = [reference.blurred_light(scene, 5.6) for scene in scenes]
        for index, condition in enumerate(taken):
            pictures = []
            for side, exposure in enumerate(condition.exposures):
                metered = CameraSettings(condition.iso, 1.0 / 64.0, 5.6)
                settings = CameraSettings(condition.iso, 2.0**exposure / 64.0, 5.6)
                speed = _SHAKE * 64.0 / SIZE
                light = reference.expose(lights[side], metered, settings, image_speed=speed)
                generator = noise_generator(seed, number, index, side)
                pictures.append(reference.record(light, condition.iso, generator))
            shown = (develop(torch.stack(pictures)) * 255.0).round() / 255.0
            yield HeldOutPair(source.name, source.group, condition, shown, homography)


def _views(source: Source, rng: np.random.Generator) -> tuple[list[ReferenceScene], np.ndarray]:
    """Light of both views, and the homography between them.

    Of a few places, that with the most corners is taken: there is nothing to match on a flat wall.
    """
    pitch = 2 if source.light.shape[0] == 3 else 1
    height, width = (n // pitch for n in source.light.shape[1:])
    image = source.light.permute(1, 2, 0).numpy()

    def light(homography: np.ndarray) -> Tensor:
        scaled = finer(homography) if pitch == 2 else homography
        return torch.from_numpy(warped(image, scaled, pitch * SIZE)).permute(2, 0, 1).contiguous()

    places = [two_crops(rng, height, width, SIZE) for _ in range(_PLACES)]
    counts = [len(training_view(source._replace(light=light(h))).corners) for h, _ in places]
    first, second = places[int(np.argmax(counts))]
    metered = CameraSettings(100.0, 1.0 / 64.0, 5.6)
    scenes = [
        ReferenceScene(source.name, source.group, "planar", light(homography), metered)
        for homography in (first, second)
    ]
    return scenes, second @ np.linalg.inv(first)


# -- measures -------------------------------------------------------------------------------------


def judge(
    detects: dict[str, Detect], pairs: Iterator[HeldOutPair]
) -> dict[str, list[dict[str, Any]]]:
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in detects}
    for pair in pairs:
        given = {"name": pair.name, "group": pair.group, **pair.condition._asdict()}
        for name, detect in detects.items():
            first, second = detect(pair.pictures, KEYPOINTS)
            rows[name].append(given | measures(first, second, pair.homography))
    return rows


def measures(first: Features, second: Features, homography: np.ndarray) -> dict[str, float]:
    """Measures of one pair under its true homography, from the first picture to the second.

    Returns:
        ``repeatability``: share of the keypoints seen by both pictures that the other one has
        within 2 pixels, mean of both directions; ``accuracy_1`` to ``accuracy_5``: share of the
        mutual nearest neighbours within so many pixels, 0 where there are none; ``matches``: how
        many are within 3; ``corner_error``: mean error of the corners [pixel] under the estimated
        homography, infinite where there is none.
    """
    a, b, errors = matched(first, second, homography)
    result = {"matches": float((errors <= 3.0).sum())}
    for threshold in THRESHOLDS:
        result[f"accuracy_{threshold}"] = float((errors <= threshold).mean()) if len(a) else 0.0
    there, back = (f.points.double().numpy() for f in (first, second))
    ways = (there, back, homography), (back, there, np.linalg.inv(homography))
    result["repeatability"] = float(np.mean([_repeated(*way) for way in ways]))
    return result | {"corner_error": _corner_error(a, b, homography)}


def matched(
    first: Features, second: Features, homography: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of both pictures that are each other's nearest, and their errors [pixel]."""
    i, j = mutual_matches(first.descriptors, second.descriptors)
    a, b = first.points[i].double().numpy(), second.points[j].double().numpy()
    return a, b, np.linalg.norm(mapped(a, homography) - b, axis=1)


def _repeated(points: np.ndarray, found: np.ndarray, homography: np.ndarray) -> float:
    """Share of the points that the other picture sees with a keypoint nearby."""
    expected = mapped(points, homography)
    expected = expected[inside(expected, SIZE)]
    if not len(expected) or not len(found):
        return 0.0
    return float((cdist(expected, found).min(axis=1) <= REPEATED).mean())


def _corner_error(first: np.ndarray, second: np.ndarray, homography: np.ndarray) -> float:
    cv2.setRNGSeed(0)
    estimate = None
    if len(first) >= 4:
        estimate, _ = cv2.findHomography(first, second, cv2.RANSAC, _RANSAC_PX, maxIters=2000)
    if estimate is None:
        return float("inf")
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (SIZE - 1.0)
    errors = np.linalg.norm(mapped(corners, estimate) - mapped(corners, homography), axis=1)
    return float(errors.mean()) if np.isfinite(errors).all() else float("inf")


# -- ALIKED ---------------------------------------------------------------------------------------


def aliked(weights: Path) -> Detect:
    """ALIKED (Zhao et al. 2023) through kornia, with the user's file of ``aliked-n16.pth``."""
    try:
        from kornia.feature import ALIKED
    except ImportError:
        wanted = "ALIKED needs kornia: install the extra with pip install 'ae-env[features]'"
        raise ImportError(wanted) from None
    model = ALIKED("aliked-n16", max_num_keypoints=KEYPOINTS, detection_threshold=0.0)
    try:
        state = torch.load(weights, map_location="cpu", weights_only=True)
        missing, _ = model.load_state_dict(state, strict=False)
    except Exception as error:
        missing = [str(error)]
    if missing:
        raise ValueError(f"`weights` (={str(weights)!r}) must hold aliked-n16: no {missing[0]!r}")
    model.eval()

    @torch.no_grad()
    def detect(pictures: Tensor, count: int) -> list[Features]:
        return [Features(f.keypoints[:count], f.descriptors[:count]) for f in model(pictures)]

    return detect


# -- report ---------------------------------------------------------------------------------------

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
    *(f"accuracy_{k}" for k in THRESHOLDS),
    *("accuracy", "matches"),
    *(f"auc_{px}" for px in CORNER_ERRORS),
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


_COSTS = """augmentation = {label:md} | 80 x 80 [ms] = {ms_80:.2f} | 512 x 512 [ms] = {ms_512:.1f} |
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
    line = "augmentation = {label:md}"
    tables = {"costs": table(costs, _COSTS)}
    for name, content in _BY_GAP.items():
        tables[name] = pivot(means, line, "{at}", content)
    contents = "accuracy = {accuracy:.3f} | AUC 5 px = {auc_5:.3f}"
    tables["by-iso"] = pivot(by_iso, line, "ISO {isos[0]:g}", contents)
    tables["differences"] = sections(
        differences, "{pair}", lambda own: pivot(own, "measure = {judged}", "{at}", "{text:md}")
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
    frame["accuracy"] = frame[[f"accuracy_{k}" for k in THRESHOLDS]].mean(axis=1)
    errors = frame["corner_error"].astype(float).fillna(np.inf).to_numpy()
    for px in CORNER_ERRORS:
        frame[f"auc_{px}"] = np.clip(
            1.0 - errors / px, 0.0, 1.0
        )  # the mean is the area under the curve
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
    beyond = found.pair is not None and not found.pair[0] <= 0.0 <= found.pair[1]
    mark = "**" if beyond else ""
    return row | {"beyond": beyond, "text": mark + row["text"] + mark}


# -- picture --------------------------------------------------------------------------------------


def picture(means: list[Row], meta: dict[str, Any]) -> Figure:
    figure = Figure(figsize=(10.0, 7.0), dpi=100, layout="constrained")
    halves: Any = figure.subfigures(2, 1)
    upper, lower = halves
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
    (condition,) = conditions((4.0,), (12800.0,))[1:]
    models = {
        arm: training.train(arm, meta["seed"], steps, limit)[0] for arm in ("scaling", "full")
    }
    pairs = list(held_out_pairs("test", [condition], meta["seed"], limit))
    matches: dict[str, Any] = {arm: [] for arm in models}
    for pair, (arm, model) in product(pairs, models.items()):
        one, other = model.detect(pair.pictures, KEYPOINTS)
        matches[arm].append(matched(one, other, pair.homography))
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
            axis.plot([x1, x2 + SIZE], [y1, y2], color=colour, lw=0.5, alpha=0.7)
        title = f"{LABELS[arm]}: {int((errors <= 3.0).sum())} of {len(errors)} matches right"
        where = f"(0 and -{condition.gap:g} EV, ISO {condition.iso:g})"
        axis.set_title(f"{title} {where}".replace("*", ""), fontsize=8)
        axis.axis("off")
    return figure


# -- parts ----------------------------------------------------------------------------------------

#: Photographs, maps, gaps and ISOs of a quick run.
QUICK_SOURCES, QUICK_GAPS, QUICK_ISOS = 4, (0.0, 4.0), (12800.0,)
#: Sides of the pictures whose augmentation is timed [pixel].
TIMED = (80, 512)


def measure(seed: int, body: int, quick: bool) -> list[dict[str, Any]]:
    """Trains under every augmentation, and judges all on the same validation and test scenes.

    `seed` is that of the training, `body` that of the test pairs and of the body that takes them.
    """
    torch.set_num_threads(1)
    limit, steps = (QUICK_SOURCES, training.QUICK_STEPS) if quick else (None, training.STEPS)
    trained = {arm: training.train(arm, seed, steps, limit) for arm in training.AUGMENTATIONS}
    detects: dict[str, Detect] = {arm: model.detect for arm, (model, _) in trained.items()}
    rows = {split: _judged(detects, split, body, quick) for split in ("validation", "test")}
    return [
        {"arm": arm, "seed": seed, "steps": steps, "seconds": seconds}
        | {split: found[arm] for split, found in rows.items()}
        for arm, (_, seconds) in trained.items()
    ]


def _judged(detects: dict[str, Detect], split: Any, body: int, quick: bool) -> dict[str, list[Row]]:
    given: Any = () if split == "test" else ((0.0, 4.0), (1600.0,))
    taken = conditions(*((QUICK_GAPS, QUICK_ISOS) if quick else given))
    limit = QUICK_SOURCES if quick else None
    return judge(detects, held_out_pairs(split, taken, body, limit))


def measure_aliked(weights: str, body: int, quick: bool) -> list[dict[str, Any]]:
    torch.set_num_threads(1)
    rows = _judged({"aliked": aliked(Path(weights))}, "test", body, quick)["aliked"]
    return [{"arm": "aliked", "seed": 0, "steps": None, "seconds": None, "test": rows}]


def measure_time(seed: int) -> list[Row]:
    torch.set_num_threads(1)
    rows = []
    for arm, augmentation in training.AUGMENTATIONS.items():
        row: Row = {"arm": arm}
        for side in TIMED if arm != "none" else ():
            count = max(1, 2 * TIMED[0] // side) * 4
            generator = torch.Generator().manual_seed(seed)
            pictures = torch.rand(count, 3, side, side, generator=generator)
            call = partial(augmentation, pictures, list(range(count)))
            call()  # compiles
            row[f"ms_{side}"] = 1e3 * median_seconds(call, least=0.3) / count
        rows.append(row)
    return rows


def parts(seed: int, quick: bool, weights: Path | None = None) -> list[Part]:
    found, given = [Part("time", measure_time, {"seed": seed}, 1)], {"body": seed, "quick": quick}
    if weights is not None:
        if not weights.is_file():
            raise ValueError(f"`weights` (={str(weights)!r}) must be an existing file")
        aliked(weights)  # raises before any work
        arguments = {"weights": str(weights.resolve()), **given}
        found.append(Part("aliked", measure_aliked, arguments, 1))
    for number in range(seed, seed + (1 if quick else SEEDS)):
        found.append(Part(f"seed {number}", measure, {"seed": number, **given}, 1))
    return found


run = benchmark("features", parts, report)
