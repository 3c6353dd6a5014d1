"""Blur kernels against closed forms, and their application against SciPy's convolution."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.ndimage
import scipy.optimize
import scipy.special
import torch

from simulator.optics.blur import box_mean, disc_blur, motion_blur
from simulator.optics.shapes import disc_kernel, kernel_energy, motion_kernel

EXTENTS = [0.1, 0.3, 0.5, 0.9, 1.0, 1.5, 2.0, 2.5, 3.0, 4.7, 8.0, 11.3, 12.5, 16.0, 21.4, 30.0]


def picture(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).random(shape, dtype=np.float32))


@pytest.mark.parametrize("extent", EXTENTS)
def test_streak_has_the_second_moment_of_uniform_motion(extent: float) -> None:
    weights = motion_kernel(extent)
    offsets = np.arange(len(weights)) - len(weights) // 2
    assert len(weights) % 2 == 1
    assert weights.min() >= 0
    assert weights.sum() == pytest.approx(1, rel=1e-9)
    assert weights @ offsets == pytest.approx(0, abs=1e-12)
    assert weights @ offsets**2 == pytest.approx(extent**2 / 12, rel=1e-6)


@pytest.mark.parametrize("diameter", EXTENTS)
def test_disc_has_the_second_moment_of_a_uniform_disc(diameter: float) -> None:
    weights = disc_kernel(diameter)
    offsets = np.arange(len(weights)) - len(weights) // 2
    assert weights.shape == (len(offsets), len(offsets))
    assert weights.min() >= 0
    assert weights.sum() == pytest.approx(1, rel=1e-9)
    for marginal in (weights.sum(0), weights.sum(1)):
        # to a hundredth of a pixel: a tenth is where a blur begins to matter to any score
        assert 4 * math.sqrt(marginal @ offsets**2) == pytest.approx(diameter, abs=0.01)
    np.testing.assert_allclose(weights, weights.T, atol=1e-12)
    np.testing.assert_allclose(weights, weights[::-1], atol=1e-12)


@pytest.mark.parametrize("extent", EXTENTS)
def test_application_is_scipys_convolution(extent: float) -> None:
    """Both paths of the disc (direct and Fourier) and the running sum of the streak."""
    image = picture(4, 23, 29)
    streak = scipy.ndimage.convolve1d(
        image.double().numpy(), motion_kernel(extent), axis=-1, mode="nearest"
    )
    np.testing.assert_allclose(motion_blur(image, extent).numpy(), streak, atol=2e-6)
    disc = scipy.ndimage.convolve(image.double().numpy(), disc_kernel(extent)[None], mode="nearest")
    np.testing.assert_allclose(disc_blur(image, extent).numpy(), disc, atol=2e-6)


@pytest.mark.parametrize("extent", [0.4, 3.0, 9.0, 30.0])
@pytest.mark.parametrize("blur", [motion_blur, disc_blur])
class TestBothBlurs:
    def test_energy_of_a_lamp_is_conserved(self, blur, extent: float) -> None:  # type: ignore[no-untyped-def]
        image = torch.zeros(4, 81, 81)
        image[:, 40, 40] = 1000.0
        assert blur(image, extent).double().sum((1, 2)).numpy() == pytest.approx(
            [1000.0] * 4, rel=1e-5
        )

    def test_constant_light_stays_constant_up_to_the_border(self, blur, extent: float) -> None:  # type: ignore[no-untyped-def]
        image = torch.full((4, 17, 13), 0.37)
        np.testing.assert_allclose(blur(image, extent).numpy(), 0.37, rtol=1e-6)

    def test_linear(self, blur, extent: float) -> None:  # type: ignore[no-untyped-def]
        first, second = picture(4, 16, 18), picture(4, 16, 18, seed=1)
        mixed = blur(3 * first + second, extent)
        np.testing.assert_allclose(
            mixed.numpy(), (3 * blur(first, extent) + blur(second, extent)).numpy(), atol=3e-6
        )

    def test_an_image_is_blurred_the_same_alone_and_in_a_batch(self, blur, extent: float) -> None:  # type: ignore[no-untyped-def]
        images = picture(5, 4, 24, 20)
        together = blur(images, extent)
        for image, expected in zip(images, together, strict=True):
            np.testing.assert_allclose(blur(image, extent).numpy(), expected.numpy(), atol=1e-6)

    @pytest.mark.parametrize(
        "shape", [(4, 1, 1), (4, 1, 9), (4, 9, 1), (4, 2, 3), (1, 1), (2, 3, 4, 5, 6)]
    )
    def test_tiny_and_long_shapes(self, blur, extent: float, shape: tuple[int, ...]) -> None:  # type: ignore[no-untyped-def]
        image = picture(*shape)
        out = blur(image, extent)
        assert out.shape == image.shape
        assert out.dtype == image.dtype
        assert torch.isfinite(out).all()
        assert float(out.min()) >= float(image.min()) - 1e-6
        assert float(out.max()) <= float(image.max()) + 1e-6

    def test_the_argument_is_left_alone(self, blur, extent: float) -> None:  # type: ignore[no-untyped-def]
        image = picture(4, 8, 8)
        before = image.clone()
        blur(image, extent)
        assert torch.equal(image, before)

    def test_a_bright_lamp_leaves_no_ringing(self, blur, extent: float) -> None:  # type: ignore[no-untyped-def]
        image = torch.full((4, 64, 64), 1e-3)
        image[:, 32, 32] = 1e6
        out = blur(image, extent)
        assert float(out.min()) >= 1e-3 * (1 - 1e-5)
        np.testing.assert_allclose(out[:, 0, 0].numpy(), 1e-3, rtol=1e-5)


@pytest.mark.parametrize("blur", [motion_blur, disc_blur])
def test_no_extent_changes_nothing(blur) -> None:  # type: ignore[no-untyped-def]
    image = picture(4, 8, 8)
    assert torch.equal(blur(image, 0.0), image)


@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_bad_extents_are_named(value: float) -> None:
    with pytest.raises(ValueError, match="`extent_px`"):
        motion_blur(torch.zeros(4, 2, 2), value)
    with pytest.raises(ValueError, match="`diameter_px`"):
        disc_blur(torch.zeros(4, 2, 2), value)


@pytest.mark.parametrize("extent", [9.0, 14.0, 16.0, 17.0, 40.0, 300.5])
def test_streaks_longer_than_the_row_count_the_border(extent: float) -> None:
    image = picture(4, 3, 8)
    expected = scipy.ndimage.convolve1d(
        image.double().numpy(), motion_kernel(extent), axis=-1, mode="nearest"
    )
    np.testing.assert_allclose(motion_blur(image, extent).numpy(), expected, atol=1e-6)


def test_motion_runs_along_the_rows() -> None:
    image = torch.zeros(1, 5, 5)
    image[0, 2, 2] = 1.0
    out = motion_blur(image, 3.0)[0]
    assert float(out[2].sum()) == pytest.approx(1.0, abs=1e-6)
    assert float(out[[0, 1, 3, 4]].abs().max()) == 0.0


@pytest.mark.parametrize(("motion", "defocus"), [(0, 0), (3.0, 0), (0, 4.0), (7.5, 2.5), (0.4, 14)])
def test_kernel_energy_is_what_a_blur_leaves_of_white_noise(motion: float, defocus: float) -> None:
    """Averaging independent pixels multiplies the variance by the sum of squared weights."""
    impulse = torch.zeros(1, 65, 65, dtype=torch.float64)
    impulse[0, 32, 32] = 1.0
    response = motion_blur(disc_blur(impulse, defocus), motion)
    assert kernel_energy(motion, defocus) == pytest.approx(float((response**2).sum()), rel=1e-6)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("extent", [0.4, 3.0, 30.0])
def test_cuda_agrees(extent: float) -> None:
    image = picture(4, 33, 31)
    for blur in (motion_blur, disc_blur):
        np.testing.assert_allclose(
            blur(image.cuda(), extent).cpu().numpy(), blur(image, extent).numpy(), atol=2e-5
        )


# The mean of a window


@pytest.mark.parametrize("window", [1, 3, 5, 7, 9, 25])
@pytest.mark.parametrize("size", [(1, 1), (16, 16), (1, 30), (23, 41)])
def test_box_mean_is_scipys_uniform_filter(window: int, size: tuple[int, int]) -> None:
    image = picture(2, 3, *size)
    axes_sizes = (1, 1, window, window)
    expected = scipy.ndimage.uniform_filter(image.double().numpy(), axes_sizes, mode="nearest")
    np.testing.assert_allclose(box_mean(image, window).numpy(), expected, rtol=2e-6, atol=1e-6)
