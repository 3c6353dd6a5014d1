"""The plan: which steps run, why the others do not, and what is said about error and cost."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from simulator import CameraSettings, Latent, NoiseLevelFunction, get_camera
from simulator.opening import MapOpening

Z6 = get_camera("nikon_z6")
SOURCE = CameraSettings(1600, 1 / 64, 8)
CLEANER = CameraSettings(100, 1 / 4, 8)
OPENER = CameraSettings(1600, 1 / 256, 4)
STEPS = {
    "exposure",
    "noise_reduction",
    "aperture",
    "defocus",
    "motion_blur",
    "noise",
    "clip_and_quantise",
}


def latent(*, networks: bool = True, **changes: object) -> Latent:
    light = torch.rand(4, 16, 20, generator=torch.Generator().manual_seed(0)) * 0.3
    made = Latent(light, SOURCE, Z6, Z6.nlf(1600))
    if networks:
        made = replace(made, denoised=light)
        made = replace(made, opening=MapOpening(light, light, torch.full((16, 20), 2.0), 8.0))
    return replace(made, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("settings", [SOURCE, CLEANER, OPENER, CameraSettings(6400, 1, 4)])
@pytest.mark.parametrize("networks", [True, False])
def test_every_step_runs_or_has_a_reason(settings: CameraSettings, networks: bool) -> None:
    plan = latent(networks=networks).plan(settings)
    assert set(plan.modules) | set(plan.left_out) == STEPS
    assert not set(plan.modules) & set(plan.left_out)
    assert all(plan.left_out.values())


def test_the_networks_run_where_they_are_needed() -> None:
    """In the order of the pipeline."""
    cleaner, opener = latent().plan(CLEANER), latent().plan(OPENER)
    assert cleaner.modules == ("exposure", "noise_reduction", "noise", "clip_and_quantise")
    assert opener.modules == ("exposure", "aperture", "noise", "clip_and_quantise")
    both = latent().plan(CameraSettings(100, 1 / 16, 4))
    assert both.modules[:3] == ("exposure", "noise_reduction", "aperture")


@pytest.mark.parametrize(
    ("changes", "settings", "step", "reason"),
    [
        ({"networks": False}, CLEANER, "noise_reduction", "no noise module"),
        ({"nlf": NoiseLevelFunction.zero()}, CLEANER, "noise_reduction", "carries no noise"),
        ({}, OPENER, "noise_reduction", "at least as noisy"),
        ({"networks": False}, OPENER, "aperture", "`depth` is not 'unknown'"),
        ({}, CLEANER, "aperture", "does not open"),
        ({"opening": None}, CLEANER, "defocus", "far or in focus"),
        ({}, CLEANER, "defocus", "each pixel's was estimated"),
        ({"nlf": Z6.nlf(100).scaled(0.1)}, CLEANER, "noise_reduction", "err as much"),
        ({"defocus": 1e-4}, CLEANER, "defocus", "below"),
        ({}, CLEANER, "motion_blur", "does not move"),
        ({"image_speed": 1e-6}, CLEANER, "motion_blur", "moves less than"),
        ({}, SOURCE, "noise", "has the target's already"),
    ],
)
def test_reasons(changes: dict, settings: CameraSettings, step: str, reason: str) -> None:
    plan = latent(**changes).plan(settings)
    assert reason in plan.left_out[step]
    assert f"left out  {step}: {plan.left_out[step]}" in str(plan)


def test_excess_is_nought_with_a_noise_module_and_stated_without() -> None:
    with_module, without = latent().plan(CLEANER), latent(networks=False).plan(CLEANER)
    assert (with_module.excess_noise, with_module.predicted_rmse) == (0.0, 0.0)
    light = latent().light.double()
    read, shot = (
        [torch.tensor(getattr(Z6.nlf(iso), name)).double()[:, None, None] for iso in (1600, 100)]
        for name in ("read", "shot")
    )
    given, wanted = (r + s * light for r, s in zip(read, shot, strict=True))
    assert without.excess_noise == pytest.approx(float(((given - wanted) / wanted).mean()))
    assert without.predicted_rmse == pytest.approx(float((given - wanted).mean()) ** 0.5)


def test_blur_of_the_aperture_lowers_the_predicted_excess() -> None:
    """f/8 to f/4 at a fifth of a stop more light: blur removes more noise than that is too much."""
    settings = replace(OPENER, exposure_time=OPENER.exposure_time * 2**0.2)
    opened = latent(denoised=None).plan(settings)
    assert latent(networks=False).plan(settings).excess_noise > 0.1
    assert opened.excess_noise == 0.0
    assert "noise" in opened.modules


def test_operations_add_up() -> None:
    """A step more costs more, and a frame of four times the pixels four times as much."""
    assert latent().plan(OPENER).operations > latent(networks=False).plan(OPENER).operations
    large = Latent(torch.full((4, 32, 40), 0.1), SOURCE, Z6, Z6.nlf(1600))
    small = Latent(torch.full((4, 16, 20), 0.1), SOURCE, Z6, Z6.nlf(1600))
    target = CameraSettings(6400, 1 / 256, 8)
    assert large.plan(target).operations == 4 * small.plan(target).operations
