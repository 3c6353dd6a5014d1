"""Files: which are raws, how weights are named, and writing so that nothing is lost."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable
from pathlib import Path

#: Endings of raw files that LibRaw knows.
RAW_SUFFIXES = (
    *(".3fr", ".ari", ".arw", ".bay", ".cr2", ".cr3", ".crw", ".dcr", ".dcs", ".dng", ".erf"),
    *(".fff", ".gpr", ".iiq", ".k25", ".kdc", ".mdc", ".mef", ".mos", ".mrw", ".nef", ".nrw"),
    *(".orf", ".pef", ".ptx", ".pxn", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw"),
    ".x3f",
)


def write_atomically(
    path: str | os.PathLike[str], content: bytes | str | Iterable[bytes | memoryview]
) -> Path:
    """Writes `content` under a temporary name beside `path`, then renames it; makes the folder.

    Args:
        path: File to write or replace.
        content: Bytes, text that is encoded as UTF-8, or pieces of bytes, written as they come.

    Returns:
        `path`.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp")
    content = content.encode() if isinstance(content, str) else content
    pieces = [content] if isinstance(content, bytes | bytearray | memoryview) else content
    try:
        with os.fdopen(descriptor, "wb") as stream:
            stream.writelines(pieces)
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(name, 0o666 & ~umask)  # mkstemp's files are private
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
    return path


def sibling(path: str | Path, suffix: str) -> Path:
    """The file of trained weights that ends in `suffix`; only its two endings are replaced.

    >>> sibling("runs/ppo-0.5", ".json").name, sibling("runs/ppo.safetensors", ".json").name
    ('ppo-0.5.json', 'ppo.json')
    """
    path = Path(path).expanduser()
    name = path.name
    for ending in (".safetensors", ".json"):
        name = name.removesuffix(ending)
    if name in ("", ".."):
        raise ValueError(f"weights file (={str(path)!r}) must have a name, such as runs/ppo")
    return path.with_name(name + suffix)
