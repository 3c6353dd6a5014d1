"""DNG tags that LibRaw does not hand on: noise profile, fractional black level, our own record."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from simulator.camera import VARIANCE_LIMIT, BayerPattern, NoiseLevelFunction
from simulator.exif import SOFTWARE
from simulator.settings import CameraSettings
from simulator.tiff import Content, Directory, numbers

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
