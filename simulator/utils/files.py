"""Files: real data, endings of raws, pictures too large to decode, writing, and result files.

Every measurement is written as ``{"meta": {...}, "rows": [...]}``.
"""

from __future__ import annotations

import datetime
import errno
import functools
import io
import json
import operator
import os
import platform
import subprocess
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from simulator import __version__

if TYPE_CHECKING:
    from PIL import Image

#: Environment variable that names the folder of real files.
DATA_VARIABLE = "AE_ENV_DATA"

#: Endings of raw files that LibRaw knows.
RAW_SUFFIXES = (
    *(".3fr", ".ari", ".arw", ".bay", ".cr2", ".cr3", ".crw", ".dcr", ".dcs", ".dng", ".erf"),
    *(".fff", ".gpr", ".iiq", ".k25", ".kdc", ".mdc", ".mef", ".mos", ".mrw", ".nef", ".nrw"),
    *(".orf", ".pef", ".ptx", ".pxn", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw"),
    ".x3f",
)
#: Endings of developed pictures, and Pillow's formats of those; of others it runs programs (EPS).
PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
_PICTURE_FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "WEBP")

#: Most pixels that a raw or a radiance map may claim: more than any camera with a Bayer array has.
MAX_PIXELS = 2**28
#: Most pixels for each byte of a raw; a flat DNG in deflate has half of that.
MAX_PIXELS_PER_BYTE = 1024
#: The same for a radiance map; a flat one in OpenEXR's DWAB compression has over 3000.
MAX_RADIANCE_PIXELS_PER_BYTE = 2**13

#: Most pixels of a developed picture, and most of any with more than 256 pixels a byte (64 of a raw
#: or a radiance map, of which real ones have 1, enlarged ones 6), as a black one has: decoded, they
#: take some 1 GB.
MAX_PICTURE_PIXELS, MAX_FLAT_PIXELS = 2**26, 2**24

_BITS_PER_SAMPLE = 258
_SPECIAL = "is no ordinary file"

#: Libraries that numbers depend on.
_LIBRARIES = ("torch", "numpy", "gymnasium", "stable-baselines3", "scikit-image", "rawpy")


def data_folder() -> Path | None:
    """The folder of real files for tests and measurements.

    It is what ``AE_ENV_DATA`` names, which must be there; where that is unset or empty,
    ``../shared/data`` beside the checkout, or None if that is not there.
    """
    named = os.environ.get(DATA_VARIABLE)
    if named and not Path(named).expanduser().is_dir():
        raise FileNotFoundError(f"{DATA_VARIABLE} (={named!r}) must name a folder: there is none")
    beside = Path(__file__).resolve().parents[3] / "shared" / "data"
    folder = Path(named).expanduser() if named else beside
    return folder if folder.is_dir() else None


def as_path(path: object) -> Path:
    """`path` as a `Path`; a `ValueError` if it is neither text nor a path."""
    if not isinstance(path, str | os.PathLike) or not isinstance(os.fspath(path), str):
        raise ValueError(f"`path` (={path!r}) must be a file's name: a str or a pathlib.Path")
    return Path(path)


def printable(name: str) -> str:
    """`name` of a file as text that can be written as UTF-8: bytes that are none become escapes.

    >>> printable(os.fsdecode(b"ete\\xe9.dng"))
    'ete\\\\udce9.dng'
    """
    return name.encode(errors="backslashreplace").decode()


def file_fault(path: Path) -> str:
    """Why a path is none of an ordinary file (a pipe is read for ever); empty where it is."""
    if path.is_file():
        return ""
    return "is a folder" if path.is_dir() else _SPECIAL if path.exists() else "does not exist"


def read_bounded(path: Path, most: int = 2**26) -> bytes:
    """Content of an ordinary file of at most so many bytes; an `OSError` for another one."""
    if file_fault(path) == _SPECIAL:
        raise OSError(errno.EINVAL, f"it {_SPECIAL}", str(path))
    with path.open("rb") as stream:
        size = os.fstat(stream.fileno()).st_size
        content = stream.read(most + 1) if size <= most else b""
    if max(size, len(content)) > most:
        raise OSError(errno.EFBIG, f"it has more than {most} bytes", str(path))
    return content


def read_table(path: Path) -> Any:
    """The cells of a CSV file in UTF-8 as a frame of texts; an empty one for an empty file.

    A `ValueError` if it is none, or cannot be read.
    """
    import pandas as pd

    how: Any = {"dtype": str, "keep_default_na": False, "encoding": "utf-8-sig"}
    try:
        with warnings.catch_warnings(category=pd.errors.ParserWarning, action="ignore"):
            content = io.BytesIO(read_bounded(path))
            frame = pd.read_csv(content, index_col=False, **how)  # no cells beyond the columns
    except pd.errors.EmptyDataError:
        return pd.DataFrame()
    except (pd.errors.ParserError, OSError, UnicodeError) as error:
        raise ValueError(f"{str(path)!r} must be a CSV file in UTF-8: {error}") from error
    return frame.fillna("").rename(columns=str.strip)


def refuse_bomb(
    height: int, width: int, size: int, *, per_byte: int = MAX_PIXELS_PER_BYTE, large: int = 64
) -> str:
    """Why a picture must not be decoded: it claims far more pixels than `size` bytes can hold.

    Empty where it may be decoded; each byte of the file may stand for `per_byte` pixels at most, or
    `large` in one of more than `MAX_FLAT_PIXELS`.

    >>> refuse_bomb(8192, 16384, 2**21), refuse_bomb(8000, 8000, 37_825)
    ('', 'claims 8000 x 8000 pixels in 37825 bytes, where at most 64 a byte are read')
    """
    pixels = height * width
    if pixels > MAX_PIXELS:
        return f"claims {height} x {width} pixels, where at most {MAX_PIXELS} are read"
    per_byte = large if pixels > MAX_FLAT_PIXELS else per_byte
    if pixels > per_byte * size:
        claim = f"claims {height} x {width} pixels in {size} bytes"
        return f"{claim}, where at most {per_byte} a byte are read"
    return ""


@contextmanager
def open_picture(
    path: Path, formats: Sequence[str] = _PICTURE_FORMATS, *, bits: int = 8
) -> Iterator[Image.Image]:
    """A developed picture, of `formats` of Pillow only; pixels are decoded when they are asked for.

    A `ValueError`, here and within, names the file if it is missing (a link that leads nowhere), no
    whole picture, larger than `MAX_PICTURE_PIXELS` or `MAX_FLAT_PIXELS`, or has colours of more
    than `bits`: Pillow reads the upper 8 of 16, which others decode where ``info["deep"]``.
    """
    from PIL import Image

    try:
        if fault := file_fault(path):
            raise ValueError(f"it {fault}")
        with warnings.catch_warnings(action="ignore", category=Image.DecompressionBombWarning):
            opened = Image.open(path, formats=list(formats))  # warns of what is refused below
        with opened as picture:
            if picture.width * picture.height > MAX_PICTURE_PIXELS:
                size = f"{picture.width} x {picture.height} pixels"
                raise ValueError(f"it has {size}, where at most {MAX_PICTURE_PIXELS} are read")
            if picture.width * picture.height > MAX_FLAT_PIXELS:
                length = path.stat().st_size
                if claim := refuse_bomb(picture.height, picture.width, length, large=256):
                    raise ValueError(f"it {claim}")
            stored = getattr(picture, "tag_v2", {}).get(_BITS_PER_SAMPLE, (8,))  # of a TIFF
            deep = max(stored) > 8 or any(";16" in str(t[3]) for t in getattr(picture, "tile", ()))
            if deep and bits == 8 and len(picture.getbands()) > 1:
                raise ValueError("it has colours of 16 bits: save it with 8, or give raws")
            picture.info["deep"] = deep
            yield picture
    except (OSError, SyntaxError, EOFError, ValueError, Image.DecompressionBombError) as error:
        dangling = path.is_symlink() and not path.exists()
        reason = "the link leads nowhere" if dangling else error
        raise ValueError(f"picture {str(path)!r} cannot be read: {reason}") from error


def write_atomically(
    path: str | os.PathLike[str],
    content: bytes | str | Iterable[bytes | memoryview],
    *,
    synced: bool = True,
) -> Path:
    """Write bytes, text (as UTF-8), or pieces of bytes whole or not at all; returns `path`.

    They are written under a temporary name beside `path` (of a link: the file that it leads to),
    whose folder is made, and then renamed: if `synced` after they are on the disk, so that even a
    loss of power leaves the old file or the new one.
    """
    path = as_path(path)
    target = Path(os.path.realpath(path))
    content = printable(content).encode() if isinstance(content, str) else content
    pieces = [content] if isinstance(content, bytes | bytearray | memoryview) else content
    start = target.name.encode(errors="ignore")[:200].decode(errors="ignore")  # 255 bytes at most
    temporary = target.parent / f".{start}.{os.urandom(4).hex()}.tmp"
    try:
        if target.is_symlink():  # links that lead to each other
            raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
        target.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("xb") as stream:
            stream.writelines(pieces)
            stream.flush()
            if synced:
                os.fsync(stream.fileno())
        os.replace(temporary, target)
    except OSError as error:
        if error.errno is None:
            raise
        reason = f"`path` (={str(path)!r}) cannot be written: {error.strerror}"
        raise OSError(error.errno, reason) from error
    finally:
        with suppress(OSError):  # after the renaming there is none
            temporary.unlink()
    return path


def write_picture(path: Path, picture: Image.Image, **options: Any) -> Path:
    """Write a picture of Pillow atomically, in the format that the ending of `path` names."""
    content = io.BytesIO()
    picture.save(content, path.suffix[1:].upper(), **options)
    return write_atomically(path, content.getvalue())


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


# -- result files ---------------------------------------------------------------------------------


def result_meta(command: str, seed: int | None) -> dict[str, Any]:
    """Where a measurement comes from: the ``meta`` of every result file, JSON-ready.

    `command` is the command line that writes the file again; the ``commit`` ends in ``+changes``
    where files differ from it, and is None outside a checkout.
    """
    return {
        "command": command,
        "commit": _commit(),
        "seed": seed,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "machine": machine(),
        "versions": versions(),
    }


def write_results(
    path: str | os.PathLike[str], rows: Iterable[Mapping[Any, Any]], meta: Mapping[str, Any]
) -> Path:
    """Write ``{"meta": meta, "rows": rows}`` as JSON, whole or not at all.

    Scalars and arrays of numpy and torch become numbers and lists; NaN and infinity, which JSON
    does not have, raise a `ValueError`. `meta` is that of `result_meta` and whatever else.
    """
    encode = functools.partial(json.dumps, allow_nan=False, default=operator.methodcaller("tolist"))
    try:
        lines = ",\n".join(encode(dict(row)) for row in rows)  # a row a line: differences are short
        text = f'{{"meta": {encode(dict(meta))},\n"rows": [\n{lines}\n]}}'
    except (AttributeError, TypeError, ValueError) as error:
        found = f"{error.obj!r} is none" if isinstance(error, AttributeError) else error
        raise ValueError(f"`rows` and `meta` must hold finite JSON values: {found}") from None
    return write_atomically(path, text + "\n")


def machine() -> dict[str, Any]:
    """CPU model, cores this process may use, threads torch uses, name of the GPU or None."""
    import torch

    affinity = getattr(os, "sched_getaffinity", None)  # absent on macOS and Windows
    return {
        "cpu": _cpu_name(),
        "cores": len(affinity(0)) if affinity else os.cpu_count(),
        "threads": torch.get_num_threads(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }


def versions() -> dict[str, str]:
    """Version of Python, of this package and of the installed libraries that numbers depend on."""
    from importlib.metadata import PackageNotFoundError, version  # imports much: help does not

    found = {"python": platform.python_version(), "ae-env": __version__}
    for name in _LIBRARIES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def _cpu_name() -> str:
    """Model name of the CPU; the architecture where the system does not say."""
    table = Path("/proc/cpuinfo")  # of Linux
    for line in table.read_text(encoding="utf-8").splitlines() if table.is_file() else ():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def _commit() -> str | None:
    """Commit of the checkout that this package runs from; None where there is no checkout."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():  # an installed copy may lie in somebody else's repository
        return None
    command = ["git", "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+changes"]
    try:
        text = subprocess.run(command, cwd=root, capture_output=True, timeout=10, check=True).stdout
        return text.decode().strip()
    except (OSError, subprocess.SubprocessError):
        return None
