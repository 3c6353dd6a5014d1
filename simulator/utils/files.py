"""Files: real data, endings of raws, pictures too large to decode, and writing atomically."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

#: Environment variable that names the folder of real files.
DATA_VARIABLE = "AE_ENV_DATA"

#: Endings of raw files that LibRaw knows.
RAW_SUFFIXES = (
    *(".3fr", ".ari", ".arw", ".bay", ".cr2", ".cr3", ".crw", ".dcr", ".dcs", ".dng", ".erf"),
    *(".fff", ".gpr", ".iiq", ".k25", ".kdc", ".mdc", ".mef", ".mos", ".mrw", ".nef", ".nrw"),
    *(".orf", ".pef", ".ptx", ".pxn", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw"),
    ".x3f",
)
#: Endings of developed pictures.
PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")

#: Most pixels that a raw or a radiance map may claim: more than any camera with a Bayer array has.
MAX_PIXELS = 2**28
#: Most pixels for each byte of a raw; a flat DNG in deflate has half of that.
MAX_PIXELS_PER_BYTE = 1024
#: The same for a radiance map; a flat one in OpenEXR's DWAB compression has over 3000.
MAX_RADIANCE_PIXELS_PER_BYTE = 2**13


def data_folder() -> Path | None:
    """The folder of real files for tests and measurements.

    Returns:
        The folder that ``AE_ENV_DATA`` names; where that is unset or empty, ``../shared/data``
        beside the checkout, or None if that is not there.

    Raises:
        FileNotFoundError: If the folder that is named is not there.
    """
    named = os.environ.get(DATA_VARIABLE)
    if named and not Path(named).expanduser().is_dir():
        raise FileNotFoundError(f"{DATA_VARIABLE} (={named!r}) must name a folder: there is none")
    beside = Path(__file__).resolve().parents[3] / "shared" / "data"
    folder = Path(named).expanduser() if named else beside
    return folder if folder.is_dir() else None


def as_path(path: object) -> Path:
    """`path` as a `Path`.

    Raises:
        ValueError: If it is neither text nor a path.
    """
    if not isinstance(path, str | os.PathLike) or not isinstance(os.fspath(path), str):
        raise ValueError(f"`path` (={path!r}) must be a file's name: a str or a pathlib.Path")
    return Path(path)


def refuse_bomb(height: int, width: int, size: int, *, per_byte: int = MAX_PIXELS_PER_BYTE) -> str:
    """Why a picture must not be decoded: it claims far more pixels than its file can hold.

    Args:
        height: Rows that the file claims.
        width: Columns that it claims.
        size: Length of the file [byte].
        per_byte: Most pixels that each byte of the file may stand for.

    Returns:
        The reason, for an error message; empty where the picture may be decoded.

    >>> refuse_bomb(60_000, 60_000, 4096)
    'claims 60000 x 60000 pixels, where at most 268435456 are read'
    """
    pixels = height * width
    if pixels > MAX_PIXELS:
        return f"claims {height} x {width} pixels, where at most {MAX_PIXELS} are read"
    if pixels > per_byte * size:
        return (
            f"claims {height} x {width} pixels in {size} bytes, where at most "
            f"{per_byte} a byte are read"
        )
    return ""


def write_atomically(
    path: str | os.PathLike[str], content: bytes | str | Iterable[bytes | memoryview]
) -> Path:
    """Write `content` under a temporary name beside `path`, then rename it; makes the folder.

    Args:
        path: File to write or replace.
        content: Bytes, text that is encoded as UTF-8, or pieces of bytes, written as they come.

    Returns:
        `path`.

    Raises:
        ValueError: If `path` is not a file's name.
        OSError: If the file cannot be written (no permission, a full disk); nothing half-written
            stays.
    """
    path = as_path(path)
    content = content.encode() if isinstance(content, str) else content
    pieces = [content] if isinstance(content, bytes | bytearray | memoryview) else content
    start = path.name.encode(errors="ignore")[:200].decode(errors="ignore")  # 255 bytes at most
    temporary = path.parent / f".{start}.{secrets.token_hex(4)}.tmp"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("xb") as stream:
            stream.writelines(pieces)
        os.replace(temporary, path)
    except OSError as error:
        if error.errno is None:
            raise
        reason = f"`path` (={str(path)!r}) cannot be written: {error.strerror}"
        raise OSError(error.errno, reason) from error
    finally:
        with suppress(OSError):  # after the renaming there is none
            temporary.unlink()
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
