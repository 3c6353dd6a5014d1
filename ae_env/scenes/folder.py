"""Scenes from a user's own files: raws and radiance maps in a folder, by a glob, or one by one.

A sequence is a folder of raws that are the frames of one scene over time.
"""

from __future__ import annotations

import glob
import logging
import math
import re
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch

from ae_env.scenes.recorded_files import PREFIX as RECORDED
from ae_env.scenes.scene import Scene, SceneRequest
from ae_env.scenes.split import (
    FEWEST_GROUPS_TO_SPLIT,
    Shot,
    describe,
    group_shots,
    log_groups,
    named_groups,
    scenes_of_split,
    too_few_groups,
)
from simulator.camera import CameraProfile
from simulator.radiance.light import camera_from_srgb, mean_anchor
from simulator.radiance.maps import (
    AZIMUTHS,
    FIELD_OF_VIEW,
    RADIANCE_SUFFIXES,
    assumed_ev100,
    central_square,
    native_size,
    near_one,
    perspective,
    read_radiance,
)
from simulator.raw.read import read_raw
from simulator.utils.checks import check_flag, check_number, check_word
from simulator.utils.files import PICTURE_SUFFIXES, RAW_SUFFIXES

logger = logging.getLogger(__name__)

OnError = Literal["stop", "skip"]
#: Seconds between two log lines about the progress of reading.
_PROGRESS_SECONDS = 10.0
#: Most file names in a log line about files that were skipped.
_MOST_NAMES = 5
_HOW_TO_SKIP = "; --on-error skip, or {'path': ..., 'on_error': 'skip'}, leaves it out"
_RAW_ENDINGS = f"{', '.join(RAW_SUFFIXES[:8])} ..."


@dataclass(frozen=True)
class FolderOptions:
    """Facts about the files that the caller knows, and the rule for files that cannot be read.

    Args:
        illuminance: Light on the subject [lux] of every file, or by file name.
        kind: Kind of the scenes; ``"raw"`` or ``"radiance"`` by default.
        hard: Whether they count as hard.
        median_speed: Median image speed of a moving episode [frame heights / s].
        ev100: EV100 of the radiance maps, in place of the assumed one.
        on_error: What happens where a file cannot be read, or is black without `illuminance`:
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

    def fields(self, path: Path) -> dict[str, Any]:
        """Keyword arguments for the scenes of `path`, a raw or a radiance map."""
        lux = self.illuminance
        if isinstance(lux, Mapping):
            lux = lux.get(path.name)
        given = {"kind": self.kind, "hard": self.hard, "median_speed": self.median_speed}
        given["illuminance"] = lux
        if not _is_raw(path):
            given["ev100"] = self.ev100
        return {name: value for name, value in given.items() if value is not None}


# -- scenes ---------------------------------------------------------------------------------------


def folder_scenes(
    spec: str | Path, request: SceneRequest, options: FolderOptions | None = None
) -> list[Scene]:
    """The scenes of `split` among the user's files.

    The source group of a file is, in this order: the one that ``groups.csv`` beside it names; its
    sub-folder under `spec`; for a radiance map the file itself; for a raw the one that
    `group_shots` finds.

    Args:
        spec: See `find_files`.
        request: Split, camera and size. Each scene is resized before the next file is read.
        options: Facts about the files that the caller knows.

    Raises:
        ValueError: If a file cannot be read (the message names it; with ``on_error="skip"`` only
            if no file can), or `split` is ``"train"`` and there are too few groups to hold any out.
    """
    base, files = find_files(spec)
    named = named_groups(sorted({base, *(p.parent for p in files)}))
    if request.split == "train" and len(files) < FEWEST_GROUPS_TO_SPLIT:
        raise too_few_groups(spec, f"at most {len(files)}")  # before any time is spent on reading
    groups = {p: named[p.resolve()] for p in files if p.resolve() in named}
    reader = _Reader(base, _scene_names(base, files), groups, options or FolderOptions(), request)
    scenes, shots = _read_all(spec, files, reader, _HOW_TO_SKIP)
    found = dict(zip(shots, group_shots(list(shots), list(shots.values())), strict=True))
    scenes = [replace(s, group=found.get(s.scene_id, s.group)) for s in scenes]
    log_groups(str(spec), scenes)
    return scenes_of_split(spec, scenes, request.split)


def sequence_scenes(
    spec: str | Path, request: SceneRequest, options: FolderOptions | None = None
) -> list[Scene]:
    """The frames of every sequence of `split`, one sequence after the other.

    The raws of one folder, in the natural order of their names, are one sequence and one source
    group; its name is the folder's below `spec`. Each raw's light is known through its own
    settings: it may change from frame to frame. Raws in `spec` itself are named after it, or ``.``
    where a folder below has that name.

    Args:
        spec: A folder, searched with its sub-folders, or a glob.
        request: Split and size; fewer than 15 sequences are all for test.
        options: Facts about the files that the caller knows; `on_error` must be ``"stop"``.

    Raises:
        ValueError: If there are no raws, one cannot be read, there are no sequences of `split`, or
            unreadable raws were to be skipped: all later frames would come too early.
    """
    options = options or FolderOptions()
    if options.on_error == "skip":
        raise ValueError(
            "`on_error` (='skip') must be 'stop' for a sequence: without a raw all later ones "
            "would come a frame too early; cut the recording there, into two folders"
        )
    base, found = find_files(spec)
    by_folder: dict[Path, list[Path]] = {}
    for path in filter(_is_raw, found):
        by_folder.setdefault(path.parent, []).append(path)
    if not by_folder:
        raise ValueError(
            f"`scenes` (={{'sequence': {str(spec)!r}}}) must hold raws ({_RAW_ENDINGS}): radiance "
            "maps have no settings of their own"
        )
    if request.split == "train" and len(by_folder) < FEWEST_GROUPS_TO_SPLIT:
        raise too_few_groups(spec, str(len(by_folder)))  # before any time is spent on reading
    files = [path for paths in by_folder.values() for path in paths]
    sequences = _sequence_names(base, list(by_folder))
    groups = {path: sequences[path.parent] for path in files}
    reader = _Reader(base, _scene_names(base, files), groups, options, request)
    scenes, _ = _read_all(spec, files, reader, "")
    scenes = [replace(scene, sequence=scene.group) for scene in scenes]
    log_groups(str(spec), scenes)
    return scenes_of_split(spec, scenes, request.split)


def _sequence_names(base: Path, folders: list[Path]) -> dict[Path, str]:
    names = {folder: folder.relative_to(base).as_posix() for folder in folders}
    own = base.resolve().name
    if base in names and own and own not in names.values():
        names[base] = own  # else "."
    return names


def sequence_bounds(scenes: Sequence[Scene]) -> tuple[np.ndarray, np.ndarray]:
    """First and last frame, (F,) int64 each, of the sequence that each of F frames belongs to.

    Args:
        scenes: As `sequence_scenes` returns them: those of one sequence follow each other. A scene
            of none is one of its own.
    """
    names = [scene.sequence or scene.scene_id for scene in scenes]
    begins = [i for i, name in enumerate(names) if i == 0 or names[i - 1] != name]
    lengths = np.diff([*begins, len(names)])
    first = np.repeat(begins, lengths)
    return first, first + np.repeat(lengths, lengths) - 1


# -- files ----------------------------------------------------------------------------------------


def find_files(spec: str | Path) -> tuple[Path, list[Path]]:
    """The raws and radiance maps that `spec` names, and the folder they are under.

    Args:
        spec: A file, a folder (searched with its sub-folders; hidden ones left out) or a glob.

    Returns:
        The base folder and the files, sorted in natural order (``IMG_2`` before ``IMG_10``).

    Raises:
        ValueError: If there is nothing by that name, or no raw or radiance map in it.
    """
    if str(spec).startswith(RECORDED):
        raise ValueError(
            f"`scenes` (={str(spec)!r}) must be raws or radiance maps here, not a recorded grid"
        )
    try:
        base, found = _listed(spec)
    except (OSError, RuntimeError) as error:  # no permission, no such user, a folder removed ...
        raise ValueError(f"`scenes` (={str(spec)!r}) cannot be listed: {error}") from error
    known = (*RAW_SUFFIXES, *RADIANCE_SUFFIXES)
    files = [
        p
        for p in found
        if p.suffix.lower() in known
        and not any(part.startswith(".") for part in p.relative_to(base).parts)
    ]
    if not files:
        endings = ", ".join(sorted({p.suffix.lower() or "(none)" for p in found}))
        if any(p.suffix.lower() in PICTURE_SUFFIXES for p in found):
            endings += f"; developed pictures of every state are '{RECORDED}FOLDER'"
        raise ValueError(
            f"`scenes` (={str(spec)!r}) must hold raws ({_RAW_ENDINGS}) or radiance maps "
            f"({', '.join(RADIANCE_SUFFIXES)}); "
            + (f"its files end in: {endings}" if endings else "it has no file that can be read")
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


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """Sort key in which numbers count as numbers."""
    parts = re.split(r"(\d+)", path.as_posix().lower())
    return [(0, int(p), "") if p.isdigit() else (1, 0, p) for p in parts]


def _is_raw(path: Path) -> bool:
    return path.suffix.lower() in RAW_SUFFIXES


def _scene_names(base: Path, files: list[Path]) -> dict[Path, str]:
    """Scene ids: the path below `base` without its ending, with it where two would be equal."""
    stems = [p.relative_to(base).with_suffix("").as_posix() for p in files]
    times = Counter(stems)
    return {
        p: stem if times[stem] == 1 else p.relative_to(base).as_posix()
        for p, stem in zip(files, stems, strict=True)
    }


# -- reading --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Reader:
    """Makes the scenes of one file after the other.

    Args:
        base: Folder that the files are under.
        names: Scene id of each file.
        groups: Source group of the files whose group is known by name.
        options: See `folder_scenes`.
        request: See `folder_scenes`.
    """

    base: Path
    names: Mapping[Path, str]
    groups: Mapping[Path, str]
    options: FolderOptions
    request: SceneRequest

    def read(self, path: Path) -> tuple[list[Scene], Shot | None]:
        """The scenes of a file; with a `Shot` where that has to tell the group of a raw."""
        name, group = self.names[path], self.groups.get(path)
        grouped = group is not None or path.parent != self.base
        if group is None:
            group = path.parent.relative_to(self.base).as_posix() if grouped else name
        fields, shot = self.options.fields(path), None
        if _is_raw(path):
            raw = read_raw(path)
            source = f"{path.name}; noise: {raw.metadata.get('nlf_source', 'unknown')}"
            scene = Scene.from_raw(raw, scene_id=name, group=group, source=source, **fields)
            shot = None if grouped else describe(raw)
            scenes = [self.request.sized(scene)]
        else:
            scenes = list(radiance_scenes(path, self.request, name=name, group=group, **fields))
        for scene in scenes:
            _ = scene.ev100  # raises where a frame is black and its light unknown
        return scenes, shot


def _read_all(
    spec: str | Path, files: list[Path], reader: _Reader, hint: str
) -> tuple[list[Scene], dict[str, Shot]]:
    """The scenes of all `files`, and the shots of those raws whose group is still to be found.

    `hint` ends the error of a file that cannot be read, where there are others.
    """
    scenes: list[Scene] = []
    shots: dict[str, Shot] = {}
    skipped: dict[Path, Exception] = {}
    for path in _with_progress(spec, files):
        try:
            own, shot = reader.read(path)
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
    """Logs the files that were left out; raises where none was read."""
    if not skipped:
        return
    reasons = [f"{path.name}: {error}" for path, error in list(skipped.items())[:_MOST_NAMES]]
    if len(skipped) > _MOST_NAMES:
        reasons.append(f"and {len(skipped) - _MOST_NAMES} more")
    text = "; ".join(reasons)
    if len(skipped) == total:
        raise ValueError(
            f"`scenes` (={str(spec)!r}) must hold a file that can be read, but all {total} were "
            f"skipped ({text})"
        )
    logger.warning("%s: %d of %d scene files skipped (%s)", spec, len(skipped), total, text)


# -- radiance maps ---------------------------------------------------------------------------------


def radiance_scenes(
    path: str | Path,
    request: SceneRequest,
    *,
    name: str,
    group: str,
    ev100: float | None = None,
    **fields: Any,
) -> Iterator[Scene]:
    """The scenes of one radiance map, all in one source group.

    A radiance map is linear but relative: nothing in it says how many lux it shows. Its views are
    therefore put at an EV100 between 3 and 14 drawn by a stable hash of the source group (an
    assumption, stated in each scene's `source`), and their `illuminance` is None unless given.

    A picture twice as wide as high (to 1 %) is an equirectangular panorama and gives four views
    with a field of view of 60 degrees; any other gives its central square. Both have about 256
    packed pixels a side, as the bundled scenes have, before `Scene.resized`. A map with at least as
    many pixels there as photosites (512 x 512) is sampled through the colour filter array, so is a
    coarser one with ``crop="native"`` if it has those of the crop; of others the planes share their
    places, and the log says so (`Scene.sampled`).

    Args:
        path: The file.
        request: Camera and size; without a resolution the views have 256 packed pixels a side.
        name: Prefix of the scene ids.
        group: Source group.
        ev100: The EV100 at which the views' mean is 0.12 (on average over the views, which keep
            their relative brightness), if known; see `assumed_ev100`.
        **fields: Further arguments of `Scene.from_radiance`.
    """
    image = read_radiance(path)
    if "illuminance" not in fields:
        image = near_one(image)
    height, width = image.shape[1:]
    if "illuminance" not in fields and ev100 is None:
        ev100 = assumed_ev100(group)
        fields.setdefault("source", f"{Path(path).name}; light of unknown scale, EV100 assumed")
    fields.setdefault("source", Path(path).name)
    if abs(width / height - 2.0) <= 0.01:
        available = int(width / math.pi * math.tan(math.radians(FIELD_OF_VIEW) / 2.0))
        size, sampled = _view_size(request, native_size(request.resolution), available)
        views = [(f"{name}-{round(a):03d}", perspective(image, a, size)) for a in AZIMUTHS]
    else:
        available = min(height, width)
        size = native_size(request.resolution, available)
        size, sampled = _view_size(request, size, available)
        views = [(name, central_square(image, size, Path(path).name))]
    if not sampled:
        logger.info(
            "radiance map %s: %d pixels a view, fewer than photosites: planes share their places",
            *(Path(path).name, available),
        )
    try:
        levels = [_log2_level(view, request.camera) for _, view in views]
    except ValueError as error:
        raise ValueError(f"radiance map {str(path)!r}: {error}") from error
    for (scene_id, view), level in zip(views, levels, strict=True):
        if ev100 is not None:  # one scale for the whole map: a darker view stays darker
            fields["ev100"] = ev100 + level - float(np.mean(levels))
        try:
            scene = Scene.from_radiance(
                view, request.camera, scene_id=scene_id, group=group, sampled=sampled, **fields
            )
        except ValueError as error:
            raise ValueError(f"radiance map {str(path)!r}, view {scene_id!r}: {error}") from error
        yield request.sized(scene)


def _view_size(request: SceneRequest, size: int, available: int) -> tuple[int, bool]:
    """Pixels a side of a view of `size` packed pixels, and whether they are photosites."""
    if available >= 2 * size:
        return 2 * size, True
    if request.crop == "native" and request.resolution and available >= 2 * request.resolution:
        return available // 2 * 2, True
    return size, False


def _log2_level(view: np.ndarray, camera: CameraProfile) -> float:
    """log2 of the mean of a view's green, clipped at white, relative to 0.12."""
    matrix, _ = camera_from_srgb(camera)
    green = torch.from_numpy(np.tensordot(matrix[1], view, axes=1))
    return -math.log2(mean_anchor(green))
