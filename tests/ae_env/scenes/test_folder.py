"""A user's files: raws and maps with bad ones among them, groups and splits, recorded sequences."""

import logging
import os
import struct
from datetime import datetime, timedelta

import numpy as np
import pytest
import torch

from ae_env.scenes import load_scenes
from ae_env.scenes.folder import Shot, group_shots, radiance_scenes, sequence_bounds, split_groups
from ae_env.scenes.scene import SceneRequest
from simulator import CameraSettings, RawImage, get_camera, write_dng
from simulator.radiance.maps import assumed_ev100, perspective
from simulator.radiance.reading import read_radiance
from tests.ae_env.environments import check_parity, make_env
from tests.ae_env.scene_files import load, write_exr, write_hdr

CAMERA = get_camera("nikon_z6")


def test_bad_files_stop_or_are_skipped_with_a_reason(tmp_path, caplog):
    caplog.set_level(logging.INFO, "ae_env.scenes")
    data = torch.rand(4, 16, 16, generator=torch.Generator().manual_seed(0))
    for name, light in (("good1", data), ("good2", data), ("black", data * 0)):
        settings = CameraSettings(100, 0.01, 4)
        write_dng(tmp_path / f"{name}.dng", RawImage(light, settings, CAMERA))
    with pytest.raises(ValueError, match=r"scene file '.*black\.dng': `light` is 0 .*'skip'"):
        load(tmp_path)
    assert [s.scene_id for s in load(tmp_path, on_error="skip")] == ["good1", "good2"]
    assert "1 of 3 scene files skipped (black.dng: `light` is 0" in caplog.text
    assert len(load(tmp_path, illuminance=100.0)) == 3  # then its exposure is known
    bad = [tmp_path / f"bad{i}.dng" for i in range(7)]
    for i, file in enumerate(bad):
        file.write_bytes(b"" if i % 2 else b"some words")
    (tmp_path / "good1.hdr").write_bytes(b"")
    caplog.clear()
    scenes = load(tmp_path, on_error="skip", illuminance=100.0)
    assert [s.scene_id for s in scenes] == ["black", "good1.dng", "good2"]
    (line,) = (r.getMessage() for r in caplog.records if "skipped" in r.getMessage())
    assert "8 of 11 scene files skipped" in line
    assert line.endswith("and 3 more)")
    with pytest.raises(ValueError, match=r"bad1\.dng") as caught:
        load(bad[1])
    assert "skip" not in str(caught.value)  # which would not help with one file


def test_options_reach_the_scenes(tmp_path):
    write_hdr(tmp_path / "a.hdr", 0)
    write_hdr(tmp_path / "b.hdr", 1)
    options = {"illuminance": {"a.hdr": 250.0}, "kind": "mine", "hard": True}
    a, b = load(tmp_path, median_speed=0.5, **options)
    assert (a.illuminance, b.illuminance) == (250.0, None)
    assert {(s.kind, s.hard, s.median_speed) for s in (a, b)} == {("mine", True, 0.5)}
    (only,) = load(tmp_path / "b.hdr", ev100=8.0)
    assert only.incident_light.reflected_ev100 == pytest.approx(8.0, abs=0.05)
    with pytest.raises(ValueError, match=r"`settings`.* has none"):
        load(tmp_path / "b.hdr", settings={"iso": 100})
    with pytest.raises(ValueError, match=r"`illuminance` names 'c\.hdr'"):
        load(tmp_path, illuminance={"a.hdr": 250.0, "c.hdr": 250.0})


#: Signal, ISO and exposure time of each frame; the light is that of signal / (ISO time), the same
#: in the first and the second, twice that in the third.
FRAMES = ((0.1, 100, 1 / 64), (0.2, 200, 1 / 64), (0.2, 100, 1 / 64))
NAMES = ("IMG_2", "IMG_9", "IMG_10")
#: ISO 100, 1/60 s, f/8 in a grid of one state.
GRID = {"isos": [100, 200], "exposure_times": [1 / 64], "f_numbers": [8]}
ARGUMENTS = {"split": "test", "resolution": 36, "grid": GRID, "simulator": None}
STILL = {"motion": "none", "depth": "far"}


def _write(recorded, scale=1.0):
    recorded.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    texture = 1.0 + 0.1 * rng.standard_normal((4, 36, 40)).astype(np.float32)
    for name, (signal, iso, time) in zip(NAMES, FRAMES, strict=True):
        raw = RawImage(scale * signal * texture, CameraSettings(iso, time, 8.0), CAMERA)
        write_dng(recorded / f"{name}.dng", raw)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    base = tmp_path_factory.mktemp("recorded")
    _write(base / "street")
    _write(base / "yard" / "day", scale=0.5)
    return base


def _env(path, **arguments):
    return make_env(scenes={"sequence": str(path)}, **ARGUMENTS, **STILL, **arguments).unwrapped


def test_frame_t_shows_raw_t_and_the_last_one_stays(recorded):
    env = _env(recorded / "street", noise=False, observation="linear")
    frames = [env.reset(seed=0, options={"state": 0})]
    frames += [env.step(0)[::4] for _ in range(4)]
    frames.append(env.step(1)[::4])
    assert [info["scene_id"] for _, info in frames] == [*NAMES, *NAMES[-1:] * 3]
    # Light is absolute through each raw's own settings.
    signals = [float(observation["raw"].mean()) for observation, _ in frames]
    assert signals == pytest.approx([0.1, 0.1, 0.2, 0.2, 0.2, 0.4], rel=5e-3)
    for frame, name in ((1, "IMG_9"), (2, "IMG_10"), (77, "IMG_10")):
        assert env.reset(seed=0, options={"frame": frame})[1]["scene_id"] == name
    # Scores are of the frame: with twice the light ISO 100 scores what ISO 200 did before.
    env = _env(recorded / "street", scorer="brightness", with_oracle=True)
    env.reset(seed=0, options={"state": 0})
    after = [env.step(0) for _ in range(2)][-1]
    scores = env.expected_scores()
    # Unknown light: the mean over what is likely, given the frame that is shown.
    stops = env.core.scenes[2].incident_light.right_ev100 - env.grid.ev100[:, None]
    expected = np.exp(1 - np.sqrt(1 + stops**2)).mean(axis=1)
    np.testing.assert_allclose(scores, expected, rtol=5e-3)
    assert env.core.scenes[2].scene_id == after[4]["scene_id"] == "IMG_10"
    assert after[1] == pytest.approx(scores[0], abs=1e-9)


def test_folders_are_sequences_and_source_groups(tmp_path, recorded):
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
    with pytest.raises(ValueError, match="needs at least 15 source groups"):
        load({"sequence": recorded}, "train")
    # Without a broken frame all later ones would come too early: nothing proposes to skip it.
    _write(tmp_path)
    (tmp_path / "IMG_9.dng").write_bytes(b"II*\0")
    with pytest.raises(ValueError, match=r"scene file '.*IMG_9\.dng'") as caught:
        load({"sequence": tmp_path})
    assert "skip" not in str(caught.value)


@pytest.mark.parametrize(
    ("folders", "groups"),
    [
        *((("", "rec"), {".", "rec"}), (("", "other"), {"rec", "other"})),
        (("rec", "other/rec"), {"rec", "other/rec"}),
    ],
)
def test_recordings_of_one_name_are_apart(tmp_path, folders, groups) -> None:
    for folder in folders:
        _write(tmp_path / "rec" / folder)
    scenes = load({"sequence": tmp_path / "rec"})
    assert {s.group for s in scenes} == groups
    for group in groups:
        place = f"{group}/" if group in folders else ""
        shown = [scene.scene_id for scene in scenes if scene.group == group]
        assert shown == [f"{place}{name}" for name in NAMES]


def test_many_at_once_are_as_single_ones(recorded):
    arguments = {"scenes": {"sequence": str(recorded)}, "with_oracle": True, "delay": 1}
    check_parity(8, 4, max_episode_steps=4, lighting="flicker", **arguments, **ARGUMENTS, **STILL)


def test_a_large_folder_is_split_by_group_and_stays_so(tmp_path, caplog) -> None:
    names = [f"subject{i}/{name}" for i in range(15) for name in "ab"]
    for name in names[:28]:
        write_hdr(tmp_path / f"{name}.hdr")
    with pytest.raises(ValueError, match=r"at least 15 source groups.*has 14"):
        load(tmp_path, "train")
    for name in names[28:]:
        write_hdr(tmp_path / f"{name}.hdr")
    train, test, both = (load(tmp_path, split) for split in ("train", "test", "all"))
    assert {s.group for s in train}.isdisjoint(s.group for s in test)
    assert sorted(s.scene_id for s in train + test) == sorted(names)
    assert sorted(s.scene_id for s in both) == sorted(names)
    for part, split in ((train, "train"), (test, "test")):
        count = 15 - len({s.group for s in part})
        assert 0 < count < 15
        assert f"split '{split}' leaves out {count} of 15 source groups" in caplog.text
    names = [f"g{i}" for i in range(200)]
    split = split_groups(names)
    assert 0.6 < np.mean([split[n] == "train" for n in names]) < 0.8
    assert split_groups([*names, "new"]).items() > split.items()
    assert set(split_groups(names[:14]).values()) == {"test"}
    for start in range(180):
        assert set(split_groups(names[start : start + 15]).values()) == {"train", "test"}


def test_groups_file_names_the_groups(tmp_path):
    for name in ("a", "b", "c"):
        write_hdr(tmp_path / f"{name}.hdr")
    (tmp_path / "groups.csv").write_text("file,group\na.hdr,first\nb.hdr,first\n")
    assert [s.group for s in load(tmp_path)] == ["first", "first", "c"]
    for content, words in (
        (b"name,group\na.hdr,x\n", r"columns \['name', 'group'\]"),
        (b"file,group\nz.hdr,x\n", "line 2"),
        (b"file,group\na.hdr,\n", "line 2"),
        (b"file,grop\n", "`group`"),  # without rows, too
        (b"\xff\xfe\0", r"groups\.csv' must be a CSV file in UTF-8"),
        (b'file,group\n"' + b"x" * 200_000, r"groups\.csv' must be a CSV file in UTF-8"),
    ):
        (tmp_path / "groups.csv").write_bytes(content)
        with pytest.raises(ValueError, match=words):
            load(tmp_path)


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


@pytest.mark.slow
@pytest.mark.real_data
def test_real_raws_are_three_subjects(data_dir, caplog):
    caplog.set_level(logging.INFO, "ae_env.scenes")
    folder = str(data_dir / "canon_crw_cc0" / "CRW_01[01][1-47]")
    scenes = load(f"{folder}*", "test", 64)
    groups = [s.group for s in scenes]
    assert [s.scene_id[-4:] for s in scenes] == ["0101", "0104", "0112", "0113", "0117"]
    assert (groups[0], groups[2], len(set(groups))) == (groups[1], groups[3], 3)
    assert "3 source groups" in caplog.text
    for scene in scenes:
        assert (scene.light.shape, scene.box_factor) == ((4, 64, 64), 13)
        assert (scene.noise_free, scene.illuminance) == (False, None)
        assert scene.camera.model.endswith("S40")
    with pytest.raises(ValueError, match="at most 5"):
        load(f"{folder}*", "train")
    one = folder.replace("[1-47]", "7") + "*"
    env = make_env(scenes=one, split="all", source="raw", resolution=64)  # as it is
    assert [s.reference for s in env.unwrapped.scenes] == [scenes[-1].reference]


HDR_HEAD = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n"


def directions(height: int) -> np.ndarray:
    """Panorama whose colour is the viewing direction: right, up, ahead, each as (n + 1) / 2."""
    latitude = np.pi * (0.5 - (np.arange(height) + 0.5) / height)[:, None]
    longitude = np.pi * ((np.arange(2 * height) + 0.5) / height - 1.0)[None, :]
    ray = [np.cos(latitude) * np.sin(longitude), np.sin(latitude) + 0 * longitude]
    ray.append(np.cos(latitude) * np.cos(longitude))
    return ((np.stack(ray) + 1.0) / 2.0).astype(np.float32)


@pytest.mark.parametrize(("azimuth", "size"), [(0.0, 32), (90.0, 200), (180.0, 32), (270.0, 200)])
def test_perspective_is_a_pin_hole(azimuth: float, size: int) -> None:
    view = 2.0 * perspective(directions(256), azimuth, size, 60.0) - 1.0
    view /= np.linalg.norm(view, axis=0)
    axis = np.tan(np.radians(30.0)) * ((np.arange(size) + 0.5) / size * 2.0 - 1.0)
    right, up = np.meshgrid(axis, -axis)
    turn = np.radians(azimuth)
    ahead = np.cos(turn) - right * np.sin(turn)
    ray = np.stack([right * np.cos(turn) + np.sin(turn), up, ahead])
    ray /= np.linalg.norm(ray, axis=0)
    assert np.abs(view - ray).max() < 2e-3


def test_exr_is_read_and_cleaned(tmp_path, caplog):
    image = np.random.default_rng(0).uniform(0.0, 5.0, (6, 8, 3)).astype(np.float32)
    write_exr(tmp_path / "a.exr", image)
    np.testing.assert_array_equal(read_radiance(tmp_path / "a.exr"), image.transpose(2, 0, 1))
    assert not caplog.records
    image[0, 0], image[1, 1], image[2, 2] = np.nan, -1.0, np.inf
    write_exr(tmp_path / "a.exr", image)
    caplog.set_level(logging.INFO)
    image[0, 0], image[1, 1], image[2, 2] = 0.0, 0.0, np.max(image, where=image < 9, initial=0)
    np.testing.assert_array_equal(read_radiance(tmp_path / "a.exr"), image.transpose(2, 0, 1))
    assert "3 NaN and 3 negative values set to 0, 3 infinite" in caplog.text


def test_views_of_a_panorama_share_one_scale(tmp_path):
    panorama = np.ones((64, 128, 3), np.float32)
    panorama[:, 48:80] = 4.0  # ahead (90 degrees wide) is four times as bright: 2 EV
    write_exr(tmp_path / "p.exr", panorama)
    request = SceneRequest("all", CAMERA, 32)
    scenes = list(radiance_scenes(tmp_path / "p.exr", request, name="p", group="p"))
    assert [s.scene_id for s in scenes] == ["p-000", "p-090", "p-180", "p-270"]
    assert {s.group for s in scenes} == {"p"}
    ev = [s.incident_light.reflected_ev100 for s in scenes]
    assert ev[0] - ev[1] == pytest.approx(2.0, abs=0.05)
    assert np.mean(ev) == pytest.approx(assumed_ev100("p"), abs=0.05)
    assert all(s.illuminance is None and s.noise_free and s.box_factor == 8 for s in scenes)


def test_maps_are_sampled_where_they_have_the_photosites(tmp_path, caplog):
    """Rows of one pixel, green and dark in turn: G1, beside red, differs from G2."""
    still = np.ones((520, 520, 3), np.float32)
    still[::2] = 0.2
    write_exr(tmp_path / "fine.exr", still)
    write_exr(tmp_path / "coarse.exr", still[:200, :200])
    panorama = np.ones((256, 512, 3), np.float32)  # 94 photosites in 60 degrees
    write_exr(tmp_path / "wide.exr", panorama)
    caplog.set_level(logging.INFO)
    for name, crop, resolution, sampled, k in (
        *(("fine", "box", 64, True, 4), ("fine", "native", 64, True, 1)),
        *(("coarse", "box", 64, False, 3), ("coarse", "native", 64, True, 1)),
        *(("coarse", "native", 128, False, 1), ("wide", "native", 48, False, 1)),
        *(("wide", "native", 40, True, 1), ("wide", "box", 40, False, 6)),
    ):
        caplog.clear()
        request = SceneRequest("all", CAMERA, resolution, crop)
        scene, *_ = radiance_scenes(tmp_path / f"{name}.exr", request, name=name, group=name)
        assert (scene.sampled, scene.box_factor) == (sampled, k)
        assert scene.light.shape == (4, resolution, resolution)
        assert ("planes share their places" in caplog.text) != sampled
        assert torch.equal(scene.light[1], scene.light[2]) == (not sampled or name == "wide")
        if name == "fine":  # a lens of half a photosite leaves 0.57 of such a contrast
            ratio = float(scene.light[1].mean() / scene.light[2].mean())
            wanted = (0.6 + 0.4 * 0.57) / (0.6 - 0.4 * 0.57)
            assert max(ratio, 1 / ratio) == pytest.approx(wanted, rel=0.01)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.hdr", b"", "complete"),
        *(
            ("a.hdr", HDR_HEAD + size + b"\n" + 16 * 32 * b"\x80\x80\x80\x80", words)
            for size, words in (
                (b"-Y 60000 +X 60000", "claims 60000 x 60000 pixels"),
                (b"-Y 8000 +X 8000", "claims 8000 x 8000 pixels in .* 64 a byte"),
                (b"-Y 17 +X 32", "complete"),
            )
        ),
        ("a.exr", (60_000, 60_000), "claims 60000 x 60000"),
        ("a.exr", (4_000, 4_000), "claims .*8192 a byte"),
    ],
)
def test_errors_name_the_file(tmp_path, name, content, words, capfd):
    pytest.importorskip("cv2")
    if isinstance(content, tuple):  # the size that the header of a small file claims
        write_exr(tmp_path / name, np.ones((32, 64)))
        sides, content = content, bytearray((tmp_path / name).read_bytes())
        corner = content.index(b"dataWindow\0box2i\0") + 29
        struct.pack_into("<2i", content, corner, *(side - 1 for side in sides))
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=rf"{name}.*{words}"):
        read_radiance(tmp_path / name)
    assert capfd.readouterr() == ("", "")  # of the libraries


@pytest.mark.parametrize("scale", [2.0**-100, 2.0**110])
def test_the_scale_of_a_map_does_not_matter(tmp_path, scale):
    image = np.random.default_rng(0).uniform(0.1, 4.0, (32, 32)).astype(np.float32)
    scenes = []
    for folder, factor in (("a", 1.0), ("b", scale)):
        (tmp_path / folder).mkdir()
        write_exr(tmp_path / folder / "map.exr", image * factor)
        own = (tmp_path / folder).rename(tmp_path / os.fsdecode(folder.encode() + b"\xff"))
        scenes += load_scenes(own, "all", camera=CAMERA, resolution=8)
    first, second = scenes
    assert second.ev100 == pytest.approx(first.ev100, abs=1e-6)
    torch.testing.assert_close(second.light, first.light, rtol=1e-5, atol=0.0)
