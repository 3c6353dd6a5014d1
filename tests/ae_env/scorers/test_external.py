"""BRISQUE against OpenCV's own class, with a model that is trained here."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import skimage.data
import torch
import torch.nn.functional as functional

from ae_env.scorers import make_scorer
from ae_env.scorers.opencv import Brisque
from ae_env.scorers.opencv import luma_bytes

cv2 = pytest.importorskip("cv2")


def _photographs(size: int) -> torch.Tensor:
    pictures = [skimage.data.astronaut(), skimage.data.coffee(), skimage.data.chelsea()]
    cut = [torch.from_numpy(p[:300, :300].copy()).permute(2, 0, 1) / 255.0 for p in pictures]
    return functional.interpolate(torch.stack(cut), (size, size), mode="bilinear", antialias=True)


def _degraded(pictures: torch.Tensor) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    noisy = pictures + 0.2 * torch.randn(pictures.shape, generator=generator)
    small = functional.avg_pool2d(pictures, 4)
    blurred = functional.interpolate(small, pictures.shape[2:], mode="bilinear")
    return torch.cat([pictures, noisy.clamp(0.0, 1.0), blurred])


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A machine that was told that noise is 80, blur 50 and a photograph 10."""
    folder = tmp_path_factory.mktemp("brisque")
    pictures = luma_bytes(_degraded(_photographs(128)))
    compute = cv2.quality.QualityBRISQUE_computeFeatures
    features = np.concatenate([compute(picture) for picture in pictures])
    low, high = features.min(axis=0), features.max(axis=0)
    machine = cv2.ml.SVM_create()
    machine.setType(cv2.ml.SVM_EPS_SVR)
    machine.setKernel(cv2.ml.SVM_RBF)
    machine.setGamma(0.05)
    machine.setC(1024.0)
    machine.setP(0.1)
    scaled = (-1.0 + 2.0 * (features - low) / (high - low)).astype(np.float32)
    wanted = np.repeat(np.float32([10.0, 80.0, 50.0]), 3)
    assert machine.train(scaled, cv2.ml.ROW_SAMPLE, wanted)
    machine.save(str(folder / "brisque_model_live.yml"))
    ranges = cv2.FileStorage(str(folder / "brisque_range_live.yml"), cv2.FILE_STORAGE_WRITE)
    ranges.write("range", np.stack([low, high]))
    ranges.release()
    return folder / "brisque_model_live.yml"


def test_values_are_those_of_opencv(model: Path) -> None:
    pictures = _degraded(_photographs(96))
    reference = cv2.quality.QualityBRISQUE_create(
        str(model), str(model.with_name("brisque_range_live.yml"))
    )
    values = [reference.compute(picture)[0] for picture in luma_bytes(pictures)]
    assert np.ptp(values) > 20.0  # else this shows nothing
    scores = Brisque(model)(pictures, None)  # type: ignore[arg-type]
    np.testing.assert_allclose(scores.numpy(), 1.0 - np.array(values) / 100.0, atol=1e-5)
    assert scores[:3].mean() > scores[6:].mean() > scores[3:6].mean()


def test_pictures_without_statistics_score_zero(model: Path) -> None:
    scorer = Brisque(model)
    pictures = torch.stack([torch.zeros(3, 64, 64), torch.ones(3, 64, 64)])
    assert scorer(pictures, None).tolist() == [0.0, 0.0]  # type: ignore[arg-type]
    assert scorer(torch.rand(2, 3, 1, 5), None).tolist() == [0.0, 0.0]  # type: ignore[arg-type]


def test_the_model_is_asked_for(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path))
    monkeypatch.delenv("AE_ENV_BRISQUE", raising=False)
    with pytest.raises(ValueError, match=r"set AE_ENV_BRISQUE=FILE.*brisque_model_live.yml"):
        make_scorer("brisque")
    alone = tmp_path / "brisque_model_live.yml"
    alone.write_bytes(model.read_bytes())
    with pytest.raises(ValueError, match=r"needs brisque_range_live.yml beside"):
        make_scorer("brisque")
    (tmp_path / "brisque_range_live.yml").write_text("%YAML:1.0\n---\nrange: 3\n")
    with pytest.raises(ValueError, match=r"must be OpenCV's BRISQUE model"):
        make_scorer("brisque")
    alone.write_text("no model")
    with pytest.raises(ValueError, match=r"must be OpenCV's BRISQUE model"):
        make_scorer("brisque")
    monkeypatch.setenv("AE_ENV_BRISQUE", str(model))
    assert make_scorer("brisque").parts["brisque"].model == str(model)  # type: ignore[attr-defined]
    monkeypatch.setenv("AE_ENV_BRISQUE", str(tmp_path / "nowhere.yml"))
    with pytest.raises(ValueError, match=r"`AE_ENV_BRISQUE` \(='.*nowhere.yml'\)"):
        make_scorer("brisque")


def test_opencv_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    for name in ("brisque", "keypoints", "matches"):
        with pytest.raises(ImportError, match=r"pip install 'ae-env\[cv\]'"):
            make_scorer(name)
