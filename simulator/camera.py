"""Camera profiles: what a sensor does to light, and how noisy it is at each ISO."""

import functools
import json
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from importlib import resources
from numbers import Real
from typing import Any, Self

import numpy as np

from simulator.camera_files import normalised_model, pixel_fields, read_camera_file
from simulator.noise.noise_level_function import NoiseLevelFunction, ReadNoise
from simulator.settings import CameraSettings
from simulator.utils.checks import check_integer, check_number, check_word

#: A sample at or below this signal counts as clipped low: ten stops below white.
LOW_CLIP = 2.0**-10
#: A sample at or above this signal counts as clipped high.
HIGH_CLIP = 1.0 - 1e-6
#: Of a body whose file has none: `read_raw` takes those of the raw.
_LEVELS_OF_MANY = {"cfa": "RGGB", "black_level": 1024, "white_level": 16383, "bit_depth": 14}
#: Least and greatest ISO.
_ISOS = (sys.float_info.min, sys.float_info.max)


class BayerPattern(StrEnum):
    """Colour filter array, the 2 x 2 tile read row by row."""

    RGGB = "RGGB"
    BGGR = "BGGR"
    GRBG = "GRBG"
    GBRG = "GBRG"

    @property
    def offsets(self) -> tuple[tuple[int, int], ...]:
        """(row, column) inside the tile of R, G1, G2, B; G1 shares its rows with R.

        >>> BayerPattern("GRBG").offsets
        ((0, 1), (0, 0), (1, 1), (1, 0))
        """
        red, blue = self.value.index("R"), self.value.index("B")
        # Each green is in the other column of a row.
        return tuple(divmod(i, 2) for i in (red, red ^ 1, blue ^ 1, blue))


@dataclass(frozen=True)
class CameraProfile:
    """A camera body."""

    name: str  #: unique lower-case name, such as ``"nikon_z6"``
    cfa: BayerPattern  #: order of the colour filter array
    #: Digital number of no light, per plane R, G1, G2, B.
    black_level: tuple[float, float, float, float]
    white_level: float  #: digital number at which the sensor saturates, whole
    bit_depth: int  #: bits per sample of its raw files
    #: Share of white from which a photosite is full where another one of its pixel is at white:
    #: photosites of some compact cameras differ by some percent.
    full_level: float = field(default=1.0, kw_only=True)
    make: str = "unknown"  #: maker as EXIF spells it
    model: str = "unknown"  #: model as EXIF spells it
    #: Calibrated noise level function by ISO; empty if unknown.
    nlf_by_iso: Mapping[float, NoiseLevelFunction] = field(default_factory=dict, hash=False)
    #: Rows and tails of the read noise by ISO, for ``noise="sensor"``; empty if unknown.
    read_noise_by_iso: Mapping[float, ReadNoise] = field(default_factory=dict, hash=False)
    #: ISO at which a new conversion-gain segment begins; interpolation never crosses it.
    segments: tuple[float, ...] = field(default=(), hash=False)
    #: XYZ (D65) to camera RGB, row by row (3 x 3); None if unknown.
    colour_matrix: tuple[tuple[float, float, float], ...] | None = field(default=None, hash=False)
    colour_matrix_source: str = ""  #: where the matrix comes from
    #: Distance between sensor pixels [micrometre]; None if unknown.
    pixel_pitch_um: float | None = None
    row_time: float = 0.0  #: read-out time of one sensor row [s]
    #: Photo response non-uniformity: standard deviation of the gains of the photosites, relative to
    #: their mean (EMVA 1288). They are a pattern that belongs to the body and stays.
    prnu: float = field(default=0.0, kw_only=True)
    #: Electrons that a photosite collects in the dark [1/s], at the temperature of the calibration.
    #: Black-level subtraction removes their mean; their shot noise stays.
    dark_current: float = field(default=0.0, kw_only=True)
    source: str = ""  #: where the noise calibration comes from

    def __post_init__(self) -> None:
        check_word("cfa", self.cfa, tuple(p.value for p in BayerPattern))
        object.__setattr__(self, "cfa", BayerPattern(self.cfa))
        level = self.black_level
        black = (float(level),) * 4 if isinstance(level, Real) else tuple(map(float, level))
        if len(black) != 4:
            raise ValueError(f"`black_level` (={black}) must be one number or 4 (R, G1, G2, B)")
        object.__setattr__(self, "black_level", black)
        check_integer("bit_depth", self.bit_depth, 1, 16)
        check_number("full_level", self.full_level, 0.5, 1.0)
        check_number("prnu", self.prnu, 0.0, 0.2)
        check_number("dark_current", self.dark_current, 0.0, 1e12)
        white, largest = self.white_level, 2**16 - 1
        if not (all(0 <= b < white for b in black) and white <= largest and white == round(white)):
            raise ValueError(
                f"`white_level` (={white}) must be a whole number above every black level "
                f"(={black}), at most {largest}"
            )

    @functools.cached_property
    def span(self) -> tuple[float, float, float, float]:
        """Digital numbers from black to white, per plane R, G1, G2, B."""
        return tuple(self.white_level - b for b in self.black_level)  # type: ignore[return-value]

    @property
    def pedestal(self) -> tuple[float, float, float, float]:
        """How far below zero a packed raw can go, per plane: black / (white - black)."""
        return tuple(b / (self.white_level - b) for b in self.black_level)  # type: ignore[return-value]

    @functools.cached_property
    def digits(self) -> np.ndarray:
        """How it digitises a signal: (6, 4) float32, columns are the planes R, G1, G2, B.

        The rows: digital numbers from black to white, digital number of black, largest one that
        counts as clipped low, smallest one that counts as clipped high, largest one, and the
        variance that rounding adds to a signal.
        """
        span, black = (np.array(v, np.float32)[:, None] for v in (self.span, self.black_level))
        numbers = np.arange(int(self.white_level) + 1, dtype=np.float32)
        signals = (numbers - black) / span  # (4, W)
        low = (signals <= LOW_CLIP).sum(axis=1) - 1
        high = len(numbers) - (signals >= HIGH_CLIP).sum(axis=1)
        white = np.full(4, self.white_level)
        rows = span[:, 0], black[:, 0], low, high, white, 1.0 / (12.0 * np.square(span[:, 0]))
        table = np.stack(rows).astype(np.float32)
        table.flags.writeable = False
        return table

    def nlf(self, iso: float, exposure_time: float = 0.0) -> NoiseLevelFunction:
        """Noise level function at `iso`, with the dark current's shot noise of an exposure [s].

        Log-log interpolation between calibrated ISOs, inside a conversion-gain segment. Outside,
        shot noise scales with ISO and read noise with its square, but for the rounding to digital
        numbers (1/12 DN^2), which is the same at each ISO; beyond the table
        `NoiseLevelFunction.extrapolation` says how far. A `ValueError` if the profile has no noise
        calibration or `iso` is not positive.
        """
        nlf = self._calibrated(iso)
        if not self.dark_current * exposure_time:
            return nlf
        # So many electrons are their own variance; each is `shot` where white is 1.
        electrons = self.dark_current * exposure_time
        read = [r + electrons * s * s for r, s in zip(nlf.read, nlf.shot, strict=True)]
        return replace(nlf, read=read)  # type: ignore[arg-type]

    def nlfs(self, states: Iterable[CameraSettings]) -> list[NoiseLevelFunction]:
        """`nlf` of captures; those that are alike are worked out once."""
        keys = [(s.iso, s.exposure_time if self.dark_current else 0.0) for s in states]
        known = {key: self.nlf(*key) for key in dict.fromkeys(keys)}
        return [known[key] for key in keys]

    def _calibrated(self, iso: float) -> NoiseLevelFunction:
        if not self.nlf_by_iso:
            raise ValueError(
                f"camera {self.name!r} has no noise calibration; give `nlf`, or estimate one with "
                "simulator.estimate_nlf"
            )
        iso, table = check_number("iso", iso, *_ISOS), self.nlf_by_iso
        if iso in table:
            return table[iso]
        isos = _segment(self, table, iso)
        if not isos[0] < iso < isos[-1]:
            nearest = min(isos, key=lambda i: abs(math.log(iso / i)))
            stops = math.log2(iso / min(max(iso, min(table)), max(table)))  # beyond the table
            return _amplified(self, table[nearest], iso / nearest, stops)
        high = next(i for i in isos if i > iso)
        low = isos[isos.index(high) - 1]
        t = math.log(iso / low) / math.log(high / low)
        shot, read = (
            [x ** (1 - t) * y**t for x, y in zip(*pair, strict=True)]
            for pair in zip(*((table[i].shot, table[i].read) for i in (low, high)), strict=True)
        )
        return NoiseLevelFunction(shot, read, source=table[low].source)  # type: ignore[arg-type]

    def read_noise(self, iso: float, box_factor: int = 1) -> ReadNoise:
        """Rows and tails of the read noise at `iso`, of averages of `box_factor` squared pixels.

        Interpolated over log ISO inside a conversion-gain segment; outside the table the nearest. A
        `ValueError` if the profile has no such calibration or `iso` is not positive.
        """
        if not self.read_noise_by_iso:
            raise ValueError(
                f"camera {self.name!r} has no calibration of row noise and of the read noise's "
                "shape: `noise` must be 'exact' or 'bank'; a profile of your own has it in "
                "`read_noise_by_iso`"
            )
        iso, table = check_number("iso", iso, *_ISOS), self.read_noise_by_iso
        isos = _segment(self, table, iso)
        row, shape = (
            float(np.interp(math.log(iso), np.log(isos), [getattr(table[i], name) for i in isos]))
            for name in ("row", "shape")
        )
        return ReadNoise(row, shape, box_factor)

    def with_levels(self, black_level: Sequence[float], white_level: float, bit_depth: int) -> Self:
        """This camera with a file's `black_level` (4,) and `white_level` [DN] of `bit_depth` bits.

        The noise is scaled to them: the same digital numbers, as shares of the converter's range,
        are more or less of the way to white.
        """
        levels: dict[str, Any] = {"black_level": black_level, "white_level": white_level}
        other = replace(self, **levels, bit_depth=bit_depth)
        own, new = (
            [span / 2.0**depth for span in spans]
            for spans, depth in ((self.span, self.bit_depth), (other.span, bit_depth))
        )
        factor = sum(own) / sum(new)
        table = {iso: nlf.exposed(factor) for iso, nlf in self.nlf_by_iso.items()}
        return replace(other, nlf_by_iso=table)

    def with_nlf(self, iso: float, nlf: NoiseLevelFunction) -> Self:
        """This camera with `nlf`, measured at `iso`, as its only noise calibration."""
        return replace(self, nlf_by_iso={float(iso): nlf}, segments=(), source=nlf.source)


def _segment(camera: CameraProfile, table: Mapping[float, object], iso: float) -> list[float]:
    """The ISOs of `table` in the conversion-gain segment of `iso`; all where it has none."""
    bounds = [0.0, *camera.segments, math.inf]
    index = sum(iso >= b for b in bounds) - 1
    return sorted(i for i in table if bounds[index] <= i < bounds[index + 1]) or sorted(table)


def _amplified(
    camera: CameraProfile, nlf: NoiseLevelFunction, gain: float, stops: float
) -> NoiseLevelFunction:
    """`nlf` after `gain` in front of the rounding, whose variance is therefore not multiplied."""
    rounding = [min(v, 1 / 12 / s**2) for v, s in zip(nlf.read, camera.span, strict=True)]
    before = replace(nlf, read=[v - r for v, r in zip(nlf.read, rounding, strict=True)])  # type: ignore[arg-type]
    after = before.exposed(gain)
    read = [v + r for v, r in zip(after.read, rounding, strict=True)]
    return replace(after, read=read, extrapolation=stops)  # type: ignore[arg-type]


@functools.cache
def _built_in() -> dict[str, CameraProfile]:
    text = resources.files("simulator").joinpath("cameras.json").read_text(encoding="utf-8")
    cameras = {}
    for name, entry in json.loads(text).items():
        nlf_by_iso, read_noise_by_iso = {}, {}
        for iso, values in entry.pop("nlf_by_iso").items():
            shot, read = ([v[0], v[1], v[1], v[2]] for v in (values["shot"], values["read"]))
            nlf_by_iso[float(iso)] = NoiseLevelFunction(shot, read, source=entry["source"])  # type: ignore[arg-type]
            if "row" in values:
                read_noise_by_iso[float(iso)] = ReadNoise(values["row"], values["shape"])
        entry["colour_matrix"] = tuple(tuple(row) for row in entry["colour_matrix"])
        entry["segments"] = tuple(entry["segments"])
        entry |= {"nlf_by_iso": nlf_by_iso, "read_noise_by_iso": read_noise_by_iso}
        cameras[name] = CameraProfile(name=name, **entry)
    return cameras


def list_cameras() -> list[str]:
    """Names of the built-in cameras."""
    return sorted(_built_in())


def get_camera(name: str) -> CameraProfile:
    """The camera called `name`: a built-in one, or one of a file (`simulator.camera_files`).

    A file's is ``"ctt:FILE"``, a tuning of Raspberry Pi's, ``"emva:FILE"``, flat fields, or
    ``"darktable:MAKER MODEL"`` with the noise of darktable's profile: of a built-in camera all else
    stays, another one has an RGGB array and levels of 14 bits unless options say more. After each
    name, ``"?prnu=0.005&dark_current=20"`` sets what pixels differ by and collect in the dark. A
    `ValueError` proposes the nearest name.
    """
    fields = read_camera_file(name) if isinstance(name, str) else None
    if fields is None:
        body, mark, query = name.partition("?") if isinstance(name, str) else (name, "", "")
        check_word("camera", body, tuple(list_cameras()))
        return replace(_built_in()[body], **pixel_fields(query)) if mark else _built_in()[body]
    known = {normalised_model(c.make, c.model): c for c in _built_in().values()}
    base = known.get(normalised_model(fields["make"], fields["model"]))
    if base is None:
        return CameraProfile(**{**_LEVELS_OF_MANY, **fields})
    return replace(base, **{**fields, "make": base.make, "model": base.model})
