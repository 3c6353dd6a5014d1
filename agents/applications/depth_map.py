"""Depth maps: from a depth camera, a stereo matcher or a network, as files hold them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from PIL import Image

from agents.applications.hdr import import_openexr
from simulator.training.scenes import fill_from_nearest

#: What the numbers of a file are: distances, or inverse distances.
DepthKind = Literal["distance", "disparity"]
#: Metres for each unit of a PNG, as depth cameras write them.
PNG_METRES = 1e-3


def read_depth(
    path: str | Path, *, kind: DepthKind = "distance", scale: float | None = None
) -> np.ndarray:
    """Distances from the lens.

    Args:
        path: A PNG of one channel (8 or 16 bit), an EXR (channel Z, Y or R) or a ``.npy`` array
            (H, W).
        kind: ``"disparity"`` where larger numbers are nearer: 1 / metres, times a constant.
        scale: Metres for each unit, or 1 / metres for each unit of disparity. By default
            a PNG of distances is in millimetres, an EXR or ``.npy`` in metres; a disparity has
            no default.

    Returns:
        (H, W) float64 [m], all > 0. Where the file has no number (0 in a PNG, NaN, infinite or
        negative elsewhere; 0 is infinitely far in a disparity of floats), the nearest pixel's.

    Raises:
        ImportError: If an EXR is given and OpenEXR is not installed.
        ValueError: If the file is no such map, or `kind` or `scale` is wrong.
    """
    path = Path(path)
    if kind not in get_args(DepthKind):
        raise ValueError(f"`kind` (={kind!r}) must be one of {list(get_args(DepthKind))}")
    if scale is not None and not 0.0 < scale < math.inf:
        raise ValueError(f"`scale` (={scale!r}) must be finite and > 0")
    if scale is None and kind == "disparity":
        raise ValueError("`scale` (=None) must be given for a disparity: 1 / metres for each unit")
    readers = {".png": _read_png, ".exr": _read_exr, ".npy": _read_npy}
    if path.suffix.lower() not in readers:
        raise ValueError(f"`depth` (={str(path)!r}) must end in .png, .exr or .npy")
    if not path.is_file():
        raise ValueError(f"`depth` (={str(path)!r}): there is no such file")
    values = np.asarray(readers[path.suffix.lower()](path), np.float64)
    if values.ndim != 2 or not values.size:
        raise ValueError(f"`depth` (={str(path)!r}, shape {values.shape}) must be one map (H, W)")
    of_png = path.suffix.lower() == ".png"
    known = np.isfinite(values) & ((values > 0) | ((values == 0) & (kind != "distance")))
    if of_png:
        known = values > 0
    if not (known & (values > 0)).any():
        raise ValueError(f"`depth` (={str(path)!r}) must hold a number above 0")
    filled = fill_from_nearest(np.where(known, values, np.nan))
    if kind == "disparity":
        with np.errstate(divide="ignore"):
            return np.asarray(1.0 / (filled * scale))
    return filled * (scale or (PNG_METRES if of_png else 1.0))


def _read_png(path: Path) -> np.ndarray:
    try:
        with Image.open(path) as picture:
            if picture.format != "PNG" or picture.mode not in ("L", "I;16", "I;16B", "I"):
                raise ValueError(
                    f"`depth` (={str(path)!r}, {picture.format} {picture.mode}) must be a PNG of "
                    "one channel of 8 or 16 bit"
                )
            return np.asarray(picture)
    except (OSError, SyntaxError) as error:
        raise ValueError(f"`depth` (={str(path)!r}) cannot be read: {error}") from error


def _read_npy(path: Path) -> np.ndarray:
    try:
        values = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise ValueError(f"`depth` (={str(path)!r}) cannot be read: {error}") from error
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "uif":
        raise ValueError(f"`depth` (={str(path)!r}) must be one array of numbers")
    return values


def _read_exr(path: Path) -> np.ndarray:
    openexr = import_openexr()
    try:
        with openexr.File(str(path), separate_channels=True) as file:
            channels = {name: c.pixels for name, c in file.channels().items()}
    except (RuntimeError, ValueError, OSError) as error:
        raise ValueError(f"`depth` (={str(path)!r}) cannot be read: {error}") from error
    for name in ("Z", "Y", "R"):
        if name in channels:
            return np.asarray(channels[name])
    raise ValueError(f"`depth` (={str(path)!r}, channels {sorted(channels)}) must have Z, Y or R")
