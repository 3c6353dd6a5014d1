"""Radiance maps: views into panoramas, and their assumed light.

A radiance map is linear but relative: nothing in it says how many lux it shows.
"""

import hashlib
import math

import numpy as np
import torch

from simulator.radiance.procedural import NATIVE_SIZE
from simulator.utils.files import printable

#: Directions of the views cut from a panorama [degrees], and their field of view.
AZIMUTHS = (0.0, 90.0, 180.0, 270.0)
FIELD_OF_VIEW = 60.0
#: Range of the EV100 assumed for a map of unknown light.
EV100_RANGE = (3.0, 14.0)
#: Maps whose median lies beyond 2 to this power, or below its inverse, are scaled first.
_USUAL_EXPONENT = 20


def near_one(image: np.ndarray) -> np.ndarray:
    """A map of unknown scale whose median is far from 1, divided by a power of two near to it."""
    _, exponent = math.frexp(float(np.quantile(image[image > 0], 0.5, method="lower")))
    if abs(exponent) <= _USUAL_EXPONENT:
        return image
    with np.errstate(over="ignore", under="ignore"):
        return np.asarray(np.minimum(np.ldexp(image, -exponent), np.float32(2.0**100)))


def map_views(
    image: np.ndarray, resolution: int | None, *, native: bool = False
) -> tuple[dict[str, np.ndarray], bool]:
    """The views of a map that become scenes, and whether their pixels are photosites.

    A picture twice as wide as high (to 1 %) is an equirectangular panorama and gives four views
    with a field of view of 60 degrees; any other gives its central square. Both have about 256
    packed pixels a side (`native_size`). Where the map has at least as many pixels there as
    photosites (512 x 512) the views have twice as many, for a colour filter array to sample;
    `native` samples a coarser map, too, if it has the photosites of a middle of `resolution`.
    The views are by the ending of their names.
    """
    height, width = image.shape[1:]
    is_panorama = abs(width / height - 2.0) <= 0.01
    available = min(height, width)
    size = native_size(resolution) if is_panorama else native_size(resolution, available)
    if is_panorama:
        available = int(width / math.pi * math.tan(math.radians(FIELD_OF_VIEW) / 2.0))
    sampled = available >= 2 * size
    if sampled:
        size = 2 * size
    elif native and resolution and available >= 2 * resolution:
        sampled, size = True, available // 2 * 2
    if is_panorama:
        return {f"-{round(a):03d}": perspective(image, a, size) for a in AZIMUTHS}, sampled
    return {"": _central_square(image, size)}, sampled


def native_size(resolution: int | None, available: int = NATIVE_SIZE) -> int:
    """Packed pixels a side of a view before it is resized to `resolution`.

    The largest multiple of `resolution` up to 256 and up to the `available` pixels, and at least
    `resolution` itself.

    >>> native_size(64), native_size(100), native_size(512), native_size(64, 150)
    (256, 200, 512, 128)
    """
    size = min(NATIVE_SIZE, available)
    if resolution is None:
        return size
    return resolution * max(1, size // max(resolution, 1))


def hash_fraction(name: str) -> float:
    """A number in [0, 1) that `name` alone decides."""
    return int.from_bytes(hashlib.sha256(printable(name).encode()).digest()[:8], "big") / 2**64


def assumed_ev100(group: str) -> float:
    """EV100 of a map of unknown light, in [3, 14], by a hash of its source group."""
    low, high = EV100_RANGE
    return round(low + hash_fraction(group) * (high - low), 2)


def perspective(
    panorama: np.ndarray,
    azimuth: float,
    size: int,
    field_of_view: float = FIELD_OF_VIEW,
    pitch: float = 0.0,
) -> np.ndarray:
    """A pin-hole view (3, size, size) into an equirectangular panorama (gnomonic).

    Sampled bilinearly at least as densely as the panorama has pixels, then box-averaged, so that
    small lamps keep their energy. Columns of `panorama`, (3, H, W) with W = 2 H, are longitudes
    from -180 degrees, rows latitudes from +90 degrees; `azimuth` and `pitch` are those of the
    view's middle. `field_of_view` is horizontal and vertical, in (0, 150] degrees.
    """
    half = math.tan(math.radians(field_of_view) / 2.0)
    per_radian = panorama.shape[2] / (2.0 * math.pi)
    dense = max(1, math.ceil(per_radian / (size / (2.0 * half))))
    axis = half * ((np.arange(size * dense) + 0.5) / (size * dense) * 2.0 - 1.0)
    sine, cosine = math.sin(math.radians(pitch)), math.cos(math.radians(pitch))
    right, up = axis[None, :], cosine * -axis[:, None] + sine
    forward = cosine + sine * axis[:, None]
    longitude = math.radians(azimuth) + np.arctan2(right, forward)
    latitude = np.arctan2(up, np.hypot(forward, right))
    column = (longitude / (2.0 * math.pi) + 0.5) * panorama.shape[2] - 0.5
    row = (0.5 - latitude / math.pi) * panorama.shape[1] - 0.5
    view = _bilinear(panorama, row, column).reshape(3, size, dense, size, dense)
    return np.asarray(view.mean(axis=(2, 4)).astype(np.float32))


def _bilinear(image: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Values of (3, H, W) at fractional positions: columns wrap around, rows are clamped."""
    height, width = image.shape[1:]
    wide = np.concatenate([image[..., -1:], image, image[..., :1]], axis=2)
    # grid_sample counts from -1 to 1 over the whole pixels, of which there are two more in a row.
    x = (np.mod(column + 0.5, width) + 1.0) * 2.0 / (width + 2) - 1.0
    y = (row + 0.5) * 2.0 / height - 1.0
    places = torch.from_numpy(np.stack([x, y], axis=-1).astype(np.float32))
    values = torch.nn.functional.grid_sample(
        torch.from_numpy(wide)[None], places[None], padding_mode="border", align_corners=False
    )
    return values[0].numpy()


def _central_square(image: np.ndarray, size: int) -> np.ndarray:
    """The middle of `image`, box-averaged by the largest integer that leaves `size` pixels."""
    height, width = image.shape[1:]
    k = min(height, width) // size
    if k == 0:
        raise ValueError(f"{height} x {width} pixels must be at least {size} a side")
    top, left = (height - k * size) // 2, (width - k * size) // 2
    square = image[:, top : top + k * size, left : left + k * size]
    return np.asarray(square.reshape(3, size, k, size, k).mean(axis=(2, 4)))
