"""Vignetting: how a lens darkens a frame towards its corners.

The model is lensfun's ``pa``: of the light in the centre, ``C(r) = 1 + k1 r^2 + k2 r^4 + k3 r^6``
is left at a distance r from it; r is 1 in the corners. The coefficients depend on the f-number.
"""

import functools
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from simulator.utils.checks import (
    check_type,
    did_you_mean,
    import_extra,
    parse_number,
    parse_options,
)

#: Lenses that `random_lens` chooses from.
RANDOM_LENSES = 64
_PREFIX, _KEYS = "lensfun:", ("focal", "crop")
#: Focus [m] whose vignetting is taken: as far as lensfun measures.
_FAR = 1000.0


@dataclass(frozen=True)
class Vignetting:
    """Light that a lens leaves in every part of the frame, relative to the centre.

    Between its f-numbers the coefficients are interpolated in stops; beyond, the nearest count.

    >>> lens = Vignetting("half in the corners", (2.0,), ((-0.5, 0.0, 0.0),))
    >>> lens.illumination(2.0, (1, 2)).astype(float).round(3).tolist()  # r^2 = 0.25 / 1.25
    [[0.9, 0.9]]
    """

    name: str
    f_numbers: tuple[float, ...]  # rising
    coefficients: tuple[tuple[float, float, float], ...]  # k1, k2, k3 for each
    #: Maps that were asked for: kernels know them by their addresses.
    _maps: dict[tuple[Any, ...], np.ndarray] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def __post_init__(self) -> None:
        numbers, terms = np.array(self.f_numbers, float), np.array(self.coefficients, float)
        if numbers.ndim != 1 or not len(numbers) or not (np.diff(numbers, prepend=0.0) > 0.0).all():
            raise ValueError(f"`f_numbers` (={self.f_numbers}) must be positive and rise")
        if terms.shape != (len(numbers), 3) or not np.isfinite(terms).all():
            raise ValueError(f"`coefficients` (={self.coefficients}) must be k1, k2, k3 of each")
        left = _polynomial(terms, np.linspace(0.0, 1.0, 101)[:, None] ** 2)
        if not (left > 0.0).all():
            worst = numbers[int(left.min(axis=0).argmin())]
            raise ValueError(f"`coefficients` must leave light everywhere: none at f/{worst:g}")

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_maps": {}}

    def illumination(
        self, f_number: float, shape: tuple[int, int], source: float | None = None
    ) -> np.ndarray:
        """(H, W) float32 share of the centre's light, of a frame of `shape` (H, W).

        Where `source` is the f-number of a capture through the same lens, relative to that.
        """
        key = f_number, shape, source
        if key not in self._maps:
            height, width = shape
            y, x = (np.arange(n) + 0.5 - n / 2 for n in shape)
            squared = (y[:, None] ** 2 + x**2) / (height**2 / 4 + width**2 / 4)
            left = _polynomial(self._terms(f_number), squared)
            if source is not None:
                left /= _polynomial(self._terms(source), squared)
            self._maps[key] = left.astype(np.float32)
        return self._maps[key]

    def corner_loss(self, f_number: float) -> float:
        """How much darker the corners are than the centre [EV]."""
        return -math.log2(float(_polynomial(self._terms(f_number), np.ones(()))))

    def _terms(self, f_number: float) -> np.ndarray:
        stops, columns = np.log2(self.f_numbers), np.array(self.coefficients).T
        return np.array([np.interp(math.log2(f_number), stops, terms) for terms in columns])


def _polynomial(terms: np.ndarray, squared: np.ndarray) -> np.ndarray:
    """C(r) of k1, k2, k3 (..., 3) at r^2."""
    k1, k2, k3 = np.moveaxis(terms, -1, 0)
    return np.asarray(1.0 + squared * (k1 + squared * (k2 + squared * k3)))


def get_lens(lens: str | Vignetting | None) -> Vignetting | None:
    """A lens, or one of lensfun's database by its name.

    Args:
        lens: ``"lensfun:NAME"``, such as ``"lensfun:Canon EF 24-70mm f/2.8L II USM?focal=50"``. The
            focal length [mm] is by default the geometric mean of the shortest and the longest;
            ``crop=`` is the crop factor of the camera, by default the one that the lens was
            measured on. A `Vignetting` and None are returned as they are.

    Raises:
        ValueError: If lensfun has no vignetting for it.
        ImportError: Without lensfunpy (extra ``lens``).
    """
    if not isinstance(lens, str):
        check_type("lens", lens, Vignetting, None)
        return lens
    if not lens.startswith(_PREFIX):
        rule = f"'{_PREFIX}NAME', a `Vignetting` or None; environments also take 'random'"
        raise ValueError(f"`lens` (={lens!r}) must be {rule}")
    name, _, query = lens.removeprefix(_PREFIX).partition("?")
    numbers = parse_options("lens", query, _KEYS)
    for key, value in numbers.items():
        if not 0.0 < parse_number(value, f"lens?{key}") < math.inf:
            raise ValueError(f"`lens?{key}` (={value}) must be above 0 and finite")
    return _from_lensfun(name, *(float(numbers.get(key, 0.0)) for key in _KEYS))


@functools.cache
def _from_lensfun(name: str, focal: float, crop: float) -> Vignetting:
    """The lens `name`; 0 stands for the defaults of `get_lens`."""
    database = import_extra("lensfunpy", "lens", "`lens`").Database()
    known = [lens for lens in database.lenses if lens.calib_vignetting]
    found = [lens for lens in known if lens.model.casefold() == name.casefold()]
    if not found:
        hint = did_you_mean(name, sorted({lens.model for lens in known}))
        raise ValueError(f"`lens` (={_PREFIX + name!r}) is not among lensfun's{hint}")
    lens = min(found, key=lambda one: float(one.crop_factor))  # measured on the largest frame
    shortest, longest = lens.min_focal, lens.max_focal or lens.min_focal
    focal = focal or math.sqrt(shortest * longest)
    if not shortest <= focal <= longest:
        raise ValueError(
            f"`lens?focal` (={focal:g}) must be in [{shortest:g}, {longest:g}] mm: {lens.model}"
        )
    crop = crop or lens.crop_factor
    if crop < lens.crop_factor:
        raise ValueError(
            f"`lens?crop` (={crop:g}) must be at least {lens.crop_factor:g}: {lens.model} was "
            "measured on no larger frame"
        )
    scales = (lens.crop_factor / crop) ** np.array([2.0, 4.0, 6.0])
    f_numbers = sorted({one.aperture for one in lens.calib_vignetting})
    measured = {f: lens.interpolate_vignetting(focal, f, _FAR) for f in f_numbers}
    terms = {f: np.array(v.terms[:3]) * scales for f, v in measured.items() if v is not None}
    rounded = tuple(float(f"{f:.3g}") for f in terms)  # lensfun has single precision
    return Vignetting(lens.model, rounded, tuple(tuple(t.tolist()) for t in terms.values()))


@functools.cache
def random_lens(number: int) -> Vignetting:
    """One of `RANDOM_LENSES` lenses, drawn once, that are as dark as those of lensfun's database.

    There, 502 lenses lose 0.4 to 2.5 EV in the corners when wide open and 0.04 to 1.3 EV when
    stopped down (5th to 95th percentile).
    """
    rng = np.random.default_rng((20070201, number))
    widest = rng.choice([1.4, 2.0, 2.8, 4.0])
    opened = min(1.2 * math.exp(0.55 * rng.standard_normal()), 3.0)
    closed = opened * min(0.27 * math.exp(0.5 * rng.standard_normal()), 0.9)
    shape = rng.uniform(0.6, 1.6)  # share of the loss that grows with r^2, the rest with r^4
    f_numbers = widest * 2.0 ** (np.arange(8) / 2.0)
    # Stopping down by one stop leaves 0.6 of what stopping down can mend.
    lost = 1.0 - 2.0 ** -(closed + (opened - closed) * 0.6 ** np.arange(8))
    terms = tuple((-share * shape, -share * (1.0 - shape), 0.0) for share in lost.tolist())
    return Vignetting(f"random {number}", tuple(f_numbers.tolist()), terms)
