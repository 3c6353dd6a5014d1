"""Results that are kept: the most recently used in memory, and files between runs."""

import functools
import glob
import hashlib
import json
import logging
import math
import os
import re
import threading
import time
from collections import OrderedDict
from collections.abc import Hashable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import platformdirs
import torch
from safetensors import SafetensorError
from safetensors.torch import load, save

from simulator import __version__
from simulator.utils.checks import check_integer
from simulator.utils.files import write_atomically

_LOGGER = logging.getLogger(__name__)
#: Environment variable that names another cache folder.
CACHE_VARIABLE = "AE_ENV_CACHE"
#: Most bytes of what all runs of a user share.
DISK_BYTES = 4 * 2**30
#: Names of a store's files, finished and half-written, of earlier versions as well; no other file
#: is ever removed.
_FILE = re.compile(r"\.?(bundled-.*-)?[0-9a-f]{24,32}\.(safetensors|npz)(\..*\.tmp)?")
#: A half-written file older than this was left by a killed process [s].
_ABANDONED = 3600.0

#: Most dimensions of a tensor in a file: for 70,000 torch needs a minute.
_MOST_DIMENSIONS = 8
#: What `safetensors_header` and `decode` may raise, and safetensors for what it cannot make.
DAMAGE = (SafetensorError, ValueError, LookupError, TypeError, AttributeError, RuntimeError)

Value = TypeVar("Value")


def cache_dir() -> Path:
    """The cache folder: the one that ``AE_ENV_CACHE`` names, else the user's; not created here."""
    named = os.environ.get(CACHE_VARIABLE)
    return Path(os.path.expanduser(named) if named else platformdirs.user_cache_dir("ae-env"))


def cache_key(kind: str, parts: Any) -> str:
    """Key of a result: its kind (a folder), and a hash of the package's version and `parts`.

    These are a JSON value of all that the result depends on.
    """
    content = {"package": __version__, "parts": parts}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return f"{kind}/{hashlib.sha256(text.encode()).hexdigest()[:24]}"


def content_digest(tensors: Mapping[str, torch.Tensor]) -> str:
    """SHA-256 of the tensors' names, types, shapes and values, whatever their layout, as text."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name].detach()
        digest.update(f"{name}:{tensor.dtype}:{tuple(tensor.shape)};".encode())
        flat = tensor.cpu().contiguous().reshape(-1)  # a single number cannot be viewed as bytes
        digest.update(flat.view(torch.uint8).numpy().data)
    return digest.hexdigest()


class LruCache(Generic[Value]):
    """The most recently used values in memory; safe to share between threads.

    They have at most `max_bytes` together; a larger value is not stored. A pickled copy is empty.
    """

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes = check_integer("max_bytes", max_bytes, 0)
        self._items: OrderedDict[Hashable, tuple[Value, int]] = OrderedDict()
        self.nbytes = 0  # of all values together
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._items)

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
            self.nbytes -= self._items.pop(key, (None, 0))[1]
            if size > self.max_bytes:
                return
            self._items[key] = (value, size)
            self.nbytes += size
            while self.nbytes > self.max_bytes:
                self.nbytes -= self._items.popitem(last=False)[1][1]

    def clear(self) -> None:
        """Drop everything."""
        with self._lock:
            self._items.clear()
            self.nbytes = 0

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.max_bytes,)


class Store:
    """Results in files, for later runs: named tensors, arrays and JSON values by key.

    A result is one safetensors file without pickles, JSON values in its header. It is written whole
    or not at all; several processes may share the folder. A damaged file, or a folder that cannot
    be read, is logged and costs time only. Beyond `max_bytes` of all files, if given, those used
    longest ago are removed; each of several processes may exceed it by a sixteenth. Then a folder
    that cannot be written costs time only, too; else `put` raises an `OSError`.
    """

    def __init__(self, folder: Path, *, max_bytes: int | None = None) -> None:
        if max_bytes is not None:
            check_integer("max_bytes", max_bytes, 0)
        self.folder, self.max_bytes = Path(folder), max_bytes
        self._uncounted = math.inf  # bytes written since the files were last counted

    def path(self, key: str) -> Path:
        """The file of a result."""
        return self.folder / f"{key}.safetensors"

    def get(self, key: str) -> dict[str, Any] | None:
        """The values under a `cache_key` as `put` got them; None if missing or damaged."""
        path = self.path(key)
        try:
            content = path.read_bytes()  # at once: another process may remove the file
            values = decode(content)
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            _warn_once(f"results in {self.folder} cannot be read: {error.strerror or error}")
            return None
        except DAMAGE as error:
            _LOGGER.warning("%s is damaged (%s) and is made again", path, error)
            return None
        with suppress(OSError):
            os.utime(path)  # used just now
        return values

    def put(self, key: str, values: Mapping[str, Any]) -> None:
        """Stores tensors, numpy arrays of numbers and JSON values under a `cache_key`."""
        content = encode(values)
        if self.max_bytes is not None and len(content) > self.max_bytes:
            return
        try:
            write_atomically(self.path(key), content)
        except OSError as error:
            if self.max_bytes is None:
                raise
            # A full or read-only disk must not stop a run that could do without.
            reason = os.strerror(error.errno) if error.errno else error
            _warn_once(f"results could not be stored in {self.folder}: {reason}")
            return
        if self.max_bytes is None:
            return
        # Counting files takes longer than writing one: count when a sixteenth was written.
        self._uncounted += len(content)
        if self._uncounted >= self.max_bytes // 16:
            self._trim(self.max_bytes)
            self._uncounted = 0.0

    def usage(self) -> dict[str, tuple[int, int]]:
        """Number of files and bytes by the kind of their keys."""
        found: dict[str, tuple[int, int]] = {}
        for path, stat in self._files():
            files, size = found.get(path.parent.name, (0, 0))
            found[path.parent.name] = files + 1, size + stat.st_size
        return found

    def clear(self) -> None:
        """Removes all results, and their folders where nothing else is in them."""
        for path, _ in self._files():
            path.unlink(missing_ok=True)
            with suppress(OSError):  # while others are in it
                path.parent.rmdir()

    def _files(self) -> list[tuple[Path, os.stat_result]]:
        found = []
        for name in sorted(glob.glob("*/*", root_dir=self.folder, include_hidden=True)):
            path = self.folder / name
            with suppress(OSError):  # another process has removed it
                if _FILE.fullmatch(path.name):
                    found.append((path, path.stat()))
        return found

    def _trim(self, max_bytes: int) -> None:
        """Removes the files used longest ago until a sixteenth is free, till the next count."""
        files = self._files()
        total = sum(stat.st_size for _, stat in files)
        recent = time.time() - _ABANDONED
        for path, stat in sorted(files, key=lambda f: max(f[1].st_atime_ns, f[1].st_mtime_ns)):
            if total <= max_bytes - max_bytes // 16:
                return
            if path.suffix == ".tmp" and stat.st_mtime > recent:
                continue  # another process is writing it
            with suppress(OSError):
                path.unlink()
                total -= stat.st_size


def disk_cache() -> Store:
    """What all runs of this user share, in `cache_dir`, at most `DISK_BYTES`."""
    return Store(cache_dir(), max_bytes=DISK_BYTES)


def encode(values: Mapping[str, Any]) -> bytes:
    """A safetensors file of tensors, numpy arrays of numbers and JSON values, and of a digest."""
    tensors, arrays, others = {}, [], {}
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            arrays.append(name)
            tensors[name] = torch.from_numpy(np.array(value, order="C"))
        elif isinstance(value, torch.Tensor):
            tensors[name] = value.detach().cpu().contiguous()
        else:
            others[name] = value
    text = json.dumps({"arrays": arrays, "values": others})
    return save(tensors, {"json": text, "digest": _digest(tensors, text)})


def decode(content: bytes) -> dict[str, Any]:
    """The values of `encode`; one of `DAMAGE` is raised where `content` is not what it returned."""
    header = safetensors_header(content)["__metadata__"]
    tensors = load(content)
    if header["digest"] != _digest(tensors, header["json"]):
        raise ValueError("its content is not what was written")
    described = json.loads(header["json"])
    arrays = {name: tensors[name].numpy() for name in described["arrays"]}
    return {**tensors, **arrays, **described["values"]}


def safetensors_header(content: bytes, most: int = 2**30) -> dict[str, Any]:
    """Header of a safetensors file, JSON after eight bytes of its length; to be read before `load`.

    One of `DAMAGE` is raised unless it has at most `most` bytes, and tensors few dimensions.
    """
    length = int.from_bytes(content[:8], "little")
    if length > most:
        raise ValueError(f"its header has {length} bytes, at most {most} are read")
    header: dict[str, Any] = json.loads(content[8 : 8 + length])
    shapes = [own["shape"] for name, own in header.items() if name != "__metadata__"]
    if max(map(len, shapes), default=0) > _MOST_DIMENSIONS:
        raise ValueError(f"a tensor has more than {_MOST_DIMENSIONS} dimensions")
    return header


def _digest(tensors: Mapping[str, torch.Tensor], text: str) -> str:
    return hashlib.sha256(f"{content_digest(tensors)} {text}".encode()).hexdigest()


@functools.cache
def _warn_once(message: str) -> None:
    """Log a warning the first time in this process."""
    _LOGGER.warning(message)
