"""Files that are damaged, lie or cannot be written: refused in words, or read as documented."""

from __future__ import annotations

import errno
import os
import struct
import subprocess
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from skimage.io import imsave

from benchmarks.stability import fuzz
from simulator import RawImage, get_camera, read_raw, write_dng
from simulator.raw import dng as dng_module
from simulator.raw import read as raw_file_module
from simulator.raw.metadata import camera_identity, read_directories
from simulator.raw.decoding import RawFileError
from simulator.utils.files import write_atomically
from tests.simulator.raw.test_read import NLF, SETTINGS, write_sample_dng

MOSAIC = np.random.default_rng(0).integers(100, 4000, (64, 96), dtype=np.uint16)


@pytest.fixture
def own_dng(tmp_path: Path) -> Path:
    """A DNG of `write_dng`: black 1008, white 15520, 1/60 s."""
    path = tmp_path / "own.dng"
    write_dng(path, RawImage.from_mosaic(MOSAIC, SETTINGS, get_camera("nikon_z6"), nlf=NLF))
    return path


def fields(content: bytes | bytearray) -> Iterator[tuple[int, int, int, int]]:
    """Tag, type, place of the entry, place of the value (TIFF 6.0); the EXIF directory's, too."""
    pending = [struct.unpack_from("<I", content, 4)[0]]
    for offset in pending:
        for i in range(struct.unpack_from("<H", content, offset)[0]):
            at = offset + 2 + 12 * i
            tag, kind, count, value = struct.unpack_from("<HHII", content, at)
            size = count * {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 7: 1, 10: 8, 12: 8}[kind]
            yield tag, kind, at, at + 8 if size <= 4 else value
            if tag == 34665:
                pending.append(value)


def patch(path: Path, tag: int, form: str, *values: Any) -> None:
    """Overwrites a tag's value; with the form ``count``, how many values it claims to have."""
    content = bytearray(path.read_bytes())
    (entry, place), *_ = ((at, v) for t, _, at, v in fields(content) if t == tag)
    if form == "count":
        struct.pack_into("<I", content, entry + 4, *values)
    else:
        struct.pack_into(f"<{form}", content, place, *values)
    path.write_bytes(content)


@pytest.mark.parametrize("write", ["own", "other"])
def test_a_dng_cut_anywhere_is_refused(own_dng: Path, tmp_path: Path, write: str) -> None:
    path = own_dng
    if write == "other":
        path = tmp_path / "other.dng"
        write_sample_dng(path, MOSAIC)
    for size in range(path.stat().st_size - 1, -1, -256):
        os.truncate(path, size)
        with pytest.raises(RawFileError, match=rf"`path` \(='{path.name}'"):
            read_raw(path, settings=SETTINGS, nlf=NLF)


@pytest.mark.real_data
def test_a_crw_cut_at_every_kilobyte_says_so(data_dir: Path, tmp_path: Path) -> None:
    path = tmp_path / "cut.crw"
    path.write_bytes((data_dir / "canon_crw_cc0" / "CRW_0101.CRW").read_bytes())
    for kilobytes in range(path.stat().st_size // 1024, 0, -1):
        os.truncate(path, 1024 * kilobytes)
        with pytest.raises(RawFileError, match=r"`path` \(='cut.crw'\).*truncated"):
            read_raw(path)


@pytest.mark.parametrize("path", [None, 3, b"x", ["a.dng"]])
def test_what_is_no_name_of_a_file(path: Any, own_dng: Path) -> None:
    with pytest.raises(ValueError, match=r"`path` .* must be a file's name"):
        read_raw(path)
    with pytest.raises(ValueError, match=r"`path` .* must be a file's name"):
        write_dng(path, read_raw(own_dng))


def test_wrong_endings_and_empty_files(tmp_path: Path) -> None:
    path = tmp_path / "a.dng"
    imsave(tmp_path / "a.png", np.zeros((8, 8), np.uint8), check_contrast=False)
    imsave(tmp_path / "a.jpg", np.zeros((8, 8), np.uint8), check_contrast=False)
    cases = [
        ((tmp_path / "a.png").read_bytes(), "a PNG file"),
        ((tmp_path / "a.jpg").read_bytes(), "a JPEG file"),
        (b"words\n", "a text file"),
        (b"", "an empty file"),
        (b"II*\0", "a TIFF-structured file"),
    ]
    for content, words in cases:
        path.write_bytes(content)
        with pytest.raises(RawFileError, match=words):
            read_raw(path)
    with pytest.raises(FileNotFoundError, match="no ordinary file"):
        read_raw(os.devnull)


def test_files_that_may_not_be_read_or_shrink(
    own_dng: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = raw_file_module.read_directories

    def shrinking(data: Any) -> Any:
        directories = real(data)
        os.truncate(own_dng, 2000)
        return directories

    with monkeypatch.context() as patched:
        patched.setattr(raw_file_module, "read_directories", shrinking)
        with pytest.raises(RawFileError, match=r"cannot be read: .*became shorter"):
            read_raw(own_dng)

    def forbidden(*_: Any) -> Any:
        raise PermissionError(errno.EACCES, "Permission denied", str(own_dng))

    monkeypatch.setattr(Path, "open", forbidden)
    with pytest.raises(RawFileError, match=r"cannot be read: .*Permission denied"):
        read_raw(own_dng)


@pytest.mark.parametrize("white", [0, 65536, 2**32 - 1])
def test_a_white_level_that_cannot_be_is_the_largest_number(
    own_dng: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, white: int
) -> None:
    other = tmp_path / "other.dng"
    write_sample_dng(other, MOSAIC, white=white)
    patch(own_dng, 50717, "I", white)
    for path, black in ((other, 64), (own_dng, 1008)):
        caplog.clear()
        raw = read_raw(path, settings=SETTINGS, nlf=NLF)
        assert raw.camera.white_level == 65535
        expected = (MOSAIC[0, 0] - float(black)) / (65535 - black)
        assert float(raw.data[0, 0, 0]) == pytest.approx(expected, rel=1e-6)
        assert f"{path.name}: its white level (={white}) must be in [1, 65535]" in caplog.text


def test_levels_that_contradict_each_other(
    own_dng: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    other = tmp_path / "other.dng"
    for white in (1, 63, 64):
        write_sample_dng(other, MOSAIC, white=white)
        patch(own_dng, 50717, "I", white)
        for path in (other, own_dng):
            with pytest.raises(
                RawFileError, match=f"above its black levels, but says white {white}"
            ):
                read_raw(path, settings=SETTINGS, nlf=NLF)
    write_sample_dng(other, MOSAIC, white=1000)
    assert not caplog.records
    raw = read_raw(other, settings=SETTINGS, nlf=NLF)
    times = (MOSAIC.max() - 64.0) / (1000 - 64)
    assert float(raw.data.max()) == pytest.approx(times, rel=1e-6)
    assert f"reach {times:.3g} times white" in caplog.text


@pytest.mark.parametrize(
    "profile", [(np.nan, 0.0), (np.inf, 0.0), (1e300, 0.0), (-1.0, 0.0), (1e-4, -1e300)]
)
def test_a_noise_profile_that_is_none(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, profile: tuple[float, float]
) -> None:
    write_sample_dng(tmp_path / "a.dng", MOSAIC, noise_profile=profile)
    raw = read_raw(tmp_path / "a.dng", settings=SETTINGS)
    assert raw.metadata["nlf_source"] == "blind estimate"
    assert "NoiseProfile" in caplog.text
    assert 0 <= max(raw.noise.shot) < 1


@pytest.mark.parametrize(
    ("tag", "form", "values", "changed"),
    [
        (50728, "6I", (0,) * 6, ("white_balance", (1.0, 1.0, 1.0))),  # 0 / 0
        (50728, "6I", (0, 1, 0, 1, 0, 1), ("white_balance", (1.0, 1.0, 1.0))),
        (50728, "count", (0,), ("white_balance", (1.0, 1.0, 1.0))),
        (33434, "2I", (0, 0), ("settings", SETTINGS)),
        (33434, "2I", (1, 0), ("settings", SETTINGS)),
        (33434, "2I", (0, 1), ("settings", SETTINGS)),
        (33437, "count", (0,), ("settings", SETTINGS)),
        (34866, "I", (0,), ("settings", SETTINGS)),
        (274, "H", (99,), ("flip", 0)),
        (274, "count", (0,), ("flip", 0)),
        (36867, "19s", (b"9999:99:99 99:99:99",), ("datetime", None)),
        (37386, "2I", (5, 0), ("focal_length", None)),
    ],
)  # fmt: skip
def test_what_an_own_dng_lost_falls_back(
    own_dng: Path, tag: int, form: str, values: tuple[Any, ...], changed: tuple[str, Any]
) -> None:
    patch(own_dng, tag, form, *values)
    raw = read_raw(own_dng)
    name, value = changed
    found = getattr(raw, name) if hasattr(raw, name) else raw.metadata.get(name)
    assert found == value
    np.testing.assert_array_equal(raw.to_mosaic(), MOSAIC)


@pytest.mark.parametrize(
    ("tag", "form", "values", "words"),
    [
        (256, "I", (0,), "64 x 0 pixels"),
        (257, "I", (0,), "0 x 96 pixels"),
        (273, "count", (2**28,), "at no place"),
        (273, "I", (2**32 - 1,), "truncated"),
        (279, "I", (2**32 - 1,), "truncated"),
        (33422, "4B", (9, 1, 1, 2), r"CFAPattern is \(9, 1, 1, 2\)"),
        (33422, "4B", (0, 0, 0, 0), "CFAPattern"),
        (50714, "I", (70_000,), "white level above its black levels"),
    ],
)
def test_what_an_own_dng_cannot_do_without(
    own_dng: Path, tag: int, form: str, values: tuple[Any, ...], words: str
) -> None:
    patch(own_dng, tag, form, *values)
    with pytest.raises(RawFileError, match=words):
        read_raw(own_dng)


@pytest.mark.parametrize(
    ("side", "words"),
    [
        (60_000, "at most 268435456 are read"),
        (20_000, "at most 268435456 are read"),  # LibRaw would try
        (8_000, "at most 1024 a byte are read"),
    ],
)
def test_bombs_are_refused_before_they_are_decoded(
    own_dng: Path, tmp_path: Path, side: int, words: str
) -> None:
    other = tmp_path / "other.dng"
    write_sample_dng(other, MOSAIC)
    for path in (other, own_dng):
        content = bytearray(path.read_bytes())
        for tag, _, at, _ in list(fields(content)):
            if tag in (256, 257):
                struct.pack_into("<HII", content, at + 2, 4, 1, side)
        path.write_bytes(content)
        with pytest.raises(RawFileError, match=f"claims {side} x {side} pixels.*{words}"):
            read_raw(path, settings=SETTINGS, nlf=NLF)


def test_a_table_of_very_many_strips_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, mosaic = tmp_path / "a.dng", np.full((17_000, 64), 1000, np.uint16)
    monkeypatch.setattr(tifffile, "imwrite", partial(tifffile.imwrite, rowsperstrip=1))
    write_sample_dng(path, mosaic)
    (tags,) = read_directories(path.read_bytes())
    assert len(tags[273]) == len(tags[279]) == 17_000
    raw = read_raw(path, settings=SETTINGS, nlf=NLF)
    np.testing.assert_array_equal(raw.to_mosaic(), mosaic)
    os.truncate(path, path.stat().st_size - 1)
    with pytest.raises(RawFileError, match="names 1 bytes beyond its end"):
        read_raw(path, settings=SETTINGS, nlf=NLF)


def test_structures_that_never_end_are_left() -> None:
    start = time.perf_counter()
    # A directory of 4096 fields, each of a value of 2**18 bytes that overlap, which is its own
    # sub-directory and successor.
    head = struct.pack("<2sHIH", b"II", 42, 8, 4096)
    entries = b"".join(struct.pack("<HHII", i, 1, 2**18, 8) for i in range(1, 4096))
    loop = struct.pack("<HHII", 34665, 4, 1, 8) + struct.pack("<I", 8)
    found = read_directories(head + entries + loop + bytes(2**18))
    assert len(found) == 1
    assert sum(len(value) for value in found[0].values()) <= 2**22
    # A Canon heap of 64 records, each of which is the heap itself.
    heap = struct.pack("<H", 64) + 64 * struct.pack("<HII", 0x2800, 2 + 64 * 10 + 4, 0)
    content = struct.pack("<2sI8s", b"II", 14, b"HEAPCCDR") + heap + struct.pack("<I", 0)
    assert camera_identity(content, []) == ("", "")
    assert time.perf_counter() - start < 5.0


@pytest.mark.parametrize("kind", [k for k in fuzz.KINDS if k != "real raw"])
def test_damaged_files_are_read_or_refused(kind: str) -> None:
    for extra in {"Radiance map": ["cv2"], "OpenEXR map": ["OpenEXR"]}.get(kind, []):
        pytest.importorskip(extra)
    found = fuzz.run_batch(kind, 0, 100, seed=5)
    assert found["faults"] == []
    assert found["refused"] > 20
    assert found["read"] == 100 - found["refused"]


def test_what_the_fuzzing_counts_as_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    make, _ = fuzz.KINDS["cache entry"]
    with monkeypatch.context() as patched:
        patched.setattr(fuzz, "damaged", lambda content, _: content)
        found = fuzz.run_batch("cache entry", 0, 3, seed=0)
        assert found == {"read": 3, "refused": 0, "faults": []}
        patched.setitem(fuzz.KINDS, "cache entry", (make, lambda _: False))
        found = fuzz.run_batch("cache entry", 0, 3, seed=0)
        assert found["faults"][2] == "input 2: read as what it does not hold"

    def late(*_: Any, timeout: float, **__: Any) -> Any:
        raise subprocess.TimeoutExpired("python", timeout)

    monkeypatch.setattr(fuzz, "isolated", late)
    monkeypatch.setattr(fuzz, "KINDS", {"DNG": fuzz.KINDS["DNG"]})
    (row,) = fuzz.rows(0, quick=True)
    assert (row.max_error, row.ok) == (1.0, False)
    assert "took more than 600 s" in row.note
    nothing = {"read": 0, "refused": 0, "faults": []}
    monkeypatch.setattr(fuzz, "isolated", lambda *_, **__: nothing)
    assert list(fuzz.rows(0, quick=True)) == []  # no real files: no row


def full_disk(*_: Any) -> Iterator[bytes]:
    yield b"half of it"
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_full_disk_leaves_nothing_and_keeps_the_old(
    tmp_path: Path, own_dng: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    raw, before = read_raw(own_dng), own_dng.read_bytes()
    monkeypatch.setattr(dng_module, "_strip", full_disk)
    for path in (own_dng, tmp_path / "new" / "b.dng"):
        with pytest.raises(OSError, match="cannot be written: No space left") as caught:
            write_dng(path, raw)
        assert caught.value.errno == errno.ENOSPC
        assert str(path) in str(caught.value)
    assert own_dng.read_bytes() == before
    assert [p.name for p in tmp_path.rglob("*") if p.is_file()] == ["own.dng"]


def test_targets_that_cannot_be_written(tmp_path: Path, own_dng: Path) -> None:
    targets = [own_dng / "under a file.dng", tmp_path / ("x" * 300 + ".dng")]
    targets += [Path("/proc/x.dng")] if Path("/proc/version").exists() else []
    for target in targets:
        with pytest.raises(OSError, match=r"`path` .* cannot be written: ") as caught:
            write_dng(target, read_raw(own_dng))
        assert str(target) in str(caught.value)
        assert ".tmp" not in str(caught.value)
    for name in ("y" * 246 + ".dng", "\u5b57" * 84 + ".d"):  # as long as a name may be
        assert write_atomically(tmp_path / name, b"1").read_bytes() == b"1"
