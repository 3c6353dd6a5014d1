"""A raw photograph as the simulator handles it, and its digital numbers."""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import torch

from simulator.camera import CameraProfile
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.settings import CameraSettings
from simulator.utils.checks import check_integer, check_type
from simulator.utils.compute import kernel, parallel_ranges

PLANES = ("R", "G1", "G2", "B")
#: Packed rows from which a second thread helps, and that are packed at a time.
_SHARE, _ROWS = 128, 32


@dataclass(frozen=True, eq=False)
class RawImage:
    """A raw photograph: packed sensor data with the settings and camera that took it.

    A `ValueError` if the data has the wrong shape or dtype or is not finite, or another argument is
    of the wrong type or out of range.
    """

    #: (4, H, W) float, planes R, G1, G2, B; black-subtracted, 1.0 is sensor white, negative values
    #: are real.
    data: torch.Tensor
    settings: CameraSettings  #: ISO, exposure time and f-number of the exposure
    camera: CameraProfile  #: the body that recorded it
    #: Noise of this very raw, where the file states it (DNG NoiseProfile) or it was estimated; by
    #: default the camera's at this ISO.
    nlf: NoiseLevelFunction | None = None
    #: Gains of R, G, B that make a grey card grey, green 1.
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    box_factor: int = 1  #: sensor pixels averaged per side into one pixel of `data`
    #: Whatever else is known: file name, how the NLF was found, excess noise.
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "data", check_packed("data", self.data))
        check_type("settings", self.settings, CameraSettings)
        check_type("camera", self.camera, CameraProfile)
        check_type("nlf", self.nlf, NoiseLevelFunction, None)
        gains = tuple(float(g) for g in self.white_balance)
        if len(gains) != 3 or not all(np.isfinite(g) and g > 0 for g in gains):
            raise ValueError(f"`white_balance` (={gains}) must be 3 positive gains (R, G, B)")
        object.__setattr__(self, "white_balance", gains)
        check_integer("box_factor", self.box_factor, 1)

    @classmethod
    def from_mosaic(
        cls, mosaic: np.ndarray, settings: CameraSettings, camera: CameraProfile, **fields: Any
    ) -> Self:
        """A raw from `mosaic` (2H, 2W) [DN], the CFA of `camera`, `settings` and other `fields`."""
        return cls(pack_mosaic(np.asarray(mosaic), camera), settings, camera, **fields)

    @classmethod
    def from_finite(cls, data: torch.Tensor, *fields: Any, **more: Any) -> Self:
        """A raw of finite `data` (4, H, W) float32, not checked; `fields` and `more` too."""
        raw = cls(data[:, :1, :1], *fields, **more)
        object.__setattr__(raw, "data", data)
        return raw

    def to_mosaic(self) -> np.ndarray:
        """Digital numbers as the sensor would record them, (2H, 2W) uint16."""
        return unpack_mosaic(self.data, self.camera)

    @property
    def noise(self) -> NoiseLevelFunction:
        """NLF of this raw's pixels: its own or its camera's, after the box averaging.

        A `ValueError` if neither is known.
        """
        own, nlf = self.settings, self.nlf
        nlf = self.camera.nlf(own.iso, own.exposure_time) if nlf is None else nlf
        return nlf.scaled(1.0 / self.box_factor**2)

    @property
    def saturated(self) -> torch.Tensor:
        """(H, W) bool: some plane of the pixel is within half a digital number of white."""
        limits = np.array([1.0 - 0.5 / s for s in self.camera.span], np.float32)
        if self.data.device.type != "cpu":
            return (self.data >= torch.tensor(limits).to(self.data)[:, None, None]).any(dim=0)

        data = self.data.detach().contiguous().numpy()
        marks = np.empty(data.shape[1:], np.bool_)
        mark = functools.partial(mark_saturated, data, limits, marks)
        parallel_ranges(mark, len(marks), least=_SHARE)
        return torch.from_numpy(marks)

    def __repr__(self) -> str:
        _, height, width = self.data.shape
        return f"RawImage({height} x {width} packed, {self.settings}, {self.camera.name})"


def pack_mosaic(mosaic: np.ndarray, camera: CameraProfile) -> torch.Tensor:
    """Bayer mosaic (2H, 2W) of digital numbers, of any dtype, to a packed raw (4, H, W) float32.

    The tile of an RGGB camera, G1 on red's rows and G2 on blue's::

        R  G1
        G2 B

    An odd last row or column is dropped.
    """
    if mosaic.ndim != 2 or min(mosaic.shape) < 2:
        raise ValueError(f"`mosaic` (shape {mosaic.shape}) must be (2H, 2W) with H, W >= 1")
    height, width = mosaic.shape[0] // 2, mosaic.shape[1] // 2
    planes = np.empty((4, height, width), np.float32)

    # One kernel for what files hold, and one for all else.
    dtype = np.uint16 if mosaic.dtype == np.uint16 else np.float64
    tile = _tile(camera)
    black, span = (np.array(v, np.float64) for v in (camera.black_level, camera.span))

    def pack(first: int, last: int) -> None:
        for top in range(first, last, _ROWS):  # what has to be copied stays in the cache
            rows = mosaic[2 * top : 2 * min(top + _ROWS, last)]
            pack_rows(np.ascontiguousarray(rows, dtype), tile, black, span, top, planes)

    parallel_ranges(pack, height, least=_SHARE)
    return torch.from_numpy(planes)


def unpack_mosaic(
    data: torch.Tensor, camera: CameraProfile, first: int = 0, last: int | None = None
) -> np.ndarray:
    """Packed rows `first` to `last` of (4, H, W) to a mosaic (2H, 2W); inverts `pack_mosaic`."""
    planes = data.detach().float().cpu().contiguous().numpy()
    _, height, width = planes.shape
    count = (height if last is None else last) - first
    mosaic = np.empty((2 * count, 2 * width), np.uint16)

    tile, white = _tile(camera), np.float32(camera.white_level)
    black, span = (np.array(v, np.float32) for v in (camera.black_level, camera.span))

    def unpack(top: int, bottom: int) -> None:
        part = mosaic[2 * top : 2 * bottom]
        unpack_rows(planes, tile, black, span, white, first + top, first + bottom, part)

    parallel_ranges(unpack, count, least=_SHARE)
    return mosaic


def _tile(camera: CameraProfile) -> np.ndarray:
    """(2, 2) plane at each position of the colour filter array."""
    tile = np.empty((2, 2), np.int64)
    for plane, position in enumerate(camera.cfa.offsets):
        tile[position] = plane
    return tile


def new_frame(like: torch.Tensor) -> torch.Tensor:
    """Uninitialised float32 memory for a frame of the shape of `like`.

    On the CPU NumPy's, which asks for huge pages: to write to it first takes a quarter of the time
    that torch's takes, but longer where a virtual machine's host still has to give them.
    """
    if like.is_cpu:
        return torch.from_numpy(np.empty(like.shape, np.float32))
    return torch.empty(like.shape, dtype=torch.float32, device=like.device)


def check_packed(name: str, data: object, *, ndim: int = 3) -> torch.Tensor:
    """`data` as a float32 packed raw, or a `ValueError` with name, value and rule."""
    if isinstance(data, np.ndarray) and data.dtype.kind in "biuf":
        data = torch.from_numpy(np.ascontiguousarray(data))
    if not isinstance(data, torch.Tensor) or data.layout != torch.strided:
        kind = getattr(data, "layout", type(data).__name__)
        rule = "must be a dense torch tensor or numpy array of numbers"
        raise ValueError(f"`{name}` (={kind}) {rule}")
    shape = "(4, H, W)" if ndim == 3 else "(B, 4, H, W)"
    if data.ndim != ndim or data.shape[-3] != 4 or min(data.shape) < 1:
        rule = f"must be {shape}, not empty: R, G1, G2, B"
        raise ValueError(f"`{name}` (shape {tuple(data.shape)}) {rule}")
    if not data.dtype.is_floating_point:
        rule = "must be floating point, white at 1.0; for digital numbers see RawImage.from_mosaic"
        raise ValueError(f"`{name}` (dtype {data.dtype}) {rule}")
    data = data.float()
    low, high = torch.aminmax(data.detach())  # passes NaN on; 20 times faster than isfinite().all()
    if not (math.isfinite(low.item()) and math.isfinite(high.item())):
        bad = int((~torch.isfinite(data)).sum())
        raise ValueError(f"`{name}` ({bad} values NaN or infinite) must be finite everywhere")
    return data


# -- kernels of the CPU: a mosaic to planes and back in one pass --------------------------------


# The two planes of a mosaic row are taken together: their columns alternate, and the compiler
# vectorises whole rows only.
@kernel()
def _split(row, left_black, left_span, right_black, right_span, left, right):  # type: ignore[no-untyped-def]
    for x in range(len(left)):
        left[x] = np.float32((np.float64(row[2 * x]) - left_black) / left_span)
        right[x] = np.float32((np.float64(row[2 * x + 1]) - right_black) / right_span)


@kernel()
def pack_rows(mosaic, tile, black, span, first, planes):  # type: ignore[no-untyped-def]
    """Fill rows of `planes` (4, H, W) float32 from `first` on: ``(mosaic - black) / span``.

    `mosaic` (2R, 2W or more) holds those rows, `tile` (2, 2) the plane at each position; `black`
    and `span` are (4,) float64.
    """
    for y in range(len(mosaic) // 2):
        for row in range(2):
            p, q = tile[row]
            left, right = planes[p, first + y], planes[q, first + y]
            _split(mosaic[2 * y + row], black[p], span[p], black[q], span[q], left, right)


@kernel()
def _weave(left, left_black, left_span, right, right_black, right_span, white, row):  # type: ignore[no-untyped-def]
    zero = np.float32(0)
    for x in range(len(left)):
        a = np.rint(left[x] * left_span + left_black)
        b = np.rint(right[x] * right_span + right_black)
        a, b = a if a > zero else zero, b if b > zero else zero
        row[2 * x] = np.uint16(np.int32(a if a < white else white))
        row[2 * x + 1] = np.uint16(np.int32(b if b < white else white))


@kernel()
def unpack_rows(planes, tile, black, span, white, first, last, mosaic):  # type: ignore[no-untyped-def]
    """The inverse of `pack_rows`, rounded and clipped to [0, white], in float32 as captures are."""
    for y in range(first, last):
        for row in range(2):
            p, q = tile[row]
            left, right, out = planes[p, y], planes[q, y], mosaic[2 * (y - first) + row]
            _weave(left, black[p], span[p], right, black[q], span[q], white, out)


@kernel()
def mark_saturated(planes, limits, marks, first, last):  # type: ignore[no-untyped-def]
    """Set `marks` (H, W) in rows `first` to `last` where a plane reaches its limit (4,) float32."""
    r, g1, g2, b = limits
    for y in range(first, last):
        row = marks[y]
        for x in range(len(row)):
            upper = (planes[0, y, x] >= r) | (planes[1, y, x] >= g1)
            row[x] = upper | (planes[2, y, x] >= g2) | (planes[3, y, x] >= b)
