"""Local features: measures against closed forms, and a whole run on drawn pictures."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import map_coordinates

pytest.importorskip("cv2")

from benchmarks.features import judging, pairs, training
from benchmarks.features.detector import Features
from simulator.training.scenes import detail_split


def test_measures_of_matches_that_are_known() -> None:
    """20 of 40 points are 2.5 pixels off to the right, under a shift by (4, -3)."""
    descriptors = torch.eye(40)
    grid = np.stack(np.meshgrid(np.arange(20.0, 140, 20), np.arange(20.0, 140, 18)), -1)
    first = grid.reshape(-1, 2)[:40]
    shift = np.array([[1.0, 0.0, 4.0], [0.0, 1.0, -3.0], [0.0, 0.0, 1.0]])
    second = first + np.array([4.0, -3.0])
    second[:20, 0] += 2.5
    a, b = (Features(torch.from_numpy(points), descriptors) for points in (first, second))
    half = judging.measures(a, b, shift)
    assert half["repeatability"] == 0.5
    assert [half[f"accuracy_{k}"] for k in (1, 2, 3, 4, 5)] == [0.5, 0.5, 1.0, 1.0, 1.0]
    exact = judging.measures(b, b, np.eye(3))
    assert (exact["repeatability"], exact["matches"]) == (1.0, 40)
    assert exact["corner_error"] < 0.01
    none = judging.measures(Features(a.points[:0], descriptors[:0]), b, shift)
    assert none["repeatability"] == none["accuracy_5"] == 0.0
    assert none["corner_error"] == float("inf")


def test_views_of_a_picture_agree_under_their_homography() -> None:
    """Light that is linear in x and y: its value at a place is known in both views."""
    y, x = torch.meshgrid(torch.arange(800.0), torch.arange(800.0), indexing="ij")
    source = pairs.Source("ramp", "ramp", torch.stack([x, y, x + y]) / 1600.0)
    # Private: the light of a pair is nowhere else before it is noisy.
    scenes, homography = judging._views(source, np.random.default_rng(3))
    places = np.array([[60.0, 70.0], [90.0, 80.0], [75.0, 100.0]])
    both = (places, pairs.mapped(places, homography))
    for channel in (0, 1):  # photosites are half as far apart as the pixels of a homography
        one, other = (
            map_coordinates(scene.light[channel].numpy(), 2.0 * at[:, ::-1].T + 0.5, order=1)
            for scene, at in zip(scenes, both, strict=True)
        )
        assert one == pytest.approx(other, abs=0.5 / 1600)


def test_plain_scaling_and_ours_have_the_same_range() -> None:
    grey = torch.full((64, 3, 2, 2), 0.5)
    linear = ((training.scaled(grey, list(range(64))) + 0.055) / 1.055) ** 2.4
    stops = (linear[linear < 0.99] / ((0.5 + 0.055) / 1.055) ** 2.4).log2()
    assert training.STOPS[0] <= stops.min() + 0.01
    assert stops.max() <= training.STOPS[1]
    assert {training.AUGMENTATIONS[arm].stops for arm in ("exposure", "full")} == {training.STOPS}


@pytest.mark.slow
def test_train_judge_report(
    ae_env, benchmarks_here: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "RUNS", tmp_path / "runs" / "bench")
    monkeypatch.setattr(training, "QUICK_STEPS", 2)
    monkeypatch.setenv("AE_ENV_DATA", str(tmp_path))
    (tmp_path / "photo_pool").mkdir()
    names = {split: [] for split in ("train", "validation", "test")}
    for number in range(100):
        names[detail_split(f"drawn{number}")].append(f"drawn{number}")
    for name in (*names["train"][:2], *names["validation"][:1], *names["test"][:2]):
        blocks = np.random.default_rng(0).integers(0, 255, (24, 32, 3)).astype(np.uint8)
        picture = Image.fromarray(blocks).resize((512, 384), Image.Resampling.NEAREST)
        picture.save(tmp_path / "photo_pool" / f"{name}.png")
    code, _, error = ae_env("bench", "features", "--quick", "--out", "results")
    assert (code, error) == (0, "")
    rows = json.loads((tmp_path / "results" / "features.json").read_text())["rows"]
    means = {(r["arm"], *r["gaps"]) for r in rows if r["part"] == "mean"}
    assert means >= {(arm, gap) for arm in training.AUGMENTATIONS for gap in (0.0, 4.0)}
    assert "| **ours, in full** " in (tmp_path / "results" / "features.md").read_text()
    assert training.train("full", 0, 2, 4)[1] == training.train("full", 0, 2, 4)[1]  # kept


def test_aliked_wants_its_weights(ae_env, benchmarks_here: Path, tmp_path: Path) -> None:
    kornia = pytest.importorskip("kornia.feature")
    code, _, error = ae_env("bench", "features", "--weights", "none.pth", "--out", "results")
    assert code == 2
    assert "`weights` (='none.pth') must be an existing file" in error
    torch.save(kornia.ALIKED("aliked-n16").state_dict(), tmp_path / "random.pth")
    found = judging.aliked(tmp_path / "random.pth")(torch.rand(2, 3, 64, 64), 20)
    assert [(f.points.shape, len(f.descriptors)) for f in found] == [((20, 2), 20)] * 2
    torch.save({"other": torch.zeros(1)}, tmp_path / "other.pth")
    with pytest.raises(ValueError, match="`weights`"):
        judging.aliked(tmp_path / "other.pth")
