"""Which light a capture starts from, and that its noise is the target's in every case."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from simulator import CameraSettings, Latent, NoiseLevelFunction, get_camera
from simulator.modules.aperture import ApertureModule
from simulator.opening import MapOpening, NetworkOpening

Z6 = get_camera("nikon_z6")
LOW, HIGH = CameraSettings(100, 1 / 64, 8), CameraSettings(6400, 1 / 64, 8)
SIDE = 128


def flat(level: float) -> Tensor:
    return torch.full((4, SIDE, SIDE), level)


def recorded(level: float, nlf: NoiseLevelFunction, seed: int = 0) -> Tensor:
    """A flat field with the noise of `nlf`, drawn by NumPy."""
    rng = np.random.default_rng(seed)
    deviation = [math.sqrt(r + s * level) for r, s in zip(nlf.read, nlf.shot, strict=True)]
    planes = [rng.normal(level, d, (SIDE, SIDE)) for d in deviation]
    return torch.from_numpy(np.stack(planes).astype(np.float32))


def expected_variance(level: float, nlf: NoiseLevelFunction) -> np.ndarray:
    return np.array(nlf.read) + np.array(nlf.shot) * level


def variance(frame: Tensor) -> np.ndarray:
    """Per plane; of 16,384 pixels, so within 4 * sqrt(2 / 16384) = 4.4 %."""
    return frame.double().flatten(1).var(dim=1).numpy()


TOLERANCE = 4 * math.sqrt(2) / SIDE


def latent(level: float = 0.2, reference: CameraSettings = HIGH, **changes: object) -> Latent:
    nlf = Z6.nlf(reference.iso)
    made = Latent(recorded(level, nlf), reference, Z6, nlf, denoised=flat(level))
    return replace(made, **changes)  # type: ignore[arg-type]


# The noise-reduced light


def test_denoised_light_is_used_where_the_source_is_noisier() -> None:
    """ISO 6400 to 100 at the same exposure: 64 times the noise. The output has the target's."""
    target = CameraSettings(100, 1.0, 8)
    source = latent()
    exposure = source.exposure(target)
    assert exposure.denoised
    assert exposure.source.is_zero
    assert torch.equal(source.expected(target), flat(0.2))
    frame, excess = source.capture(target, 3)
    assert excess == 0.0
    np.testing.assert_allclose(
        variance(frame), expected_variance(0.2, Z6.nlf(100)), rtol=TOLERANCE, atol=1 / 12 / 14512**2
    )
    assert source.plan(target).excess_noise == 0.0
    assert source.output_noise(target) == Z6.nlf(100)


def test_light_as_recorded_is_used_where_noise_is_only_to_be_added() -> None:
    target = CameraSettings(6400, 1 / 64, 8)
    source = latent(reference=CameraSettings(100, 1.0, 8))
    exposure = source.exposure(target)
    assert not exposure.denoised
    assert torch.equal(source.expected(target), source.light)
    frame, excess = source.capture(target, 3)
    assert excess == 0.0
    np.testing.assert_allclose(
        variance(frame), expected_variance(0.2, Z6.nlf(6400)), rtol=TOLERANCE
    )


def test_the_same_settings_give_the_recorded_light_back() -> None:
    """No excess at ratio 1: a network must not touch what is exact already."""
    source = latent()
    assert not source.exposure(HIGH).denoised
    assert torch.equal(source.expected(HIGH), source.light)


def test_a_brighter_target_at_the_same_iso_is_denoised() -> None:
    """Exposing by c multiplies shot noise by c^2, the signal and the target's noise by c."""
    assert latent(0.05).exposure(CameraSettings(6400, 1 / 16, 8)).denoised
    assert not latent(0.05).exposure(CameraSettings(6400, 1 / 256, 8)).denoised


def test_a_source_with_next_to_no_noise_keeps_it() -> None:
    """ISO 100 at half of white: sigma is sqrt(7.5e-6 * 0.5) = 0.2 %, 0.4 % of the light."""
    bright = latent(0.5, LOW).exposure(CameraSettings(100, 1 / 16, 8))
    dark = latent(0.01, LOW).exposure(CameraSettings(100, 1 / 16, 8))  # 3 % of the light
    assert (bright.denoised, dark.denoised) == (False, True)
    assert bright.source_noise.shot == pytest.approx([4 * s for s in Z6.nlf(100).shot])


def test_without_a_noise_module_the_excess_is_declared() -> None:
    target = CameraSettings(100, 1.0, 8)
    source = latent(denoised=None)
    assert not source.exposure(target).denoised
    wanted, given = (expected_variance(0.2, Z6.nlf(iso)) for iso in (100, 6400))
    stated = source.plan(target).excess_noise
    assert stated == pytest.approx(float((given / wanted - 1).mean()), rel=0.02)
    assert source.capture(target, 0)[1] == pytest.approx(stated, rel=1e-4)


def test_a_source_without_noise_is_never_denoised() -> None:
    source = latent(nlf=NoiseLevelFunction.zero())
    assert not source.exposure(CameraSettings(100, 4.0, 8)).denoised


def test_the_denoised_light_has_the_shape_of_the_light() -> None:
    with pytest.raises(ValueError, match=r"`denoised` \(shape \(4, 8, 8\)\) must have the shape"):
        latent(denoised=torch.zeros(4, 8, 8))


def test_noise_is_compared_with_the_averaged_sensors() -> None:
    """A box-averaged source has the target's noise divided by k^2 as well: nothing to remove."""
    nlf = Z6.nlf(6400).scaled(1 / 16)
    assert not latent(nlf=nlf, box_factor=4).exposure(HIGH).denoised
    assert latent(nlf=Z6.nlf(6400), box_factor=4).exposure(HIGH).denoised


# The wider aperture


def with_opening(source: Latent, diameter: float) -> Latent:
    denoised = source.light if source.denoised is None else source.denoised
    found = torch.full((SIDE, SIDE), diameter)
    opening = MapOpening(source.light, denoised, found, source.reference.effective_f_number)
    return replace(source, opening=opening)


@pytest.mark.parametrize("diameter", [0.8, 2.0, 6.0])
@pytest.mark.parametrize("level", [0.02, 0.2])
def test_noise_that_the_blur_removed_is_topped_up(diameter: float, level: float) -> None:
    """f/8 to f/4 at the same exposure and ISO: what blur takes of the noise is added again."""
    source = with_opening(latent(level), diameter)
    target = CameraSettings(6400, 1 / 256, 4)
    exposure = source.exposure(target)
    assert exposure.ratio == 1.0
    assert exposure.opened_to == 4.0
    assert not exposure.denoised
    blurred = variance(source.expected(target)[:, 16:-16, 16:-16])
    assert (blurred < 0.75 * expected_variance(level, Z6.nlf(6400))).all()  # it did remove some
    frame, excess = source.capture(target, 9)
    assert excess == 0.0
    wanted = expected_variance(level, Z6.nlf(6400)) + 1 / 12 / 14512**2
    np.testing.assert_allclose(variance(frame), wanted, rtol=1.5 * TOLERANCE)
    assert frame.double().mean() == pytest.approx(level, rel=0.01)


def test_the_denoised_light_is_opened_where_the_target_is_cleaner() -> None:
    source = with_opening(latent(), 3.0)
    target = CameraSettings(100, 1 / 4, 4)
    exposure = source.exposure(target)
    assert (exposure.denoised, exposure.opened_to, exposure.remaining) == (True, 4.0, None)
    torch.testing.assert_close(source.expected(target), flat(0.2))
    frame, _ = source.capture(target, 3)
    np.testing.assert_allclose(
        variance(frame), expected_variance(0.2, Z6.nlf(100)), rtol=TOLERANCE, atol=1 / 12 / 14512**2
    )


@pytest.mark.parametrize("f_number", [8, 11, 16])
def test_the_same_and_smaller_apertures_leave_every_bit(f_number: float) -> None:
    target = CameraSettings(6400, 1 / 64 * 2 ** ((f_number - 8) / 8), f_number)
    source, plain = with_opening(latent(), 9.0), latent()
    assert source.exposure(target).opened_to is None
    assert torch.equal(source.capture(target, 1)[0], plain.capture(target, 1)[0])


def test_what_is_in_focus_stays_as_it_is() -> None:
    target = CameraSettings(6400, 1 / 256, 4)
    source, plain = with_opening(latent(), 0.0), latent()
    assert source.exposure(target).opened_to is None
    assert torch.equal(source.capture(target, 1)[0], plain.capture(target, 1)[0])


def test_the_papers_network_always_opens_denoised_light() -> None:
    torch.manual_seed(0)
    module = ApertureModule("paper").eval().requires_grad_(False)
    small = Latent(flat(0.2)[:, :16, :16], HIGH, Z6, Z6.nlf(6400), denoised=flat(0.2)[:, :16, :16])
    assert small.denoised is not None
    source = replace(small, opening=NetworkOpening(small.denoised, module, 8.0))
    exposure = source.exposure(CameraSettings(6400, 1 / 256, 4))
    assert (exposure.denoised, exposure.opened_to, exposure.remaining) == (True, 4.0, None)
    assert source.exposure(HIGH).denoised is False
