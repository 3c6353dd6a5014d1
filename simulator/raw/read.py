"""Raw files: any Bayer raw that LibRaw reads, as a `RawImage`."""

import io
import itertools
import logging
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import rawpy

from simulator.camera import BayerPattern, CameraProfile, get_camera, list_cameras
from simulator.camera_files import normalised_model
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.raw.dng import OPCODES, ORIENTATIONS, OwnRecord
from simulator.raw.image import RawImage, pack_mosaic
from simulator.raw.metadata import (
    LONG_ISO,
    Directory,
    camera_identity,
    first,
    first_numbers,
    is_raw_container,
    missing_bytes,
    numbers,
    plane_letters,
    read_black_level,
    read_colour_matrix,
    read_directories,
    read_noise_profile,
    read_own_record,
    undefined,
)
from simulator.raw.noise_estimation import estimate_nlf
from simulator.settings import CameraSettings, snap_exposure_time
from simulator.utils.checks import check_type, check_word
from simulator.utils.files import as_path, file_fault, printable, read_bounded, refuse_bomb

logger = logging.getLogger(__name__)

#: A profile whose white level differs by more than this factor is of another bit depth.
_WHITE_TOLERANCE = 2.0
#: PhotometricInterpretation of a raw, and of a DNG that is demosaicked already.
COLOUR_FILTER_ARRAY, LINEAR_RAW = 32803, 34892
#: SampleFormat of a DNG of floating-point numbers.
_FLOATING_POINT = 3
#: Compression of DNGs that LibRaw decodes: none, lossless JPEG, deflate; and GoPro's.
_COMPRESSIONS, _VC5 = (1, 7, 8), 9
_LETTERS = {0: "R", 1: "G", 2: "B"}
_SETTINGS = ("iso", "exposure_time", "f_number")
_TAGS = {"iso": "PhotographicSensitivity", "exposure_time": "ExposureTime", "f_number": "FNumber"}
#: What LibRaw takes where a file lacks these, or they are 0.
_SPARE = {"exposure_time": ("ShutterSpeedValue",), "f_number": ("ApertureValue",)}
#: Makers whose cameras record the stop that is marked, 1/60 s for 1/64 s, by the first word of
#: their name; others (phones, computers, industrial cameras) record the time itself, and so does
#: whoever gives it with this denominator or a larger one (Android: nanoseconds).
_STOP_MARKING = {
    *("asahi", "canon", "casio", "contax", "eastman", "epson", "fuji", "fujifilm", "hasselblad"),
    *("kodak", "konica", "leaf", "leica", "mamiya", "minolta", "nikon", "olympus", "om"),
    *("panasonic", "pentax", "phase", "ricoh", "samsung", "seiko", "sigma", "sony"),
}
_MEASURED = 10**6
#: `CameraProfile.full_level` of cameras that are not built in, seen in their own files.
_FULL_LEVELS = {"canonpowershots40": 0.92}
_LARGEST_BASELINE = 32.0  # [EV]; beyond it a file is damaged
_DNG_MATRIX = "XYZ to camera RGB, ColorMatrix of the file"
_BLACK_LEVEL_RULE = (
    "must have a BlackLevel of as many values, 0 or more, as its BlackLevelRepeatDim says (1 or 4 "
    "without one), and a BlackLevelDelta for each column and row, but has {found} of them; "
    "exiftool -BlackLevel=64 writes one for all"
)
#: First bytes of files that are taken for raws by mistake.
_PICTURES = {b"\xff\xd8\xff": "JPEG", b"\x89PN": "PNG"}
#: What LibRaw raises; NotImplementedError is a RuntimeError.
_LIBRAW_ERRORS = (rawpy.LibRawError, rawpy.NotSupportedError, RuntimeError)


class RawFileError(ValueError):
    """A file that is not a Bayer raw, or not a whole one; the message says what it is."""


@contextmanager
def _errors_name(path: Path) -> Iterator[None]:
    """Errors about the content of the file at `path` name it."""
    try:
        yield
    except RawFileError as error:
        text = str(error)
        if not file_fault(path):
            with suppress(OSError), path.open("rb") as stream:
                kind = _PICTURES.get(stream.read(3))
                text = text if kind is None else f"is a {kind}, not a raw"
        raise RawFileError(f"`path` (={path.name!r}) {text}") from None
    except OSError as error:
        raise RawFileError(f"`path` (={str(path)!r}) cannot be read: {error}") from error


def read_raw(
    path: str | os.PathLike[str],
    *,
    settings: CameraSettings | Mapping[str, float] | None = None,
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
        settings: Exposure settings to use in place of the file's, taken as they are: all of them,
            or some by name (``{"f_number": 2.8}`` for an adapted lens). Others come from the file's
            metadata, the shutter speed as the exact stop that the recorded one stands for (1/60 is
            1/64) if the maker's cameras mark stops; a DNG of `write_dng`, a phone, a computer or an
            industrial camera says exact values.
        camera: A `CameraProfile`, taken as it is (its CFA order must be the file's), or the name of
            one (`get_camera`), whose noise calibration is used with the file's own CFA order and
            levels. By default a built-in camera of the file's make and model is used in that way,
            and for any other one a profile is made from the file.
        nlf: Noise level function of this raw. By default the file's own (DNG NoiseProfile), else
            the camera's calibration at this ISO, else a blind estimate from the pixels; where they
            do not tell, that of rounding, with a warning. ``metadata["nlf_source"]`` says which.

    Returns:
        The raw, with ``metadata`` keys ``path`` (file name), ``make``, ``model``, ``flip``
        (LibRaw's code of how to turn it upright, see `simulator.raw.develop.upright`),
        ``nlf_source``, ``white_balance_source`` and, where known, ``datetime`` (ISO 8601),
        ``focal_length`` [mm]; of a DNG ``baseline_exposure`` and ``opcodes`` (packed height and
        width, and the lists by name), which `write_dng` passes on; and, of pixels that are not
        square, ``pixel_aspect`` (width / height): the data have the sensor's pixels.

    Raises:
        FileNotFoundError: If there is no such file.
        RawFileError: (a `ValueError`) If the file is not a raw, not a Bayer raw (X-Trans, Foveon,
            linear DNG, monochrome), cut short or damaged, may not be read, changes meanwhile, or
            claims more than `MAX_PIXELS` of `simulator.utils.files`, or `MAX_PIXELS_PER_BYTE`
            for each byte of the file, 64 where it claims more than `MAX_FLAT_PIXELS`.
        ValueError: If settings are missing from the file and not given, or `camera` does not fit.
    """
    path = as_path(path)
    check_settings(settings)
    if fault := file_fault(path):
        raise FileNotFoundError(f"`path` (={str(path)!r}) {fault}; give a raw file")
    with _errors_name(path):
        return _read(path, settings, camera, nlf)


def check_settings(settings: object) -> None:
    """A `ValueError` unless these are `CameraSettings`, some of them by name, or None."""
    check_type("settings", settings, CameraSettings, Mapping, None)
    for name in settings if isinstance(settings, Mapping) else ():
        check_word("settings", name, _SETTINGS)
    if isinstance(settings, Mapping):
        CameraSettings(**{"iso": 100.0, "exposure_time": 1.0, "f_number": 1.0, **settings})


def read_settings(path: str | os.PathLike[str]) -> dict[str, float]:
    """``iso``, ``exposure_time`` [s] and ``f_number`` that a raw file states, where it does.

    No pixel is read; the exposure time is the exact stop that the recorded one stands for.
    """
    path = as_path(path)
    with _errors_name(path):
        if fault := file_fault(path):
            raise RawFileError(fault)
        with path.open("rb") as stream:
            directories = read_directories(stream)
            make, _ = camera_identity(stream, directories)
        own = read_own_record(directories)
        if own is not None:
            return {name: getattr(own.settings, name) for name in _SETTINGS}
        try:
            with _open(path) as raw:
                return _exposure(raw, directories, make)
        except _LIBRAW_ERRORS as error:
            raise _unreadable(error, directories) from None


def _read(
    path: Path,
    settings: CameraSettings | Mapping[str, float] | None,
    camera: CameraProfile | str | None,
    nlf: NoiseLevelFunction | None,
) -> RawImage:
    with path.open("rb") as stream:
        directories = read_directories(stream)
        make, model = camera_identity(stream, directories)
        # LibRaw takes some headerless files for a camera's from their size alone.
        known_kind = bool(model) or is_raw_container(stream)
    _check_structure(directories, known_kind, path.stat().st_size)
    own = read_own_record(directories)
    with ExitStack() as opened:
        decoded = None if own is None else _decode_own_dng(path, directories)
        if decoded is None:
            decoded = _decode_with_libraw(path, directories, make, opened)
        stated = decoded.exposure
        if own is not None:
            stated = {name: getattr(own.settings, name) for name in _SETTINGS}
        known = _settings(path, stated, settings)
        profile = _profile(path, decoded, make, model, camera, own)
        packed = pack_mosaic(decoded.mosaic, profile)
        most = (float(decoded.mosaic.max()) - min(profile.black_level)) / min(profile.span)
    if most > _WHITE_TOLERANCE and float(packed.max()) > _WHITE_TOLERANCE:
        logger.warning(
            "%s: its digital numbers reach %.3g times white; its white level (=%g) is wrong: give "
            "`camera` with the right one",
            *(path.name, float(packed.max()), profile.white_level),
        )
    box_factor = own.box_factor if own is not None else 1
    noise, source = _noise(path, packed.numpy(), profile, nlf, directories, box_factor)
    if noise is not None and not profile.nlf_by_iso:
        profile = profile.with_nlf(known.iso, noise)
    return RawImage.from_finite(
        packed,
        known,
        profile,
        noise,
        decoded.white_balance,
        box_factor,
        metadata={
            "path": printable(path.name),
            "make": make,
            "model": model,
            "nlf_source": source,
            "white_balance_source": decoded.white_balance_source,
            **decoded.extra,
            **_passed_on(path, directories, decoded.origin, packed.shape[1:]),
        },
    )


def _passed_on(
    path: Path, directories: Sequence[Directory], origin: tuple[int, int], size: Sequence[int]
) -> dict[str, Any]:
    """Metadata of a DNG for other developers, which `write_dng` passes on.

    Positions in the first opcode list are those of the file's array, in the others those of its
    ActiveArea: lists go along where the packed frame of this `size` at `origin` is all of that.
    """
    tags, baseline = _mosaic_directory(directories), first_numbers(directories, "BaselineExposure")
    sides = [next(iter(numbers(tags, name)), 0) for name in ("ImageLength", "ImageWidth")]
    frame, whole = (*origin, *size), (0, 0, *sides)
    lists: dict[str, bytes] = {}
    for name in (name for name in OPCODES if isinstance(tags.get(name, (0,))[0], bytes)):
        area = whole if name == OPCODES[0] else numbers(tags, "ActiveArea") or whole
        top, left, bottom, right = area if len(area) == 4 else whole
        if frame == (top, left, (bottom - top) // 2, (right - left) // 2):
            lists[name] = tags[name][0]
        else:
            logger.warning("%s: its %s is of another frame, and is left out", path.name, name)
    found: dict[str, Any] = {"opcodes": (tuple(size), lists)} if lists else {}
    if baseline and 0.0 < abs(baseline[0]) < _LARGEST_BASELINE:
        found["baseline_exposure"] = float(baseline[0])
    return found


def _check_structure(directories: Sequence[Directory], known_kind: bool, size: int) -> None:
    """Raises unless a file of `size` bytes can be a whole Bayer raw, as its structure tells."""
    if not known_kind:
        raise RawFileError(
            "must be a camera raw that LibRaw reads, but names no camera: another kind of file, "
            "truncated or damaged; for bare arrays see numpy.fromfile and RawImage.from_mosaic"
        )
    lost = missing_bytes(directories, size)
    if lost:
        raise RawFileError(f"must be whole, but names {lost} bytes beyond its end: truncated")
    kinds = [tags.get("PhotometricInterpretation") for tags in directories]
    if (LINEAR_RAW,) in kinds and (COLOUR_FILTER_ARRAY,) not in kinds:
        single = directories[kinds.index((LINEAR_RAW,))].get("SamplesPerPixel") == (1,)
        found = "of a monochrome sensor" if single else "a linear DNG: demosaicked already"
        raise RawFileError(f"must be a Bayer raw, but is {found}")
    for tags, kind in zip(directories, kinds, strict=True):
        if kind != (COLOUR_FILTER_ARRAY,):
            continue
        height, width = ((numbers(tags, n) or (0,))[0] for n in ("ImageLength", "ImageWidth"))
        pixels = numbers(tags, "StripOffsets") or numbers(tags, "TileOffsets")
        if min(height, width) < 1 or not pixels:
            found = f"{height:g} x {width:g} pixels at {tags.get('StripOffsets', 'no position')}"
            raise RawFileError(f"must hold an image, but names {found}: it is damaged")
        if tags.get("CFALayout", (1,)) != (1,):
            raise RawFileError("must be a Bayer raw, but its CFALayout says staggered pixels")
        if first(directories, "DNGVersion") and _has_gaps(tags, width):
            rule = "must have its strips one after another, the only order that LibRaw knows"
            raise RawFileError(f"{rule}; convert it to a DNG of one strip")


def _has_gaps(tags: Directory, width: float) -> bool:
    """Whether the uncompressed strips of a directory do not follow each other without a gap."""
    strips = numbers(tags, "StripOffsets")
    rows, bits = (sum(numbers(tags, name)) for name in ("RowsPerStrip", "BitsPerSample"))
    size = rows * math.ceil(width * bits / 8)
    apart = any(end - begin != size for begin, end in itertools.pairwise(strips))
    return apart and tags.get("Compression") == (1,)


def _settings(
    path: Path, stated: Mapping[str, float], given: CameraSettings | Mapping[str, float] | None
) -> CameraSettings:
    """The settings that are given, the others as the file states them."""
    if isinstance(given, CameraSettings):
        return given
    given = given or {}
    values: Any = {**stated, **given}
    missing = [name for name in _SETTINGS if name not in values]
    if missing:
        raise ValueError(
            f"`settings` must be given: {path.name!r} does not say its {', '.join(missing)}; pass "
            f"settings={dict.fromkeys(missing, '...')}, a folder's 'settings', or --source-iso, "
            "--source-shutter, --source-aperture on the command line"
        )
    try:
        return CameraSettings(**values)
    except ValueError as error:
        if set(given) == set(_SETTINGS):
            raise
        raise ValueError(f"`settings` must be given: {path.name!r} says {error}") from error


def _profile(
    path: Path,
    decoded: "_Decoded",
    make: str,
    model: str,
    camera: CameraProfile | str | None,
    own: OwnRecord | None,
) -> CameraProfile:
    if isinstance(camera, CameraProfile):
        _check_profile(path, decoded, camera)
        return camera
    check_type("camera", camera, str, CameraProfile, None)
    if camera is not None:
        base: CameraProfile | None = get_camera(camera)
    else:
        built_in = {normalised_model(p.make, p.model): p for p in map(get_camera, list_cameras())}
        base = built_in.get(normalised_model(make, model))
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
        return replace(base.with_levels(decoded.black_level, decoded.white_level, depth), **colours)
    repeated = make == "unknown" or model.lower().startswith(make.lower())
    name = model if repeated else f"{make} {model}".strip()
    return CameraProfile(
        name="_".join(name.lower().split()) or "unknown",
        make=make or "unknown",
        model=model or "unknown",
        black_level=decoded.black_level,
        white_level=decoded.white_level,
        bit_depth=depth,
        full_level=_FULL_LEVELS.get(normalised_model(make, model), 1.0),
        **colours,
    )


def _check_profile(path: Path, decoded: "_Decoded", camera: CameraProfile) -> None:
    brightest, ratio = int(decoded.mosaic.max()), camera.white_level / decoded.white_level
    # Where pixels are brighter than the file's own level, that is wrong.
    corrected = ratio > 1.0 and decoded.white_level < brightest <= camera.white_level
    fits = corrected or 1 / _WHITE_TOLERANCE <= ratio <= _WHITE_TOLERANCE
    if camera.cfa != decoded.cfa or not fits:
        raise ValueError(
            f"`camera` (={camera.name!r}, {camera.cfa.value}, white {camera.white_level:g}) must "
            f"have colour filters and levels of {path.name!r}, {decoded.cfa.value}, white "
            f"{decoded.white_level:g}, black {decoded.black_level}; dataclasses.replace(camera, "
            "...) adapts a profile"
        )


def _noise(
    path: Path,
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
    read: Any = tuple(1.0 / (12.0 * s**2) for s in camera.span)
    rounding = NoiseLevelFunction((0.0,) * 4, read, source="rounding alone")
    try:
        estimate = estimate_nlf(packed)
    except ValueError as error:
        logger.warning(
            "%s: its noise cannot be told, so that of rounding alone is assumed; give `nlf`, or a "
            "calibrated `camera`, to read_raw. The reason: %s",
            *(path.name, error),
        )
        return rounding, "assumed: rounding alone"
    return estimate.scaled(float(box_factor**2)).at_least(rounding), "blind estimate"


# -- decoding, before the camera is known --------------------------------------------------------


@dataclass(frozen=True)
class _Decoded:
    """The mosaic of a file, and its description by the file."""

    mosaic: np.ndarray  # (H, W) uint16, visible area
    cfa: BayerPattern
    black_level: tuple[float, float, float, float]
    white_level: float
    white_balance: tuple[float, float, float]
    white_balance_source: str
    colour_matrix: tuple[tuple[float, float, float], ...] | None
    colour_matrix_source: str
    exposure: dict[str, float]  # the settings that the file's tags state
    extra: dict[str, Any]
    origin: tuple[int, int] = (0, 0)  # row and column of the file's array where it begins


def _decode_own_dng(path: Path, directories: Sequence[Directory]) -> _Decoded | None:
    """A DNG of `write_dng`; None if another program has changed the layout of its pixels.

    LibRaw refuses DNGs of less than about 22 pixels a side, and takes a frame of 32 x 32 that says
    Nikon Z 6 for another format.
    """
    mosaic, tags = _plain_mosaic(path, directories), _mosaic_directory(directories)
    if mosaic is None:
        return None
    tile = first_numbers(directories, "CFAPattern")
    letters = "".join(_LETTERS.get(int(colour), "?") for colour in tile)
    if letters not in {p.value for p in BayerPattern}:
        rule = "must have a Bayer tile of 0 (R), 1 (G), 2 (B)"
        raise RawFileError(f"{rule}, but its CFAPattern is {tile}: damaged")
    found = read_black_level(tags, BayerPattern(letters), (0, 0), mosaic.shape)
    if found is None or found[1] is not None:
        return None
    black = found[0]
    white = next(iter(first_numbers(directories, "WhiteLevel")), 0.0)
    neutral = first_numbers(directories, "AsShotNeutral")
    known = len(neutral) == 3 and min(neutral) > 0
    red, green, blue = neutral if known else (1.0, 1.0, 1.0)
    flips = {orientation: flip for flip, orientation in ORIENTATIONS.items()}
    orientation = next(iter(first_numbers(directories, "Orientation")), 1)
    moment = None
    with suppress(ValueError):  # blanks where it is not known
        text = str((first(directories, "DateTimeOriginal") or ("",))[0])
        moment = datetime.strptime(text.strip(), "%Y:%m:%d %H:%M:%S")
    focal_length = next(iter(first_numbers(directories, "FocalLength")), 0.0)
    scale = first_numbers(directories, "DefaultScale")
    aspect = scale[0] / scale[1] if len(scale) == 2 and scale[1] > 0 else 1.0
    return _Decoded(
        mosaic=mosaic,
        cfa=BayerPattern(letters),
        black_level=black,
        white_level=_white_level(path, white, black, directories, mosaic),
        white_balance=(green / red, 1.0, green / blue),
        white_balance_source="camera" if known else "none",
        colour_matrix=read_colour_matrix(directories),
        colour_matrix_source=_DNG_MATRIX,
        exposure={},
        extra=_extra(flips.get(int(orientation), 0), moment, focal_length, aspect),
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
    length = path.stat().st_size
    if min(height, width) < 2 or size != 2 * width * height or start + size > length:
        return None
    if bomb := refuse_bomb(height, width, length):
        raise RawFileError(bomb)
    with path.open("rb") as stream:
        order = "<u2" if stream.read(2) == b"II" else ">u2"
        strip = np.fromfile(stream, order, width * height, offset=start - 2)
    if strip.size < width * height:
        raise RawFileError("became shorter while it was read")
    return strip.reshape(height, width).astype(np.uint16, copy=False)


def _open(path: Path) -> rawpy.RawPy:
    name = str(path)  # of which LibRaw's wrapper takes UTF-8 only
    return rawpy.imread(name if printable(name) == name else io.BytesIO(read_bounded(path, 2**30)))


def _decode_with_libraw(
    path: Path, directories: Sequence[Directory], make: str, opened: ExitStack
) -> _Decoded:
    """A file as LibRaw reads it; `opened` closes its memory, in which the mosaic lies."""
    try:
        raw = opened.enter_context(_open(path))
        # No pixel is decoded before one is asked for.
        bomb = refuse_bomb(raw.sizes.raw_height, raw.sizes.raw_width, path.stat().st_size)
        if bomb:
            raise RawFileError(bomb)
        return _from_libraw(path, raw, directories, make)
    except _LIBRAW_ERRORS as error:
        raise _unreadable(error, directories) from None


def _from_libraw(
    path: Path, raw: rawpy.RawPy, directories: Sequence[Directory], make: str
) -> _Decoded:
    sizes = raw.sizes
    if raw.raw_type != rawpy.RawType.Flat:
        raise RawFileError(
            "must be a Bayer raw, but has every colour at every pixel (linear or Foveon)"
        )
    # Of LibRaw's colour indices, which are the planes of a DNG, in any order.
    letters = plane_letters(directories)
    letters = raw.color_desc.decode() if letters == "RGB" else letters + letters[1]
    indices = _tile_indices(raw, letters)
    cfa = BayerPattern("".join(letters[i] for i in indices))
    order = [indices[2 * row + column] for row, column in cfa.offsets]  # R, G1, G2, B
    black = [float(raw.black_level_per_channel[i]) for i in order]
    mosaic, libraw_white = raw.raw_image_visible, float(raw.white_level)
    if min(mosaic.shape) < 2:
        raise RawFileError("must hold an image, but is empty")
    height, width = (n // 2 * 2 for n in mosaic.shape)
    mosaic, tags = mosaic[:height, :width], _mosaic_directory(directories)
    # LibRaw drops the fraction, all but the mean of a pixel's own level, and the phase where it
    # moves an odd margin to an even one.
    margins = sizes.top_margin, sizes.left_margin
    stated, own = read_black_level(tags, cfa, margins, mosaic.shape), None
    if stated is None and "BlackLevel" in tags and first(directories, "DNGVersion"):
        names = ("BlackLevel", "BlackLevelRepeatDim", "BlackLevelDeltaH", "BlackLevelDeltaV")
        found = ", ".join(f"{len(tags[n])} in {n} {tags[n][:4]}" for n in names if n in tags)
        raise RawFileError(_BLACK_LEVEL_RULE.format(found=found))  # LibRaw says 0
    if stated is not None:
        scale = 1.0
        if tags.get("SampleFormat") == (_FLOATING_POINT,):  # of which LibRaw makes whole numbers
            scale = libraw_white / next(iter(numbers(tags, "WhiteLevel")), 1.0)
        black, own = [scale * level for level in stated[0]], stated[1]
    white = _white_level(path, libraw_white, black, directories, mosaic)
    if own is not None:  # what is white stays white, and only that is
        corrected = np.minimum(mosaic - scale * own, white - 1.0)
        mosaic = np.where(mosaic < white, corrected, mosaic)
    white_balance, source = _white_balance(raw, directories)
    matrix, matrix_source = _colour_matrix(raw, directories)
    moment = raw.other.timestamp
    known = moment is not None and moment.timestamp() > 0
    return _Decoded(
        mosaic=mosaic,
        cfa=cfa,
        black_level=tuple(black),  # type: ignore[arg-type]
        white_level=white,
        white_balance=white_balance,
        white_balance_source=source,
        colour_matrix=matrix,
        colour_matrix_source=matrix_source,
        exposure=_exposure(raw, directories, make),
        extra=_extra(
            int(sizes.flip),
            moment.replace(tzinfo=None) if known else None,
            0.0 if undefined(directories, "FocalLength") else raw.other.focal_length,
            1.0 if undefined(directories, "DefaultScale") else sizes.pixel_aspect,
        ),
        origin=margins,
    )


def _tile_indices(raw: rawpy.RawPy, description: str) -> list[int]:
    """LibRaw's colour indices of the 2 x 2 tile at the origin of the visible area."""
    try:
        pattern = raw.raw_pattern
    except NotImplementedError:
        pattern = None
    shape = None if pattern is None else pattern.shape
    if shape == (6, 6):
        raise RawFileError("must be a Bayer raw, but has Fujifilm's X-Trans array")
    top, left = raw.sizes.top_margin, raw.sizes.left_margin
    if shape == (2, 2):
        # The visible area may begin on an odd row or column: ask there, not at the sensor's corner.
        indices = [int(raw.raw_color(top + r, left + c)) for r in (0, 1) for c in (0, 1)]
        letters = "".join(description[i] for i in indices)
        if letters in {p.value for p in BayerPattern}:
            return indices
        description = letters
    array = f"{description or 'monochrome'} in {shape or 'no'} tile"
    raise RawFileError(f"must be a Bayer raw (R, G, B in a 2 x 2 tile), but is {array}")


def _white_balance(
    raw: rawpy.RawPy, directories: Sequence[Directory]
) -> tuple[tuple[float, float, float], str]:
    """Gains of R, G, B with green 1: the camera's, else LibRaw's daylight ones, else neutral."""
    known = {"camera": raw.camera_whitebalance, "daylight": raw.daylight_whitebalance}
    if undefined(directories, "AsShotNeutral"):
        del known["camera"]
    for source, gains in known.items():
        red, green, blue = (gains[plane_letters(directories).index(letter)] for letter in "RGB")
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


def _exposure(raw: rawpy.RawPy, directories: Sequence[Directory], make: str) -> dict[str, float]:
    """Settings that a file states, the shutter speed as the exact stop where a stop is recorded."""
    values = raw.other.iso_speed, raw.other.shutter_speed, raw.other.aperture
    of_name = zip(_SETTINGS, values, strict=True)
    found = {name: float(f"{value:.7g}") for name, value in of_name}  # it has float32
    for setting, name in _TAGS.items():  # phones write no EXIF directory, where LibRaw looks
        stated = next((v for v in first_numbers(directories, name) if v > 0), 0.0)
        # LibRaw has float32, and the lower 16 bits of an ISO that is written with 32.
        same = math.isclose(found[setting], stated, rel_tol=1e-6)
        cut = setting == "iso" and found[setting] == stated % 2**16
        if stated and (not found[setting] or same or cut):
            found[setting] = float(stated)
        if undefined(directories, name, *_SPARE.get(setting, ())):
            found[setting] = 0.0
    if found["iso"] in (0, 65535):  # none, or it does not fit EXIF's 16 bits
        more = (first_numbers(directories, name) for name in LONG_ISO)
        found["iso"] = next((v[0] for v in more if v and v[0] > 0), found["iso"])
    known = {k: float(v) for k, v in found.items() if math.isfinite(v) and v > 0}
    recorded = (*first_numbers(directories, "ExposureTime"), known.get("exposure_time"))[0]
    model = str((first(directories, "Model") or ("",))[0])
    if marks_stops(make, model, recorded) and "exposure_time" in known:
        known["exposure_time"] = snap_exposure_time(known["exposure_time"])
    return known


def marks_stops(make: str, model: str, recorded: object) -> bool:
    """Whether a `recorded` exposure time, a rational or a number, is the stop that is marked."""
    measured = getattr(recorded, "denominator", 1) >= _MEASURED
    phone = model.lower().startswith(("sm-", "galaxy"))  # of a maker of cameras
    marks = _STOP_MARKING.intersection(make.lower().split()[:1])
    return bool(marks) and not measured and not phone


def _unreadable(error: Exception, directories: Sequence[Directory]) -> RawFileError:
    """Why LibRaw cannot read a file that its directory does not call cut short."""
    tags = _mosaic_directory(directories)
    compression = next(iter(tags.get("Compression", ())), 1)
    if "WhiteLevel" in tags and compression not in _COMPRESSIONS:
        kind = " (VC-5, GoPro's)" if compression == _VC5 else ""
        lacking = f"LibRaw lacks its compression, {compression}{kind}"
        return RawFileError(f"cannot be decoded: {lacking}; convert it to an uncompressed DNG")
    reason = error.args[0] if error.args else error
    reason = reason.decode() if isinstance(reason, bytes) else reason
    rule = "it is a file of another kind, truncated or damaged"
    return RawFileError(f"must be a camera raw, but LibRaw cannot read it ({reason}): {rule}")


def _extra(
    flip: int, moment: datetime | None, focal_length: float, aspect: float
) -> dict[str, Any]:
    """Entries of the metadata; a pixel aspect of 8 to 1 and beyond is damage."""
    extra: dict[str, Any] = {"flip": flip}
    if moment is not None:
        extra["datetime"] = moment.isoformat()
    if np.isfinite(focal_length) and focal_length > 0:
        extra["focal_length"] = float(focal_length)
    if aspect != 1.0 and 0.125 < aspect < 8.0:
        extra["pixel_aspect"] = float(aspect)
    return extra


def _mosaic_directory(directories: Sequence[Directory]) -> Directory:
    """The directory of the colour filter array; empty where there is none.

    Of several it is that of the largest, as in LibRaw: the others are previews.
    """
    kinds = [d for d in directories if d.get("PhotometricInterpretation") == (COLOUR_FILTER_ARRAY,)]
    sides = ("ImageLength", "ImageWidth")
    return max(kinds, key=lambda d: math.prod(sum(numbers(d, n)) for n in sides), default={})


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
        text = "%s: its white level (=%.10g) must be in [1, %d]; %d is used"
        logger.warning(text, path.name, stated, largest, largest)
        white = float(largest)
    if white <= max(black):
        levels = f"white {white:g}, black {tuple(black)}"
        raise RawFileError(f"must have a white level above its black levels, but says {levels}")
    return float(white)
