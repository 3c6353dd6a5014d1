"""The scenes that a page offers: named ones, or the files of a folder, each read when opened."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from ae_env.scenes import Scene, load_scenes
from ae_env.scenes.folder import find_files
from ae_env.scenes.recorded import PREFIX
from simulator import RawImage, get_camera, read_raw
from simulator.radiance.maps import RADIANCE_SUFFIXES
from simulator.raw.develop import quarter_turns
from simulator.utils.checks import did_you_mean
from simulator.utils.files import RAW_SUFFIXES

#: Camera in whose colours named scenes and radiance maps are made, as the environment's default.
CAMERA = "nikon_z6"
#: Scenes kept in memory: a raw of 24 megapixels takes 0.1 GB, with its noise reduced twice that.
_KEPT = 4
#: Most files that an error names.
_MOST_NAMED = 8


@dataclass(frozen=True)
class Shown:
    """A scene to look at.

    Args:
        scene: At its finest resolution.
        turns: Quarter turns to the left that turn its picture upright.
        raw: The photograph that it is; None for a scene that is none.
    """

    scene: Scene
    turns: int = 0
    raw: RawImage | None = None


@dataclass(frozen=True)
class Entry:
    """One scene of a library.

    Args:
        name: Shown in the picker.
        read: Reads the scene.
    """

    name: str
    read: Callable[[], Shown]


class Library:
    """Scenes by name.

    Args:
        entries: At least one.
        first: Name of the one to open first; that of the first entry by default.
    """

    def __init__(self, entries: Sequence[Entry], first: str | None = None) -> None:
        self.entries = {entry.name: entry for entry in entries}
        self.first = entries[0].name if first is None else first
        self._lock = threading.Lock()
        self._read: OrderedDict[str, Shown] = OrderedDict()

    @property
    def names(self) -> list[str]:
        """Names of the scenes, in order."""
        return list(self.entries)

    def add(self, path: Path, name: str) -> str:
        """Adds the raw at `path`; returns the name it got, `name` with a number where taken.

        Raises:
            ValueError: If the file is no raw that can be read.
        """
        shown = _read_raw(path, name)
        own, number = name, 1
        while own in self.entries:
            number += 1
            own = f"{name} ({number})"
        self.entries[own] = Entry(own, partial(_read_raw, path, name))
        self._keep(own, shown)
        return own

    def open(self, name: str) -> Shown:
        """The scene called `name`."""
        with self._lock:
            if name in self._read:
                self._read.move_to_end(name)
                return self._read[name]
        shown = self.entries[name].read()
        self._keep(name, shown)
        return shown

    def _keep(self, name: str, shown: Shown) -> None:
        with self._lock:
            self._read[name] = shown
            while len(self._read) > _KEPT:
                self._read.popitem(last=False)


def _read_raw(path: Path, name: str) -> Shown:
    raw = read_raw(path)
    return Shown(Scene.from_raw(raw, scene_id=name), quarter_turns(raw), raw)


def find_scenes(what: str) -> Library:
    """The library of what ``ae-env view`` was asked to show.

    Args:
        what: A raw or radiance map, a folder or glob of them, scenes as `load_scenes` takes them
            (of a recorded grid the light that its captures tell together), or the id of a bundled
            scene.

    Raises:
        ValueError: If it is none of these.
    """
    known = (*RAW_SUFFIXES, *RADIANCE_SUFFIXES)
    looks_like_files = Path(what).suffix.lower() in known or any(s in what for s in "/*?")
    if Path(what).exists() or (looks_like_files and not what.startswith(PREFIX)):
        base, files = find_files(what)
        entries: list[Entry] = []
        for path in files:
            if path.suffix.lower() in RADIANCE_SUFFIXES:
                entries += _named(_load(str(path)))
            else:
                name = str(path.relative_to(base)) if path.is_relative_to(base) else path.name
                name = path.name if name == "." else name
                entries.append(Entry(name, partial(_read_raw, path, name)))
        return Library(entries, _first_readable(what, entries))
    try:
        scenes = _load(what)
    except ValueError:
        if what.startswith(PREFIX):
            raise
        bundled = _load("bundled")
        ids = [scene.scene_id for scene in bundled]
        if what in ids:
            return Library(_named(bundled), what)
        hint = did_you_mean(what, ids)
        raise ValueError(
            f"`what` (={what!r}) must be a raw, a radiance map, a folder, scenes such as bundled, "
            f"or the id of a bundled scene, such as {ids[0]}{hint}"
        ) from None
    return Library(_named(scenes))


def _first_readable(what: str, entries: Sequence[Entry]) -> str:
    """Name of the first scene that can be read: files are refused here, not on an empty page.

    Raises:
        ValueError: If none can; names them.
    """
    broken: list[str] = []
    for entry in entries:
        try:
            entry.read()
        except (ValueError, OSError) as error:
            broken.append(f"{entry.name}: {error}")
            continue
        return entry.name
    named = "; ".join(broken[:_MOST_NAMED])
    if len(broken) > _MOST_NAMED:
        named += f"; and {len(broken) - _MOST_NAMED} more"
    raise ValueError(f"`what` (={what!r}) must hold a raw that can be read, but none can: {named}")


def _load(spec: Any) -> list[Scene]:
    return load_scenes(spec, "all", camera=get_camera(CAMERA), resolution=None)


def _named(scenes: Sequence[Scene]) -> list[Entry]:
    return [Entry(scene.scene_id, partial(Shown, scene)) for scene in scenes]
