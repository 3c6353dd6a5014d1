"""Recorded sequences as scenes: raws in the order of their names are the frames of an episode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ae_env.scenes.folder import (
    FolderOptions,
    Reader,
    find_files,
    of_split,
    read_all,
    scene_names,
    too_few_groups,
)
from ae_env.scenes.grouping import FEWEST_GROUPS_TO_SPLIT, log_groups
from ae_env.scenes.scene import Crop, Resize, Scene
from simulator.camera import CameraProfile
from simulator.files import RAW_SUFFIXES


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
