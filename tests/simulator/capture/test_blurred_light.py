"""Light behind apertures and streaks: made once, kept within bounds, the same either way."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from simulator.capture import scene_blur as optics_module
from simulator.capture.aperture_blur import MapApertureBlur
from simulator.capture.blurred_light import BlurredLight
from simulator.capture.denoised import Denoised
from simulator.capture.exposure import LIGHT_LIMIT, Exposure
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.optics.blur import disc_blur, motion_blur

ZERO = NoiseLevelFunction.zero()
STILL = Exposure(2.0, ZERO, ZERO)
LIGHT = torch.rand(4, 24, 20, generator=torch.Generator().manual_seed(0))
CLEAN = Denoised(LIGHT * 0.5)


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, float]]:
    """What is blurred, and by how much."""
    calls: list[tuple[str, float]] = []

    def streak(light: torch.Tensor, extent: float) -> torch.Tensor:
        calls.append(("streak", extent))
        return motion_blur(light, extent)

    def disc(light: torch.Tensor, diameter: float) -> torch.Tensor:
        if diameter:
            calls.append(("disc", diameter))
        return disc_blur(light.clamp(-LIGHT_LIMIT, LIGHT_LIMIT), diameter)

    monkeypatch.setattr(optics_module, "motion_blur", streak)
    monkeypatch.setattr(optics_module, "defocused_light", disc)
    return calls


@pytest.mark.parametrize("denoised", [False, True])
def test_disc_then_streak(denoised: bool) -> None:
    source = CLEAN.light if denoised else LIGHT
    blurred_light = BlurredLight(LIGHT, (Denoised(LIGHT), CLEAN), ZERO, None)
    exposure = replace(STILL, denoised=CLEAN if denoised else None)
    assert blurred_light.blurred(exposure) is source  # what needs no blur is not copied
    exposure = replace(exposure, defocus_px=2.0, motion_px=3.0)
    expected = motion_blur(disc_blur(source, 2.0), 3.0)
    assert torch.equal(blurred_light.blurred(exposure), expected)


def test_each_blur_is_made_once(made: list[tuple[str, float]]) -> None:
    """Two apertures, two exposure times, many ISO speeds: two discs and four streaks."""
    blurred_light = BlurredLight(LIGHT, (), ZERO, None)
    for ratio in (1.0, 2.0, 4.0):
        for disc in (2.0, 1.0):
            for streak in (3.0, 0.0, 6.0):
                blurred_light.blurred(Exposure(ratio, ZERO, ZERO, streak, disc))
    assert sorted(made) == [("disc", 1.0), ("disc", 2.0)] + 2 * [("streak", 3.0)] + 2 * [
        ("streak", 6.0)
    ]


def test_a_bound_in_bytes_forgets_what_was_used_longest_ago(
    made: list[tuple[str, float]],
) -> None:
    blurred_light = BlurredLight(LIGHT, (), ZERO, None, cache_bytes=2 * LIGHT.nbytes)
    for disc in (1.0, 2.0, 1.0, 3.0, 1.0, 2.0):
        found = blurred_light.blurred(replace(STILL, defocus_px=disc))
        assert torch.equal(found, disc_blur(LIGHT, disc))
    assert [d for _, d in made] == [1.0, 2.0, 3.0, 2.0]
    none = BlurredLight(LIGHT, (), ZERO, None, cache_bytes=0)
    for _ in range(2):
        none.blurred(replace(STILL, defocus_px=7.0))
    assert [d for _, d in made][-2:] == [7.0, 7.0]


def test_the_opened_aperture_comes_first() -> None:
    aperture_blur = MapApertureBlur(LIGHT, torch.full((24, 20), 2.0), 8.0)
    blurred_light = BlurredLight(LIGHT, (CLEAN,), ZERO, aperture_blur)
    exposure = replace(STILL, opened_to=4.0, denoised=CLEAN, motion_px=2.0)
    expected = motion_blur(aperture_blur.opened(4.0, CLEAN), 2.0)
    assert torch.equal(blurred_light.blurred(exposure), expected)
    assert not torch.equal(expected, motion_blur(CLEAN.light, 2.0))


def test_blur_that_opening_adds_and_noise_that_it_leaves() -> None:
    """Squared diameters add: 2 pixels at f/8 take sqrt(16 - 4) more at f/4."""
    aperture_blur = MapApertureBlur(LIGHT, torch.full((24, 20), 2.0), 8.0)
    blurred_light, none = (BlurredLight(LIGHT, (), ZERO, blur) for blur in (aperture_blur, None))
    assert blurred_light.added_blur(4.0) == pytest.approx(12**0.5)
    assert blurred_light.added_blur(8.0) == blurred_light.added_blur(16.0) == 0.0
    assert none.added_blur(1.4) == 0.0
    assert none.remaining_variance(4.0, 1.0) is None
    alone = aperture_blur.remaining_variance(4.0)
    assert torch.equal(blurred_light.remaining_variance(4.0, 1.0), alone)
    half = blurred_light.remaining_variance(4.0, 0.5)
    torch.testing.assert_close(half, (2 * alone).clamp(max=1.0))
    assert blurred_light.remaining_variance(4.0, 0.5) is half
