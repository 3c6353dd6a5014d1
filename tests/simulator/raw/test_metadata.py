import io
import os
import struct
import tracemalloc

import numpy as np
import pytest
import tifffile

from simulator.raw.metadata import camera_identity, is_raw_container, read_directories
from tests.simulator.raw.test_read import CODE, write_sample_dng


def tiff(entries: list[tuple[int, int, int, int]], following: int = 0, magic: int = 42) -> bytes:
    """A directory at 8 of (tag, type, count, value) entries."""
    head = struct.pack("<2sHIH", b"II", magic, 8, len(entries))
    body = b"".join(struct.pack("<HHII", *entry) for entry in entries)
    return head + body + struct.pack("<I", following)


@pytest.mark.parametrize("byteorder", ["<", ">"])
def test_sub_directories_and_both_byte_orders(tmp_path, byteorder):
    model = (CODE["Model"], "s", 0, "Sensor", True)
    white, path = (CODE["WhiteLevel"], "I", 1, 4095, True), tmp_path / "a.tif"
    options = {"photometric": "minisblack", "metadata": None, "software": False}
    with tifffile.TiffWriter(path, byteorder=byteorder) as writer:
        writer.write(np.zeros((2, 2), np.uint8), subifds=1, extratags=[model], **options)
        writer.write(np.zeros((4, 6), np.uint16), extratags=[white], **options)
    with path.open("rb") as stream:
        first, second = read_directories(stream)
        assert camera_identity(stream, [first, second]) == ("", "Sensor")
    assert (first["ImageWidth"], second["ImageWidth"]) == ((2,), (6,))
    assert (second["WhiteLevel"], second["BitsPerSample"]) == ((4095,), (16,))


@pytest.mark.parametrize("magic", [42, 0x4F52, 0x5352, 0x55])
def test_makers_with_a_magic_of_their_own(magic):
    content = tiff([(CODE["Model"], 2, 4, int.from_bytes(b"X-1\0", "little"))], magic=magic)
    assert read_directories(io.BytesIO(content)) == [{"Model": ("X-1",)}]
    assert read_directories(io.BytesIO(b"II\0\0" + content[4:])) == []


def test_identities_of_other_containers(tmp_path):
    dng = write_sample_dng(tmp_path / "a.dng").read_bytes()
    raf = b"FUJIFILMCCD-RAW 0201FF159501" + b"X-T1".ljust(32, b"\0") + bytes(99)
    mrw = b"\0MRM" + bytes(4) + b"\0PRD" + bytes(28) + b"\0TTW" + bytes(4) + dng
    cr3 = struct.pack(">I", 24) + b"ftypcrx " + bytes(12) + struct.pack(">I", 9) + b"CMT1" + dng
    names = b"Canon\0PowerShot\0"  # one record follows, then where it is
    record = struct.pack("<HHIII", 1, 0x080A, len(names), 0, len(names))
    ciff = struct.pack("<2sI8s", b"II", 14, b"HEAPCCDR") + names + record
    known = {raf: ("FUJIFILM", "X-T1"), mrw: ("Test", "Sensor"), cr3: ("Test", "Sensor")}
    known |= {ciff: ("Canon", "PowerShot"), b"": ("", ""), bytes(99): ("", "")}
    for content, identity in known.items():
        assert camera_identity(io.BytesIO(content), []) == identity
    kinds = {
        raf: True,
        mrw: True,
        cr3: True,
        b"FOVb": True,
        ciff: False,
        b"text": False,
        b"": False,
    }
    for content, is_raw in kinds.items():  # a whole Canon CRW names its camera
        assert is_raw_container(io.BytesIO(content)) is is_raw


@pytest.mark.parametrize("count", [2**32 - 1, 2**30, 2**18])
@pytest.mark.parametrize("kind", [1, 3, 4, 12])
def test_tags_of_any_size_are_read_in_bounded_memory(tmp_path, count, kind):
    """Every tag there is claims `count` values, in a file that is long enough for them."""
    codes = sorted({*range(254, 345), *tifffile.TIFF.TAG_READERS, *range(50706, 50830), 34665})
    path = tmp_path / "a.dng"
    path.write_bytes(tiff([(code, kind, count, 4096) for code in codes]))
    os.truncate(path, 5 * 2**30)
    tracemalloc.start()
    with path.open("rb") as stream:
        read_directories(stream)
    assert tracemalloc.get_traced_memory()[1] < 64 * 2**20
    tracemalloc.stop()


def test_structures_that_never_end_are_left():
    # A directory that is its own sub-directory, EXIF directory and successor.
    loop = [(CODE[name], 4, 1, 8) for name in ("SubIFDs", "ExifTag")]
    assert read_directories(io.BytesIO(tiff(loop, following=8))) == []
    # A chain of very many directories.
    entry = struct.pack("<HHII", CODE["Make"], 2, 4, 0x00414141)
    chain = (struct.pack("<H", 1) + entry + struct.pack("<I", 26 + 18 * i) for i in range(10**5))
    assert len(read_directories(io.BytesIO(tiff([])[:8] + b"".join(chain)))) <= 64
    # A Canon heap of 64 records, each of which is the heap itself.
    heap = struct.pack("<H", 64) + 64 * struct.pack("<HII", 0x2800, 2 + 64 * 10 + 4, 0)
    content = struct.pack("<2sI8s", b"II", 14, b"HEAPCCDR") + heap + struct.pack("<I", 0)
    assert camera_identity(io.BytesIO(content), []) == ("", "")


def test_one_damaged_tag_costs_no_other():
    no_such_type, beyond_the_end = (CODE["Make"], 99, 1, 0), (CODE["StripOffsets"], 4, 7, 2**31)
    entries = [no_such_type, beyond_the_end, (CODE["WhiteLevel"], 4, 1, 4095)]
    assert read_directories(io.BytesIO(tiff(entries))) == [{"WhiteLevel": (4095,)}]
