"""The bundled scenes: fixed source groups in a fixed split, drawn on demand and cached."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np

from ae_env.scenes.drawn import DrawnScenes, SceneSource
from ae_env.scenes.scene import DEFAULT_SPEED, Crop, Scene
from ae_env.scenes.stored import stored_scenes
from simulator.camera import CameraProfile
from simulator.radiance.depth import draw_layout
from simulator.radiance.photographs import PHOTOGRAPHS, Photograph, photograph_drawings
from simulator.radiance.procedural import (
    GENERATOR_VERSION,
    HARD_KINDS,
    MOTION_SPEED,
    draw,
)
from simulator.utils.cache import cache_key

Split = Literal["train", "test", "all"]

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
Size = Literal["small", "normal", "large"]
#: Kinds of the bundled scenes; those of scikit-image's photographs last.
KINDS = (*GROUPS_PER_KIND, "photograph")
#: Name of the hard kinds together.
HARD = "hard"


def bundled_scenes(
    split: Split,
    camera: CameraProfile,
    resolution: int | None = 64,
    crop: Crop = "box",
    *,
    size: Size = "normal",
    part: str | None = None,
) -> Sequence[Scene]:
    """The bundled scenes of `split`, from the cache where they have been made before.

    Else those of one split are drawn when they are needed (`DrawnScenes`).

    Args:
        split: ``"train"``, ``"test"`` or ``"all"`` (train, then test).
        camera: Whose colours the light is taken to.
        resolution: Packed pixels a side; None keeps 256.
        crop: See `Scene.resized`.
        size: ``"small"``: only `SMALL_GROUPS` groups of each kind and split; ``"large"``:
            `LARGE_FACTOR` times the procedural training groups, and the same test groups.
        part: Only those of one of `KINDS`, or the hard ones (`HARD`); None for all.
    """
    kinds = KINDS if part is None else HARD_KINDS if part == HARD else (part,)
    parts: list[Sequence[Scene]] = []
    for name in ["train", "test"] if split == "all" else [split]:
        key = _cache_key(name, camera, resolution, crop, size, part)
        found = stored_scenes(key, camera, resolution)
        if found is None:
            sources = list(_sources(name, camera, resolution, crop, size, kinds))
            parts.append(DrawnScenes(f"the bundled scenes ({name})", sources, key))
        else:
            parts.append(found)
    return parts[0] if len(parts) == 1 else [scene for own in parts for scene in own]


def _sources(
    split: str,
    camera: CameraProfile,
    resolution: int | None,
    crop: Crop,
    size: Size,
    kinds: Sequence[str],
) -> Iterator[SceneSource]:
    """Where the scenes of `split` come from, the photographs last."""

    def source(scene_ids: Sequence[str], draw: Callable[[], Iterable[Scene]]) -> SceneSource:
        def make() -> list[Scene]:
            return [add_layout(scene).resized(resolution, crop) for scene in draw()]

        return SceneSource(tuple(scene_ids), make)

    for kind, index in _procedural(split, size):
        if kind in kinds:
            yield source([_name(kind, index)], partial(_procedural_scenes, kind, index, camera))
    photographs = [p for p in PHOTOGRAPHS if p.split == split and KINDS[-1] in kinds]
    for photograph in photographs[:SMALL_GROUPS] if size == "small" else photographs:
        yield source(photograph.scene_ids, partial(_photograph_scenes, photograph, camera))


def _procedural(split: str, size: Size) -> Iterator[tuple[str, int]]:
    """Kind of each procedural group, and its index within the kind over both splits."""
    for kind, (train, test) in GROUPS_PER_KIND.items():
        first, count = (0, train) if split == "train" else (FIRST_TEST_INDEX, test)
        if size == "small":
            count = min(count, SMALL_GROUPS)
        elif size == "large" and split == "train":
            count *= LARGE_FACTOR
        for index in range(first, first + count):
            yield kind, index


def _name(kind: str, index: int) -> str:
    return f"{kind}-{index:03d}"


def _procedural_scenes(kind: str, index: int, camera: CameraProfile) -> Iterator[Scene]:
    rng = np.random.default_rng([zlib.crc32(kind.encode()), index])
    drawing = draw(kind, rng)
    name = _name(kind, index)
    yield Scene.from_radiance(
        drawing.light,
        camera,
        scene_id=name,
        group=name,
        illuminance=drawing.illuminance,
        illuminant=drawing.illuminant,
        kind=kind,
        hard=kind in HARD_KINDS,
        median_speed=MOTION_SPEED if kind == "motion" else DEFAULT_SPEED,
        source="procedural, ae-env (MIT)",
    )


def _photograph_scenes(photograph: Photograph, camera: CameraProfile) -> Iterator[Scene]:
    """The scenes of one photograph, a pixel of it one packed pixel, all in one source group."""
    drawings = photograph_drawings(photograph)
    for scene_id, drawing in zip(photograph.scene_ids, drawings, strict=True):
        yield Scene.from_radiance(
            drawing.light,
            camera,
            scene_id=scene_id,
            group=photograph.name,
            illuminance=drawing.illuminance,
            illuminant=drawing.illuminant,
            kind="photograph",
            source=f"scikit-image {photograph.file}: {photograph.credit}",
        )


def add_layout(scene: Scene) -> Scene:
    """The scene with a procedural layout, which its name decides (`draw_layout`)."""
    return replace(scene, layout=draw_layout(scene.scene_id, *scene.light.shape[1:]))


def _cache_key(
    split: str,
    camera: CameraProfile,
    resolution: int | None,
    crop: str,
    size: Size,
    part: str | None,
) -> str:
    return cache_key(
        "scenes",
        {
            "generator": GENERATOR_VERSION,
            "format": 7,
            "groups": [GROUPS_PER_KIND, FIRST_TEST_INDEX, LARGE_FACTOR],
            "photographs": [p.name for p in PHOTOGRAPHS],
            "camera": camera.name,
            "colour_matrix": camera.colour_matrix,
            "split": split,
            "resolution": resolution,
            "crop": crop,
            "size": size if split == "train" or size == "small" else "normal",
            "part": part,
        },
    )
