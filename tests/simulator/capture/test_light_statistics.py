"""Statistics of light against brute force, and the bound on a blur against the blur itself."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from simulator import NoiseLevelFunction, get_camera
from simulator.capture.light_statistics import SAMPLES, LightStatistics
from simulator.optics.blur import disc_blur, motion_blur

Z6 = get_camera("nikon_z6")


def natural(height: int = 96, width: int = 128, seed: int = 0) -> np.ndarray:
    """Light with the 1 / f spectrum of photographs, log-normal over three stops, (4, H, W)."""
    rng = np.random.default_rng(seed)
    rows, columns = np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width)[None]
    frequency = np.hypot(rows, columns)
    frequency[0, 0] = 1.0
    spectrum = np.fft.fft2(rng.normal(size=(4, height, width))) / frequency
    field = np.fft.ifft2(spectrum).real
    field /= field.std(axis=(1, 2), keepdims=True)
    return np.exp2(1.5 * field - 4.0)


def sparse(height: int = 96, width: int = 128, seed: int = 0) -> np.ndarray:
    """Lamps in the dark, some at the border: a hundred times white."""
    rng = np.random.default_rng(seed)
    light = np.full((4, height, width), 1e-3)
    light[:, rng.integers(0, height, 12), rng.integers(0, width, 12)] = 100.0
    light[:, 0, 5] = light[:, 40, -1] = 100.0
    return light


def stripes(period: int) -> np.ndarray:
    columns = np.arange(128) // max(period // 2, 1) % 2
    return np.broadcast_to(0.1 + 0.8 * columns, (4, 96, 128)).copy()


LIGHTS = {
    "natural": natural(),
    "white noise": np.random.default_rng(1).random((4, 96, 128)),
    "lamps": sparse(),
    "finest stripes": stripes(2),
    "stripes": stripes(16),
    "an edge": np.repeat(np.linspace(0, 1, 128) > 0.5, 96).reshape(128, 96).T * np.ones((4, 1, 1)),
    "a ramp": np.broadcast_to(np.linspace(0.0, 1.0, 128), (4, 96, 128)),
}


def exact(light: np.ndarray, ratio: float, dm: np.ndarray, ds: np.ndarray, iso: float) -> float:
    return math.sqrt(((dm**2 + ds**2) / variance(ratio * light, iso)).mean())


def variance(signal: np.ndarray, iso: float) -> np.ndarray:
    shot, read = (np.array(v)[:, None, None] for v in (Z6.nlf(iso).shot, Z6.nlf(iso).read))
    return read + shot * np.maximum(signal, 0.0)


def blur_error(
    statistics: LightStatistics,
    ratio: float,
    target: NoiseLevelFunction,
    streak: float = 0.0,
    disc: float = 0.0,
) -> float:
    """Bound on the error of leaving out a blur of these extents [pixel]."""
    per_disc, per_streak = statistics.curvature(ratio, target)
    return per_disc * disc**2 + per_streak * streak**2


def tensor(light: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(light.astype(np.float32))


# Noise


@pytest.mark.parametrize("name", ["natural", "white noise", "stripes"])
@pytest.mark.parametrize("ratio", [0.125, 1.0, 3.0])
def test_excess_bounds_that_of_all_pixels_closely(name: str, ratio: float) -> None:
    light = LIGHTS[name] / max(ratio, 1.0)
    statistics = LightStatistics(tensor(light))
    for source, target in [(6400, 100), (400, 100), (100, 100), (100, 1600)]:
        first, second = Z6.nlf(source), Z6.nlf(target)
        given, wanted = ratio**2 * variance(light, source), variance(ratio * light, target)
        spread = np.maximum(np.sqrt(given) - np.sqrt(wanted), 0.0)
        spread[ratio * light - 4.0 * np.sqrt(given) > 1.0] = 0.0  # white in any case
        expected = exact(light, ratio, np.zeros_like(light), spread, target)
        stated = statistics.excess_error(ratio, first, second)
        # White noise has pixels much darker than the rest of their bin.
        assert 0.998 * expected <= stated <= 1.1 * expected + 0.07


def test_excess_of_a_grey_patch_by_hand() -> None:
    """Variances 4e-6 + 2e-5 x against 1e-6 + 1e-5 x, twice the exposure, x = 0.1:
    sqrt(4 * (4e-6 + 2e-6)) / sqrt(1e-6 + 2e-6) - 1 = sqrt(8) - 1."""
    source = NoiseLevelFunction((2e-5,) * 4, (4e-6,) * 4)
    target = NoiseLevelFunction((1e-5,) * 4, (1e-6,) * 4)
    statistics = LightStatistics(torch.full((4, 8, 8), 0.1))
    assert statistics.excess_error(2.0, source, target) == pytest.approx(math.sqrt(8) - 1, rel=1e-6)
    half = torch.full((4, 8, 8), 0.1)
    half[..., :4] = 0.9  # white in the capture, whatever its noise
    error = LightStatistics(half).excess_error(2.0, source, target)
    assert error == pytest.approx((math.sqrt(8) - 1) / math.sqrt(2), rel=1e-6)
    assert statistics.excess_error(1.0, target, source) == 0.0
    assert statistics.excess_error(1.0, NoiseLevelFunction.zero(), target) == 0.0


def test_levels_in_units_of_the_noise() -> None:
    light = LIGHTS["natural"]
    statistics = LightStatistics(tensor(light))
    zero = np.zeros_like(light)
    assert statistics.relative_level(3.0, Z6.nlf(400)) == pytest.approx(
        exact(light, 3.0, 3.0 * light, zero, 400), rel=0.01
    )
    deviation = 3.0 * np.sqrt(variance(light, 1600))
    assert statistics.relative_noise(3.0, Z6.nlf(1600), Z6.nlf(400)) == pytest.approx(
        exact(light, 3.0, zero, deviation, 400), rel=0.01
    )


@pytest.mark.parametrize("ratio", [0.5, 3.0])
def test_excess_variance_over_all_pixels(ratio: float) -> None:
    """Of a source that is on the target's scale."""
    light = LIGHTS["natural"]
    expected = np.maximum(variance(ratio * light, 1600) / variance(ratio * light, 400) - 1.0, 0.0)
    stated = LightStatistics(tensor(light)).relative_excess_variance(
        ratio, Z6.nlf(1600), Z6.nlf(400)
    )
    assert stated == pytest.approx(expected.mean(), rel=0.01)


def test_median_of_each_plane() -> None:
    light = LIGHTS["natural"] * np.array([1.0, 2.0, 3.0, -1.0])[:, None, None]
    median = LightStatistics(tensor(light)).median  # of a sample
    np.testing.assert_allclose(median[:3], np.median(light[:3], axis=(1, 2)), rtol=0.03)
    assert median[3] == 0.0


def test_median_of_columns_that_repeat() -> None:
    """Every fourth column is bright: whatever pixels are looked at, most are not."""
    light = torch.full((4, 128, 128), 0.002)
    light[..., ::4] = 0.5
    np.testing.assert_allclose(LightStatistics(light).median, 0.002, rtol=1e-6)


# Blur


@pytest.mark.parametrize("name", list(LIGHTS))
@pytest.mark.parametrize("iso", [100, 6400])
def test_no_blur_moves_the_light_by_more_than_its_bound(name: str, iso: float) -> None:
    light = tensor(LIGHTS[name])
    statistics, target = LightStatistics(light), Z6.nlf(iso)
    still = light.double().numpy()
    for extent in (0.05, 1.0, 2.5, 9.0):
        for ratio in (0.25, 4.0):
            for blurred, bound in (
                (disc_blur(light, extent), blur_error(statistics, ratio, target, disc=extent)),
                (motion_blur(light, extent), blur_error(statistics, ratio, target, extent)),
            ):
                moved = blurred.double().numpy()
                before, after = variance(ratio * still, iso), variance(ratio * moved, iso)
                ds = np.sqrt(before) - np.sqrt(after)
                error = exact(still, ratio, ratio * (moved - still), ds, iso)
                assert error <= bound * 1.001 + 1e-5, (extent, ratio)


# Sizes and extremes


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (3, 5)])
@pytest.mark.parametrize("extreme", [False, True])
def test_any_size_and_light(shape: tuple[int, int], extreme: bool) -> None:
    light = np.random.default_rng(0).random((4, *shape))
    if extreme:
        light.reshape(4, -1)[:, :3] = np.array([3e38, -3e38, -0.07])[: light[0].size]
    statistics = LightStatistics(tensor(light))
    for ratio in (1e-12, 1.0, 1e12):
        error = statistics.excess_error(ratio, Z6.nlf(6400), Z6.nlf(100))
        assert math.isfinite(error)
        assert error > 1.0 or ratio != 1.0 or extreme
        assert 0.0 <= blur_error(statistics, ratio, Z6.nlf(100), 1.0, 1.0) < math.inf


@pytest.mark.parametrize("shape", [(1024, 1024), (3, 4 * SAMPLES), (4 * SAMPLES, 3)])
def test_large_frames_are_sampled(shape: tuple[int, int]) -> None:
    light = np.random.default_rng(0).random((4, *shape), dtype=np.float32)
    light *= np.linspace(0.1, 1.0, shape[1], dtype=np.float32)
    statistics = LightStatistics(torch.from_numpy(light))
    flat = NoiseLevelFunction((0.0,) * 4, (1e-6,) * 4)
    padded = np.pad(light[0].astype(np.float64), 1, mode="edge")
    laplacian = (
        padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:] - 4 * light[0]
    )
    expected = math.sqrt((laplacian**2).mean() / 1e-6) / 32
    # Of three rows only one is looked at, or of three columns two at the border.
    assert blur_error(statistics, 1.0, flat, 0.0, 1.0) == pytest.approx(expected, rel=0.25)


def test_a_target_without_noise_sees_everything() -> None:
    statistics = LightStatistics(tensor(LIGHTS["natural"]))
    assert statistics.excess_error(1.0, Z6.nlf(100), NoiseLevelFunction.zero()) > 1e6
    assert blur_error(statistics, 1.0, NoiseLevelFunction.zero(), 0.01, 0.0) > 1e6
