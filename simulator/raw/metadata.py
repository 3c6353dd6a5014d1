"""Who made a raw file: the camera's make and model, whatever the container."""

from __future__ import annotations

import math
import os
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from fractions import Fraction
from pathlib import Path
from typing import Any

# TIFF directories: the tags of TIFF-based files (DNG, NEF, CR2, ARW ...), read and written.
#
# Only what raw files need: tags are read without their pixels, and a file of one uncompressed image
# with an EXIF directory is written. Numbers follow TIFF 6.0 and EXIF 2.3.
Directory = dict[int, tuple[Any, ...]]

#: Tags that point to further directories: SubIFDs, EXIF.
SUB_DIRECTORIES = (330, 34665)
EXIF_DIRECTORY = 34665
_STRIPS, _TILES = (273, 279), (324, 325)
#: Beyond these a file is damaged, or made to take forever; camera files stay far below. Longer
#: values (maker notes, previews) are passed over, but for the places of strips and tiles.
_MAX_DIRECTORIES, _MAX_ENTRIES, _MAX_VALUE, _MAX_VALUES = 64, 4096, 2**16, 2**22
#: 42 is TIFF; the others are the same structure under Olympus' and Panasonic's own magic.
_MAGIC = (42, 0x4F52, 0x5352, 0x55)


class TiffType(IntEnum):
    """Field types of TIFF 6.0 that are written here."""

    BYTE = 1
    ASCII = 2
    SHORT = 3
    LONG = 4
    RATIONAL = 5
    UNDEFINED = 7
    SRATIONAL = 10
    DOUBLE = 12


_FORMATS = {1: "B", 2: "c", 3: "H", 4: "I", 5: "II", 6: "b", 7: "c", 8: "h", 9: "i"}
_FORMATS |= {10: "ii", 11: "f", 12: "d", 13: "I"}


@dataclass(frozen=True)
class Tag:
    """One field to write: its type and its values (rationals as numbers, text as ``str``)."""

    type: TiffType
    values: Sequence[Any] | str | bytes


def as_rational(value: float, *, signed: bool = False) -> tuple[int, int]:
    """Numerator and denominator, each in 32 bits, nearest to `value`.

    >>> as_rational(1 / 60), as_rational(2.8), as_rational(0.0)
    ((1, 60), (14, 5), (0, 1))
    """
    limit = 2**31 - 1 if signed else 2**32 - 1
    exact = Fraction(value)
    if abs(exact) > limit or (exact < 0 and not signed):
        raise ValueError(f"`value` (={value!r}) must fit a {'signed ' * signed}32-bit rational")
    # The simplest fraction that is the same float64 keeps 1/60 as 1/60.
    bound = limit if abs(exact) <= 1 else max(1, int(limit / abs(exact)))
    for denominator in (1000, 100_000, bound):
        candidate = exact.limit_denominator(min(denominator, bound))
        if candidate.numerator / candidate.denominator == value:
            break
    return candidate.numerator, candidate.denominator


def _encode(tag: Tag) -> tuple[int, bytes]:
    """Count and bytes of a field, little endian."""
    if isinstance(tag.values, str):
        data = tag.values.encode("ascii", "replace") + b"\0"
        return len(data), data
    if isinstance(tag.values, bytes):
        return len(tag.values), tag.values
    values = list(tag.values)
    if tag.type in (TiffType.RATIONAL, TiffType.SRATIONAL):
        signed = tag.type == TiffType.SRATIONAL
        flat = [part for v in values for part in as_rational(v, signed=signed)]
        return len(values), struct.pack(f"<{len(flat)}{_FORMATS[tag.type][0]}", *flat)
    return len(values), struct.pack(f"<{len(values)}{_FORMATS[tag.type]}", *values)


def _pack_directory(tags: Mapping[int, Tag], offset: int) -> bytes:
    """A directory that begins at `offset` of the file, followed by its out-of-line values."""
    entries, outside = [], b""
    values_at = offset + 2 + 12 * len(tags) + 4
    for number in sorted(tags):
        count, data = _encode(tags[number])
        if len(data) > 4:
            field = struct.pack("<I", values_at + len(outside))
            outside += data + b"\0" * (len(data) % 2)
        else:
            field = data.ljust(4, b"\0")
        entries.append(struct.pack("<HHI", number, tags[number].type, count) + field)
    return struct.pack("<H", len(tags)) + b"".join(entries) + b"\0\0\0\0" + outside


def tiff_head(tags: Mapping[int, Tag], exif: Mapping[int, Tag], size: int) -> bytes:
    """A little-endian TIFF file of one strip of pixels, up to where the strip begins.

    The strip's offset and length (tags 273, 279) and the EXIF pointer (34665) are filled in.

    Args:
        tags: Its directory.
        exif: Its EXIF directory.
        size: Length of the strip [byte].
    """
    layout = dict(tags)
    layout[273] = layout[EXIF_DIRECTORY] = Tag(TiffType.LONG, [0])
    layout[279] = Tag(TiffType.LONG, [size])
    exif_at = 8 + len(_pack_directory(layout, 8))
    packed_exif = _pack_directory(exif, exif_at)
    strip_at = -(-(exif_at + len(packed_exif)) // 16) * 16
    layout[273] = Tag(TiffType.LONG, [strip_at])
    layout[EXIF_DIRECTORY] = Tag(TiffType.LONG, [exif_at])
    head = struct.pack("<2sHI", b"II", 42, 8) + _pack_directory(layout, 8) + packed_exif
    return head.ljust(strip_at, b"\0")


class FileContent:
    """The bytes of a file, of which only those are read that are looked at.

    (Memory that is mapped would end the process where a file shrinks or a disk fails meanwhile.)

    Args:
        path: The file. It stays open until `close`.

    Raises:
        FileNotFoundError: If there is no such file; also for a folder.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            missing = "is no ordinary file" if path.exists() else "does not exist"
            what = "is a folder" if path.is_dir() else missing
            raise FileNotFoundError(f"`path` (={str(path)!r}) {what}; give a raw file")
        self._path, self._stream = path, path.open("rb")
        self._size = os.fstat(self._stream.fileno()).st_size

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, part: slice) -> bytes:
        start, stop, _ = part.indices(self._size)
        self._stream.seek(start)
        found = self._stream.read(max(0, stop - start))
        if len(found) < stop - start:
            raise OSError(f"`path` (={str(self._path)!r}) became shorter while it was read")
        return found

    def close(self) -> None:
        """Nothing can be read afterwards."""
        self._stream.close()


#: The bytes of a file, at hand or not.
Content = bytes | FileContent


def unpack_at(form: str, data: Content, offset: int) -> tuple[Any, ...]:
    """`struct.unpack` of what stands at `offset`."""
    return struct.unpack(form, data[offset : offset + struct.calcsize(form)])


def _decode(kind: int, data: bytes, order: str) -> tuple[Any, ...]:
    if kind == TiffType.ASCII:
        return (data.split(b"\0")[0].decode("utf-8", "replace").strip(),)
    if kind == TiffType.UNDEFINED:
        return (data,)
    values = struct.unpack(f"{order}{len(data) // struct.calcsize(_FORMATS[kind][0])}"
                           f"{_FORMATS[kind][0]}", data)  # fmt: skip
    if kind in (TiffType.RATIONAL, TiffType.SRATIONAL):
        pairs = zip(values[::2], values[1::2], strict=True)
        return tuple(a / b if b else float("nan") for a, b in pairs)
    return values


def _read_directory(
    data: Content, offset: int, order: str, room: int
) -> tuple[Directory, int, int]:
    """Tags of the directory at `offset`, where the next one is, and how many bytes they took.

    Broken fields are left out, and those that do not fit into `room` bytes.
    """
    if not 8 <= offset <= len(data) - 2:
        return {}, 0, 0
    (count,) = unpack_at(f"{order}H", data, offset)
    end = offset + 2 + 12 * count
    if end > len(data) or count > _MAX_ENTRIES:
        return {}, 0, 0
    tags: Directory = {}
    used = 0
    for at in range(offset + 2, end, 12):
        number, kind, length = unpack_at(f"{order}HHI", data, at)
        if kind not in _FORMATS or length == 0:
            continue
        size = length * struct.calcsize("=" + _FORMATS[kind])
        start = at + 8 if size <= 4 else unpack_at(f"{order}I", data, at + 8)[0]
        most = room - used if number in (*_STRIPS, *_TILES) else min(_MAX_VALUE, room - used)
        if start + size <= len(data) and size <= most:
            tags[number] = _decode(kind, data[start : start + size], order)
            used += size
    following = unpack_at(f"{order}I", data, end)[0] if end + 4 <= len(data) else 0
    return tags, following, used


def read_directories(data: Content) -> list[Directory]:
    """All directories of a TIFF-structured file, SubIFDs and EXIF included, in reading order.

    Args:
        data: The file. Maker notes are not followed.

    Returns:
        One ``{tag: values}`` per directory, at least one value each; rationals as floats, ASCII as
        one ``str``, UNDEFINED as one ``bytes``. Empty if `data` is not TIFF-structured.
    """
    order = {b"II": "<", b"MM": ">"}.get(data[:2])
    if order is None or len(data) < 8:
        return []
    magic, first = unpack_at(f"{order}HI", data, 2)
    if magic not in _MAGIC:
        return []
    pending, seen = [first], set[int]()
    found: list[Directory] = []
    room = _MAX_VALUES
    while pending and len(seen) < _MAX_DIRECTORIES:
        offset = pending.pop(0)
        if offset in seen:
            continue
        seen.add(offset)
        tags, following, used = _read_directory(data, offset, order, room)
        room -= used
        if not tags:
            continue
        found.append(tags)
        for number in SUB_DIRECTORIES:
            pending += [v for v in tags.get(number, ()) if isinstance(v, int)]
        if following:
            pending.append(following)
    return found


def numbers(tags: Directory, tag: int) -> tuple[float, ...]:
    """The values of a field; empty where it is missing or any is no finite number.

    >>> numbers({33434: (0.5,), 33437: (math.nan,), 271: ("Canon",)}, 33434)
    (0.5,)
    """
    values = tags.get(tag, ())
    return values if all(isinstance(v, int | float) and math.isfinite(v) for v in values) else ()


def missing_bytes(directories: Sequence[Directory], size: int) -> int:
    """How many bytes of pixels lie beyond the end of a file of `size` bytes; 0 if it is whole."""
    end = size
    for tags in directories:
        for offsets, counts in (_STRIPS, _TILES):
            pairs = zip(numbers(tags, offsets), numbers(tags, counts), strict=False)
            end = max([end, *(int(a + b) for a, b in pairs)])
    return end - size


MAKE, MODEL, SOFTWARE = 271, 272, 305
UNKNOWN_FILE, CANON_CRW = "a file of unknown type", "a Canon CRW file"
_CIFF_MAKE_MODEL = 0x080A
_CIFF_HEAP_TYPES = (0x2800, 0x3000)
#: A Canon CRW has less than ten heaps of less than a hundred records.
_CIFF_MAX_HEAPS, _CIFF_MAX_RECORDS = 64, 1024
#: TIFF structures inside of other containers are shorter.
_EMBEDDED_BYTES = 2**20
_SIGNATURES: tuple[tuple[bytes, str], ...] = (
    (b"\xff\xd8\xff", "a JPEG file"),
    (b"\x89PNG\r\n", "a PNG file"),
    (b"GIF8", "a GIF file"),
    (b"BM", "a BMP file"),
    (b"RIFF", "a RIFF file (WebP or video)"),
    (b"#?R", "a Radiance HDR file"),
    (b"v/1\x01", "an OpenEXR file"),
    (b"%PDF", "a PDF file"),
    (b"PK\x03\x04", "a ZIP archive"),
    (b"\x1f\x8b", "a gzip archive"),
    (b"\x93NUMPY", "a NumPy array"),
    (b"\0MRM", "a Minolta MRW file"),
    (b"ARRI", "an ARRIRAW file"),
    (b"NOKIARAW", "a Nokia raw file"),
    (b"FUJIFILM", "a Fujifilm RAF file"),
    (b"FOVb", "a Sigma X3F file (Foveon: three colours at every pixel)"),
)


def describe_file(data: Content) -> str:
    """What a file is, from its first bytes, in words for an error message."""
    head = data[:4096]
    for signature, words in _SIGNATURES:
        if head.startswith(signature):
            return words
    if not head:
        return "an empty file"
    if head[4:12] in (b"ftypheic", b"ftypheix", b"ftypmif1", b"ftypavif"):
        return "a HEIF or AVIF file"
    if head[6:14] == b"HEAPCCDR":
        return CANON_CRW
    if head[:2] in (b"II", b"MM"):
        return "a TIFF-structured file"
    if b"\0" not in head and all(b >= 32 or b in b"\t\n\r\f" for b in head):
        return "a text file"
    return UNKNOWN_FILE


def camera_identity(data: Content, directories: list[Directory]) -> tuple[str, str]:
    """Make and model as the camera recorded them; ``("", "")`` where the file does not say.

    Args:
        data: The file.
        directories: Its TIFF directories, empty for other containers.
    """
    for tags in directories:
        if MODEL in tags:
            return str(tags.get(MAKE, ("",))[0]), str(tags[MODEL][0])
    if data[6:14] == b"HEAPCCDR":
        return _ciff_identity(data, unpack_at("<I", data, 2)[0], len(data))
    if data[:8] == b"FUJIFILM":
        return "FUJIFILM", data[28:60].split(b"\0")[0].decode("ascii", "replace").strip()
    if data[:4] == b"\0MRM":  # Minolta MRW: a TIFF directory in its block TTW
        block = data[:65536].find(b"\0TTW")
        return _embedded_identity(data, block + 8) if block > 0 else ("", "")
    box = data[:65536].find(b"CMT1")  # Canon CR3: a TIFF directory in a box of that name
    if data[4:8] == b"ftyp" and box > 0:
        return _embedded_identity(data, box + 4)
    return "", ""


def _embedded_identity(data: Content, at: int) -> tuple[str, str]:
    """Make and model from a TIFF structure that begins at `at`."""
    return camera_identity(b"", read_directories(data[at : at + _EMBEDDED_BYTES]))


def _ciff_identity(data: Content, start: int, end: int) -> tuple[str, str]:
    """Make and model from Canon CIFF heaps, each with its directory at its end."""
    heaps = [(start, end)]
    for start, end in heaps:  # grows while it is read
        if end > len(data) or end - start < 6:
            continue
        table = start + unpack_at("<I", data, end - 4)[0]
        if not start <= table <= end - 6:
            continue
        count = min(unpack_at("<H", data, table)[0], _CIFF_MAX_RECORDS)
        for at in range(table + 2, min(table + 2 + 10 * count, end - 9), 10):
            kind, size, offset = unpack_at("<HII", data, at)
            first, last = start + offset, start + offset + size
            if kind == _CIFF_MAKE_MODEL and last <= end and size < _EMBEDDED_BYTES:
                make, model = (*data[first:last].split(b"\0"), b"", b"")[:2]
                return make.decode("ascii", "replace"), model.decode("ascii", "replace")
            inner = kind & 0x3800 in _CIFF_HEAP_TYPES and kind & 0xC000 == 0
            if inner and len(heaps) < _CIFF_MAX_HEAPS:
                heaps.append((first, last))
    return "", ""


def normalised_model(make: str, model: str) -> str:
    """Make and model for comparison: lower case, letters and digits, the maker's name once.

    >>> normalised_model("NIKON CORPORATION", "NIKON Z 6"), normalised_model("Nikon", "Z 6")
    ('nikonz6', 'nikonz6')
    """
    words = re.findall(r"[a-z0-9]+", make.lower())
    maker = words[0] if words else ""
    return maker + "".join(re.findall(r"[a-z0-9]+", model.lower())).removeprefix(maker)
