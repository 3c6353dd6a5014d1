"""A small local feature trained under five augmentations, judged across exposure gaps.

Detectors are judged on pairs that the reference camera takes of held-out scenes.
"""

from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import cv2
import numpy as np
import pandas as pd
import torch
from scipy.spatial.distance import cdist
from torch import Tensor

from agents.evaluation.intervals import score_interval
from benchmarks.features import training
from benchmarks.features.training import CAMERA, Features, Source, mapped
from benchmarks.harness import Part, Report, Row, benchmark, panels, pivot, sections, table
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


def conditions(gaps: tuple[float, ...] = GAPS, isos: tuple[float, ...] = ISOS) -> list[Condition]:
    """All of them; without a gap both kinds are the same."""
    every = (Condition(*own) for own in product(gaps, (AROUND, BELOW), isos))
    return [own for own in every if own.gap or own.kind == AROUND]


#: What is known of a pair, its pictures (2, 3, SIZE, SIZE), sRGB in [0, 1] of 8 bits, and the
#: homography (3, 3) from the first to the second.
HeldOutPair = tuple[Row, Tensor, np.ndarray]


def held_out_pairs(
    split: Split, taken: list[Condition], seed: int, limit: int | None = None
) -> Iterator[HeldOutPair]:
    """A pair of one picture of each held-out source group, in each condition."""
    camera = get_camera(CAMERA)
    reference = ReferenceCamera(camera, body=BodyError.draw(camera, seed))
    sources = training.sources(split, raws=split == "test", limit=limit)
    first = {source.group: source for source in reversed(sources)}
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
            head = {"name": source.name, "group": source.group, **condition._asdict()}
            yield head, shown, homography


def _views(source: Source, rng: np.random.Generator) -> tuple[list[ReferenceScene], np.ndarray]:
    """Light of both views, and the homography between them.

    Of a few places, that with the most corners is taken: there is nothing to match on a flat wall.
    """
    pitch = 2 if source.light.shape[0] == 3 else 1
    height, width = (n // pitch for n in source.light.shape[1:])
    image = source.light.permute(1, 2, 0).numpy()

    def light(homography: np.ndarray) -> Tensor:
        scaled = training.finer(homography) if pitch == 2 else homography
        seen = torch.from_numpy(training.warped(image, scaled, pitch * SIZE))
        return seen.permute(2, 0, 1).contiguous()

    places = [training.two_crops(rng, height, width, SIZE) for _ in range(_PLACES)]
    views = [training.training_view(source._replace(light=light(h))) for h, _ in places]
    first, second = places[int(np.argmax([len(view.corners) for view in views]))]
    metered = CameraSettings(100.0, 1.0 / 64.0, 5.6)
    scenes = [
        ReferenceScene(source.name, source.group, "planar", light(homography), metered)
        for homography in (first, second)
    ]
    return scenes, second @ np.linalg.inv(first)


# -- measures -------------------------------------------------------------------------------------


def judge(detects: dict[str, Detect], pairs: Iterator[HeldOutPair]) -> dict[str, list[Row]]:
    rows: dict[str, list[Row]] = {name: [] for name in detects}
    for head, pictures, homography in pairs:
        for name, detect in detects.items():
            first, second = detect(pictures, KEYPOINTS)
            rows[name].append(head | measures(first, second, homography))
    return rows


def measures(first: Features, second: Features, homography: np.ndarray) -> dict[str, float]:
    """Measures of one pair under its true homography, from the first picture to the second.

    ``repeatability``: share of the keypoints seen by both that the other one has within 2 pixels,
    mean of both ways; ``accuracy_K``: share of the mutual nearest neighbours within K pixels;
    ``matches``: how many are within 3; ``corner_error``: of the estimated homography [pixel].
    """
    descriptors = [own.descriptors.numpy() for own in (first, second)]
    matcher = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True)  # each other's nearest
    found = matcher.match(*descriptors) if all(map(len, descriptors)) else ()
    i, j = [match.queryIdx for match in found], [match.trainIdx for match in found]
    there, back = (f.points.double().numpy() for f in (first, second))
    a, b = there[i], back[j]
    errors = np.linalg.norm(mapped(a, homography) - b, axis=1)
    result = {"matches": float((errors <= 3.0).sum())}
    for threshold in THRESHOLDS:
        result[f"accuracy_{threshold}"] = float((errors <= threshold).mean()) if len(a) else 0.0
    ways = (there, back, homography), (back, there, np.linalg.inv(homography))
    result["repeatability"] = float(np.mean([_repeated(*way) for way in ways]))
    return result | {"corner_error": _corner_error(a, b, homography)}


def _repeated(points: np.ndarray, found: np.ndarray, homography: np.ndarray) -> float:
    """Share of the points that the other picture sees with a keypoint nearby."""
    expected = mapped(points, homography)
    expected = expected[training.inside(expected, SIZE)]
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


# -- report ---------------------------------------------------------------------------------------

#: Trainings under each augmentation.
SEEDS = 5
LABELS = {
    "none": "none",
    "jitter": "gamma and contrast",
    "scaling": "plain exposure scaling",
    "exposure": "ours, exposure only",
    "full": "**ours, in full**",
}
#: Measures of a row of results.
MEASURES = ["repeatability", *(f"accuracy_{k}" for k in THRESHOLDS), "accuracy", "matches"]
MEASURES += [f"auc_{px}" for px in CORNER_ERRORS]
#: What differences are stated of.
JUDGED = {
    "repeatability": "repeatability",
    "accuracy_1": "matching accuracy, 1 px",
    "accuracy": "matching accuracy, mean of 1 to 5 px",
    "auc_5": "homography AUC, 5 px",
}
COMPARED = (
    *(("full", "scaling"), ("full", "exposure"), ("exposure", "scaling")),
    *(("scaling", "jitter"), ("scaling", "none")),
)
_LINE = "augmentation = {label:md}"
_COSTS = f"""{_LINE} | 80 x 80 [ms] = {{ms_80:.2f}} | 512 x 512 [ms] = {{ms_512:.1f}} |
training [s] = {{seconds:.0f}} | steps = {{steps}}"""
#: Tables by gap: their content.
_BY_GAP = {
    "repeatability": "{repeatability:.3f}",
    "accuracy": "{accuracy_1:.3f} / {accuracy_3:.3f} / {accuracy_5:.3f}",
    "auc": "{auc_3:.3f} / {auc_5:.3f} / {auc_10:.3f}",
    "matches": "{matches:.0f}",
}
_DIFFERENCE = "{mark:md}{difference:+.3f} ({interval:+.3f}){mark:md}"


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    costs = {row["arm"]: row for row in results.pop("time")}
    runs = [run for own in results.values() for run in own]
    for arm, own in pd.DataFrame(runs).groupby("arm", sort=False):
        cost = {"part": "cost", "arm": arm, "label": LABELS[str(arm)]}
        cost |= {"seconds": own["seconds"].median(), "steps": own["steps"].iloc[0]}
        costs[arm] = costs.get(arm, {}) | cost
    frame = _frame(runs)
    arms = [arm for arm in LABELS if arm in set(frame["arm"])]
    gaps, isos = (sorted(set(frame[name].tolist())) for name in ("gap", "iso"))
    large = [gap for gap in gaps if gap >= 4.0]
    means = [_mean(frame, arm, [gap], isos) for gap in gaps for arm in arms]
    by_iso = [_mean(frame, arm, large, [iso]) for iso in isos for arm in arms]
    differences = [
        _difference(frame, pair, measure, chosen, meta["seed"])
        for pair in COMPARED
        for chosen in [*([gap] for gap in gaps), large]
        for measure in JUDGED
    ]
    tables = {"costs": table(costs.values(), _COSTS)}
    tables |= {name: pivot(means, _LINE, "{at}", content) for name, content in _BY_GAP.items()}
    contents = "accuracy = {accuracy:.3f} | AUC 5 px = {auc_5:.3f}"
    tables["by-iso"] = pivot(by_iso, _LINE, "ISO {isos[0]:g}", contents)
    tables["differences"] = sections(
        differences, "{pair}", lambda own: pivot(own, "measure = {judged}", "{at}", _DIFFERENCE)
    )
    curves = [
        {"panel": JUDGED[measure], "x": gaps, "style": {"marker": "."}}
        | {"y": [row[measure] for row in means if row["arm"] == arm]}
        | {"label": LABELS[arm].strip("*")}
        for measure in ("repeatability", "accuracy", "auc_5")
        for arm in arms
    ]
    figure = panels(curves, xlabel="exposure gap [EV]", ylim=(0.0, None))
    rows = [*costs.values(), *means, *by_iso, *differences]
    return Report(rows, tables, figures={"features.png": figure})


def _frame(runs: list[Row]) -> pd.DataFrame:
    """A row for each run and test pair."""
    head = ("arm", "seed")
    frame = pd.DataFrame({k: run[k] for k in head} | row for run in runs for row in run["test"])
    frame["accuracy"] = frame[[f"accuracy_{k}" for k in THRESHOLDS]].mean(axis=1)
    errors = frame["corner_error"].astype(float).fillna(np.inf)
    for px in CORNER_ERRORS:  # the mean is the area under the curve
        frame[f"auc_{px}"] = np.clip(1.0 - errors / px, 0.0, 1.0)
    return frame


def _at(gaps: list[float]) -> str:
    return " and ".join(f"{gap:g}" for gap in gaps) + " EV"


def _by_group(frame: pd.DataFrame, arm: str, measure: str, gaps: list[float]) -> np.ndarray:
    """(K, G) means of a measure over the pairs of each seed and source group."""
    own = frame[(frame["arm"] == arm) & frame["gap"].isin(gaps)]
    return own.groupby(["seed", "group"])[measure].mean().unstack().to_numpy()


def _mean(frame: pd.DataFrame, arm: str, gaps: list[float], isos: list[float]) -> Row:
    own = frame[frame["iso"].isin(isos)]
    row: Row = {"arm": arm, "part": "mean", "gaps": gaps, "isos": isos}
    row |= {"label": LABELS[arm], "at": _at(gaps)}
    for measure in MEASURES:
        values = _by_group(own, arm, measure, gaps)
        row |= {measure: float(values.mean()), f"{measure}_seeds": values.mean(axis=1).tolist()}
    return row


def _difference(
    frame: pd.DataFrame, pair: tuple[str, str], measure: str, gaps: list[float], seed: int
) -> Row:
    first, second = (_by_group(frame, arm, measure, gaps) for arm in pair)
    found = score_interval(first - second, np.ones(first.shape[1]), seed=seed)
    row: Row = {"part": "difference", "arm": pair[0], "against": pair[1], "gaps": gaps}
    row |= {"measure": measure, "difference": found.value, "interval": found.pair}
    row |= {"pair": " against ".join(LABELS[arm].strip("*") for arm in pair), "at": _at(gaps)}
    beyond = found.pair is not None and not found.pair[0] <= 0.0 <= found.pair[1]
    return row | {"judged": JUDGED[measure], "mark": "**" * beyond, "beyond": beyond}


# -- parts ----------------------------------------------------------------------------------------

#: Photographs, maps, gaps and ISOs of a quick run.
QUICK_SOURCES, QUICK_GAPS, QUICK_ISOS = 4, (0.0, 4.0), (12800.0,)
#: Sides of the pictures whose augmentation is timed [pixel].
TIMED = (80, 512)


def measure(seed: int, body: int, quick: bool) -> list[Row]:
    """Trains under every augmentation, and judges all on the same test scenes.

    `seed` is that of the training, `body` that of the test pairs and of the body that takes them.
    """
    limit, steps = (QUICK_SOURCES, training.QUICK_STEPS) if quick else (None, training.STEPS)
    trained = {arm: training.train(arm, seed, steps, limit) for arm in training.AUGMENTATIONS}
    taken = conditions(*((QUICK_GAPS, QUICK_ISOS) if quick else ()))
    pairs = held_out_pairs("test", taken, body, limit)
    found = judge({arm: model.detect for arm, (model, _) in trained.items()}, pairs)
    return [
        {"arm": arm, "seed": seed, "steps": steps, "seconds": seconds, "test": found[arm]}
        for arm, (_, seconds) in trained.items()
    ]


def measure_time(seed: int) -> list[Row]:
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


def parts(seed: int, quick: bool) -> list[Part]:
    numbers = range(seed, seed + (1 if quick else SEEDS))
    found = [Part(f"seed {n}", measure, {"seed": n, "body": seed}, 1) for n in numbers]
    return [Part("time", measure_time, threads=1), *found]


run = benchmark("features", parts, report)
