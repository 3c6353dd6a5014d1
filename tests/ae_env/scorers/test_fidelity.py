"""Fidelity: the ideal picture scores 1, what a camera does to it costs; closed forms."""

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from ae_env.scorers import make_scorer
from ae_env.scorers.fidelity import likeness, reference_pictures
from simulator import CameraSettings
from tests.ae_env.scorer_images import make_captures, random_scene


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


def test_the_right_exposure_wins_and_noise_is_seen():
    """Through the simulator: of whole stops the right one scores best, low ISO above high."""
    scene = random_scene(illuminance=1000.0)
    proper = math.log2(1000 / 2.5)
    times = [2.0 ** -(proper - 4 + stop) for stop in (-4, -2, 0, 2, 4)]
    states = [CameraSettings(100, t, 4) for t in times]
    states.append(CameraSettings(6400, times[2] / 64, 4))
    captures = make_captures(scene, states)
    frames = scene.prepared.expose(states, seed=0).clamp(0.0, 1.0)
    scores = make_scorer("fidelity")(frames, captures).tolist()
    assert np.argmax(scores) == 2
    assert scores[2] > scores[1] > scores[0]
    assert scores[2] > scores[3] > scores[4]
    assert scores[5] < scores[2] - 0.02
