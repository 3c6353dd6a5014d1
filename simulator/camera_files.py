"""Camera bodies from files of a user: Raspberry Pi's tuning, darktable's profiles, flat fields.

The files don't come with the package. The first two say how noisy a body is, on scales of their
own; the noise of flat fields is measured:

- *The camera tuning tool* (ctt) of Raspberry Pi fits ``constant + slope * sqrt(mean)`` to the
  standard deviation of the patches of a ColorChecker, less black, in numbers of 16 bits, at gain 1.
  That is ISO 100 here. Its square is a straight line where the constant is 0, as in most files;
  otherwise the nearest straight line (least squares from black to white) is taken.
- *darktable* fits ``b + a * signal`` to the variance of a colour, where black is 0 and white is 1.
  It measures a picture that PPG has demosaicked, from the differences of the differences of 2 x 2
  pixels, divided by 4 (Haar's HH coefficient, ``tools/noise/noiseprofile.c``). Green then has
  `GREEN_SHARE` of a photosite's variance. Red and blue inherit the noise of the greens around them,
  so their numbers depend on the colour of the profiled picture, and are not used: planes with equal
  white levels and gains have equal `shot`.
- *Flat fields* are measured as EMVA 1288 (release 4.0, linear model) has it. The system gain is the
  slope of the variance over the mean, both less their dark values, up to 70 % of the saturation.
  The covariance of the frames of a pair is the variance of the pattern in both; there, that of PRNU
  grows with the square of the signal. The dark current is the slope of the dark mean over time.
"""

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import is_zipfile

import numpy as np

from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.utils.checks import (
    check_integer,
    check_number,
    did_you_mean,
    parse_number,
    parse_options,
)

#: Share of the variance of a photosite in HH of the green that PPG makes of a flat field; LibRaw's
#: PPG has 0.076 to 0.080 for greens that are 1 to 2.5 times as bright as red and blue.
GREEN_SHARE = 0.078
#: Environment variable that names darktable's ``noiseprofiles.json``.
DARKTABLE_VARIABLE = "AE_ENV_DARKTABLE"
#: Where an installed darktable has it.
_INSTALLED = (
    "/usr/share/darktable/noiseprofiles.json",
    "/usr/local/share/darktable/noiseprofiles.json",
    "/Applications/darktable.app/Contents/Resources/share/darktable/noiseprofiles.json",
    "C:/Program Files/darktable/share/darktable/noiseprofiles.json",
)
#: Linear sRGB (D65) to CIE XYZ, IEC 61966-2-1:1999.
XYZ_FROM_SRGB = ((0.4124, 0.3576, 0.1805), (0.2126, 0.7152, 0.0722), (0.0193, 0.1192, 0.9505))
#: Colour temperature of the matrix [K].
_DAYLIGHT = 6504.0
#: Bits of the numbers of a tuning file.
_TUNED_BITS = 16
#: Variance of rounding to 14 bits, the least that darktable's read noise can be: some are negative.
_ROUNDING = 1 / 12 / 2.0**28
#: Fields of a profile by option.
_FIELDS = {"black": "black_level", "white": "white_level", "bits": "bit_depth", "cfa": "cfa"}
#: Options of every camera, which are fields: what photosites differ by, and collect in the dark.
_PIXEL = ("prnu", "dark_current")


def normalised_model(make: str, model: str) -> str:
    """Make and model for comparison: lower case, letters and digits, the maker's name once.

    >>> normalised_model("NIKON CORPORATION", "NIKON Z 6"), normalised_model("Nikon", "Z 6")
    ('nikonz6', 'nikonz6')
    """
    words = re.findall(r"[a-z0-9]+", make.lower())
    maker = words[0] if words else ""
    return maker + _letters(model).removeprefix(maker)


def _letters(text: str) -> str:
    return "".join(re.findall(r"[a-z0-9]+", text.lower()))


def read_camera_file(name: str) -> dict[str, Any] | None:
    """Fields of the `CameraProfile` that ``"ctt:FILE"`` or ``"darktable:MAKER MODEL"`` names.

    ``"emva:FILE"`` is a ``.npz`` of flat fields (`read_flat_fields`). None if `name` has no such
    form. Options follow a question mark: ``bits`` (by default 10 of a tuned sensor, those of the
    largest number of flat fields) and ``cfa`` (RGGB); darktable's ``file``, and ``black``,
    ``white``, ``bits`` and ``cfa`` of its body, which are missing from the fields otherwise; and
    ``prnu`` and ``dark_current`` of all.

    Raises:
        ValueError: If the file or the body is not there, or is not what it should be.
    """
    kind, mark, rest = name.partition(":")
    if not mark or kind not in _READERS:
        return None
    stem, _, query = rest.rpartition("?") if "?" in rest else (rest, "", "")
    reader, known = _READERS[kind]
    try:
        options = parse_options("camera", query, (*known, *_PIXEL))
        return reader(stem, options) | pixel_fields(query, known)
    except (KeyError, TypeError, AttributeError, IndexError, np.linalg.LinAlgError) as error:
        what = {"ctt": "tuning file of libcamera", "darktable": "noiseprofiles.json of darktable"}
        what["emva"] = "npz of flat fields"
        fault = f"lacks {error}" if isinstance(error, KeyError) else f"has a wrong entry: {error}"
        raise ValueError(f"`camera` (={name!r}) must name a {what[kind]}: it {fault}") from None
    except (ValueError, OSError) as error:
        raise ValueError(f"`camera` (={name!r}) cannot be used: {error}") from None


def pixel_fields(query: str, known: tuple[str, ...] = ()) -> dict[str, Any]:
    """``prnu`` and ``dark_current`` of options, which may also be those that are `known`."""
    options = parse_options("camera", query, (*known, *_PIXEL))
    return {key: parse_number(options[key], f"camera?{key}") for key in _PIXEL if key in options}


def _read(path: Path) -> Any:
    from simulator.utils.files import read_bounded  # needs the version of the whole package

    return json.loads(read_bounded(path.expanduser()))


def _number(name: str, text: str) -> int:
    if not text.isdecimal():
        raise ValueError(f"`{name}` (={text!r}) must be a whole number")
    return int(text)


# -- Raspberry Pi's tuning ------------------------------------------------------------------------


def _from_ctt(path: str, options: Mapping[str, str]) -> dict[str, Any]:
    content = _read(Path(path))
    blocks = content.get("algorithms", content)  # a list of blocks since version 2
    if isinstance(blocks, list):
        blocks = {key: value for block in blocks for key, value in block.items()}
    bits = check_integer("bits", _number("bits", options.get("bits", "10")), 8, _TUNED_BITS)
    unit, own = 2.0 ** (_TUNED_BITS - bits), blocks.get("rpi.black_level", {})
    common = own.get("black_level", 4096)
    red, green, blue = (own.get(f"black_level_{c}", common) / unit for c in "rgb")
    white, noise = 2**bits - 1, blocks["rpi.noise"]
    for level in (red, green, blue):
        check_number("rpi.black_level", level * unit, 0.0, 2.0**_TUNED_BITS - 2.0 * unit)
    for key in ("reference_constant", "reference_slope"):
        check_number(f"rpi.noise.{key}", noise[key], 0.0, 2.0**_TUNED_BITS)
    constant, slope = noise["reference_constant"] / unit, noise["reference_slope"] / unit**0.5
    shot, read = zip(
        *(_straight(constant, slope, white - b) for b in (red, green, green, blue)), strict=True
    )
    model, nlf = Path(path).stem, NoiseLevelFunction(shot, read, source=f"tuning file {path}")
    return {
        "name": f"ctt_{model.lower()}",
        "make": "Raspberry Pi",
        "model": model,
        "cfa": options.get("cfa", "RGGB"),
        "black_level": (red, green, green, blue),
        "white_level": white,
        "bit_depth": bits,
        "nlf_by_iso": {100.0: nlf},
        "colour_matrix": _colour_matrix(blocks),
        "colour_matrix_source": f"rpi.ccm and rpi.awb of {path}",
        "source": nlf.source,
    }


def _straight(constant: float, slope: float, span: float) -> tuple[float, float]:
    """`shot` and `read` on the scale where `span` [DN] is 1.

    The square of the fit has a root of the signal in it. Of sqrt(x) from 0 to 1 the least squares
    line is 4/15 + 4/5 x.
    """
    mixed = 2.0 * constant * slope * span**0.5
    variance_at_0 = constant**2 + 4 / 15 * mixed
    shot = (slope**2 * span + 4 / 5 * mixed) / span**2
    return shot, max(variance_at_0, 1 / 12) / span**2


def _colour_matrix(blocks: Mapping[str, Any]) -> tuple[tuple[float, ...], ...] | None:
    """XYZ to camera RGB in daylight; None of a monochrome sensor."""
    if "rpi.ccm" not in blocks or "ct_curve" not in blocks.get("rpi.awb", {}):
        return None
    nearest = min(blocks["rpi.ccm"]["ccms"], key=lambda entry: abs(entry["ct"] - _DAYLIGHT))
    curve = np.reshape(blocks["rpi.awb"]["ct_curve"], (-1, 3))  # of grey: K, red/green, blue/green
    red, blue = (np.interp(nearest["ct"], curve[:, 0], curve[:, i]) for i in (1, 2))
    camera_from_srgb = np.diag([red, 1.0, blue]) @ np.linalg.inv(np.reshape(nearest["ccm"], (3, 3)))
    return tuple(map(tuple, (camera_from_srgb @ np.linalg.inv(XYZ_FROM_SRGB)).tolist()))


# -- darktable's noise profiles -------------------------------------------------------------------


def _from_darktable(body: str, options: Mapping[str, str]) -> dict[str, Any]:
    here = next((path for path in _INSTALLED if Path(path).is_file()), None)
    path = options.get("file") or os.environ.get(DARKTABLE_VARIABLE) or here
    if path is None:
        rule = f"set {DARKTABLE_VARIABLE} to its noiseprofiles.json"
        raise ValueError(f"there is no darktable in the usual places; {rule}")
    known = {
        f"{maker['maker']} {model['model']}": (maker["maker"], model)
        for maker in _read(Path(path))["noiseprofiles"]
        for model in maker["models"]
    }
    found = [
        name
        for name, (_, model) in known.items()
        if _letters(body) in (_letters(name), _letters(model["model"]))
    ]
    if not found:
        raise ValueError(f"{path} has {len(known)} bodies, not {body!r}{did_you_mean(body, known)}")
    make, model = known[found[0]]
    table: dict[float, list[tuple[float, float]]] = {}
    for one in model["profiles"]:
        if not one.get("skip") and one["a"][1] > 0:  # darktable does not use what it skips either
            table.setdefault(float(one["iso"]), []).append((one["a"][1], one["b"][1]))
    means = {iso: np.mean(pairs, axis=0) / GREEN_SHARE for iso, pairs in table.items()}
    source = f"darktable's noise profile of the {found[0]}"
    given: dict[str, Any] = {
        field: text if key == "cfa" else _number(key, text)
        for key, field in _FIELDS.items()
        for text in [options.get(key)]
        if text is not None
    }
    if not table:
        raise ValueError(f"{path} has no profile of {found[0]} that darktable uses")
    return {
        **given,
        "name": f"darktable_{_letters(body)}",
        "make": make,
        "model": model["model"],
        "nlf_by_iso": {
            iso: NoiseLevelFunction((a,) * 4, (max(b, _ROUNDING),) * 4, source=source)
            for iso, (a, b) in sorted(means.items())
        },
        "source": source,
    }


# -- flat fields ----------------------------------------------------------------------------------

#: Up to this share of the saturation, where the variance is highest, the gain is fitted.
FITTED = 0.7
#: Least dark variance [DN²] that frames can show (EMVA 1288): rounding hides smaller ones.
LEAST_VARIANCE = 0.24


class FlatFields(NamedTuple):
    """Pairs of flat fields of a monochrome sensor, or of one colour, at a ladder of exposures."""

    bright: np.ndarray  # (N, 2, H, W) [DN]
    dark: np.ndarray  # the same without light
    photons: np.ndarray  # (N,) mean photons of a pixel; zeros if unknown
    times: np.ndarray  # (N,) exposure times

    @property
    def dark_variance(self) -> float:
        """Temporal variance in the dark after no time [DN²], at least `LEAST_VARIANCE`."""
        return max(float(np.polyfit(self.times, pair_moments(self.dark)[1], 1)[1]), LEAST_VARIANCE)

    def gain(self, dark_variance: float | None = None) -> float:
        """System gain [DN per electron]; `dark_variance` takes the place of the dark frames'."""
        (mean, variance), (dark, noise) = pair_moments(self.bright), pair_moments(self.dark)
        signal, extra = mean - dark, variance - (noise if dark_variance is None else dark_variance)
        fit = signal <= FITTED * signal[variance.argmax()]
        return float(signal[fit] @ extra[fit] / (signal[fit] @ signal[fit]))

    @property
    def prnu(self) -> float:
        """Standard deviation of the pixels' gains relative to their mean."""
        (mean, variance), (dark, _) = pair_moments(self.bright), pair_moments(self.dark)
        signal, extra = mean - dark, _pattern(self.bright) - _pattern(self.dark)
        fit = signal <= FITTED * signal[variance.argmax()]
        square = signal[fit] ** 2
        return max(float(square @ extra[fit] / (square @ square)), 0.0) ** 0.5

    @property
    def dark_current(self) -> tuple[float, float]:
        """Electrons per second, and their standard error."""
        times, dark = self.times * 1e-9, pair_moments(self.dark)[0]
        (slope, _), covariance = np.polyfit(times, dark, 1, cov=True)
        return float(slope / self.gain()), float(covariance[0, 0] ** 0.5 / self.gain())


def _pattern(frames: np.ndarray) -> np.ndarray:
    """Variance (N,) of what both frames of each pair (N, 2, H, W) show: their covariance."""
    apart = frames - frames.mean(axis=(2, 3), keepdims=True)
    return np.asarray(apart.prod(axis=1).mean(axis=(1, 2)))


def pair_moments(frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and temporal variance of each pair of frames (N, 2, H, W): two arrays (N,)."""
    change = np.diff(frames.astype(float), axis=1)
    return frames.mean(axis=(1, 2, 3)), change.var(axis=(1, 2, 3)) / 2


def read_flat_fields(path: str | os.PathLike[str]) -> FlatFields:
    """Flat fields of a ``.npz``: bright, dark, bright_photons (optional), bright_exposure_ns.

    Exposures after those whose times rise are of other measurements, and are left out.
    """
    path = Path(path).expanduser()
    if path.is_file() and not is_zipfile(path):
        raise ValueError(f"{path.name} is no .npz")
    with np.load(path) as file:
        found = dict(file)
    bright, dark, times = (found[name] for name in ("bright", "dark", "bright_exposure_ns"))
    photons = found.get("bright_photons", 0.0 * times)
    pairs = bright.ndim == 4 and bright.shape[1] == 2 and len(times) == len(photons) == len(bright)
    if not pairs or bright.shape != dark.shape:
        raise ValueError("`bright` and `dark` must be (exposures, 2, H, W), with as many times")
    whole = all(np.array_equal(frames, np.rint(np.abs(frames))) for frames in (bright, dark))
    if not whole or len(times) < 3 or not np.diff(times[:3]).min() > 0:
        raise ValueError(
            "`bright` and `dark` must be whole numbers >= 0 at three exposures or more, and "
            "`bright_exposure_ns` must rise"
        )
    bright, dark = bright.astype(np.int64), dark.astype(np.int64)
    count = int(np.argmax(np.append(np.diff(times) <= 0, True))) + 1
    return FlatFields(*(values[:count] for values in (bright, dark, photons, times)))


def _from_flat_fields(path: str, options: Mapping[str, str]) -> dict[str, Any]:
    from scipy.stats import norm

    fields = read_flat_fields(path)
    dark, most = fields.dark, int(fields.bright.max()).bit_length()
    bits = check_integer("bits", _number("bits", options.get("bits", str(most))), most, 16)
    black, variance = float(dark.mean()), fields.dark_variance
    if variance <= LEAST_VARIANCE:  # the normal distribution with the shares of the dark numbers
        share = np.cumsum(np.bincount(dark.ravel())) / dark.size
        told = (share > 1e-3) & (share < 1 - 1e-3)
        slope, start = np.polyfit(np.flatnonzero(told) + 0.5, norm.ppf(share[told]), 1)
        # The mean of all frames shows what pixels differ by, which is no noise.
        black, variance = -start / slope, slope**-2 - dark.mean(axis=(0, 1)).var() + 1 / 12
    span, source = 2**bits - 1 - black, f"flat fields {path}"
    shot, read = fields.gain(variance) / span, variance / span**2
    nlf = NoiseLevelFunction((shot,) * 4, (read,) * 4, source=source)
    levels = {"black_level": black, "white_level": 2**bits - 1, "bit_depth": bits}
    name = Path(path).stem
    body = {"name": f"emva_{name.lower()}", "model": name, "cfa": options.get("cfa", "RGGB")}
    dark_current, error = fields.dark_current
    pixels = {"prnu": fields.prnu, "dark_current": dark_current * (dark_current > 3.0 * error)}
    fixed = {**body, "make": "unknown", **levels, "source": source}
    return {**fixed, **pixels, "nlf_by_iso": {100.0: nlf}}


_READERS = {
    "ctt": (_from_ctt, ("bits", "cfa")),
    "darktable": (_from_darktable, (*_FIELDS, "file")),
    "emva": (_from_flat_fields, ("bits", "cfa")),
}
