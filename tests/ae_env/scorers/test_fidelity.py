"""Captures against the ideal picture: fidelity by closed forms, keypoints and matches by hand."""

import math
import sys
from importlib.util import find_spec

import numpy as np
import pytest
import skimage.data
import torch
from scipy.ndimage import gaussian_filter

from ae_env.scenes import Scene, reference_settings
from ae_env.scorers import make_scorer
from ae_env.scorers.fidelity import likeness, reference_pictures
from simulator import CameraSettings, incident_ev100
from tests.ae_env.scorer_images import GRID, make_captures, make_scene, random_scene


def lab(lightness: float, a: float = 0.0, b: float = 0.0, size: int = 16) -> np.ndarray:
    return np.broadcast_to(np.array([lightness, a, b]), (size, size, 3)).copy()


def test_colour_is_the_published_difference():
    """Pairs of Sharma, Wu and Dalal 2005, table 1, of equal lightness: even areas, structure 1."""
    for first, second, difference in (
        ((2.6772, -79.7751), (0.0, -82.7485), 2.0425),
        ((-1.3802, -84.2814), (0.0, -82.7485), 1.0000),
        ((2.5, 0.0), (0.0, -2.5), 4.3065),
    ):
        found = likeness(lab(50.0, *first), lab(50.0, *second))
        assert found == pytest.approx(math.sqrt(math.exp(-difference / 10)), abs=1e-5)


def test_structure_is_the_similarity_of_even_lightness():
    """Without variance SSIM is (2 m n + c) / (m^2 + n^2 + c), c = (0.01 * 100)^2."""
    found, m, n = likeness(lab(40.0), lab(60.0)), 40.0, 60.0
    structure = (2 * m * n + 1.0) / (m * m + n * n + 1.0)
    # CIEDE2000 of greys is |dL| / S_L, S_L = 1 + 0.015 (L - 50)^2 / sqrt(20 + (L - 50)^2), L = 50.
    assert found == pytest.approx(math.sqrt(math.exp(-2.0) * structure), rel=1e-6)


def test_what_a_camera_does_costs():
    """Of the ideal picture: noise, blur, a stop too much, another white balance."""
    scorer, scene = make_scorer("fidelity"), random_scene(illuminance=1000.0)
    state = CameraSettings(100, 2.0 ** -(math.log2(1000 / 2.5) - 4), 4)
    captures = make_captures(scene, [state] * 5)
    (ideal,) = reference_pictures(captures, [0])
    rng = np.random.default_rng(0)
    noisy = (ideal + 0.05 * torch.from_numpy(rng.normal(size=ideal.shape)).float()).clamp(0, 1)
    blurred = torch.from_numpy(gaussian_filter(ideal.numpy(), (0, 1.5, 1.5)))
    brighter = (ideal * 1.3).clamp(0, 1)
    tinted = ideal * torch.tensor([1.0, 0.9, 0.8])[:, None, None]
    pictures = torch.stack([ideal, noisy, blurred, brighter, tinted])
    perfect, *others = scorer.parts["fidelity"](pictures, captures).tolist()
    assert perfect == pytest.approx(1.0, abs=1e-9)
    assert all(0.0 < score < 0.95 for score in others)
    assert scorer.parts["fidelity"](1.0 - pictures[:1], make_captures(scene, [state]))[0] < 0.3


EV = incident_ev100(1000.0)
needs_opencv = pytest.mark.skipif(find_spec("cv2") is None, reason="needs the extra cv")


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


@needs_opencv
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


@needs_opencv
def test_each_capture_is_compared_with_its_own_scene() -> None:
    first, second = _scene(_camera_man(), "a"), _scene(_camera_man()[::-1].copy(), "a")
    scenes = [first, second, first, second]
    captures = make_captures(scenes, [reference_settings(EV)] * 4)
    scores = make_scorer("matches")(captures.light.clamp(0.0, 1.0), captures)
    assert scores.tolist() == [1.0] * 4  # though the two have one name
    swapped = make_scorer("matches")(captures.light[[1, 0, 3, 2]].clamp(0.0, 1.0), captures)
    assert float(swapped.max()) < 0.3


@needs_opencv
@pytest.mark.parametrize("name", ["keypoints", "matches"])
@pytest.mark.parametrize("size", [(1, 1), (37, 64)])
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


def test_opencv_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    for name in ("keypoints", "matches"):
        with pytest.raises(ImportError, match=r"pip install 'ae-env\[cv\]'"):
            make_scorer(name)
