"""Statistics of a light against brute force and closed forms, and light that a network denoises."""

import math
import pickle

import numpy as np
import pytest
import torch

from simulator import NoiseLevelFunction, get_camera
from simulator.capture import statistics as module
from simulator.capture.statistics import LightStatistics, Residual, ResidualStatistics, wiener_error
from simulator.optics.discs import disc_blur
from simulator.optics.motion import motion_blur

Z6 = get_camera("nikon_z6")
ZERO = NoiseLevelFunction.zero()


def nlf(shot: float, read: float) -> NoiseLevelFunction:
    return NoiseLevelFunction((shot,) * 4, (read,) * 4)


def numbers(noise: NoiseLevelFunction) -> np.ndarray:
    """(2, 4) shot and read noise."""
    return np.array([noise.shot, noise.read])


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


def blur_error(statistics, ratio, target, streak=0.0, disc=0.0):
    """Bound on the error of leaving out a blur of these extents [pixel]."""
    noises = numbers(target)
    per_disc, per_streak = module.curvature(statistics.columns, ratio, noises)
    return per_disc * disc**2 + per_streak * streak**2


def excess_error(statistics, ratio, *noises):
    """Of leaving the noise of a source, where that of a target is wanted."""
    bins = statistics.bins
    return module.excess_error(bins[0], bins[1:3], ratio, *map(numbers, noises))


def tensor(light: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(light.astype(np.float32))


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
        stated = excess_error(statistics, ratio, first, second)
        # White noise has pixels much darker than the rest of their bin.
        assert 0.998 * expected <= stated <= 1.1 * expected + 0.07


def test_excess_of_a_grey_patch_by_hand() -> None:
    """Variances 4e-6 + 2e-5 x against 1e-6 + 1e-5 x, twice the exposure, x = 0.1:
    sqrt(4 * (4e-6 + 2e-6)) / sqrt(1e-6 + 2e-6) - 1 = sqrt(8) - 1."""
    source = nlf(2e-5, 4e-6)
    target = nlf(1e-5, 1e-6)
    statistics = LightStatistics(torch.full((4, 8, 8), 0.1))
    assert excess_error(statistics, 2.0, source, target) == pytest.approx(
        math.sqrt(8) - 1, rel=1e-6
    )
    half = torch.full((4, 8, 8), 0.1)
    half[..., :4] = 0.9  # white in the capture, whatever its noise
    error = excess_error(LightStatistics(half), 2.0, source, target)
    assert error == pytest.approx((math.sqrt(8) - 1) / math.sqrt(2), rel=1e-6)
    assert excess_error(statistics, 1.0, target, source) == 0.0
    assert excess_error(statistics, 1.0, ZERO, target) == 0.0


def test_levels_in_units_of_the_noise() -> None:
    light = LIGHTS["natural"]
    statistics = LightStatistics(tensor(light))
    zero = np.zeros_like(light)
    expected = exact(light, 3.0, 3.0 * light, zero, 400)
    bins, target = statistics.bins, numbers(Z6.nlf(400))
    level = module.relative_level(bins[0], bins[3], 3.0, target)
    assert level == pytest.approx(expected, rel=0.01)
    expected = exact(light, 3.0, zero, 3.0 * np.sqrt(variance(light, 1600)), 400)
    exposed = numbers(Z6.nlf(1600).exposed(3.0))
    found = math.sqrt(module.variance_beyond(bins[0], bins[3], 3.0, exposed, target, 0.0))
    assert found == pytest.approx(expected, rel=0.01)
    assert excess_error(statistics, 1.0, Z6.nlf(100), ZERO) > 1e6  # without noise all is seen
    assert blur_error(statistics, 1.0, ZERO, 0.01, 0.0) > 1e6


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


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (3, 5)])
@pytest.mark.parametrize("extreme", [False, True])
def test_any_size_and_light(shape: tuple[int, int], extreme: bool) -> None:
    light = np.random.default_rng(0).random((4, *shape))
    if extreme:
        light.reshape(4, -1)[:, :3] = np.array([3e38, -3e38, -0.07])[: light[0].size]
    statistics = LightStatistics(tensor(light))
    for ratio in (1e-12, 1.0, 1e12):
        error = excess_error(statistics, ratio, Z6.nlf(6400), Z6.nlf(100))
        assert math.isfinite(error)
        assert error > 1.0 or ratio != 1.0 or extreme
        assert 0.0 <= blur_error(statistics, ratio, Z6.nlf(100), 1.0, 1.0) < math.inf


@pytest.mark.parametrize("shape", [(1024, 1024), (3, 4 * module.SAMPLES), (4 * module.SAMPLES, 3)])
def test_large_frames_are_sampled(shape: tuple[int, int]) -> None:
    light = np.random.default_rng(0).random((4, *shape), dtype=np.float32)
    light *= np.linspace(0.1, 1.0, shape[1], dtype=np.float32)
    statistics = LightStatistics(torch.from_numpy(light))
    flat = nlf(0.0, 1e-6)
    padded = np.pad(light[0].astype(np.float64), 1, mode="edge")
    laplacian = (
        padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:] - 4 * light[0]
    )
    expected = math.sqrt((laplacian**2).mean() / 1e-6) / 32
    # Of three rows only one is looked at, or of three columns two at the border.
    assert blur_error(statistics, 1.0, flat, 0.0, 1.0) == pytest.approx(expected, rel=0.25)


# -- errors of networks -----------------------------------------------------------------------


def leaves(bias: float, variance: float, *, detailed: float = 0.0) -> Residual:
    """Squared bias and variance of a network without detail, and squared bias with much of it."""
    tables = np.array([bias, detailed]), np.full(2, variance)
    return Residual(np.array([0.0, 1.0]), *tables, 1.0)


@pytest.mark.parametrize("variance", [0.0, 0.3, 3.0])
def test_noise_that_is_left_in_a_flat_field_and_in_white_noise(variance: float) -> None:
    """A standard deviation of 1 becomes sqrt(1 + v); without noise on top, sqrt(v) is left."""
    noise, rng = nlf(0.0, 4e-6), np.random.default_rng(0)
    white = torch.from_numpy(rng.normal(0.5, 2e-3, (4, 64, 64)).astype(np.float32))
    for light in (white, torch.full((4, 64, 64), 0.5), torch.full((4, 3, 5), 0.5)):
        found, network = ResidualStatistics(light, noise), leaves(0.0, variance)
        expected = math.sqrt(1.0 + variance) - 1.0
        assert found.error(network, 1.0, noise) == pytest.approx(expected)
        alone = found.error(network, 1.0, noise, noise=False)
        assert alone == pytest.approx(math.sqrt(variance))


def test_exposure_and_target_by_hand() -> None:
    """Noise 1e-4 * 0.05 + 1e-6 times 8^2 on top of 2e-4 * 0.4 + 1e-5; squared bias of 0.09."""
    relative = (1e-4 * 0.05 + 1e-6) * 64 / (2e-4 * 0.4 + 1e-5)
    found = ResidualStatistics(torch.full((4, 16, 24), 0.05), nlf(1e-4, 1e-6))
    network, target = leaves(0.09, 0.5, detailed=0.09), nlf(2e-4, 1e-5)
    expected = math.hypot(0.3 * math.sqrt(relative), math.sqrt(1 + 0.5 * relative) - 1)
    assert found.error(network, 8.0, target) == pytest.approx(expected)
    expected = math.sqrt((0.09 + 0.5) * relative)
    assert found.error(network, 8.0, target, noise=False) == pytest.approx(expected)
    assert found.error(network, 64.0, target) == 0.0  # a white frame
    assert found.error(network, 64.0, target, noise=False) > 1.0
    again = pickle.loads(pickle.dumps(found))
    assert again.error(network, 8.0, target, noise=False) == pytest.approx(expected)


def test_levels_of_light_count_by_their_share() -> None:
    """Read noise against shot noise: in units of the target's, light of 0.1 and 0.4, half each."""
    light = torch.full((4, 64, 48), 0.1)
    light[:, 32:] = 0.4
    found = ResidualStatistics(light, nlf(0.0, 1e-6))
    squares = [0.25 * 1e-6 / (1e-5 * level) for level in (0.1, 0.4)]
    error = found.error(leaves(0.25, 0.0, detailed=0.25), 1.0, nlf(1e-5, 0.0))
    assert error == pytest.approx(math.sqrt(sum(squares) / 2), rel=1e-5)


@pytest.mark.parametrize("amplitude", [0.0004, 0.002, 0.05])
@pytest.mark.parametrize("size", [(32, 128), (90, 128)])
def test_wiener_error_of_waves_by_hand(amplitude: float, size: tuple[int, int]) -> None:
    """Octave by octave: S / (1 + S) of the noise, for shares 3/4, 3/16, 3/64 and the rest.

    The mean of a wave over n pixels has sin(nk/2) / (n sin(k/2)) of its amplitude, the Laplacian of
    a cos(nkx) is 2 a (1 - cos nk) cos(nkx), and that of noise has 20 variances.
    """
    k, variance, expected = 2 * math.pi / 32, 1e-6 * 0.3 + 1e-7, 0.0
    for n, share in ((1, 3 / 4), (2, 3 / 16), (4, 3 / 64), (8, 1 / 64)):
        left = amplitude * math.sin(n * k / 2) / (n * math.sin(k / 2))
        energy = (2 * left * (1 - math.cos(n * k))) ** 2 / 2
        excess = max(energy / (20 * variance / n**2) - 1.0, 0.0)
        expected += share * excess / (1.0 + excess)
    wave = torch.cos(k * (torch.arange(128, dtype=torch.float64) + 0.5)).float()
    light = (0.3 + amplitude * wave).expand(4, *size)
    error = wiener_error(light, nlf(1e-6, 1e-7))
    assert error.shape == tuple(n // 8 for n in size)
    np.testing.assert_allclose(error.numpy(), max(expected, 2 / math.prod(size)), rtol=2e-3)
    assert (expected > 0.01) == (amplitude > 0.001)


def test_wiener_error_of_noise_is_hardly_any_and_of_too_much_noise_is_its_excess() -> None:
    """Twice the deviation is four times the energy: S is 3, whatever the octave."""
    rng, noise = np.random.default_rng(1), nlf(0.0, 1e-6)
    for scale, least, most in ((1e-3, 0.0, 0.005), (2e-3, 0.745, 0.755)):
        light = torch.from_numpy(rng.normal(0.2, scale, (4, 256, 256)).astype(np.float32))
        assert least <= float(wiener_error(light, noise).mean()) <= most


def test_wiener_error_is_that_of_the_place() -> None:
    """Noise that is taken for detail in one half of the frame does not count in the other."""
    rng = np.random.default_rng(2)
    scale = np.where(np.arange(192) < 64, 1e-3, 8e-3)
    light = torch.from_numpy(rng.normal(0.2, scale, (4, 100, 192)).astype(np.float32))
    error = wiener_error(light, nlf(0.0, 1e-6))
    assert error.shape == (12, 24)
    assert float(error[:, :4].max()) < 0.02  # the next window borders on the other half
    assert float(error[:, 8:].min()) > 0.95
    assert torch.equal(error[11], error[8])  # the rest belongs to the last window


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (5, 3), (17, 64)])
def test_wiener_error_of_small_frames(size: tuple[int, int]) -> None:
    """Few samples cannot be averaged: n keep about an nth of their noise, however flat it is."""
    error = wiener_error(torch.full((4, *size), 0.2), nlf(0.0, 1e-6))
    assert error.shape == tuple(max(1, n // 8) for n in size)
    assert torch.equal(error, torch.full_like(error, min(1.0, 2.0 / math.prod(size))))


def test_tables_are_read_by_the_logarithm_of_the_wiener_error() -> None:
    """0.097, 0.197, 0.397 and the 0.003 that is there by chance: 0.1, 0.2, 0.4."""
    table = np.array([0.2, 0.6]), np.array([1.0, 0.0])
    residual = Residual(np.array([0.097, 0.397]), *table, 1.0)
    bias, variance = residual.at(np.array([0, 0.097, 0.197, 0.397, 1]))
    np.testing.assert_allclose(bias, [0.2, 0.2, 0.4, 0.6, 0.6])
    np.testing.assert_allclose(variance, [1.0, 1.0, 0.5, 0.0, 0.0], atol=1e-12)


def test_of_a_large_frame_some_rows_are_sampled(monkeypatch: pytest.MonkeyPatch) -> None:
    light = torch.rand(1, 1, 64, generator=torch.Generator().manual_seed(0)).expand(4, 256, 64)
    network, noise = leaves(0.0, 0.2, detailed=3.0), nlf(1e-3, 1e-5)
    whole = ResidualStatistics(light, noise).error(network, 2.0, noise)

    # Frames that are large enough take seconds.
    monkeypatch.setattr(module, "_BLOCKS", 32)
    assert ResidualStatistics(light, noise).error(network, 2.0, noise) == pytest.approx(whole)


def test_cards() -> None:
    card = {"wiener_error": [0.0, 0.5], "bias": [0.5, 0.25], "variance": [1.0, 0.75]}
    card["spread"] = 1.25
    assert Residual.from_card(card).to_card() == card
    bad = {"spread": [None, 0.9], "bias": [["a", 1], [1.0]], "variance": [[1, math.nan], [1, -1]]}
    for change in ({name: value} for name, values in bad.items() for value in values):
        with pytest.raises(ValueError, match=r"`residual`|must be"):
            Residual.from_card(card | change)


def test_the_network_runs_once_when_it_is_needed() -> None:
    calls: list[int] = []
    light = torch.rand(4, 6, 5)

    def denoise() -> torch.Tensor:
        calls.append(1)
        return light

    lazy = module.DenoisedLight(denoise, name="nano", operations=3, everywhere=False)
    moved = lazy.to(torch.device("cpu"))
    assert lazy.shape is None
    assert not calls
    again = pickle.loads(pickle.dumps(moved))
    for made in (moved, lazy, again):
        assert torch.equal(made.light, light)
        assert torch.equal(made.statistics.light, light)
        assert (made.name, made.operations, made.everywhere) == ("nano", 3, False)
        assert made.shape == light.shape
        assert made.to(torch.device("cpu")) is made
    assert calls == [1]
    with pytest.raises(ValueError, match="`denoised`"):
        module.DenoisedLight(light[:3])
