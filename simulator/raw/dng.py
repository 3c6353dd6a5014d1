"""Writing DNG files: a raw, simulated or not, for any raw developer.

The tags stand here by their names in TIFF 6.0, EXIF 2.3 and the DNG specification 1.4. The file has
one uncompressed strip: the only layout that every raw developer in use reads.
"""

import itertools
import json
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from fractions import Fraction
from typing import Any

import numpy as np
import tifffile
from tifffile import DATATYPE

from simulator import __version__
from simulator.raw.image import RawImage, unpack_mosaic
from simulator.settings import CameraSettings
from simulator.utils.checks import check_type
from simulator.utils.files import as_path, write_atomically

#: Begins the Software tag of every DNG written here.
SOFTWARE_NAME = "ae-env"
#: Begins a UserComment in ASCII.
COMMENT_PREFIX = b"ASCII\0\0\0"
#: EXIF's code for daylight of 6500 K.
D65 = 21
#: EXIF orientation for LibRaw's flip codes.
ORIENTATIONS = {0: 1, 1: 2, 2: 4, 3: 3, 4: 5, 5: 8, 6: 6, 7: 7}
#: What a developer is to do with the pixels of a DNG, gain maps of the lens among it; passed on.
OPCODES: tuple[str, ...] = ("OpcodeList1", "OpcodeList2", "OpcodeList3")
#: Colour matrix of a raw whose camera has none: its R, G, B are taken as linear sRGB primaries
#: (XYZ to sRGB, D65, IEC 61966-2-1).
DEFAULT_COLOUR_MATRIX = (
    (3.2406, -1.5372, -0.4986),
    (-0.9689, 1.8758, 0.0415),
    (0.0557, -0.2040, 1.0570),
)
#: A field to write: its type and its values (rationals as numbers, text as ``str``).
Tag = tuple[DATATYPE, Sequence[float] | str | bytes]
_CFA_BYTE = {"R": 0, "G": 1, "B": 2}
_UNCOMPRESSED, _COLOUR_FILTER_ARRAY, _RECTANGULAR = 1, 32803, 1
#: Packed rows that are converted and written at a time: few, so that they stay in the CPU's cache.
_STRIP_ROWS = 32


@dataclass(frozen=True)
class OwnRecord:
    """A note of `write_dng` in the EXIF comment: values that the standard tags would round.

    The source of the colour matrix is empty for the neutral default.
    """

    settings: CameraSettings
    box_factor: int
    colour_matrix_source: str

    def to_comment(self) -> bytes:
        """Value of the EXIF tag UserComment."""
        names = ("iso", "exposure_time", "f_number")
        fields = {name: getattr(self.settings, name) for name in names}
        own = {"box_factor": self.box_factor, "colour_matrix_source": self.colour_matrix_source}
        return COMMENT_PREFIX + json.dumps(fields | own).encode("ascii")


def write_dng(path: str | os.PathLike[str], raw: RawImage) -> None:
    """Write `raw` as an uncompressed DNG that raw developers open at the right level and colour.

    `read_raw` brings back the same digital numbers, settings, white balance, levels and noise.
    The file carries the exposure in EXIF, the noise level function in NoiseProfile (greens
    averaged: the tag has one pair per colour), the white balance in AsShotNeutral and the camera's
    colour matrix; a camera without one is taken to see linear sRGB primaries
    (`DEFAULT_COLOUR_MATRIX`). Of another DNG, its opcode lists (gain maps) go along while the frame
    has its size, and its BaselineExposure. Values are rounded, from 0 to the camera's white level.

    Args:
        path: Where to, ending in ``.dng``. The folder is made; an existing file is replaced once
            the new one is whole.
        raw: What to write. Box-averaged raws state the noise of the averaged pixels.

    Raises:
        ValueError: If `path` does not end in ``.dng``.
        OSError: If the file cannot be written; nothing half-written stays.
    """
    path = as_path(path)
    if path.suffix.lower() != ".dng":
        raise ValueError(f"`path` (={str(path)!r}) must end in '.dng'")
    check_type("raw", raw, RawImage)
    head = tiff_head(_image_tags(raw), _exif_tags(raw), 8 * raw.data[0].numel())
    write_atomically(path, itertools.chain([head], _strip(raw)), synced=False)


def _strip(raw: RawImage) -> Iterator[bytes | memoryview]:
    """The mosaic as it stands in the file, a few rows at a time."""
    data, height = raw.data.detach().cpu().contiguous(), raw.data.shape[1]
    for first in range(0, height, _STRIP_ROWS):
        rows = unpack_mosaic(data, raw.camera, first, min(first + _STRIP_ROWS, height))
        yield rows.astype("<u2", copy=False).data.cast("B")


def _image_tags(raw: RawImage) -> dict[str, Tag]:
    camera = raw.camera
    height, width = 2 * raw.data.shape[1], 2 * raw.data.shape[2]
    matrix = camera.colour_matrix or DEFAULT_COLOUR_MATRIX
    make, model = camera.make, camera.name if camera.model == "unknown" else camera.model
    aspect = raw.metadata.get("pixel_aspect", 1.0)
    unique = model if model.lower().startswith(make.lower()) else f"{make} {model}"
    # A grey card's values: one over the gains, to the 12 digits that matter.
    neutral = [float(f"{1.0 / gain:.12g}") for gain in raw.white_balance]
    return {
        "NewSubfileType": (DATATYPE.LONG, [0]),  # a full-resolution image
        "ImageWidth": (DATATYPE.LONG, [width]),
        "ImageLength": (DATATYPE.LONG, [height]),
        "BitsPerSample": (DATATYPE.SHORT, [16]),
        "Compression": (DATATYPE.SHORT, [_UNCOMPRESSED]),
        "PhotometricInterpretation": (DATATYPE.SHORT, [_COLOUR_FILTER_ARRAY]),
        "Make": (DATATYPE.ASCII, make),
        "Model": (DATATYPE.ASCII, model),
        "Orientation": (DATATYPE.SHORT, [ORIENTATIONS.get(raw.metadata.get("flip", 0), 1)]),
        "SamplesPerPixel": (DATATYPE.SHORT, [1]),
        "RowsPerStrip": (DATATYPE.LONG, [height]),
        "PlanarConfiguration": (DATATYPE.SHORT, [1]),
        "Software": (DATATYPE.ASCII, f"{SOFTWARE_NAME} {__version__}"),
        "DateTime": (DATATYPE.ASCII, _date(raw)),
        "CFARepeatPatternDim": (DATATYPE.SHORT, [2, 2]),
        "CFAPattern": (DATATYPE.BYTE, [_CFA_BYTE[letter] for letter in camera.cfa.value]),
        "DNGVersion": (DATATYPE.BYTE, [1, 4, 0, 0]),
        "DNGBackwardVersion": (DATATYPE.BYTE, [1, 1, 0, 0]),
        "UniqueCameraModel": (DATATYPE.ASCII, unique),
        "CFAPlaneColor": (DATATYPE.BYTE, [0, 1, 2]),
        "CFALayout": (DATATYPE.SHORT, [_RECTANGULAR]),
        "WhiteLevel": (DATATYPE.LONG, [round(camera.white_level)]),
        "ColorMatrix1": (DATATYPE.SRATIONAL, [v for row in matrix for v in row]),
        "CalibrationIlluminant1": (DATATYPE.SHORT, [D65]),
        "AsShotNeutral": (DATATYPE.RATIONAL, neutral),
        "BaselineExposure": (DATATYPE.SRATIONAL, [raw.metadata.get("baseline_exposure", 0.0)]),
        **_black_tags(raw),
        **({} if aspect == 1.0 else {"DefaultScale": (DATATYPE.RATIONAL, [aspect, 1])}),
        **_noise_tags(raw),
        **_opcode_tags(raw),
    }


def _opcode_tags(raw: RawImage) -> dict[str, Tag]:
    """Opcode lists of the source; their positions are those of a frame of its size."""
    size, lists = raw.metadata.get("opcodes", ((), {}))
    fits = tuple(size) == tuple(raw.data.shape[1:]) and raw.box_factor == 1
    return {name: (DATATYPE.UNDEFINED, lists[name]) for name in OPCODES if fits and name in lists}


def _black_tags(raw: RawImage) -> dict[str, Tag]:
    black = raw.camera.black_level
    whole = all(b == round(b) for b in black)
    kind = DATATYPE.LONG if whole else DATATYPE.RATIONAL
    values = [round(b) for b in black] if whole else list(black)
    if len(set(black)) == 1:
        return {"BlackLevel": (kind, values[:1])}
    tile = [values[0]] * 4
    for value, (row, column) in zip(values, raw.camera.cfa.offsets, strict=True):
        tile[2 * row + column] = value
    return {"BlackLevelRepeatDim": (DATATYPE.SHORT, [2, 2]), "BlackLevel": (kind, tile)}


def _noise_tags(raw: RawImage) -> dict[str, Tag]:
    if raw.nlf is None and not raw.camera.nlf_by_iso:
        return {}  # not known; `read_raw` will estimate it
    noise, pairs = raw.noise, list[float]()
    for planes in ((0,), (1, 2), (3,)):
        pairs += [float(np.mean([noise.shot[p] for p in planes]))]
        pairs += [float(np.mean([noise.read[p] for p in planes]))]
    return {"NoiseProfile": (DATATYPE.DOUBLE, pairs)}


def _exif_tags(raw: RawImage) -> dict[str, Tag]:
    settings, camera = raw.settings, raw.camera
    iso = max(1, round(settings.iso))
    source = (camera.colour_matrix_source or "given") if camera.colour_matrix else ""
    record = OwnRecord(settings, raw.box_factor, source)
    return {
        "ExposureTime": (DATATYPE.RATIONAL, [settings.exposure_time]),
        "FNumber": (DATATYPE.RATIONAL, [settings.f_number]),
        # 65535 sends readers to RecommendedExposureIndex, which SensitivityType 2 announces.
        "PhotographicSensitivity": (DATATYPE.SHORT, [min(iso, 65535)]),
        "SensitivityType": (DATATYPE.SHORT, [2]),
        "RecommendedExposureIndex": (DATATYPE.LONG, [iso]),
        "ExifVersion": (DATATYPE.UNDEFINED, b"0230"),
        "DateTimeOriginal": (DATATYPE.ASCII, _date(raw)),
        "DateTimeDigitized": (DATATYPE.ASCII, _date(raw)),
        "FocalLength": (DATATYPE.RATIONAL, [float(raw.metadata.get("focal_length", 0.0))]),
        "UserComment": (DATATYPE.UNDEFINED, record.to_comment()),
    }


def _date(raw: RawImage) -> str:
    try:
        moment = datetime.fromisoformat(str(raw.metadata.get("datetime", "")))
    except ValueError:
        return "    :  :     :  :  "  # as EXIF spells a date that is not known
    return moment.strftime("%Y:%m:%d %H:%M:%S")


# -- TIFF -----------------------------------------------------------------------------------------


def _encode(kind: DATATYPE, values: Sequence[float] | str | bytes) -> tuple[int, bytes]:
    """Number of the values of a field, and their bytes, little endian."""
    if isinstance(values, str):
        values = values.encode("ascii", "replace") + b"\0"
    if isinstance(values, bytes):
        return len(values), values
    flat: list[Any] = list(values)
    if kind in (DATATYPE.RATIONAL, DATATYPE.SRATIONAL):
        signed = kind == DATATYPE.SRATIONAL
        flat = [part for value in flat for part in as_rational(value, signed=signed)]
    return len(values), struct.pack(f"<{len(flat)}{tifffile.TIFF.DATA_FORMATS[kind][-1]}", *flat)


def as_rational(value: float, *, signed: bool = False) -> tuple[int, int]:
    """Numerator and denominator, each in 32 bits, nearest to `value`.

    >>> as_rational(1 / 60), as_rational(2.8), as_rational(0.0)
    ((1, 60), (14, 5), (0, 1))
    """
    limit = 2**31 - 1 if signed else 2**32 - 1
    exact = Fraction(value)
    if abs(exact) > limit or (exact < 0 and not signed):
        raise ValueError(f"`value` (={value!r}) must fit a {'signed ' * signed}32-bit rational")
    # The simplest fraction that is the same float64: 1/60 stays 1/60.
    bound = limit if abs(exact) <= 1 else max(1, int(limit / abs(exact)))
    for denominator in (1000, 100_000, bound):
        candidate = exact.limit_denominator(min(denominator, bound))
        if candidate.numerator / candidate.denominator == value:
            break
    return candidate.numerator, candidate.denominator


def _pack_directory(tags: Mapping[str, Tag], offset: int) -> bytes:
    """A directory that begins at `offset` of the file, followed by its out-of-line values."""
    entries, outside = [], b""
    values_at = offset + 2 + 12 * len(tags) + 4
    codes = {int(tifffile.TIFF.EXIF_TAGS[name]): tag for name, tag in tags.items()}
    for code, tag in sorted(codes.items()):
        count, data = _encode(*tag)
        if len(data) > 4:
            field = struct.pack("<I", values_at + len(outside))
            outside += data + b"\0" * (len(data) % 2)
        else:
            field = data.ljust(4, b"\0")
        entries.append(struct.pack("<HHI", code, tag[0], count) + field)
    return struct.pack("<H", len(tags)) + b"".join(entries) + b"\0\0\0\0" + outside


def tiff_head(tags: Mapping[str, Tag], exif: Mapping[str, Tag], size: int) -> bytes:
    """A little-endian TIFF file of one strip of `size` bytes, up to where the strip begins.

    The positions of the strip and of the EXIF directory are filled in.
    """

    def directory(strip_at: int, exif_at: int) -> bytes:
        positions = {"StripOffsets": strip_at, "StripByteCounts": size, "ExifTag": exif_at}
        own: dict[str, Tag] = {name: (DATATYPE.LONG, [value]) for name, value in positions.items()}
        return _pack_directory({**tags, **own}, 8)

    exif_at = 8 + len(directory(0, 0))
    packed_exif = _pack_directory(exif, exif_at)
    strip_at = -(-(exif_at + len(packed_exif)) // 16) * 16
    head = struct.pack("<2sHI", b"II", 42, 8) + directory(strip_at, exif_at) + packed_exif
    return head.ljust(strip_at, b"\0")
