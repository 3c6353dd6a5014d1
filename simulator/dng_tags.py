"""DNG tags that LibRaw does not hand on: noise profile, fractional black level, our own record."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from simulator.camera import BayerPattern, NoiseLevelFunction
from simulator.exif import SOFTWARE
from simulator.settings import CameraSettings
from simulator.tiff import Content, Directory

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


def read_own_record(directories: list[Directory]) -> OwnRecord | None:
    """The record of a DNG that `write_dng` wrote, else None.

    A record that no longer agrees with the standard EXIF tags (someone edited them) yields to them.
    """
    software = _first(directories, SOFTWARE)
    comment = _first(directories, USER_COMMENT)
    if software is None or not str(software[0]).startswith(SOFTWARE_NAME) or comment is None:
        return None
    try:
        fields = json.loads(comment[0].removeprefix(COMMENT_PREFIX).rstrip(b"\0 ").decode("ascii"))
        stated = {k: float(fields[k]) for k in _EXPOSURE_TAGS}
        box_factor, source = int(fields["box_factor"]), str(fields["colour_matrix_source"])
    except (ValueError, KeyError, TypeError):
        return None
    for key, tag in _EXPOSURE_TAGS.items():
        value = _first(directories, tag)
        rounding = 0.5 if key == "iso" else 1e-6 * stated[key]
        if value is not None and not abs(value[0] - stated[key]) <= rounding:
            stated[key] = float(value[0])
    return OwnRecord(CameraSettings(**stated), max(1, box_factor), source)


def read_long_iso(directories: list[Directory]) -> float | None:
    """The ISO speed that does not fit EXIF's 16 bits, None where the file has none."""
    values = (_first(directories, tag) for tag in _LONG_ISO_TAGS)
    return next((float(v[0]) for v in values if v is not None and v[0] > 0), None)


def read_colour_matrix(
    directories: list[Directory],
) -> tuple[tuple[float, float, float], ...] | None:
    """XYZ to camera RGB of a DNG, for D65 or else for its second or only illuminant.

    AnalogBalance and CameraCalibration are multiplied in (DNG specification 1.4, chapter 6).
    """
    chosen = None
    for matrix_tag, calibration_tag, illuminant_tag in _COLOUR_SETS:
        values = _first(directories, matrix_tag)
        if values is None or len(values) != 9:
            continue
        matrix = np.array(values, np.float64).reshape(3, 3)
        calibration = _first(directories, calibration_tag)
        if calibration is not None and len(calibration) == 9:
            matrix = np.array(calibration, np.float64).reshape(3, 3) @ matrix
        balance = _first(directories, ANALOG_BALANCE)
        if balance is not None and len(balance) == 3:
            matrix = np.array(balance, np.float64)[:, None] * matrix
        if np.isfinite(matrix).all() and abs(np.linalg.det(matrix)) > 1e-6:
            chosen = tuple(tuple(float(v) for v in row) for row in matrix)
            if _first(directories, illuminant_tag) == (D65,):
                break
    return chosen  # type: ignore[return-value]


def read_noise_profile(directories: list[Directory]) -> NoiseLevelFunction | None:
    """The noise level function of a DNG's NoiseProfile tag (51041), None if it has none.

    The tag holds pairs (S, O), one for all colour planes or one per plane in the order of
    CFAPlaneColor; the variance of a value x between black (0) and white (1) is S x + O
    (DNG specification 1.4). Values that cannot be a noise profile are ignored.
    """
    values = _first(directories, NOISE_PROFILE)
    if values is None:
        return None
    colours = _first(directories, CFA_PLANE_COLOUR) or (0, 1, 2)
    if len(values) == 2:
        values = tuple(values) * len(colours)
    if len(values) != 2 * len(colours) or sorted(colours) != [0, 1, 2]:
        return None
    if not all(math.isfinite(v) for v in values) or any(v < 0 for v in values[::2]):
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
    repeat, values = where.get(BLACK_REPEAT, (1, 1)), where[BLACK_LEVEL]
    if tuple(repeat) == (1, 1) and len(values) == 1:
        values = tuple(values) * 4
    elif tuple(repeat) != (2, 2) or len(values) != 4:
        return None
    down, right = (a - b for a, b in zip(origin, where.get(ACTIVE_AREA, (0, 0))[:2], strict=True))
    return tuple(  # type: ignore[return-value]
        float(values[2 * ((row + down) % 2) + (column + right) % 2]) for row, column in cfa.offsets
    )


def read_plain_mosaic(data: Content, directories: list[Directory]) -> np.ndarray | None:
    """The pixels of an uncompressed one-strip Bayer DNG as `write_dng` writes it, (H, W) uint16.

    LibRaw crops and misreads very small frames of some makes; these pixels are plainly there.

    Returns:
        None if the file is laid out in another way.
    """
    where = next((d for d in directories if d.get(262, (0,))[0] == 32803), None)
    if where is None or where.get(259, (0,))[0] != 1 or len(where.get(273, ())) != 1:
        return None
    width, height = int(where[256][0]), int(where[257][0])
    start, size = int(where[273][0]), 2 * width * height
    if where.get(258, (0,))[0] != 16 or int(where[279][0]) != size:
        return None
    order = "<u2" if data[:2] == b"II" else ">u2"
    strip = np.frombuffer(data[start : start + size], order)
    return strip.reshape(height, width).astype(np.uint16, copy=False)
