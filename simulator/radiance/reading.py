"""Reading radiance maps: Radiance RGBE (.hdr) and OpenEXR (.exr), in linear sRGB, upright.

OpenCV and OpenEXR decode the pixels. What a file says beside them is followed or refused by name:
orientation, primaries, parts and layers, windows, environment maps, the aspect of the pixels.
"""

import contextlib
import logging
import os
import re
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from simulator.utils.checks import import_extra
from simulator.utils.files import MAX_PIXELS, MAX_RADIANCE_PIXELS_PER_BYTE, as_path, refuse_bomb

logger = logging.getLogger(__name__)

#: File endings read here.
RADIANCE_SUFFIXES = (".hdr", ".exr")
#: Chromaticities x, y of red, green, blue and white: of sRGB, and of XYZ as Radiance writes it.
SRGB = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
_XYZ = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3)
_RADIANCE_FORMATS = {"32-bit_rle_rgbe": SRGB, "32-bit_rle_xyze": _XYZ}
#: Entries of a Radiance header whose lines multiply each other, and how many numbers a line has.
_MULTIPLIERS = {"PIXASPECT": 1, "COLORCORR": 3}
_ONE_AT_A_TIME = threading.Lock()
_RESOLUTION = re.compile(r"([-+])([XY]) +(\d{1,18}) +([-+])([XY]) +(\d{1,18})\s*")


class RadianceError(ValueError):
    """A radiance map that cannot be read; the message says what it is."""


def read_radiance(path: str | Path, *, layer: str | None = None) -> np.ndarray:
    """Linear light of an .hdr or .exr file in the primaries of sRGB, (3, H, W) float32, relative.

    Values that are not light are repaired, and the repair is logged: NaN and negative values
    (ringing of a filter, colours outside the gamut) become 0, +inf the largest finite value.
    Colours are converted by the chromaticities that a file states, whatever its white, else taken
    to be sRGB's; alpha and further channels are ignored; a file with luminance only is grey. Of an
    OpenEXR file that is the part and layer with R, G and B, or with luminance and chroma (Y, RY,
    BY); the picture fills its display window, black where there are no data.

    `layer` is a part or layer of an OpenEXR file, such as ``"ViewLayer.Combined"``; needed where
    several have R, G and B.

    Raises:
        FileNotFoundError: If there is no such file.
        ImportError: If the extra ``hdr`` is not installed.
        ValueError: If the file cannot be read, holds no light, is a cube map, has pixels that are
            not square, or more than `simulator.utils.files` allows for a file of its length.
    """
    path = as_path(path)
    if not path.is_file():
        raise FileNotFoundError(f"`path` (={str(path)!r}) must be an existing file")
    suffix = path.suffix.lower()
    if suffix not in RADIANCE_SUFFIXES:
        raise ValueError(f"`path` (={path.name!r}) must end in one of {list(RADIANCE_SUFFIXES)}")
    try:
        if suffix == ".hdr":
            if layer is not None:
                raise RadianceError("has no layers: leave out `layer`")
            image, primaries = _read_hdr(path)
        else:
            image, primaries = read_exr(path, (("R", "G", "B"), ("Y", "RY", "BY"), ("Y",)), layer)
        if len(image) == 1:
            image = np.repeat(image, 3, axis=0)
        elif not np.abs(np.subtract(primaries, SRGB)).max() <= 1e-4:  # NaN is none of these
            matrix = np.linalg.inv(_xyz_from_rgb(SRGB)) @ _xyz_from_rgb(primaries)
            most = np.max(image, initial=0.0, where=np.isfinite(image))  # inf - inf is no colour
            image = np.nan_to_num(image, nan=0.0, posinf=most, neginf=0.0)
            image = np.tensordot(matrix.astype(np.float32), image, axes=1)
        return _clean(image.astype(np.float32, copy=False), path)
    except FileNotFoundError:
        raise
    except RadianceError as error:
        raise RadianceError(f"radiance map {str(path)!r} {error}") from error.__cause__
    except OSError as error:
        raise RadianceError(f"radiance map {str(path)!r} cannot be read: {error}") from error


def _xyz_from_rgb(chromaticities: Sequence[float]) -> np.ndarray:
    """(3, 3) XYZ of R, G, B whose white, at (1, 1, 1), has the luminance 1."""
    x, y = np.reshape(chromaticities, (4, 2)).T.astype(np.float64)
    columns = np.stack([x, y, 1.0 - x - y])
    matrix, white = columns[:, :3], columns[:, 3]
    if not np.isfinite(columns).all() or not white[1] or abs(np.linalg.det(matrix)) < 1e-9:
        raise RadianceError(f"states primaries that are none: {tuple(chromaticities)}")
    return np.asarray(matrix * np.linalg.solve(matrix, white / white[1]))


def _check_aspect(aspect: float) -> None:
    if not abs(aspect - 1.0) <= 0.01:
        raise RadianceError(f"has pixels that are not square (aspect {aspect:g}): resample it")


def _refuse_lies(path: Path, height: int, width: int) -> None:
    bomb = refuse_bomb(height, width, path.stat().st_size, per_byte=MAX_RADIANCE_PIXELS_PER_BYTE)
    if bomb:
        raise RadianceError(bomb)


# -- Radiance ---------------------------------------------------------------------------------


def _read_hdr(path: Path) -> tuple[np.ndarray, Sequence[float]]:
    """Light (3, H, W), upright, and its primaries; OpenCV reads the usual header only."""
    cv2 = import_extra("cv2", "hdr", f"reading {path.name!r}")
    with path.open("rb") as stream:
        content = stream.read(5 * MAX_PIXELS)  # run lengths may make it longer than it would be
    found = re.match(rb"(#\?.*?\n)\r?\n([-+][XY] [^\n]*\n)", content[:65536], re.DOTALL)
    shown = None if found is None else _RESOLUTION.fullmatch(found[2].decode("ascii", "replace"))
    if found is None or shown is None or shown[2] == shown[5]:
        raise RadianceError("must be a complete Radiance file: its header has no resolution")
    entries: dict[str, str] = {}
    for line in found[1].decode("utf-8", "replace").splitlines():
        name, equals, value = line.partition("=")
        if equals:
            earlier = entries.get(name.strip(), "") if name.strip() in _MULTIPLIERS else ""
            entries[name.strip()] = f"{earlier} {value}".strip()
    aspect, correction = (_product(entries.get(n, ""), k) for n, k in _MULTIPLIERS.items())
    _check_aspect(aspect[0])
    if not ((correction >= 1e-6) & (correction <= 1e6)).all():
        raise RadianceError(f"states a COLORCORR that is none: {entries['COLORCORR']}")
    kind = entries.get("FORMAT", "32-bit_rle_rgbe")
    if kind not in _RADIANCE_FORMATS:
        raise RadianceError(f"has the format {kind!r}, which is none of {[*_RADIANCE_FORMATS]}")
    primaries: Sequence[float] = _RADIANCE_FORMATS[kind]
    if "PRIMARIES" in entries:
        try:
            stated = [float(number) for number in entries["PRIMARIES"].split()]
            if any(stated):  # some programs write zeros
                primaries = stated
                _xyz_from_rgb(primaries)
        except ValueError:
            raise RadianceError(f"states PRIMARIES that are none: {entries['PRIMARIES']}") from None
    lines, samples, data = int(shown[3]), int(shown[6]), content[found.end() :]
    _refuse_lies(path, lines, samples)
    if data[:2] != b"\2\2" and len(data) < 4 * lines * samples:
        raise RadianceError("is not complete, or has run lengths of before 1991 (not read)")
    head = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {lines} +X {samples}\n".encode()
    level = cv2.utils.logging.setLogLevel(0)  # the error below says it all
    image = None
    try:
        flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR
        with contextlib.suppress(cv2.error):
            image = cv2.imdecode(np.frombuffer(head + data, np.uint8), flags)
    finally:
        cv2.utils.logging.setLogLevel(level)
    if image is None or image.dtype != np.float32:
        raise RadianceError("must be a complete Radiance file: its pixels end too early")
    signs = {shown[2]: shown[1], shown[5]: shown[4]}
    if shown[2] == "X":  # columns are written, not rows
        image = image.swapaxes(0, 1)
    upright = image[:: 1 if signs["Y"] == "-" else -1, :: 1 if signs["X"] == "+" else -1]
    light = upright[:, :, ::-1].transpose(2, 0, 1)
    if (correction != 1.0).any():  # the light has been multiplied by it
        light = light / correction.astype(np.float32)[:, None, None]
    return light, primaries


def _product(text: str, count: int) -> np.ndarray:
    """Product of all lines of `count` numbers; 1 where there is none, NaN where it is no number."""
    with contextlib.suppress(ValueError), np.errstate(over="ignore"):
        return np.array(text.split(), np.float64).reshape(-1, count).prod(axis=0)
    return np.full(count, np.nan)


# -- OpenEXR ----------------------------------------------------------------------------------


#: Beside these a channel means another thing than alone: that of a colour, a direction, a place.
_COMPANIONS = {"R": {"G"}, "Y": {"X", "RY", "BY"}, "Z": {"X"}, "V": {"U"}}


class _Layer(NamedTuple):
    """Channels of a part, in the order that was asked for."""

    part: int
    name: str
    channels: tuple[str, ...]


def read_exr(
    path: Path, kinds: Sequence[tuple[str, ...]], layer: str | None, outside: float = 0.0
) -> tuple[np.ndarray, Sequence[float]]:
    """Channels (C, H, W) float32 of an OpenEXR file's display window, and their primaries.

    Args:
        kinds: Sets of channels by preference, such as R, G and B, or Y alone.
        layer: The part or layer to take them from; None where one alone has them.
        outside: Value of pixels that the file has no data of.

    Raises:
        ImportError: If the extra ``hdr`` is not installed.
        RadianceError: If there is no such layer, several have the channels and none is named, or
            the file is damaged, a cube map, or has pixels that are not square.
    """
    OpenEXR = import_extra("OpenEXR", "hdr", f"reading {path.name!r}")
    try:
        with _silence(), OpenEXR.File(os.fsencode(path), header_only=True) as file:
            headers = [dict(part.header) for part in file.parts]  # it empties its own
            _refuse_lies(path, *_claimed_size(headers))
            chosen = _chosen(headers, kinds, layer)
        with _silence(), OpenEXR.File(os.fsencode(path), separate_channels=True) as file:
            channels = file.parts[chosen.part].channels
            planes = [np.asarray(channels[n].pixels, np.float32) for n in chosen.channels]
    except RadianceError:
        raise
    except (RuntimeError, ValueError, LookupError) as error:
        rule = f"must be a complete OpenEXR file, but OpenEXR says: {error}"
        raise RadianceError(rule) from error
    header = headers[chosen.part]
    data, shown = (np.array(header[name]) for name in ("dataWindow", "displayWindow"))
    width, height = shown[1] - shown[0] + 1
    planes = [_interpolated(plane, tuple((data[1] - data[0] + 1)[::-1])) for plane in planes]
    try:
        primaries = [float(value) for value in header.get("chromaticities", SRGB)]
    except (TypeError, ValueError):
        primaries = []
    if len(primaries) != len(SRGB):
        raise RadianceError("states chromaticities that are not eight numbers")
    if chosen.channels[-1].upper().endswith("BY"):  # (R - Y) / Y and (B - Y) / Y
        luminance, (red, blue) = planes[0], (planes[0] * (1 + chroma) for chroma in planes[1:])
        of_red, of_green, of_blue = _xyz_from_rgb(primaries)[1].astype(np.float32)
        planes = [red, (luminance - of_red * red - of_blue * blue) / of_green, blue]
    image = np.full((len(planes), height, width), outside, np.float32)
    (left, top), (right, bottom) = np.maximum(data[0], shown[0]), np.minimum(data[1], shown[1]) + 1
    if right > left and bottom > top:
        target = image[:, top - shown[0][1] : bottom - shown[0][1], :]
        source = (slice(top - data[0][1], bottom - data[0][1]), slice(left - data[0][0], None))
        for plane, values in zip(target, planes, strict=True):
            plane[:, left - shown[0][0] : right - shown[0][0]] = values[source][:, : right - left]
    return image, primaries


def _interpolated(plane: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """Every pixel of a plane that has samples at every first, second, ... row and column only."""
    if not plane.size or any(n % stored for n, stored in zip(size, plane.shape, strict=True)):
        raise RadianceError(f"must have channels of {size} samples, but has {plane.shape}")
    for axis, count in enumerate(size):
        if plane.shape[axis] < count:
            at = np.arange(count, dtype=np.float32) / (count // plane.shape[axis])
            low, high = (plane.take(at.astype(int) + i, axis, mode="clip") for i in (0, 1))
            plane = low + (high - low) * np.expand_dims(at % 1.0, 1 - axis)
    return plane


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Within, nothing that OpenEXR prints is shown: the error that follows says it."""
    with _ONE_AT_A_TIME, open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        shown = os.dup(2)
        try:
            os.dup2(nowhere.fileno(), 2)
            yield
        finally:
            os.dup2(shown, 2)
            os.close(shown)


def _claimed_size(headers: Sequence[Any]) -> tuple[int, int]:
    """Rows and columns of all parts below one another; channels in threes."""
    height = width = 0
    for header in headers:
        windows = np.array([header["dataWindow"], header["displayWindow"]], np.int64)
        columns, rows = (windows[:, 1] - windows[:, 0] + 1).max(axis=0).tolist()
        height += rows * -(-len(header["channels"]) // 3)
        width = max(width, columns)
    return height, width


def _chosen(headers: Sequence[Any], kinds: Sequence[tuple[str, ...]], layer: str | None) -> _Layer:
    """The layer that has the first of `kinds` that any has."""
    found, names = [list[_Layer]() for _ in kinds], []
    for index, header in enumerate(headers):
        groups: dict[str, dict[str, str]] = {}
        for channel in header["channels"]:
            prefix, _, base = channel.name.rpartition(".")
            # In the order of ASCII, so that R comes before r.
            groups.setdefault(prefix, {}).setdefault(base.upper(), channel.name)
        part = header.get("name", "") if len(headers) > 1 else ""
        for prefix, channels in groups.items():
            name = ".".join(filter(None, (part, prefix)))
            names.append(f"{name or 'one without a name'} ({', '.join(channels)})")
            if str(header.get("type")).endswith(("deepscanline", "deeptile")):
                names[-1] += ", deep, which is not read"
                continue
            for kind, layers in zip(kinds, found, strict=True):
                part_of_more = len(kind) == 1 and _COMPANIONS.get(kind[0], set()) & set(channels)
                if set(kind) <= set(channels) and not part_of_more and layer in (None, name):
                    layers.append(_Layer(index, name, tuple(channels[base] for base in kind)))
    layers = next((layers for layers in found if layers), [])
    # R, G, B beside layers of their own are the picture.
    plain = [one for one in layers if not one.name]
    if len(layers) != 1 and len(plain) != 1:
        wanted = " or ".join(", ".join(kind) for kind in kinds)
        rule = f"must have {wanted} in one part or layer"
        if layer is not None:
            rule += f" called {layer!r}"
        elif layers:
            rule += f", else `layer` must name one of {[one.name for one in layers]}"
        raise RadianceError(f"{rule}; it has {'; '.join(names)}")
    chosen = (plain if len(layers) > 1 else layers)[0]
    header = headers[chosen.part]
    if str(header.get("envmap", "")).endswith("CUBE"):
        raise RadianceError("is a cube map: convert it to an equirectangular panorama")
    _check_aspect(header.get("pixelAspectRatio", 1.0))
    return chosen


def _clean(image: np.ndarray, path: Path) -> np.ndarray:
    undefined, infinite, negative = np.isnan(image), np.isposinf(image), image < 0
    if undefined.any() or infinite.any() or negative.any():
        finite = np.where(undefined | negative | infinite, 0.0, image)
        image = np.where(infinite, finite.max(), finite)
        logger.info(
            "radiance map %s: %d NaN and %d negative values set to 0, %d infinite to the maximum",
            *(path.name, undefined.sum(), negative.sum(), infinite.sum()),
        )
    if not image.any():
        raise RadianceError("must hold some light, but is 0 everywhere")
    return np.ascontiguousarray(image, np.float32)
