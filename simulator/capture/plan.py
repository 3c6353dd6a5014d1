"""Which steps a transition takes: decided, explained and priced in one place.

`decide` looks at numbers only and says for each step whether it runs and why; captures follow it
(`PreparedScene.exposure`), and `SimulationPlan` shows it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from numbers import Real
from typing import NamedTuple

import numpy as np
import torch

from simulator.capture.exposure import Exposure, Step
from simulator.capture.light_statistics import LightStatistics
from simulator.capture.sensor import NoiseBalance
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.settings import CameraSettings
from simulator.utils.tiles import varying

#: How much of a transition may be left out, in units of the target's noise: by default the
#: distribution of a pixel may move by a tenth of its noise's standard deviation.
DEFAULT_TOLERANCE = 0.1
#: Noise below this share of the light is not worth denoising: the networks' own error is as large.
WORTH_DENOISING = 0.006
#: Error of the compact noise module itself: a share of the standard deviation of the noise that
#: it removes, and a share of the light. Calibrated on 41 scenes of the validation split
#: (procedural, photographs, radiance maps, draped ones) at ISO 100 to 6400, 8 noisy captures each:
#: with these, `SimulationPlan.predicted_difference` bounds 98 % of 261 measured distances between
#: the full run and plans without noise reduction, and is two to three times the median one.
BIAS, GAMMA = 0.35, 0.015
#: Rounding error of float32 in a transition, as a share of the light.
ROUNDING = 2.0**-20
#: Arithmetic operations per sample of the steps whose cost does not depend on anything.
_OPERATIONS = {
    "exposure": 2,
    "noise_reduction": 1,
    "aperture": 4,
    "motion_blur": 6,
    "noise": 14,
    "clip_and_quantise": 6,
}


def check_tolerance(tolerance: float) -> float:
    """`tolerance` as a float.

    Raises:
        ValueError: Unless it is a finite number >= 0.
    """
    if (
        isinstance(tolerance, bool)
        or not isinstance(tolerance, Real)
        or not 0 <= tolerance < math.inf
    ):
        raise ValueError(f"`tolerance` (={tolerance!r}) must be a finite number >= 0")
    return float(tolerance)


# -- deciding ---------------------------------------------------------------------------------


class Situation(NamedTuple):
    """The numbers that decide which steps a transition takes.

    Args:
        ratio: Exposure ratio from the source to the target.
        source: Noise of the source, at its own exposure.
        target: Noise that the capture should have.
        tolerance: Bound on the root of the sum of squares of the errors of all that is left out.
            0 leaves out nothing that changes a pixel.
        noise: Whether a capture is wanted; else the light without noise, in which noise of the
            source cannot count as part of the target's.
        statistics: Of the light as it was recorded.
        denoised: Function that returns the statistics of the noise-reduced light; None without a
            noise module.
        defocus_px: Diameter of the defocus disc [pixel].
        motion_px: Length of the streak of motion [pixel].
        aperture_px: Largest diameter of the blur that the opening aperture adds [pixel], inf where
            it is not known; None where no defocus was estimated.
        opens: Whether the aperture opens.
        opens_denoised: Whether it is opened by a network that needs the noise-reduced light.
    """

    ratio: float
    source: NoiseLevelFunction
    target: NoiseLevelFunction
    tolerance: float
    noise: bool
    statistics: LightStatistics
    denoised: Callable[[], LightStatistics] | None = None
    defocus_px: float = 0.0
    motion_px: float = 0.0
    aperture_px: float | None = None
    opens: bool = False
    opens_denoised: bool = False


def decide(given: Situation) -> tuple[Step, Step, Step, Step]:
    """Noise reduction, aperture, defocus and motion blur, in the order in which they run.

    Noise that stays widens a pixel's distribution, blur that is missing shifts it: squares add.
    Several missing blurs shift it the same way and add up; the error of each is what it adds to the
    square, so that the root of the sum of squares of all errors is right for any set of steps.
    """
    noise_reduction = _decide_noise_reduction(given)
    if not (given.aperture_px or given.defocus_px or given.motion_px):
        return noise_reduction, _no_aperture(given), _no_defocus(given), _NO_MOTION
    missing_noise = missing_blur = 0.0
    if given.denoised is not None and not noise_reduction.runs:
        missing_noise = noise_reduction.error
    disc, row = _curvature(given, noise_reduction.runs)

    def blur(name: str, extent: float, curvature: float) -> Step:
        nonlocal missing_blur
        error = math.inf if extent == math.inf else curvature * extent * extent
        together = missing_blur + error
        left_out = math.hypot(missing_noise, together) <= given.tolerance
        added = math.sqrt(error * (together + missing_blur)) if error else 0.0
        if left_out:
            missing_blur = together
        reason = (_LEFT_OUT if left_out else _NEEDED)[name, extent == math.inf]
        if not left_out and added < math.inf:
            reason += _WITHOUT
        return Step(name, not left_out, reason, added, extent)

    aperture_px, defocus_px, motion_px = given.aperture_px, given.defocus_px, given.motion_px
    return (
        noise_reduction,
        blur("aperture", aperture_px, disc) if aperture_px else _no_aperture(given),
        blur("defocus", defocus_px, disc) if defocus_px else _no_defocus(given),
        blur("motion_blur", motion_px, row) if motion_px else _NO_MOTION,
    )


def _curvature(given: Situation, denoised: bool) -> tuple[float, float]:
    """`LightStatistics.curvature` of the light that is blurred."""
    if given.tolerance == 0.0:  # no blur is left out, however small
        return math.inf, math.inf
    if not (given.defocus_px or given.motion_px or given.aperture_px != math.inf):
        return math.inf, math.inf  # nobody asks: the network need not run for it
    light = given.statistics
    if denoised and given.denoised is not None:
        light = given.denoised()
    return light.curvature(given.ratio, given.target)


def _decide_noise_reduction(given: Situation) -> Step:
    if given.source.is_zero:
        return _CLEAN_SOURCE
    if given.denoised is None:  # its error need not be known to decide: `make_plan` works it out
        return _NO_NOISE_MODULE
    name, error = "noise_reduction", _noise_error(given)
    # Blur averages noise, too. That is not counted on: it may be left out itself.
    if given.opens_denoised and given.aperture_px:
        reason = "the aperture module works on the noise-reduced light only"
        return Step(name, True, reason + _WITHOUT, error)
    if given.tolerance > 0.0:
        if error <= given.tolerance:
            return Step(name, False, _small_noise(given, error), error)
        if not _worth_denoising(given):
            reason = "the source has so little noise that the network's own error is as large"
            return Step(name, False, reason, error)
    if not given.noise:
        reason = "no noise of the target's is there to take the source's up"
    elif error == 0.0:
        reason = "tolerance 0 takes no noisy pixel for its mean"
    else:
        reason = "the source is noisier than the target"
    return Step(name, True, reason + _WITHOUT, error)


def _noise_error(given: Situation) -> float:
    """Error of leaving the source's noise in, in units of the target's."""
    error_of = given.statistics.excess_error if given.noise else given.statistics.relative_noise
    return error_of(given.ratio, given.source, given.target)


def _worth_denoising(given: Situation) -> bool:
    """Whether the noise is more than `WORTH_DENOISING` of the light, at its median level."""
    signal = given.statistics.median
    deviation = np.sqrt(np.array(given.source.read) + np.array(given.source.shot) * signal)
    return bool((deviation > WORTH_DENOISING * signal).any())


def _small_noise(given: Situation, error: float) -> str:
    if not given.noise:
        return "the source's noise is small against the target's"
    if error == 0.0:
        return "the target is at least as noisy: noise is added up to it"
    return "the source is hardly noisier than the target, elsewhere noise is added up to it"


def _no_aperture(given: Situation) -> Step:
    if given.aperture_px is None:
        return _NO_APERTURE_MODULE
    return _IN_FOCUS if given.opens else _CLOSES


def _no_defocus(given: Situation) -> Step:
    return _FAR if given.aperture_px is None else _DEFOCUS_ESTIMATED


#: Steps that would do nothing.
_CLEAN_SOURCE = Step("noise_reduction", False, "the source carries no noise")
_NO_NOISE_MODULE = Step("noise_reduction", False, "the simulator has no noise module")
_NO_APERTURE_MODULE = Step(
    "aperture", False, "the scene is taken as in focus: `depth` is not 'unknown'"
)
_CLOSES = Step(
    "aperture", False, "the aperture does not open; what is blurred in the source stays so"
)
_IN_FOCUS = Step("aperture", False, "the picture was found to be in focus throughout")
_FAR = Step("defocus", False, "the scene is taken as far or in focus throughout")
_DEFOCUS_ESTIMATED = Step(
    "defocus", False, "none is given for the whole frame: each pixel's was estimated"
)
_NO_MOTION = Step("motion_blur", False, "the image does not move")
_WITHOUT = "; leaving it out would be an error of {error:.2g}"
#: Reasons by step, and whether the extent is unknown; filled in when a plan is shown.
_NEEDED = {
    ("aperture", False): "the aperture opens and adds blur (up to {extent:.2g} pixel)",
    ("aperture", True): "the aperture opens and adds blur",
    ("defocus", False): "the defocus disc is {extent:.3g} pixel wide",
    ("motion_blur", False): "the image moves by {extent:.3g} pixel during the exposure",
}
_LEFT_OUT = {
    ("aperture", False): "the blur that opening adds (up to {extent:.2g} pixel) would hardly show",
    ("defocus", False): "the defocus disc is {extent:.2g} pixel wide, which would hardly show",
    ("motion_blur", False): (
        "the image moves by {extent:.2g} pixel during the exposure, which would hardly show"
    ),
}


# -- showing ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class PlannedStep:
    """One step of a transition.

    Args:
        name: Its name in `SimulationPlan.modules`.
        runs: Whether it runs.
        reason: Why it does, or does not.
        error: Error of leaving it out, in units of the target's noise; 0 if it runs.
        operations: Arithmetic operations that it takes, all pixels together.
    """

    name: str
    runs: bool
    reason: str
    error: float
    operations: int


@dataclass(frozen=True)
class SimulationPlan:
    """Steps of a change of settings, with their cost in error and in work.

    Predicted errors are distances between the distributions of a pixel, root mean square over the
    pixels: ``sqrt(mean((dm^2 + ds^2) / s^2))`` where the mean moves by dm, the standard deviation
    by ds, and s is the standard deviation that the target's noise should have.

    Args:
        settings: Settings to simulate.
        exposure_ratio: How much brighter than the source the result is.
        steps: Every step in order, with the reason why it runs or not.
        tolerance: Bound that `predicted_error` was planned for.
        excess_noise: Variance that the source brings beyond the target's, relative to the target's,
            mean over the pixels. 0 means that the noise is exact.
        clipped_source: Share of the pixels that are saturated in the source: what they would show
            at a darker exposure is unknown.
        extrapolated_noise: Whether the target's ISO lies outside the camera's calibration.
        predicted_rmse: Root mean square of the excess noise, 1 is sensor white.
        predicted_difference: Bound on the distance to the full run (`CameraSimulator.simulate` with
            ``tolerance=None``), including the errors of the networks that it runs.
    """

    settings: CameraSettings
    exposure_ratio: float
    steps: tuple[PlannedStep, ...]
    tolerance: float
    excess_noise: float
    clipped_source: float
    extrapolated_noise: bool
    predicted_rmse: float
    predicted_difference: float

    @property
    def modules(self) -> tuple[str, ...]:
        """Steps that run, in order."""
        return tuple(step.name for step in self.steps if step.runs)

    @property
    def left_out(self) -> Mapping[str, str]:
        """Every other step and the reason why this scene does not need it."""
        return {step.name: step.reason for step in self.steps if not step.runs}

    @property
    def operations(self) -> int:
        """Arithmetic operations that the steps need, all pixels together.

        What `CameraSimulator.prepare` does once per scene, such as denoising, is not counted.
        """
        return sum(step.operations for step in self.steps)

    @property
    def predicted_error(self) -> float:
        """Distance to a camera that does every step perfectly: root of the sum of squares."""
        return math.hypot(*(step.error for step in self.steps))

    def explain(self) -> str:
        """The plan as text: what runs, what does not, why, and what that costs."""
        lines = [
            f"{self.settings}: {self.exposure_ratio:.4g} x the light of the source",
            f"  runs      {' -> '.join(self.modules)}",
        ]
        for step in self.steps:
            if step.runs and step.reason:
                lines.append(f"  needed    {step.name}: {step.reason}")
        for step in self.steps:
            if not step.runs:
                error = f" (error {step.error:.2g})" if step.error else ""
                lines.append(f"  left out  {step.name}: {step.reason}{error}")
        if "noise_reduction" in self.modules or "aperture" in self.modules:
            lines.append(
                "  networks  ran once for all settings; their error: docs/results/simulator.md"
            )
        lines.append(
            f"  error     {self.predicted_error:.2g} of the target's noise is due to what is left "
            f"out (tolerance {self.tolerance:g})"
        )
        lines.append(
            f"            at most {self.predicted_difference:.2g} of the target's noise away from "
            "the full run of this simulator"
        )
        lines.append(
            f"            noise variance {self.excess_noise:.1%} above the target's "
            f"(RMSE {self.predicted_rmse:.2e} of white); "
            f"{self.clipped_source:.2%} of the source is saturated"
        )
        if self.extrapolated_noise:
            lines.append("  warning   the ISO is outside the camera's noise calibration")
        lines.append(f"  cost      {self.operations / 1e6:.1f} million operations")
        return "\n".join(lines)

    def __str__(self) -> str:
        return self.explain()


def make_plan(
    settings: CameraSettings,
    exposure: Exposure,
    given: Situation,
    balance: NoiseBalance,
    light: torch.Tensor,
    clipped_source: float,
) -> SimulationPlan:
    """Steps, reasons, predicted error and cost of a capture, or of the light without noise.

    Args:
        settings: Settings to simulate.
        exposure: The exposure that was decided for them.
        given: The numbers that it was decided on.
        balance: The source's noise against the target's.
        light: (4, H, W) as it was recorded.
        clipped_source: See `SimulationPlan`.
    """
    samples = light.numel()
    noise_reduction, *blurs = exposure.steps
    if noise_reduction is _NO_NOISE_MODULE:
        noise_reduction = noise_reduction._replace(error=_noise_error(given))
    optional = tuple(_planned(step, samples) for step in (noise_reduction, *blurs))
    wanted, reason = given.noise, "only the light is asked for"
    noise = Step("noise", wanted and balance.lacks_noise, "" if wanted else reason)
    if wanted and not balance.lacks_noise:
        reason = "no pixel lacks noise: the source has the target's already, or more"
        noise = Step("noise", False, reason)
    clip = Step("clip_and_quantise", wanted, "" if wanted else "only the light is asked for")
    return SimulationPlan(
        settings=settings,
        exposure_ratio=exposure.ratio,
        steps=(
            _planned(Step("exposure", True, ""), samples),
            *optional,
            _planned(noise, samples),
            _planned(clip, samples),
        ),
        tolerance=given.tolerance,
        excess_noise=balance.relative_excess_variance,
        clipped_source=clipped_source,
        extrapolated_noise=exposure.target.extrapolated,
        predicted_rmse=balance.excess_variance**0.5,
        predicted_difference=_difference(exposure, given, optional, light),
    )


def _planned(step: Step, samples: int) -> PlannedStep:
    reason = step.reason.format(extent=step.extent, error=step.error)
    if not step.runs:
        return PlannedStep(step.name, False, reason, step.error, 0)
    per_sample = _OPERATIONS.get(step.name) or 2 * (1 + int(step.extent) ** 2)  # taps of a disc
    return PlannedStep(step.name, True, reason, 0.0, per_sample * samples)


def _difference(
    exposure: Exposure, given: Situation, steps: tuple[PlannedStep, ...], light: torch.Tensor
) -> float:
    """See `SimulationPlan.predicted_difference`."""
    excess, *errors = (step.error for step in steps)  # noise reduction is the first
    level = given.statistics.relative_level(given.ratio, given.target)
    moved = math.hypot(*errors) + ROUNDING * level
    if given.denoised is None:  # the full run does not reduce the noise either
        return moved
    if exposure.denoised:
        noise, level = (0.0, 0.0) if given.tolerance == 0.0 else _untouched(given, light)
    else:
        noise = given.statistics.relative_noise(given.ratio, given.source, given.target)
    if not given.source.is_zero:
        moved += math.hypot(BIAS * noise, GAMMA * level)
    return math.hypot(0.0 if exposure.denoised else excess, moved)


def _untouched(given: Situation, light: torch.Tensor) -> tuple[float, float]:
    """Noise and level, in units of the target's noise, of the regions that needed no network."""
    noise, level = 0.0, 0.0
    brought, target = given.source.exposed(given.ratio), given.target
    constant = ~varying(light)
    for plane in range(4):
        signal = (light[plane][constant] * given.ratio).clamp_(min=0.0).double()
        wanted = (signal * target.shot[plane] + target.read[plane]).clamp_(min=1e-30)
        level += float((signal**2 / wanted).sum())
        noise += float(((signal * brought.shot[plane] + brought.read[plane]) / wanted).sum())
    return math.sqrt(noise / light.numel()), math.sqrt(level / light.numel())
