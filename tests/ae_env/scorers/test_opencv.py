"""Keypoints and matches by hand, BRISQUE against OpenCV's own class with a model trained here."""

import sys
from pathlib import Path

import numpy as np
import pytest
import skimage.data
import torch
import torch.nn.functional as functional

from ae_env.scenes import Scene, reference_settings
from ae_env.scorers import make_scorer
from ae_env.scorers.opencv import Brisque, luma_bytes, reference_pictures
from simulator import incident_ev100
from tests.ae_env.scorer_images import GRID, make_captures, make_scene

cv2 = pytest.importorskip("cv2")
EV = incident_ev100(1000.0)


def _scene(light: np.ndarray, name: str = "test") -> Scene:
    return make_scene(np.repeat(light[None], 4, axis=0), scene_id=name)


def _camera_man(size: int = 128) -> np.ndarray:
    return 0.6 * (skimage.data.camera()[: 4 * size : 4, : 4 * size : 4] / 255.0) ** 2.2


def test_the_reference_is_the_right_exposure_without_noise() -> None:
    """Whatever the state, and a grey card under incident light is 18 % grey in it."""
    scene = _scene(np.full((40, 40), 0.18 * 0.6635))
    captures = make_captures(scene, [GRID[i] for i in (0, 30, 63)])
    pictures = reference_pictures(captures, [0, 1, 2])
    # sRGB of 18 %: 1.055 * 0.18 ** (1 / 2.4) - 0.055.
    np.testing.assert_allclose(pictures.numpy(), 0.4614, atol=2e-3)


def test_a_perfect_capture_finds_all_again() -> None:
    scene = _scene(_camera_man())
    captures = make_captures(scene, [reference_settings(EV)] * 4)
    light = captures.light.clamp(0.0, 1.0)
    generator = torch.Generator().manual_seed(0)
    noisy = (light + 0.05 * torch.randn(light.shape, generator=generator)).clamp(0.0, 1.0)
    blurred = torch.nn.functional.avg_pool2d(light, 5, stride=1, padding=2)
    shifted = light.roll(12, dims=3)  # all are found, none at its place
    images = torch.stack([light[0], noisy[1], blurred[2], shifted[3]])
    perfect, with_noise, with_blur, elsewhere = make_scorer("matches")(images, captures).tolist()
    assert perfect == 1.0
    assert 0.0 < with_noise < 0.9
    assert 0.0 < with_blur < 0.9
    assert elsewhere < 0.1
    keypoints = make_scorer("keypoints")(images, captures)
    assert keypoints[2] < keypoints[0] < keypoints[1]  # noise is taken for corners


def test_each_capture_is_compared_with_its_own_scene() -> None:
    first, second = _scene(_camera_man(), "a"), _scene(_camera_man()[::-1].copy(), "a")
    scenes = [first, second, first, second]
    captures = make_captures(scenes, [reference_settings(EV)] * 4)
    scores = make_scorer("matches")(captures.light.clamp(0.0, 1.0), captures)
    assert scores.tolist() == [1.0] * 4  # though the two have one name
    swapped = make_scorer("matches")(captures.light[[1, 0, 3, 2]].clamp(0.0, 1.0), captures)
    assert float(swapped.max()) < 0.3


@pytest.mark.parametrize("name", ["keypoints", "matches"])
@pytest.mark.parametrize("size", [(1, 1), (2, 31), (37, 64), (65, 41)])
def test_any_frame_is_scored(name: str, size: tuple[int, int]) -> None:
    light = np.full(size, 0.1)
    captures = make_captures(_scene(light), [GRID[20]] * 3)
    images = torch.zeros(3, 4, *size)
    images[1] = 1.0
    images[2] = torch.rand(4, *size)
    scores = make_scorer(name)(images, captures)
    assert scores[:2].tolist() == [0.0, 0.0]
    assert 0.0 <= float(scores[2]) <= 1.0
    assert torch.equal(scores, make_scorer(name)(images, captures))


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
