"""A user's own files as scenes: raws and radiance maps in a folder, by a glob, or one by one."""

from __future__ import annotations

import glob
import logging
import re
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

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
from ae_env.utils.checks import check_flag, check_number, check_word
from simulator.camera import CameraProfile
from simulator.raw.read import read_raw
from simulator.utils.files import RAW_SUFFIXES


# Recorded sequences as scenes: raws in the order of their names are the frames of an episode.
def sequence_scenes(
    spec: str | Path,
    split: str,
    camera: CameraProfile,
    resolution: int | None = 64,
    crop: Crop = "box",
    options: FolderOptions | None = None,
    resize: Resize = Scene.resized,
) -> list[Scene]:
    """The frames of every sequence of `split`, one sequence after the other.

    The raws of one folder, in the natural order of their names, are one sequence and one source
    group; its name is the folder's below `spec`. Each raw's light is known through its own
    settings: it may change from frame to frame. Raws in `spec` itself are named after it, or ``.``
    where a folder below has that name.

    Args:
        spec: A folder, searched with its sub-folders, or a glob.
        split: ``"train"``, ``"test"`` or ``"all"``; of fewer than 15 sequences all are for test.
        camera: Not used by raws, which bring their own; as of `folder_scenes`.
        resolution: Packed pixels a side; None keeps each raw's own size.
        crop: See `Scene.resized`.
        options: What the caller knows about the files; `on_error` must be ``"stop"``.
        resize: Brings each scene to `resolution`, before the next file is read.

    Raises:
        ValueError: If there are no raws, one cannot be read, there are no sequences of `split`, or
            unreadable raws were to be skipped: all later frames would come too early.
    """
    options = FolderOptions() if options is None else options
    if options.on_error == "skip":
        raise ValueError(
            "`on_error` (='skip') must be 'stop' for a sequence: without a raw all later ones "
            "would come a frame too early; cut the recording there, into two folders"
        )
    base, found = find_files(spec)
    by_folder: dict[Path, list[Path]] = {}
    for path in found:
        if path.suffix.lower() in RAW_SUFFIXES:
            by_folder.setdefault(path.parent, []).append(path)
    if not by_folder:
        raise ValueError(
            f"`scenes` (={{'sequence': {str(spec)!r}}}) must hold raws "
            f"({', '.join(RAW_SUFFIXES[:8])} ...): radiance maps have no settings of their own"
        )
    if split == "train" and len(by_folder) < FEWEST_GROUPS_TO_SPLIT:
        raise too_few_groups(spec, str(len(by_folder)))  # before any time is spent on reading
    files = [path for paths in by_folder.values() for path in paths]
    names = scene_names(base, files)
    sequences = _sequence_names(base, list(by_folder))
    groups = {names[path]: sequences[path.parent] for path in files}
    reader = Reader(base, names, {}, options, camera, resolution, crop, resize)
    scenes, _ = read_all(spec, files, reader, hint="")
    scenes = [replace(scene, group=groups[scene.scene_id]) for scene in scenes]
    log_groups(str(spec), {scene.scene_id: scene.group for scene in scenes})
    return of_split(spec, scenes, split)


def _sequence_names(base: Path, folders: list[Path]) -> dict[Path, str]:
    names = {folder: folder.relative_to(base).as_posix() for folder in folders}
    own = base.resolve().name
    if base in names and own and own not in names.values():
        names[base] = own  # else "."
    return names


def sequence_bounds(scenes: Sequence[Scene]) -> tuple[np.ndarray, np.ndarray]:
    """First and last frame, (F,) int64 each, of the sequence that each of F frames belongs to.

    Args:
        scenes: As `sequence_scenes` returns them: those of one group follow each other.
    """
    groups = [scene.group for scene in scenes]
    begins = [i for i, group in enumerate(groups) if i == 0 or groups[i - 1] != group]
    lengths = np.diff([*begins, len(groups)])
    first = np.repeat(begins, lengths)
    return first, first + np.repeat(lengths, lengths) - 1


logger = logging.getLogger(__name__)


OnError = Literal["stop", "skip"]
#: Seconds between two log lines about how far the reading is, and names in one about what is bad.
_PROGRESS_SECONDS, _NAMES = 10.0, 5
_HOW_TO_SKIP = "; in Python or YAML, {'path': ..., 'on_error': 'skip'} leaves it out"


@dataclass(frozen=True)
class FolderOptions:
    """What the caller knows about the files.

    Args:
        illuminance: Light on the subject [lux] of every file, or by file name.
        kind: Kind of the scenes; ``"raw"`` or ``"radiance"`` by default.
        hard: Whether they count as hard.
        median_speed: Median image speed of a moving episode [frame heights / s].
        ev100: EV100 of the radiance maps, in place of the assumed one.
        on_error: What a file does that cannot be read, or is black without `illuminance`:
            ``"stop"`` raises an error that names it, so that nothing goes missing unseen;
            ``"skip"`` leaves it out, and a warning in the log says how many were and why; not
            for sequences.
    """

    illuminance: float | Mapping[str, float] | None = None
    kind: str | None = None
    hard: bool | None = None
    median_speed: float | None = None
    ev100: float | None = None
    on_error: OnError = "stop"

    def __post_init__(self) -> None:
        check_word("on_error", self.on_error, get_args(OnError))
        lux = self.illuminance
        for value in lux.values() if isinstance(lux, Mapping) else [lux]:
            if value is not None:
                check_number("illuminance", value, 1e-6, 1e9, more=" lux")
        if self.kind is not None and not isinstance(self.kind, str):
            raise ValueError(f"`kind` (={self.kind!r}) must be a name or None")
        if self.hard is not None:
            check_flag("hard", self.hard)
        if self.median_speed is not None:
            check_number("median_speed", self.median_speed, 0.0, 1e6, more=" frame heights / s")
        if self.ev100 is not None:
            check_number("ev100", self.ev100, -20.0, 40.0)

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
    known = (*RAW_SUFFIXES, *RADIANCE_SUFFIXES)
    try:
        base, found = _listed(spec)
    except (OSError, RuntimeError) as error:  # no permission, no such user, a folder removed ...
        raise ValueError(f"`scenes` (={str(spec)!r}) cannot be listed: {error}") from error
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


def _listed(spec: str | Path) -> tuple[Path, list[Path]]:
    """The base folder and every file that `spec` names."""
    path = Path(spec).expanduser()
    if path.is_file():
        return path.parent, [path]
    if path.is_dir():
        return path, [p for p in path.rglob("*") if p.is_file()]
    matches = [Path(p) for p in glob.glob(str(path), recursive=True)]
    if not matches:
        raise ValueError(f"`scenes` (={str(spec)!r}) must name an existing file, folder or glob")
    first = next((i for i, p in enumerate(path.parts) if glob.has_magic(p)), -1)
    return Path(*path.parts[:first]), [p for p in matches if p.is_file()]


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
        ValueError: If a file cannot be read (the message names it; with ``on_error="skip"`` only
            if no file can), or `split` is ``"train"`` and there are too few groups to hold any out.
    """
    options = FolderOptions() if options is None else options
    base, files = find_files(spec)
    named = named_groups(sorted({base, *(p.parent for p in files)}))
    names = scene_names(base, files)
    if split == "train" and len(files) < FEWEST_GROUPS_TO_SPLIT:
        raise too_few_groups(spec, f"at most {len(files)}")  # before any time is spent on reading
    reader = Reader(base, names, named, options, camera, resolution, crop, resize)
    scenes, shots = read_all(spec, files, reader)
    found = dict(zip(shots, group_shots(list(shots), list(shots.values())), strict=True))
    scenes = [replace(s, group=found.get(s.scene_id, s.group)) for s in scenes]
    log_groups(str(spec), {s.scene_id: s.group for s in scenes})
    return of_split(spec, scenes, split)


@dataclass(frozen=True)
class Reader:
    """Makes scenes of one file after the other; see `folder_scenes`."""

    base: Path
    names: Mapping[Path, str]
    named: Mapping[Path, str]
    options: FolderOptions
    camera: CameraProfile
    resolution: int | None
    crop: Crop
    resize: Resize

    def __call__(self, path: Path) -> tuple[list[Scene], Shot | None]:
        """The scenes of a file, and what tells the group of a raw that none is named for."""
        scenes, shot = self._read(path)
        for scene in scenes:
            _ = scene.ev100  # refuses what is black in unknown light
        return scenes, shot

    def _read(self, path: Path) -> tuple[list[Scene], Shot | None]:
        name, group = self.names[path], self.named.get(path.resolve())
        grouped = group is not None or path.parent != self.base
        if group is None:
            group = path.parent.relative_to(self.base).as_posix() if grouped else name
        raw_file = path.suffix.lower() in RAW_SUFFIXES
        fields = self.options.fields(path, raw_file)
        if raw_file:
            scene, shot = _raw_scene(path, name, group, fields)
            return [self.resize(scene, self.resolution, self.crop)], None if grouped else shot
        fields |= {"resolution": self.resolution, "crop": self.crop, "resize": self.resize}
        return list(radiance_scenes(path, self.camera, name=name, group=group, **fields)), None


def read_all(
    spec: str | Path, files: list[Path], reader: Reader, hint: str = _HOW_TO_SKIP
) -> tuple[list[Scene], dict[str, Shot]]:
    """The scenes of all `files`, and what tells the groups of those that none is named for.

    `hint` ends the error of a file that cannot be read, where there are others.
    """
    scenes: list[Scene] = []
    shots: dict[str, Shot] = {}
    skipped: dict[Path, Exception] = {}
    for path in _with_progress(spec, files):
        try:
            own, shot = reader(path)
        except (ValueError, OSError) as error:  # it may also have vanished since it was listed
            if reader.options.on_error == "stop":
                more = hint if len(files) > 1 else ""
                raise ValueError(f"scene file {str(path)!r}: {error}{more}") from error
            skipped[path] = error
            continue
        scenes += own
        if shot is not None:
            shots[own[0].scene_id] = shot
    _report_skipped(spec, skipped, len(files))
    return scenes, shots


def _with_progress(spec: str | Path, files: list[Path]) -> Iterator[Path]:
    """`files`, with a log line at the beginning and every few seconds."""
    logger.info("reading %d scene files of %s", len(files), spec)
    last = time.monotonic()
    for number, path in enumerate(files, start=1):
        if time.monotonic() - last > _PROGRESS_SECONDS:
            logger.info("reading scene file %d of %d: %s", number, len(files), path.name)
            last = time.monotonic()
        yield path


def _report_skipped(spec: str | Path, skipped: Mapping[Path, Exception], total: int) -> None:
    """Log what was left out; an error if nothing is left."""
    if not skipped:
        return
    reasons = [f"{path.name}: {error}" for path, error in list(skipped.items())[:_NAMES]]
    more = f"; and {len(skipped) - _NAMES} more" if len(skipped) > _NAMES else ""
    if len(skipped) == total:
        raise ValueError(
            f"`scenes` (={str(spec)!r}) must hold a file that can be read, but all {total} were "
            f"skipped ({'; '.join(reasons)}{more})"
        )
    logger.warning(
        "%s: %d of %d scene files skipped (%s%s)",
        *(spec, len(skipped), total, "; ".join(reasons), more),
    )


def of_split(spec: str | Path, scenes: list[Scene], split: str) -> list[Scene]:
    """Those of `scenes` whose source group is in `split`."""
    if split == "all":
        return scenes
    parts = split_groups([scene.group for scene in scenes])
    if split == "train" and "train" not in parts.values():
        raise too_few_groups(spec, str(len(parts)))
    return [scene for scene in scenes if parts[scene.group] == split]


def too_few_groups(spec: str | Path, number: str) -> ValueError:
    """What to raise where `spec` has only `number` source groups to train on."""
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


def scene_names(base: Path, files: list[Path]) -> dict[Path, str]:
    """Scene ids: the path below `base` without its ending, with it where two would be equal."""
    stems = [p.relative_to(base).with_suffix("").as_posix() for p in files]
    times = Counter(stems)
    return {
        p: stem if times[stem] == 1 else p.relative_to(base).as_posix()
        for p, stem in zip(files, stems, strict=True)
    }


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """Sort key in which numbers count as numbers."""
    parts = re.split(r"(\d+)", path.as_posix().lower())
    return [(0, int(p), "") if p.isdigit() else (1, 0, p) for p in parts]
