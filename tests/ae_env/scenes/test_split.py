"""Source groups of raws, and the split by group."""

import logging
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from ae_env.scenes.folder import Shot, group_shots, split_groups
from tests.ae_env.scene_files import load, write_hdr


def test_large_folder_is_split_by_group(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    names = [f"subject{i}/{name}" for i in range(15) for name in "ab"]
    for name in names[:28]:
        write_hdr(tmp_path / f"{name}.hdr")
    with pytest.raises(ValueError, match=r"at least 15 source groups.*has 14"):
        load(tmp_path, "train")
    for name in names[28:]:
        write_hdr(tmp_path / f"{name}.hdr")
    train, test, both = (load(tmp_path, split) for split in ("train", "test", "all"))
    assert train
    assert test
    assert {s.group for s in train}.isdisjoint(s.group for s in test)
    assert sorted(s.scene_id for s in train + test) == sorted(s.scene_id for s in both)
    assert sorted(s.scene_id for s in both) == sorted(names)
    left_out = [15 - len({s.group for s in part}) for part in (train, test)]
    lines = [r.getMessage() for r in caplog.records if "--split all" in r.getMessage()]
    for line, split, count in zip(lines, ("train", "test"), left_out, strict=True):
        assert f"split '{split}' leaves out {count} of 15 source groups" in line


def test_groups_file_names_the_groups(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        write_hdr(tmp_path / f"{name}.hdr")
    (tmp_path / "groups.csv").write_text("file,group\na.hdr,first\nb.hdr,first\n")
    assert [s.group for s in load(tmp_path)] == ["first", "first", "c"]
    for content, words in (
        (b"name,group\na.hdr,x\n", "columns"),
        (b"file,group\nz.hdr,x\n", "line 2"),
        (b"file,group\na.hdr,\n", "line 2"),
        (b"\xff\xfe\0", r"groups\.csv' must be a CSV file in UTF-8"),
        (b'file,group\n"' + b"x" * 200_000, r"groups\.csv' must be a CSV file in UTF-8"),
    ):
        (tmp_path / "groups.csv").write_bytes(content)
        with pytest.raises(ValueError, match=words):
            load(tmp_path)


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
    time = None if seconds is None else datetime(2024, 1, 1) + timedelta(seconds=seconds)
    return Shot(camera, time, np.eye(4)[look])


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
        assert (scene.light.shape, scene.box_factor) == ((4, 64, 64), 13)
        assert (scene.noise_free, scene.illuminance) == (False, None)
        assert scene.camera.model.endswith("S40")
    with pytest.raises(ValueError, match="at most 8"):
        load(data_dir / "canon_crw_cc0", "train")
