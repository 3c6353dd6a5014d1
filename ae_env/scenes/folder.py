"""A user's own files as scenes: raws and radiance maps in a folder, by a glob, or one by one."""

from __future__ import annotations

import glob
import logging
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ae_env.scenes.grouping import (
    FEWEST_GROUPS_TO_SPLIT,
    Shot,
    describe,
    group_shots,
    log_groups,
    named_groups,
    split_groups,
)
from ae_env.scenes.radiance import RADIANCE_SUFFIXES, radiance_scenes
from ae_env.scenes.scene import Crop, Resize, Scene
from simulator.camera import CameraProfile
from simulator.files import RAW_SUFFIXES
from simulator.raw_file import read_raw

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class FolderOptions:
    """What the caller knows about the files.

    Args:
        illuminance: Light on the subject [lux] of every file, or by file name.
        kind: Kind of the scenes; ``"raw"`` or ``"radiance"`` by default.
        hard: Whether they count as hard.
        median_speed: Median image speed of a moving episode [frame heights / s].
        ev100: EV100 of the radiance maps, in place of the assumed one.
    """

    illuminance: float | Mapping[str, float] | None = None
    kind: str | None = None
    hard: bool | None = None
    median_speed: float | None = None
    ev100: float | None = None

    def fields(self, path: Path, raw: bool) -> dict[str, Any]:
        """Keyword arguments for the scenes of `path`."""
        lux = self.illuminance
        if isinstance(lux, Mapping):
            lux = lux.get(path.name)
        given = {"kind": self.kind, "hard": self.hard, "median_speed": self.median_speed}
        given["illuminance"] = lux
        if not raw:
            given["ev100"] = self.ev100
        return {name: value for name, value in given.items() if value is not None}


def find_files(spec: str | Path) -> tuple[Path, list[Path]]:
    """The raws and radiance maps that `spec` names, and the folder they are under.

    Args:
        spec: A file, a folder (searched with its sub-folders; hidden ones left out) or a glob.

    Returns:
        The base folder and the files, sorted in natural order (``IMG_2`` before ``IMG_10``).

    Raises:
        ValueError: If there is nothing by that name, or no raw or radiance map in it.
    """
    path = Path(spec).expanduser()
    known = (*RAW_SUFFIXES, *RADIANCE_SUFFIXES)
    if path.is_file():
        base, found = path.parent, [path]
    elif path.is_dir():
        base, found = path, [p for p in path.rglob("*") if p.is_file()]
    else:
        matches = [Path(p) for p in glob.glob(str(path), recursive=True)]
        if not matches:
            raise ValueError(
                f"`scenes` (={str(spec)!r}) must name an existing file, folder or glob"
            )
        first = next((i for i, p in enumerate(path.parts) if glob.has_magic(p)), -1)
        base, found = Path(*path.parts[:first]), [p for p in matches if p.is_file()]
    files = [
        p
        for p in found
        if p.suffix.lower() in known
        and not any(part.startswith(".") for part in p.relative_to(base).parts)
    ]
    if not files:
        endings = sorted({p.suffix.lower() or "(none)" for p in found})
        raise ValueError(
            f"`scenes` (={str(spec)!r}, files ending in {endings}) must hold raws "
            f"({', '.join(RAW_SUFFIXES[:8])} ...) or radiance maps ({', '.join(RADIANCE_SUFFIXES)})"
        )
    return base, sorted(files, key=_natural)


def folder_scenes(
    spec: str | Path,
    split: str,
    camera: CameraProfile,
    resolution: int | None = 64,
    crop: Crop = "box",
    options: FolderOptions | None = None,
    resize: Resize = Scene.resized,
) -> list[Scene]:
    """The scenes of `split` among the user's files.

    The source group of a file is, in this order: what ``groups.csv`` beside it says; its sub-folder
    under `spec`; for a radiance map the file itself; for a raw what `group_shots` finds.

    Args:
        spec: See `find_files`.
        split: ``"train"``, ``"test"`` or ``"all"``.
        camera: Whose colours the light of radiance maps is taken to.
        resolution: Packed pixels a side; None keeps each scene's own size.
        crop: See `Scene.resized`.
        options: What the caller knows about the files.
        resize: Brings each scene to `resolution`, before the next file is read.

    Raises:
        ValueError: If a file cannot be read (the message names it), or `split` is ``"train"`` and
            there are too few groups to hold any out.
    """
    options = FolderOptions() if options is None else options
    base, files = find_files(spec)
    named = named_groups(sorted({base, *(p.parent for p in files)}))
    names = _scene_names(base, files)
    if split == "train" and len(files) < FEWEST_GROUPS_TO_SPLIT:
        raise _too_few_groups(spec, f"at most {len(files)}")  # before any time is spent on reading
    scenes: list[Scene] = []
    shots: dict[str, Shot] = {}
    for number, path in enumerate(files, start=1):
        logger.info("reading scene file %d of %d: %s", number, len(files), path.name)
        name = names[path]
        group = named.get(path.resolve())
        if group is None:
            group = name if path.parent == base else path.parent.relative_to(base).as_posix()
        raw_file = path.suffix.lower() in RAW_SUFFIXES
        fields = options.fields(path, raw_file)
        try:
            if raw_file:
                scene, shot = _raw_scene(path, name, group, fields)
                scenes.append(resize(scene, resolution, crop))
                if path.parent == base and path.resolve() not in named:
                    shots[name] = shot
            else:
                fields |= {"name": name, "group": group, "resolution": resolution, "crop": crop}
                scenes += radiance_scenes(path, camera, resize=resize, **fields)
        except ValueError as error:
            raise ValueError(f"scene file {str(path)!r}: {error}") from error
    found = dict(zip(shots, group_shots(list(shots), list(shots.values())), strict=True))
    scenes = [replace(s, group=found.get(s.scene_id, s.group)) for s in scenes]
    log_groups(str(spec), {s.scene_id: s.group for s in scenes})
    return _of_split(spec, scenes, split)


def _of_split(spec: str | Path, scenes: list[Scene], split: str) -> list[Scene]:
    if split == "all":
        return scenes
    parts = split_groups([scene.group for scene in scenes])
    if split == "train" and "train" not in parts.values():
        raise _too_few_groups(spec, str(len(parts)))
    return [scene for scene in scenes if parts[scene.group] == split]


def _too_few_groups(spec: str | Path, number: str) -> ValueError:
    return ValueError(
        f"`split` (='train') needs at least {FEWEST_GROUPS_TO_SPLIT} source groups, so that some "
        f"can be held out; {str(spec)!r} has {number}. Train on scenes='bundled' and use these "
        "with split='test' (zero-shot) or split='all'; if files are grouped wrongly, name the "
        "groups in a groups.csv (columns file, group) beside them"
    )


def _raw_scene(path: Path, name: str, group: str, fields: dict[str, Any]) -> tuple[Scene, Shot]:
    raw = read_raw(path)
    noise = raw.metadata.get("nlf_source", "unknown")
    source = f"{path.name}; noise: {noise}"
    scene = Scene.from_raw(raw, scene_id=name, group=group, source=source, **fields)
    return scene, describe(raw)


def _scene_names(base: Path, files: list[Path]) -> dict[Path, str]:
    """Scene ids: the path below `base` without its ending, with it where two would be equal."""
    stems = [p.relative_to(base).with_suffix("").as_posix() for p in files]
    return {
        p: stem if stems.count(stem) == 1 else p.relative_to(base).as_posix()
        for p, stem in zip(files, stems, strict=True)
    }


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """Sort key in which numbers count as numbers."""
    parts = re.split(r"(\d+)", path.as_posix().lower())
    return [(0, int(p), "") if p.isdigit() else (1, 0, p) for p in parts]
