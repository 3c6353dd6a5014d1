"""Damaged files of every kind: each is read as it was written, or refused with a ValueError."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from ae_env.scenes.radiance import read_radiance
from agents.learning.training import AgentConfig
from simulator import CameraSettings, RawImage, get_camera, read_raw, write_dng
from simulator.training.config import SimulatorConfig
from simulator.utils.cache import DiskCache
from simulator.utils.config_file import load_yaml

INPUTS, KEY = 120, "0" * 24
TENSORS = {"light": torch.rand(4, 16, 16, generator=torch.Generator().manual_seed(0))}


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """`content` after one to four accidents: cut off, bits flipped, pieces lost or overwritten.

    Most of them near the beginning, where the structure of a file is.
    """
    data = bytearray(content)
    for _ in range(rng.integers(1, 5)):
        reach = max(1, len(data) if rng.random() < 0.3 else min(len(data), 1024))
        at, size = int(rng.integers(reach)), int(rng.integers(1, 65))
        accident = int(rng.integers(5))
        if accident == 0:
            del data[at:]
        elif accident == 1 and data:
            data[at] ^= 1 << int(rng.integers(8))
        elif accident == 2:
            del data[at : at + size]
        elif accident == 3:
            data[at:at] = rng.bytes(size)
        else:
            data[at : at + size] = bytes([int(rng.choice([0, 0x7F, 0xFF]))]) * size
    return bytes(data)


def dngs(folder: Path) -> Iterator[Path]:
    data = torch.rand(4, 24, 32, generator=torch.Generator().manual_seed(0))
    raw = RawImage(data, CameraSettings(400.0, 1 / 60, 4.0), camera=get_camera("nikon_z6"))
    own, foreign = folder / "own.dng", folder / "foreign.dng"
    write_dng(own, raw)
    # Without our name in it LibRaw reads it, as any other maker's.
    foreign.write_bytes(own.read_bytes().replace(b"ae-env ", b"others ", 1))
    yield from (own, foreign)


def radiance_maps(folder: Path) -> Iterator[Path]:
    pixels = np.random.default_rng(0).integers(100, 140, (16, 32, 4), dtype=np.uint8)
    path = folder / "map.hdr"
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 16 +X 32\n"
    path.write_bytes(head + pixels.tobytes())
    yield path


def openexr_maps(folder: Path) -> Iterator[Path]:
    openexr = pytest.importorskip("OpenEXR")
    rng = np.random.default_rng(0)
    channels = {name: rng.random((16, 32), np.float32) for name in "RGB"}
    for name in ("NO", "ZIP", "PIZ"):
        path = folder / f"map_{name}.exr"
        header = {"compression": getattr(openexr, f"{name}_COMPRESSION")}
        openexr.File(header | {"type": openexr.scanlineimage}, channels).write(str(path))
        yield path


def configs(folder: Path) -> Iterator[Path]:
    yield from sorted((Path(__file__).parents[2] / "configs").glob("*.yaml"))


def cache_entries(folder: Path) -> Iterator[Path]:
    cache = DiskCache(folder / "cache")
    cache.put("denoised", KEY, TENSORS)
    yield cache.path("denoised", KEY)


def raw_is_finite(path: Path) -> bool:
    return bool(torch.isfinite(read_raw(path).data).all())


def map_is_finite(path: Path) -> bool:
    return bool(np.isfinite(read_radiance(path)).all())


def config_is_one(path: Path) -> bool:
    try:
        load_yaml(path, AgentConfig)
    except ValueError:
        load_yaml(path, SimulatorConfig)
    return True


def entry_is_as_written(path: Path) -> bool:
    cache = DiskCache(path.parent / "damaged")
    target = cache.path("denoised", KEY)
    target.parent.mkdir(parents=True, exist_ok=True)
    path.replace(target)
    found = cache.get("denoised", KEY)
    if found is None:
        raise ValueError("as if it were not there")
    return found.keys() == TENSORS.keys() and torch.equal(found["light"], TENSORS["light"])


@pytest.mark.parametrize(
    ("make", "read"),
    [
        (dngs, raw_is_finite),
        (radiance_maps, map_is_finite),
        (openexr_maps, map_is_finite),
        (configs, config_is_one),
        (cache_entries, entry_is_as_written),
    ],
)
@pytest.mark.filterwarnings("ignore")  # libraries may warn of a file; the program must not stop
def test_damaged_files_are_read_or_refused(
    make: Callable[[Path], Iterator[Path]], read: Callable[[Path], bool], tmp_path: Path
) -> None:
    originals = [(path.suffix, path.read_bytes()) for path in make(tmp_path)]
    refused = 0
    for number in range(INPUTS):
        suffix, content = originals[number % len(originals)]
        path = tmp_path / f"damaged{suffix}"
        path.write_bytes(damaged(content, np.random.default_rng([7, number])))
        try:
            assert read(path), f"input {number} is read as something else"
        except ValueError:  # any other error is a fault
            refused += 1
    assert refused > INPUTS / 4  # the damage is no illusion
