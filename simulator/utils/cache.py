"""Results that are kept: the most recent in memory, and files between runs, both bounded."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
import threading
import time
from collections import OrderedDict
from collections.abc import Hashable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Generic, TypeVar

import platformdirs
import torch
from safetensors import SafetensorError
from safetensors.torch import load, save

from simulator.utils.files import write_atomically

_LOGGER = logging.getLogger(__name__)
#: Environment variable that names another cache folder.
CACHE_VARIABLE = "AE_ENV_CACHE"
#: The cache's folders: what is not in one of them is never removed.
CACHE_KINDS = ("scenes", "score_tables", "denoised", "defocus_maps", "opened")
#: What the files on disk take at most, together [byte].
DISK_BYTES = 4 * 2**30
#: Names of the cache's files, finished and half-written; nothing else is ever removed.
_FILE = re.compile(r"\.?(bundled-.*-)?[0-9a-f]{24,32}\.(safetensors|npz)(\..*\.tmp)?")
#: A half-written file older than this was left by a killed process [s].
_ABANDONED = 3600.0

#: Folders of which it was logged that they cannot be used.
_WARNED: set[Path] = set()

Value = TypeVar("Value")


def cache_dir() -> Path:
    """The cache folder: the one named by ``AE_ENV_CACHE``, else the user's (not created here).

    The user's, too, where the name begins with the home of somebody unknown.
    """
    named, own = os.environ.get(CACHE_VARIABLE), Path(platformdirs.user_cache_dir("ae-env"))
    try:
        return Path(named).expanduser() if named else own
    except RuntimeError as error:
        _warn_once(Path(str(named)), "%s (=%r): %s; using %s", CACHE_VARIABLE, named, error, own)
        return own


def _warn_once(folder: Path, message: str, *values: object) -> None:
    """Logs what is wrong with a cache folder, as a warning the first time in this process."""
    level = logging.DEBUG if folder in _WARNED else logging.WARNING
    _LOGGER.log(level, message, *values)
    _WARNED.add(folder)


def cache_key(parts: Mapping[str, Any]) -> str:
    """Hexadecimal key of everything that changes a cached result.

    Args:
        parts: JSON values by name; the order of the names does not matter.

    >>> cache_key({"a": 1, "b": 2}) == cache_key({"b": 2, "a": 1}) != cache_key({"a": 1, "b": 3})
    True
    """
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:24]


def content_digest(tensors: Mapping[str, torch.Tensor]) -> str:
    """Hexadecimal SHA-256 of the tensors' names, types, shapes and values, whatever their layout.

    >>> grey = torch.full((2, 3), 0.18)
    >>> content_digest({"light": grey}) == content_digest({"light": grey.T.contiguous().T})
    True
    """
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name].detach()
        digest.update(f"{name}:{tensor.dtype}:{tuple(tensor.shape)};".encode())
        flat = tensor.cpu().contiguous().reshape(-1)  # a single number cannot be viewed as bytes
        digest.update(flat.view(torch.uint8).numpy().data)
    return digest.hexdigest()


class LruCache(Generic[Value]):
    """The most recently used values in memory; safe to share between threads.

    A pickled copy is empty.

    Args:
        max_bytes: What the values may take together; a larger one is not kept.

    >>> cache = LruCache(max_bytes=2)
    >>> for name in "abc":
    ...     cache.put(name, name.upper(), 1)
    >>> cache.get("a"), cache.get("c"), len(cache), cache.nbytes
    (None, 'C', 2, 2)
    """

    def __init__(self, max_bytes: int) -> None:
        if max_bytes < 0:
            raise ValueError(f"`max_bytes` (={max_bytes}) must be at least 0")
        self.max_bytes = max_bytes
        self._items: OrderedDict[Hashable, tuple[Value, int]] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._items)

    @property
    def nbytes(self) -> int:
        """What the values take [byte]."""
        return self._bytes

    def get(self, key: Hashable) -> Value | None:
        """The value of `key`, now the most recently used; None where there is none."""
        with self._lock:
            if key not in self._items:
                return None
            self._items.move_to_end(key)
            return self._items[key][0]

    def put(self, key: Hashable, value: Value, size: int) -> None:
        """Keeps `value` of `size` bytes, and drops the least recently used beyond the bound."""
        with self._lock:
            self._bytes -= self._items.pop(key, (None, 0))[1]
            if size > self.max_bytes:
                return
            self._items[key] = (value, size)
            self._bytes += size
            while self._bytes > self.max_bytes:
                self._bytes -= self._items.popitem(last=False)[1][1]

    def clear(self) -> None:
        """Drops everything."""
        with self._lock:
            self._items.clear()
            self._bytes = 0

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.max_bytes,)


class DiskCache:
    """Tensors in files between runs; several processes may share the folder.

    Files are written whole or not at all, and read only if their content is what was written
    under that key. A file that is damaged, or a folder that cannot be read or written (once in a
    process), is logged and costs time only.

    Args:
        folder: By default `cache_dir()` at the time of each call.
        max_bytes: What the files may take together; beyond it those go that were used longest ago.
            Several processes at once may exceed it by a sixteenth each.
    """

    def __init__(self, folder: Path | None = None, *, max_bytes: int = DISK_BYTES) -> None:
        if max_bytes < 0:
            raise ValueError(f"`max_bytes` (={max_bytes}) must be at least 0")
        self._folder, self.max_bytes = folder, max_bytes
        self._unseen: int | None = None  # bytes written since the files were last counted

    @property
    def folder(self) -> Path:
        """Where the files are."""
        return cache_dir() if self._folder is None else self._folder

    def path(self, kind: str, key: str) -> Path:
        """The file of `key`.

        Raises:
            ValueError: If `kind` is none of `CACHE_KINDS`.
        """
        if kind not in CACHE_KINDS:
            raise ValueError(f"`kind` (={kind!r}) must be one of {list(CACHE_KINDS)}")
        return self.folder / kind / f"{key}.safetensors"

    def get(self, kind: str, key: str) -> dict[str, torch.Tensor] | None:
        """The tensors of `key` by name; None if they are not there or damaged.

        Args:
            kind: One of `CACHE_KINDS`.
            key: As `cache_key` makes it.
        """
        path = self.path(kind, key)
        try:
            content = path.read_bytes()  # at once: another process may remove it
            tensors = load(content)
            stored = _stored(content)
            if stored.get("digest") != content_digest(tensors):
                raise ValueError("its content is not what was written")
            if stored.get("key", key) != key:  # earlier versions wrote none
                raise ValueError(f"it was written as {stored['key']}")
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            _warn_once(self.folder, "cached file %s cannot be read: %s", path, error)
            return None
        except (SafetensorError, ValueError) as error:
            _LOGGER.warning("cached file %s is damaged (%s) and is made again", path, error)
            return None
        with suppress(OSError):
            os.utime(path)  # used just now
        return tensors

    def put(self, kind: str, key: str, tensors: Mapping[str, torch.Tensor]) -> None:
        """Keeps `tensors`; see `get`."""
        path = self.path(kind, key)
        own = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
        content = save(own, {"digest": content_digest(own), "key": key})
        if len(content) > self.max_bytes:
            return
        try:
            write_atomically(path, content)
        except OSError as error:  # a full or read-only disk must not stop the run
            _warn_once(self.folder, "%s could not be cached: %s", path, error)
            return
        unseen = None if self._unseen is None else self._unseen + len(content)
        if unseen is None or unseen >= self.max_bytes // 16:
            self._trim()
            unseen = 0
        self._unseen = unseen

    def usage(self) -> dict[str, tuple[int, int]]:
        """Number of files and bytes by kind."""
        sizes = {kind: [s.st_size for _, s in self._files(kind)] for kind in CACHE_KINDS}
        return {kind: (len(own), sum(own)) for kind, own in sizes.items()}

    def clear(self) -> None:
        """Removes all files of the cache, and its folders where nothing else is in them.

        Raises:
            OSError: If a file cannot be removed.
        """
        for kind in CACHE_KINDS:
            for path, _ in self._files(kind):
                path.unlink(missing_ok=True)
            with suppress(OSError):
                (self.folder / kind).rmdir()

    def _files(self, kind: str) -> Iterator[tuple[Path, os.stat_result]]:
        folder = self.folder / kind
        try:
            names = os.listdir(folder)
        except OSError:  # not there, or nothing that can be listed
            return
        for name in sorted(names):
            with suppress(OSError):  # removed by another process since
                if _FILE.fullmatch(name):
                    yield folder / name, (folder / name).stat()

    def _trim(self) -> None:
        """Removes what was used longest ago until a sixteenth of the bound is free.

        So the bound holds until the files are counted again, when a sixteenth was written.
        """
        files = [found for kind in CACHE_KINDS for found in self._files(kind)]
        total = sum(stat.st_size for _, stat in files)
        recent = time.time() - _ABANDONED
        for path, stat in sorted(files, key=lambda f: max(f[1].st_atime_ns, f[1].st_mtime_ns)):
            if total <= self.max_bytes - self.max_bytes // 16:
                return
            if path.suffix == ".tmp" and stat.st_mtime > recent:
                continue  # another process is writing it
            with suppress(OSError):
                path.unlink()
                total -= stat.st_size


def _stored(content: bytes) -> dict[str, str]:
    """What was written beside the tensors: in the header, JSON after eight bytes of its length."""
    length = int.from_bytes(content[:8], "little")
    return json.loads(content[8 : 8 + length]).get("__metadata__", {})
