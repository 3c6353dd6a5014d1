"""Numbers out of files that ``torch.save`` wrote of whole modules, without running what is in them.

Such a file is a pickle: a program that may call any function of any package. The reader here knows
a few calls, those that put tensors together, and does them itself; it imports nothing that a file
names. A class of a network becomes an inert stand-in that only holds what the file says of it, and
anything else is refused by name. Both formats are read: the zip archive, and the row of pickles
that torch wrote before 1.6. Tensors of any device come to the CPU.
"""

from __future__ import annotations

import io
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import torch
from torch import Tensor

#: First numbers of the older format.
_MAGIC, _PROTOCOL = 0x1950A86A20F9469CFC6C, 1001
#: How files of the two formats begin.
_ZIP_START, _LEGACY_START = b"PK\x03\x04", b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19."
#: Types of storages by the name that files give them, in ``torch`` and in ``torch.cuda``.
_STORAGES = {
    "DoubleStorage": torch.float64,
    "FloatStorage": torch.float32,
    "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16,
    "LongStorage": torch.int64,
    "IntStorage": torch.int32,
    "ShortStorage": torch.int16,
    "CharStorage": torch.int8,
    "ByteStorage": torch.uint8,
    "BoolStorage": torch.bool,
}
#: Deepest module in a module.
_DEEPEST = 32


class _Refused(pickle.UnpicklingError):
    """What is wrong with a file, to follow its name."""


class _StorageType(NamedTuple):
    dtype: torch.dtype


class _Storage(NamedTuple):
    """Numbers that lie elsewhere in the file."""

    key: str
    dtype: torch.dtype
    size: int


class _Tensor(NamedTuple):
    """A tensor that has not been read: a view of a storage."""

    storage: Any
    offset: Any
    size: Any
    stride: Any


class StandIn:
    """In the place of an object of a network's class: what the file says of it, and no code."""


class _Reader(pickle._Unpickler):
    """Unpickles the few things that a saved network is made of.

    In Python: C's keeps a list as long as the largest number in the file, whatever that takes.

    Args:
        stream: The pickle.
        packages: Modules whose classes may stand in the file, besides torch's own layers.
    """

    def __init__(self, stream: io.BytesIO, packages: tuple[str, ...]) -> None:
        super().__init__(stream, encoding="utf-8")
        self._packages = packages
        self.storages: dict[str, _Storage] = {}

    def find_class(self, module: str, name: str) -> Any:
        """What the file gets for a global that it names; nothing is imported."""
        whole = f"{module}.{name}"
        if whole == "collections.OrderedDict":
            return OrderedDict
        if whole in ("builtins.set", "__builtin__.set"):
            return set
        if module in ("torch", "torch.cuda") and name in _STORAGES:
            return _StorageType(_STORAGES[name])
        if module == "torch" and isinstance(getattr(torch, name, None), torch.dtype):
            return getattr(torch, name)
        calls: dict[str, Callable[..., Any]] = {
            "torch._utils._rebuild_tensor": self._tensor,
            "torch._utils._rebuild_tensor_v2": self._tensor,
            "torch._utils._rebuild_parameter": self._parameter,
            "torch.Size": self._size,
            "torch.device": self._device,
        }
        if whole in calls:
            return calls[whole]
        if module.startswith("torch.nn.") or module in self._packages:
            return type(name, (StandIn,), {})
        raise _Refused(
            f"names {whole}, which is no part of a network: it may be harmful, and was not run"
        )

    def persistent_load(self, pid: Any) -> Any:
        """A storage, or in the older format the class of a module."""
        if isinstance(pid, tuple) and len(pid) == 4 and pid[0] == "module":
            return pid[1]
        if not (isinstance(pid, tuple) and len(pid) in (5, 6) and pid[0] == "storage"):
            raise _Refused("refers to something that is no storage")
        kind, key, size = pid[1], pid[2], pid[4]
        if not isinstance(kind, _StorageType) or not isinstance(key, str) or not _is_size(size):
            raise _Refused("describes a storage in an unknown way")
        if len(pid) == 6 and pid[5] is not None:
            raise _Refused("has storages within storages, which are not read")
        storage = _Storage(key, kind.dtype, size)
        if self.storages.setdefault(key, storage) != storage:
            raise _Refused(f"describes the storage {key!r} in two ways")
        return storage

    def _tensor(self, storage: Any, offset: Any, size: Any, stride: Any, *_: Any) -> _Tensor:
        return _Tensor(storage, offset, size, stride)

    def _parameter(self, data: Any, *_: Any) -> Any:
        return data

    def _size(self, values: Any) -> tuple[Any, ...]:
        return tuple(values)

    def _device(self, *words: Any) -> str:
        return ":".join(str(word) for word in words)


def _is_size(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**40


def is_torch_file(path: Path) -> bool:
    """Whether a file begins as those that ``torch.save`` writes."""
    with path.open("rb") as stream:
        start = stream.read(4096)
    in_zip = start.startswith(_ZIP_START) and b"/data.pkl" in start  # its first entry
    return in_zip or start.startswith(_LEGACY_START)


def read_state(path: Path, *, packages: tuple[str, ...] = ()) -> dict[str, Tensor]:
    """The tensors of the network in a file, by the names that its ``state_dict`` gives them.

    Args:
        path: A file that ``torch.save`` wrote: of a module, of its ``state_dict``, or of a
            dictionary that holds one of them under ``"model"`` or ``"state_dict"``. The prefix
            ``module.`` that ``DataParallel`` puts before every name is left out.
        packages: Modules of Python whose classes may stand in the file.

    Returns:
        Tensors of their own, on the CPU.

    Raises:
        ValueError: If the file cannot be read, is damaged, or names anything but a network; no
            code of it was run.
    """
    try:
        content = path.read_bytes()
        found, contents = _parsed(content, packages)
        return {name: _materialised(t, contents) for name, t in _named(found).items()}
    except OSError as error:
        raise ValueError(f"`{path}` cannot be read: {error.strerror}") from error
    except RecursionError as error:
        raise ValueError(f"`{path}` is nested too deeply") from error
    except _Refused as error:
        raise ValueError(f"`{path}` {error}") from error
    except Exception as error:  # a damaged pickle can fail in any way
        words = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"`{path}` is damaged: {words}") from error


def _damaged(text: str) -> NoReturn:
    raise _Refused(f"is damaged: {text}")


def _parsed(
    content: bytes, packages: tuple[str, ...]
) -> tuple[Any, Callable[[_Storage], memoryview]]:
    """The object in a file, and a function that gives the bytes of a storage."""
    if content.startswith(_ZIP_START):
        return _parsed_zip(content, packages)
    if content.startswith(_LEGACY_START):
        return _parsed_legacy(content, packages)
    try:
        _Reader(io.BytesIO(content), packages).load()  # refuses by name what may be harmful
    except _Refused:
        raise
    except Exception:  # no pickle at all
        pass
    raise _Refused("must be a file that torch.save wrote")


def _parsed_zip(
    content: bytes, packages: tuple[str, ...]
) -> tuple[Any, Callable[[_Storage], memoryview]]:
    archive = zipfile.ZipFile(io.BytesIO(content))
    records = {info.filename: info for info in archive.infolist()}
    packed = [name for name, info in records.items() if info.compress_type != zipfile.ZIP_STORED]
    if packed:
        _damaged(f"{packed[0]} is compressed, which torch never does")
    roots = [name.removesuffix("data.pkl") for name in records if name.endswith("/data.pkl")]
    if len(roots) != 1:
        raise _Refused("must be a file that torch.save wrote: it has no data.pkl")
    (root,) = roots
    if f"{root}byteorder" in records and archive.read(f"{root}byteorder") != b"little":
        raise _Refused("must be of a little-endian machine")

    def contents(storage: _Storage) -> memoryview:
        name = f"{root}data/{storage.key}"
        if name not in records:
            _damaged(f"there is no {name}")
        return memoryview(archive.read(name))

    return _Reader(io.BytesIO(archive.read(f"{root}data.pkl")), packages).load(), contents


def _parsed_legacy(
    content: bytes, packages: tuple[str, ...]
) -> tuple[Any, Callable[[_Storage], memoryview]]:
    stream = io.BytesIO(content)
    if [_Reader(stream, ()).load() for _ in range(2)] != [_MAGIC, _PROTOCOL]:
        raise _Refused("must be a file that torch.save wrote, of protocol 1001")
    system = _Reader(stream, ()).load()
    if not isinstance(system, dict) or system.get("little_endian") is not True:
        raise _Refused("must be of a little-endian machine")
    reader = _Reader(stream, packages)
    found, keys = reader.load(), _Reader(stream, ()).load()
    if not isinstance(keys, list) or set(map(str, keys)) != set(reader.storages):
        _damaged("the storages it lists are not those it uses")
    places: dict[str, memoryview] = {}
    whole, place = memoryview(content), stream.tell()
    for key in keys:
        storage = reader.storages[key]
        length = storage.size * storage.dtype.itemsize
        stated = int.from_bytes(whole[place : place + 8], "little")
        if stated != storage.size or place + 8 + length > len(whole):
            _damaged(f"the storage {key} must have {storage.size} numbers; the file is cut off")
        places[key] = whole[place + 8 : place + 8 + length]
        place += 8 + length
    return found, lambda storage: places[storage.key]


def _named(found: Any) -> dict[str, _Tensor]:
    """The tensors of a module or of a dictionary, without the prefix of ``DataParallel``."""
    if isinstance(found, dict):
        for key in ("model", "state_dict"):
            if isinstance(found.get(key), StandIn | dict):
                return _named(found[key])
        named = {k: v for k, v in found.items() if isinstance(k, str) and isinstance(v, _Tensor)}
        if not named or len(named) < len(found):
            raise _Refused("must hold a network or its state_dict")
    elif isinstance(found, StandIn):
        named = dict(_walk(found, "", 0))
    else:
        raise _Refused("must hold a network or its state_dict")
    if named and all(name.startswith("module.") for name in named):
        named = {name.removeprefix("module."): tensor for name, tensor in named.items()}
    return named


def _walk(module: Any, prefix: str, depth: int) -> Iterator[tuple[str, _Tensor]]:
    """Parameters, buffers and those of the modules within, as ``state_dict`` names them."""
    if not isinstance(module, StandIn) or depth > _DEEPEST:
        _damaged(f"{prefix.rstrip('.') or 'the network'} is no module")
    for group in ("_parameters", "_buffers"):
        for name, tensor in _entries(module, group, prefix):
            if not isinstance(tensor, _Tensor):
                _damaged(f"{prefix}{name} is no tensor")
            yield f"{prefix}{name}", tensor
    for name, inner in _entries(module, "_modules", prefix):
        yield from _walk(inner, f"{prefix}{name}.", depth + 1)


def _entries(module: StandIn, group: str, prefix: str) -> Iterator[tuple[str, Any]]:
    entries = vars(module).get(group)
    if not isinstance(entries, Mapping):
        _damaged(f"{prefix.rstrip('.') or 'the network'} has no {group}")
    return ((str(name), value) for name, value in entries.items() if value is not None)


def _materialised(tensor: _Tensor, contents: Callable[[_Storage], memoryview]) -> Tensor:
    """A tensor of its own with the numbers that the file has for it."""
    storage, offset, size, stride = tensor
    fits = (
        isinstance(storage, _Storage)
        and _is_size(offset)
        and isinstance(size, tuple)
        and isinstance(stride, tuple)
        and len(size) == len(stride)
        and all(map(_is_size, (*size, *stride)))
    )
    if not fits:
        _damaged("a tensor is described in an unknown way")
    count = 1
    for length in size:
        count *= length
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if count and (last >= storage.size or count > storage.size):
        _damaged(f"a tensor of shape {size} does not lie within its storage of {storage.size}")
    if not count:
        return torch.empty(size, dtype=storage.dtype)
    content = contents(storage)
    if len(content) != storage.size * storage.dtype.itemsize:
        _damaged(f"the storage {storage.key} has {len(content)} bytes")
    flat = torch.frombuffer(bytearray(content), dtype=storage.dtype)
    return flat.as_strided(size, stride, offset).clone(memory_format=torch.contiguous_format)
