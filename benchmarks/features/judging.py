"""Judges detectors on pairs that the reference camera takes of held-out scenes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from scipy.spatial.distance import cdist
from torch import Tensor

from benchmarks.features.detector import Features, mutual_matches
from benchmarks.features.pairs import (
    Source,
    finer,
    inside,
    mapped,
    sources,
    training_view,
    two_crops,
    warped,
)
from benchmarks.features.training import CAMERA
from simulator import CameraSettings, develop, get_camera
from simulator.noise.generator import noise_generator
from simulator.reference.camera import BodyError, ReferenceCamera, ReferenceScene
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


def area_under(errors: np.ndarray, threshold: float) -> np.ndarray:
    """Area under the cumulated errors up to `threshold`, of each error alone; the mean of them is
    that of all."""
    return np.clip(1.0 - errors / threshold, 0.0, 1.0)


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
