"""Rows and tails of read noise: against quadrature of the quantile function, and variances."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.stats import norm

from simulator.camera import CameraProfile, get_camera
from simulator.camera_simulator import CameraSimulator
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.sensor import Transitions, record
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.noise.read_noise import ReadNoise, averaged_shape, tukey_lambda
from simulator.reference.camera import ReferenceCamera
from simulator.settings import CameraSettings

BASE = CameraSettings(100, 1 / 64, 4)
ZERO = NoiseLevelFunction.zero()
READ, SHOT, SPAN, ROW = 1e-4, 2e-3, 12000.0, 0.5  # a read noise of 120 digital numbers
HEIGHT, WIDTH = 512, 256


def quantile(p: float, shape: float) -> float:
    """Of Tukey's lambda distribution."""
    return (p**shape - (1 - p) ** shape) / shape if shape else math.log(p / (1 - p))


def moment(shape: float, power: int) -> float:
    """Over the normal score, where the integrand has no singularity."""
    return quad(
        lambda z: quantile(norm.cdf(z), shape) ** power * norm.pdf(z), -8, 8, epsabs=0, limit=200
    )[0]


def kurtosis(shape: float) -> float:
    return moment(shape, 4) / moment(shape, 2) ** 2 - 3


@pytest.mark.parametrize("shape", [-0.2, -0.1, 0.0, 0.05, 0.135, 0.3])
def test_draws_are_quantiles_of_variance_one(shape: float) -> None:
    z = np.array([-4.0, -1.5, 0.0, 0.3, 2.0])
    deviation = math.sqrt(moment(shape, 2))
    expected = [quantile(norm.cdf(x), shape) / deviation for x in z]
    drawn = tukey_lambda(torch.from_numpy(z), shape).numpy()
    np.testing.assert_allclose(drawn, expected, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize(("shape", "k"), [(-0.1, 1), (-0.1, 3), (0.05, 2), (0.3, 2), (0.13, 4)])
def test_kurtosis_falls_with_the_number_of_averaged_pixels(shape: float, k: int) -> None:
    """Cumulants of a mean of n independent draws: the fourth falls as n^3, the variance as n."""
    assert kurtosis(averaged_shape(shape, k)) == pytest.approx(kurtosis(shape) / k**2, abs=2e-3)


def camera(row: float = ROW, shape: float = -0.05) -> CameraProfile:
    nlf = NoiseLevelFunction((SHOT,) * 4, (READ,) * 4)
    tables = {"nlf_by_iso": {100.0: nlf}, "read_noise_by_iso": {100.0: ReadNoise(row, shape)}}
    return CameraProfile("round", "RGGB", 3000, 3000 + SPAN, 14, **tables)  # type: ignore[arg-type]


def by_engine(level: float, k: int, source: NoiseLevelFunction = ZERO) -> np.ndarray:
    light = torch.full((4, HEIGHT, WIDTH), level)
    scene = PreparedScene(light, BASE, camera(), source, box_factor=k)
    return scene.expose([BASE], seed=5, noise="sensor")[0].double().numpy()


def by_reference(level: float, k: int) -> np.ndarray:
    signal = torch.full((4, k * HEIGHT, k * WIDTH), level)  # averaged after it was recorded
    generator = torch.Generator().manual_seed(5)
    body = ReferenceCamera(camera(), box_factor=k, sensor_noise=True)
    return body.record(signal, 100.0, generator).double().numpy()


@pytest.mark.parametrize("capture", [by_engine, by_reference])
@pytest.mark.parametrize(("level", "k"), [(0.0, 1), (0.2, 1), (0.0, 3)])
def test_rows_and_pixels_share_the_variance(
    capture: Callable[[float, int], np.ndarray], level: float, k: int
) -> None:
    frame = capture(level, k) - level
    rows, pixels = ROW**2 * READ / k, (1 - ROW**2) * READ / k**2 + SHOT * level / k**2
    sampling = 5 * math.sqrt(2 / HEIGHT)
    within = frame.var(axis=2, ddof=1).mean(axis=1)
    np.testing.assert_allclose(within, pixels, rtol=0.02)
    means = frame.mean(axis=2)
    covariance = np.cov(means)
    expected = np.kron(np.eye(2), np.full((2, 2), rows)) + np.eye(4) * pixels / WIDTH
    np.testing.assert_allclose(covariance, expected, atol=sampling * expected[0, 0])
    if k == 1:  # the noise level function is that of a sensor pixel
        np.testing.assert_allclose(frame.var(), READ + SHOT * level, rtol=sampling)
    elsewhere = frame - means[..., None]
    found = (elsewhere**4).mean() / (elsewhere**2).mean() ** 2 - 3
    share = (1 - ROW**2) * READ / k**2 / pixels  # fourth cumulants: shot noise has hardly any
    assert found == pytest.approx(kurtosis(-0.05) / k**2 * share**2, abs=0.15)


def test_a_noisy_source_lacks_a_part_of_each() -> None:
    source = NoiseLevelFunction((0.0,) * 4, (0.6 * READ,) * 4)
    frame = by_engine(0.0, 1, source)  # its light has no noise: only what is added shows
    between = frame.mean(axis=2).var(axis=1) - frame.var(axis=2).mean(axis=1) / WIDTH
    assert between.mean() == pytest.approx(0.4 * READ * ROW**2, rel=5 / math.sqrt(HEIGHT))
    assert frame.var() == pytest.approx(0.4 * READ, rel=5 * math.sqrt(2 / HEIGHT))


def test_off_it_changes_no_bit_and_every_output_shows_the_same_frame() -> None:
    known, light = camera(), torch.rand(4, 9, 70, generator=torch.Generator().manual_seed(0)) * 1.1
    plain = replace(known, read_noise_by_iso={})
    scenes = [PreparedScene(light, BASE, body, ZERO) for body in (known, plain)]
    for noise in ("exact", "bank"):
        first, second = (scene.expose([BASE], noise=noise) for scene in scenes)  # type: ignore[arg-type]
        assert torch.equal(first, second)
    drawn = [
        ReferenceCamera(body).record(light, 100.0, torch.Generator().manual_seed(1))
        for body in (known, plain)
    ]
    assert torch.equal(*drawn)
    simulated = CameraSimulator().simulate(scenes[0], BASE, seed=3, noise="sensor").data
    assert torch.equal(simulated, scenes[0].expose([BASE], seed=3, noise="sensor")[0])
    transitions = Transitions.of([light], [scenes[0].exposure(BASE)])
    signals, numbers = torch.empty(1, 4, 9, 70), np.empty((1, 4, 9, 70), np.uint16)
    given = {"keys": np.array([7], np.uint64), "read_noise": [ReadNoise(ROW, -0.05)]}
    ((low, high),) = record(
        transitions, known, signals=signals, numbers=numbers, count=True, **given
    )
    np.testing.assert_array_equal(numbers, np.rint(signals.numpy() * SPAN + 3000))
    assert (low, high) == ((signals <= 2**-10).sum(), (signals >= 1 - 1e-6).sum())


def test_what_is_not_calibrated_is_refused() -> None:
    z6, light = get_camera("nikon_z6"), torch.zeros(4, 8, 8)
    for call in (
        lambda: PreparedScene(light, BASE, z6, ZERO).expose([BASE], noise="sensor"),
        lambda: ReferenceCamera(z6, sensor_noise=True),
    ):
        with pytest.raises(ValueError, match="'nikon_z6' has no calibration of row noise"):
            call()
    for wrong, message in (((1.0, 0.0), "`row`"), ((0.1, -0.25), "`shape`")):
        with pytest.raises(ValueError, match=message):
            ReadNoise(*wrong)
