"""Real captures as scenes and environments: which file is which state, what is shown, bad input."""

import os
import pickle
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from ae_env.episodes.lookup import nearest_recorded
from ae_env.grid import ExposureGrid
from ae_env.observation import encode_observation
from ae_env.scenes import Scene, load_scenes, recorded
from ae_env.scenes.load import _LOADED
from simulator import CameraSettings, exposure_ratio, get_camera, read_raw
from simulator.raw.develop import develop
from simulator.reference.reference_camera import ReferenceCamera
from tests.ae_env import scene_files
from tests.ae_env.environments import ID, check_parity, make_env
from tests.ae_env.scene_files import GRID, capture, write_picture, write_raws, write_states
from tests.simulator.training.scenes import scene as reference_scene

CAMERA = get_camera("nikon_z6")
load = partial(load_scenes, split="all", camera=CAMERA, resolution=None)


def test_raws_are_shown_as_they_are_and_pictures_developed_back(tmp_path: Path) -> None:
    write_raws(tmp_path / "desk")
    (scene,) = load(f"recorded:{tmp_path}?iso=50")  # what the files state comes first
    assert scene.allowed.all()
    assert (scene.kind, scene.group, scene.sequence) == ("recorded", "desk", "")
    for state in range(len(GRID)):
        raw = read_raw(tmp_path / "desk" / f"IMG_{state:04d}.dng")
        torch.testing.assert_close(scene.recorded[state], raw.data, rtol=0.0, atol=0.0)
    # Averaged as any scene is: every capture by itself.
    (small,) = load(f"recorded:{tmp_path}", resolution=20)
    expected = scene.recorded.reshape(8, 4, 20, 2, 20, 2).mean(dim=(3, 5))
    torch.testing.assert_close(small.recorded, expected, rtol=0.0, atol=1e-6)
    assert small.box_factor == 2
    body = recorded.RecordedOptions(tmp_path).camera(get_camera("canon_70d"))  # that of the raws
    assert body.black_level == CAMERA.black_level
    for iso in (100.0, 1600.0):  # a DNG states one pair of numbers for both greens
        np.testing.assert_allclose(body.nlf_by_iso[iso].shot, CAMERA.nlf(iso).shot, rtol=0.02)
    for settings in GRID:
        name = f"iso{settings.iso:.0f}_1-{1 / settings.exposure_time:.0f}s_f{settings.f_number:g}"
        write_picture(tmp_path / "shown" / f"{name}.png", settings)
    (scene,) = load(f"recorded:{tmp_path / 'shown'}")
    pictures = [Image.open(path) for path in sorted((tmp_path / "shown").iterdir())]
    sums = {np.asarray(picture).astype(int).sum() for picture in pictures}
    developed = develop(scene.recorded, scene.white_balance, scene.camera.colour_matrix)
    shown = (developed * 255.0).round().int()
    assert {int(rgb.sum()) for rgb in shown} == sums  # the same codes as in the files
    assert scene.camera.nlf(100) == CAMERA.nlf(100)


def test_the_light_is_that_of_all_captures(tmp_path: Path) -> None:
    """The oracle's exposure rests on it: it has less noise than any capture."""
    grid = ExposureGrid((100, 1600), (1 / 1000, 1 / 250), (8,))
    write_raws(tmp_path / "desk", tuple(grid))
    (scene,) = load(f"recorded:{tmp_path}")
    assert scene.nlf.is_zero
    body, photographed = ReferenceCamera(CAMERA), reference_scene("s0", size=40, seed=0)
    errors = []
    for number, settings in enumerate(grid):
        truth = body.capture(photographed, settings, 0).mean
        alpha = exposure_ratio(settings, scene.reference)
        errors.append(float((scene.recorded[number] - truth).std()) * alpha)
    merged = float((scene.light - truth * alpha).std())
    assert merged < 0.9 * min(errors)


def test_pictures_by_exif_and_by_table(tmp_path: Path) -> None:
    for number, settings in enumerate(GRID):
        picture = tmp_path / "exif" / f"IMG_{number}.jpg"
        write_picture(picture, settings, exif=("iso", "exposure_time", "f_number"))
        write_picture(tmp_path / "a" / f"{number}.jpg", settings, exif=("exposure_time", "iso"))
    write_states(tmp_path / "table", seeds=(0,))
    (by_exif,), (by_table,) = (load(f"recorded:{tmp_path / n}") for n in ("exif", "table"))
    assert (by_exif.scene_id, by_table.scene_id) == ("exif", "l1/n00000000/val_0")
    torch.testing.assert_close(by_exif.recorded, by_table.recorded, rtol=0.0, atol=0.0)
    # They complete each other.
    rows = [f"{number}.jpg,f{settings.f_number:g}" for number, settings in enumerate(GRID)]
    (tmp_path / "a" / "settings.csv").write_text("\n".join(["file,aperture", *rows]))
    files = recorded.index_recorded(tmp_path / "a", {})
    assert [f.scene for f in files] == ["a"] * 8
    assert recorded.recorded_grid(files) == GRID
    stated = Image.Exif()
    stated[ExifTags.Base.Make] = "Canon"  # whose cameras record the stop that is marked
    stated.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.ExposureTime] = IFDRational(1, 60)
    Image.new("RGB", (8, 8)).save(tmp_path / "a" / "60.jpg", exif=stated)
    assert recorded._in_file(tmp_path / "a" / "60.jpg") == {"exposure_time": 1 / 64}
    # Nominal and exact values are one state.
    grid = ExposureGrid((100,), (1 / 128, 1 / 64), (2.8, 5.6))
    assert recorded.state_of(CameraSettings(100, 1 / 125, 5.6569), grid) == 1
    assert recorded.state_of(CameraSettings(100, 1 / 60, 5.6), grid) is None  # 6.7 % off
    assert recorded.state_of(CameraSettings(200, 1 / 64, 5.6), grid) is None


def test_states_without_a_capture_are_forbidden_and_said(raws, caplog) -> None:
    a, b = load(f"recorded:{raws}")
    assert a.allowed.all()
    assert np.flatnonzero(~b.allowed).tolist() == [*HOLES]
    assert len(b.recorded) == len(GRID) - len(HOLES)  # what is not there takes no memory
    (message,) = caplog.messages
    assert "1 of 2 recorded scenes lack states" in message
    assert "'b' lacks 2 of 8, the first is ISO 1600, 1/1000 s, f/8" in message
    # A grid of one's own leaves out what it does not have.
    (a, b) = load(f"recorded:{raws}", grid=ExposureGrid((100, 1600), (1 / 1000,), (4,)))
    assert a.recorded.shape[0] == b.recorded.shape[0] == 2
    torch.testing.assert_close(a.recorded[1], capture(GRID[4]).data)


def only_one_state(path: Path) -> None:
    for number in (1, 2, *range(4, 9)):
        shutil.rmtree(path.parents[2] / f"param_{number}")


def only_16_bits(path: Path) -> None:
    path.unlink()
    Image.fromarray(np.full((32, 40), 30000, np.uint16)).save(path.with_suffix(".png"))


def bomb(side: int, path: Path) -> None:
    Image.new("1", (side, side)).save(path.with_suffix(".png"))  # some kB
    path.unlink()


def link(path: Path) -> None:
    path.unlink()
    path.symlink_to("nowhere.JPEG")


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda file: os.truncate(file, 300), r"'.*param_3.*val_1.JPEG' cannot be read: "),
        (lambda file: shutil.copy(file, file.with_suffix(".png")), "l1/n00000001/val_1' must have"),
        (lambda file: Image.new("RGB", (44, 40)).save(file), r"val_1.JPEG' \(\(40, 44\) packed"),
        (lambda file: (file.parents[3] / "grid-options-2x2x2.csv").unlink(), "val_0.JPEG"),
        (only_16_bits, r"val_1.png' cannot be read: it must have 8 bits a sample, not mode 'I;16'"),
        (partial(bomb, 4200), r"val_1.png' cannot be read: it claims 4200 x 4200 pixels in \d+ "),
        (partial(bomb, 9500), r"val_1.png' cannot be read: it has 9500 x 9500 pixels"),
        (partial(bomb, 14000), r"val_1.png' cannot be read: Image size"),
        (link, r"val_1.JPEG' cannot be read: the link leads nowhere"),
        (lambda file: (file.unlink(), os.mkfifo(file)), "val_1.JPEG' cannot .* no ordinary file"),
        (None, r"`resolution` \(=64\).*val_0, ISO 100, 1/1000 s, f/4' has 40 x 40"),
        (only_one_state, "2 of 2 recorded scenes have fewer than two .*param_3"),
    ],
)
def test_bad_files_get_one_line_that_names_them(tmp_path, spoil, message):
    write_states(tmp_path)
    if spoil:
        spoil(tmp_path / "l1" / "param_3" / "n00000001" / "val_1.JPEG")
    with pytest.raises(ValueError, match=message) as error:
        load(f"recorded:{tmp_path}", resolution=None if spoil else 64)
    assert "\n" not in str(error.value)


def touch(folder: Path, *names: str) -> Path:
    """Files whose names say everything: nothing in them is read."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("settings.csv", "a,b\n1,2", "column file"),
        ("settings.csv", "file,iso\nx,many", "line 2"),
        ("settings.csv", "a link to /dev/zero", "no ordinary file"),
        *(("settings.csv", "idx,iso\nfirst,100", "line 2"), ("s.txt", "", "that has captures")),
        ("settings.csv", "file,iso\nx,100\nx,200", "one row for 'x'"),
        ("settings.csv", "file,iso\n\udcff,100", "CSV file in UTF-8"),
        (".hidden/iso1_1s_f1.png", "", "that has captures"),
        *(("1-8s/x.png", "", "its iso and f_number"), ("a.dng", "", r"a.dng': `path`")),
    ],
)
def test_folders_that_are_no_grid(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    if text.startswith("a link to "):
        (tmp_path / name).symlink_to(text.removeprefix("a link to "))
    else:
        (tmp_path / name).write_text(text, errors="surrogateescape")
    with pytest.raises(ValueError, match=message):
        recorded.index_recorded(tmp_path, {})


def test_options_and_how_many_states_a_grid_may_have(tmp_path: Path) -> None:
    options = recorded.RecordedOptions
    found = options.of("recorded:a/b?iso=100&exposure_time=1/8&f_number=f5.6")
    assert found == options(Path("a/b"), iso=100, exposure_time=0.125, f_number=5.6)
    names = [f"iso{i}_1-{i}s_f{i / 100}.png" for i in range(100, 1800, 100)]
    with pytest.raises(ValueError, match="4913 combinations; at most 4096"):
        recorded.recorded_grid(recorded.index_recorded(touch(tmp_path, *names), {}))


@pytest.mark.parametrize(
    ("name", "settings", "rest"),
    [
        ("iso100_1-125s_f4", (100, 1 / 125, 4), ""),
        ("desk_ISO-1600_0.5s_F5.6", (1600, 0.5, 5.6), "desk"),
        ("f2.8 iso50 8ms", (50, 0.008, 2.8), ""),
        ("250us", (None, 0.00025, None), ""),
        # An underscore parts words: it is no fraction's bar after one.
        ("frame_0007_0.5s_iso100_f4", (100, 0.5, 4), "frame_0007"),
        ("frame-1-8s", (None, 8, None), "frame-1"),
        ("IMG_0001_2s_f4", (None, 2, 4), "IMG_0001"),
        ("100iso_1-125s", (100, 1 / 125, None), ""),
        # Not settings: a class of ImageNet, a picture of it, words that begin with f or iso.
        ("n01443537", (None, None, None), "n01443537"),
        ("isolated_scene2_from_3steps", (None, None, None), "isolated_scene2_from_3steps"),
    ],
)
def test_settings_in_names(name: str, settings: tuple[float | None, ...], rest: str) -> None:
    names = ("iso", "exposure_time", "f_number")
    expected = {k: v for k, v in zip(names, settings, strict=True) if v is not None}
    found, left = recorded.settings_in_name(name)
    assert found == pytest.approx(expected)
    assert left == rest


def test_imagenet_es_and_video_stacks(tmp_path: Path) -> None:
    grid = ExposureGrid((200, 12800), (1 / 1250, 0.4), (5, 13))
    write_states(tmp_path, seeds=(3,), grid=grid)
    shutil.copytree(tmp_path / "l1", tmp_path / "l5")
    files = recorded.index_recorded(tmp_path, {})
    assert [f.scene for f in files] == [f"l{i}/n00000003/val_3" for i in (1, 5) for _ in range(8)]
    # Both lights of a picture stay on one side of a split.
    assert {f.group for f in files} == {"n00000003/val_3"}
    assert recorded.recorded_grid(files) == grid
    by_folder = {f.path.parts[-3]: f.settings for f in files}
    assert by_folder == {f"param_{i + 1}": s for i, s in enumerate(grid)}
    scene_files.write_video(tmp_path / "video", frames=11, times=("1-1000s", "1-60s"))
    scenes = load({"recorded": tmp_path / "video", "iso": 400, "f_number": 4})
    assert [s.scene_id for s in scenes] == [f"street/frame_{i:04d}" for i in range(11)]
    assert {(s.group, s.sequence) for s in scenes} == {("street", "street")}
    # Frames in the files' names are the same.
    flat = touch(tmp_path / "flat", *(f"v/frame_{i}_1-{t}s.png" for i in (9, 10) for t in (8, 15)))
    files = recorded.index_recorded(flat, {"iso": 400.0, "f_number": 4.0})
    assert [(f.sequence, f.frame) for f in files] == [("v", 9), ("v", 9), ("v", 10), ("v", 10)]


def test_pictures_of_16_bits_keep_them(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    codes = np.random.default_rng(0).integers(2000, 60000, (2, 36, 40, 3), np.uint16)
    tifffile.imwrite(tmp_path / "iso100_1s_f4.tif", codes[0], photometric="rgb")
    cv2.imwrite(str(tmp_path / "iso100_2s_f4.png"), codes[1][:, :, ::-1])
    (scene,) = load(f"recorded:{tmp_path}")
    shown = develop(scene.recorded, scene.white_balance, None).permute(0, 2, 3, 1).numpy()
    np.testing.assert_allclose(shown * 65535.0, codes, atol=1.0)  # 8 bits would be 257 apart


def test_grids_of_other_people(tmp_path: Path, caplog) -> None:
    """Bare numbers as folders, ground truth, shots at one setting, and what does not count."""
    for time, settings in ((1, GRID[0]), (8, GRID[2])):
        write_picture(tmp_path / "desk" / f"{time}.0" / "17.png", settings)
    write_picture(tmp_path / "desk" / "gt" / "17.png", GRID[0])
    write_picture(tmp_path / "desk" / "8.0" / "17_GT.png", GRID[0])
    write_picture(tmp_path / "walk" / "4.0" / "3.png", GRID[0])
    (tmp_path / "settings.csv").write_text("file,iso\ndesk/1.0,100\ngone.png,100\n")
    known = "iso=103&f_number=4&exposure_time=7"  # 103 counts as 100
    (scene,) = load(f"recorded:{tmp_path}?folder=exposure_ms&{known}")
    assert scene.scene_id == "desk/17"
    assert scene.recorded.shape[0] == len(scene.allowed) == 2  # 4 ms is no state
    truth, time, row, single = caplog.messages
    assert "ground truth is left out, 2 of 5 files" in truth
    assert "1 of 2 recorded scenes have fewer than two states" in single
    assert "`exposure_time` (=7): 3 of 3 files state another" in time
    assert "1 of 2 rows of tables name no file" in row
    options = recorded.RecordedOptions.of(
        f"recorded:{tmp_path}?folder=exposure_us&iso=1&f_number=4"
    )
    assert options.grid.exposure_times == (1e-6, 8e-6)
    with pytest.raises(ValueError, match=r"`folder` \(='ms'\) must be"):
        load(f"recorded:{tmp_path}?folder=ms")
    names = ["GT_SRGB_010", "0001_gt", "ground truth", "GroundTruth", "room-gt"]
    assert all(map(recorded._TRUTH.search, names))
    assert not any(map(recorded._TRUTH.search, ["gtx", "night", "length", "background"]))


#: States that scene "b" lacks: the brightest, and one with others as bright.
HOLES = (5, 6)


@pytest.fixture(scope="module")
def raws(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("raws")
    write_raws(folder / "a")
    write_raws(folder / "b", [s for i, s in enumerate(GRID) if i not in HOLES], seed=1)
    return folder


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    folder = tmp_path_factory.mktemp("video")
    scene_files.write_video(folder)
    return {"recorded": str(folder), "iso": 400, "f_number": 4}


def arguments(scenes, **more):
    spec = f"recorded:{scenes}" if isinstance(scenes, Path) else scenes
    return {"scenes": spec, "split": "test", **more}


def test_every_observation_is_the_capture(raws: Path) -> None:
    black = np.array(CAMERA.black_level)[:, None, None]
    span = np.array(CAMERA.span)[:, None, None]
    envs = {kind: make_env(**arguments(raws, observation=kind)) for kind in ("linear", "dn")}
    envs["uint8"] = make_env(**arguments(raws))
    for kind, env in envs.items():
        env.reset(seed=0, options={"scene": "a", "state": 0})
        for state in (3, 7, 0):
            observation, _, _, _, info = env.step(state)
            data = central(GRID[state], 0)
            expected = {
                "linear": data.clamp(-1 / 1024, 1.0).numpy(),
                "dn": np.rint(data.numpy() * span + black).astype(np.uint16),
                "uint8": encode_observation(data[None])[0].numpy(),
            }[kind]
            np.testing.assert_array_equal(observation["raw"], expected)
            assert (info["state"], info["modules"]) == (state, "recorded")
            assert info["clipped_high"] == pytest.approx(float((data >= 1.0).float().mean()))
            assert info["excess_noise"] == 0.0


def test_states_without_a_capture_are_masked_and_never_shown(raws: Path) -> None:
    base = make_env(**arguments(raws)).unwrapped
    assert base.action_space.n == len(GRID)
    for seed in range(8):  # no episode starts there
        _, info = base.reset(seed=seed, options={"scene": "b"})
        assert info["state"] not in HOLES
    assert np.flatnonzero(~base.action_masks()).tolist() == list(HOLES)
    # ISO 1600, 1/1000 s, f/8 is missing: ISO 100, 1/125 s, f/8 is a stop darker, others more off.
    for action, shown in ((5, 3), (6, 7)):
        observation, _, _, _, info = base.step(action)
        assert info["state"] == shown
        assert (info["iso"], info["exposure_time"]) == (GRID[shown].iso, GRID[shown].exposure_time)
        expected = encode_observation(central(GRID[shown], 1)[None])[0].numpy()
        np.testing.assert_array_equal(observation["raw"], expected)
    _, info = base.reset(seed=0, options={"scene": "b", "state": 5})
    assert info["state"] == 3
    # Of the 64 states those at f/4 and f/8 with ISO 100 or 1600 and 1/1000 or 1/125 s were taken.
    named = make_env(**arguments(raws, grid="default")).unwrapped
    assert named.action_space.n == 64
    (whole,) = (scene for scene in named.scenes if scene.scene_id == "a")
    assert whole.allowed.sum() == 8


def test_the_nearest_capture_is_nearest_in_exposure_first() -> None:
    grid = ExposureGrid((100, 200, 400), (1 / 64, 1 / 32), (4,))
    fields = {"recorded": torch.zeros(4, 4, 4, 4), "allowed": np.array([1, 1, 0, 1, 1, 0], bool)}
    scene = Scene.from_array(torch.full((4, 4, 4), 0.1), grid[0], CAMERA, scene_id="a", **fields)
    # ISO 200, 1/64 s: ISO 100, 1/32 s is as bright. ISO 400, 1/32 s: a stop off are two, both a
    # stop away in one control; the lower ISO wins.
    assert nearest_recorded(scene, grid).tolist() == [0, 1, 1, 3, 4, 3]


def test_frames_of_a_video_follow_each_other_whatever_is_chosen(video):
    env = make_env(**arguments(video))
    _, info = env.reset(seed=0, options={"scene": "street", "state": 0})
    shown = [info["scene_id"]]
    for action in (0, 2, 1, 1):
        observation, _, _, _, info = env.step(action)
        shown.append(info["scene_id"])
    assert shown == [f"street/frame_{i:04d}" for i in (0, 1, 2, 2, 2)]  # the last one stays
    expected = load_scenes(video, "all", camera=CAMERA, resolution=36)[2].recorded[1:2]
    np.testing.assert_array_equal(observation["raw"], encode_observation(expected)[0].numpy())
    _, info = env.reset(seed=0, options={"frame": 1})
    assert info["scene_id"] == "street/frame_0001"


def test_the_table_is_what_stepping_gives(raws: Path) -> None:
    for scorer in ("balanced", {"entropy": 0.5, "noise": 0.5}):
        env = make_env(**arguments(raws, scorer=scorer, with_oracle=True))
        base = env.unwrapped
        env.reset(seed=0, options={"scene": "b"})
        rewards = np.full(len(GRID), -1.0)
        for state in np.flatnonzero(base.action_masks()):
            _, rewards[state], _, _, info = env.step(int(state))
        table = base.score_table()
        seen = rewards >= 0.0
        np.testing.assert_allclose(table.mean[seen], rewards[seen], atol=1e-6)
        assert not table.mean[~seen].any()
        assert info["oracle_state"] == rewards.argmax()


def test_many_and_pickled_copies_show_the_same(raws, video):
    for scenes in (raws, video):
        given = arguments(scenes, with_oracle=True, costs={"flicker": 1.0})
        check_parity(0, 4, max_episode_steps=3, **given)
    env = make_env(**arguments(raws)).unwrapped
    pickled = pickle.dumps(env)
    _LOADED.clear()  # as in another process
    shown = [one.reset(seed=4)[0]["raw"] for one in (env, pickle.loads(pickled))]
    np.testing.assert_array_equal(*shown)


def test_a_changed_folder_is_read_again(tmp_path: Path) -> None:
    write_raws(tmp_path / "a")
    assert len(make_env(**arguments(tmp_path)).unwrapped.scenes) == 1
    (tmp_path / "a" / "IMG_0007.dng").unlink()
    scene = make_env(**arguments(tmp_path)).unwrapped.scenes[0]
    assert not scene.allowed[7]


def central(settings: CameraSettings, seed: int) -> torch.Tensor:
    """What the reference camera took, as written to the file; its middle 36 x 36 pixels."""
    return capture(settings, seed).data[:, 2:38, 2:38]


REAL = {"motion": 0.3, "depth": 1.0, "lighting": "step", "noise": "exact", "source": "raw"}


@pytest.mark.parametrize(("name", "value"), [*REAL.items(), ("noise", False), ("lens", "random")])
def test_nothing_of_real_captures_can_be_simulated(raws, name, value):
    with pytest.raises(ValueError, match=rf"`{name}` .* must be .* for recorded"):
        make_env(**arguments(raws, **{name: value}))
    scenes = load_scenes(f"recorded:{raws}", "all", camera=CAMERA, resolution=36)
    with pytest.raises(ValueError, match=r"must name the folder of recorded scenes"):
        make_env(scenes=scenes)
    with pytest.raises(ValueError, match=r"`scenes` .* must not be recorded: of a bracket's"):
        make_env(ID.replace("AutoExposure-v0", "ExposureBracket-v0"), **arguments(raws))
