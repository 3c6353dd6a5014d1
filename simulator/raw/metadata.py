"""Metadata of raw files: their tags, their camera, their noise and colour.

The tags of TIFF-structured files (DNG, NEF, CR2, ARW, ...) are read with tifffile. From other
containers (CRW, CR3, RAF, MRW) only make and model are read; LibRaw reads their settings.
"""

import io
import itertools
import json
import logging
import math
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, BinaryIO, Self

import numpy as np
import tifffile

from simulator.camera import BayerPattern
from simulator.noise.noise_level_function import VARIANCE_LIMIT, NoiseLevelFunction
from simulator.raw.dng import COMMENT_PREFIX, D65, OPCODES, SOFTWARE_NAME, OwnRecord
from simulator.settings import CameraSettings

#: The tags of one TIFF directory: a tuple of values by name. Rationals are `Ratio`, ASCII is one
#: ``str``, UNDEFINED one ``bytes``.
Directory = dict[str, tuple[Any, ...]]


class Ratio(float):
    """A rational of a file, which keeps the two numbers that it was written with."""

    __slots__ = ("denominator", "numerator")
    numerator: int
    denominator: int

    def __new__(cls, numerator: int, denominator: int) -> Self:
        """NaN over a denominator of 0."""
        ratio = super().__new__(cls, numerator / denominator if denominator else math.nan)
        ratio.numerator, ratio.denominator = numerator, denominator
        return ratio


# -- TIFF directories -----------------------------------------------------------------------------

_POSITIONS = ("StripOffsets", "StripByteCounts", "TileOffsets", "TileByteCounts")
#: The tags that are read, by name. Others (maker notes, previews, XMP) are passed over.
_NAMES = (
    *("ImageWidth", "ImageLength", "BitsPerSample", "Compression", "PhotometricInterpretation"),
    *("Make", "Model", "Orientation", "SamplesPerPixel", "Software", "RowsPerStrip"),
    *(*_POSITIONS, "CFAPattern", "CFAPlaneColor", "LinearizationTable", "WhiteLevel", "ActiveArea"),
    *("BlackLevelRepeatDim", "BlackLevel", "BlackLevelDeltaH", "BlackLevelDeltaV"),
    *("ColorMatrix1", "CameraCalibration1", "CalibrationIlluminant1", "AnalogBalance"),
    *("ColorMatrix2", "CameraCalibration2", "CalibrationIlluminant2", "AsShotNeutral"),
    *("NoiseProfile", "ExposureTime", "FNumber", "RecommendedExposureIndex", "ISOSpeed"),
    *("StandardOutputSensitivity", "DateTimeOriginal", "FocalLength", "UserComment"),
    *("PhotographicSensitivity", "DefaultScale", "BaselineExposure", *OPCODES, "DNGVersion"),
    *("UniqueCameraModel", "CFALayout", "SampleFormat", "ShutterSpeedValue", "ApertureValue"),
)
#: Of Panasonic's and Leica's RW2 and RWL: where the pixels are, how many, how they are packed.
_PANASONIC = {0x118: "RawDataOffset", 2: "SensorWidth", 3: "SensorHeight", 0x2D: "RawFormat"}
_NAME_OF_CODE = {int(tifffile.TIFF.EXIF_TAGS[name]): name for name in _NAMES} | _PANASONIC
_SUB_DIRECTORIES, _EXIF = (int(tifffile.TIFF.EXIF_TAGS[name]) for name in ("SubIFDs", "ExifTag"))
_WANTED = {*_NAME_OF_CODE, _SUB_DIRECTORIES, _EXIF}
#: 42 is TIFF; the others are the same structure under Olympus' and Panasonic's own magic.
_MAGIC = (42, 0x4F52, 0x5352, 0x55)
#: Beyond these a file is damaged, or made to take forever; camera files stay far below.
_MAX_DIRECTORIES, _MAX_TAGS, _MAX_VALUES = 64, 4096, 2**18
_NO_POSITION = 2**32 - 1
#: Formats of RATIONAL and SRATIONAL, of which tifffile reads half where there are more than 1024.
_RATIONALS = {5: "I", 10: "i"}


def read_directories(stream: BinaryIO) -> list[Directory]:
    """The tags of all directories of a TIFF-structured file, SubIFDs and EXIF included, in order.

    At most a few megabytes of the file are read, whatever it claims. Damaged directories and tags
    are left out; the list is empty if the file is not TIFF-structured.
    """
    head = _read_at(stream, 0, 8)
    form = {b"II": tifffile.TIFF.CLASSIC_LE, b"MM": tifffile.TIFF.CLASSIC_BE}.get(head[:2])
    if form is None or len(head) < 8:
        return []
    magic, start = struct.unpack(f"{form.byteorder}HI", head[2:])
    # All that `TiffTag` needs of a file; `TiffFile` itself also interprets what it finds, and gives
    # up a whole directory for one damaged tag.
    file = SimpleNamespace(tiff=form, filehandle=tifffile.FileHandle(stream, offset=0))
    found: list[Directory] = []
    queue, known, room = [start] if magic in _MAGIC else [], {start}, _MAX_VALUES
    with _silent_tifffile():
        for offset in itertools.islice(queue, _MAX_DIRECTORIES):  # grows while it is read
            tags: Directory = {}
            followers: list[Any] = []
            entries, following = _read_entries(file, offset)
            for at, entry in entries.items():
                code, kind, count, place = struct.unpack(f"{form.byteorder}HHII", entry)
                if not 0 < count <= room or code not in _WANTED:
                    continue
                room -= count
                with suppress(Exception):  # of a damaged tag, tifffile may raise anything
                    if kind in _RATIONALS and code in _NAME_OF_CODE:
                        layout = f"{form.byteorder}{2 * count}{_RATIONALS[kind]}"
                        parts = iter(struct.unpack(layout, _read_at(stream, place, 8 * count)))
                        tags[_NAME_OF_CODE[code]] = tuple(map(Ratio, parts, parts))
                        continue
                    tag = tifffile.TiffTag.fromfile(file, offset=at, header=entry)  # type: ignore[arg-type]
                    if code == _EXIF:
                        followers.append(tag.valueoffset)
                    elif code == _SUB_DIRECTORIES:
                        followers += _values(tag)
                    else:
                        tags[_NAME_OF_CODE[code]] = _values(tag)
            found += [tags] if tags else []
            for at in (*followers, following):
                if isinstance(at, int) and 8 <= at < 2**32 and at not in known:
                    known.add(at)
                    queue.append(at)
    return found


def _read_entries(file: SimpleNamespace, offset: int) -> tuple[dict[int, bytes], int]:
    """The entries of a directory by their positions, and where the next directory is."""
    handle, order = file.filehandle, file.tiff.byteorder
    handle.seek(offset)
    head = handle.read(2)
    count = struct.unpack(f"{order}H", head)[0] if len(head) == 2 and offset >= 8 else 0
    content = handle.read(12 * count + 4) if count <= _MAX_TAGS else b""
    if len(content) < 12 * count:
        return {}, 0
    following = struct.unpack(f"{order}I", content[-4:])[0] if len(content) % 12 == 4 else 0
    return {offset + 2 + at: content[at : at + 12] for at in range(0, 12 * count, 12)}, following


@contextmanager
def _silent_tifffile() -> Iterator[None]:
    """Keep tifffile from logging what is unusual about a raw, or damaged."""
    logger, nothing = logging.getLogger("tifffile"), logging.Filter("nothing of this name")
    logger.addFilter(nothing)
    try:
        yield
    finally:
        logger.removeFilter(nothing)


def _values(tag: tifffile.TiffTag) -> tuple[Any, ...]:
    """The values of a tag as `Directory` has them."""
    value, kind = tag.value, tag.dtype
    if kind == tifffile.DATATYPE.ASCII:
        text = value.decode("utf-8", "replace") if isinstance(value, bytes) else value
        return (text.split("\0")[0].strip(),)
    if isinstance(value, bytes):
        return tuple(value) if kind == tifffile.DATATYPE.BYTE else (value,)
    return tuple(np.ravel(value).tolist())


def first(directories: Sequence[Directory], name: str) -> tuple[Any, ...] | None:
    """The values of a tag in the first directory that has it; None if there is none."""
    return next((tags[name] for tags in directories if name in tags), None)


def numbers(tags: Directory, name: str) -> tuple[float, ...]:
    """The values of a tag; empty where it is missing or any value is no finite number."""
    values = tags.get(name, ())
    return values if all(isinstance(v, int | float) and math.isfinite(v) for v in values) else ()


def first_numbers(directories: Sequence[Directory], name: str) -> tuple[float, ...]:
    """`numbers` of the first directory that has the tag; empty if there is none."""
    return next((numbers(tags, name) for tags in directories if name in tags), ())


def undefined(directories: Sequence[Directory], *names: str) -> bool:
    """Whether the first of `names` that is not 0 in a file is over a denominator of 0.

    LibRaw goes on to the next where one is 0, and takes 1 for such a denominator.
    """
    for name in names:
        if any(getattr(value, "numerator", value) for value in first(directories, name) or ()):
            return not first_numbers(directories, name)
    return False


def missing_bytes(directories: Sequence[Directory], size: int) -> int:
    """How many bytes of pixels lie beyond the end of a file of `size` bytes; 0 if it is whole.

    An offset of 2^32 - 1 and a count of 0 are no position: Panasonic's RW2 have their own tag.
    """
    end = size
    for tags in directories:
        begin, *sides, packing = (sum(numbers(tags, name)) for name in _PANASONIC.values())
        if begin and packing != 8:  # all others have 14 pixels in 16 bytes, or less
            end = max(end, int(begin + math.prod(sides) * 16 / 14))
        for offsets, counts in (_POSITIONS[:2], _POSITIONS[2:]):
            pairs = zip(numbers(tags, offsets), numbers(tags, counts), strict=False)
            end = max([end, *(int(a + b) for a, b in pairs if b and a != _NO_POSITION)])
    return end - size


# -- the camera of a file -------------------------------------------------------------------------

#: How raws begin: TIFF, Minolta MRW, ARRIRAW, Nokia, Fujifilm RAF, Sigma X3F, Raspberry Pi's JPEG.
_RAW_SIGNATURES = (
    *(b"II", b"MM", b"\0MRM", b"ARRI", b"NOKIARAW", b"FUJIFILM", b"FOVb", b"\xff\xd8\xff"),
)
#: Where a Canon CRW has it; the camera's name is in a directory at the end of that file.
_CIFF = slice(6, 14), b"HEAPCCDR"
#: Record type of make and model in Canon's CIFF, and of the heaps that hold further records.
_CIFF_MAKE_MODEL, _CIFF_HEAPS = 0x080A, (0x2800, 0x3000)
#: A Canon CRW has less than ten heaps of less than a hundred records.
_CIFF_MAX_HEAPS, _CIFF_MAX_RECORDS = 64, 1024


def is_raw_container(stream: BinaryIO) -> bool:
    """Whether a file that names no camera may be a raw all the same."""
    head = _read_at(stream, 0, 16)
    if head[_CIFF[0]] == _CIFF[1]:
        return False
    return head.startswith(_RAW_SIGNATURES) or head[4:8] == b"ftyp"


def camera_identity(stream: BinaryIO, directories: Sequence[Directory]) -> tuple[str, str]:
    """Make and model as the camera recorded them; ``("", "")`` where the file does not say."""
    for tags in directories:
        if tags.get("Model", ("",))[0]:
            return str(tags.get("Make", ("",))[0]), str(tags["Model"][0])
    unique = str((first(directories, "UniqueCameraModel") or ("",))[0])  # all that a DNG must say
    if unique:
        return unique.split()[0], unique
    head = _read_at(stream, 0, 2**16)
    if head[_CIFF[0]] == _CIFF[1]:
        return _ciff_identity(stream, struct.unpack_from("<I", head, 2)[0])
    if head[:8] == b"FUJIFILM":
        return "FUJIFILM", _text(head[28:60])
    # Minolta MRW and Canon CR3 have a TIFF directory in a block or box of these names.
    marker = b"\0TTW" if head[:4] == b"\0MRM" else b"CMT1" if head[4:8] == b"ftyp" else b""
    at = head.find(marker) if marker else 0
    if at > 0:
        start = at + (8 if marker == b"\0TTW" else 4)
        embedded = io.BytesIO(_read_at(stream, start, 2**20))
        return camera_identity(io.BytesIO(), read_directories(embedded))
    return "", ""


def _ciff_identity(stream: BinaryIO, start: int) -> tuple[str, str]:
    """Make and model from Canon CIFF heaps, each with its directory at its end."""
    size = stream.seek(0, io.SEEK_END)
    heaps = [(start, size)]
    for start, end in heaps:  # grows while it is read
        if end > size or end - start < 6:
            continue
        table = start + struct.unpack("<I", _read_at(stream, end - 4, 4))[0]
        if not start <= table <= end - 6:
            continue
        records = _read_at(stream, table, min(end - table, 2 + 10 * _CIFF_MAX_RECORDS))
        count = min(struct.unpack_from("<H", records)[0], (len(records) - 2) // 10)
        for kind, length, offset in struct.iter_unpack("<HII", records[2 : 2 + 10 * count]):
            first, last = start + offset, start + offset + length
            if kind == _CIFF_MAKE_MODEL and last <= end:
                make, model = (*_read_at(stream, first, min(length, 256)).split(b"\0"), b"")[:2]
                return _text(make), _text(model)
            if kind & 0x3800 in _CIFF_HEAPS and kind & 0xC000 == 0 and len(heaps) < _CIFF_MAX_HEAPS:
                heaps.append((first, last))
    return "", ""


def _read_at(stream: BinaryIO, offset: int, size: int) -> bytes:
    stream.seek(offset)
    return stream.read(size)


def _text(content: bytes) -> str:
    return content.split(b"\0")[0].decode("ascii", "replace").strip()


# -- the meaning of DNG tags that LibRaw does not pass on -----------------------------------------

#: ISO speeds above 65534 are in these; PhotographicSensitivity then is 65535.
LONG_ISO = ("RecommendedExposureIndex", "ISOSpeed", "StandardOutputSensitivity")
_EXPOSURE: dict[str, tuple[str, ...]] = {
    "iso": ("PhotographicSensitivity", LONG_ISO[0]),
    "exposure_time": ("ExposureTime",),
    "f_number": ("FNumber",),
}
#: Beyond these a file is damaged.
_MAX_BOX_FACTOR, _LARGEST_FACTOR = 4096, 1000.0


def read_own_record(directories: Sequence[Directory]) -> OwnRecord | None:
    """The record of a DNG that `write_dng` wrote, else None.

    A record that no longer agrees with the standard EXIF tags (someone edited them) yields to them
    where they can be a camera's.
    """
    software, comment = first(directories, "Software"), first(directories, "UserComment")
    if software is None or not str(software[0]).startswith(SOFTWARE_NAME) or comment is None:
        return None
    try:
        fields = json.loads(comment[0].removeprefix(COMMENT_PREFIX).rstrip(b"\0 ").decode("ascii"))
        settings = CameraSettings(**{key: float(fields[key]) for key in _EXPOSURE})
        box_factor, source = int(fields["box_factor"]), str(fields["colour_matrix_source"])
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        return None
    recorded = settings
    for key, name in ((key, name) for key, names in _EXPOSURE.items() for name in names):
        stated = getattr(recorded, key)
        written, rounding = stated, 1e-6 * stated
        if key == "iso":  # whole, at least 1, and in the older tag at most what 16 bits hold
            largest = 65535.0 if name == _EXPOSURE[key][0] else math.inf
            written, rounding = min(max(1.0, stated), largest), 0.5
        value = next(iter(first_numbers(directories, name)), written)
        if abs(value - written) > rounding:
            with suppress(ValueError):
                changed: Any = {key: float(value)}
                settings = replace(settings, **changed)
    return OwnRecord(settings, min(max(1, box_factor), _MAX_BOX_FACTOR), source)


def read_colour_matrix(
    directories: Sequence[Directory],
) -> tuple[tuple[float, float, float], ...] | None:
    """XYZ to camera RGB of a DNG, for D65 or else for its second or only illuminant.

    AnalogBalance and CameraCalibration are multiplied in (DNG specification 1.4, chapter 6).
    """
    chosen, letters = None, plane_letters(directories)
    for number in "12":
        values = first_numbers(directories, f"ColorMatrix{number}")
        calibration = first_numbers(directories, f"CameraCalibration{number}")
        balance = first_numbers(directories, "AnalogBalance")
        if len(values) != 9 or max(map(abs, (*values, *calibration, *balance))) > _LARGEST_FACTOR:
            continue
        matrix = np.array(values, np.float64).reshape(3, 3)
        if len(calibration) == 9:
            matrix = np.array(calibration, np.float64).reshape(3, 3) @ matrix
        if len(balance) == 3:
            matrix = np.array(balance, np.float64)[:, None] * matrix
        if abs(np.linalg.det(matrix)) > 1e-6:
            rows = matrix[[letters.index(letter) for letter in "RGB"]]
            chosen = tuple(tuple(float(v) for v in row) for row in rows)
            if first(directories, f"CalibrationIlluminant{number}") == (D65,):
                break
    return chosen  # type: ignore[return-value]


def plane_letters(directories: Sequence[Directory]) -> str:
    """Letters of the colour planes of a DNG, by which its tags are ordered; "RGB" of all others."""
    colours = first_numbers(directories, "CFAPlaneColor")
    return "".join("RGB"[int(c)] for c in colours) if sorted(colours) == [0, 1, 2] else "RGB"


def read_noise_profile(directories: Sequence[Directory]) -> NoiseLevelFunction | None:
    """The noise level function of a DNG's NoiseProfile, None if it has none that can be one.

    The tag holds pairs (S, O), one for all colour planes or one per plane in the order of
    CFAPlaneColor; the variance of a value x between black (0) and white (1) is S x + O
    (DNG specification 1.4).
    """
    values, letters = first_numbers(directories, "NoiseProfile"), plane_letters(directories)
    if len(values) == 2:
        values = tuple(values) * 3
    if len(values) != 6:
        return None
    if any(abs(v) > VARIANCE_LIMIT for v in values) or any(v < 0 for v in values[::2]):
        return None
    pairs = [2 * letters.index(letter) for letter in "RGGB"]
    return NoiseLevelFunction(
        shot=tuple(float(values[i]) for i in pairs),  # type: ignore[arg-type]
        read=tuple(max(0.0, float(values[i + 1])) for i in pairs),  # type: ignore[arg-type]
        source="DNG NoiseProfile of the file",
    )


def read_black_level(
    tags: Directory, cfa: BayerPattern, origin: tuple[int, int], shape: tuple[int, int]
) -> tuple[tuple[float, float, float, float], np.ndarray | None] | None:
    """Black level per plane R, G1, G2, B with its fraction, and (H, W) what pixels differ from it.

    The pixels' own differences are None where there are none. The level of a pixel is that of the
    tile, which begins at the corner of the ActiveArea, plus BlackLevelDeltaV of its row, plus
    BlackLevelDeltaH of its column (DNG specification 1.4). Four values without a
    BlackLevelRepeatDim are a tile of 2 x 2 (several writers of DNGs leave it out), one value is
    that of all pixels whatever the tile, and values beyond those of the tile count for nothing.

    `tags` are those of the directory that describes the mosaic, which begins with the order `cfa`
    at row and column `origin` of the file's array. None where the file has none or impossible ones.
    """
    values = numbers(tags, "BlackLevel")
    corner, tile = numbers(tags, "ActiveArea")[:2] or (0, 0), numbers(tags, "BlackLevelRepeatDim")
    if len(values) == 1 or (len(values) == 4 and "BlackLevelRepeatDim" not in tags):
        tile = (1, 1) if len(values) == 1 else (2, 2)
    fits = len(tile) == 2 and 0 < math.prod(tile) <= len(values) and min(values) >= 0
    if not fits or len(corner) != 2:
        return None
    rows, columns = map(int, tile)
    values = values[: rows * columns]
    down, right = (a - int(b) for a, b in zip(origin, corner, strict=True))
    # Alike in every 2 x 2 pixels, as in most files, it is looked at in those.
    varies = max(rows, columns) > 2 or "BlackLevelDeltaV" in tags or "BlackLevelDeltaH" in tags
    height, width = shape if varies else (2, 2)
    level = np.reshape(values, (rows, columns))
    level = level[(np.arange(height) + down) % rows][:, (np.arange(width) + right) % columns]
    for name, begin, count, axis in (
        ("BlackLevelDeltaV", down, height, (slice(None), None)),
        ("BlackLevelDeltaH", right, width, (None, slice(None))),
    ):
        if name in tags:
            deltas, places = np.array(numbers(tags, name)), np.arange(begin, begin + count)
            if len(deltas) <= places[-1]:
                return None
            level = level + deltas[places.clip(0)][axis]
    planes = [level[row::2, column::2] for row, column in cfa.offsets]
    # A level below 0, of negative deltas, is the pixels' own.
    means = [max(0.0, float(plane.mean())) for plane in planes]
    if all(np.ptp(plane) == 0.0 <= plane.min() for plane in planes):
        return tuple(means), None  # type: ignore[return-value]
    own = np.empty(shape, np.float32)
    for (row, column), plane, mean in zip(cfa.offsets, planes, means, strict=True):
        own[row::2, column::2] = plane - mean
    return tuple(means), own  # type: ignore[return-value]
