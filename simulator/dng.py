"""DNG files: a raw, simulated or not, for any raw developer."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from datetime import datetime
from importlib import metadata

import numpy as np

from simulator.camera import NoiseLevelFunction
from simulator.dng_tags import (
    BLACK_LEVEL,
    BLACK_REPEAT,
    CFA_PLANE_COLOUR,
    D65,
    NOISE_PROFILE,
    ORIENTATIONS,
    SOFTWARE_NAME,
    USER_COMMENT,
    OwnRecord,
)
from simulator.exif import MAKE, MODEL, SOFTWARE
from simulator.files import as_path, write_atomically
from simulator.raw_image import RawImage, unpack_mosaic
from simulator.tiff import Tag, TiffType, tiff_head

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
