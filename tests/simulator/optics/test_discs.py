"""Discs, streaks and banks of discs: closed forms, SciPy's convolution, sums in torch."""

import math

import numpy as np
import pytest
import torch
from scipy import ndimage

from simulator.optics.discs import (
    DIAMETERS,
    Blur,
    DiscBank,
    blur_many,
    box_mean,
    disc_blur,
    disc_kernel,
    kernel_energy,
    remaining_variance,
)
from simulator.optics.motion import motion_blur, motion_kernel

BETWEEN = [0.35, 0.85, 1.2, 1.7, 2.4, 3.3, 5.0, 6.5, 9.7, 14.0, 19.0, 27.0]
KNOTS = np.array(DIAMETERS) ** 2
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


def test_outputs_and_no_or_bad_extents():
    light, out = lamp(4, 8, 8), torch.empty(4, 8, 8)
    assert motion_blur(light, 0.0) is light
    assert disc_blur(light, 0.0) is light
    assert torch.equal(motion_blur(light, 0.0, out), light)
    assert motion_blur(light, 3.0, out) is out
    assert torch.equal(out, motion_blur(light, 3.0))
    for bad in (-1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="`extent_px`"):
            motion_blur(light, bad)
        with pytest.raises(ValueError, match="`diameter_px`"):
            disc_blur(light, bad)


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


@pytest.mark.parametrize("threads", [1, 3])
def test_many_images_are_scipys_correlation(threads, monkeypatch):
    for module in ("utils.compute", "optics.discs"):
        monkeypatch.setattr(f"simulator.{module}.thread_count", lambda: threads)
    extents = [
        (48.0, 5.0),
        (0.0, 5.0),
        (3.3, 0.0),
        (8.0, 17.0),
        (1e-4, 1e-7),
        (2.0, 90.0),
        (0.7, 0.4),
    ]
    blurs = []
    for extent in extents:
        outputs = [torch.empty(4, 21, 40) if each else None for each in extent]
        blurs.append(Blur(torch.rand(4, 21, 40), extent[0], outputs[0], extent[1], outputs[1]))
    blur_many(blurs)
    for light, diameter, defocused, extent, moved in blurs:
        rtol = 5e-6 if diameter < 40 else 1e-4  # wide discs in the Fourier domain
        weights = disc_kernel(diameter)[None]
        wanted = ndimage.correlate(light.double().numpy(), weights, mode="nearest")
        if defocused is not None:
            np.testing.assert_allclose(defocused, wanted, rtol=rtol)
        wanted = ndimage.correlate1d(wanted, motion_kernel(extent), mode="nearest")
        if moved is not None:
            np.testing.assert_allclose(moved, wanted, rtol=2 * rtol)
    blur_many([])


def test_a_streak_is_the_same_compiled_and_loaded(compiled_and_loaded):
    """A sum of two products may be fused either way, and was: each process chose its own."""
    code = (
        "import torch; from simulator.optics.motion import motion_blur, move_rows\n"
        "light = torch.rand(1, 9, 100, generator=torch.Generator().manual_seed(0))\n"
        "blurred = [motion_blur(light, extent) for extent in (1.3, 5.5, 11.2)]\n"
        "blurred = torch.stack(blurred).numpy().tobytes().hex()\n"
        "print(*move_rows.stats.cache_hits.values(), blurred)\n"
    )
    (compiled,), (hits, loaded) = compiled_and_loaded(code)
    assert (hits, loaded) == ("1", compiled)


@pytest.mark.parametrize("window", [1, 3, 5, 7, 9, 25])
@pytest.mark.parametrize("size", [(1, 1), (16, 16), (1, 30), (23, 41)])
def test_box_mean_is_scipys_uniform_filter(window, size):
    image = picture(2, 3, *size)
    sides = (1, 1, window, window)
    expected = ndimage.uniform_filter(image.double().numpy(), sides, mode="nearest")
    np.testing.assert_allclose(box_mean(image, window).numpy(), expected, rtol=2e-6, atol=1e-6)


def blurred(image: torch.Tensor, diameter: float) -> torch.Tensor:
    return DiscBank(image).blurred(torch.full(image.shape[-2:], diameter))


def uniform(*size: int, high: float = 1.0, seed: int = 0) -> torch.Tensor:
    values = np.random.default_rng(seed).uniform(0.0, high, size)
    return torch.from_numpy(values).float()


def through_torch(image: torch.Tensor, diameter: torch.Tensor) -> torch.Tensor:
    """What training uses: gradients flow through it."""
    return DiscBank(image).blurred(diameter.clone().requires_grad_()).detach()


@pytest.mark.parametrize("diameter", [*DIAMETERS, 100.0])
def test_at_its_diameters_and_beyond_them_it_is_the_disc_blur(diameter):
    image = uniform(2, 24, 31)
    expected = disc_blur(image, min(diameter, DIAMETERS[-1]))
    torch.testing.assert_close(blurred(image, diameter), expected, atol=2e-6, rtol=0)


@pytest.mark.parametrize("diameter", [*BETWEEN, 0.0, 11.3, 100.0])
def test_between_its_diameters_energy_and_second_moment_are_a_discs(diameter):
    """d^2 / 16 per axis: the moment of a uniform disc of diameter d."""
    point = torch.zeros(81, 81)
    point[40, 40] = 1.0
    spread = blurred(point, diameter).double().numpy()
    offsets, moment = np.arange(81) - 40, min(diameter, DIAMETERS[-1]) ** 2 / 16
    assert spread.sum() == pytest.approx(1.0, abs=1e-5)
    assert spread.min() > -1e-7
    for marginal in (spread.sum(0), spread.sum(1)):
        assert marginal @ offsets**2 == pytest.approx(moment, rel=2e-3, abs=2e-4)
        assert marginal @ offsets == pytest.approx(0.0, abs=1e-5)
    # Of white noise the sum of squared weights is left.
    left = float(remaining_variance(torch.tensor(diameter)))
    assert left == pytest.approx((spread**2).sum(), rel=1e-4)


def test_gradient_is_finite_everywhere_and_right():
    image = uniform(1, 16, 16).requires_grad_()
    values = torch.tensor([0.0, 1e-9, 0.7, 1.3, 4.0, 32.0, 50.0])
    diameter = values.repeat(16, 3)[:, :16].clone().requires_grad_()
    DiscBank(image).blurred(diameter).square().sum().backward()
    assert diameter.grad is not None
    assert image.grad is None
    assert bool(diameter.grad.isfinite().all())
    assert bool((diameter.grad[:, 0] == 0).all())  # d(diameter^2) is 0 there
    with torch.no_grad():
        assert not DiscBank(image).blurred(diameter).requires_grad

    exact = torch.full((6, 6), 1.27, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(DiscBank(uniform(6, 6).double()).blurred, exact, eps=1e-5)


@pytest.mark.parametrize("size", [(1, 1), (1, 300), (40, 1), (130, 131), (9, 257)])
@pytest.mark.parametrize("high", [0.3, 3.0, 40.0])
def test_it_is_the_blend_of_whole_frames(size, high):
    image, diameter = uniform(4, *size, high=2.0), uniform(*size, high=high, seed=1)
    diameter.view(-1)[::7] = 0.0
    found = DiscBank(image).blurred(diameter)
    torch.testing.assert_close(found, through_torch(image, diameter), rtol=1e-6, atol=1e-6)


def test_interpolation_is_linear_in_the_squared_diameter():
    """Levels that are constants, by NumPy's own interpolation; only those in use are computed."""
    diameter = uniform(3, 200, high=35.0)
    bank = DiscBank(torch.zeros(2, 3, 200))
    for index in range(1, len(DIAMETERS)):
        bank._levels[index] = torch.full((2, 3, 200), float(index**2))  # stands for a blur
    wanted = np.interp(diameter.double() ** 2, KNOTS, [float(i * i) for i in range(len(KNOTS))])
    np.testing.assert_allclose(bank.blurred(diameter), np.stack([wanted] * 2), rtol=1e-5, atol=1e-5)
    few = DiscBank(torch.zeros(1, 40, 600))
    few.blurred(torch.tensor([0.3, 9.0]).repeat_interleave(20)[:, None].expand(40, 600))
    assert sorted(few._levels) == [0, 1, *(DIAMETERS.index(d) for d in (8.0, 11.3))]


def test_remaining_variance_is_that_of_each_pixels_kernel():
    """Of the blend of two discs by NumPy, in frames of any shape."""
    diameter = uniform(70, 30, high=35.0)
    found = remaining_variance(diameter)
    assert torch.equal(remaining_variance(diameter.double()[None])[0].float(), found)
    for y, x in np.ndindex(7, 3):
        squared = min(float(diameter[10 * y, 10 * x]) ** 2, KNOTS[-1])
        index = min(int(np.searchsorted(KNOTS, squared, side="right")), len(KNOTS) - 1)
        share = (squared - KNOTS[index - 1]) / (KNOTS[index] - KNOTS[index - 1])
        small, large = (disc_kernel(d) for d in DIAMETERS[index - 1 : index + 1])
        small = np.pad(small, (len(large) - len(small)) // 2)
        wanted = (((1 - share) * small + share * large) ** 2).sum()
        assert float(found[10 * y, 10 * x]) == pytest.approx(wanted, rel=2e-5)
