"""Finished parts of an evaluation in files, so that a stopped run can resume.

A part's name is a hash of everything that decides its content: the version of this package, the
plan's entries, the scenes' light, and the files of policies, scorers and lightings of a user's own.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import lzma
import struct
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from agents.evaluation.evaluation_plan import digest
from agents.policy_names import (
    FORECASTERS,
    LEARNT,
    split_class,
    split_options,
    training_seeds,
    weight_files,
)
from simulator.utils.files import sibling, write_atomically
from simulator.utils.results import package_version

if TYPE_CHECKING:
    from ae_env.scenes import Scene

logger = logging.getLogger(__name__)

#: Increased when the layout of a file changes.
_LAYOUT = 3
#: Python files beside one's own that count as parts of it.
_MAX_NEIGHBOURS = 200
#: Errors that reading a damaged file can end in.
_DAMAGED = (
    *(ArithmeticError, EOFError, LookupError, MemoryError, OSError, RuntimeError, ValueError),
    *(lzma.LZMAError, struct.error, zipfile.BadZipFile, zlib.error),
)


class EvaluationStore:
    """Finished parts of an evaluation, one ``.npz`` each, without pickles.

    Args:
        folder: Made where missing.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)

    def path(self, key: str) -> Path:
        """File of a part."""
        return self.folder / f"{key}.npz"

    def has(self, key: str) -> bool:
        """Whether the part is there and readable."""
        return self.load(key) is not None

    def load(self, key: str) -> tuple[dict[str, NDArray[Any]], dict[str, Any]] | None:
        """Arrays and JSON values of a part; None where there is none, or it is damaged."""
        file = self.path(key)
        try:
            return _read(file.read_bytes())
        except FileNotFoundError:
            return None
        except _DAMAGED as error:
            logger.warning("%s is damaged and is measured again: %s", file, error)
            return None

    def save(
        self, key: str, arrays: Mapping[str, NDArray[Any]], meta: Mapping[str, Any] | None = None
    ) -> Path:
        """Writes a part under a temporary name, then renames it."""
        stream = io.BytesIO()
        text = json.dumps({"digest": _arrays_digest(arrays), **(meta or {})}, sort_keys=True)
        content: dict[str, Any] = {"meta": np.array(text), **arrays}
        np.savez_compressed(stream, **content)
        return write_atomically(self.path(key), stream.getvalue())


def _read(content: bytes) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    # The checksums first: the header of a damaged array might ask for any amount of memory.
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        damaged = archive.testzip()
        if damaged is not None:
            raise ValueError(f"the checksum of {damaged!r} is wrong")
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    meta = json.loads(str(arrays.pop("meta")))
    if meta.pop("digest") != _arrays_digest(arrays):  # the list of the arrays has no checksum
        raise ValueError("arrays are missing")
    return arrays, meta


def _arrays_digest(arrays: Mapping[str, NDArray[Any]]) -> str:
    found = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        found.update(f"{name}\0{array.dtype.str}\0{array.shape}\0".encode() + array.tobytes())
    return found.hexdigest()


def part_key(kind: str, *parts: object) -> str:
    """Name of a part: its kind and a hash of this package's version and of JSON values `parts`."""
    return f"{kind}-{digest(_LAYOUT, package_version(), *parts)[:32]}"


def scene_content(scenes: Sequence[Scene]) -> list[Any]:
    """JSON values that change with the scenes."""
    return [
        [
            *(s.scene_id, s.group, s.kind, s.hard, s.content, s.median_speed, s.box_factor),
            # Computed again, these may differ in the last bit from those of the cache.
            *(round(value, 5) for value in (s.ev100, s.reference.log2_exposure, *s.white_balance)),
            None if s.allowed is None else np.flatnonzero(~s.allowed).tolist(),
        ]
        for s in scenes
    ]


def file_content(spec: Any) -> list[str]:
    """Hashes of the files that a scorer's or a lighting's specification names.

    Args:
        spec: A name, or a mapping of names to weights or from options to files.
    """
    names: list[Any] = [spec]
    if isinstance(spec, Mapping):
        names = [*spec, *spec.values()]
    return [policy_content(name) for name in names if isinstance(name, str)]


def policy_content(name: str) -> str:
    """Hash of the files that decide a policy: its module, weights and folders; "" without any.

    With a Python file, all others of its folder count, since it may import them; data that it reads
    is not known.

    Args:
        name: As `agents.make_policy` takes it; the name of a scorer or a file works as well.
    """
    base, options = split_options(name)
    files = _own_files(base) or _named_files(base)
    for value in options.values():
        files += _named_files(str(value))
        if value == LEARNT:
            files += [Path(f"{file}.safetensors") for file in weight_files(FORECASTERS)]
    if not files:
        return ""
    found = hashlib.sha256()
    for file in files:
        content = file.read_bytes() if file.is_file() else b""
        found.update(f"{file.name}\0{len(content)}\0".encode() + content)
    return found.hexdigest()


def _own_files(base: str) -> list[Path]:
    head, tail = split_class(base)
    if head.endswith(".py"):
        return _with_neighbours(Path(head).expanduser())
    if head in ("ppo", "regression"):
        names = training_seeds(base)
        return [file for name in names for file in _named_files(name.partition(":")[2])]
    if head == "recorded":
        return _named_files(tail)
    if tail and "." in head:
        try:
            found = find_spec(head)
        except (ImportError, ValueError):
            found = None
        if found is not None and found.origin is not None:
            return _with_neighbours(Path(found.origin))
    return []


def _with_neighbours(file: Path) -> list[Path]:
    """A Python file, and the first `_MAX_NEIGHBOURS` others of its folder by name."""
    others = sorted(other for other in file.parent.glob("*.py") if other.name != file.name)
    return [file, *others[:_MAX_NEIGHBOURS]]


def _named_files(text: str) -> list[Path]:
    """The file of this name, the two of an agent, or all in a folder; none where there is none."""
    path = Path(text).expanduser()
    if path.is_dir():
        return sorted(file for file in path.rglob("*") if file.is_file())
    pair = [sibling(path, end) for end in (".safetensors", ".json")] if path.name else []
    return [file for file in (path, *pair) if file.is_file()]
