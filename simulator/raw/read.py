"""Raw files: any Bayer raw that LibRaw reads, as a `RawImage`."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from simulator.camera import CameraProfile, get_camera, list_cameras
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.raw.decoding import (
    COLOUR_FILTER_ARRAY,
    LINEAR_RAW,
    Decoded,
    RawFileError,
    decode_own_dng,
    decode_with_libraw,
    stated_exposure,
)
from simulator.raw.dng import OwnRecord
from simulator.raw.image import RawImage, pack_mosaic
from simulator.raw.metadata import (
    CANON_CRW,
    UNKNOWN_FILE,
    Directory,
    camera_identity,
    describe_file,
    missing_bytes,
    normalised_model,
    numbers,
    read_directories,
    read_noise_profile,
    read_own_record,
)
from simulator.raw.noise_estimation import estimate_nlf
from simulator.settings import CameraSettings, snap_exposure_time
from simulator.utils.files import as_path

logger = logging.getLogger(__name__)

#: A profile whose white level differs by more than this factor is of another bit depth.
_WHITE_TOLERANCE = 2.0


def read_raw(
    path: str | os.PathLike[str],
    *,
    settings: CameraSettings | None = None,
    camera: CameraProfile | str | None = None,
    nlf: NoiseLevelFunction | None = None,
) -> RawImage:
    """Read a Bayer raw file: CR2, CR3, CRW, NEF, ARW, DNG, RW2 ... whatever LibRaw decodes.

    The mosaic is cropped to its visible area, not rotated, and split into R, G1 (on red's rows),
    G2 and B; black and white levels are the file's. A white level of 0, or beyond what its bits can
    hold, is taken for the largest number they can; a noise profile that cannot be one is left out,
    and values of a `write_dng` that were lost fall back to neutral white balance, upright, no date.
    The log says so of levels and noise, and of pixels far above white.

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
        ``white_balance_source`` and, where known, ``datetime`` (ISO 8601), ``focal_length`` [mm]
        and, of pixels that are not square, ``pixel_aspect`` (width / height): the data have the
        sensor's pixels.

    Raises:
        FileNotFoundError: If there is no such file.
        RawFileError: (a `ValueError`) If the file is not a raw, not a Bayer raw (X-Trans, Foveon,
            linear DNG, monochrome), cut short or damaged, may not be read, changes meanwhile, or
            claims more than `MAX_PIXELS` of `simulator.utils.files`, or `MAX_PIXELS_PER_BYTE`
            for each byte of the file.
        ValueError: If settings are missing from the file and not given, or `camera` does not fit.
    """
    path = as_path(path)
    if not path.is_file():
        missing = "is no ordinary file" if path.exists() else "does not exist"
        what = "is a folder" if path.is_dir() else missing
        raise FileNotFoundError(f"`path` (={str(path)!r}) {what}; give a raw file")
    try:
        return _read(path, settings, camera, nlf)
    except OSError as error:
        raise RawFileError(f"`path` (={str(path)!r}) cannot be read: {error}") from error


def _read(
    path: Path,
    settings: CameraSettings | None,
    camera: CameraProfile | str | None,
    nlf: NoiseLevelFunction | None,
) -> RawImage:
    with path.open("rb") as stream:
        head = stream.read(4096)
        directories = read_directories(stream)
        make, model = camera_identity(stream, directories)
    words = describe_file(head)
    fault = _fault(os.stat(path).st_size, words, directories, model)
    if fault:
        raise RawFileError.of(path, fault)
    own = read_own_record(directories)
    with ExitStack() as opened:
        decoded = None if own is None else decode_own_dng(path, directories, own)
        if decoded is None:
            decoded = decode_with_libraw(path, words, directories, opened)
        known = settings or _settings(path, decoded.exposure, own)
        profile = _profile(path, decoded, make, model, camera, own)
        packed = pack_mosaic(decoded.mosaic, profile)
    if float(packed.max()) > _WHITE_TOLERANCE:
        times, level = f"{float(packed.max()):.3g}", f"{profile.white_level:g}"
        logger.warning(
            f"{path.name}: its digital numbers reach {times} times white; its white level "
            f"(={level}) is wrong: give `camera` with the right one"
        )
    box_factor = own.box_factor if own is not None else 1
    noise, source = _noise(packed.numpy(), profile, nlf, directories, box_factor)
    if noise is not None and not profile.nlf_by_iso:
        profile = profile.with_nlf(known.iso, noise)
    return RawImage(
        packed,
        known,
        profile,
        noise,
        decoded.white_balance,
        box_factor,
        metadata={
            "path": path.name,
            "make": make,
            "model": model,
            "nlf_source": source,
            "white_balance_source": decoded.white_balance_source,
            **decoded.extra,
        },
    )


def _fault(size: int, words: str, directories: Sequence[Directory], model: str) -> str:
    """Why a file cannot be a whole Bayer raw, as its structure tells; empty if it can be."""
    if not size:
        return f"must be a camera raw, but is {words}"
    if not model and words == UNKNOWN_FILE:
        # LibRaw takes some headerless files for a camera's from their size alone.
        return (
            f"must say which camera it is from, but is {words} without a header; read a bare array "
            "with numpy.fromfile and RawImage.from_mosaic"
        )
    if not model and words == CANON_CRW:
        return (
            f"must be a whole file, but its directory, with which {words} ends, is missing: it is "
            "truncated or damaged"
        )
    lost = missing_bytes(directories, size)
    if lost:
        return (
            f"must be a whole file, but its directory names {lost} bytes beyond its end: it is "
            "truncated"
        )
    kinds = [tags.get("PhotometricInterpretation") for tags in directories]
    if (LINEAR_RAW,) in kinds and (COLOUR_FILTER_ARRAY,) not in kinds:
        return (
            "must be a Bayer raw, but is a linear DNG: already demosaicked, its noise is no longer "
            "per pixel"
        )
    for tags in (
        d for d, kind in zip(directories, kinds, strict=True) if kind == (COLOUR_FILTER_ARRAY,)
    ):
        height, width = ((numbers(tags, n) or (0,))[0] for n in ("ImageLength", "ImageWidth"))
        pixels = numbers(tags, "StripOffsets") or numbers(tags, "TileOffsets")
        if min(height, width) < 1 or not pixels:
            return (
                f"must hold an image, but its directory names {height:g} x {width:g} pixels at "
                f"{tags.get('StripOffsets', 'no position')}: it is damaged"
            )
    return ""


def _settings(path: Path, exposure: Sequence[float], own: OwnRecord | None) -> CameraSettings:
    """Settings from the file: exact from our own DNGs, else as a camera records them."""
    if own is not None:
        return own.settings
    iso, seconds, f_number = (float(v) for v in exposure)
    values = {"iso": iso, "exposure_time": seconds, "f_number": f_number}
    missing = [k for k, v in values.items() if not (np.isfinite(v) and v > 0)]
    if missing:
        raise ValueError(
            f"`settings` (=None) must be given: {path.name!r} does not say its "
            f"{', '.join(missing)}; pass settings=CameraSettings(iso, exposure_time, f_number), or "
            "--source-iso, --source-shutter and --source-aperture to `ae-env simulate` and `sweep`"
        )
    # LibRaw hands on float32; 7 digits are what it holds.
    rounded = {k: float(f"{v:.7g}") for k, v in values.items()}
    try:
        return CameraSettings.from_exif(**rounded)
    except ValueError as error:
        raise ValueError(f"`settings` (=None) must be given: {path.name!r} says {error}") from error


def _match(make: str, model: str) -> CameraProfile | None:
    wanted = normalised_model(make, model)
    for name in list_cameras():
        profile = get_camera(name)
        if normalised_model(profile.make, profile.model) == wanted:
            return profile
    return None


def _profile(
    path: Path,
    decoded: Decoded,
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
    depth = max(1, int(decoded.white_level).bit_length())
    colours: dict[str, Any] = {
        "cfa": decoded.cfa,
        "colour_matrix": matrix,
        "colour_matrix_source": source if matrix is not None else "",
    }
    if base is not None:
        found = base.with_levels(decoded.black_level, decoded.white_level, depth)
        return replace(found, **colours)
    repeated = make == "unknown" or model.lower().startswith(make.lower())
    name = model if repeated else f"{make} {model}".strip()
    return CameraProfile(
        name="_".join(name.lower().split()) or "unknown",
        make=make or "unknown",
        model=model or "unknown",
        black_level=decoded.black_level,
        white_level=decoded.white_level,
        bit_depth=depth,
        **colours,
    )


def _check_profile(path: Path, decoded: Decoded, camera: CameraProfile) -> None:
    hint = "; dataclasses.replace(camera, ...) adapts a profile"
    if camera.cfa != decoded.cfa:
        raise ValueError(
            f"`camera` (={camera.name!r}, {camera.cfa.value}) must have the colour filter order of "
            f"{path.name!r}, {decoded.cfa.value}{hint}"
        )
    ratio = camera.white_level / decoded.white_level
    if not 1 / _WHITE_TOLERANCE <= ratio <= _WHITE_TOLERANCE:
        brightest = int(decoded.mosaic.max())
        if ratio > 1.0 and decoded.white_level < brightest <= camera.white_level:
            return  # the pixels show that the file's own level is wrong
        raise ValueError(
            f"`camera` (={camera.name!r}, white level {camera.white_level:g}) must have the levels "
            f"of {path.name!r}, white {decoded.white_level:g}, black {decoded.black_level}{hint}"
        )


def _noise(
    packed: np.ndarray,
    camera: CameraProfile,
    nlf: NoiseLevelFunction | None,
    directories: Sequence[Directory],
    box_factor: int,
) -> tuple[NoiseLevelFunction | None, str]:
    """NLF of this raw and how it was found; None leaves it to the camera's calibration."""
    if nlf is not None:
        return nlf, "given"
    stated = read_noise_profile(directories)
    if stated is not None:
        return stated.scaled(float(box_factor**2)), "DNG NoiseProfile"
    if any("NoiseProfile" in tags for tags in directories):
        logger.warning("the NoiseProfile of the file cannot be one, and is not used")
    if camera.nlf_by_iso:
        return None, f"camera calibration ({camera.name})"
    # Clipped at black, a dark raw shows no read noise; rounding alone leaves this much.
    rounding = NoiseLevelFunction((0.0,) * 4, tuple(1.0 / (12.0 * s**2) for s in camera.span))  # type: ignore[arg-type]
    estimate = estimate_nlf(packed).scaled(float(box_factor**2)).at_least(rounding)
    return estimate, "blind estimate"


def read_settings(path: str | os.PathLike[str]) -> dict[str, float]:
    """Settings that a raw file states, without reading its pixels.

    Returns:
        ``iso``, ``exposure_time`` [s] and ``f_number``, of which those are missing that the file
        does not state; the exposure time is the exact stop that the recorded one stands for.

    Raises:
        RawFileError: (a `ValueError`) If the file is no raw that can be read.
    """
    path = as_path(path)
    try:
        with path.open("rb") as stream:
            directories = read_directories(stream)
    except OSError as error:
        raise RawFileError(f"`path` (={str(path)!r}) cannot be read: {error}") from error
    own = read_own_record(directories)
    if own is not None:
        return {name: getattr(own.settings, name) for name in ("iso", "exposure_time", "f_number")}
    stated = stated_exposure(path, directories)
    values = dict(zip(("iso", "exposure_time", "f_number"), map(float, stated), strict=True))
    known = {name: value for name, value in values.items() if np.isfinite(value) and value > 0}
    if "exposure_time" in known:
        known["exposure_time"] = snap_exposure_time(known["exposure_time"])
    return known
