"""Who made a raw file: the camera's make and model, whatever the container."""

from __future__ import annotations

import re

from simulator.tiff import Content, Directory, read_directories, unpack_at

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
