"""The plan: which steps run, why the others do not, and what is said about error and cost."""

from __future__ import annotations

import math
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
import torch

from simulator import CameraSettings, NoiseLevelFunction, PreparedScene, exposure_ratio, get_camera
from simulator.capture.aperture_blur import MapApertureBlur
from simulator.capture.blurred_light import Denoised
from simulator.capture.exposure import Step
from simulator.capture.light_statistics import LightStatistics
from simulator.capture.plan import DEFAULT_TOLERANCE, Situation, check_tolerance, decide

Z6 = get_camera("nikon_z6")
SOURCE = CameraSettings(1600, 1 / 64, 8)
CLEANER = CameraSettings(100, 1 / 4, 8)
OPENER = CameraSettings(1600, 1 / 256, 4)
STEPS = "exposure noise_reduction aperture defocus motion_blur noise clip_and_quantise"
ZERO = NoiseLevelFunction.zero()


def prepared(*, networks: bool = True, diameter: float = 2.0, **changes: object) -> PreparedScene:
    light = torch.rand(4, 16, 20, generator=torch.Generator().manual_seed(0)) * 0.3
    made = PreparedScene(light, SOURCE, Z6, Z6.nlf(1600))
    if networks:
        denoised, found = Denoised(light), torch.full((16, 20), diameter)
        blur = MapApertureBlur(light, denoised, found, 8.0)
        made = replace(made, denoised=denoised, aperture_blur=blur)
    return replace(made, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("settings", [SOURCE, CLEANER, OPENER, CameraSettings(6400, 1, 4)])
@pytest.mark.parametrize("networks", [True, False])
@pytest.mark.parametrize("tolerance", [0.0, 0.1, 5.0])
def test_every_step_runs_or_has_a_reason(
    settings: CameraSettings, networks: bool, tolerance: float
) -> None:
    plan = prepared(networks=networks, tolerance=tolerance, image_speed=1e-3).plan(settings)
    assert " ".join(step.name for step in plan.steps) == STEPS
    assert plan.modules == tuple(s.name for s in plan.steps if s.runs)
    assert plan.left_out == {s.name: s.reason for s in plan.steps if not s.runs}
    assert all(plan.left_out.values())
    assert plan.operations == sum(s.operations for s in plan.steps)
    assert all(s.error == 0 if s.runs else s.operations == 0 for s in plan.steps)
    assert plan.tolerance == tolerance
    assert plan.predicted_error == pytest.approx(math.sqrt(sum(s.error**2 for s in plan.steps)))
    assert not networks or plan.predicted_error <= tolerance
    assert plan.predicted_difference >= plan.predicted_error * networks


def test_the_networks_run_where_they_are_needed() -> None:
    first, last = ("exposure",), ("noise", "clip_and_quantise")
    for settings, modules in (
        (CLEANER, ("noise_reduction",)),
        (OPENER, ("aperture",)),
        (CameraSettings(100, 1 / 16, 4), ("noise_reduction", "aperture")),
    ):
        assert prepared().plan(settings).modules == first + modules + last


@pytest.mark.parametrize(
    ("changes", "settings", "line"),
    [
        ({"networks": False}, CLEANER, "left out  noise_reduction: the simulator has no noise"),
        ({"nlf": ZERO}, CLEANER, "left out  noise_reduction: the source carries no noise"),
        ({}, OPENER, "left out  noise_reduction: the target is at least as noisy: noise is added"),
        ({"tolerance": 9}, CLEANER, "left out  noise_reduction: the source is hardly noisier"),
        (
            {"tolerance": 9, "noise": False},
            OPENER,
            "left out  noise_reduction: the source's noise is small against the target's",
        ),
        (
            {"nlf": Z6.nlf(100).scaled(0.1)},
            CameraSettings(100, 4, 8),
            "left out  noise_reduction: the source has so little noise that the network's own",
        ),
        ({"networks": False}, OPENER, "left out  aperture: the scene is taken as in focus: `dep"),
        ({}, CLEANER, "left out  aperture: the aperture does not open"),
        ({"diameter": 0.0}, OPENER, "left out  aperture: the picture was found to be in focus"),
        ({"tolerance": 900}, OPENER, "left out  aperture: the blur that opening adds (up to 3.5 "),
        ({"aperture_blur": None}, CLEANER, "left out  defocus: the scene is taken as far"),
        ({}, CLEANER, "left out  defocus: none is given for the whole frame: each pixel's was"),
        ({"defocus": 1e-4}, CLEANER, "left out  defocus: the defocus disc is 5e-05 pixel wide, "),
        ({}, CLEANER, "left out  motion_blur: the image does not move"),
        ({"image_speed": 1e-6}, CLEANER, "left out  motion_blur: the image moves by 4e-06 pixel "),
        ({}, SOURCE, "left out  noise: no pixel lacks noise: the source has the target's already"),
        ({"noise": False}, SOURCE, "left out  noise: only the light is asked for"),
        ({"noise": False}, SOURCE, "left out  clip_and_quantise: only the light is asked for"),
        ({}, CameraSettings(12800, 1, 8), "warning   the ISO is outside the camera's noise calib"),
        ({}, CLEANER, "needed    noise_reduction: the source is noisier than the target; leaving"),
        ({"tolerance": 0}, OPENER, "needed    noise_reduction: tolerance 0 takes no noisy pixel"),
        ({"noise": False}, CLEANER, "needed    noise_reduction: no noise of the target's is there"),
        ({}, OPENER, "needed    aperture: the aperture opens and adds blur (up to 3.5 pixel); lea"),
        ({"defocus": 3}, CLEANER, "needed    defocus: the defocus disc is 1.5 pixel wide; leaving"),
        (
            {"image_speed": 0.25, "tolerance": 0},
            CLEANER,
            "needed    motion_blur: the image moves by 1 pixel during the exposure",
        ),
    ],
)
def test_reasons(changes: dict, settings: CameraSettings, line: str) -> None:
    scene = {name: value for name, value in changes.items() if name != "noise"}
    text = str(prepared(**scene).plan(settings, noise=changes.get("noise", True)))
    assert f"\n  {line}" in text
    assert all(name in text for name in STEPS.split())
    assert max(map(len, text.splitlines())) < 140


def test_excess_is_nought_with_a_noise_module_and_stated_without() -> None:
    with_module, without = prepared().plan(CLEANER), prepared(networks=False).plan(CLEANER)
    assert (with_module.excess_noise, with_module.predicted_rmse) == (0.0, 0.0)
    light = prepared().light.double()
    read, shot = (
        [torch.tensor(getattr(Z6.nlf(iso), name)).double()[:, None, None] for iso in (1600, 100)]
        for name in ("read", "shot")
    )
    given, wanted = (r + s * light for r, s in zip(read, shot, strict=True))
    assert without.excess_noise == pytest.approx(float(((given - wanted) / wanted).mean()))
    assert without.predicted_rmse == pytest.approx(float((given - wanted).mean()) ** 0.5)


def test_operations_by_hand() -> None:
    """Per sample: 2 + 1 + 4 + 2 (1 + 3^2) + 6 + 14 + 6, for a disc of 3.5 pixel."""
    everything = prepared(tolerance=0.0, image_speed=0.2, defocus=3.5)
    plan = everything.plan(CameraSettings(6400, 1 / 64, 4))
    assert [step.operations / (4 * 16 * 20) for step in plan.steps] == [2, 1, 4, 20, 6, 14, 6]
    with pytest.raises(FrozenInstanceError):
        plan.tolerance = 1.0  # type: ignore[misc]
    large = PreparedScene(torch.full((4, 500, 1000), 0.1), SOURCE, Z6, ZERO).plan(SOURCE)
    assert large.explain().endswith("  cost      44.0 million operations")


# Deciding on numbers alone


class Statistics(LightStatistics):
    """Errors by hand: of noise, and of a disc and a streak of one pixel."""

    def __init__(self, noise: float = 0.0, disc: float = 0.0, streak: float = 0.0) -> None:
        self.noise, self.blur = noise, (disc, streak)

    @property
    def median(self) -> float:  # type: ignore[override]
        return 1.0

    def excess_error(self, *_: object) -> float:
        return self.noise

    def curvature(self, *_: object) -> tuple[float, float]:
        return self.blur


def steps(tolerance: float, found: Statistics, noise: float = 1.0, **given: object) -> list[Step]:
    """What is decided where the deviation of the source's noise is `noise` times the light."""
    source = NoiseLevelFunction((0.0,) * 4, (noise**2,) * 4)
    situation = Situation(1.0, source, source, tolerance, True, found, lambda: found, **given)  # type: ignore[arg-type]
    return list(decide(situation))


def left_out(made: list[Step]) -> list[str]:
    return [step.name for step in made if not step.runs and step.error]


def test_noise_and_blur_add_as_squares() -> None:
    """3, 4, 5: a blur of 0.4 fits beside noise of 0.3 within 0.5, and nothing more does."""
    found = Statistics(0.3, disc=0.4, streak=1e-3)
    assert left_out(steps(0.5, found, defocus_px=1.0)) == ["noise_reduction", "defocus"]
    made = steps(0.5, found, defocus_px=1.0, motion_px=1.0)
    assert [step.runs for step in made] == [False, False, False, True]
    assert left_out(steps(0.29, found, defocus_px=1.0)) == []
    assert left_out(steps(0.4999, Statistics(0.5))) == []


def test_missing_blurs_add_up_in_the_mean() -> None:
    """0.3 and 0.4 shift a pixel by up to 0.7; the second adds sqrt(0.49 - 0.09) to the square."""
    found = Statistics(disc=0.1, streak=0.4)
    made = steps(0.7, found, aperture_px=3**0.5, opens=True, motion_px=1.0)
    assert left_out(made) == ["aperture", "motion_blur"]
    assert made[3].error == pytest.approx(math.sqrt(0.4))
    assert math.hypot(*(step.error for step in made)) == pytest.approx(0.7)
    # Errors go with the square of the extent: 0.9 does not fit.
    assert left_out(steps(0.7, found, aperture_px=3.0, opens=True)) == []


def test_a_blur_that_runs_takes_nothing_of_the_tolerance() -> None:
    made = steps(0.2, Statistics(disc=0.05, streak=0.2), aperture_px=10, defocus_px=2, opens=True)
    assert left_out(made) == ["defocus"]
    assert [step.error for step in made] == [0.0, pytest.approx(5.0), pytest.approx(0.2), 0.0]
    assert [step.extent for step in made] == [0.0, 10, 2, 0.0]


def test_noise_too_small_for_the_network_is_left_out_but_leaves_nothing_over() -> None:
    """Half a percent of the light: the network's own error is 0.6 %."""
    found = Statistics(0.3, streak=1e-6)
    assert left_out(steps(0.1, found, 0.005)) == ["noise_reduction"]
    assert left_out(steps(0.1, found, 0.007)) == []
    assert steps(0.1, found, 0.005, motion_px=1.0)[3].runs


def test_tolerance_0_leaves_nothing_out() -> None:
    blurs = {"aperture_px": 1.0, "opens": True, "defocus_px": 1e-200, "motion_px": 1.0}
    made = steps(0.0, Statistics(), 1e-9, **blurs)
    assert all(step.runs for step in made)
    assert [step.error for step in made] == [0.0] + [math.inf] * 3


def test_no_network_runs_for_the_errors_of_blur_that_nobody_asks_for() -> None:
    """The paper's aperture module needs the denoised light; its own blur is not known before."""
    nlf, found = (Z6.nlf(6400), Z6.nlf(100)), Statistics(5.0, disc=0.01)
    situation = Situation(1.0, *nlf, 0.1, True, found, lambda: pytest.fail("it ran"))
    opens = situation._replace(aperture_px=math.inf, opens=True, opens_denoised=True)
    made = decide(opens)
    assert [step.runs for step in made] == [True, True, False, False]
    assert "works on the noise-reduced light only" in made[0].reason
    assert made[1].reason == "the aperture opens and adds blur"
    assert made[1].error == math.inf
    assert decide(situation)[0].runs
    asked = opens._replace(defocus_px=2.0, denoised=lambda: Statistics(disc=0.02))
    assert decide(asked)[2].error == pytest.approx(0.08)  # of the light that is blurred


def test_tolerances() -> None:
    assert DEFAULT_TOLERANCE == 0.1
    for value in (0, 1e-9, 3, 1e6):
        assert check_tolerance(value) == value
        assert isinstance(check_tolerance(value), float)
    for wrong in (-1e-9, math.inf, math.nan, None, "0.1", True):
        with pytest.raises(ValueError, match=r"`tolerance` \(=.*\) must be a finite number >= 0"):
            check_tolerance(wrong)  # type: ignore[arg-type]


# Steps and errors


@pytest.mark.parametrize("settings", [SOURCE, CLEANER, OPENER])
def test_tolerance_nought_predicts_rounding_alone(settings: CameraSettings) -> None:
    """A millionth of the light, in units of the noise."""
    source = prepared(tolerance=0.0, image_speed=1e-3, defocus=0.1)
    plan, nlf = source.plan(settings), Z6.nlf(settings.iso)
    assert {"noise_reduction", "defocus", "motion_blur"} <= set(plan.modules)
    assert plan.predicted_error == 0.0
    shot, read = (np.array(v)[:, None, None] for v in (nlf.shot, nlf.read))
    signal = source.light.numpy() * exposure_ratio(SOURCE, settings)
    level = math.sqrt((signal**2 / (read + shot * signal)).mean())
    assert plan.predicted_difference == pytest.approx(level / 2**20, rel=0.02)


def test_each_decision_says_what_it_costs() -> None:
    """Standard deviation 5e-3 where 4e-3 is wanted: 0.25 if it stays."""
    camera = replace(Z6, nlf_by_iso={100.0: NoiseLevelFunction((0.0,) * 4, (16e-6,) * 4)})
    nlf = NoiseLevelFunction((0.0,) * 4, (25e-6,) * 4)
    light, settings = torch.full((4, 8, 8), 0.2), CameraSettings(100, 1, 8)
    made = PreparedScene(
        light, settings, replace(camera, segments=()), nlf, denoised=Denoised(light)
    )
    strict, loose = (replace(made, tolerance=t).plan(settings) for t in (0.2, 0.3))
    assert "noise_reduction" in strict.modules
    assert "leaving it out would be an error of 0.25" in strict.steps[1].reason
    assert (strict.predicted_error, loose.predicted_error) == (0.0, pytest.approx(0.25))
    assert "hardly noisier" in loose.left_out["noise_reduction"]
    assert "(error 0.25)" in loose.explain()
    assert (
        "0.25 of the target's noise is due to what is left out (tolerance 0.3)" in loose.explain()
    )
    # The network that did not run would itself have erred, by shares of noise and light.
    own = math.hypot(0.35 * 5e-3, 0.015 * 0.2) / 4e-3
    assert loose.predicted_difference == pytest.approx(math.hypot(0.25, own), rel=1e-3)
    assert replace(made, denoised=None).plan(settings).predicted_error == pytest.approx(0.25)


def test_regions_that_needed_no_network_count_against_the_full_run() -> None:
    """A quarter of the frame is saturated and was left as it is: the full run errs by shares of it,
    and of the noise that it takes it to have."""
    light = 0.2 + 0.01 * torch.rand(4, 32, 32, generator=torch.Generator().manual_seed(0))
    light[:, :16, :16] = 1.0
    denoised = torch.where(light == 1.0, 1.0, 0.19)
    made = PreparedScene(light, SOURCE, Z6, Z6.nlf(1600), denoised=Denoised(denoised))
    plan = made.plan(CLEANER)
    assert "noise_reduction" in plan.modules
    assert plan.predicted_error == 0.0
    given, wanted = (
        torch.tensor(n.read) + torch.tensor(n.shot) for n in (Z6.nlf(1600), Z6.nlf(100))
    )
    square = (0.35**2 * given + 0.015**2) / wanted
    expected = math.sqrt(float(square.mean()) / 4)
    assert plan.predicted_difference == pytest.approx(expected, rel=1e-3)
    assert replace(made, tolerance=0.0).plan(CLEANER).predicted_difference < 1e-3
