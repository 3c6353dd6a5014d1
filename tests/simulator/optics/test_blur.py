"""Blur kernels against closed forms, and their application against SciPy's convolution."""

import math

import numpy as np
import pytest
import torch
from scipy import ndimage

from simulator.optics import blur as blur_module
from simulator.optics.blur import (
    Blur,
    blur_many,
    box_mean,
    coverage,
    disc_blur,
    disc_kernel,
    kernel_energy,
    motion_blur,
    motion_kernel,
)

EXTENTS = [0.1, 0.3, 0.5, 0.9, 1.0, 1.5, 2.0, 2.5, 3.0, 4.7, 8.0, 11.3, 12.5, 16.0, 21.4, 30.0]
BOTH = pytest.mark.parametrize("blur", [motion_blur, disc_blur])


def lamp(*shape: int) -> torch.Tensor:
    """Random light with a lamp 500 times as bright."""
    light = torch.rand(shape, generator=torch.Generator().manual_seed(0)) + 0.01
    light.view(-1)[light.numel() // 2] = 500.0
    return light


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


@pytest.mark.parametrize(
    "shape", [(1, 1, 1), (1, 1, 5), (4, 5, 1), (37, 53), (2, 3, 4, 6, 24), (4, 128, 128)]
)
@pytest.mark.parametrize(
    ("blur", "extent"),
    [(motion_blur, e) for e in (0.02, 1.0, 2.9, 8.0, 31.0, 130.0, 5000.0)]
    + [(disc_blur, d) for d in (0.1, 1.0, 3.3, 8.0, 20.0)],
)
def test_float32_is_that_of_float64(blur, extent, shape):
    """The kernels for the CPU against sums in torch, which other types and devices take."""
    light = lamp(*shape)
    found, wanted = blur(light, extent).numpy(), blur(light.double(), extent).numpy()
    rtol, atol = (2e-6, 0) if blur is motion_blur else (5e-6, 2e-5 * (extent > 12))
    np.testing.assert_allclose(found, wanted, rtol=rtol, atol=atol)


@BOTH
def test_threads_and_views_change_nothing(blur, monkeypatch):
    light = lamp(4, 301, 257)
    alone = blur(light, 4.0)
    view = torch.stack([light, light], dim=-1)[..., 0]  # not contiguous
    assert torch.equal(blur(view, 4.0), alone)
    for threads in (2, 3):
        monkeypatch.setattr("simulator.utils.compute.thread_count", lambda n=threads: n)
        assert torch.equal(blur(light, 4.0), alone)


def test_outputs_and_no_extent():
    light, out = lamp(4, 8, 8), torch.empty(4, 8, 8)
    assert motion_blur(light, 0.0) is light
    assert disc_blur(light, 0.0) is light
    assert torch.equal(motion_blur(light, 0.0, out), light)
    assert motion_blur(light, 3.0, out) is out
    assert torch.equal(out, motion_blur(light, 3.0))


@pytest.mark.parametrize("extent", [3.0, 9.0, 200.0])
def test_light_beyond_the_limit_is_clipped_first(extent):
    light = lamp(4, 16, 24)
    light[0, 3, 4], light[1, 5, 6] = 1e30, -1e30
    found = motion_blur(light, extent, limit=1e9).numpy()
    wanted = motion_blur(light.clamp(-1e9, 1e9).double(), extent)
    np.testing.assert_allclose(found, wanted, rtol=2e-6, atol=300)
    out = torch.empty(4, 16, 24)
    blur_many([Blur(light, 3.0, out)], limit=1e9)
    wanted = disc_blur(light.clamp(-1e9, 1e9).double(), 3.0)
    np.testing.assert_allclose(out, wanted, rtol=2e-6, atol=300)


@pytest.mark.parametrize("radius", [0.3, 0.5, 0.6, 1.0, 2.49, 2.5, 7.3])
def test_coverage_is_that_of_many_rows_and_columns(radius):
    reach, rows = max(math.ceil(radius - 0.5), 0), 32
    edges = np.arange(-reach, reach + 2) - 0.5
    y = (np.arange((2 * reach + 1) * rows) + 0.5) / rows - reach - 0.5
    chord = np.sqrt(np.maximum(radius**2 - y**2, 0.0))[:, None]
    area = np.diff(np.clip(edges, -chord, chord), axis=1).reshape(2 * reach + 1, rows, -1).sum(1)
    area += area.T
    wanted = (area / area.sum())[reach:, reach:]
    np.testing.assert_allclose(coverage(radius), wanted, atol=1e-14)


@pytest.mark.parametrize("threads", [1, 3])
def test_many_images_are_scipys_correlation(threads, monkeypatch):
    for module in ("utils.compute", "optics.blur"):
        monkeypatch.setattr(f"simulator.{module}.thread_count", lambda: threads)
    extents = [(0.0, 5.0), (3.3, 0.0), (8.0, 17.0), (1e-4, 1e-7), (2.0, 90.0), (0.7, 0.4)]
    blurs = []
    for extent in extents:
        outputs = [torch.empty(4, 21, 40) if each else None for each in extent]
        blurs.append(Blur(torch.rand(4, 21, 40), extent[0], outputs[0], extent[1], outputs[1]))
    blur_many(blurs)
    for light, diameter, defocused, extent, moved in blurs:
        weights = disc_kernel(diameter)[None]
        wanted = ndimage.correlate(light.double().numpy(), weights, mode="nearest")
        if defocused is not None:
            np.testing.assert_allclose(defocused, wanted, rtol=5e-6)
        wanted = ndimage.correlate1d(wanted, motion_kernel(extent), mode="nearest")
        if moved is not None:
            np.testing.assert_allclose(moved, wanted, rtol=1e-5)
    blur_many([])


@pytest.mark.parametrize("extent", [0.0, 5.0])
def test_wide_discs_in_the_fourier_domain_are_those_of_the_sum(monkeypatch, extent):
    light, narrow = torch.rand(4, 64, 48), torch.empty(4, 64, 48)
    light[:, 20, 20], results = 1e6, []
    for widest in (blur_module._WIDE_PX, 1e9):
        monkeypatch.setattr(blur_module, "_WIDE_PX", widest)
        defocused, moved = torch.empty_like(light), torch.empty_like(light)
        wide = Blur(light, 48.0, defocused, extent, moved if extent else None)
        blur_many([wide, Blur(light, 3.0, narrow)], limit=1e3)
        results.append([defocused, narrow.clone()] + [moved] * bool(extent))
    for fourier, direct in zip(*results, strict=True):
        torch.testing.assert_close(fourier, direct, rtol=1e-4, atol=1e-5)


def test_a_streak_is_the_same_compiled_and_loaded(compiled_and_loaded):
    """A sum of two products may be fused either way, and was: each process chose its own."""
    code = (
        "import torch; from simulator.optics.blur import _moved, motion_blur\n"
        "light = torch.rand(1, 9, 100, generator=torch.Generator().manual_seed(0))\n"
        "blurred = [motion_blur(light, extent) for extent in (1.3, 5.5, 11.2)]\n"
        "print(*_moved.stats.cache_hits.values(), torch.stack(blurred).numpy().tobytes().hex())\n"
    )
    (compiled,), (hits, loaded) = compiled_and_loaded(code)
    assert (hits, loaded) == ("1", compiled)


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
