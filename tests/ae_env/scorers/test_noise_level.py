"""The signal-to-noise ratio of the noise level function, and Immerkaer's blind estimate."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.signal
import torch

from ae_env.scorers import make_scorer
from ae_env.scorers.detail import immerkaer_sigma
from simulator import CameraSettings
from tests.ae_env.scorer_images import CAMERA, captures_of, check_image_scorer, random_pictures

KERNEL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]])


def test_any_picture_has_a_score() -> None:
    check_image_scorer("blind_noise")


def test_snr_is_the_mean_of_decibels() -> None:
    light = 0.1 * np.exp(np.random.default_rng(0).normal(0.0, 2.0, (4, 6, 5)))
    states = [
        CameraSettings(iso=100, exposure_time=1 / 64, f_number=4),
        CameraSettings(iso=6400, exposure_time=1 / 64, f_number=4),
        CameraSettings(iso=400, exposure_time=1 / 4000, f_number=4),
    ]
    expected = []
    for state in states:
        nlf, total = CAMERA.nlf(state.iso), 0.0
        for plane in range(4):
            for value in light[plane].ravel():
                x = value * (state.exposure_time * 64) * (state.iso / 100)
                power = min(x, 1.0) ** 2 / (nlf.shot[plane] * x + nlf.read[plane])
                total += min(max(10 * math.log10(power), 0.0), 50.0)
        expected.append(total / light.size / 50.0)
    scores = make_scorer("snr")(None, captures_of(light, states))
    np.testing.assert_allclose(scores.numpy(), expected, rtol=1e-5)
    assert make_scorer("snr").closed_form


def test_no_light_has_no_signal() -> None:
    states = [CameraSettings(iso=100, exposure_time=1 / 64, f_number=4)]
    assert make_scorer("snr")(None, captures_of(np.zeros((4, 5, 5)), states)).tolist() == [0.0]


def test_blind_sigma_is_immerkaers() -> None:
    luma = random_pictures(3, 20, 31)[:, 0].double()
    expected = []
    for picture in 255.0 * luma.numpy():
        response = np.abs(scipy.signal.convolve2d(picture, KERNEL, mode="valid"))
        expected.append(math.sqrt(math.pi / 2) / (6 * 29 * 18) * response.sum())
    np.testing.assert_allclose(immerkaer_sigma(luma).numpy(), expected, rtol=1e-9)


@pytest.mark.parametrize("sigma", [2.0, 5.0, 12.0])
def test_blind_sigma_of_known_noise(sigma: float) -> None:
    rows, columns = np.mgrid[0:200, 0:220]
    slope = 60.0 + 0.3 * rows + 0.2 * columns  # straight slopes leave nothing
    noisy = slope + sigma * np.random.default_rng(2).normal(size=slope.shape)
    found = immerkaer_sigma(torch.from_numpy(noisy[None] / 255.0)).item()
    assert found == pytest.approx(sigma, rel=0.02)
    assert immerkaer_sigma(torch.from_numpy(slope[None] / 255.0)).item() < 1e-9
    pictures = torch.from_numpy(noisy / 255.0).float().expand(1, 3, -1, -1)
    score = make_scorer("blind_noise").parts["blind_noise"](pictures, None).item()
    assert score == pytest.approx(1 / (1 + sigma / 10), rel=0.03)


def test_blind_sigma_is_near_that_of_wavelets() -> None:
    pytest.importorskip("pywt", reason="scikit-image needs PyWavelets for its estimate")
    from skimage.restoration import estimate_sigma

    rng = np.random.default_rng(4)
    noisy = 100.0 + 0.2 * np.arange(200) + 6.0 * rng.normal(size=(180, 200))
    found = immerkaer_sigma(torch.from_numpy(noisy[None] / 255.0)).item()
    assert found == pytest.approx(estimate_sigma(noisy), rel=0.05)
