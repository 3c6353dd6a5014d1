"""Paths against shifted images, lamps against quadrature, discs against SciPy."""

import importlib.util
import math
import sys
from fractions import Fraction
from functools import partial

import numba
import numpy as np
import pytest
import torch
from scipy import ndimage
from scipy.integrate import quad
from scipy.ndimage import correlate

from simulator.networks.noise_module import box_mean
from simulator.optics import discs, motion
from simulator.optics.discs import DIAMETERS, DiscBank, disc_blur, disc_kernel
from simulator.optics.flicker_integral import Lamp, MainsLamp, PulsedLamp
from simulator.optics.motion import Movement, Path, motion_blur, path_blur, path_taps
from tests.simulator.tables import streak_kernel

# -- paths -----------------------------------------------------------------------------------------
PATHS = [
    Path(0.3, 0.4),
    Path(2.0, math.pi / 2),
    Path(7.3, 0.7, 1.2),
    Path(20.0, -2.0, -5.0),
    Path(9.0, 1.0, 0.5, drift_x=-6.0, drift_y=4.0),
    Path(0.0, drift_x=3.0, drift_y=-5.0),
]


@pytest.mark.parametrize("path", PATHS)
def test_taps_have_the_moments_of_the_path(path: Path) -> None:
    taps = path_taps(path, 200, 200)
    weights = taps.weights.astype(float)
    angle = path.direction + path.turn * (np.arange(2000) + 0.5) / 2000  # in parts of the exposure
    x, y = path.extent * np.cos(angle), path.extent * np.sin(angle)
    velocity = np.stack([x + path.drift_x, y + path.drift_y])
    assert motion.path_length(*path) == pytest.approx(np.hypot(*velocity).mean(), rel=2e-3)
    variances = (np.cumsum(velocity, axis=1) / 2000).var(axis=1)
    assert weights.sum() == pytest.approx(1.0, abs=1e-6)
    assert (weights >= 0.0).all()
    for places, wanted in zip((taps.columns, taps.rows), variances, strict=True):
        assert (weights * places).sum() == pytest.approx(0.0, abs=1e-4)
        assert (weights * places**2).sum() == pytest.approx(wanted, rel=2e-3, abs=1e-6)


def test_bad_movements_are_refused() -> None:
    with pytest.raises(ValueError, match="finite"):
        Movement(turn=math.inf)


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("size", [(30, 26), (5, 9)])
def test_blur_is_a_sum_of_shifts(path: Path, size: tuple[int, int]) -> None:
    """By SciPy, whose ``nearest`` replicates the border; shifts may leave the frame."""
    light = torch.rand(3, *size, generator=torch.Generator().manual_seed(1))
    blurred = path_blur(light, path_taps(path, *size))
    taps = path_taps(path, 100, 100)
    reach = int(max(np.abs(taps.rows).max(), np.abs(taps.columns).max()))
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    np.add.at(kernel, (taps.rows + reach, taps.columns + reach), taps.weights.astype(float))
    for plane, found in zip(light.double().numpy(), blurred, strict=True):
        wanted = correlate(plane, kernel, mode="nearest")
        np.testing.assert_allclose(found, wanted, atol=1e-5)


# -- lamps: light in closed form, by adaptive quadrature and exact fractions -----------------------

TIMES = (1 / 8000, 1 / 1000, 1 / 120, 0.01, 1 / 60, 0.35)
STARTS = (0.0, 0.0013, 0.00499999, 3.7)
#: An hour and a day on: the phase must be known as well as in the first second.
LATER = (3600.123, 86_400.7, -1e6 / 3)


@pytest.mark.parametrize("time", TIMES)
@pytest.mark.parametrize("frequency", [100.0, 120.0])
@pytest.mark.parametrize("depth", [0.3, 1.0])
def test_mains_light_is_its_integral(time, frequency, depth):
    def light(t: float) -> float:
        return 1.0 + depth * math.cos(2 * math.pi * (frequency * t + 0.2))

    lamp = MainsLamp(frequency, depth, phase=0.2)
    for start in STARTS:
        whole, _ = quad(light, start, start + time, epsabs=0, epsrel=1e-12, limit=500)
        assert lamp.mean_light(start, time) == pytest.approx(whole / time, rel=1e-9)


def _pulses(start: Fraction, time: Fraction, frequency: Fraction, duty: Fraction) -> Fraction:
    """Exact mean of a pulsed lamp: what each pulse and the exposure share, pulse by pulse."""
    on, stop = Fraction(0), start + time
    for pulse in range(math.floor(start * frequency) - 1, math.ceil(stop * frequency) + 2):
        begin = pulse / frequency
        on += max(Fraction(0), min(stop, begin + duty / frequency) - max(start, begin))
    return on / (time * duty)


@pytest.mark.parametrize("frequency", [1000, 7919, 20_000])
@pytest.mark.parametrize("duty", [0.01, 0.5, 0.99])
@pytest.mark.parametrize("time", [1 / 8000, 1 / 1000, 1 / 60])
def test_pulsed_light_is_the_exact_overlap(frequency, duty, time):
    lamp = PulsedLamp(frequency, duty)
    for start in (*STARTS, *LATER):
        exact = float(_pulses(*map(Fraction, (start, time, frequency, duty))))
        assert lamp.mean_light(start, time) == pytest.approx(exact, rel=1e-9, abs=1e-12)


def test_rows_are_exposed_one_after_the_other():
    lamp, time, row_time = MainsLamp(100.0, 0.8, phase=0.1), 1 / 1000, 20e-6
    rows, whole = lamp.row_light([0.5, 0.7], [time, 0.01], 64, row_time, 4, phase=[0.2, 0.9])
    starts = 0.5 + row_time * np.arange(64 * 4).reshape(64, 4)
    wanted = np.vectorize(MainsLamp(100.0, 0.8, phase=0.3).mean_light)(starts, time).mean(1)
    np.testing.assert_allclose(rows, wanted, rtol=1e-12)
    np.testing.assert_allclose(whole, 1.0, rtol=1e-12)
    # Bands of one period: 10 ms are 500 sensor rows of 20 us, 125 rows of four.
    repeated = lamp.row_light(0.5, time, 250, row_time, sensor_rows=4)
    np.testing.assert_allclose(repeated[:125], repeated[125:], rtol=1e-9)


def test_bad_values_are_refused():
    rows = partial(Lamp().row_light, 0.0, 1.0, rows=4, row_time=1e-5)
    mean = partial(Lamp().mean_light, start=0.0, exposure_time=1.0)
    bad = [(MainsLamp, "frequency", 0.0), (MainsLamp, "depth", 1.5), (MainsLamp, "phase", math.nan)]
    bad += [(PulsedLamp, "duty", 0.0), (PulsedLamp, "frequency", "100")]
    bad += [(Movement, "subject_speed", -1.0), (mean, "start", math.inf)]
    bad += [(mean, "exposure_time", 0.0), (rows, "rows", 0), (rows, "row_time", -1e-5)]
    for make, name, value in bad:
        with pytest.raises(ValueError, match=f"`{name}`"):
            make(**{name: value})


# -- discs, streaks and banks of discs ------------------------------------------------------------
BETWEEN = [0.35, 0.85, 1.2, 1.7, 2.4, 3.3, 5.0, 6.5, 9.7, 14.0, 19.0, 27.0]
EXTENTS = [0.1, 0.3, 0.5, 0.9, 1.0, 1.5, 2.0, 2.5, 3.0, 4.7, 8.0, 11.3, 12.5, 16.0, 21.4, 30.0]


def uniform(*size: int, high: float = 1.0, seed: int = 0) -> torch.Tensor:
    values = np.random.default_rng(seed).uniform(0.0, high, size)
    return torch.from_numpy(values).float()


def lamp(*shape: int) -> torch.Tensor:
    """Random light with a lamp 500 times as bright."""
    light = torch.rand(shape, generator=torch.Generator().manual_seed(0)) + 0.01
    light.view(-1)[light.numel() // 2] = 500.0
    return light


@pytest.mark.parametrize("extent", EXTENTS)
def test_second_moments_are_those_of_uniform_motion_and_of_a_uniform_disc(extent):
    streak, disc = streak_kernel(extent), disc_kernel(extent)
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


@pytest.mark.parametrize(
    "shape", [(1, 1, 1), (1, 1, 5), (4, 5, 1), (37, 53), (2, 3, 4, 6, 24), (2, 128, 128)]
)
@pytest.mark.parametrize("extent", [*EXTENTS, 0.02, 40.0, 130.0, 5000.0])
def test_application_is_scipys_convolution(extent, shape):
    """Direct and Fourier sums of discs, running sums of streaks, streaks longer than the row.

    Those in float32 are kernels for the CPU; torch's sums serve other types and devices."""
    blurs = {motion_blur: streak_kernel(extent)[None]}
    blurs |= {disc_blur: disc_kernel(extent)} if extent < 100 else {}
    for blur, weights in blurs.items():
        kernel = weights.reshape(*[1] * (len(shape) - 2), *weights.shape)
        for light in (lamp(*shape), lamp(*shape).double()):
            found, before = blur(light, extent), lamp(*shape)
            assert found.dtype == light.dtype
            assert torch.equal(light, before.to(light.dtype))
            expected = ndimage.convolve(before.double().numpy(), kernel, mode="nearest")
            rtol, atol = (2e-6, 0) if blur is motion_blur else (5e-6, 2e-5 * (extent > 12))
            np.testing.assert_allclose(found.numpy(), expected, rtol=rtol, atol=atol)


@pytest.mark.parametrize(
    ("extent", "diameter"), [(0, 0), (3.0, 0), (0, 4.0), (7.5, 2.5), (0.4, 14), (5000.3, 4.0)]
)
def test_kernel_energy_is_what_a_blur_leaves_of_white_noise(extent, diameter):
    """Averaging independent pixels multiplies the variance by the sum of squared weights."""
    disc, streak = disc_kernel(diameter), streak_kernel(extent)
    response = np.stack([np.convolve(row, streak) for row in disc])
    found = discs.kernel_energy(extent, diameter, *discs.radius_table())
    assert found == pytest.approx((response**2).sum(), rel=1e-9)


def test_no_or_bad_extents():
    light = lamp(4, 8, 8)
    assert motion_blur(light, 0.0) is light
    assert disc_blur(light, 0.0) is light
    for bright in (torch.full((2, 7), 1e30), torch.full((2, 7), 1e30, dtype=torch.float64)):
        for extent in (1e12, 1e300):  # no sum and no square overflows
            torch.testing.assert_close(motion_blur(bright, extent), bright)
    view = torch.stack([light, light], dim=-1)[..., 0]  # not contiguous
    assert all(torch.equal(blur(view, 4.0), blur(light, 4.0)) for blur in (motion_blur, disc_blur))
    for bad in (-1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="`extent_px`"):
            motion_blur(light, bad)
        with pytest.raises(ValueError, match="`diameter_px`"):
            disc_blur(light, bad)


@pytest.mark.slow
def test_a_streak_is_the_same_compiled_and_loaded(tmp_path, monkeypatch):
    """A sum of two products may be fused either way, and was: each process chose its own."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    spec = importlib.util.spec_from_file_location("a_copy", motion.__file__)
    for hits in range(2):  # the first copy compiles its kernels
        copy = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, spec.name, copy)
        spec.loader.exec_module(copy)
        for extent in (1.3, 5.5, 11.2):
            light = uniform(1, 9, 100)
            assert torch.equal(copy.motion_blur(light, extent), motion_blur(light, extent))
        assert sum(copy.move_rows.stats.cache_hits.values()) == hits


@pytest.mark.parametrize("window", [1, 3, 5, 7, 9, 25])
@pytest.mark.parametrize("size", [(1, 1), (16, 16), (1, 30), (23, 41)])
def test_box_mean_is_scipys_uniform_filter(window, size):
    image = uniform(2, 3, *size)
    sides = (1, 1, window, window)
    expected = ndimage.uniform_filter(image.double().numpy(), sides, mode="nearest")
    found = box_mean(image, window).numpy()
    np.testing.assert_allclose(found, expected, rtol=2e-6, atol=1e-6)


def blurred(image: torch.Tensor, diameter: float) -> torch.Tensor:
    return DiscBank(image).blurred(torch.full(image.shape[-2:], diameter))


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
    left = discs.remaining_variance(torch.tensor([[[0.0], [diameter]]]))
    assert left.flatten().tolist() == pytest.approx([1.0, (spread**2).sum()], rel=1e-4)


def test_gradient_is_finite_everywhere_and_right():
    image = uniform(1, 16, 16).requires_grad_()
    values = torch.tensor([0.0, 1e-9, 0.7, 1.3, 4.0, 32.0, 50.0])
    diameter = values.repeat(16, 3)[:, :16].clone().requires_grad_()
    DiscBank(image).blurred(diameter).square().sum().backward()
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
    trained = DiscBank(image).blurred(diameter.clone().requires_grad_()).detach()
    torch.testing.assert_close(found, trained, rtol=1e-6, atol=1e-6)
