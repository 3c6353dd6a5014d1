"""Which file is which state of which scene, in every layout."""

import shutil
from pathlib import Path

import pytest

from ae_env.grid import ExposureGrid
from ae_env.scenes.recorded import index_recorded, recorded_grid, settings_in_name, state_of
from simulator import CameraSettings
from tests.ae_env.recorded_files import GRID, write_picture, write_raws, write_states, write_video


def touch(folder: Path, *names: str) -> Path:
    """Files whose names say everything: nothing in them is read."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


@pytest.mark.parametrize(
    ("name", "settings", "rest"),
    [
        ("iso100_1-125s_f4", (100, 1 / 125, 4), ""),
        ("desk_ISO-1600_0.5s_F5.6", (1600, 0.5, 5.6), "desk"),
        ("f2.8 iso50 8ms", (50, 0.008, 2.8), ""),
        ("250us", (None, 0.00025, None), ""),
        ("15s", (None, 15, None), ""),
        # An underscore parts words: it is no fraction's bar after one.
        ("frame_0007_0.5s_iso100_f4", (100, 0.5, 4), "frame_0007"),
        ("frame_0007_8s", (None, 8, None), "frame_0007"),
        ("frame_1_8s", (None, 8, None), "frame_1"),
        ("frame-1-8s", (None, 8, None), "frame-1"),
        ("IMG_0001_2s_f4", (None, 2, 4), "IMG_0001"),
        ("f4_0.5s_iso100", (100, 0.5, 4), ""),
        ("f4_1s_iso100", (100, 1, 4), ""),
        ("100iso_1-125s", (100, 1 / 125, None), ""),
        # Not settings: a class of ImageNet, a picture of it, words that begin with f or iso.
        ("n01443537", (None, None, None), "n01443537"),
        ("ILSVRC2012_val_00000293", (None, None, None), "ILSVRC2012_val_00000293"),
        ("isolated_scene2_from_3steps", (None, None, None), "isolated_scene2_from_3steps"),
        ("param_12", (None, None, None), "param_12"),
    ],
)
def test_settings_in_names(name: str, settings: tuple[float | None, ...], rest: str) -> None:
    names = ("iso", "exposure_time", "f_number")
    expected = {k: v for k, v in zip(names, settings, strict=True) if v is not None}
    found, left = settings_in_name(name)
    assert found == pytest.approx(expected)
    assert left == rest


def test_raws_state_their_settings_in_exif(tmp_path: Path) -> None:
    write_raws(tmp_path / "desk")
    write_raws(tmp_path / "door", tuple(GRID)[1:], seed=1)
    files = index_recorded(tmp_path, {"iso": 50.0})  # what the files state comes first
    assert [f.scene for f in files] == ["desk"] * 8 + ["door"] * 7
    assert {f.group for f in files} == {"desk", "door"}
    assert [f.settings for f in files[:8]] == list(GRID)
    assert recorded_grid(files) == GRID


def test_imagenet_es(tmp_path: Path) -> None:
    grid = ExposureGrid((200, 12800), (1 / 1250, 0.4), (5, 13))
    write_states(tmp_path, seeds=(3,), grid=grid)
    shutil.copytree(tmp_path / "l1", tmp_path / "l5")
    files = index_recorded(tmp_path, {})
    assert [f.scene for f in files] == [f"l{i}/n00000003/val_3" for i in (1, 5) for _ in range(8)]
    # Both lights of a picture stay on one side of a split.
    assert {f.group for f in files} == {"n00000003/val_3"}
    assert recorded_grid(files) == grid
    by_folder = {f.path.parts[-3]: f.settings for f in files}
    assert by_folder == {f"param_{i + 1}": s for i, s in enumerate(grid)}


def test_video_stacks(tmp_path: Path) -> None:
    write_video(tmp_path, frames=2, times=("1-1000s", "1-60s"))
    files = index_recorded(tmp_path, {"iso": 400.0, "f_number": 4.0})
    assert [(f.sequence, f.frame, f.scene) for f in files] == [
        ("street", i, f"street/frame_{i:04d}") for i in (0, 1) for _ in range(2)
    ]
    assert {f.group for f in files} == {"street"}
    # Frames in the files' names are the same.
    flat = touch(tmp_path / "flat", *(f"v/frame_{i}_1-{t}s.png" for i in (9, 10) for t in (8, 15)))
    files = index_recorded(flat, {"iso": 400.0, "f_number": 4.0})
    assert [(f.sequence, f.frame) for f in files] == [("v", 9), ("v", 9), ("v", 10), ("v", 10)]


def test_a_table_and_exif_complete_each_other(tmp_path: Path) -> None:
    for number, settings in enumerate(GRID):
        write_picture(tmp_path / "a" / f"{number}.jpg", settings, exif=("exposure_time", "iso"))
    rows = [f"{number}.jpg,f{settings.f_number:g}" for number, settings in enumerate(GRID)]
    (tmp_path / "a" / "settings.csv").write_text("\n".join(["file,aperture", *rows]))
    files = index_recorded(tmp_path, {})
    assert [f.scene for f in files] == ["a"] * 8
    assert recorded_grid(files) == GRID


def test_nominal_and_exact_values_are_one_state() -> None:
    grid = ExposureGrid((100,), (1 / 128, 1 / 64), (2.8, 5.6))
    assert state_of(CameraSettings(100, 1 / 125, 5.6569), grid) == 1
    assert state_of(CameraSettings(100, 1 / 60, 5.6), grid) is None  # 6.7 % off
    assert state_of(CameraSettings(200, 1 / 64, 5.6), grid) is None


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("a,b\n1,2", r"columns \['a', 'b'\]\) must have the column file"),
        ("file,iso\nx,many", r"settings.csv', line 2: 'many' must be a number"),
        ("file,iso\nx,1\ny,1/0", r"settings.csv', line 3: '1/0' must be a number"),
        ("idx,iso\nfirst,100", r"settings.csv', line 2: 'first' must be a number"),
        ("file,iso\nx,100\nx,200", r"settings.csv' must have one row for 'x': two say"),
        ("file,iso\n\udcff,100", r"settings.csv' must be a CSV file in UTF-8"),
    ],
)
def test_wrong_tables(tmp_path: Path, table: str, message: str) -> None:
    (tmp_path / "settings.csv").write_text(table, errors="surrogateescape")
    with pytest.raises(ValueError, match=message):
        index_recorded(tmp_path, {})


def test_files_that_are_no_state(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"'recorded:.*none'\) must name an existing folder"):
        index_recorded(tmp_path / "none", {})
    with pytest.raises(ValueError, match=r"must hold captures: raws \(.*pictures \("):
        index_recorded(touch(tmp_path / "a", "read_me.txt", ".hidden/iso1_1s_f1.png"), {})
    with pytest.raises(ValueError, match=r"x.png' does not state its iso and f_number: name it"):
        index_recorded(touch(tmp_path / "b", "1-8s/x.png"), {})
    with pytest.raises(ValueError, match=r"f0.png': `f_number` \(=0.0\) must be"):
        index_recorded(touch(tmp_path / "c", "iso100_1-8s_f0.png"), {})
    with pytest.raises(ValueError, match=r"file '.*a.dng': `path` \(='a.dng'\) must be a"):
        index_recorded(touch(tmp_path / "d", "a.dng"), {})
    names = [f"iso{i}_1-{i}s_f{i / 100}.png" for i in range(100, 1800, 100)]
    with pytest.raises(ValueError, match=r"17 ISO speeds.*4913 combinations; at most 4096"):
        recorded_grid(index_recorded(touch(tmp_path / "e", *names), {}))
