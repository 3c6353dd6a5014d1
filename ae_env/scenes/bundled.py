"""The bundled scenes: fixed source groups in a fixed split, drawn on demand and cached."""

from __future__ import annotations

import json
import logging
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import safetensors
import safetensors.torch
import torch

from ae_env.scenes.photographs import PHOTOGRAPHS, photograph_scenes
from ae_env.scenes.procedural import GENERATOR_VERSION, HARD_KINDS, MOTION_SPEED, draw
from ae_env.scenes.scene import DEFAULT_SPEED, Crop, Scene
from simulator.camera import CameraProfile, NoiseLevelFunction
from simulator.settings import CameraSettings
from simulator.utils.cache import cache_dir, cache_key
from simulator.utils.files import write_atomically

logger = logging.getLogger(__name__)

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


@dataclass(frozen=True)
class _Entry:
    kind: str
    index: int  # within the kind, over both splits
    split: str


def bundled_scenes(
    split: Split,
    camera: CameraProfile,
    resolution: int | None = 64,
    crop: Crop = "box",
    *,
    size: Size = "normal",
    part: str | None = None,
) -> list[Scene]:
    """The bundled scenes of `split`, from the cache where they have been made before.

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
    scenes: list[Scene] = []
    for name in ["train", "test"] if split == "all" else [split]:
        path = _cache_path(name, camera, resolution, crop, size, part)
        loaded = _read_cache(path, camera)
        if loaded is None:
            loaded = [_rounded(s) for s in _make(name, camera, resolution, crop, size, kinds)]
            _write_cache(path, loaded)
        scenes += loaded
    return scenes


def _make(
    split: str,
    camera: CameraProfile,
    resolution: int | None,
    crop: Crop,
    size: Size,
    kinds: Sequence[str],
) -> Iterator[Scene]:
    logger.info("making the bundled scenes of split %r for camera %s", split, camera.name)
    for entry in _entries(split, size):
        if entry.kind in kinds:
            yield _procedural_scene(entry, camera).resized(resolution, crop)
    photographs = [p for p in PHOTOGRAPHS if p.split == split and KINDS[-1] in kinds]
    for photograph in photographs[:SMALL_GROUPS] if size == "small" else photographs:
        for scene in photograph_scenes(photograph, camera):
            yield scene.resized(resolution, crop)


def _entries(split: str, size: Size) -> Iterator[_Entry]:
    for kind, (train, test) in GROUPS_PER_KIND.items():
        first, count = (0, train) if split == "train" else (FIRST_TEST_INDEX, test)
        if size == "small":
            count = min(count, SMALL_GROUPS)
        elif size == "large" and split == "train":
            count *= LARGE_FACTOR
        for index in range(first, first + count):
            yield _Entry(kind, index, split)


def _procedural_scene(entry: _Entry, camera: CameraProfile) -> Scene:
    rng = np.random.default_rng([zlib.crc32(entry.kind.encode()), entry.index])
    drawing = draw(entry.kind, rng)
    name = f"{entry.kind}-{entry.index:03d}"
    return Scene.from_radiance(
        drawing.light,
        camera,
        scene_id=name,
        group=name,
        illuminance=drawing.illuminance,
        illuminant=drawing.illuminant,
        kind=entry.kind,
        hard=entry.kind in HARD_KINDS,
        median_speed=MOTION_SPEED if entry.kind == "motion" else DEFAULT_SPEED,
        source="procedural, ae-env (MIT)",
    )


def _rounded(scene: Scene) -> Scene:
    """The scene with its light as the cache keeps it, so that a cached run equals a fresh one."""
    return replace(scene, light=scene.light.clamp(max=65504.0).half().float())


# -- the cache: float16 light and the other fields as JSON, in one safetensors file --------------

_FIELDS = (
    *("scene_id", "group", "illuminance", "white_balance", "kind", "hard", "median_speed"),
    *("box_factor", "source"),
)


def _cache_path(
    split: str,
    camera: CameraProfile,
    resolution: int | None,
    crop: str,
    size: Size,
    part: str | None,
) -> Path:
    key = cache_key(
        {
            "generator": GENERATOR_VERSION,
            "format": 2,
            "groups": [GROUPS_PER_KIND, FIRST_TEST_INDEX, LARGE_FACTOR],
            "photographs": [p.name for p in PHOTOGRAPHS],
            "camera": camera.name,
            "colour_matrix": camera.colour_matrix,
            "split": split,
            "resolution": resolution,
            "crop": crop,
            "size": size if split == "train" or size == "small" else "normal",
        }
        | ({} if part is None else {"part": part})
    )
    return cache_dir() / "scenes" / f"bundled-{split}-{resolution}-{key}.safetensors"


def _write_cache(path: Path, scenes: list[Scene]) -> None:
    tensors = {f"{i:05d}": scene.light.half() for i, scene in enumerate(scenes)}
    rows: list[dict[str, Any]] = []
    for scene in scenes:
        row: dict[str, Any] = {name: getattr(scene, name) for name in _FIELDS}
        reference = scene.reference
        row["reference"] = (reference.iso, reference.exposure_time, reference.f_number)
        rows.append(row)
    text = json.dumps(rows)
    metadata = {"scenes": text, "checksum": _checksum(tensors, text)}
    try:
        write_atomically(path, safetensors.torch.save(tensors, metadata))
    except OSError as error:  # a full or read-only disk must not stop the run
        logger.warning("the bundled scenes could not be cached in %s: %s", path, error)


def _read_cache(path: Path, camera: CameraProfile) -> list[Scene] | None:
    """The scenes in `path`; None if there is no such file or it is damaged."""
    try:
        if not path.is_file():
            return None
        with safetensors.safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in sorted(file.keys())}
        if metadata.get("checksum") != _checksum(tensors, metadata["scenes"]):
            raise ValueError("its checksum does not match its content")
        rows = json.loads(metadata["scenes"])
        if len(rows) != len(tensors):
            raise ValueError(f"it describes {len(rows)} scenes and holds {len(tensors)}")
        return [
            _scene_of(row, tensor, camera)
            for row, tensor in zip(rows, tensors.values(), strict=True)
        ]
    except (safetensors.SafetensorError, OSError, ValueError, KeyError, TypeError) as error:
        logger.warning("cached scenes %s are damaged (%s) and are made again", path, error)
        return None


def _scene_of(row: dict[str, Any], light: torch.Tensor, camera: CameraProfile) -> Scene:
    fields = {name: row[name] for name in _FIELDS}
    fields["white_balance"] = tuple(fields["white_balance"])
    reference = CameraSettings(*row["reference"])
    return Scene(
        light=light.float(),
        reference=reference,
        camera=camera,
        nlf=NoiseLevelFunction.zero(),
        **fields,
    )


def _checksum(tensors: dict[str, torch.Tensor], text: str) -> str:
    value = zlib.crc32(text.encode())
    for name in sorted(tensors):
        value = zlib.crc32(tensors[name].contiguous().numpy().tobytes(), value)
    return f"{value:08x}"
