"""Damaged maps and configurations: each is read, or refused with a ValueError."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from ae_env.scenes.radiance import read_radiance
from agents.learning.training import AgentConfig
from simulator.training.config import SimulatorConfig
from simulator.utils.config_file import load_yaml

INPUTS = 120


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """Cut off, or with up to four pieces lost or overwritten, most of them near the beginning."""
    data = bytearray(content)
    for _ in range(rng.integers(1, 5)):
        at = int(rng.integers(1 + len(data) if rng.random() < 0.3 else 1024))
        lost, new = rng.integers(65, size=2) // rng.choice([1, 64])  # a piece, or a byte
        data[at : at + lost] = rng.bytes(new)
    return bytes(data if rng.random() < 0.8 else data[: rng.integers(1 + len(data))])


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


def map_is_finite(path: Path) -> bool:
    return bool(np.isfinite(read_radiance(path)).all())


def config_is_one(path: Path) -> bool:
    try:
        load_yaml(path, AgentConfig)
    except ValueError:
        load_yaml(path, SimulatorConfig)
    return True


@pytest.mark.parametrize(
    ("make", "read"),
    [
        (radiance_maps, map_is_finite),
        (openexr_maps, map_is_finite),
        (configs, config_is_one),
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
