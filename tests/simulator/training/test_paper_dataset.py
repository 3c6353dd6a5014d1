"""The paper's dataset, on files made as its authors' preprocessing does, and training on it."""

import csv
import math
import shutil
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks import paper_baselines as paper_baselines  # presets pc and dl
from simulator import CameraSettings, RawImage, get_camera
from simulator.networks.weights import load_modules
from simulator.training import paper_dataset
from simulator.training.paper_dataset import packed_camera, read_dataset, split_dataset
from simulator.training.trainer import SimulatorConfig, StageConfig, first_modules
from tests.simulator.training.scenes import SETTINGS, write_dataset

#: NoiseProfile of a Nikon Z6 raw at ISO 800, as exiftool prints it: (shot, read) of R, G, B.
PROFILE = "6.4e-05 2.3e-08 6.1e-05 2.2e-08 5.7e-05 1.9e-08"
NIKON = ("path", "time", "iso", "aperture", "wb", "noiseprofile")
CANON = ("path", "time", "iso", "aperture", "noiseprofile")


def captures(name: str) -> list[RawImage]:
    camera, gains = packed_camera(name), (2.0, 1.0, 1.5)
    numbers = np.random.default_rng(0).integers(1000, 15000, (len(SETTINGS), 8, 8))
    pairs = zip(numbers, SETTINGS, strict=True)
    return [RawImage.from_mosaic(n, s, camera, white_balance=gains) for n, s in pairs]


@pytest.mark.parametrize("camera", ["nikon_z6", "canon_70d"])
def test_captures_come_back(tmp_path, camera):
    raws, folder = captures(camera), tmp_path / "scene_007"
    paper_dataset.write_packed_sequence(folder, raws)
    (sequence,) = read_dataset(folder)
    assert sequence.name == "scene_007"
    for capture, raw in zip(sequence.captures, raws, strict=True):
        back = capture.read()
        np.testing.assert_array_equal(back.to_mosaic(), raw.to_mosaic())
        assert back.settings == raw.settings
        for name in ("name", "black_level", "white_level"):
            assert getattr(back.camera, name) == getattr(raw.camera, name)
        assert back.noise.shot[1] == pytest.approx(sum(raw.noise.shot[1:3]) / 2)
        assert back.noise.read[0] == pytest.approx(raw.noise.read[0])
    header = (folder / "camera_params.csv").read_text().splitlines()[0]
    assert header == ",".join(NIKON if camera == "nikon_z6" else CANON)
    if camera == "nikon_z6":  # the Canon's table has no white balance
        assert sequence.captures[0].white_balance == pytest.approx((2.0, 1.0, 1.5))


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


def test_the_authors_nikon_files_and_a_partial_copy_of_them(nikon, caplog):
    root, mosaics = nikon
    sequences = read_dataset(root)
    assert [(s.name, len(s.captures)) for s in sequences] == [("scene_001", 2), ("scene_002", 1)]
    raw = sequences[0].captures[1].read()
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
    mine = get_camera("canon_70d")
    assert read_dataset(root, camera=mine)[0].captures[0].read().camera is mine
    (root / "scene_002" / "DSC_0001.npy").unlink()
    assert [s.name for s in read_dataset(root)] == ["scene_001"]
    assert "1 of 3 files are not there" in caplog.text
    shutil.rmtree(root / "scene_001")
    with pytest.raises(ValueError, match=r"camera_params\.csv"):
        read_dataset(root)


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
    raw = read_dataset(tmp_path)[0].captures[0].read()
    known = raw.camera.name, raw.camera.white_level, raw.camera.black_level
    assert known == ("canon_70d", 15000, (2048.0,) * 4)
    np.testing.assert_array_equal(raw.to_mosaic(), np.minimum(mosaic, 15000))
    assert raw.settings == CameraSettings(3200, 4, 22)
    assert (raw.noise.shot, raw.noise.read) == ((2e-4,) * 4, (3e-7,) * 4)
    assert raw.white_balance == pytest.approx((2.0, 1.0, 1.6))


def test_cells_that_are_no_value_and_files_that_are_no_raw_are_named(tmp_path):
    bad = {"iso": "auto", "time": "", "aperture": "0", "noiseprofile": "1e-5 1e-8 1e-5"}
    for name, value in bad.items():
        author_table(tmp_path / "camera_params.csv", NIKON, nikon_row("s/a.jpg", **{name: value}))
        with pytest.raises(ValueError, match=f"row 2: `{name.replace('aperture', 'f_number')}`"):
            read_dataset(tmp_path)
    table = tmp_path / "camera_params.csv"
    table.write_text(table.read_text() + '"s/a.jpg,1\n')  # a quotation that does not end
    with pytest.raises(ValueError, match=r"camera_params\.csv` must be a CSV"):
        read_dataset(tmp_path)
    file, pickled = tmp_path / "a.npy", np.array([{}], dtype=object)  # nothing pickled is run
    author_table(table, NIKON, [*nikon_row("a.jpg"), ""])  # a comma at the end
    for array in (np.zeros((4, 6)), np.full((4, 2, 2), math.nan), np.zeros((5, 2, 2)), pickled):
        np.save(file, array)
        (capture,) = read_dataset(tmp_path)[0].captures
        with pytest.raises(ValueError, match=r"a\.npy|`data`"):
            capture.read()
    file.write_bytes(b"not an array at all")
    with pytest.raises(ValueError, match=r"a\.npy"):
        capture.read()


def test_what_cannot_be_written(tmp_path):
    nikon, canon = captures("nikon_z6"), captures("canon_70d")
    (tmp_path / "a.txt").write_text("words")
    other_levels = [RawImage(canon[0].data, SETTINGS[0], get_camera("canon_70d"))]
    with pytest.raises(ValueError, match="`folder`"):
        paper_dataset.write_packed_sequence(tmp_path, nikon)
    for raws in ([], [*nikon, canon[0]], other_levels):  # would come back as another camera's
        with pytest.raises(ValueError, match="`raws`"):
            paper_dataset.write_packed_sequence(tmp_path / "b", raws)
    assert not (tmp_path / "b").exists()


@pytest.mark.parametrize(("read", "name"), [(read_dataset, "root"), (split_dataset, "folder")])
def test_what_is_no_dataset_is_refused(tmp_path, read, name):
    with pytest.raises(FileNotFoundError, match=f"`{name}`"):
        read(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=f"`{name}`"):
        read(tmp_path)
    for header in ("path,iso,aperture\n", ""):
        (tmp_path / "camera_params.csv").write_text(header)
        with pytest.raises(ValueError, match="columns"):
            read(tmp_path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("Nikon"), sequences=4)


def test_sequences_are_split_whole_and_paired_for_each_stage(folder: Path, tmp_path: Path) -> None:
    train, test = split_dataset(folder, seed=0)
    assert (len(train), len(test)) == (3, 1)
    assert {s.name for s in (*train, *test)} == {f"scene_00{n}" for n in range(4)}
    assert split_dataset(folder, seed=0)[1] == test
    assert len({split_dataset(folder, seed=seed)[1][0].name for seed in range(12)}) > 1
    assert train[0].settings == SETTINGS
    write_dataset(tmp_path / "AutoModenikon_test_512", sequences=1)
    with pytest.raises(ValueError, match="`folder`"):
        split_dataset(tmp_path)
    shutil.copytree(folder, tmp_path / "AutoModeNikon_Train")
    train, test = split_dataset(tmp_path)  # folders named test are held out
    assert (len(train), len(test)) == (4, 1)
    sequences = split_dataset(folder)[0][:1]
    settings = sequences[0].settings
    pairs = paper_dataset.captured_pairs
    found = {
        stage: [(settings[p.source], settings[p.target]) for p in pairs(sequences, stage)]
        for stage in ("exposure", "noise", "aperture")
    }
    assert len(found["exposure"]) == 4 * 3
    assert found["noise"] == [(SETTINGS[1], SETTINGS[0])]  # f/8, ISO 1600 to 100
    opens = [(s, t) for s, t in found["aperture"] if s.f_number > t.f_number]
    assert len(opens) == 5  # of 6 unordered pairs, one has the same aperture
    assert all(s.f_number >= t.f_number for s, t in found["aperture"])


def test_batches_hold_what_the_files_and_the_table_say(folder: Path) -> None:
    sequences = split_dataset(folder)[0]
    pairs, other = (paper_dataset.CapturedPairs(sequences, "noise", seed=5) for _ in range(2))
    batch = pairs.batch(3, 4, 16)
    assert all(map(torch.equal, batch, other.batch(3, 4, 16)))
    assert batch.source.shape == (4, 4, 16, 16)
    assert batch.ratio.tolist() == [1.0] * 4  # four stops of ISO against four of time
    assert batch.f_source.tolist() == batch.f_target.tolist() == [8.0] * 4
    assert batch.shot[0].tolist() == pytest.approx(packed_camera("nikon_z6").nlf(1600).shot, 1e-2)
    whole = pairs.batch(0, 1, 4096)
    files = [np.load(c.file)[[0, 1, 3, 2]].clip(max=1.0) for s in sequences for c in s.captures]
    for shown in (whole.source, whole.sample):
        assert any(np.array_equal(shown[0], file) for file in files)


def test_a_training_changes_the_weights_and_a_second_run_resumes(tmp_path, folder: Path) -> None:
    """The three stages of the paper's simulator are trained by `bench paper --quick`."""
    train, _ = split_dataset(folder)
    path, once = tmp_path / "out" / "pc", StageConfig(steps=1, batch=1, crop=16)
    training = SimulatorConfig(preset="pc", baseline=once)
    run = partial(paper_dataset.train_on_captures, sequences=train, command="test")
    modules, card = load_modules(run(training, path=path))
    assert card["stages"]["baseline"]["steps"] == 1
    assert (card["sequences"], card["training"]["preset"]) == (3, "pc")
    state, fresh = modules.state_dict(), first_modules(training)[0].state_dict()
    assert not all(torch.equal(fresh[name], value) for name, value in state.items())
    again = load_modules(run(training, path=path))[0].state_dict()
    assert all(torch.equal(again[name], value) for name, value in state.items())
    compact = SimulatorConfig(preset="compact", exposure=once, noise=once, aperture=once)
    with pytest.raises(ValueError, match="`preset`"):
        run(compact, path=tmp_path / "a")
