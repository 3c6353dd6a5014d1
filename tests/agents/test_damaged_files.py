"""Damaged maps and configurations: each is read, or refused with a ValueError."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from agents.learning.training import AgentConfig
from simulator.radiance.maps import read_radiance
from simulator.training.trainer import SimulatorConfig
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


def refused(originals: Sequence[Path], read: Callable[[Path], object]) -> int:
    """How many of 120 damaged files raise a `ValueError`; any other error is a fault."""
    read_ones = 0
    for number in range(INPUTS):
        original = originals[number % len(originals)]
        path = original.with_stem("damaged")
        path.write_bytes(damaged(original.read_bytes(), np.random.default_rng([7, number])))
        with suppress(ValueError):
            read(path)
            read_ones += 1
    return INPUTS - read_ones


@pytest.mark.filterwarnings("ignore")  # libraries may warn of a file; the program must not stop
def test_damaged_maps(tmp_path: Path) -> None:
    openexr = pytest.importorskip("OpenEXR")
    rng = np.random.default_rng(0)
    pixels = rng.integers(100, 140, (16, 32, 4), dtype=np.uint8)
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 16 +X 32\n"
    (tmp_path / "map.hdr").write_bytes(head + pixels.tobytes())
    channels = {name: rng.random((16, 32), np.float32) for name in "RGB"}
    for kind in (openexr.NO_COMPRESSION, openexr.ZIP_COMPRESSION, openexr.PIZ_COMPRESSION):
        header = {"compression": kind, "type": openexr.scanlineimage}
        openexr.File(header, channels).write(str(tmp_path / f"{kind}.exr"))

    def read(path: Path) -> None:
        assert np.isfinite(read_radiance(path)).all()

    assert INPUTS / 4 < refused(sorted(tmp_path.iterdir()), read) < INPUTS


def test_damaged_configurations(tmp_path: Path) -> None:
    for file in (Path(__file__).parents[2] / "configs").glob("*.yaml"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    files = sorted(tmp_path.iterdir())
    assert refused(files, lambda path: load_yaml(path, AgentConfig)) > INPUTS / 4
    assert refused(files, lambda path: load_yaml(path, SimulatorConfig)) > INPUTS / 4
