"""DNG files: a raw, simulated or not, for any raw developer."""

from __future__ import annotations

import itertools
import json
import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from importlib import metadata
from typing import Any

import numpy as np

from simulator.camera import VARIANCE_LIMIT, BayerPattern, NoiseLevelFunction
from simulator.raw.image import RawImage, unpack_mosaic
from simulator.raw.metadata import (
    MAKE,
    MODEL,
    SOFTWARE,
    Content,
    Directory,
    Tag,
    TiffType,
    numbers,
    tiff_head,
)
from simulator.settings import CameraSettings
from simulator.utils.files import as_path, write_atomically

# DNG tags that LibRaw does not hand on: noise profile, fractional black level, our own record.
#: Begins the Software tag of every DNG written here.
SOFTWARE_NAME = "ae-env"
USER_COMMENT = 37510
COMMENT_PREFIX = b"ASCII\0\0\0"
CFA_PLANE_COLOUR, NOISE_PROFILE = 50710, 51041
BLACK_REPEAT, BLACK_LEVEL, BLACK_DELTA_H, BLACK_DELTA_V = 50713, 50714, 50715, 50716
ACTIVE_AREA = 50829
ANALOG_BALANCE, D65 = 50727, 21
#: ColorMatrix, CameraCalibration and CalibrationIlluminant, first and second set.
_COLOUR_SETS = ((50721, 50723, 50778), (50722, 50724, 50779))
#: ISO speeds above 65534 stand in these; PhotographicSensitivity then says 65535.
_LONG_ISO_TAGS = (34866, 34867, 34865)
#: EXIF orientation for LibRaw's flip codes.
ORIENTATIONS = {0: 1, 3: 3, 5: 8, 6: 6}
#: Beyond these a file is damaged.
_MAX_BOX_FACTOR, _LARGEST_FACTOR = 4096, 1000.0
_EXPOSURE_TAGS = {"iso": 34866, "exposure_time": 33434, "f_number": 33437}


@dataclass(frozen=True)
class OwnRecord:
    """What `write_dng` notes in the EXIF comment because the standard tags would round it.

    Args:
        settings: Exact exposure settings.
        box_factor: Sensor pixels averaged per side into one pixel.
        colour_matrix_source: Where the colour matrix comes from; empty for the neutral default.
    """

    settings: CameraSettings
    box_factor: int
    colour_matrix_source: str

    def to_comment(self) -> bytes:
        """Value of the EXIF tag UserComment."""
        fields = {
            "iso": self.settings.iso,
            "exposure_time": self.settings.exposure_time,
            "f_number": self.settings.f_number,
            "box_factor": self.box_factor,
            "colour_matrix_source": self.colour_matrix_source,
        }
        return COMMENT_PREFIX + json.dumps(fields).encode("ascii")


def _first(directories: list[Directory], tag: int) -> tuple[Any, ...] | None:
    return next((d[tag] for d in directories if tag in d), None)


def first_numbers(directories: list[Directory], tag: int) -> tuple[float, ...]:
    """The field's values where it is first; empty if it is nowhere or not made of numbers."""
    return next((numbers(d, tag) for d in directories if tag in d), ())


def read_own_record(directories: list[Directory]) -> OwnRecord | None:
    """The record of a DNG that `write_dng` wrote, else None.

    A record that no longer agrees with the standard EXIF tags (someone edited them) yields to them
    where they can be a camera's.
    """
    software = _first(directories, SOFTWARE)
    comment = _first(directories, USER_COMMENT)
    if software is None or not str(software[0]).startswith(SOFTWARE_NAME) or comment is None:
        return None
    try:
        fields = json.loads(comment[0].removeprefix(COMMENT_PREFIX).rstrip(b"\0 ").decode("ascii"))
        settings = CameraSettings(**{k: float(fields[k]) for k in _EXPOSURE_TAGS})
        box_factor, source = int(fields["box_factor"]), str(fields["colour_matrix_source"])
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        return None
    for key, tag in _EXPOSURE_TAGS.items():
        stated = getattr(settings, key)
        value = next(iter(first_numbers(directories, tag)), stated)
        written, rounding = stated, 1e-6 * stated
        if key == "iso":  # whole, and at least 1
            written, rounding = max(1.0, stated), 0.5
        if abs(value - written) > rounding:
            with suppress(ValueError):
                settings = replace(settings, **{key: float(value)})
    return OwnRecord(settings, min(max(1, box_factor), _MAX_BOX_FACTOR), source)


def read_long_iso(directories: list[Directory]) -> float | None:
    """The ISO speed that does not fit EXIF's 16 bits, None where the file has none."""
    values = (first_numbers(directories, tag) for tag in _LONG_ISO_TAGS)
    return next((float(v[0]) for v in values if v and v[0] > 0), None)


def read_colour_matrix(
    directories: list[Directory],
) -> tuple[tuple[float, float, float], ...] | None:
    """XYZ to camera RGB of a DNG, for D65 or else for its second or only illuminant.

    AnalogBalance and CameraCalibration are multiplied in (DNG specification 1.4, chapter 6).
    """
    chosen = None
    for matrix_tag, calibration_tag, illuminant_tag in _COLOUR_SETS:
        values = first_numbers(directories, matrix_tag)
        calibration = first_numbers(directories, calibration_tag)
        balance = first_numbers(directories, ANALOG_BALANCE)
        if len(values) != 9 or max(map(abs, (*values, *calibration, *balance))) > _LARGEST_FACTOR:
            continue
        matrix = np.array(values, np.float64).reshape(3, 3)
        if len(calibration) == 9:
            matrix = np.array(calibration, np.float64).reshape(3, 3) @ matrix
        if len(balance) == 3:
            matrix = np.array(balance, np.float64)[:, None] * matrix
        if abs(np.linalg.det(matrix)) > 1e-6:
            chosen = tuple(tuple(float(v) for v in row) for row in matrix)
            if _first(directories, illuminant_tag) == (D65,):
                break
    return chosen  # type: ignore[return-value]


def read_noise_profile(directories: list[Directory]) -> NoiseLevelFunction | None:
    """The noise level function of a DNG's NoiseProfile tag (51041), None if it has none.

    The tag holds pairs (S, O), one for all colour planes or one per plane in the order of
    CFAPlaneColor; the variance of a value x between black (0) and white (1) is S x + O
    (DNG specification 1.4). Values that cannot be a noise profile are ignored: negative slopes, and
    variances that no capture has.
    """
    values = first_numbers(directories, NOISE_PROFILE)
    colours = first_numbers(directories, CFA_PLANE_COLOUR) or (0, 1, 2)
    if len(values) == 2:
        values = tuple(values) * len(colours)
    if len(values) != 2 * len(colours) or sorted(colours) != [0, 1, 2]:
        return None
    if any(abs(v) > VARIANCE_LIMIT for v in values) or any(v < 0 for v in values[::2]):
        return None
    slots = [tuple(colours).index(c) for c in (0, 1, 1, 2)]
    return NoiseLevelFunction(
        shot=tuple(float(values[2 * s]) for s in slots),  # type: ignore[arg-type]
        read=tuple(max(0.0, float(values[2 * s + 1])) for s in slots),  # type: ignore[arg-type]
        source="DNG NoiseProfile of the file",
    )


def read_black_level(
    directories: list[Directory], cfa: BayerPattern, origin: tuple[int, int]
) -> tuple[float, float, float, float] | None:
    """Black level per plane R, G1, G2, B with its fraction; None for other forms of the tag.

    Args:
        directories: The file's.
        cfa: Order of the colour filter array at `origin`.
        origin: Row and column of the file's array where the mosaic begins. The tag's tile begins
            at the corner of the ActiveArea (DNG specification 1.4).
    """
    where = next((d for d in directories if BLACK_LEVEL in d), None)
    if where is None or BLACK_DELTA_H in where or BLACK_DELTA_V in where:
        return None
    repeat, values = where.get(BLACK_REPEAT, (1, 1)), numbers(where, BLACK_LEVEL)
    if any(v < 0 for v in values):
        return None
    if tuple(repeat) == (1, 1) and len(values) == 1:
        values = tuple(values) * 4
    elif tuple(repeat) != (2, 2) or len(values) != 4:
        return None
    corner = numbers(where, ACTIVE_AREA)[:2] or (0, 0)
    if len(corner) != 2:
        return None
    down, right = (a - int(b) for a, b in zip(origin, corner, strict=True))
    return tuple(  # type: ignore[return-value]
        float(values[2 * ((row + down) % 2) + (column + right) % 2]) for row, column in cfa.offsets
    )


def read_plain_mosaic(data: Content, directories: list[Directory]) -> np.ndarray | None:
    """The pixels of an uncompressed one-strip Bayer DNG as `write_dng` writes it, (H, W) uint16.

    LibRaw crops and misreads very small frames of some makes; these pixels are plainly there.

    Returns:
        None if the file is laid out in another way.
    """
    where = next((d for d in directories if d.get(262) == (32803,)), {})
    if where.get(258) != (16,) or where.get(259) != (1,):
        return None
    layout = [numbers(where, tag) for tag in (257, 256, 273, 279)]
    if any(len(values) != 1 for values in layout):
        return None
    height, width, start, size = (int(values[0]) for values in layout)
    if min(height, width) < 2 or size != 2 * width * height or start + size > len(data):
        return None
    order = "<u2" if data[:2] == b"II" else ">u2"
    strip = np.frombuffer(data[start : start + size], order)
    return strip.reshape(height, width).astype(np.uint16, copy=False)


#: Colour matrix of a raw whose camera has none: its R, G, B are taken as linear sRGB primaries
#: (XYZ to sRGB, D65, IEC 61966-2-1).
DEFAULT_COLOUR_MATRIX = (
    (3.2406, -1.5372, -0.4986),
    (-0.9689, 1.8758, 0.0415),
    (0.0557, -0.2040, 1.0570),
)
#: What EXIF writes for a date that is not known.
_NO_DATE = "    :  :     :  :  "
_CFA_BYTE = {"R": 0, "G": 1, "B": 2}
#: Packed rows that are converted and written at a time: few, so that they stay in the cache.
_STRIP_ROWS = 32


def write_dng(path: str | os.PathLike[str], raw: RawImage) -> None:
    """Write `raw` as an uncompressed DNG that raw developers open at the right level and colour.

    `read_raw` brings back the same digital numbers, settings, white balance, levels and noise.
    The file carries the exposure in EXIF, the noise level function in NoiseProfile (greens
    averaged: the tag has one pair per colour), the white balance in AsShotNeutral and the camera's
    colour matrix; a camera without one is taken to see linear sRGB primaries
    (`DEFAULT_COLOUR_MATRIX`). Values are clipped to the camera's 0 .. white level and rounded.

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
    if not isinstance(raw, RawImage):
        raise ValueError(f"`raw` (={type(raw).__name__}) must be a RawImage")
    head = tiff_head(_image_tags(raw), _exif_tags(raw), 8 * raw.data[0].numel())
    write_atomically(path, itertools.chain([head], _strip(raw)))


def _strip(raw: RawImage) -> Iterator[bytes | memoryview]:
    """The mosaic as it stands in the file, a few rows at a time."""
    data, height = raw.data.detach().cpu().contiguous(), raw.data.shape[1]
    for first in range(0, height, _STRIP_ROWS):
        rows = unpack_mosaic(data, raw.camera, first, min(first + _STRIP_ROWS, height))
        yield rows.astype("<u2", copy=False).data.cast("B")


def _image_tags(raw: RawImage) -> dict[int, Tag]:
    camera = raw.camera
    height, width = 2 * raw.data.shape[1], 2 * raw.data.shape[2]
    matrix = camera.colour_matrix or DEFAULT_COLOUR_MATRIX
    make, model = camera.make, camera.model
    if model == "unknown":
        model = camera.name
    unique = model if model.lower().startswith(make.lower()) else f"{make} {model}"
    tags = {
        254: Tag(TiffType.LONG, [0]),  # a full-resolution image
        256: Tag(TiffType.LONG, [width]),
        257: Tag(TiffType.LONG, [height]),
        258: Tag(TiffType.SHORT, [16]),
        259: Tag(TiffType.SHORT, [1]),  # uncompressed: every reader takes that
        262: Tag(TiffType.SHORT, [32803]),  # colour filter array
        MAKE: Tag(TiffType.ASCII, make),
        MODEL: Tag(TiffType.ASCII, model),
        274: Tag(TiffType.SHORT, [ORIENTATIONS.get(raw.metadata.get("flip", 0), 1)]),
        277: Tag(TiffType.SHORT, [1]),
        278: Tag(TiffType.LONG, [height]),  # one strip
        284: Tag(TiffType.SHORT, [1]),
        SOFTWARE: Tag(TiffType.ASCII, f"{SOFTWARE_NAME} {_version()}"),
        306: Tag(TiffType.ASCII, _date(raw)),
        33421: Tag(TiffType.SHORT, [2, 2]),
        33422: Tag(TiffType.BYTE, [_CFA_BYTE[letter] for letter in camera.cfa.value]),
        50706: Tag(TiffType.BYTE, [1, 4, 0, 0]),
        50707: Tag(TiffType.BYTE, [1, 1, 0, 0]),
        50708: Tag(TiffType.ASCII, unique),
        CFA_PLANE_COLOUR: Tag(TiffType.BYTE, [0, 1, 2]),
        50711: Tag(TiffType.SHORT, [1]),  # rectangular layout
        50717: Tag(TiffType.LONG, [round(camera.white_level)]),
        50721: Tag(TiffType.SRATIONAL, [v for row in matrix for v in row]),
        50728: Tag(TiffType.RATIONAL, [_neutral(g) for g in raw.white_balance]),
        50730: Tag(TiffType.SRATIONAL, [0.0]),
        50778: Tag(TiffType.SHORT, [D65]),
    }
    return tags | _black_tags(raw) | _noise_tags(raw)


def _neutral(gain: float) -> float:
    """A grey card's value in AsShotNeutral: one over the gain, to the 12 digits that matter."""
    return float(f"{1.0 / gain:.12g}")


def _black_tags(raw: RawImage) -> dict[int, Tag]:
    black = raw.camera.black_level
    whole = all(b == round(b) for b in black)
    kind = TiffType.LONG if whole else TiffType.RATIONAL
    values = [round(b) for b in black] if whole else list(black)
    if len(set(black)) == 1:
        return {BLACK_LEVEL: Tag(kind, values[:1])}
    tile = [values[0]] * 4
    for value, (row, column) in zip(values, raw.camera.cfa.offsets, strict=True):
        tile[2 * row + column] = value
    return {BLACK_REPEAT: Tag(TiffType.SHORT, [2, 2]), BLACK_LEVEL: Tag(kind, tile)}


def _noise_tags(raw: RawImage) -> dict[int, Tag]:
    if raw.nlf is None and not raw.camera.nlf_by_iso:
        return {}  # not known; `read_raw` will estimate it
    noise: NoiseLevelFunction = raw.noise
    pairs: list[float] = []
    for planes in ((0,), (1, 2), (3,)):
        pairs += [float(np.mean([noise.shot[p] for p in planes]))]
        pairs += [float(np.mean([noise.read[p] for p in planes]))]
    return {NOISE_PROFILE: Tag(TiffType.DOUBLE, pairs)}


def _exif_tags(raw: RawImage) -> dict[int, Tag]:
    settings = raw.settings
    iso = max(1, round(settings.iso))
    record = OwnRecord(
        settings,
        raw.box_factor,
        (raw.camera.colour_matrix_source or "given") if raw.camera.colour_matrix else "",
    )
    return {
        33434: Tag(TiffType.RATIONAL, [settings.exposure_time]),
        33437: Tag(TiffType.RATIONAL, [settings.f_number]),
        34855: Tag(TiffType.SHORT, [min(iso, 65535)]),  # 65535 sends readers to tag 34866
        34864: Tag(TiffType.SHORT, [2]),  # sensitivity is the recommended exposure index
        34866: Tag(TiffType.LONG, [iso]),
        36864: Tag(TiffType.UNDEFINED, b"0230"),
        36867: Tag(TiffType.ASCII, _date(raw)),
        36868: Tag(TiffType.ASCII, _date(raw)),
        37386: Tag(TiffType.RATIONAL, [float(raw.metadata.get("focal_length", 0.0))]),
        USER_COMMENT: Tag(TiffType.UNDEFINED, record.to_comment()),
    }


def _date(raw: RawImage) -> str:
    """When the photograph was taken, as EXIF spells it; blanks where not known."""
    try:
        moment = datetime.fromisoformat(str(raw.metadata.get("datetime", "")))
    except ValueError:
        return _NO_DATE
    return moment.strftime("%Y:%m:%d %H:%M:%S")


def _version() -> str:
    try:
        return metadata.version("ae-env")
    except metadata.PackageNotFoundError:
        return "0"
