"""Decoding raw files before their camera is known: by LibRaw, or directly for our own DNGs."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import rawpy

from simulator.camera import BayerPattern
from simulator.raw.dng import ORIENTATIONS, OwnRecord
from simulator.raw.metadata import (
    NO_RAWS,
    TIFF_FILE,
    UNKNOWN_FILE,
    Directory,
    first,
    first_numbers,
    numbers,
    read_black_level,
    read_colour_matrix,
    read_long_iso,
)
from simulator.utils.files import refuse_bomb

logger = logging.getLogger(__name__)

#: PhotometricInterpretation of a raw, and of a DNG that is demosaicked already.
COLOUR_FILTER_ARRAY, LINEAR_RAW = 32803, 34892
#: Compression of DNGs that LibRaw decodes: none, lossless JPEG, deflate; and GoPro's.
_COMPRESSIONS, _VC5 = (1, 7, 8), 9
_LETTERS = {0: "R", 1: "G", 2: "B"}
_DNG_MATRIX = "XYZ to camera RGB, ColorMatrix of the file"


class RawFileError(ValueError):
    """A file that is not a Bayer raw, or not a whole one; the message says what it is."""

    @classmethod
    def of(cls, path: Path, text: str) -> RawFileError:
        """An error about the file at `path`, which is called by its name alone."""
        return cls(f"`path` (={path.name!r}) {text}")


@dataclass(frozen=True)
class Decoded:
    """The mosaic of a file, and its description by the file."""

    mosaic: np.ndarray  # (H, W) uint16, visible area
    cfa: BayerPattern
    black_level: tuple[float, float, float, float]
    white_level: float
    white_balance: tuple[float, float, float]
    white_balance_source: str
    colour_matrix: tuple[tuple[float, float, float], ...] | None
    colour_matrix_source: str
    exposure: tuple[float, float, float]  # ISO, seconds, f-number; 0 where the file does not say
    extra: dict[str, Any]


# -- DNGs of `write_dng` --------------------------------------------------------------------------


def decode_own_dng(path: Path, directories: Sequence[Directory], own: OwnRecord) -> Decoded | None:
    """A DNG of `write_dng` without LibRaw, which misreads very small frames of some makes.

    Returns:
        None if another program has changed the layout of its pixels.

    Raises:
        RawFileError: If it is damaged.
    """
    mosaic = _plain_mosaic(path, directories)
    if mosaic is None:
        return None
    tile = first_numbers(directories, "CFAPattern")
    letters = "".join(_LETTERS.get(int(colour), "?") for colour in tile)
    if letters not in {p.value for p in BayerPattern}:
        raise RawFileError.of(
            path,
            f"must have a Bayer tile of 0 (R), 1 (G), 2 (B), but its CFAPattern is {tile}: damaged",
        )
    black = read_black_level(directories, BayerPattern(letters), (0, 0))
    if black is None:
        return None
    white = next(iter(first_numbers(directories, "WhiteLevel")), 0.0)
    neutral = first_numbers(directories, "AsShotNeutral")
    known = len(neutral) == 3 and min(neutral) > 0
    red, green, blue = neutral if known else (1.0, 1.0, 1.0)
    flips = {orientation: flip for flip, orientation in ORIENTATIONS.items()}
    orientation = next(iter(first_numbers(directories, "Orientation")), 1)
    extra: dict[str, Any] = {"flip": flips.get(int(orientation), 0)}
    moment = str((first(directories, "DateTimeOriginal") or ("",))[0])
    with suppress(ValueError):  # blanks where it is not known
        extra["datetime"] = datetime.strptime(moment.strip(), "%Y:%m:%d %H:%M:%S").isoformat()
    focal_length = next(iter(first_numbers(directories, "FocalLength")), 0.0)
    if focal_length > 0:
        extra["focal_length"] = float(focal_length)
    scale = first_numbers(directories, "DefaultScale")
    extra |= _pixel_aspect(scale[0] / scale[1] if len(scale) == 2 and scale[1] > 0 else 1.0)
    return Decoded(
        mosaic=mosaic,
        cfa=BayerPattern(letters),
        black_level=black,
        white_level=_white_level(path, white, black, directories, mosaic),
        white_balance=(green / red, 1.0, green / blue),
        white_balance_source="camera" if known else "none",
        colour_matrix=read_colour_matrix(directories),
        colour_matrix_source=_DNG_MATRIX,
        exposure=(own.settings.iso, own.settings.exposure_time, own.settings.f_number),
        extra=extra,
    )


def _plain_mosaic(path: Path, directories: Sequence[Directory]) -> np.ndarray | None:
    """The pixels of an uncompressed one-strip Bayer DNG, (H, W) uint16; None in other layouts."""
    tags = _mosaic_directory(directories)
    if tags.get("BitsPerSample") != (16,) or tags.get("Compression") != (1,):
        return None
    names = ("ImageLength", "ImageWidth", "StripOffsets", "StripByteCounts")
    layout = [numbers(tags, name) for name in names]
    if any(len(values) != 1 for values in layout):
        return None
    height, width, start, size = (int(values[0]) for values in layout)
    if min(height, width) < 2 or size != 2 * width * height or start + size > os.stat(path).st_size:
        return None
    with path.open("rb") as stream:
        order = "<u2" if stream.read(2) == b"II" else ">u2"
        strip = np.fromfile(stream, order, width * height, offset=start - 2)
    if strip.size < width * height:
        raise RawFileError.of(path, "became shorter while it was read")
    return strip.reshape(height, width).astype(np.uint16, copy=False)


# -- any raw --------------------------------------------------------------------------------------


def decode_with_libraw(
    path: Path, words: str, directories: Sequence[Directory], opened: ExitStack
) -> Decoded:
    """A file as LibRaw reads it.

    Args:
        path: The file.
        words: What kind of file it is, for error messages.
        directories: Its TIFF directories.
        opened: Closes LibRaw's memory, in which the mosaic lies.

    Raises:
        RawFileError: If LibRaw cannot read it, or it is no Bayer raw.
    """
    try:
        raw = opened.enter_context(rawpy.imread(str(path)))
        # No pixel is decoded before one is asked for.
        bomb = refuse_bomb(raw.sizes.raw_height, raw.sizes.raw_width, os.stat(path).st_size)
        if bomb:
            raise RawFileError.of(path, f"({words}) {bomb}")
        return _from_libraw(path, raw, words, directories)
    except (rawpy.LibRawError, rawpy.NotSupportedError, RuntimeError) as error:
        raise RawFileError.of(path, _reason(error, words, directories)) from None


def _reason(error: Exception, words: str, directories: Sequence[Directory]) -> str:
    """Why LibRaw cannot read a file that its directory does not call cut short."""
    compression = next(iter(_mosaic_directory(directories).get("Compression", ())), 1)
    if "WhiteLevel" in _mosaic_directory(directories) and compression not in _COMPRESSIONS:
        kind = " (VC-5, GoPro's)" if compression == _VC5 else ""
        return (
            f"cannot be decoded: LibRaw lacks its compression, {compression}{kind}; convert it to "
            "an uncompressed DNG"
        )
    if isinstance(error, rawpy.LibRawFileUnsupportedError) or words in NO_RAWS:
        cut = ", or is truncated" if words in (TIFF_FILE, UNKNOWN_FILE) else ""
        return f"must be a camera raw that LibRaw reads, but is {words}{cut}"
    reason = error.args[0] if error.args else error
    reason = reason.decode() if isinstance(reason, bytes) else reason
    return f"must be a whole raw file, but LibRaw says {reason}: {words}, truncated or damaged"


def stated_exposure(path: Path, directories: Sequence[Directory]) -> tuple[float, float, float]:
    """ISO, exposure time [s] and f-number that a raw states; no pixel is decoded.

    Raises:
        RawFileError: If LibRaw cannot read it.
    """
    try:
        with rawpy.imread(str(path)) as raw:
            return _exposure(raw, directories)
    except (rawpy.LibRawError, rawpy.NotSupportedError, RuntimeError) as error:
        raise RawFileError.of(path, _reason(error, UNKNOWN_FILE, directories)) from None


def _exposure(raw: rawpy.RawPy, directories: Sequence[Directory]) -> tuple[float, float, float]:
    other = raw.other
    iso = other.iso_speed if other.iso_speed != 65535 else read_long_iso(directories) or 65535.0
    return iso, other.shutter_speed, other.aperture


def _from_libraw(
    path: Path, raw: rawpy.RawPy, words: str, directories: Sequence[Directory]
) -> Decoded:
    sizes = raw.sizes
    if raw.raw_type != rawpy.RawType.Flat:
        text = "must be a Bayer raw, but has every colour at every pixel (linear or Foveon)"
        raise RawFileError.of(path, f"{text}: {words}")
    indices = _tile_indices(path, raw, words)
    cfa = BayerPattern("".join(raw.color_desc.decode()[i] for i in indices))
    order = [indices[2 * row + column] for row, column in cfa.offsets]  # R, G1, G2, B
    black = [float(raw.black_level_per_channel[i]) for i in order]
    exact = read_black_level(directories, cfa, (sizes.top_margin, sizes.left_margin))
    if exact is not None and np.abs(np.sort(exact) - np.sort(black)).max() < 1.0:
        # LibRaw drops the fraction, and the phase where it moves an odd margin to an even one.
        black = list(exact)
    white_balance, source = _white_balance(raw)
    matrix, matrix_source = _colour_matrix(raw, directories)
    mosaic = raw.raw_image_visible
    if min(mosaic.shape) < 2:
        raise RawFileError.of(path, f"must hold an image, but is empty: {words}")
    other, extra = raw.other, dict[str, Any](flip=int(sizes.flip))
    if other.timestamp is not None and other.timestamp.timestamp() > 0:
        extra["datetime"] = other.timestamp.replace(tzinfo=None).isoformat()
    if np.isfinite(other.focal_length) and other.focal_length > 0:
        extra["focal_length"] = float(other.focal_length)
    extra |= _pixel_aspect(sizes.pixel_aspect)
    return Decoded(
        mosaic=mosaic,
        cfa=cfa,
        black_level=tuple(black),  # type: ignore[arg-type]
        white_level=_white_level(path, float(raw.white_level), black, directories, mosaic),
        white_balance=white_balance,
        white_balance_source=source,
        colour_matrix=matrix,
        colour_matrix_source=matrix_source,
        exposure=_exposure(raw, directories),
        extra=extra,
    )


def _tile_indices(path: Path, raw: rawpy.RawPy, words: str) -> list[int]:
    """LibRaw's colour indices of the 2 x 2 tile at the origin of the visible area."""
    try:
        pattern = raw.raw_pattern
    except NotImplementedError:
        pattern = None
    shape = None if pattern is None else pattern.shape
    if shape == (6, 6):
        raise RawFileError.of(path, "must be a Bayer raw, but has Fujifilm's X-Trans array")
    top, left = raw.sizes.top_margin, raw.sizes.left_margin
    description = raw.color_desc.decode()
    if shape == (2, 2):
        # The visible area may begin on an odd row or column: ask there, not at the sensor's corner.
        indices = [int(raw.raw_color(top + r, left + c)) for r in (0, 1) for c in (0, 1)]
        letters = "".join(description[i] for i in indices)
        if letters in {p.value for p in BayerPattern}:
            return indices
        description = letters
    array = f"{description or 'monochrome'} in {shape or 'no'} tile"
    text = f"must be a Bayer raw (R, G, B in a 2 x 2 tile), but its colour array is {array}"
    raise RawFileError.of(path, f"{text}: {words}")


def _white_balance(raw: rawpy.RawPy) -> tuple[tuple[float, float, float], str]:
    """Gains of R, G, B with green 1: the camera's, else LibRaw's daylight ones, else neutral."""
    known = {"camera": raw.camera_whitebalance, "daylight": raw.daylight_whitebalance}
    for source, gains in known.items():
        red, green, blue = gains[:3]
        if all(np.isfinite(g) and g > 0 for g in (red, green, blue)):
            return (red / green, 1.0, blue / green), source
    return (1.0, 1.0, 1.0), "none"


def _colour_matrix(
    raw: rawpy.RawPy, directories: Sequence[Directory]
) -> tuple[tuple[tuple[float, float, float], ...] | None, str]:
    """XYZ to camera RGB and its source: a DNG's own, else LibRaw's table."""
    stated = read_colour_matrix(directories)
    if stated is not None:
        return stated, _DNG_MATRIX
    matrix = np.asarray(raw.rgb_xyz_matrix, np.float64)[:3]
    if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-6:
        return None, ""
    version = ".".join(map(str, rawpy.libraw_version))
    # float32 to the nearest short decimal: LibRaw's own tables have four digits.
    rows = tuple(tuple(round(float(v), 7) for v in row) for row in matrix)
    return rows, f"XYZ to camera RGB, as LibRaw {version} has it"  # type: ignore[return-value]


# -- both -----------------------------------------------------------------------------------------


def _pixel_aspect(aspect: float) -> dict[str, float]:
    """Entry of the metadata for pixels that are not square; 8 to 1 and beyond is damage."""
    return {"pixel_aspect": float(aspect)} if aspect != 1.0 and 0.125 < aspect < 8.0 else {}


def _mosaic_directory(directories: Sequence[Directory]) -> Directory:
    """The directory that describes the colour filter array; empty where there is none."""
    return next(
        (d for d in directories if d.get("PhotometricInterpretation") == (COLOUR_FILTER_ARRAY,)), {}
    )


def _white_level(
    path: Path,
    white: float,
    black: Sequence[float],
    directories: Sequence[Directory],
    mosaic: np.ndarray,
) -> float:
    """`white`, or the largest digital number where the file's WhiteLevel cannot be right.

    That is 0, or in a DNG beyond what the bits of a sample can hold. Elsewhere the bits are those
    of the compressed samples (Sony's ARW says 12 of 14), and LibRaw knows the camera's white.
    """
    tags = _mosaic_directory(directories)
    stated = next(iter(numbers(tags, "WhiteLevel")), white)
    bits = next(iter(numbers(tags, "BitsPerSample")), 16)
    fits = 8 <= bits <= 16 and "WhiteLevel" in tags and "LinearizationTable" not in tags
    largest = 2 ** (int(bits) if fits else 16) - 1
    if largest < stated < 2**16 and int(mosaic.max()) > largest:  # samples hold more than the bits
        largest = 2**16 - 1
    if not 0 < stated <= largest:
        text = f"its white level (={stated:.10g}) must be in [1, {largest}]; {largest} is used"
        logger.warning("%s: %s", path.name, text)
        white = float(largest)
    if white <= max(black):
        levels = f"white {white:g}, black {tuple(black)}"
        text = f"must have a white level above its black levels, but says {levels}"
        raise RawFileError.of(path, text)
    return float(white)
