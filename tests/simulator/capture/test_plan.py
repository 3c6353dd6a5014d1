"""The plan: which steps run, why the others do not, and what is said about error and cost."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from simulator import CameraSettings, NoiseLevelFunction, PreparedScene, exposure_ratio, get_camera
from simulator.capture import plan as plan_module
from simulator.capture import statistics
from simulator.capture.blurred_frames import Layout
from simulator.capture.blurred_light import ApertureBlur, MapApertureBlur
from simulator.capture.decision import Exposure

# The factors and the least bound were measured; the tests hold the arithmetic that uses them.
from simulator.capture.plan import _BOUND, _LEAST_BOUND, KEPT_BLUR_ERROR, MISSED_BLUR
from simulator.capture.statistics import DenoisedLight, LightStatistics, Residual
from simulator.optics.motion import Movement

Z6 = get_camera("nikon_z6")
SOURCE = CameraSettings(1600, 1 / 64, 8)
CLEANER = CameraSettings(100, 1 / 4, 8)
OPENER = CameraSettings(1600, 1 / 256, 4)
STEPS = "exposure noise_reduction aperture defocus motion_blur noise clip_and_quantise"
ERRORS = "left out, network, clipped highlights, unknown depth, ISO, rounding"
ZERO = NoiseLevelFunction.zero()
LIGHT = torch.rand(4, 16, 20, generator=torch.Generator().manual_seed(0)) * 0.3


def network(name: str, error: float, *, spread: float = 1.0, **known: object) -> DenoisedLight:
    """One that errs by `error` standard deviations of the noise that it removes, everywhere."""
    residual = Residual(np.array([0.0, 9.0]), np.full(2, error**2), np.zeros(2), spread)
    return DenoisedLight(LIGHT, name=name, residual=residual, **known)


def prepared(*, networks: bool = True, diameter: float = 2.0, **changes: object) -> PreparedScene:
    made = PreparedScene(LIGHT, SOURCE, Z6, Z6.nlf(1600))
    if networks:
        denoised = (DenoisedLight(LIGHT, name="compact", operations=7, seconds=lambda: 0.25),)
        blur = MapApertureBlur(LIGHT, torch.full((16, 20), diameter), 8.0)
        made = replace(made, denoised_lights=denoised, aperture_blur=blur)
    return replace(made, **changes)


@pytest.mark.parametrize("settings", [SOURCE, CLEANER, OPENER, CameraSettings(6400, 1, 4)])
@pytest.mark.parametrize("networks", [True, False])
@pytest.mark.parametrize("tolerance", [0.0, 0.1, 5.0])
def test_every_step_runs_or_has_a_reason(settings, networks, tolerance):
    plan = prepared(networks=networks, tolerance=tolerance, image_speed=1e-3).plan(settings)
    assert " ".join(step.name for step in plan.steps) == STEPS
    assert plan.modules == tuple(s.name for s in plan.steps if s.runs)
    assert plan.left_out == {s.name: s.reason for s in plan.steps if not s.runs}
    assert all(plan.left_out.values())
    assert plan.operations == sum(s.operations for s in plan.steps)
    assert all(s.error == 0 if s.runs else s.operations == 0 for s in plan.steps)
    assert plan.tolerance == tolerance
    assert ", ".join(plan.errors) == ERRORS
    assert plan.errors["left out"] == pytest.approx(math.hypot(*(s.error for s in plan.steps)))
    assert not networks or plan.errors["left out"] <= tolerance
    assert plan.predicted_error == pytest.approx(math.hypot(*plan.errors.values()))
    assert plan.error_bound >= plan.predicted_error
    assert (plan.network is None) is ("noise_reduction" not in plan.modules)


@pytest.mark.parametrize(
    ("changes", "settings", "left_out", "word"),
    [
        ({"networks": False}, CLEANER, "noise_reduction", "no noise module"),
        ({"nlf": ZERO}, CLEANER, "noise_reduction", "no noise"),
        ({}, OPENER, "noise_reduction", "at least as noisy"),
        ({"tolerance": 9}, CLEANER, "noise_reduction", "within the tolerance"),
        ({"tolerance": 9, "noise": False}, OPENER, "noise_reduction", "small"),
        ({"denoised_lights": (network("bad", 9.0),)}, CLEANER, "noise_reduction", "smaller error"),
        ({"networks": False}, OPENER, "aperture", "`depth`"),
        ({}, CLEANER, "aperture", "does not open"),
        ({"diameter": 0.0}, OPENER, "aperture", "in focus throughout"),
        ({"tolerance": 900}, OPENER, "aperture", "up to 3.5 pixel"),
        ({"aperture_blur": None}, CLEANER, "defocus", "far"),
        ({}, CLEANER, "defocus", "each pixel's"),
        ({"defocus": 1e-4}, CLEANER, "defocus", "5e-05 pixel"),
        ({}, CLEANER, "motion_blur", "does not move"),
        ({"image_speed": 1e-6}, CLEANER, "motion_blur", "4e-06 pixel"),
        ({"noise": False}, SOURCE, "noise", "only the light"),
        ({}, OPENER, None, "adds blur (up to 3.5 pixel)"),
        ({"defocus": 3}, CLEANER, None, "disc is 1.5 pixel"),
        ({"image_speed": 0.25, "tolerance": 0}, CLEANER, None, "moves by 1 pixel"),
        ({"networks": False}, CameraSettings(1600, 1 / 32, 8), None, "noise variance 2"),
        ({}, CameraSettings(12800, 1, 8), None, "1 stop beyond"),
    ],
)
def test_reasons(changes: dict, settings: CameraSettings, left_out: str | None, word: str) -> None:
    """Whether a step is left out, and the fact that its reason states."""
    scene = {name: value for name, value in changes.items() if name != "noise"}
    plan = prepared(**scene).plan(settings, noise=changes.get("noise", True))
    assert word in (plan.details() if left_out is None else plan.left_out[left_out])


def test_operations_and_time_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """Per sample: 2 + 4 + 2 (1 + 3^2) + 6 + 14 + 6, for a disc of 3.5 pixel; and the network's."""
    monkeypatch.setattr(plan_module, "seconds_per_operation", lambda: 1e-9)
    everything = prepared(tolerance=0.0, image_speed=0.2, defocus=3.5)
    plan, samples = everything.plan(CameraSettings(6400, 1 / 64, 4)), 4 * 16 * 20
    each = [2 * samples, 7, *(n * samples for n in (4, 20, 6, 14, 6))]
    assert [step.operations for step in plan.steps] == each
    assert plan.milliseconds == pytest.approx((52 * samples * 1e-6, 250.0))
    assert plan.explain().endswith(" ms a capture and 250 ms once for all settings")
    large = PreparedScene(torch.full((4, 500, 1000), 0.1), SOURCE, Z6, ZERO).plan(SOURCE)
    assert large.explain().endswith("cost 44 million operations, about 44 ms a capture")
    monkeypatch.undo()
    assert 1e-13 < plan_module.seconds_per_operation() < 1e-6  # of whatever machine


# Deciding on numbers alone


class Statistics(LightStatistics):
    """Errors by hand: of noise, and of a disc and a streak of one pixel."""

    def __init__(self, noise: float = 0.0, disc: float = 0.0, streak: float = 0.0) -> None:
        self.noise, self.blur = noise, (disc, streak)

    def excess_error(self, *_: object) -> float:
        return self.noise

    relative_noise = excess_error

    def curvature(self, *_: object) -> tuple[float, float]:
        return self.blur


#: A flat field of unit noise: a network's error there is that of its first knot.
UNIT = NoiseLevelFunction((0.0,) * 4, (1.0,) * 4)
FLAT = statistics.ResidualStatistics(torch.ones(4, 16, 16), UNIT)


class Opening(ApertureBlur):
    """An aperture that opens by a blur of `extent`."""

    def __init__(self, extent: float, *, needs_denoised: bool = False) -> None:
        super().__init__(16.0)
        self.needs_denoised = needs_denoised
        self.extent = lambda f_number: extent if f_number < self.f_number else 0.0

    def remaining_variance(self, f_number: float) -> None:
        """None: no noise is left out of account here."""

    def _open(self, f_number: float, denoised: DenoisedLight | None) -> torch.Tensor:
        return LIGHT


def decided(tolerance, found, networks=(), *, opened_px=None, noise=True, nlf=(UNIT, UNIT), **rest):
    """What is decided where the noise's variance is 1; by default with a network without error."""
    exact = DenoisedLight(LIGHT)
    exact.statistics = found
    if opened_px is not None:
        rest["aperture_blur"] = Opening(opened_px)
    rest |= {"denoised_lights": networks or (exact,), "tolerance": tolerance}
    scene = PreparedScene(LIGHT, SOURCE, Z6.with_nlf(SOURCE.iso, nlf[1]), nlf[0], **rest)
    scene.blurred_light.statistics, scene.blurred_light.residuals = found, FLAT
    return scene.exposure(SOURCE, noise=noise)


def steps(*given, **options):
    return decided(*given, **options).steps


#: A disc, and a streak along the rows, of so many pixels at `SOURCE`.
def disc(extent: float) -> dict[str, float]:
    return {"defocus": 2.0 * extent}


def streak(extent: float) -> dict[str, float]:
    return {"image_speed": 4.0 * extent}


def left_out(made):
    return [step.name for step in made if not step.runs and step.error]


FAMILY = (network("nano", 0.4), network("compact", 0.2), network("large", 0.1))


@pytest.mark.parametrize(
    ("tolerance", "name"),
    [
        *[(0.7, None), (0.59, "nano"), (0.41, "nano"), (0.39, "compact"), (0.21, "compact")],
        *[(0.19, "large"), (0.09, "large"), (0.0, "large")],  # out of reach: the least error
    ],
)
@pytest.mark.parametrize("noise", [True, False])
def test_the_cheapest_network_within_the_tolerance_or_else_the_best(tolerance, name, noise):
    """The noise would be an error of 0.6, the networks of 0.4, 0.2, 0.1."""
    step = steps(tolerance, Statistics(0.6), FAMILY, noise=noise)[0]
    assert (step.network.name if step.network else None) == name
    assert step.runs is (name is not None)
    assert step.error == 0.6
    errors = {"nano": 0.4, "compact": 0.2, "large": 0.1, None: 0.0}
    assert step.residual == pytest.approx(errors[name])


def test_a_larger_network_or_any_may_be_the_worse_one() -> None:
    odd = (network("nano", 0.4), network("compact", 0.1), network("large", 0.2))
    for tolerance, name in ((0.25, "compact"), (0.05, "compact"), (0.0, "compact")):
        chosen = steps(tolerance, Statistics(0.6), odd)[0].network
        assert chosen.name == name
    for tolerance in (0.0, 0.04, 0.06):  # noise that errs by less than all of them stays
        assert steps(tolerance, Statistics(0.05), odd)[0].network is None
    assert "no network would make" in steps(0.04, Statistics(0.05), odd)[0].reason


def test_noise_and_blur_add_as_squares() -> None:
    """3, 4, 5: a blur of 0.4 fits beside noise of 0.3 within 0.5, and nothing more does."""
    found = Statistics(0.3, disc=0.4, streak=1e-3)
    assert left_out(steps(0.5, found, **disc(1.0))) == ["noise_reduction", "defocus"]
    made = steps(0.5, found, **disc(1.0), **streak(1.0))
    assert [step.runs for step in made] == [False, False, False, True]
    assert left_out(steps(0.29, found, **disc(1.0))) == []
    assert left_out(steps(0.4999, Statistics(0.5))) == []
    for error, runs in ((0.41, True), (0.39, False)):  # beside a network that errs by 0.3
        own = network("nano", 0.3)
        own.statistics = Statistics(disc=error)
        made = steps(0.5, Statistics(0.9), (own,), **disc(1.0))
        assert [made[0].runs, made[2].runs] == [True, runs]


def test_missing_blurs_add_up_in_the_mean() -> None:
    """0.3 and 0.4 shift a pixel by up to 0.7; the second adds sqrt(0.49 - 0.09) to the square."""
    found = Statistics(disc=0.1, streak=0.4)
    made = steps(0.7, found, opened_px=3**0.5, **streak(1.0))
    assert left_out(made) == ["aperture", "motion_blur"]
    assert made[3].error == pytest.approx(math.sqrt(0.4))
    assert math.hypot(*(step.error for step in made)) == pytest.approx(0.7)
    # Errors go with the square of the extent: 0.9 does not fit.
    assert left_out(steps(0.7, found, opened_px=3.0)) == []


def test_a_blur_that_runs_takes_nothing_of_the_tolerance() -> None:
    made = steps(0.2, Statistics(disc=0.05, streak=0.2), opened_px=10, **disc(2))
    assert left_out(made) == ["defocus"]
    assert [step.error for step in made] == [0.0, pytest.approx(5.0), pytest.approx(0.2), 0.0]
    assert [step.extent for step in made] == [0.0, 10, 2, 0.0]


def test_no_network_runs_for_the_errors_of_blur_that_nobody_asks_for() -> None:
    """The paper's aperture module needs the denoised light; its own blur is not known before."""
    nlf, found = (Z6.nlf(6400), Z6.nlf(100)), Statistics(5.0, disc=0.01)
    lazy = DenoisedLight(lambda: pytest.fail("it ran"))
    opens = {"aperture_blur": Opening(math.inf, needs_denoised=True), "nlf": nlf}
    made = steps(0.1, found, (lazy,), **opens)
    assert [step.runs for step in made] == [True, True, False, False]
    assert "works on the noise-reduced light only" in made[0].reason
    assert made[1].reason == "the aperture opens and adds blur"
    assert made[1].error == math.inf
    assert steps(0.1, found, (lazy,), nlf=nlf)[0].runs
    lazy.statistics = Statistics(disc=0.02)
    blurred = steps(0.1, found, (lazy,), **opens, **disc(2.0))
    assert blurred[2].error == pytest.approx(0.08)  # of the light that is blurred


def test_the_exposure_has_what_runs() -> None:
    """Of blur that is left out, neither extent nor path nor layout stays."""
    subject = torch.arange(20).expand(16, 20) > 9
    layout, movement = Layout(torch.ones(16, 20), subject), Movement(0.5, 0.0, 4.0)
    blurs = {**disc(2.0), **streak(4.0), "layout": layout, "movement": movement}
    own = movement.subject_path(16.0, 1 / 64, 16)
    paths = movement.path(16.0, 1 / 64, 16), own
    for point, row in ((1.0, 1.0), (1.0, 0.0), (0.0, 1.0), (0.0, 0.0)):
        found = Statistics(disc=point, streak=3 / 4 * row)  # a path's bound is that of a disc
        made = decided(0.1, found, (network("a", 0.0),), **blurs)
        moves = point > 0.0
        assert (made.defocus_px, made.motion_px) == (2.0 * moves, own.length * moves)
        assert (made.path, made.subject_path) == (paths if moves else (None, None))
        assert made.layout is (layout if moves else None)
        assert (made.ratio, made.source, made.denoised, made.opened_to) == (1.0, UNIT, None, None)
    exact = network("a", 0.0)
    exact.statistics = Statistics(9, 9)
    made = decided(0.1, Statistics(9, 9), (exact,), opened_px=9.0)
    assert (made.opened_to, made.source.is_zero, made.denoised) == (8.0, True, exact)
    assert made.left_out == 0.0
    assert Exposure(1.0, UNIT, UNIT).left_out == 0.0


@pytest.mark.parametrize("settings", [SOURCE, CLEANER, OPENER])
def test_tolerance_nought_predicts_rounding_alone(settings: CameraSettings) -> None:
    """A millionth of the light, in units of the noise."""
    plan = prepared(tolerance=0.0, image_speed=1e-3, defocus=0.1).plan(settings)
    nlf = Z6.nlf(settings.iso)
    assert {"defocus", "motion_blur"} <= set(plan.modules)
    assert ("noise_reduction" in plan.modules) is (settings is CLEANER)
    shot, read = (np.array(v)[:, None, None] for v in (nlf.shot, nlf.read))
    signal = LIGHT.numpy() * exposure_ratio(SOURCE, settings)
    level = math.sqrt((signal**2 / (read + shot * signal)).mean())
    assert plan.errors.pop("rounding") == pytest.approx(level / 2**20, rel=0.02)
    plan.errors.pop("unknown depth")  # of the aperture that opens
    assert set(plan.errors.values()) == {0.0}


def test_each_decision_says_what_it_costs() -> None:
    """Standard deviation 5e-3 where 4e-3 is wanted: 0.25 if it stays, 0.08 * 5 / 4 if not."""
    camera = replace(Z6, nlf_by_iso={100.0: NoiseLevelFunction((0.0,) * 4, (16e-6,) * 4)})
    nlf = NoiseLevelFunction((0.0,) * 4, (25e-6,) * 4)
    light, settings = torch.full((4, 16, 20), 0.2), CameraSettings(100, 1, 8)
    denoised, camera = (network("nano", 0.08, spread=1.5),), replace(camera, segments=())
    made = PreparedScene(light, settings, camera, nlf, denoised_lights=denoised)
    tiny, strict, loose = (replace(made, tolerance=t).plan(settings) for t in (0.09, 0.2, 0.3))
    assert "leaving it out would be an error of 0.25" in strict.steps[1].reason
    by_network, left_out = 1.5 * _BOUND["network"], _BOUND["left out"]
    cases = (tiny, 0.1, by_network), (strict, 0.1, by_network), (loose, 0.25, left_out)
    for plan, found, factor in cases:
        assert plan.predicted_error == pytest.approx(found, rel=1e-3)
        bound = factor * math.hypot(found, _LEAST_BOUND)
        assert plan.error_bound == pytest.approx(bound, rel=1e-3)
        assert plan.network == ("nano" if found == 0.1 else None)
        assert ("out of reach" in plan.explain()) is (plan is tiny)
        assert ("kept)" in plan.explain()) is (plan is not tiny)
    # Never below what is predicted.
    rounded = replace(loose, errors={**loose.errors, "left out": 0.0, "rounding": 0.4})
    assert rounded.error_bound == pytest.approx(0.4)
    assert "kept, except for errors" in rounded.explain()
    alone = replace(made, denoised_lights=()).plan(settings)
    assert alone.errors["left out"] == pytest.approx(0.25)


@pytest.mark.parametrize("ratio", [2.0, 1.25, 1.0, 0.5, 1 / 64])
def test_what_clipped_highlights_hide_by_quadrature(ratio: float) -> None:
    """Light x >= 1 of density 1 / x^2, shown as 1.5, in three planes of a tenth of the pixels."""
    target = NoiseLevelFunction((2e-4,) * 4, (1e-4,) * 4)
    camera = replace(Z6, segments=(), nlf_by_iso={100.0: target})
    saturated, light = torch.zeros(10, 12, dtype=torch.bool), torch.full((4, 10, 12), 0.5)
    saturated[0] = True
    light[:, 0] = torch.tensor([0.9, 1.5, 1.5, 1.5])[:, None]  # R was measured
    settings = CameraSettings(100, 1 / 64, 8)
    made = PreparedScene(light, settings, camera, ZERO, saturated=saturated)
    plan = made.plan(CameraSettings(100, ratio / 64, 8))
    square = 0.0
    if ratio < 1.0:
        shown = min(1.5 * ratio, 1.0)

        def density(x: float) -> float:
            return (ratio * x - shown) ** 2 / (1e-4 + 2e-4 * ratio * x) / x**2

        square = quad(density, 1.0, 1.0 / ratio)[0]
        square += ratio * (1.0 - shown) ** 2 / 3e-4  # white in the capture, too
    error = math.sqrt(0.075 * square)
    assert plan.errors["clipped highlights"] == pytest.approx(error, rel=1e-5)
    assert replace(made, box_factor=2).clipped_light == pytest.approx((0.1, 1.35))
    leading = max(plan.errors, key=plan.errors.get)
    assert leading == ("clipped highlights" if ratio < 1.0 else "rounding")
    bound = _BOUND[leading] * math.hypot(error, plan.errors["rounding"], _LEAST_BOUND)
    assert plan.error_bound == pytest.approx(max(bound, plan.predicted_error))
    assert plan.clipped_source == pytest.approx(0.1)
    clear = replace(made, saturated=None).plan(CameraSettings(100, ratio / 64, 8))
    assert clear.clipped_source == clear.errors["clipped highlights"] == 0.0


def test_unknown_depth_and_iso_add_to_the_error_only_where_they_play_a_part() -> None:
    """A share of what opening changes; and of the noise, for each stop beyond the calibration."""
    plans = {iso: prepared().plan(CameraSettings(iso, 1 / iso, 8)) for iso in (6400, 12800)}
    assert plans[6400].errors["ISO"] == plans[6400].extrapolated == 0.0
    assert 0.01 < plans[12800].errors["ISO"] < 0.3
    clean = prepared().plan(CameraSettings(12800, 1 / 12800, 8), noise=False)
    assert clean.errors["ISO"] == clean.extrapolated == 0.0  # it has no noise
    source = prepared()
    changed = source.expected(OPENER).double() - LIGHT
    shot, read = (np.array(v)[:, None, None] for v in (Z6.nlf(1600).shot, Z6.nlf(1600).read))
    relative = math.sqrt((changed.numpy() ** 2 / (read + shot * LIGHT.numpy())).mean())
    assert 0.59 * relative < source.plan(OPENER).errors["unknown depth"] < relative
    lazy = MapApertureBlur(LIGHT, lambda: pytest.fail("it ran"), 8.0)  # the same aperture
    assert replace(source, aperture_blur=lazy).plan(CLEANER).errors["unknown depth"] == 0.0
    smaller = CameraSettings(100, 1, 16)  # would show sharp what is blurred in the source
    found = [prepared(diameter=d).plan(smaller).errors["unknown depth"] for d in (0.0, 2.0, 4.0)]
    assert found[0] == 0.0 < found[1]
    assert found[2] == pytest.approx(4 * found[1])
    light = LIGHT + 0.3
    blur = MapApertureBlur(light, torch.full((16, 20), 2.0), 8.0)
    bright = PreparedScene(light, SOURCE, Z6, Z6.nlf(1600), aperture_blur=blur)
    for white in (CameraSettings(12800, 1, 4), CameraSettings(12800, 1, 16)):
        assert bright.plan(white).errors["unknown depth"] == 0.0
        assert bright.plan(white, noise=False).errors["unknown depth"] > 0.0


@pytest.mark.parametrize("f_number", [4, 16])
def test_unknown_depth_of_a_wave_by_hand(f_number: int) -> None:
    """A wave of 16 pixels in focus throughout, or blurred by 2 pixels, against noise of 1e-3.

    Half a disc's second moment, d^2 / 16, times the wave's Laplacian. Of f/4, what could not be
    seen at f/8 grows by the square of 2; of f/16, three quarters of what is blurred stays so.
    """
    t, noise = 2 * math.pi / 16, NoiseLevelFunction((0.0,) * 4, (1e-6,) * 4)
    light = 0.3 + 0.1 * torch.cos(t * (torch.arange(64, dtype=torch.float64) + 0.5)).float()
    light = light.expand(4, 64, 64).contiguous()
    per_square = (2 - 2 * math.cos(t)) / 32 * 0.1 / 2**0.5 / 1e-3
    wanted, diameter = MISSED_BLUR**2 * 3, 0.0
    if f_number == 16:
        wanted, diameter = KEPT_BLUR_ERROR * 2.0**2 * 0.75, 2.0
    blur = MapApertureBlur(light, torch.full((64, 64), diameter), 8.0)
    body, source = Z6.with_nlf(100, noise), CameraSettings(100, 1 / 64, 8)
    made = PreparedScene(light, source, body, ZERO, aperture_blur=blur)
    plan = made.plan(CameraSettings(100, (f_number / 8) ** 2 / 64, f_number))
    assert plan.errors["unknown depth"] == pytest.approx(wanted * per_square, rel=2e-3)
