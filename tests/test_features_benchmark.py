"""Local features: measures against closed forms, and a whole run on drawn pictures."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from benchmarks.features import judging, pairs, training
from benchmarks.features.detector import CELL, Detector, Features, mutual_matches, sample
from benchmarks.features.judging import SIZE, area_under, measures
from simulator.training.scenes import detail_split

cv2 = pytest.importorskip("cv2")


def features(points: np.ndarray, seed: int = 0) -> Features:
    """Features with descriptors that are all different."""
    generator = torch.Generator().manual_seed(seed)
    descriptors = torch.randn(len(points), 64, generator=generator)
    return Features(
        torch.from_numpy(points).float(), torch.nn.functional.normalize(descriptors, dim=1)
    )


def test_measures_of_matches_that_are_known() -> None:
    """20 of 40 points are 2.5 pixels off to the right, under a shift by (4, -3)."""
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(20, 140, 20), np.arange(20, 140, 18)), -1)
    first = grid.reshape(-1, 2)[:40] + rng.uniform(0, 0.1, (40, 2))
    shift = np.array([[1.0, 0.0, 4.0], [0.0, 1.0, -3.0], [0.0, 0.0, 1.0]])
    second = pairs.mapped(first, shift)
    exact = measures(features(first), features(second), shift)
    assert exact["repeatability"] == 1.0
    assert [exact[f"accuracy_{k}"] for k in (1, 2, 3, 4, 5)] == [1.0] * 5
    assert exact["corner_error"] < 0.01
    assert exact["matches"] == 40
    second[:20, 0] += 2.5
    half = measures(features(first), features(second), shift)
    assert half["repeatability"] == 0.5
    assert [half[f"accuracy_{k}"] for k in (1, 2, 3, 4, 5)] == [0.5, 0.5, 1.0, 1.0, 1.0]
    none = measures(features(first[:0]), features(second), shift)
    assert none["repeatability"] == none["accuracy_5"] == 0.0
    assert none["corner_error"] == float("inf")


def test_area_under_is_that_of_the_cumulated_curve() -> None:
    errors, threshold = np.random.default_rng(1).exponential(3.0, 500), 5.0
    t = (np.arange(100_000) + 0.5) / 100_000 * threshold
    curve = np.searchsorted(np.sort(errors), t) / len(errors)
    assert area_under(errors, threshold).mean() == pytest.approx(curve.mean(), abs=1e-4)
    assert area_under(np.array([np.inf]), threshold).tolist() == [0.0]


def test_only_mutual_nearest_neighbours_match() -> None:
    first = torch.tensor([[1.0, 0.0], [0.8, 0.6], [0.0, 1.0]])
    second = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    i, j = mutual_matches(first, second)
    assert (i.tolist(), j.tolist()) == ([0, 2], [0, 1])


def test_homographies_of_both_scales_show_the_same_place() -> None:
    """Else the pictures of a pair are off by the half pixel between the two grids."""
    first, second = pairs.two_crops(np.random.default_rng(2), 300, 400, SIZE)
    point = np.array([[200.0, 150.0]])
    for homography in (first, second):
        fine = pairs.mapped(2.0 * point + 0.5, pairs.finer(homography))
        assert np.allclose(fine, 2.0 * pairs.mapped(point, homography) + 0.5)


def test_views_of_a_picture_agree_under_their_homography() -> None:
    """Light that is linear in x and y: its value at a place is known in both views."""
    y, x = torch.meshgrid(torch.arange(800.0), torch.arange(800.0), indexing="ij")
    light = torch.stack([x, y, x + y]) / 1600.0
    (scenes, homography) = judging._views(
        pairs.Source("ramp", "ramp", light), np.random.default_rng(3)
    )
    first, second = (scene.light for scene in scenes)
    places = np.array([[60.0, 70.0], [90.0, 80.0], [75.0, 100.0]])
    there = pairs.mapped(places, homography)
    for (x1, y1), (x2, y2) in zip(places, there, strict=True):
        for channel in (0, 1):
            one, other = (
                _interpolated(image[channel].numpy(), 2 * u + 0.5, 2 * v + 0.5)
                for image, u, v in ((first, x1, y1), (second, x2, y2))
            )
            assert one == pytest.approx(other, abs=0.5 / 1600)


def _interpolated(image: np.ndarray, x: float, y: float) -> float:
    left, top = int(x), int(y)
    a, b = x - left, y - top
    square = image[top : top + 2, left : left + 2]
    return float(np.array([1 - b, b]) @ square @ np.array([1 - a, a]))


def test_descriptors_are_sampled_at_their_cells() -> None:
    dense = torch.zeros(1, 2, 5, 5)
    dense[0, 0], dense[0, 1, 2, 3] = 0.1, 1.0
    middle = torch.tensor([[[CELL * 3 + 1.5, CELL * 2 + 1.5], [1.5, 1.5]]])
    found = sample(dense, middle)[0]
    wanted = torch.tensor([[0.1, 1.0], [1.0, 0.0]])
    assert torch.allclose(found, torch.nn.functional.normalize(wanted, dim=1), atol=1e-6)


def test_keypoints_are_apart_and_off_the_border() -> None:
    torch.manual_seed(0)
    model = Detector().eval()
    pictures = torch.rand(2, 3, 48, 64)
    for found in model.detect(pictures, 40):
        assert 0 < len(found.points) <= 40
        assert found.points.min() >= 4
        assert (found.points < torch.tensor([60.0, 44.0])).all()
        apart = torch.cdist(found.points, found.points, p=torch.inf)
        assert apart.fill_diagonal_(9.0).min() > 3


def test_a_pair_for_training_has_the_same_places_in_both_crops() -> None:
    y, x = np.mgrid[:200, :300]
    picture = np.stack([x * 0.8, y * 1.2, 0 * x], -1).astype(np.uint8)
    view = pairs.View(picture, np.array([[150.0, 100.0], [160.0, 90.0]], np.float32))
    crops, _, (first, second) = training._pair(view, np.random.default_rng(0))
    for (x1, y1), (x2, y2) in zip(first[:20], second[:20], strict=True):
        one, other = (
            [_interpolated(crop[..., c].astype(float), u, v) for c in (0, 1)]
            for crop, u, v in ((crops[0], x1, y1), (crops[1], x2, y2))
        )
        assert np.allclose(one, other, atol=2.5)


def test_plain_scaling_and_ours_have_the_same_range() -> None:
    for arm in ("exposure", "full"):
        assert training.AUGMENTATIONS[arm].stops == training.STOPS
    grey = torch.full((64, 3, 2, 2), 0.5)
    linear = ((training.scaled(grey, list(range(64))) + 0.055) / 1.055) ** 2.4
    stops = (linear[linear < 0.99] / ((0.5 + 0.055) / 1.055) ** 2.4).log2()
    low, high = training.STOPS
    assert low <= stops.min() + 0.01
    assert stops.max() <= high
    assert (
        max(-judging.Condition(6.0, kind, 100.0).exposures[1] for kind in ("around", "below"))
        <= -low
    )


@pytest.fixture
def here(benchmarks_here: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Parts run in this process on drawn photographs, and nothing is written elsewhere."""
    monkeypatch.setattr(training, "RUNS", tmp_path / "runs" / "bench")
    monkeypatch.setattr(training, "QUICK_STEPS", 2)
    monkeypatch.setenv("AE_ENV_DATA", str(tmp_path))
    (tmp_path / "photo_pool").mkdir()
    rng = np.random.default_rng(0)
    wanted = {"train": 2, "validation": 1, "test": 2}
    for number in range(100):
        split = detail_split(f"drawn{number}")
        if wanted[split]:
            wanted[split] -= 1
            blocks = rng.integers(0, 255, (24, 32, 3)).astype(np.uint8)
            picture = Image.fromarray(blocks).resize((512, 384), Image.Resampling.NEAREST)
            picture.save(tmp_path / "photo_pool" / f"drawn{number}.png")
    assert not any(wanted.values())
    return tmp_path


@pytest.mark.slow
def test_train_judge_report(ae_env, here: Path) -> None:
    code, _, error = ae_env("bench", "features", "--quick", "--out", "results")
    assert (code, error) == (0, "")
    rows = json.loads((here / "results" / "features.json").read_text())["rows"]
    means = {(r["arm"], *r["gaps"]): r for r in rows if r["part"] == "mean"}
    assert {key for key in means if len(key) == 2} == {
        (arm, gap) for arm in training.AUGMENTATIONS for gap in (0.0, 4.0)
    }
    page = (here / "results" / "features.md").read_text()
    assert "| **ours, in full** |" in page
    with Image.open(here / "results" / "features.webp") as picture:
        assert picture.width > 300
    # Weights of a training are kept: the next one finds them.
    model, seconds = training.train("full", 0, 2, 4)
    again, same = training.train("full", 0, 2, 4)
    assert seconds == same
    assert all(
        torch.equal(a, b) for a, b in zip(model.parameters(), again.parameters(), strict=True)
    )


def test_aliked_wants_its_weights(ae_env, here: Path) -> None:
    pytest.importorskip("kornia")
    code, _, error = ae_env("bench", "features", "--weights", "none.pth", "--out", "results")
    assert code == 2
    assert "`weights` (='none.pth') must be an existing file" in error
    # A file of the right layout is read; its features are of its network.
    from kornia.feature import ALIKED

    torch.save(ALIKED("aliked-n16").state_dict(), here / "random.pth")
    found = judging.aliked(here / "random.pth")(torch.rand(2, 3, 64, 64), 20)
    assert [f.points.shape for f in found] == [(20, 2)] * 2
    assert [f.descriptors.shape[0] for f in found] == [20] * 2
    torch.save({"other": torch.zeros(1)}, here / "other.pth")
    with pytest.raises(ValueError, match="must hold aliked-n16: no "):
        judging.aliked(here / "other.pth")
