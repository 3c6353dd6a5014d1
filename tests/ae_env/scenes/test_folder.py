"""A user's files: raws and maps with bad ones among them, groups and splits, recorded sequences."""

import logging
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ae_env.scenes import load_scenes
from ae_env.scenes.folder import Shot, group_shots, sequence_bounds, split_groups
from simulator import CameraSettings, RawImage, get_camera, write_dng
from tests.ae_env.environments import check_parity, make_env
from tests.ae_env.scene_files import load, write_hdr

CAMERA = get_camera("nikon_z6")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Four raws, ``good1.dng`` to ``good4.dng``."""
    data = torch.rand(4, 16, 16, generator=torch.Generator().manual_seed(0))
    for i in range(1, 5):
        write_dng(tmp_path / f"good{i}.dng", RawImage(data, CameraSettings(100, 0.01, 4), CAMERA))
    return tmp_path


def test_bad_files_stop_or_are_skipped_with_a_reason(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "ae_env.scenes")
    for i in range(7):
        (folder / f"bad{i}.dng").write_bytes(b"" if i % 2 else b"some words")
    (folder / "good1.hdr").write_bytes(b"")
    with pytest.raises(ValueError, match=r"scene file '.*bad0\.dng': .*'skip'"):
        load(folder)
    assert f"reading 12 scene files of {folder}" in caplog.text  # before it fails
    scenes = load(folder, on_error="skip")
    assert [s.scene_id for s in scenes] == ["good1.dng", "good2", "good3", "good4"]
    (line,) = (r.getMessage() for r in caplog.records if "skipped" in r.getMessage())
    assert "8 of 12 scene files skipped" in line
    assert "bad0.dng" in line
    assert line.endswith("and 3 more)")


def test_nothing_left_is_an_error(tmp_path: Path) -> None:
    for name in "ab":
        (tmp_path / f"{name}.dng").write_bytes(b"")
    with pytest.raises(ValueError, match=r"all 2 were skipped \(a\.dng: "):
        load(tmp_path, on_error="skip")
    with pytest.raises(ValueError, match=r"a\.dng") as caught:
        load(tmp_path / "a.dng")
    assert "skip" not in str(caught.value)  # which would not help with one file


def test_a_black_frame_stops_or_is_skipped(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    settings = CameraSettings(100, 0.01, 4)
    write_dng(folder / "black.dng", RawImage(torch.zeros(4, 64, 64), settings, CAMERA))
    with pytest.raises(ValueError, match=r"scene file '.*black\.dng': `light` is 0 .*'skip'"):
        load(folder)
    scenes = load(folder, on_error="skip")
    assert [s.scene_id for s in scenes] == ["good1", "good2", "good3", "good4"]
    assert "1 of 5 scene files skipped (black.dng: `light` is 0" in caplog.text
    assert len(load(folder, illuminance=100.0)) == 5  # then its exposure is known


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"on_error": "skp"}, r"`on_error` \(='skp'\).*'stop', 'skip'; did you mean 'skip'"),
        ({"on_eror": "skip"}, "did you mean 'on_error'"),
        ({"illuminance": -1.0}, "`illuminance`"),
        ({"hard": 1}, "`hard`"),
        ({"kind": 3}, "`kind`"),
        ({"ev100": "bright"}, "`ev100`"),
    ],
)
def test_options_are_refused_before_anything_is_read(
    options: dict[str, Any], words: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=words):
        load(tmp_path / "is not there", **options)


def test_options_reach_the_scenes(tmp_path: Path) -> None:
    write_hdr(tmp_path / "a.hdr", 0)
    write_hdr(tmp_path / "b.hdr", 1)
    options = {"illuminance": {"a.hdr": 250.0}, "kind": "mine", "hard": True}
    a, b = load(tmp_path, median_speed=0.5, **options)
    assert (a.illuminance, b.illuminance) == (250.0, None)
    assert {(s.kind, s.hard, s.median_speed) for s in (a, b)} == {("mine", True, 0.5)}
    (only,) = load(tmp_path / "b.hdr", ev100=8.0)
    assert only.ev100 == pytest.approx(8.0, abs=0.05)


#: Signal, ISO and exposure time of each frame; the light is that of signal / (ISO time), the same
#: in the first and the second, twice that in the third.
FRAMES = ((0.1, 100, 1 / 64), (0.2, 200, 1 / 64), (0.2, 100, 1 / 64))


NAMES = ("IMG_2", "IMG_9", "IMG_10")


#: ISO 100, 1/60 s, f/8 in a grid of one state.
GRID = {"isos": [100, 200], "exposure_times": [1 / 64], "f_numbers": [8]}


ARGUMENTS: dict[str, Any] = {"split": "test", "resolution": 36, "grid": GRID, "simulator": None}


STILL = {"motion": "none", "depth": "far"}


def _write(recorded: Path, scale: float = 1.0) -> None:
    recorded.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    texture = 1.0 + 0.1 * rng.standard_normal((4, 36, 40)).astype(np.float32)
    for name, (signal, iso, time) in zip(NAMES, FRAMES, strict=True):
        raw = RawImage(scale * signal * texture, CameraSettings(iso, time, 8.0), CAMERA)
        write_dng(recorded / f"{name}.dng", raw)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    base = tmp_path_factory.mktemp("recorded")
    _write(base / "street")
    _write(base / "yard" / "day", scale=0.5)
    return base


def _env(path: Path, **arguments: Any) -> Any:
    return make_env(scenes={"sequence": str(path)}, **ARGUMENTS, **STILL, **arguments).unwrapped


def _signal(observation: dict[str, np.ndarray]) -> float:
    return float(observation["raw"].mean())


def test_frame_t_shows_raw_t_and_the_last_one_stays(recorded: Path) -> None:
    env = _env(recorded / "street", noise=False, observation="linear")
    observation, info = env.reset(seed=0, options={"state": 0})
    shown = [(info["scene_id"], _signal(observation))]
    for _ in range(4):
        observation, _, _, _, info = env.step(0)
        shown.append((info["scene_id"], _signal(observation)))
    assert [name for name, _ in shown] == [*NAMES, NAMES[-1], NAMES[-1]]
    # Light is absolute through each raw's own settings.
    assert [s for _, s in shown] == pytest.approx([0.1, 0.1, 0.2, 0.2, 0.2], rel=5e-3)
    assert _signal(env.step(1)[0]) == pytest.approx(0.4, rel=5e-3)
    for frame, name in ((1, "IMG_9"), (2, "IMG_10"), (77, "IMG_10")):
        assert env.reset(seed=0, options={"frame": frame})[1]["scene_id"] == name


def test_folders_are_sequences_and_source_groups(recorded: Path) -> None:
    env = _env(recorded)
    assert [s.scene_id for s in env.scenes] == ["street/IMG_2", "yard/day/IMG_2"]
    assert [s.group for s in env.scenes] == ["street", "yard/day"]
    scenes = load({"sequence": recorded})
    assert [s.group for s in scenes] == ["street"] * 3 + ["yard/day"] * 3
    first, last = sequence_bounds(scenes)
    assert first.tolist() == [0, 0, 0, 3, 3, 3]
    assert last.tolist() == [2, 2, 2, 5, 5, 5]
    for wanted in ("yard/day", "yard/day/IMG_2", 1):
        info = env.reset(options={"scene": wanted, "frame": 1})[1]
        assert info["scene_id"] == "yard/day/IMG_9"
    with pytest.raises(ValueError, match=r"`options\['scene'\]` \(='street/IMG_9'\)"):
        env.reset(options={"scene": "street/IMG_9"})
    drawn = {env.reset(seed=i)[1]["scene_id"] for i in range(20)}
    assert drawn == {"street/IMG_2", "yard/day/IMG_2"}


@pytest.mark.parametrize(
    ("folders", "groups"),
    [
        (("", "rec"), {".", "rec"}),
        (("", "other"), {"rec", "other"}),
        (("rec", "other/rec"), {"rec", "other/rec"}),
    ],
)
def test_recordings_of_one_name_are_apart(
    tmp_path: Path, folders: tuple[str, str], groups: set[str]
) -> None:
    for folder in folders:
        _write(tmp_path / "rec" / folder)
    env = _env(tmp_path / "rec")
    assert {s.group for s in env.scenes} == groups
    for group in groups:
        env.reset(seed=0, options={"scene": group})
        shown = [env.step(0)[4]["scene_id"] for _ in range(3)]
        place = f"{group}/" if group in folders else ""
        assert shown == [f"{place}{name}" for name in (*NAMES[1:], NAMES[-1])]


def test_a_broken_frame_is_an_error(tmp_path: Path) -> None:
    """Without it all later ones would come too early, so nothing proposes to skip it."""
    _write(tmp_path)
    (tmp_path / "IMG_3.dng").write_bytes(b"II*\0")
    with pytest.raises(ValueError, match=r"scene file '.*IMG_3\.dng'") as caught:
        load({"sequence": tmp_path})
    assert "skip" not in str(caught.value)


def test_scores_are_those_of_the_frame(recorded: Path) -> None:
    """The third raw has twice the light: ISO 100 there scores what ISO 200 does before."""
    env = _env(recorded / "street", scorer="brightness", with_oracle=True)
    env.reset(seed=0, options={"state": 0})
    before = env.expected_scores()
    after = [env.step(0) for _ in range(2)][-1]
    scores = env.expected_scores()
    scene = env.core.scenes[2]
    # Unknown light: the right exposure has the mean of green at 0.12.
    stops = np.log2([0.2 / 0.12, 0.4 / 0.12])
    np.testing.assert_allclose(scores, np.exp(1 - np.sqrt(1 + stops**2)), rtol=5e-3)
    assert scene.scene_id == after[4]["scene_id"] == "IMG_10"
    assert after[1] == pytest.approx(scores[0], abs=1e-9)
    assert before[0] > scores[0]


@pytest.mark.parametrize("extra", [{"delay": 1}, {"lighting": "flicker", **STILL}])
def test_many_at_once_are_as_single_ones(recorded: Path, extra: dict[str, Any]) -> None:
    arguments = {"scenes": {"sequence": str(recorded)}, **ARGUMENTS, "with_oracle": True, **extra}
    check_parity(8, 4, max_episode_steps=4, **arguments)


@pytest.mark.parametrize(
    ("spec", "split", "message"),
    [
        ({"sequence": "{}"}, "train", "needs at least 15 source groups"),
        ({"sequence": "{}/none"}, "test", "must name an existing file, folder or glob"),
        ({"sequence": 3}, "test", "must have a 'path' or a 'sequence'"),
        ({"sequence": "{}", "path": "{}"}, "test", "`scenes`"),
        ({"sequence": "{}", "on_error": "skip"}, "test", r"`on_error` \(='skip'\) must be 'stop'"),
        ({"sequence": "{}", "hrad": True}, "test", "did you mean 'hard'"),
        ({"path": "recorded:{}"}, "test", "must be raws or radiance maps here, not a recorded"),
        ({"sequence": "bundled:snow"}, "test", "give the name 'bundled:snow' itself"),
    ],
)
def test_bad_sequences_are_refused(
    recorded: Path, spec: dict[str, Any], split: Any, message: str
) -> None:
    named = {k: v.format(recorded) if isinstance(v, str) else v for k, v in spec.items()}
    with pytest.raises(ValueError, match=message):
        load_scenes(named, split, camera=CAMERA, resolution=36)


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
    # In the order of their times, not of their names.
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
