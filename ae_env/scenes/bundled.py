"""The bundled scenes: fixed source groups in a fixed split, drawn on demand and cached.

A cached scene has float16 light, and a byte a pixel for its layout: defocus in 127 steps, and a bit
for the subject. One that was just drawn is rounded alike, so that a cached run equals a fresh one.
"""

import logging
import math
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
import torch

from ae_env.scenes.scene import DEFAULT_SPEED, Scene, SceneRequest, SceneSet
from simulator.camera import CameraProfile
from simulator.capture.blurred_frames import Layout
from simulator.radiance import procedural
from simulator.radiance.depth import draw_layout
from simulator.radiance.incident_light import picture_illuminance
from simulator.radiance.photographs import PHOTOGRAPHS, Photograph, photograph_drawings
from simulator.settings import CameraSettings
from simulator.utils.cache import cache_key, disk_cache
from simulator.utils.checks import NOTE
from simulator.utils.compute import parallel_ranges, progress_bar

logger = logging.getLogger(__name__)

Size = Literal["small", "normal", "large"]
#: Source groups of each procedural kind: (train, test).
GROUPS_PER_KIND = {
    "dead_leaves": (90, 24),
    "indoor": (70, 18),
    "back_light": (90, 11),
    "snow": (70, 10),
    "night": (80, 11),
    "spot_light": (80, 10),
    "motion": (60, 10),
}
#: Index of the first test group of a kind: the test scenes stay when training scenes are added.
FIRST_TEST_INDEX = 1000
#: Groups of each kind and split in "bundled:small"; the same scenes as the first of "bundled".
SMALL_GROUPS = 2
#: How many times the training groups of "bundled" there are in "bundled:large"; same test groups.
LARGE_FACTOR = 4
#: Kinds of the bundled scenes, those of scikit-image's photographs last; the hard ones together.
KINDS, HARD = (*GROUPS_PER_KIND, "photograph"), "hard"
#: From so many missing groups on, drawing takes long enough for a log line and a progress bar.
_MANY = 64
#: Part of every cache key: raise it with any change of the stored values.
_FORMAT = 9
#: Fields of a cached scene that JSON holds.
_FIELDS = (
    *("scene_id", "group", "illuminance", "white_balance", "kind", "hard", "median_speed"),
    *("box_factor", "source", "sampled"),
)
#: Steps of a cached layout's defocus.
_STEPS = 127


def bundled_scenes(
    request: SceneRequest, *, size: Size = "normal", part: str | None = None
) -> SceneSet:
    """The bundled scenes of a split, from the cache where they have been made before.

    Args:
        request: Split, camera, resolution and crop; without a resolution they have 256 pixels.
        size: ``"small"``: only `SMALL_GROUPS` groups of each kind and split; ``"large"``:
            `LARGE_FACTOR` times the procedural training groups, and the same test groups.
        part: Only those of one of `KINDS`, or the hard ones (`HARD`); None for all.
    """
    if request.split == "all":
        halves = [replace(request, split=split) for split in ("train", "test")]
        return SceneSet([s for half in halves for s in bundled_scenes(half, size=size, part=part)])
    key = {
        "generator": procedural.GENERATOR_VERSION,
        "format": _FORMAT,
        "groups": [GROUPS_PER_KIND, FIRST_TEST_INDEX, LARGE_FACTOR],
        "photographs": [p.name for p in PHOTOGRAPHS],
        "camera": request.camera.name,
        "colour_matrix": request.camera.colour_matrix,
        "split": request.split,
        "resolution": request.resolution,
        "crop": request.crop,
        "size": size if request.split == "train" or size == "small" else "normal",
        "part": part,
    }
    key_of_all = cache_key("scenes", key)
    found = _stored(key_of_all, request.camera, request.resolution)
    if found is not None:
        return found
    kinds = KINDS if part is None else procedural.HARD_KINDS if part == HARD else (part,)
    groups = list(_groups(request, size, kinds))
    return DrawnScenes(f"the bundled scenes ({request.split})", groups, key_of_all)


class SceneGroup(NamedTuple):
    """Names of scenes that are drawn together, and what draws them, always the same ones."""

    scene_ids: Sequence[str]
    draw: Callable[[], Iterable[Scene]]


class DrawnScenes(SceneSet):
    """Scenes whose names are known, and each of which is drawn when it is first needed.

    The first is drawn at once, so that what cannot be drawn is an error here. When the last one is
    there, all are stored under `key` for the next process; without one they are stored already. A
    pickled copy has all of them.
    """

    def __init__(self, name: str, groups: Sequence[SceneGroup], key: str = "") -> None:
        self._name, self._groups, self._key = name, groups, key
        self.scene_ids = tuple(one for group in groups for one in group.scene_ids)
        self._scenes = [None] * len(self.scene_ids)
        ends = np.cumsum([len(group.scene_ids) for group in groups]).tolist()
        self._firsts = [end - len(g.scene_ids) for end, g in zip(ends, groups, strict=True)]
        self._group_of = np.repeat(np.arange(len(groups)), [len(g.scene_ids) for g in groups])
        if groups:
            self.load([0])

    def __reduce__(self) -> tuple[Any, ...]:
        return SceneSet, (list(self),)

    def load(self, indices: Iterable[int]) -> None:
        """Draws the groups of the scenes `indices` that are missing, on torch's threads."""
        missing = sorted({int(self._group_of[i]) for i in indices if self._scenes[i] is None})
        if not missing:
            return
        many = len(missing) >= _MANY and bool(self._key)
        if many:
            logger.log(NOTE, "drawing %s, once for this camera and resolution", self._name)
        with progress_bar("drawing scenes", len(missing) if many else 0) as advance:

            def draw_some(first: int, last: int) -> None:
                for number in missing[first:last]:
                    start = self._firsts[number]
                    for place, scene in enumerate(self._groups[number].draw(), start=start):
                        self._scenes[place] = _rounded(scene)
                    advance()

            parallel_ranges(draw_some, len(missing))
        whole = [scene for scene in self._scenes if scene is not None]
        if self._key and len(whole) == len(self):  # once: later calls have none missing
            _store(self._key, whole)


def _groups(request: SceneRequest, size: Size, kinds: Sequence[str]) -> Iterator[SceneGroup]:
    """The source groups of a split, the photographs last."""
    for kind, index in procedural_groups(request.split, size):
        if kind in kinds:
            name = f"{kind}-{index:03d}"
            yield SceneGroup([name], partial(_draw_procedural, kind, index, name, request))
    photographs = [p for p in PHOTOGRAPHS if p.split == request.split and KINDS[-1] in kinds]
    for photograph in photographs[:SMALL_GROUPS] if size == "small" else photographs:
        yield SceneGroup(photograph.scene_ids, partial(_draw_photograph, photograph, request))


def procedural_groups(split: str, size: Size) -> Iterator[tuple[str, int]]:
    """Kind of each procedural group, and its index within the kind over both splits."""
    for kind, (train, test) in GROUPS_PER_KIND.items():
        first, count = (0, train) if split == "train" else (FIRST_TEST_INDEX, test)
        if size == "small":
            count = min(count, SMALL_GROUPS)
        elif size == "large" and split == "train":
            count *= LARGE_FACTOR
        for index in range(first, first + count):
            yield kind, index


def _draw_procedural(kind: str, index: int, name: str, request: SceneRequest) -> list[Scene]:
    drawing = procedural.draw(kind, np.random.default_rng([zlib.crc32(kind.encode()), index]))
    speed = procedural.MOTION_SPEED if kind == "motion" else DEFAULT_SPEED
    facts = {"kind": kind, "hard": kind in procedural.HARD_KINDS, "median_speed": speed}
    return [_scene(drawing, request, scene_id=name, source="procedural, ae-env (MIT)", **facts)]


def _draw_photograph(photograph: Photograph, request: SceneRequest) -> list[Scene]:
    facts = {"group": photograph.name, "kind": KINDS[-1]}
    facts["source"] = f"scikit-image {photograph.file}: {photograph.credit}"
    drawings = zip(photograph.scene_ids, photograph_drawings(photograph), strict=True)
    return [_scene(drawing, request, scene_id=name, **facts) for name, drawing in drawings]


def _scene(drawing: procedural.Drawing, request: SceneRequest, **facts: Any) -> Scene:
    light, lux, illuminant = drawing.light, drawing.illuminance, drawing.illuminant
    scene = Scene.from_radiance(
        light, request.camera, illuminance=lux, illuminant=illuminant, **facts
    )
    reflected = scene.incident_light.reflected_ev100
    if reflected is not None:  # what is drawn is lit from the front by `lux`
        scene = replace(scene, illuminance=picture_illuminance(lux, reflected))
    return add_layout(scene).resized(request.resolution, request.crop)


def add_layout(scene: Scene) -> Scene:
    """The scene with a procedural layout, which its name decides (`draw_layout`)."""
    return replace(scene, layout=draw_layout(scene.scene_id, *scene.light.shape[1:]))


def cached_scenes(
    key: str, make: Callable[[], Iterable[Scene]], camera: CameraProfile, resolution: int | None
) -> SceneSet:
    """Scenes without noise of `camera`, from the cache where they have been made before.

    `key` is of all that they depend on; `make` makes them, all of one size, all with a layout or
    none, of `resolution` packed pixels a side (None for `NATIVE_SIZE`).
    """
    found = _stored(key, camera, resolution)
    if found is None:
        found = SceneSet(_rounded(scene) for scene in make())
        _store(key, found)
    return found


def _rounded(scene: Scene) -> Scene:
    layout = None if scene.layout is None else _from_bytes(_to_bytes(scene.layout))
    return replace(scene, light=scene.light.clamp(max=65504.0).half().float(), layout=layout)


def _to_bytes(layout: Layout) -> torch.Tensor:
    """(H, W) uint8: the defocus, and 128 where the subject is."""
    found = (layout.defocus * _STEPS).round().byte()
    return found if layout.subject is None else found + 128 * layout.subject.byte()


def _from_bytes(stored: torch.Tensor) -> Layout:
    return Layout((stored % 128).float() / _STEPS, stored >= 128)


def _store(key: str, scenes: Sequence[Scene]) -> None:
    settings = [(s.reference.iso, s.reference.exposure_time, s.reference.f_number) for s in scenes]
    facts = [{name: getattr(scene, name) for name in _FIELDS} for scene in scenes]
    layouts = [_to_bytes(scene.layout) for scene in scenes if scene.layout is not None]
    values = {
        "light": torch.stack([scene.light for scene in scenes]).half(),
        "facts": [own | {"reference": used} for own, used in zip(facts, settings, strict=True)],
    }
    disk_cache().put(key, values | ({"layouts": torch.stack(layouts)} if layouts else {}))


def _stored(key: str, camera: CameraProfile, resolution: int | None) -> SceneSet | None:
    """The scenes in the cache; None if there are none, or they cannot be those asked for."""
    values = disk_cache().get(key)
    if values is None:
        return None
    side = procedural.NATIVE_SIZE if resolution is None else resolution
    try:
        ids, light = [row["scene_id"] for row in values["facts"]], values["light"]
        if light.shape != (len(ids), 4, side, side) or not light.amax() < math.inf:
            raise ValueError(f"light of {side} x {side} has the shape {light.shape}, or NaN")
        draw = partial(_unpacked, values, camera)
        return DrawnScenes("", [SceneGroup([one], partial(draw, i)) for i, one in enumerate(ids)])
    except (ValueError, KeyError, TypeError) as error:
        logger.warning("the cached scenes are damaged (%s) and are made again", error)
        return None


def _unpacked(values: Mapping[str, Any], camera: CameraProfile, index: int) -> list[Scene]:
    facts, light = dict(values["facts"][index]), values["light"][index].float()
    used = CameraSettings(*facts.pop("reference"))
    if "layouts" in values:
        facts["layout"] = _from_bytes(values["layouts"][index])
    return [Scene.from_array(light, used, camera, **facts)]
