"""The one cache: recently used results in memory, and tensors in files between runs."""

from __future__ import annotations

import functools
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
from simulator.utils.results import package_version

_LOGGER = logging.getLogger(__name__)
#: Environment variable that names another cache folder.
CACHE_VARIABLE = "AE_ENV_CACHE"
#: The cache's folders (score tables are of earlier versions); files elsewhere are never removed.
CACHE_KINDS = ("scenes", "score_tables", "denoised", "defocus_maps", "opened")
#: Most bytes that the files take together.
DISK_BYTES = 4 * 2**30
#: Names of the cache's files, finished and half-written, of earlier versions as well; no other
#: file is ever removed.
_FILE = re.compile(r"\.?(bundled-.*-)?[0-9a-f]{24,32}\.(safetensors|npz)(\..*\.tmp)?")
#: A half-written file older than this was left by a killed process [s].
_ABANDONED = 3600.0

Value = TypeVar("Value")


def cache_dir() -> Path:
    """The cache folder: the one that ``AE_ENV_CACHE`` names, else the user's; not created here."""
    named = os.environ.get(CACHE_VARIABLE)
    return Path(os.path.expanduser(named) if named else platformdirs.user_cache_dir("ae-env"))


def cache_key(parts: Mapping[str, Any]) -> str:
    """Hexadecimal key of a cached result: of all that it depends on, and the package's version.

    Args:
        parts: JSON values by name; the order of the names does not matter.

    >>> cache_key({"a": 1, "b": 2}) == cache_key({"b": 2, "a": 1}) != cache_key({"a": 1, "b": 3})
    True
    """
    content = {"package": package_version(), "parts": dict(parts)}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
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
        max_bytes: Most bytes of all values together; a larger value is not stored.

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
        """Bytes of all values together."""
        return self._bytes

    def get(self, key: Hashable) -> Value | None:
        """The value of `key`, now the most recently used; None where there is none."""
        with self._lock:
            if key not in self._items:
                return None
            self._items.move_to_end(key)
            return self._items[key][0]

    def put(self, key: Hashable, value: Value, size: int) -> None:
        """Store `value` of `size` bytes, and drop the least recently used beyond the bound."""
        with self._lock:
            self._bytes -= self._items.pop(key, (None, 0))[1]
            if size > self.max_bytes:
                return
            self._items[key] = (value, size)
            self._bytes += size
            while self._bytes > self.max_bytes:
                self._bytes -= self._items.popitem(last=False)[1][1]

    def clear(self) -> None:
        """Drop everything."""
        with self._lock:
            self._items.clear()
            self._bytes = 0

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.max_bytes,)


class DiskCache:
    """Tensors in safetensors files between runs; several processes may share the folder.

    Files are written whole or not at all. A damaged file, or a folder that cannot be read or
    written, is logged and costs time only.

    Args:
        folder: By default `cache_dir()` at the time of each call.
        max_bytes: Most bytes of all files together; beyond it those used longest ago are removed.
            Several processes at once may exceed it by a sixteenth each.
    """

    def __init__(self, folder: Path | None = None, *, max_bytes: int = DISK_BYTES) -> None:
        if max_bytes < 0:
            raise ValueError(f"`max_bytes` (={max_bytes}) must be at least 0")
        self._folder, self.max_bytes = folder, max_bytes
        self._uncounted: int | None = None  # bytes written since the files were last counted

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
            content = path.read_bytes()  # at once: another process may remove the file
            tensors = load(content)
            # The header is JSON after eight bytes of its length.
            header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
            if header.get("__metadata__", {}).get("digest") != content_digest(tensors):
                raise ValueError("its content is not what was written")
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            _warn_once(f"the cache in {self.folder} cannot be read: {error.strerror or error}")
            return None
        except (SafetensorError, ValueError) as error:
            _LOGGER.warning("cached file %s is damaged (%s) and is made again", path, error)
            return None
        with suppress(OSError):
            os.utime(path)  # used just now
        return tensors

    def put(self, kind: str, key: str, tensors: Mapping[str, torch.Tensor]) -> None:
        """Store `tensors` under `key`; the arguments are those of `get`."""
        path = self.path(kind, key)
        own = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
        content = save(own, {"digest": content_digest(own)})
        if len(content) > self.max_bytes:
            return
        try:
            write_atomically(path, content)
        except OSError as error:  # a full or read-only disk must not stop the run
            reason = os.strerror(error.errno) if error.errno else error
            _warn_once(f"results could not be cached in {self.folder}: {reason}")
            return
        # Counting files takes longer than writing one: count when a sixteenth was written.
        uncounted = None if self._uncounted is None else self._uncounted + len(content)
        if uncounted is None or uncounted >= self.max_bytes // 16:
            self._trim()
            uncounted = 0
        self._uncounted = uncounted

    def usage(self) -> dict[str, tuple[int, int]]:
        """Number of files and bytes by kind."""
        sizes = {kind: [s.st_size for _, s in self._files(kind)] for kind in CACHE_KINDS}
        return {kind: (len(own), sum(own)) for kind, own in sizes.items()}

    def clear(self) -> None:
        """Remove all files of the cache, and its folders where nothing else is in them.

        Raises:
            OSError: If a file cannot be removed.
        """
        for kind in CACHE_KINDS:
            for path, _ in self._files(kind):
                path.unlink(missing_ok=True)
            with suppress(OSError):
                (self.folder / kind).rmdir()

    def _files(self, kind: str) -> Iterator[tuple[Path, os.stat_result]]:
        with suppress(OSError):  # no such folder, or one that may not be listed
            for path in sorted((self.folder / kind).iterdir()):
                with suppress(OSError):  # another process has removed it
                    if _FILE.fullmatch(path.name):
                        yield path, path.stat()

    def _trim(self) -> None:
        """Remove the files used longest ago until a sixteenth of the bound is free.

        So the bound holds until the files are counted again.
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


@functools.cache
def _warn_once(message: str) -> None:
    """Log a warning the first time in this process."""
    _LOGGER.warning(message)
