"""Scenes of the reference camera, pictures, and the paper's dataset in its authors' layout."""

import csv
import json
import logging
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from skimage.data import stereo_motorcycle

from examples.write_sequences import write_packed_sequence
from simulator import CameraSettings, RawImage, get_camera
from simulator.radiance.procedural import KINDS
from simulator.reference.reference_camera import DRAPED, ReferenceScene
from simulator.training import paper_dataset
from simulator.training import scenes as pictured
from simulator.training.paper_dataset import packed_camera, read_dataset, split_dataset
from simulator.training.scenes import reference_scenes
from simulator.training.trainer import SimulatorConfig, StageConfig
from tests.ae_env.scene_files import write_exr, write_hdr
from tests.simulator.training.scenes import SETTINGS, write_dataset

CAMERA = get_camera("nikon_z6")
SPLITS = ("train", "validation", "test")
WHITE = 100 * 2.5 / (120 * np.pi)  # signal of a white surface at the incident-light exposure


def blur(scene: ReferenceScene) -> np.ndarray:
    """Circle of confusion at f/11 [packed pixels of 11.88 um] by the thin-lens formula."""
    f, s, z = scene.lens.focal_length, scene.lens.focus_distance, scene.depth.double().numpy()
    return f * f / (11.0 * (s - f)) * np.abs(z - s) / z / 11.88e-6


def assert_no_group_is_shared(made: dict[str, list]) -> None:
    groups = [{each.group for each in own} for own in made.values()]
    assert all(groups)
    assert sum(map(len, groups)) == len(set().union(*groups))
    names = [getattr(e, "scene_id", None) or e.name for own in made.values() for e in own]
    assert len(set(names)) == len(names)


def test_splits_are_apart_and_scenes_the_same_however_many():
    numbers = zip(SPLITS, (28, 4, 4), strict=True)
    scenes = {split: reference_scenes(split, CAMERA, number=n, size=48) for split, n in numbers}
    assert_no_group_is_shared(scenes)
    fewer = reference_scenes("validation", CAMERA, number=2, size=48)[:2]
    for scene, again in zip(scenes["validation"], fewer, strict=False):
        assert (scene.scene_id, scene.lens) == (again.scene_id, again.lens)
        for field in ("light", "depth"):
            torch.testing.assert_close(getattr(again, field), getattr(scene, field), rtol=0, atol=0)
    with pytest.raises(ValueError, match="`split`"):
        reference_scenes("trian", CAMERA)
    other = reference_scenes("validation", CAMERA, number=1, size=48, seed=1)[0]
    assert other.group != fewer[0].group
    assert not torch.equal(other.light, fewer[0].light)
    train = scenes["train"]
    kinds = [s.kind for s in train]
    assert kinds.count("depth") == 21
    assert set(kinds) == {"depth", "photograph", *KINDS}
    for scene in train:
        assert (scene.light.shape, scene.size) == ((3, 96, 96), (48, 48))
        assert (scene.depth is not None) == (scene.kind == "depth")
        assert 1.0 <= scene.illuminance <= 20_000.0
        # The incident-light exposure, E = 2.5 * 2**EV100, with ISO 12232's 120 for white.
        exposure = 2.0**scene.reference.log2_exposure
        assert scene.illuminance * exposure / 2.5 == pytest.approx(1.0, rel=1e-6)
    surfaces = [s.light[1].median().item() / WHITE for s in train if s.kind == "depth"]
    assert 0.05 < np.median(surfaces) < 0.3  # reflectances of nature


def test_panoramas_are_cut_and_coarse_pictures_left_out(tmp_path, caplog):
    (tmp_path / "hdri_cc0").mkdir()
    row, column = np.mgrid[:256, :512]
    panorama = np.stack([1.0 + column % 128, 1.0 + row, 1.0 + row % 2], axis=2)
    write_exr(tmp_path / "hdri_cc0" / "city.exr", panorama)
    with caplog.at_level(logging.INFO):
        found = reference_scenes("validation", CAMERA, number=0, size=64, data=tmp_path)
        views = [s for s in found if s.kind == "radiance"]
        wide = reference_scenes("validation", CAMERA, number=0, size=128, data=tmp_path)
    assert [s.scene_id for s in views] == ["city-000", "city-090", "city-180", "city-270"]
    assert "city-000: too coarse (128 photosites a side), left out" in caplog.text
    assert all(s.kind == "photograph" for s in wide)
    assert {s.group for s in views} == {"city"}
    for view in views:
        assert (view.depth, view.size, view.light.shape) == (None, (64, 64), (3, 128, 128))
        assert view.reference.log2_exposure == pytest.approx(-np.log2(view.illuminance / 2.5))
    # A quarter of the circle each, its pixels as they are: every one looks the same here.
    assert len({float(v.light.sum()) for v in views}) == 1
    with pytest.raises(FileNotFoundError, match="`data`"):
        reference_scenes("train", CAMERA, number=0, data=tmp_path / "none")


def test_motorcycle_has_the_depth_of_its_calibration() -> None:
    """z = baseline * focal length / (disparity + offset), as scikit-image's documentation says."""
    _, _, disparity = stereo_motorcycle()
    front, middle = pictured.depth_photographs(CAMERA)
    assert (front.scene_id, middle.scene_id) == ("motorcycle-front", "motorcycle-middle")
    assert (front.light.shape, front.size) == ((3, 500, 740), (250, 370))
    assert torch.equal(front.depth, middle.depth)
    depth = 0.193001 * 994.978 / (np.where(np.isfinite(disparity), disparity, np.nan) + 31.086)
    known = np.isfinite(depth[:500, :740])
    np.testing.assert_allclose(front.depth.numpy()[known], depth[:500, :740][known], rtol=1e-5)
    assert 1.8 < front.depth.min() < front.depth.max() < 6.0


@pytest.mark.real_data
def test_real_pictures_become_scenes(data_dir: Path, tmp_path: Path) -> None:
    """One file of each kind."""
    files = "photo_pool/galliumos_galliumos-3_0-architectural.jpg", "hdri_pool/Flowers.exr"
    for name in ("depth_cones", "MANIFEST_POOL.csv", *files, "canon_crw_cc0/CRW_0117.CRW"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).symlink_to(data_dir / name)
    for scene in pictured.depth_photographs(CAMERA, data=tmp_path)[2:]:
        assert (scene.group, scene.size) == ("cones", (187, 225))
        assert 4.5 < np.quantile(blur(scene), 0.97) < 6.3
    made = reference_scenes("validation", CAMERA, number=0, size=128, data=tmp_path)
    assert [s.scene_id for s in made] == ["coffee", "Flowers", Path(files[0]).stem]
    made += pictured.mosaic_scenes("test", tmp_path, size=128)
    assert [(s.scene_id, s.group) for s in made[3:]] == [("CRW_0117", "camera_box")]
    assert all(s.sampled and s.size == (128, 128) for s in made)


def test_drapes_keep_light_and_group_and_have_a_blur_in_range() -> None:
    light = torch.rand(3, 128, 96, generator=torch.Generator().manual_seed(1))
    reference = CameraSettings(100, 1 / 64, 4)
    scene = ReferenceScene("a", "the-group", "indoor", light, reference, illuminance=100.0)
    others = replace(scene, in_focus=False), replace(scene, light=light[[0, 1, 1, 2]])
    drapes = list(pictured.draped_scenes([scene, *others], CAMERA, copies=4))
    assert len({d.scene_id for d in drapes}) == len(drapes) == 4
    assert not torch.equal(drapes[0].depth, drapes[1].depth)
    for copy in drapes:
        assert torch.equal(copy.light, light)
        assert (copy.group, copy.kind, copy.size) == ("the-group", DRAPED, (64, 48))
        assert blur(copy).max() <= 7.0 + 1e-3
        assert blur(copy).min() < 0.35  # something is in focus


def by_split(data, drawn=0):
    return {s: pictured.detail_pictures(s, data=data, drawn=drawn) for s in SPLITS}


def the_only(folder, name):
    (found,) = (p for own in by_split(folder).values() for p in own if p.name == name)
    return found


def test_groups_of_files_stay_together(tmp_path: Path) -> None:
    (tmp_path / "photo_pool").mkdir()
    rows = ["file,licence,group"]
    for i in range(60):
        Image.new("RGB", (12, 10), (i, 2 * i, 99)).save(tmp_path / f"photo_pool/p{i}.png")
        rows.append(f"photo_pool/p{i}.png,CC0,series{i % 20}")
    (tmp_path / "MANIFEST_POOL.csv").write_text("\n".join(rows) + "\n")
    for name in ("bridge", "venice"):
        write_hdr(tmp_path / f"hdri_cc0/{name}.hdr")
    pictures = by_split(tmp_path)
    assert_no_group_is_shared(pictures)
    found = [p for own in pictures.values() for p in own if p.kind == "photograph"]
    assert {p.group for p in found} == {f"series{i}" for i in range(20)}
    assert len({p.group for p in pictures["train"]}) > len({p.group for p in pictures["test"]}) > 1
    assert [p.name for p in pictures["train"] if p.kind == "radiance"] == ["bridge"]
    assert [p.name for p in pictures["test"] if p.kind == "radiance"] == ["venice"]
    # 62, 8 and 30 percent of 2,000 groups, within four standard errors.
    drawn = [pictured.detail_split(f"group{i}") for i in range(2000)]
    for split, share in zip(SPLITS, (0.62, 0.08, 0.30), strict=True):
        error = 4 * (share * (1 - share) / 2000) ** 0.5
        assert drawn.count(split) / 2000 == pytest.approx(share, abs=error)


def test_mosaics_linear_frames_and_maps_by_hand(tmp_path: Path) -> None:
    """Black 10 and white 110; the planes lie at (0, 0), (0, 1), (1, 0), (1, 1)."""
    cv2 = pytest.importorskip("cv2")
    for folder in ("gopro_raw", "intel_tau_small"):
        (tmp_path / folder).mkdir()
    tile = np.array([[20, 30], [40, 60]], np.uint16)
    Image.fromarray(np.tile(tile, (2, 3))).save(tmp_path / "gopro_raw" / "A.png")
    meta = {"black": [10] * 4, "white": 110, "dng_tags": {"NoiseProfile": "(0.002, 0.00003)"}}
    (tmp_path / "gopro_raw" / "meta.json").write_text(json.dumps({"A.png": meta}))
    frame = np.zeros((4, 4, 3), np.uint16)
    frame[..., 2] = 65535  # red, as OpenCV writes it
    cv2.imwrite(str(tmp_path / "intel_tau_small" / "B.png"), frame)
    mosaic, linear = (the_only(tmp_path, name) for name in ("A.png", "B"))
    assert mosaic.light.shape == (4, 2, 3)
    assert mosaic.light[:, 1, 2].tolist() == pytest.approx([0.1, 0.2, 0.3, 0.5])
    assert (mosaic.nlf.shot, mosaic.nlf.read) == ((0.002,) * 4, (0.00003,) * 4)
    assert linear.light[:, 3, 0].tolist() == [1.0, 0.0, 0.0]
    assert linear.nlf.is_zero
    (tmp_path / "intel_tau_small" / "C.png").symlink_to("nowhere")
    with pytest.raises(ValueError, match=r"C\.png' cannot be read: the link leads nowhere"):
        by_split(tmp_path)
    (tmp_path / "intel_tau_small" / "C.png").unlink()
    # A map has a median of one, and no lamp outshines it.
    image = np.full((8, 16, 3), 4.0)
    image[0, 0] = 4000.0
    write_hdr(tmp_path / "hdri_pool" / "room.hdr", image=image)
    light = the_only(tmp_path, "room").light
    assert light.shape == (3, 8, 16)
    assert light[:, 0, 0].tolist() == [64.0] * 3
    torch.testing.assert_close(light[:, 1:], torch.ones(3, 7, 16), rtol=0.01, atol=0)


def test_drawn_pictures(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setattr(pictured, "_SIZE", 64)
    drawn = by_split(None, drawn=8)
    assert "AE_ENV_DATA" in caplog.text
    assert_no_group_is_shared(drawn)
    for own in drawn.values():
        assert [p.kind for p in own] == ["leaves"] * 8 + ["chart"] * 8 + ["smooth"] * 8
        for each in own:
            assert (each.light.shape, each.light.dtype) == ((3, 64, 64), torch.float32)
            assert bool(((each.light >= 0) & each.light.isfinite()).all())
    again, other = (pictured.detail_pictures("train", data=None, drawn=8, seed=s) for s in (0, 1))
    for first, same, new in zip(drawn["train"], again, other, strict=True):
        assert torch.equal(first.light, same.light)
        assert not torch.equal(first.light, new.light)
        assert first.group != new.group


# -- the paper's dataset ---------------------------------------------------------------------------


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
    write_packed_sequence(folder, raws)
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


def author_table(path, header, *rows):
    with path.open("w", newline="") as stream:
        csv.writer(stream).writerows([header, *rows])


def nikon_row(path, **changes):
    values = (path, 0.008, 800, 5.6, [1.9, 1.0, 1.4, 0.0], PROFILE)
    return [*(dict(zip(NIKON, values, strict=True)) | changes).values()]


def test_the_authors_nikon_files_and_a_partial_copy_of_them(tmp_path, caplog):
    """Two sequences with one table above them, paths beginning where the script ran."""
    rng, root, mosaics = np.random.default_rng(0), tmp_path / "Nikon", {}
    for name in ("scene_001/DSC_0001", "scene_001/DSC_0002", "scene_002/DSC_0001"):
        mosaics[name] = rng.integers(1008, 15520, (6, 10))
        mosaics[name][0, :2] = 900, 16383  # what the preprocessing does not clip
        author_file(root / f"{name}.npy", mosaics[name], 1008, 15520)
    rows = (nikon_row(f"./ProcessedData/Nikon/{name}.jpg") for name in mosaics)
    author_table(root / "camera_params.csv", NIKON, *rows)
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
    with pytest.raises(ValueError, match=r"camera_params\.csv' must be a CSV"):
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


def test_captures_do_not_teach_every_preset(tmp_path: Path) -> None:
    """Those that they teach are trained by `bench paper --quick`."""
    nano = SimulatorConfig(preset="nano", noise=StageConfig(steps=1))
    with pytest.raises(ValueError, match="`preset`"):
        paper_dataset.train_on_captures(nano, [], tmp_path / "a", command="test")
