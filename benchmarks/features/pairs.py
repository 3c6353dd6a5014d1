"""Pictures, and pairs of views of them with a known homography."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.harness import data_root
from simulator import develop
from simulator.radiance.maps import read_radiance
from simulator.raw.develop import GREY_CARD_SIGNAL
from simulator.training.scenes import (
    Split,
    photograph_pictures,
    radiance_files,
    recorded_mosaics,
)

#: Brightest light of a map, in its medians.
_BRIGHTEST = 64.0
#: Corners that are labels: least contrast, and least distance [pixel].
_LEAST_CORNER, _CORNER_DISTANCE = 2e-5, 4


class Source(NamedTuple):
    """Light of one picture; `group` is the unit of splitting.

    (3, 2H, 2W) linear at the pitch of the photosites, or (4, H, W) planes of a raw; its median
    green is that of a metered exposure.
    """

    name: str
    group: str
    light: Tensor


class View(NamedTuple):
    """A source picture (H, W, 3) uint8 sRGB at its metered exposure, and its corners (N, 2)."""

    picture: np.ndarray
    corners: np.ndarray


def sources(split: Split, *, raws: bool, limit: int | None = None) -> list[Source]:
    data = data_root()
    if data is None:
        raise FileNotFoundError("set AE_ENV_DATA to the folder of real files (photo_pool, maps)")
    found = []
    for picture in islice(photograph_pictures(data, split), limit):
        found.append(Source(picture.name, picture.group, _metered(picture.light)))
    for path, group in islice(radiance_files(data, split), limit):
        light = read_radiance(path)
        light = np.minimum(light / max(float(np.median(light[1])), 1e-9), _BRIGHTEST)
        found.append(Source(path.stem, group, _metered(torch.from_numpy(light))))
    for belongs in ("train", "validation", "test") if raws else ():
        for raw in recorded_mosaics(data, belongs):
            found.append(Source(raw.name, raw.group, _metered(raw.light.clamp(min=0.0))))
    return found


def _metered(light: Tensor) -> Tensor:
    """`light` at an exposure at which its median green is that of a grey card."""
    return light.float() * (GREY_CARD_SIGNAL / max(float(light[1].median()), 1e-9))


def training_view(source: Source) -> View:
    """The picture of a source as files hold them, and Shi and Tomasi's corners of it."""
    packed = source.light[None]
    if packed.shape[1] == 3:
        packed = F.avg_pool2d(packed, 2)[:, [0, 1, 1, 2]]
    picture = develop(packed)[0].permute(1, 2, 0).numpy()
    grey = cv2.GaussianBlur(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), (0, 0), 1.0)
    strength = torch.from_numpy(cv2.cornerMinEigenVal(grey, 5))[None, None]
    largest = F.max_pool2d(strength, 2 * _CORNER_DISTANCE + 1, 1, _CORNER_DISTANCE)
    peaks = ((strength == largest) & (strength > _LEAST_CORNER))[0, 0].nonzero()
    corners = peaks.flip(1).numpy().astype(np.float32)
    return View(np.round(picture * 255.0).astype(np.uint8), corners)


# -- homographies ---------------------------------------------------------------------------------


def crop_homography(
    rng: np.random.Generator,
    centre: np.ndarray,
    size: int,
    scale: float,
    turn: float,
    jitter: float,
) -> np.ndarray:
    """(3, 3) from a picture to a crop of `size` pixels a side around `centre` (x, y).

    Drawn: a factor of up to `scale` either way, a rotation of up to `turn` degrees, and shifts of
    the corners of up to `jitter` sides of the crop.
    """
    half = 0.5 * size * scale ** rng.uniform(-1.0, 1.0)
    angle = np.radians(rng.uniform(-turn, turn))
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moved = square + 2.0 * rng.uniform(-jitter, jitter, (4, 2))
    given = (centre + half * moved @ rotation.T).astype(np.float32)
    wanted = (0.5 * size * (square + 1.0) - 0.5).astype(np.float32)
    return cv2.getPerspectiveTransform(given, wanted).astype(np.float64)


def mapped(points: np.ndarray, homography: np.ndarray) -> np.ndarray:
    """Points (N, 2) mapped by a homography."""
    if not len(points):
        return points.reshape(0, 2)
    return cv2.perspectiveTransform(points.astype(np.float64)[None], homography)[0]


def inside(points: np.ndarray, size: int, border: float = 0.0) -> np.ndarray:
    """(N,) whether points lie in a crop."""
    return ((points >= border) & (points <= size - 1 - border)).all(axis=1)


def two_crops(
    rng: np.random.Generator, height: int, width: int, size: int
) -> tuple[np.ndarray, np.ndarray]:
    reach = min(0.75 * size, 0.5 * min(height, width))
    centre = np.array([rng.uniform(reach, width - reach), rng.uniform(reach, height - reach)])
    first = crop_homography(rng, centre, size, 1.1, 0.0, 0.0)
    moved = centre + rng.uniform(-0.1, 0.1, 2) * size
    return first, crop_homography(rng, moved, size, 1.25, 25.0, 0.1)


def warped(image: np.ndarray, homography: np.ndarray, size: int) -> np.ndarray:
    flags, border = cv2.INTER_LINEAR, cv2.BORDER_REFLECT_101
    return cv2.warpPerspective(image, homography, (size, size), flags=flags, borderMode=border)


def finer(homography: np.ndarray) -> np.ndarray:
    """The same between pictures of twice the pixels a side."""
    # Pixel x of a picture is at 2 x + 1/2 of the finer one.
    up = np.array([[2.0, 0.0, 0.5], [0.0, 2.0, 0.5], [0.0, 0.0, 1.0]])
    return up @ homography @ np.linalg.inv(up)


def batches(count: int, size: int, seed: int) -> Iterator[np.ndarray]:
    """Indices of endless batches, each picture as often as any other."""
    rng, left = np.random.default_rng([seed, 1]), np.zeros(0, np.int64)
    while True:
        while len(left) < size:
            left = np.concatenate([left, rng.permutation(count)])
        yield left[:size]
        left = left[size:]
