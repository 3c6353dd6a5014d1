"""Damaged radiance maps: each is read, or refused with a ValueError, so that it can be skipped."""

import numpy as np
import pytest

from simulator.radiance.maps import read_radiance


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """Cut off, or with up to four pieces lost or overwritten, most of them near the beginning."""
    data = bytearray(content)
    for _ in range(rng.integers(1, 5)):
        at = int(rng.integers(1 + len(data) if rng.random() < 0.3 else 1024))
        lost, new = rng.integers(65, size=2) // rng.choice([1, 64])  # a piece, or a byte
        data[at : at + lost] = rng.bytes(new)
    return bytes(data if rng.random() < 0.8 else data[: rng.integers(1 + len(data))])


@pytest.mark.filterwarnings("ignore")  # libraries may warn of a file; the program must not stop
def test_damaged_maps(tmp_path):
    openexr = pytest.importorskip("OpenEXR")
    rng, refused = np.random.default_rng(0), 0
    pixels = rng.integers(100, 140, (16, 32, 4), dtype=np.uint8)
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 16 +X 32\n"
    (tmp_path / "map.hdr").write_bytes(head + pixels.tobytes())
    channels = {name: rng.random((16, 32), np.float32) for name in "RGB"}
    for kind in (openexr.NO_COMPRESSION, openexr.ZIP_COMPRESSION, openexr.PIZ_COMPRESSION):
        header = {"compression": kind, "type": openexr.scanlineimage}
        openexr.File(header, channels).write(str(tmp_path / f"{kind}.exr"))
    originals = sorted(tmp_path.iterdir())
    for number in range(120):
        original = originals[number % len(originals)]
        path = original.with_stem("damaged")
        path.write_bytes(damaged(original.read_bytes(), np.random.default_rng([7, number])))
        try:
            assert np.isfinite(read_radiance(path)).all()
        except ValueError:
            refused += 1
    assert 30 < refused < 120
