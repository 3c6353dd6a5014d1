"""Pictures with real detail at the pitch of the photosites, for the networks' training and tests.

A folder of data (see docs/networks.md) gives radiance maps, photographs and raws; dead
leaves, charts and smooth shading are drawn. Everything is split by source group: the same place,
subject or photographer's series is on one side only.
"""

from __future__ import annotations

import csv
import hashlib
import json
import logging
import zlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.radiance.maps import RADIANCE_SUFFIXES, read_radiance
from simulator.radiance.photographs import unprocess
from simulator.radiance.procedural import LeafStyle, dead_leaves, fractal_noise
from simulator.raw.read import read_raw
from simulator.training.crops import DetailPicture
from simulator.utils.checks import check_word

logger = logging.getLogger(__name__)

Split = Literal["train", "validation", "test"]

#: Index of the first procedural group of each split.
FIRST_INDEX = {"train": 0, "validation": 100_000, "test": 200_000}
#: Groups whose split was fixed before the hash decided; all others follow `detail_split`.
_FIXED: dict[Split, tuple[str, ...]] = {
    "train": ("bridge", "dawn", "forest", "lobby"),
    "validation": ("StillLife", "city"),
    "test": ("Desk", "apartment", "lab", "park", "sunset", "venice", "warehouse"),
}
#: Folders of radiance maps and of photographs.
_MAP_FOLDERS, _PHOTOGRAPH_FOLDER = ("hdri_pool", "hdri_cc0", "openexr_bsd"), "photo_pool"
#: Shares of the source groups: training, validation; the rest tests.
_TRAIN, _VALIDATION = 0.62, 0.70
#: Raws of known subjects: file name (its beginning) to group and split.
_RAWS: dict[str, tuple[str, Split]] = {
    "CRW_0101": ("colour_checker", "train"),
    "CRW_0104": ("colour_checker", "train"),
    "CRW_0105": ("colour_checker", "train"),
    "CRW_0112": ("pantone_strip", "train"),
    "CRW_0113": ("pantone_strip", "train"),
    "CRW_0117": ("camera_box", "test"),
    "CRW_0118": ("camera_box", "test"),
    "CRW_0119": ("camera_box", "test"),
    "GOPR0024": ("gopro_courtyard", "train"),
    "GOPR9231": ("gopro_courtyard", "train"),
}
#: Brightest light of a picture, in its medians: lamps beyond it would be all that a mean shows.
_BRIGHTEST = 64.0
#: Photosites a side of drawn pictures, and how many of each kind there are in a split.
_SIZE = 640
_DRAWN = {"train": 60, "validation": 8, "test": 8}


def detail_split(group: str) -> Split:
    """The split of a source group, by a stable hash of its name.

    >>> detail_split("quarry_02") == detail_split("quarry_02")
    True
    """
    for split, names in _FIXED.items():
        if group in names:
            return split
    draw = int.from_bytes(hashlib.sha256(group.encode()).digest()[:8], "big") / 2**64
    return "train" if draw < _TRAIN else "validation" if draw < _VALIDATION else "test"


def detail_pictures(
    split: Split, *, data: Path | None, drawn: int | None = None, seed: int = 0
) -> list[DetailPicture]:
    """The pictures of a split.

    Args:
        split: ``"train"``, ``"validation"`` or ``"test"``.
        data: Folder of real files; None uses drawn pictures only. What is missing in it is logged.
        drawn: Dead leaves, and as many charts and smooth pictures; 60 to train on, else 8.
        seed: Seed of the drawn pictures.

    Raises:
        ValueError: If `split` is no split.
    """
    check_word("split", split, tuple(FIRST_INDEX))
    pictures: list[DetailPicture] = []
    if data is None:
        logger.warning("no folder of real files (AE_ENV_DATA): training on drawn pictures only")
    else:
        pictures += _maps(data, split)
        pictures += photograph_pictures(data, split)
        pictures += recorded_mosaics(data, split)
        pictures += _linear(data, split)
    pictures += _drawings(split, _DRAWN[split] if drawn is None else drawn, seed)
    return pictures


def radiance_files(data: Path, split: Split) -> Iterator[tuple[Path, str]]:
    """Radiance maps of a split, each with its source group."""
    for folder in _MAP_FOLDERS:
        for path in _files(data / folder, RADIANCE_SUFFIXES):
            group = _groups(data).get(path.name, path.stem)
            if detail_split(group) == split:
                yield path, group


def _maps(data: Path, split: Split) -> Iterator[DetailPicture]:
    for path, group in radiance_files(data, split):
        light = read_radiance(path)
        light = light / max(float(np.median(light[1])), 1e-6 * float(light.max()))
        clipped = torch.from_numpy(np.minimum(light, _BRIGHTEST))
        yield DetailPicture(path.stem, group, "radiance", clipped)


def photograph_pictures(data: Path, split: Split) -> Iterator[DetailPicture]:
    """Photographs of a split, unprocessed to linear light, 1.0 at the photograph's white."""
    for path in _files(data / _PHOTOGRAPH_FOLDER, (".jpg", ".png")):
        group = _groups(data).get(path.name, path.stem)
        if detail_split(group) == split:
            rng = np.random.default_rng(zlib.crc32(path.stem.encode()))
            with Image.open(path) as picture:
                light = unprocess(np.asarray(picture.convert("RGB")), rng)
            yield DetailPicture(path.stem, group, "photograph", torch.from_numpy(light))


def recorded_mosaics(data: Path, split: Split) -> Iterator[DetailPicture]:
    """Raws of real sensors at low ISO, of a split."""
    for path in _files(data / "canon_crw_cc0", (".CRW",)):
        group, belongs = _RAWS.get(path.stem, (path.stem, detail_split(path.stem)))
        if belongs == split:
            raw = read_raw(path)
            yield DetailPicture(path.stem, group, "mosaic", raw.data, raw.noise)
    description = data / "gopro_raw" / "meta.json"
    if not description.is_file():
        return
    for name, meta in json.loads(description.read_text(encoding="utf-8")).items():
        group, belongs = _RAWS.get(name.partition("_")[0], (name, detail_split(name)))
        if belongs != split:
            continue
        with Image.open(description.parent / name) as picture:
            mosaic = np.asarray(picture).astype(np.float32)
        planes = np.stack([mosaic[i::2, j::2] for i, j in ((0, 0), (0, 1), (1, 0), (1, 1))])
        black = np.array(meta["black"], np.float32)[:, None, None]
        light = torch.from_numpy((planes - black) / (meta["white"] - black))
        slope, offset = (float(v) for v in meta["dng_tags"]["NoiseProfile"].strip("()").split(","))
        yield DetailPicture(
            name, group, "mosaic", light, NoiseLevelFunction((slope,) * 4, (offset,) * 4)
        )


def _linear(data: Path, split: Split) -> Iterator[DetailPicture]:
    """Demosaicked linear frames."""
    for path in _files(data / "intel_tau_small", (".png",)):
        if detail_split(path.stem) == split:
            import cv2

            image = np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
            light = image[:, :, ::-1].transpose(2, 0, 1).astype(np.float32) / 65535.0
            yield DetailPicture(
                path.stem, path.stem, "linear", torch.from_numpy(np.ascontiguousarray(light))
            )


def _files(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    files = sorted(p for p in folder.glob("*") if p.suffix in suffixes)
    if not files:
        logger.warning("no %s files in %s: they are left out", " or ".join(suffixes), folder)
    return files


@cache
def _groups(data: Path) -> dict[str, str]:
    """Source group by file name, where a table beside the files states it."""
    table = data / "MANIFEST_POOL.csv"
    if not table.is_file():
        return {}
    with table.open(newline="", encoding="utf-8") as stream:
        return {Path(r["file"]).name: r["group"] for r in csv.DictReader(stream) if r["group"]}


# -- drawn pictures -------------------------------------------------------------------------------


def _drawings(split: Split, number: int, seed: int) -> Iterator[DetailPicture]:
    for kind, draw in (("leaves", _leaves), ("chart", _chart), ("smooth", _smooth)):
        for index in range(number):
            name = f"{kind}-{seed}-{FIRST_INDEX[split] + index:06d}"
            rng = np.random.default_rng(
                [zlib.crc32(kind.encode()), seed, FIRST_INDEX[split], index]
            )
            yield DetailPicture(name, name, kind, torch.from_numpy(draw(rng)))


def _leaves(rng: np.random.Generator) -> np.ndarray:
    """Dead leaves down to less than a photosite: the sharpest edges that can be."""
    style = LeafStyle(
        smallest=float(np.exp(rng.uniform(np.log(0.7), np.log(4.0)))),
        contrast=float(rng.uniform(0.3, 1.1)),
        chroma=float(rng.uniform(0.1, 0.6)),
        texture=float(rng.uniform(0.0, 0.5)),
        palette=int(rng.integers(3, 30)),
    )
    return dead_leaves(rng, _SIZE, style)


def _chart(rng: np.random.Generator) -> np.ndarray:
    """Text, gratings, zone plates and checks in two colours."""
    paper, ink = (np.exp2(rng.uniform(-5.0, 0.0, (2, 1))) * rng.uniform(0.6, 1.0, (2, 3)))[
        :, :, None
    ]
    row, column = np.mgrid[:_SIZE, :_SIZE].astype(np.float32)
    kind = int(rng.integers(4))
    if kind == 0:
        mask = _text(rng)
    elif kind == 1:
        angle, period = rng.uniform(0, np.pi), np.exp(rng.uniform(np.log(2.0), np.log(40.0)))
        wave = np.sin((row * np.sin(angle) + column * np.cos(angle)) * 2 * np.pi / period)
        mask = (wave > 0).astype(np.float32) if rng.random() < 0.5 else 0.5 + 0.5 * wave
    elif kind == 2:
        centre = rng.uniform(-0.2, 1.2, 2) * _SIZE
        radius = np.hypot(row - centre[0], column - centre[1])
        mask = 0.5 + 0.5 * np.cos(np.pi * radius**2 / _SIZE * rng.uniform(0.3, 1.0))
    else:
        side = int(rng.integers(1, 48))
        mask = ((row // side + column // side) % 2).astype(np.float32)
    light = paper[..., None] * (1.0 - mask) + ink[..., None] * mask
    return np.ascontiguousarray(light, np.float32)


def _text(rng: np.random.Generator) -> np.ndarray:
    page = Image.new("L", (_SIZE, _SIZE))
    draw, top = ImageDraw.Draw(page), 0
    while top < _SIZE:
        size = int(rng.integers(7, 40))
        letters = "".join(chr(c) for c in rng.integers(33, 127, 90))
        words = letters.replace("~", " ").replace("|", " ")
        draw.text((int(rng.integers(-20, 5)), top), words, 255, ImageFont.load_default(size))
        top += size + int(rng.integers(1, 8))
    return np.asarray(page, np.float32) / 255.0


def _smooth(rng: np.random.Generator) -> np.ndarray:
    """Shading without detail: walls, skies, flat fields."""
    tint = np.exp2(rng.uniform(-0.8, 0.8, 3))[:, None, None]
    if rng.random() < 0.3:
        return np.ascontiguousarray(np.broadcast_to(tint, (3, _SIZE, _SIZE)), np.float32)
    shape = fractal_noise(rng, _SIZE, float(rng.uniform(1.8, 3.0)))
    return np.asarray(tint * np.exp(rng.uniform(0.02, 0.8) * shape), np.float32)
