"""Codes drawn into scenes, and the scorers that read them."""

import importlib.util
import sys
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from ae_env.grid import ExposureGrid
from ae_env.scenes import load_scenes
from ae_env.scenes.ladder import LIGHT_EV, RUNGS, with_ladder
from ae_env.scorers import make_scorer
from ae_env.scorers.detection import Legibility
from ae_env.scorers.score_table import ScoreTables
from ae_env.scorers.terms import developed
from simulator.capture.prepared_scene import Layout
from tests.ae_env.environments import make_env
from tests.ae_env.scorer_images import CAMERA, make_captures, make_scene

zxing = pytest.importorskip("zxingcpp", reason="needs the extra tasks")
needs_opencv = pytest.mark.skipif(importlib.util.find_spec("cv2") is None, reason="needs OpenCV")

pytestmark = pytest.mark.usefixtures("no_network")


def plain(size=128, scene_id="grey", **fields):
    """A grey card with more light at the top, as the incident-light exposure records it."""
    slope = np.linspace(1.2, 0.8, size)[:, None] * np.ones((4, 1, size))
    return make_scene(0.119 * slope, scene_id=scene_id, **fields)


def boards(sorts, count=40, size=128):
    """A ladder with these boards."""
    ladders = (with_ladder(plain(size, scene_id=f"grey-{i}")) for i in range(count))
    return next(s for s in ladders if set(s.ladder.boards) == set(sorts))


def states(scene, evs, iso=400.0):
    """States at so much more than the right exposure, that differ in the time."""
    grid = [ExposureGrid((iso,), (2.0 ** (ev - scene.ev100) * 6400 / iso,), (8.0,)) for ev in evs]
    return [one[0] for one in grid]


def read(scene, evs, *, iso=400.0, speed=0.0, scorer=None, noise="exact"):
    """(EV, N) bool, which codes are read at exposures relative to the right one."""
    at = states(scene, evs, iso)
    frames = scene.prepared.changed(image_speed=speed).expose(at, seed=3, noise=noise).clamp(0, 1)
    captures = make_captures(scene, at, speed=speed)
    shown = developed(frames, captures.white_balance, captures.colour_matrices)
    return np.array((scorer or Legibility()).read(shown, captures))


def inside(point, polygon):
    """Whether a point is in a convex polygon whose corners go clockwise."""
    edges = np.roll(polygon, -1, axis=0) - polygon
    apart = np.asarray(point) - polygon
    return bool((edges[:, 0] * apart[:, 1] - edges[:, 1] * apart[:, 0] >= 0.0).all())


def test_a_reader_that_knows_nothing_finds_what_the_truth_says_where_it_says():
    """zxing-cpp on the whole picture of a large frame, which the scorer never looks at."""
    scene = boards(["sun"], size=512)
    picture = scene.light[1].numpy() / scene.light[1].max().item()
    picture = (picture.clip(0.0, 1.0) ** (1 / 2.2) * 255.0).round().astype(np.uint8)
    found = zxing.read_barcodes(picture, formats=zxing.BarcodeFormat.DataMatrix)
    assert len(found) >= 2
    for barcode in found:
        number = scene.ladder.texts.index(barcode.text)
        place = barcode.position
        corners = (place.top_left, place.top_right, place.bottom_right, place.bottom_left)
        middle = np.mean([(corner.x, corner.y) for corner in corners], axis=0)
        assert inside(middle, scene.ladder.corners[number])
        assert np.abs(middle - scene.ladder.corners[number].mean(axis=0)).max() < 3.0


def test_name_and_seed_decide_the_ladder():
    first, again, other = (with_ladder(plain(), "codes", seed) for seed in (0, 0, 1))
    assert torch.equal(first.light, again.light)
    assert first.ladder.facts == again.ladder.facts
    assert first.ladder.texts != other.ladder.texts
    assert set(with_ladder(plain(scene_id="b")).ladder.texts) != set(first.ladder.texts)


def test_white_modules_have_the_light_of_their_board():
    """0.663 R of white at the incident exposure (ISO 12232), times the light on the board."""
    scene = boards(["sun", "shade"])
    _, dark, light = RUNGS[0]
    for sort, (low, high) in LIGHT_EV.items():
        first = scene.ladder.boards.index(sort)
        x0, y0, x1, y1 = (*scene.ladder.corners[first].min(0), *scene.ladder.corners[first].max(0))
        cell = scene.light[:, int(y0) + 3 : int(y1) - 2, int(x0) + 3 : int(x1) - 2]
        ev = np.log2(cell[1].max().item() / (0.663 * light))
        assert low - 0.02 < ev < high + 0.02
        assert cell[1].min().item() == pytest.approx(cell[1].max().item() * dark / light, rel=0.3)


def test_a_board_is_neutral_in_the_light_of_the_scene():
    scene = with_ladder(plain(white_balance=(2.0, 1.0, 1.5)))
    x, y = scene.ladder.corners[0].mean(axis=0).astype(int)
    red, green, _, blue = scene.light[:, y - 3 : y + 4, x - 3 : x + 4].flatten(1).max(dim=1).values
    assert (red * 2.0, blue * 1.5) == (pytest.approx(green.item()), pytest.approx(green.item()))


def test_codes_are_read_where_they_are_after_a_cut_and_an_average():
    scene = with_ladder(plain(size=256))
    whole = read(scene, [1.0], noise=None).sum()
    small = scene.averaged(2)
    assert small.ladder.corners == pytest.approx(scene.ladder.corners / 2.0)
    moved = scene.cut(slice(3, 256), slice(5, 256))
    assert moved.ladder.corners == pytest.approx(scene.ladder.corners - (5.0, 3.0))
    assert abs(int(read(moved, [1.0], noise=None).sum()) - int(whole)) <= 1


def test_one_board_is_the_subject_in_focus():
    layout = Layout(torch.full((128, 128), 0.7), None)
    scene = with_ladder(plain(layout=layout))
    subject = scene.layout.subject
    assert 0.2 < subject.float().mean() < 0.35  # 8 cells, and the grey beside them
    assert (scene.layout.defocus[subject] == 0.0).all()
    x, y = scene.ladder.corners.mean(axis=1).T.astype(int)
    own = subject[y, x].reshape(-1, len(RUNGS))
    assert own.any(dim=1).equal(own.all(dim=1))
    assert own.any(dim=1).sum() == 1


def test_the_easiest_rung_survives_six_stops_and_the_hardest_fails_at_the_best():
    evs, easy, hard = np.arange(-6.0, 6.5, 1.0), [], []
    for sort in ("sun", "shade"):
        scene = boards([sort])
        found = read(scene, evs)
        easy.append(found[:, 0])
        hard.append(found[:, len(RUNGS) - 1])
    assert easy[0][0]  # in the sun, 6 EV too dark
    assert easy[1][-1]  # in the shade, 6 EV too bright
    assert not np.any(hard)


def test_the_score_falls_with_exposure_gain_and_motion():
    scenes = [with_ladder(plain(scene_id=f"grey-{i}")) for i in range(8)]

    def mean(evs, **options):
        return np.mean([read(scene, evs, **options).mean(axis=1) for scene in scenes], axis=0)

    evs = np.arange(-9.0, 9.1, 3.0)
    curve = mean(evs)
    best = int(curve.argmax())
    assert 2 <= best <= 4
    assert (np.diff(curve[: best + 1]) >= -0.02).all()
    assert (np.diff(curve[best:]) <= 0.02).all()
    assert np.abs(np.diff(curve)).max() < 0.35  # no cliff
    assert curve[best] > curve[0] + 0.2
    low, middle, high = (mean([0.0], iso=iso)[0] for iso in (100.0, 6400.0, 102400.0))
    assert low > middle > high
    still, slow, fast = (mean([0.0], speed=speed)[0] for speed in (0.0, 0.002, 0.2))
    assert still >= slow > fast


def test_tables_are_stored_and_looked_up_by_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path))
    scene = boards(["sun"])
    grid = ExposureGrid((100.0,), (1 / 125, 1 / 15), (4.0,))
    made = ScoreTables(grid, CAMERA, make_scorer("legibility")).table(scene)

    options = {"scenes": [scene], "split": "all", "grid": grid, "resolution": 128}
    options |= {"scorer": "legibility", "motion": "none", "depth": "far", "reward": "expected"}
    monkeypatch.setattr(Legibility, "__call__", Mock(side_effect=AssertionError("read again")))
    again = ScoreTables(grid, CAMERA, make_scorer("legibility")).table(scene)
    assert np.array_equal(made.mean, again.mean)
    env = make_env(**options)
    env.reset(seed=0)
    assert [env.step(a)[1] for a in (0, 1)] == made.mean.tolist()
    with pytest.raises(AssertionError, match="read again"):  # another episode is another table
        ScoreTables(grid, CAMERA, make_scorer("legibility")).table(scene, speed=0.1)


def test_names_of_scenes_take_ladders(monkeypatch):
    options = {"camera": CAMERA, "resolution": 96}
    first, other = (load_scenes(f"bundled:small?codes{seed}", **options)[0] for seed in ("", "=7"))
    assert (first.scene_id, first.group) == (other.scene_id, other.group)
    assert first.ladder.texts != other.ladder.texts
    both = load_scenes("bundled:small?codes=7,0", **options)
    half = len(both) // 2
    assert [both[i].ladder.texts for i in (0, half)] == [other.ladder.texts, first.ladder.texts]
    assert [both[i].scene_id for i in (0, half)] == [first.scene_id, f"{first.scene_id} 0"]
    for wrong in ("=7,7", "=7,", "=-1"):
        with pytest.raises(ValueError, match=r"`scenes\?codes` .* whole number"):
            load_scenes(f"bundled:small?codes{wrong}", **options)
    with pytest.raises(ValueError, match=r"`resolution` \(=64\) must be .*96"):
        load_scenes("bundled:small?codes", camera=CAMERA, resolution=64)
    noisy = plain(nlf=CAMERA.nlf(100))
    with pytest.raises(ValueError, match="light without noise"):
        with_ladder(noisy)


def test_errors_name_what_is_missing(monkeypatch):
    env = make_env(scorer="legibility", resolution=96)
    with pytest.raises(ValueError, match=r"bundled\?codes"):
        env.reset(seed=0)
    monkeypatch.setitem(sys.modules, "zxingcpp", None)
    with pytest.raises(ImportError, match=r"ae-env\[tasks\]"):
        make_scorer("legibility")
    with pytest.raises(ImportError, match=r"ae-env\[tasks\]"):
        with_ladder(plain())


@needs_opencv
def test_tags_are_read_too():
    scene = with_ladder(plain(size=192), "tags")
    scorer = next(iter(make_scorer("tags").parts.values()))
    found = read(scene, [-7.0, 1.0], scorer=scorer)
    assert found[1].mean() >= 0.4
    assert found[0].mean() < found[1].mean()
    assert not found[:, len(RUNGS) - 1 :: len(RUNGS)].any()
