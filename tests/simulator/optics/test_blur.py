"""Blur kernels against closed forms, and their application against SciPy's convolution."""

import math

import numpy as np
import pytest
import torch
from scipy import ndimage

from simulator.optics.blur import box_mean, disc_blur, motion_blur
from simulator.optics.shapes import disc_kernel, kernel_energy, motion_kernel

EXTENTS = [0.1, 0.3, 0.5, 0.9, 1.0, 1.5, 2.0, 2.5, 3.0, 4.7, 8.0, 11.3, 12.5, 16.0, 21.4, 30.0]
BOTH = pytest.mark.parametrize("blur", [motion_blur, disc_blur])


def picture(*shape: int) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(0).random(shape, dtype=np.float32))


@pytest.mark.parametrize("extent", EXTENTS)
def test_second_moments_are_those_of_uniform_motion_and_of_a_uniform_disc(extent):
    streak, disc = motion_kernel(extent), disc_kernel(extent)
    # A disc's to a hundredth of a pixel: a tenth is where a blur begins to matter to any score.
    assert disc.shape == (len(disc),) * 2
    for weights, share, error in ((streak, 12, 1e-6), (disc.sum(0), 16, 0), (disc.sum(1), 16, 0)):
        offsets = np.arange(len(weights)) - len(weights) // 2
        assert len(weights) % 2 == 1
        assert weights.sum() == pytest.approx(1, rel=1e-9)
        assert weights @ offsets == pytest.approx(0, abs=1e-12)
        width = math.sqrt(share * (weights @ offsets**2))
        assert width == pytest.approx(extent, rel=error / 2, abs=0 if error else 0.01)
    assert min(streak.min(), disc.min()) >= 0
    np.testing.assert_allclose(disc, disc.T, atol=1e-12)
    np.testing.assert_allclose(disc, disc[::-1], atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [(23, 29), (3, 8), (1, 1)])
@pytest.mark.parametrize("extent", [*EXTENTS, 40.0, 300.5])
def test_application_is_scipys_convolution(extent, size, dtype):
    """Direct and Fourier sums of discs, running sums of streaks, streaks longer than the row."""
    image = picture(4, *size).to(dtype)
    before = image.double().numpy().copy()
    blurs = [motion_kernel(extent)[None, None]] + [disc_kernel(extent)[None]] * (extent < 100)
    for blur, weights in zip((motion_blur, disc_blur), blurs, strict=False):
        found = blur(image, extent)
        assert found.dtype == dtype
        expected = ndimage.convolve(before, weights, mode="nearest")
        np.testing.assert_allclose(found.numpy(), expected, atol=2e-6)
    np.testing.assert_array_equal(image.numpy(), before)


@BOTH
@pytest.mark.parametrize("extent", [0.4, 3.0, 9.0, 30.0])
def test_a_bright_lamp_leaves_no_ringing(blur, extent):
    image = torch.full((4, 64, 64), 1e-3)
    image[:, 32, 32] = 1e6
    out = blur(image, extent)
    assert float(out.min()) >= 1e-3 * (1 - 1e-5)
    np.testing.assert_allclose(out[:, 0, 0].numpy(), 1e-3, rtol=1e-5)
    np.testing.assert_allclose(out.double().sum((1, 2)), [1e6] * 4, rtol=1e-5)


def test_bad_extents_are_named():
    for bad in (-1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="`extent_px`"):
            motion_blur(torch.zeros(4, 2, 2), bad)
        with pytest.raises(ValueError, match="`diameter_px`"):
            disc_blur(torch.zeros(4, 2, 2), bad)


@pytest.mark.parametrize(
    ("motion", "defocus"), [(0, 0), (3.0, 0), (0, 4.0), (7.5, 2.5), (0.4, 14), (5000.3, 4.0)]
)
def test_kernel_energy_is_what_a_blur_leaves_of_white_noise(motion, defocus):
    """Averaging independent pixels multiplies the variance by the sum of squared weights."""
    disc, streak = disc_kernel(defocus), motion_kernel(motion)
    response = np.stack([np.convolve(row, streak) for row in disc])
    rel = 1e-6 if motion < 4096 else 1e-3  # of a longer one only the main term is computed
    assert kernel_energy(motion, defocus) == pytest.approx((response**2).sum(), rel=rel)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@BOTH
@pytest.mark.parametrize("extent", [0.4, 3.0, 30.0])
def test_cuda_agrees(blur, extent):
    image = picture(4, 33, 31)
    torch.testing.assert_close(
        blur(image.cuda(), extent).cpu(), blur(image, extent), atol=2e-5, rtol=0
    )


@pytest.mark.parametrize("window", [1, 3, 5, 7, 9, 25])
@pytest.mark.parametrize("size", [(1, 1), (16, 16), (1, 30), (23, 41)])
def test_box_mean_is_scipys_uniform_filter(window, size):
    image = picture(2, 3, *size)
    sides = (1, 1, window, window)
    expected = ndimage.uniform_filter(image.double().numpy(), sides, mode="nearest")
    np.testing.assert_allclose(box_mean(image, window).numpy(), expected, rtol=2e-6, atol=1e-6)
