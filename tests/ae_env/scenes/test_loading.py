"""load_scenes: users' folders, groups, splits, errors."""

import logging
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
import torch

from ae_env.scenes import Scene, load_scenes
from ae_env.scenes.folder import find_files
from ae_env.scenes.split import Shot, group_shots, split_groups
from simulator.camera import get_camera
from simulator.settings import CameraSettings

CAMERA = get_camera("nikon_z6")


def write_hdr(path: Path, seed: int = 0, height: int = 20, width: int = 24) -> None:
    cv2 = pytest.importorskip("cv2")
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.random.default_rng(seed).uniform(0.1, 4.0, (height, width, 3)).astype(np.float32)
    path.write_bytes(cv2.imencode(".hdr", image)[1].tobytes())


def my_scenes(split: str, camera: object) -> list[Scene]:
    light = torch.full((4, 16, 16), 0.3 if split == "train" else 0.6)
    settings = CameraSettings(100, 0.01, 4)
    return [Scene.from_array(light, settings, CAMERA, scene_id=split)]


MINE = my_scenes("all", None)


def load(spec: object, split: str = "all", resolution: int | None = 16) -> list[Scene]:
    return load_scenes(spec, split, camera=CAMERA, resolution=resolution)  # type: ignore[arg-type]


def test_scenes_from_lists_and_attributes() -> None:
    for split in ("train", "test", "all"):
        assert [s.scene_id for s in load(MINE, split)] == ["all"]
        assert [s.scene_id for s in load(f"{__name__}:MINE", split)] == ["all"]
        assert [s.scene_id for s in load(f"{__name__}:my_scenes", split)] == [split]
    assert load(MINE, resolution=8)[0].box_factor == 2


def test_small_folder_is_zero_shot(tmp_path: Path) -> None:
    for i in (10, 2, 1):
        write_hdr(tmp_path / f"map{i}.hdr", i)
    scenes = load(tmp_path, "test")
    assert [s.scene_id for s in scenes] == ["map1", "map2", "map10"]
    assert [s.group for s in scenes] == ["map1", "map2", "map10"]
    assert [s.scene_id for s in load(str(tmp_path), "all")] == ["map1", "map2", "map10"]
    assert [s.scene_id for s in load(str(tmp_path / "map1*.hdr"))] == ["map1", "map10"]
    assert [s.scene_id for s in load(tmp_path / "map2.hdr")] == ["map2"]
    with pytest.raises(ValueError, match=r"at least 15 source groups.*has at most 3.*split='test'"):
        load(tmp_path, "train")


def test_large_folder_is_split_by_group(tmp_path: Path) -> None:
    for i in range(14):
        for name in ("a", "b"):
            write_hdr(tmp_path / f"subject{i}" / f"{name}.hdr", i)
    with pytest.raises(ValueError, match=r"at least 15 source groups.*has 14"):
        load(tmp_path, "train")
    for name in ("a", "b"):
        write_hdr(tmp_path / "subject14" / f"{name}.hdr", 14)
    train, test = (
        {s.scene_id: s.group for s in load(tmp_path, split)} for split in ("train", "test")
    )
    assert not set(train.values()) & set(test.values())
    assert {*train, *test} == {s.scene_id for s in load(tmp_path)}
    assert len(train) + len(test) == 30
    assert train
    assert test
    assert next(iter(train)).endswith(("/a", "/b"))


def test_groups_file_names_the_groups(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        write_hdr(tmp_path / f"{name}.hdr")
    (tmp_path / "groups.csv").write_text("file,group\na.hdr,first\nb.hdr,first\n")
    assert [s.group for s in load(tmp_path)] == ["first", "first", "c"]
    for text, words in (
        ("name,group\na.hdr,x\n", "columns"),
        ("file,group\nz.hdr,x\n", "line 2"),
        ("file,group\na.hdr,\n", "line 2"),
    ):
        (tmp_path / "groups.csv").write_text(text)
        with pytest.raises(ValueError, match=words):
            load(tmp_path)


def test_options_reach_the_scenes(tmp_path: Path) -> None:
    write_hdr(tmp_path / "a.hdr", 0)
    write_hdr(tmp_path / "b.hdr", 1)
    options = {"path": str(tmp_path), "illuminance": {"a.hdr": 250.0}, "kind": "mine", "hard": True}
    a, b = load(options | {"median_speed": 0.5})
    assert (a.illuminance, b.illuminance) == (250.0, None)
    assert {(s.kind, s.hard, s.median_speed) for s in (a, b)} == {("mine", True, 0.5)}
    (only,) = load({"path": tmp_path / "b.hdr", "ev100": 8.0})
    assert only.ev100 == pytest.approx(8.0, abs=0.05)


def test_split_of_groups_is_stable_and_needs_fifteen() -> None:
    names = [f"g{i}" for i in range(200)]
    split = split_groups(names)
    assert 0.6 < np.mean([split[n] == "train" for n in names]) < 0.8
    more = split_groups([*names, "new"])
    assert all(more[n] == split[n] for n in names)
    assert set(split_groups(names[:14]).values()) == {"test"}
    for start in range(180):
        assert set(split_groups(names[start : start + 15]).values()) == {"train", "test"}


def shot(seconds: float | None, look: int, camera: str = "A") -> Shot:
    histogram = np.zeros(4)
    histogram[look] = 1.0
    start = datetime(2024, 1, 1)
    time = None if seconds is None else start + timedelta(seconds=seconds)
    return Shot(camera, time, histogram)


@pytest.mark.parametrize(
    ("first", "second", "same"),
    [
        (shot(0, 0), shot(30, 1), True),  # a burst
        (shot(0, 0), shot(31, 1), False),
        (shot(0, 0), shot(300, 0), True),  # the same look within five minutes
        (shot(0, 0), shot(301, 0), False),
        (shot(None, 0), shot(None, 0), True),
        (shot(None, 0), shot(None, 1), False),
        (shot(0, 0), shot(0, 0, "B"), False),
    ],
)
def test_grouping_of_two_shots(first: Shot, second: Shot, same: bool) -> None:
    assert group_shots(["x", "y"], [first, second]) == (["x", "x"] if same else ["x", "y"])


def test_shots_are_grouped_in_the_order_of_their_times() -> None:
    shots = [shot(1000, 0), shot(0, 1), shot(1010, 2), shot(20, 3)]
    assert group_shots(["a", "b", "c", "d"], shots) == ["a", "b", "a", "b"]


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("bundeld", r"did you mean 'bundled'"),
        ("bundled:smal", r"did you mean 'bundled:small'"),
        ("no/such/folder", r"`scenes` \(='no/such/folder'\) must name an existing file"),
        ("no_such_module:scenes", "cannot be loaded: ModuleNotFound"),
        (f"{__name__}:MINES", "did you mean 'MINE'"),
        ("math:pi", "must give a list of Scene, not float"),
        ([1], r"scenes\[0\] \(=int\) must be a Scene"),
        ([], "at least one scene"),
        ([*MINE, *MINE], r"`scene_id` \(='all'\) must be unique"),
        (3, r"`scenes` \(=3\) must be"),
        ({"lux": 3}, "must have a 'path'"),
        ({"path": "x", "illuminace": 3}, "did you mean 'illuminance'"),
        ({"path": "bundled", "kind": "snow"}, "give the name"),
    ],
)
def test_errors_name_the_value_and_the_rule(spec: object, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        load(spec)


def test_unknown_split_and_too_small_scenes() -> None:
    with pytest.raises(ValueError, match=r"`split` \(='val'\)"):
        load(MINE, "val")
    with pytest.raises(ValueError, match=r"`resolution` \(=17\)"):
        load(MINE, resolution=17)
    with pytest.raises(ValueError, match=r"dead_leaves-1000.*`resolution` \(=512\)"):
        load("bundled", "test", resolution=512)


def test_unreadable_files_are_named(tmp_path: Path) -> None:
    (tmp_path / "readme.txt").write_text("no scenes here")
    with pytest.raises(ValueError, match=r"\.txt.*must hold raws"):
        load(tmp_path)
    (tmp_path / "broken.dng").write_bytes(b"II*\0 not a raw")
    with pytest.raises(ValueError, match=r"scene file .*broken\.dng"):
        load(tmp_path)
    (tmp_path / "broken.dng").unlink()
    pytest.importorskip("cv2")
    (tmp_path / "broken.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 9 +X 9\n")
    with pytest.raises(ValueError, match=r"broken\.hdr"):
        load(tmp_path)
    write_hdr(tmp_path / "broken.hdr", height=12, width=20)
    with pytest.raises(ValueError, match=r"broken\.hdr.*at least 16"):
        load(tmp_path)


def test_hidden_files_are_left_out(tmp_path: Path) -> None:
    write_hdr(tmp_path / "a.hdr")
    write_hdr(tmp_path / ".trash" / "b.hdr")
    write_hdr(tmp_path / "._a.hdr")
    assert [p.name for p in find_files(tmp_path)[1]] == ["a.hdr"]


@pytest.mark.real_data
def test_real_raws_are_three_subjects(data_dir: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "ae_env.scenes")
    scenes = load(data_dir / "canon_crw_cc0", "test", 64)
    groups = {s.scene_id[-4:]: s.group for s in scenes}
    assert len(scenes) == 8
    assert len(set(groups.values())) == 3
    for members in (("0101", "0104", "0105"), ("0112", "0113"), ("0117", "0118", "0119")):
        assert len({groups[m] for m in members}) == 1
    assert "3 source groups" in caplog.text
    for scene in scenes:
        assert scene.light.shape == (4, 64, 64)
        assert scene.box_factor == 13
        assert not scene.noise_free
        assert scene.illuminance is None
        assert scene.camera.model.endswith("S40")
    with pytest.raises(ValueError, match="at most 8"):
        load(data_dir / "canon_crw_cc0", "train")
