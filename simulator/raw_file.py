"""Raw files: any Bayer raw that LibRaw reads, as a `RawImage`."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import rawpy

from simulator.camera import (
    BayerPattern,
    CameraProfile,
    NoiseLevelFunction,
    get_camera,
    list_cameras,
)
from simulator.dng_tags import (
    ORIENTATIONS,
    OwnRecord,
    read_black_level,
    read_colour_matrix,
    read_long_iso,
    read_noise_profile,
    read_own_record,
    read_plain_mosaic,
)
from simulator.exif import UNKNOWN_FILE, camera_identity, describe_file, normalised_model
from simulator.noise_estimation import estimate_nlf
from simulator.raw_image import RawImage, pack_mosaic
from simulator.settings import CameraSettings
from simulator.tiff import Content, Directory, FileContent, missing_bytes, read_directories

logger = logging.getLogger(__name__)

#: A profile whose white level differs by more than this factor is of another bit depth.
_WHITE_TOLERANCE = 2.0
_DNG_VERSION, _PHOTOMETRIC, _LINEAR_RAW = 50706, 262, 34892


class RawFileError(ValueError):
    """A file that is not a Bayer raw, or not a whole one; the message says what it is."""


@dataclass(frozen=True)
class _Decoded:
    """What LibRaw makes of a file."""

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


def read_raw(
    path: str | os.PathLike[str],
    *,
    settings: CameraSettings | None = None,
    camera: CameraProfile | str | None = None,
    nlf: NoiseLevelFunction | None = None,
) -> RawImage:
    """Read a Bayer raw file: CR2, CR3, CRW, NEF, ARW, DNG, RW2 ... whatever LibRaw decodes.

    The mosaic is cropped to its visible area, not rotated, and split into R, G1 (on red's rows),
    G2 and B; black and white levels are the file's.

    Args:
        path: The file.
        settings: Exposure settings to use in place of the file's, taken as they are. Without it
            they come from the file's metadata, the shutter speed as the exact stop that the
            recorded one stands for (1/60 is 1/64); a DNG of `write_dng` says exact values.
        camera: A `CameraProfile`, taken as it is (its CFA order must be the file's), or the name of
            a built-in camera, whose noise calibration is used with the file's own CFA order and
            levels. By default a built-in camera of the file's make and model is used in that way,
            and for any other one a profile is made from the file.
        nlf: Noise level function of this raw. By default the file's own (DNG NoiseProfile), else
            the camera's calibration at this ISO, else a blind estimate from the pixels;
            ``metadata["nlf_source"]`` says which.

    Returns:
        The raw, with ``metadata`` keys ``path`` (file name), ``make``, ``model``, ``flip``
        (LibRaw's code of how to turn it upright: 0, 3, 5 or 6), ``nlf_source``,
        ``white_balance_source`` and, where known, ``datetime`` (ISO 8601) and
        ``focal_length`` [mm].

    Raises:
        FileNotFoundError: If there is no such file.
        RawFileError: (a `ValueError`) If the file is not a raw, not a Bayer raw (X-Trans, Foveon,
            linear DNG, monochrome) or cut short.
        ValueError: If settings are missing from the file and not given, or `camera` does not fit.
    """
    path = Path(path)
    with ExitStack() as opened:
        data = opened.enter_context(closing(FileContent(path)))
        directories = read_directories(data)
        make, model = camera_identity(data, directories)
        _refuse_early(path, data, directories, model)
        own = read_own_record(directories)
        decoded = None if own is None else _from_own_dng(data, directories, own)
        if decoded is None:
            decoded = _decode(path, data, directories, opened)
        known = settings or _settings(path, decoded.exposure, own)
        profile = _profile(path, decoded, make, model, camera, own)
        packed = pack_mosaic(decoded.mosaic, profile)
    box_factor = own.box_factor if own is not None else 1
    noise, source = _noise(packed.numpy(), profile, nlf, directories, box_factor)
    if noise is not None and not profile.nlf_by_iso:
        profile = profile.with_nlf(known.iso, noise)
    metadata: dict[str, Any] = {"path": path.name, "make": make, "model": model}
    metadata |= {"nlf_source": source, "white_balance_source": decoded.white_balance_source}
    metadata |= decoded.extra
    gains = decoded.white_balance
    return RawImage(packed, known, profile, noise, gains, box_factor, metadata)


def _refuse_early(path: Path, data: Content, directories: list[Directory], model: str) -> None:
    """Refuse what can be told from the structure: no header, linear DNG, files cut short."""
    if not model and describe_file(data) == UNKNOWN_FILE:
        # LibRaw takes some headerless files for a camera's from their size alone.
        raise RawFileError(
            f"`path` (={path.name!r}) must say which camera it is from, but is {UNKNOWN_FILE} "
            "without a header; read a bare array with numpy.fromfile and RawImage.from_mosaic"
        )
    lost = missing_bytes(directories, len(data))
    if lost:
        raise RawFileError(
            f"`path` (={path.name!r}) must be a whole file, but its directory names {lost} bytes "
            "beyond its end: it is truncated"
        )
    if any(d.get(_PHOTOMETRIC, (0,))[0] == _LINEAR_RAW for d in directories) and not any(
        d.get(_PHOTOMETRIC, (0,))[0] == 32803 for d in directories
    ):
        raise RawFileError(
            f"`path` (={path.name!r}) must be a Bayer raw, but is a linear DNG: already "
            "demosaicked, its noise is no longer per pixel"
        )


def _from_own_dng(data: Content, directories: list[Directory], own: OwnRecord) -> _Decoded | None:
    """A DNG of `write_dng` without LibRaw, which misreads very small frames of some makes."""
    tags = {tag: value for directory in reversed(directories) for tag, value in directory.items()}
    mosaic = read_plain_mosaic(data, directories)
    cfa = BayerPattern("".join("RGB"[colour] for colour in tags[33422]))
    black = read_black_level(directories, cfa, (0, 0))
    if mosaic is None or black is None:
        return None
    red, green, blue = tags[50728]
    flips = {orientation: flip for flip, orientation in ORIENTATIONS.items()}
    extra: dict[str, Any] = {"flip": flips.get(tags[274][0], 0)}
    moment = str(tags[36867][0]).strip()
    if moment[:1].isdigit():
        extra["datetime"] = datetime.strptime(moment, "%Y:%m:%d %H:%M:%S").isoformat()
    if tags[37386][0] > 0:
        extra["focal_length"] = float(tags[37386][0])
    return _Decoded(
        mosaic=mosaic,
        cfa=cfa,
        black_level=black,
        white_level=float(tags[50717][0]),
        white_balance=(green / red, 1.0, green / blue),
        white_balance_source="camera",
        colour_matrix=read_colour_matrix(directories),
        colour_matrix_source="XYZ to camera RGB, ColorMatrix of the file",
        exposure=(own.settings.iso, own.settings.exposure_time, own.settings.f_number),
        extra=extra,
    )


def _decode(path: Path, data: Content, directories: list[Directory], opened: ExitStack) -> _Decoded:
    """What LibRaw reads; its mosaic lies in LibRaw's memory, which `opened` lets go of."""
    words = describe_file(data)
    try:
        raw = opened.enter_context(rawpy.imread(str(path)))
        return _from_libraw(path, raw, words, directories)
    except rawpy.LibRawFileUnsupportedError:
        raise RawFileError(
            f"`path` (={path.name!r}) must be a camera raw that LibRaw reads, but is {words}, or "
            "is truncated"
        ) from None
    except (rawpy.LibRawError, rawpy.NotSupportedError, RuntimeError) as error:
        reason = error.args[0] if error.args else error
        reason = reason.decode() if isinstance(reason, bytes) else reason
        raise RawFileError(
            f"`path` (={path.name!r}) must be a whole raw file, but LibRaw says {reason!s}: "
            f"{words}, truncated or damaged"
        ) from None


def _from_libraw(
    path: Path, raw: rawpy.RawPy, words: str, directories: list[Directory]
) -> _Decoded:
    sizes = raw.sizes
    if raw.raw_type != rawpy.RawType.Flat:
        raise RawFileError(
            f"`path` (={path.name!r}) must be a Bayer raw, but has every colour at every pixel "
            f"(linear or Foveon): {words}"
        )
    indices = _tile_indices(path, raw, words)
    letters = "".join(raw.color_desc.decode()[i] for i in indices)
    cfa = BayerPattern(letters)
    order = [indices[2 * row + column] for row, column in cfa.offsets]  # R, G1, G2, B
    black = [float(raw.black_level_per_channel[i]) for i in order]
    exact = read_black_level(directories, cfa, (sizes.top_margin, sizes.left_margin))
    if exact is not None and np.abs(np.sort(exact) - np.sort(black)).max() < 1.0:
        # LibRaw drops the fraction, and the phase where it moves an odd margin to an even one.
        black = list(exact)
    white_balance, source = _white_balance(raw)
    matrix, matrix_source = _colour_matrix(raw, directories)
    mosaic = raw.raw_image_visible
    if min(mosaic.shape) < 2 or float(raw.white_level) <= max(black):
        raise RawFileError(f"`path` (={path.name!r}) must hold an image, but is empty: {words}")
    extra: dict[str, Any] = {"flip": int(sizes.flip)}
    other = raw.other
    iso = other.iso_speed if other.iso_speed != 65535 else read_long_iso(directories) or 65535.0
    if other.timestamp is not None and other.timestamp.timestamp() > 0:
        extra["datetime"] = other.timestamp.replace(tzinfo=None).isoformat()
    if np.isfinite(other.focal_length) and other.focal_length > 0:
        extra["focal_length"] = float(other.focal_length)
    return _Decoded(
        mosaic=mosaic,
        cfa=cfa,
        black_level=tuple(black),  # type: ignore[arg-type]
        white_level=float(raw.white_level),
        white_balance=white_balance,
        white_balance_source=source,
        colour_matrix=matrix,
        colour_matrix_source=matrix_source,
        exposure=(iso, other.shutter_speed, other.aperture),
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
        raise RawFileError(
            f"`path` (={path.name!r}) must be a Bayer raw, but has Fujifilm's X-Trans array"
        )
    top, left = raw.sizes.top_margin, raw.sizes.left_margin
    description = raw.color_desc.decode()
    if shape == (2, 2):
        # The visible area may begin on an odd row or column: ask there, not at the sensor's corner.
        indices = [int(raw.raw_color(top + r, left + c)) for r in (0, 1) for c in (0, 1)]
        letters = "".join(description[i] for i in indices)
        if letters in {p.value for p in BayerPattern}:
            return indices
        description = letters
    raise RawFileError(
        f"`path` (={path.name!r}) must be a Bayer raw (R, G, B in a 2 x 2 tile), but its colour "
        f"array is {description or 'monochrome'} in {shape or 'no'} tile: {words}"
    )


def _white_balance(raw: rawpy.RawPy) -> tuple[tuple[float, float, float], str]:
    """Gains of R, G, B with green 1: the camera's, else LibRaw's daylight ones, else neutral."""
    for gains, source in (
        (raw.camera_whitebalance, "camera"),
        (raw.daylight_whitebalance, "daylight"),
    ):
        red, green, blue = gains[:3]
        if all(np.isfinite(g) and g > 0 for g in (red, green, blue)):
            return (red / green, 1.0, blue / green), source
    return (1.0, 1.0, 1.0), "none"


def _colour_matrix(
    raw: rawpy.RawPy, directories: list[Directory]
) -> tuple[tuple[tuple[float, float, float], ...] | None, str]:
    """XYZ to camera RGB and its source: a DNG's own, else LibRaw's table."""
    stated = read_colour_matrix(directories)
    if stated is not None:
        return stated, "XYZ to camera RGB, ColorMatrix of the file"
    matrix = np.asarray(raw.rgb_xyz_matrix, np.float64)[:3]
    if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-6:
        return None, ""
    version = ".".join(map(str, rawpy.libraw_version))
    # float32 to the nearest short decimal: LibRaw's own tables have four digits.
    rows = tuple(tuple(round(float(v), 7) for v in row) for row in matrix)
    return rows, f"XYZ to camera RGB, as LibRaw {version} has it"  # type: ignore[return-value]


def _settings(path: Path, exposure: Iterable[float], own: OwnRecord | None) -> CameraSettings:
    """Settings from the file: exact from our own DNGs, else as a camera records them."""
    if own is not None:
        return own.settings
    iso, seconds, f_number = (float(v) for v in exposure)
    values = {"iso": iso, "exposure_time": seconds, "f_number": f_number}
    missing = [k for k, v in values.items() if not (np.isfinite(v) and v > 0)]
    if missing:
        raise ValueError(
            f"`settings` (=None) must be given: {path.name!r} does not say its "
            f"{', '.join(missing)}; pass settings=CameraSettings(iso, exposure_time, f_number)"
        )
    # LibRaw hands on float32; 7 digits are what it holds.
    rounded = {k: float(f"{v:.7g}") for k, v in values.items()}
    return CameraSettings.from_exif(**rounded)


def _match(make: str, model: str) -> CameraProfile | None:
    wanted = normalised_model(make, model)
    for name in list_cameras():
        profile = get_camera(name)
        if normalised_model(profile.make, profile.model) == wanted:
            return profile
    return None


def _profile(
    path: Path,
    decoded: _Decoded,
    make: str,
    model: str,
    camera: CameraProfile | str | None,
    own: OwnRecord | None,
) -> CameraProfile:
    if isinstance(camera, CameraProfile):
        _check_profile(path, decoded, camera)
        return camera
    if not isinstance(camera, str | None):
        raise ValueError(
            f"`camera` (={camera!r}) must be a CameraProfile or a built-in camera's name"
        )
    base = get_camera(camera) if camera is not None else _match(make, model)
    matrix, source = decoded.colour_matrix, decoded.colour_matrix_source
    if own is not None:
        source = own.colour_matrix_source
        matrix = matrix if source else None
    if matrix is None and base is not None:
        matrix, source = base.colour_matrix, base.colour_matrix_source
    levels: dict[str, Any] = {
        "cfa": decoded.cfa,
        "black_level": decoded.black_level,
        "white_level": decoded.white_level,
        "bit_depth": max(1, int(decoded.white_level).bit_length()),
        "colour_matrix": matrix,
        "colour_matrix_source": source if matrix is not None else "",
    }
    if base is not None:
        return replace(base, **levels)
    repeated = make == "unknown" or model.lower().startswith(make.lower())
    name = model if repeated else f"{make} {model}".strip()
    return CameraProfile(
        name="_".join(name.lower().split()) or "unknown",
        make=make or "unknown",
        model=model or "unknown",
        **levels,
    )


def _check_profile(path: Path, decoded: _Decoded, camera: CameraProfile) -> None:
    hint = "; dataclasses.replace(camera, ...) adapts a profile"
    if camera.cfa != decoded.cfa:
        raise ValueError(
            f"`camera` (={camera.name!r}, {camera.cfa.value}) must have the colour filter order of "
            f"{path.name!r}, {decoded.cfa.value}{hint}"
        )
    ratio = camera.white_level / decoded.white_level
    if not 1 / _WHITE_TOLERANCE <= ratio <= _WHITE_TOLERANCE:
        raise ValueError(
            f"`camera` (={camera.name!r}, white level {camera.white_level:g}) must have the levels "
            f"of {path.name!r}, white {decoded.white_level:g}, black {decoded.black_level}{hint}"
        )


def _noise(
    packed: np.ndarray,
    camera: CameraProfile,
    nlf: NoiseLevelFunction | None,
    directories: list[Directory],
    box_factor: int,
) -> tuple[NoiseLevelFunction | None, str]:
    """NLF of this raw and how it was found; None leaves it to the camera's calibration."""
    if nlf is not None:
        return nlf, "given"
    stated = read_noise_profile(directories)
    if stated is not None:
        return stated.scaled(float(box_factor**2)), "DNG NoiseProfile"
    if camera.nlf_by_iso:
        return None, f"camera calibration ({camera.name})"
    estimate = estimate_nlf(packed)
    return estimate.scaled(float(box_factor**2)), "blind estimate"
