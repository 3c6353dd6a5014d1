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
from simulator.capture.columns import ERRORS as PARTS
from simulator.capture.columns import KEPT_BLUR_ERROR, MISSED_BLUR, plan_captures

# The factors and the least bound were measured; the tests hold the arithmetic that uses them.
from simulator.capture.plan import _BOUND, _LEAST_BOUND
from simulator.capture.statistics import DenoisedLight, LightStatistics, Residual
from simulator.optics.motion import Movement, path_length

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
    """Errors by hand: of noise, and of a disc and a streak of one pixel.

    For a target of variance 1, of a source whose variance is its light: one bin of the light that
    makes `noise` be the error. A disc moves a pixel by a 32nd of the Laplacian, a streak by a 24th.
    """

    columns = bins = np.empty(0)

    def __init__(self, noise: float = 0.0, disc: float = 0.0, streak: float = 0.0) -> None:
        self.columns, self.bins = np.zeros((2, 4, 4, statistics.BINS))
        self.columns[:, :, 0] = [[0.25], [0.0], [(32.0 * disc) ** 2], [(24.0 * streak) ** 2]]
        self.bins[:, :, 0] = [[0.25], *[[(1.0 + noise) ** 2]] * 2, [noise**2]]


#: A flat field of unit noise: a network's error there is that of its first knot.
UNIT = NoiseLevelFunction((0.0,) * 4, (1.0,) * 4)
SHOT = NoiseLevelFunction((1.0,) * 4, (0.0,) * 4)
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


def posed(tolerance, found, networks=(), *, opened_px=None, source=SHOT, **rest):
    """A scene in which noise of variance 1 is wanted; by default with a network without error."""
    exact = DenoisedLight(LIGHT)
    exact.statistics = found
    if opened_px is not None:
        rest["aperture_blur"] = Opening(opened_px)
    rest |= {"denoised_lights": networks or (exact,), "tolerance": tolerance}
    scene = PreparedScene(LIGHT, SOURCE, Z6.with_nlf(SOURCE.iso, UNIT), source, **rest)
    scene.blurred_light.statistics, scene.blurred_light.residuals = found, FLAT
    return scene


def decided(*given, noise=True, **options):
    """What is decided at the settings of the source."""
    return plan_captures(posed(*given, **options), [SOURCE], noise=noise)


def errors(made) -> dict[str, float]:
    """Of leaving out each step, and of the network."""
    return dict(zip(PARTS[:5], made.details[0].tolist(), strict=False))


def runs(made) -> list[str]:
    ((network, opened),), (blur,) = made.origins, made.blurs
    ran = network is not None, opened is not None, blur["defocus_px"] > 0, blur["motion_px"] > 0
    return [name for name, runs in zip(PARTS, ran, strict=False) if runs]


#: A disc, and a streak along the rows, of so many pixels at `SOURCE`.
def disc(extent: float) -> dict[str, float]:
    return {"defocus": 2.0 * extent}


def streak(extent: float) -> dict[str, float]:
    return {"image_speed": 4.0 * extent}


def left_out(made):
    some = list(errors(made).items())[:4]
    return [name for name, error in some if error and name not in runs(made)]


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
    made = decided(tolerance, Statistics(0.6), FAMILY, noise=noise)
    ((network, _),) = made.origins
    assert (network.name if network else None) == name
    assert errors(made)["noise_reduction"] == pytest.approx(0.6)
    own = {"nano": 0.4, "compact": 0.2, "large": 0.1, None: 0.0}
    assert errors(made)["network"] == pytest.approx(own[name])


def test_a_larger_network_or_any_may_be_the_worse_one() -> None:
    odd = (network("nano", 0.4), network("compact", 0.1), network("large", 0.2))
    for tolerance, name in ((0.25, "compact"), (0.05, "compact"), (0.0, "compact")):
        assert posed(tolerance, Statistics(0.6), odd).plan(SOURCE).network == name
    for tolerance in (0.0, 0.04, 0.06):  # noise that errs by less than all of them stays
        plan = posed(tolerance, Statistics(0.05), odd).plan(SOURCE)
        assert plan.network is None
    plan = posed(0.04, Statistics(0.05), odd).plan(SOURCE)
    assert "no network would make" in plan.left_out["noise_reduction"]


def test_noise_and_blur_add_as_squares() -> None:
    """3, 4, 5: a blur of 0.4 fits beside noise of 0.3 within 0.5, and nothing more does."""
    found = Statistics(0.3, disc=0.4, streak=1e-3)
    assert left_out(decided(0.50001, found, **disc(1.0))) == ["noise_reduction", "defocus"]
    assert runs(decided(0.50001, found, **disc(1.0), **streak(1.0))) == ["motion_blur"]
    assert left_out(decided(0.29, found, **disc(1.0))) == []
    assert left_out(decided(0.4999, Statistics(0.5))) == []
    for error, ran in ((0.41, ["defocus"]), (0.39, [])):  # beside a network that errs by 0.3
        own = network("nano", 0.3)
        own.statistics = Statistics(disc=error)
        made = decided(0.5, Statistics(0.9), (own,), **disc(1.0))
        assert runs(made) == ["noise_reduction", *ran]


def test_missing_blurs_add_up_in_the_mean() -> None:
    """0.3 and 0.4 shift a pixel by up to 0.7; the second adds sqrt(0.49 - 0.09) to the square."""
    found = Statistics(disc=0.1, streak=0.4)
    made = decided(0.70001, found, opened_px=3**0.5, **streak(1.0))
    assert left_out(made) == ["aperture", "motion_blur"]
    assert errors(made)["motion_blur"] == pytest.approx(math.sqrt(0.4))
    assert math.hypot(*errors(made).values()) == pytest.approx(0.7)
    # Errors go with the square of the extent: 0.9 does not fit.
    assert left_out(decided(0.7, found, opened_px=3.0)) == []


def test_a_blur_that_runs_takes_nothing_of_the_tolerance() -> None:
    made = decided(0.20001, Statistics(disc=0.05, streak=0.2), opened_px=10, **disc(2))
    assert left_out(made) == ["defocus"]
    assert [*errors(made).values()] == pytest.approx([0.0, 5.0, 0.2, 0.0, 0.0])
    assert made.details[0, len(PARTS) :].tolist() == [10, 2, 0.0]


def test_no_network_runs_for_the_errors_of_blur_that_nobody_asks_for() -> None:
    """The paper's aperture module needs the denoised light; its own blur is not known before."""
    noisy, found = NoiseLevelFunction((0.0,) * 4, (9.0,) * 4), Statistics(disc=0.01)
    lazy = DenoisedLight(lambda: pytest.fail("it ran"))
    opens = {"aperture_blur": Opening(math.inf, needs_denoised=True), "source": noisy}
    made = decided(0.1, found, (lazy,), **opens)
    assert runs(made) == ["noise_reduction", "aperture"]
    assert errors(made)["aperture"] == math.inf
    assert runs(decided(0.1, found, (lazy,), source=noisy)) == ["noise_reduction"]
    lazy.statistics = Statistics(disc=0.02)
    blurred = decided(0.1, found, (lazy,), **opens, **disc(2.0))
    assert errors(blurred)["defocus"] == pytest.approx(0.08)  # of the light that is blurred
    reasons = posed(0.1, found, **opens).plan(SOURCE).details()
    assert "runs noise_reduction: the aperture module works on the noise-reduced" in reasons
    assert "runs aperture: the aperture opens and adds blur\n" in reasons


def test_the_exposure_has_what_runs() -> None:
    """Of blur that is left out, no extent stays."""
    subject = torch.arange(20).expand(16, 20) > 9
    layout, movement = Layout(torch.ones(16, 20), subject), Movement(0.5, 0.0, 4.0)
    blurs = {**disc(2.0), **streak(4.0), "layout": layout, "movement": movement}
    drift = math.cos(0.0), math.sin(0.0)  # 4 frame heights of 16 pixels in 1 / 64 s
    length = path_length(4.0, 0.5, 0.0, *drift)
    for point, row in ((1.0, 1.0), (1.0, 0.0), (0.0, 1.0), (0.0, 0.0)):
        found = Statistics(disc=point, streak=3 / 4 * row)  # a path's bound is that of a disc
        made = decided(0.1, found, (network("a", 0.0),), **blurs)
        moves = point > 0.0
        extents = made.blurs[["defocus_px", "motion_px", "drift_x", "drift_y"]].tolist()
        assert extents == [pytest.approx((2.0 * moves, length * moves, *drift))]
        assert made.origins == [(None, None)]
        assert made.table[0, :, 0].tolist() == [1.0, -1.0, 1.0, 1.0, 0.0]
    exact = network("a", 0.0)
    exact.statistics = Statistics(2, 9)
    made = decided(0.1, Statistics(2, 9), (exact,), opened_px=9.0)
    assert made.origins == [(exact, 8.0)]
    assert made.table[0, :, 0].tolist() == [1.0, 0.0, 1.0, 0.0, 0.0]
    assert left_out(made) == []


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
