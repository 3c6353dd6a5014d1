"""Both layouts of the paper's dataset, on files made as the authors' preprocessing makes them."""

import csv
import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from simulator import CameraSettings, RawImage, get_camera
from simulator.raw.dataset import (
    packed_camera,
    read_dataset,
    read_sequence,
    write_packed_sequence,
    write_raw_sequence,
)
from simulator.reference.camera import ReferenceCamera, ReferenceScene

SETTINGS = (
    CameraSettings(100, 1 / 64, 8),
    CameraSettings(1600, 1 / 512, 5.6),
    CameraSettings(400, 2 ** (-5 / 3), 22),
)
#: NoiseProfile of a Nikon Z6 raw at ISO 800, as exiftool prints it: (shot, read) of R, G, B.
PROFILE = "6.4e-05 2.3e-08 6.1e-05 2.2e-08 5.7e-05 1.9e-08"
WRITERS = pytest.mark.parametrize("write", [write_raw_sequence, write_packed_sequence])
NIKON = ("path", "time", "iso", "aperture", "wb", "noiseprofile")
CANON = ("path", "time", "iso", "aperture", "noiseprofile")


@functools.cache
def captures(camera_name: str) -> list[RawImage]:
    camera = packed_camera(camera_name)
    light = torch.linspace(0.02, 0.3, 64).reshape(4, 4, 4)
    scene, body = ReferenceScene("s", "g", "k", light, SETTINGS[0]), ReferenceCamera(camera)
    options = {"camera": camera, "white_balance": (2.0, 1.0, 1.5)}
    return [RawImage(body.capture(scene, s, seed=1).sample, s, **options) for s in SETTINGS]


def assert_same(back: Sequence[RawImage], raws: Sequence[RawImage]) -> None:
    for one, other in zip(back, raws, strict=True):
        torch.testing.assert_close(one.data, other.data, rtol=0, atol=1e-7)
        np.testing.assert_array_equal(one.to_mosaic(), other.to_mosaic())
        assert one.settings == other.settings
        for name in ("name", "black_level", "white_level"):
            assert getattr(one.camera, name) == getattr(other.camera, name)
        assert one.noise.shot[1] == pytest.approx(sum(other.noise.shot[1:3]) / 2)
        assert one.noise.read[0] == pytest.approx(other.noise.read[0])


@WRITERS
@pytest.mark.parametrize("camera", ["nikon_z6", "canon_70d"])
def test_captures_of_the_reference_camera_come_back(tmp_path, write, camera):
    raws, folder = captures(camera), tmp_path / "scene_007"
    write(folder, raws)
    sequence = read_sequence(folder)
    assert sequence.name == "scene_007"
    assert_same(list(sequence.captures), raws)
    if write is write_packed_sequence:
        header = (folder / "camera_params.csv").read_text().splitlines()[0]
        assert header == ",".join(NIKON if camera == "nikon_z6" else CANON)
    if (write, camera) != (write_packed_sequence, "canon_70d"):  # its table has no white balance
        assert sequence.captures[0].white_balance == pytest.approx((2.0, 1.0, 1.5))
    next(folder.glob("capture_001.*")).unlink()  # captures are read when they are asked for
    assert sequence.captures[-1].settings == SETTINGS[2]
    assert [c.settings for c in sequence.captures[::2]] == [SETTINGS[0], SETTINGS[2]]
    with pytest.raises(FileNotFoundError):
        sequence.captures[1]
    with pytest.raises(IndexError):
        sequence.captures[3]


def author_file(path: Path, mosaic: np.ndarray, black: float, white: float) -> None:
    """Subtract black, divide, pack top-left, top-right, bottom-right, bottom-left, save."""
    bayer = (mosaic.astype(np.float32) - black) / (white - black)
    tile = [bayer[row::2, column::2] for row, column in ((0, 0), (0, 1), (1, 1), (1, 0))]
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, np.array(tile, np.float32))


def author_table(path: Path, header: Sequence[str], *rows: Sequence[Any]) -> None:
    with path.open("w", newline="") as stream:
        csv.writer(stream).writerows([header, *rows])


def nikon_row(path: str, **changes: Any) -> list[Any]:
    values = (path, 0.008, 800, 5.6, [1.9, 1.0, 1.4, 0.0], PROFILE)
    return [*(dict(zip(NIKON, values, strict=True)) | changes).values()]


@pytest.fixture
def nikon(tmp_path: Path) -> tuple[Path, dict[str, np.ndarray]]:
    """Two sequences with one table above them, paths beginning where the script ran."""
    rng, root, mosaics = np.random.default_rng(0), tmp_path / "Nikon", {}
    for name in ("scene_001/DSC_0001", "scene_001/DSC_0002", "scene_002/DSC_0001"):
        mosaics[name] = rng.integers(1008, 15520, (6, 10))
        mosaics[name][0, :2] = 900, 16383  # what the preprocessing does not clip
        author_file(root / f"{name}.npy", mosaics[name], 1008, 15520)
    rows = (nikon_row(f"./ProcessedData/Nikon/{name}.jpg") for name in mosaics)
    author_table(root / "camera_params.csv", NIKON, *rows)
    return root, mosaics


def test_the_authors_nikon_files(nikon):
    root, mosaics = nikon
    sequences = read_dataset(root)
    assert [(s.name, len(s.captures)) for s in sequences] == [("scene_001", 2), ("scene_002", 1)]
    raw = sequences[0].captures[1]
    # Red at the top left: R, G1 beside it, G2 below it, B across.
    expected = (mosaics["scene_001/DSC_0002"] - 1008.0) / (15520 - 1008)
    tiles = [expected[row::2, column::2] for row in (0, 1) for column in (0, 1)]
    np.testing.assert_allclose(raw.data, tiles, atol=7e-7)
    assert raw.settings == CameraSettings(800, 1 / 128, 5.6)  # 1/125 s stands for 1/128
    assert (raw.camera.name, raw.white_balance) == ("nikon_z6", (1.9, 1.0, 1.4))
    # Planes R, G1, G2, B from pairs of R, G, B.
    assert raw.noise.shot == (6.4e-5, 6.1e-5, 6.1e-5, 5.7e-5)
    assert raw.noise.read == (2.3e-8, 2.2e-8, 2.2e-8, 1.9e-8)
    assert (raw.box_factor, raw.metadata["nlf_source"]) == (1, "camera_params.csv")
    alone = read_sequence(root / "scene_002").captures[0]
    expected = np.minimum(mosaics["scene_002/DSC_0001"], 15520)
    np.testing.assert_array_equal(alone.to_mosaic(), expected)


def test_the_authors_canon_files(tmp_path):
    mosaic = np.random.default_rng(1).integers(2000, 16000, (4, 8))
    author_file(tmp_path / "s1" / "IMG_1.npy", mosaic, 2048, 15000)
    path = "D:\\data\\Canon\\s1\\IMG_1.jpg"
    author_table(tmp_path / "camera_params.csv", CANON, [path, 4, 3200, 22.0, "2e-4 3e-7"])
    # The table for developing: white balance as AsShotNeutral, and cells beyond csv's limit.
    long = " ".join(["0.125"] * 30_000)
    assert len(long) > csv.field_size_limit()
    header = ("path", "AnalogBalance", "AsShotNeutral", "ProfileLookTableData")
    author_table(tmp_path / "camera_isp_params.csv", header, (path, "1 1 1", "0.5 1 0.625", long))
    raw = read_sequence(tmp_path / "s1").captures[0]
    known = raw.camera.name, raw.camera.white_level, raw.camera.black_level
    assert known == ("canon_70d", 15000, (2048.0,) * 4)
    np.testing.assert_array_equal(raw.to_mosaic(), np.minimum(mosaic, 15000))
    assert raw.settings == CameraSettings(3200, 4, 22)
    assert (raw.noise.shot, raw.noise.read) == ((2e-4,) * 4, (3e-7,) * 4)
    assert raw.white_balance == pytest.approx((2.0, 1.0, 1.6))


def test_the_canons_noise_moves_to_the_levels_of_the_files():
    # One electron is the same digital numbers on either scale: shot goes with it, read squared.
    for name, factor in (("canon_70d", 15583 / 12952), ("nikon_z6", 1.0)):
        built_in, packed = get_camera(name).nlf(400), packed_camera(name).nlf(400)
        assert packed.shot == pytest.approx([s * factor for s in built_in.shot])
        assert packed.read == pytest.approx([r * factor**2 for r in built_in.read])
    with pytest.raises(ValueError, match=r"`camera` \(='sony'\) must be one of nikon_z6"):
        packed_camera("sony")


def test_a_camera_given_replaces_the_guess(nikon):
    root, mine = nikon[0], get_camera("nikon_z6")
    assert read_dataset(root, camera="canon_70d")[0].captures[0].camera.name == "canon_70d"
    assert read_sequence(root / "scene_001", camera=mine).captures[0].camera is mine
    write_raw_sequence(root / "raws", captures("nikon_z6"))
    assert read_sequence(root / "raws", camera="canon_70d").captures[0].camera.name == "canon_70d"


def test_a_partial_copy_is_read_with_a_warning(nikon, caplog):
    root = nikon[0]
    (root / "scene_002" / "DSC_0001.npy").unlink()
    assert [s.name for s in read_dataset(root)] == ["scene_001"]
    assert "1 of 3 files are not there" in caplog.text
    for path in (root / "scene_001").iterdir():
        path.unlink()
    with pytest.raises(ValueError, match=r"\(3 rows\) must list \.npy files that are there"):
        read_dataset(root)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"iso": "auto"}, r"row 2: `iso` \(='auto'\) must be a number"),
        ({"time": ""}, r"row 2: `time` \(=''\) must be a number"),
        ({"aperture": "0"}, r"row 2: `f_number`"),
        ({"noiseprofile": "1e-5 1e-8 1e-5"}, r"row 2: `noiseprofile` .* must be 2 or 6 numbers"),
    ],
)
def test_a_cell_that_is_no_value_is_named(tmp_path, changes, message):
    author_table(tmp_path / "camera_params.csv", NIKON, nikon_row("s/a.jpg", **changes))
    with pytest.raises(ValueError, match=message):
        read_dataset(tmp_path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (np.zeros((4, 6), np.float32), r"must be \(4, H, W\)"),
        (np.zeros((6, 8, 4), np.float32), r"must be \(4, H, W\)"),
        (np.full((4, 2, 2), math.nan, np.float32), "finite"),
        (np.zeros((4, 2, 2), np.uint16), "floating point"),
        (b"", "whole .npy file"),
        (b"not an array at all", "whole .npy file"),
        (np.array([{}], dtype=object), "allow_pickle"),  # nothing pickled is run
    ],
)
def test_files_that_are_no_packed_raw_are_refused(tmp_path, content, message):
    file = tmp_path / "a.npy"
    file.write_bytes(content) if isinstance(content, bytes) else np.save(file, content)
    author_table(tmp_path / "camera_params.csv", NIKON, nikon_row("a.jpg"))
    captures = read_sequence(tmp_path).captures
    with pytest.raises(ValueError, match=message):
        captures[0]


def test_every_folder_of_raws_is_a_sequence(tmp_path):
    raws = captures("nikon_z6")
    write_raw_sequence(tmp_path / "nikon" / "b", raws)
    write_raw_sequence(tmp_path / "nikon" / "a", raws[:2])
    (tmp_path / "nikon" / "readme.txt").write_text("words")
    for ending in ("NEF", "jpg"):  # there twice: read once, from the DNG
        (tmp_path / "nikon" / "b" / f"capture_000.{ending}").write_bytes(b"never read")
    found = read_dataset(tmp_path)
    assert [(s.name, len(s.captures)) for s in found] == [("nikon/a", 2), ("nikon/b", 3)]
    assert [s.name for s in read_dataset(tmp_path / "nikon" / "a")] == ["a"]
    assert_same(list(found[1].captures), raws)


@WRITERS
def test_what_cannot_be_written(tmp_path, write):
    nikon, canon = captures("nikon_z6"), captures("canon_70d")
    (tmp_path / "a.txt").write_text("words")
    with pytest.raises(ValueError, match="must be new or empty"):
        write(tmp_path, nikon)
    with pytest.raises(ValueError, match="at least one capture"):
        write(tmp_path / "b", [])
    if write is write_packed_sequence:  # they would come back as another camera's
        other_levels = [RawImage(canon[0].data, SETTINGS[0], get_camera("canon_70d"))]
        for raws in ([*nikon, canon[0]], other_levels):
            with pytest.raises(ValueError, match="must all be of packed_camera"):
                write(tmp_path / "b", raws)
    assert not (tmp_path / "b").exists()


def test_what_is_no_dataset_is_refused(nikon, tmp_path):
    with pytest.raises(ValueError, match="lists 2; use read_dataset"):
        read_sequence(nikon[0])
    for read, name in ((read_sequence, "folder"), (read_dataset, "root")):
        with pytest.raises(FileNotFoundError, match=f"`{name}`"):
            read(tmp_path / "nowhere")
    folder = tmp_path / "words"
    folder.mkdir()
    (folder / "a.txt").write_text("words")
    with pytest.raises(ValueError, match=r"files ending in \['\.txt'\]\) must hold raw files"):
        read_sequence(folder)
    with pytest.raises(ValueError, match=r"`root` .* must hold a camera_params\.csv"):
        read_dataset(folder)
    for header, words in ("path,iso,aperture\n", "missing: time"), ("", "columns: none"):
        (folder / "camera_params.csv").write_text(header)
        with pytest.raises(ValueError, match=words):
            read_dataset(folder)
