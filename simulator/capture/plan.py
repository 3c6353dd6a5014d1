"""What a change of settings takes, why the rest is left out, and what it costs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from simulator.capture.exposure import Exposure
from simulator.capture.record import noise_balance
from simulator.settings import CameraSettings
from simulator.utils.tiles import varying

if TYPE_CHECKING:
    from simulator.capture.prepared_scene import PreparedScene

#: What the compact noise module errs by itself: a share of the standard deviation of the noise that
#: it removes, and a share of the light. Calibrated on 41 scenes of the validation split
#: (procedural, photographs, radiance maps, draped ones) at ISO 100 to 6400, 8 noisy captures each:
#: with these, `SimulationPlan.predicted_difference` bounds 98 % of 261 measured distances between
#: the full run and plans without noise reduction, and is two to three times the median one.
BIAS, GAMMA = 0.35, 0.015
#: What float32 loses in a transition, as a share of the light.
ROUNDING = 2.0**-20
_EXPOSE_OPERATIONS = 2
_NOISE_OPERATIONS = 14
_CLIP_OPERATIONS = 6
_STREAK_OPERATIONS = 6
_GATHER_OPERATIONS = 4


@dataclass(frozen=True)
class PlannedStep:
    """One step of a transition.

    Args:
        name: What it is called in `SimulationPlan.modules`.
        runs: Whether it runs.
        reason: Why it does, or does not.
        error: What leaving it out errs, in units of the target's noise; 0 if it runs.
        operations: Arithmetic operations that it takes, all pixels together.
    """

    name: str
    runs: bool
    reason: str
    error: float
    operations: int


@dataclass(frozen=True)
class SimulationPlan:
    """What a change of settings takes, and what it will cost in error and in work.

    Predicted errors are distances between the distributions of a pixel, root mean square over the
    pixels: ``sqrt(mean((dm^2 + ds^2) / s^2))`` where the mean moves by dm, the standard deviation
    by ds, and s is the standard deviation that the target's noise should have.

    Args:
        settings: Settings to simulate.
        exposure_ratio: How much brighter than the source the result is.
        steps: Every step in order, with the reason why it runs or not.
        tolerance: What `predicted_error` was allowed to be.
        excess_noise: Variance that the source brings beyond the target's, relative to the target's,
            mean over the pixels. 0 means that the noise is exact.
        clipped_source: Share of the pixels that are saturated in the source: what they would show
            at a darker exposure is unknown.
        extrapolated_noise: Whether the target's ISO lies outside the camera's calibration.
        predicted_rmse: Root mean square of the excess noise, 1 is sensor white.
        predicted_difference: Bound on the distance to the full run (`CameraSimulator.simulate` with
            ``tolerance=None``), which also has what the networks that it runs err themselves.
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
    prepared: PreparedScene, settings: CameraSettings, *, noise: bool = True
) -> SimulationPlan:
    """Steps, reasons, predicted error and cost of a capture of `prepared` at `settings`.

    Args:
        prepared: The scene's light.
        settings: Settings to simulate.
        noise: Whether a capture is wanted, or the light on the sensor without noise.
    """
    exposure = prepared.exposure(settings, noise=noise)
    # A clean source lacks all of the noise: its light need not be made to see that.
    light = prepared.light if exposure.source.is_zero else prepared.source_light(exposure)
    balance = noise_balance(light, exposure)
    pixels = prepared.light.numel()
    steps = (
        PlannedStep("exposure", True, "", 0.0, _EXPOSE_OPERATIONS * pixels),
        _noise_reduction(prepared, exposure, noise, pixels),
        _aperture(prepared, settings, exposure, pixels),
        _defocus(prepared, settings, exposure, pixels),
        _motion_blur(prepared, settings, exposure, pixels),
        _noise(noise, balance.is_short, pixels),
        _clip(noise, pixels),
    )
    return SimulationPlan(
        settings=settings,
        exposure_ratio=exposure.ratio,
        steps=steps,
        tolerance=prepared.tolerance,
        excess_noise=balance.relative_excess,
        clipped_source=0.0
        if prepared.saturated is None
        else int(prepared.saturated.count_nonzero()) / prepared.saturated.numel(),
        extrapolated_noise=exposure.target.extrapolated,
        predicted_rmse=balance.excess**0.5,
        predicted_difference=_difference(prepared, exposure, steps),
    )


def _difference(
    prepared: PreparedScene, exposure: Exposure, steps: tuple[PlannedStep, ...]
) -> float:
    """See `SimulationPlan.predicted_difference`."""
    ratio, target = exposure.ratio, exposure.target
    found = prepared.statistics  # of the light as recorded: a plan need not run the network
    errors = {step.name: step.error for step in steps}
    excess = errors.pop("noise_reduction")
    level = found.relative_level(ratio, target)
    moved = math.hypot(*errors.values()) + ROUNDING * level
    if prepared.denoised is None:  # the full run does not reduce the noise either
        return moved
    if exposure.denoised:
        noise, level = _untouched(prepared, exposure)
    else:
        noise = found.relative_noise(ratio, prepared.nlf, target)
    if not prepared.nlf.is_zero:
        moved += math.hypot(BIAS * noise, GAMMA * level)
    return math.hypot(0.0 if exposure.denoised else excess, moved)


def _untouched(prepared: PreparedScene, exposure: Exposure) -> tuple[float, float]:
    """Noise and level, in units of the target's noise, of the regions that needed no network."""
    if prepared.tolerance == 0.0 or prepared.denoised is None:
        return 0.0, 0.0
    noise, level = 0.0, 0.0
    brought = prepared.nlf.exposed(exposure.ratio)
    constant = ~varying(prepared.light)
    for plane in range(4):
        signal = (prepared.light[plane][constant] * exposure.ratio).clamp_(min=0.0).double()
        target = exposure.target
        wanted = (signal * target.shot[plane] + target.read[plane]).clamp_(min=1e-30)
        share = 1.0 / prepared.light.numel()
        level += share * float((signal**2 / wanted).sum())
        given = signal * brought.shot[plane] + brought.read[plane]
        noise += share * float((given / wanted).sum())
    return math.sqrt(noise), math.sqrt(level)


def _step(
    exposure: Exposure, name: str, runs: bool, reasons: tuple[str, str], operations: int
) -> PlannedStep:
    """A step that would do something: it runs because of its error, or is left out within it."""
    error = exposure.errors[name]
    if not runs:
        return PlannedStep(name, False, reasons[0], error, 0)
    cause = f"; leaving it out would err by {error:.2g}" if error < math.inf else ""
    return PlannedStep(name, True, reasons[1] + cause, 0.0, operations)


def _unneeded(name: str, reason: str, error: float = 0.0) -> PlannedStep:
    return PlannedStep(name, False, reason, error, 0)


def _noise_reduction(
    prepared: PreparedScene, exposure: Exposure, noise: bool, pixels: int
) -> PlannedStep:
    name = "noise_reduction"
    if prepared.nlf.is_zero:
        return _unneeded(name, "the source carries no noise")
    left = prepared.statistics.excess if noise else prepared.statistics.relative_noise
    error = left(exposure.ratio, prepared.nlf, exposure.target)
    if prepared.denoised is None:
        return _unneeded(name, "the simulator has no noise module", error)
    if error > prepared.tolerance:
        left_out = "the source has so little noise that the network would err as much"
    elif not noise:
        left_out = "the source's noise is small against the target's"
    elif error == 0.0:
        left_out = "the target is at least as noisy: noise is added up to it"
    else:
        left_out = "the source is hardly noisier than the target, elsewhere noise is added up to it"
    needed = "the source is noisier than the target"
    if not noise:
        needed = "no noise of the target's is there to take the source's up"
    elif error == 0.0:
        needed = "tolerance 0 takes no noisy pixel for its mean"
    if (
        prepared.aperture_blur is not None
        and prepared.aperture_blur.needs_denoised
        and exposure.opened_to
    ):
        needed = "the aperture module works on the noise-reduced light only"
    return _step(exposure, name, exposure.denoised, (left_out, needed), pixels)


def _aperture(
    prepared: PreparedScene, settings: CameraSettings, exposure: Exposure, pixels: int
) -> PlannedStep:
    name, aperture_blur = "aperture", prepared.aperture_blur
    if aperture_blur is None:
        return _unneeded(name, "no defocus was estimated: `depth` is not 'unknown'")
    if settings.effective_f_number >= aperture_blur.f_number:
        return _unneeded(name, "the aperture does not open; what is blurred in the source stays so")
    added = prepared.blurred_light.added_blur(settings.effective_f_number)
    if not added:
        return _unneeded(name, "the picture was found to be in focus throughout")
    largest = f" (up to {added:.2g} pixel)" if added < math.inf else ""
    reasons = (
        f"the blur that opening adds{largest} would hardly show",
        f"the aperture opens and adds blur{largest}",
    )
    runs = exposure.opened_to is not None
    return _step(exposure, name, runs, reasons, _GATHER_OPERATIONS * pixels)


def _defocus(
    prepared: PreparedScene, settings: CameraSettings, exposure: Exposure, pixels: int
) -> PlannedStep:
    name = "defocus"
    if prepared.defocus:
        disc = prepared.defocus * 4.0 / settings.effective_f_number
        taps = 1 + int(disc) ** 2
        reasons = (
            f"the defocus disc is {disc:.2g} pixel wide, which would hardly show",
            f"the defocus disc is {disc:.3g} pixel wide",
        )
        return _step(exposure, name, exposure.defocus_px > 0, reasons, taps * 2 * pixels)
    if prepared.aperture_blur is not None:
        return _unneeded(name, "none is given for the whole frame: each pixel's was estimated")
    return _unneeded(name, "the scene is taken as far or in focus throughout")


def _motion_blur(
    prepared: PreparedScene, settings: CameraSettings, exposure: Exposure, pixels: int
) -> PlannedStep:
    name = "motion_blur"
    if prepared.image_speed == 0:
        return _unneeded(name, "the image does not move")
    streak = prepared.image_speed * settings.exposure_time * prepared.light.shape[-2]
    reasons = (
        f"the image moves by {streak:.2g} pixel during the exposure, which would hardly show",
        f"the image moves by {streak:.3g} pixel during the exposure",
    )
    return _step(exposure, name, exposure.motion_px > 0, reasons, _STREAK_OPERATIONS * pixels)


def _noise(wanted: bool, is_short: bool, pixels: int) -> PlannedStep:
    if not wanted:
        return _unneeded("noise", "only the light is asked for")
    if not is_short:
        reason = "no pixel lacks noise: the source has the target's already, or more"
        return _unneeded("noise", reason)
    return PlannedStep("noise", True, "", 0.0, _NOISE_OPERATIONS * pixels)


def _clip(wanted: bool, pixels: int) -> PlannedStep:
    if not wanted:
        return _unneeded("clip_and_quantise", "only the light is asked for")
    return PlannedStep("clip_and_quantise", True, "", 0.0, _CLIP_OPERATIONS * pixels)
