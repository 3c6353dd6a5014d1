"""Exposure of one capture: the steps from a scene's light to the sensor, and why they are taken.

`decide` looks at numbers only, and says for each step whether it runs and why. Captures follow the
`Exposure` that it returns, and `simulator.capture.plan.SimulationPlan` shows it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple, cast

import numpy as np
import torch

from simulator.capture.layout import Layout
from simulator.capture.statistics import DenoisedLight, LightStatistics, ResidualStatistics
from simulator.noise.noise_level_function import NoiseLevelFunction, top_up_table
from simulator.optics.discs import kernel_energy
from simulator.optics.motion import Path
from simulator.raw.develop import ABOVE_WHITE

#: Signals beyond this many times sensor white are clipped early: they end at white in any case,
#: and an infinite variance times a zero draw would be NaN.
SIGNAL_LIMIT = 1e6
#: Light beyond this many times the reference's white is clipped before it is blurred: it is white
#: at every exposure, and sums of larger numbers would no longer resolve the shadows.
LIGHT_LIMIT = 1e9
#: Exposure ratios are limited to this: float32 must hold them, and any two settings keep below.
RATIO_LIMIT = 2.0**107
#: Most negative signal that a companded 8-bit code shows; the offset under its square root.
PEDESTAL = 1.0 / 1024.0
#: Rounding error of float32 in a transition, as a share of the light.
ROUNDING = 2.0**-20
#: Root mean square light hidden by white, over what a density that falls with the square of the
#: light would have.
HIDDEN_LIGHT = 0.3
#: Second moment of a streak over that of a disc of the same extent, per axis: (1/12) / (1/16).
_STREAK_TO_DISC = 4.0 / 3.0
#: Relative error of the noise's standard deviation for each stop of ISO beyond the calibration:
#: without their last ISOs the Z6's table is off by 0.03 to 0.05, the 70D's by 0.17 to 0.25.
EXTRAPOLATION_ERROR = 0.1


class Step(NamedTuple):
    """A step that a capture may leave out.

    Args:
        name: Its name in `SimulationPlan.modules`.
        runs: Whether it runs.
        reason: Why it does, or does not; ``{extent}`` and ``{error}`` stand for the numbers.
        error: Error of leaving it out, in units of the target's noise.
        extent: Extent of its blur [pixel], where it is one.
        residual: Error that it makes itself where it runs, as far as that is known.
        network: The network that it runs, if any.
    """

    name: str
    runs: bool
    reason: str
    error: float = 0.0
    extent: float = 0.0
    residual: float = 0.0
    network: DenoisedLight | None = None


class TransitionInputs(NamedTuple):
    """What decides which steps a capture takes.

    Args:
        ratio: Exposure ratio from the source to the target.
        source: Noise of the source, at its own exposure.
        target: Noise that the capture should have.
        tolerance: Error that the capture may have: the cheapest way within it is taken, or else
            the one with the least error. At 0 that is always the one with the least.
        noise: Whether a capture is wanted; else the light without noise, in which noise of the
            source cannot count as part of the target's.
        statistics: Of the light as it was recorded.
        residuals: Errors of networks on that light.
        networks: The results of the noise modules that there are, the cheapest first.
        defocus_px: Diameter of the defocus disc [pixel].
        motion_px: Length of the longest path of motion [pixel].
        layout: See `Exposure`.
        path: See `Exposure`; None where the motion is a streak along the rows.
        subject_path: See `Exposure`.
        f_number: Effective f-number of the target.
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
    residuals: ResidualStatistics
    networks: tuple[DenoisedLight, ...] = ()
    defocus_px: float = 0.0
    motion_px: float = 0.0
    layout: Layout | None = None
    path: Path | None = None
    subject_path: Path | None = None
    f_number: float = 1.0
    aperture_px: float | None = None
    opens: bool = False
    opens_denoised: bool = False


@dataclass(frozen=True)
class Exposure:
    """Exposure of one capture: ratio, noise and blur, from a scene's light to the sensor.

    Args:
        ratio: Exposure ratio from the prepared scene's reference to the capture.
        source: Noise in the prepared scene at its reference settings.
        target: Noise of the camera at the capture's settings.
        motion_px: How far the image moves while the shutter is open [pixel], at most.
        defocus_px: Diameter of the defocus disc [pixel], of the largest one.
        layout: What is out of focus and what is the subject; None for one disc everywhere, and
            where all of the frame moves together.
        path: Of the background; None for a streak along the rows, as long as `motion_px`.
        subject_path: Of the layout's subject where it moves on its own.
        energy: Share of the source's noise variance that these blurs leave; None for what a disc
            and a streak leave.
        denoised: The noise-reduced light that it starts from; `source` is zero then. None for the
            light as it was recorded.
        opened_to: Effective f-number whose wider aperture blurs what the source shows out of focus;
            None where it does not.
        remaining_variance: (H, W) share of the source's noise variance that the blurs leave, beyond
            `energy`: of all of them with a layout, else of `opened_to`; None for all.
        steps: Noise reduction, aperture, defocus and motion blur, in the order in which they run:
            why each runs or is left out.
        inputs: What that was decided on; None where it was not.
    """

    ratio: float
    source: NoiseLevelFunction
    target: NoiseLevelFunction
    motion_px: float = 0.0
    defocus_px: float = 0.0
    layout: Layout | None = None
    path: Path | None = None
    subject_path: Path | None = None
    energy: float | None = None
    denoised: DenoisedLight | None = None
    opened_to: float | None = None
    remaining_variance: torch.Tensor | None = None
    steps: tuple[Step, ...] = field(default=(), compare=False)
    inputs: TransitionInputs | None = field(default=None, compare=False, repr=False)

    @cached_property
    def source_noise(self) -> NoiseLevelFunction:
        """Noise of the source on the sensor: exposed, and averaged by the blur."""
        if self.source.is_zero:
            return self.source
        energy = self.energy
        if energy is None:
            energy = kernel_energy(self.motion_px, self.defocus_px)
        return self.source.exposed(self.ratio).scaled(energy)

    @property
    def is_uniform(self) -> bool:
        """Whether its blur is a disc and a streak along the rows, the same everywhere."""
        return self.layout is None and self.path is None

    @property
    def left_out(self) -> float:
        """Error of the steps that are left out, in units of the target's noise."""
        return math.hypot(*(step.error for step in self.steps if not step.runs))

    @property
    def lens_blur(self) -> tuple[object, ...]:
        """Key of the light behind the lens, before motion and exposure."""
        layout = self.layout if self.defocus_px else None
        return self.denoised, self.opened_to, self.defocus_px, layout

    @property
    def blur(self) -> tuple[object, ...]:
        """Key of the light on the sensor, before exposure."""
        return (*self.lens_blur, self.motion_px, self.path, self.subject_path)


def exposure_table(exposures: Sequence[Exposure]) -> np.ndarray:
    """Exposures as the columns of a batch: (B, 5, 4) float32, columns are the planes R, G1, G2, B.

    The rows: exposure ratio; then the rows of `top_up_table`.
    """
    table = np.empty((len(exposures), 5, 4), np.float32)
    table[:, 0] = np.array([exposure.ratio for exposure in exposures])[:, None]
    table[:, 1:] = top_up_table([e.source_noise for e in exposures], [e.target for e in exposures])
    return table


# -- deciding ---------------------------------------------------------------------------------


def decide(inputs: TransitionInputs) -> Exposure:
    """The exposure of a capture, without what `BlurredLight.with_remaining_noise` knows of it."""
    steps = _decide_steps(inputs)
    noise_reduction, aperture, defocus, motion_blur = steps
    defocus_px = defocus.extent if defocus.runs else 0.0
    moves, denoised = motion_blur.runs, noise_reduction.network
    subject_path = inputs.subject_path if moves else None
    return Exposure(
        ratio=inputs.ratio,
        source=inputs.source if denoised is None else NoiseLevelFunction.zero(),
        target=inputs.target,
        motion_px=motion_blur.extent if moves else 0.0,
        defocus_px=defocus_px,
        layout=inputs.layout if defocus_px or subject_path is not None else None,
        path=inputs.path if moves else None,
        subject_path=subject_path,
        denoised=denoised,
        opened_to=inputs.f_number if aperture.runs else None,
        steps=steps,
        inputs=inputs,
    )


def _decide_steps(inputs: TransitionInputs) -> tuple[Step, ...]:
    """`Exposure.steps`.

    Noise that stays widens a pixel's distribution, blur that is missing shifts it: squares add.
    Several missing blurs shift it the same way and add up; the error of each is what it adds to the
    square, so that the root of the sum of squares of all errors is right for any set of steps.
    """
    noise_reduction = _decide_noise_reduction(inputs)
    missing_noise = noise_reduction.residual if noise_reduction.runs else noise_reduction.error
    # No network can mend it: blur has the tolerance to itself.
    if missing_noise > inputs.tolerance or not inputs.networks:
        missing_noise = 0.0
    extents = {
        "aperture": inputs.aperture_px or 0.0,
        "defocus": inputs.defocus_px,
        "motion_blur": inputs.motion_px,
    }
    disc = row = 0.0
    if any(extents.values()):
        disc, row = _curvature(inputs, noise_reduction.network)
    blurs, missing_blur = [], 0.0
    for name, extent in extents.items():
        if not extent:
            blurs.append(Step(name, False, _without_blur(name, inputs)))
            continue
        curvature = row if name == "motion_blur" else disc
        error = math.inf if extent == math.inf else curvature * extent * extent
        together = missing_blur + error
        left_out = math.hypot(missing_noise, together) <= inputs.tolerance
        added = math.sqrt(error * (together + missing_blur)) if error else 0.0
        if left_out:
            missing_blur = together
        reason = "the aperture opens and adds blur"
        if extent < math.inf:
            reason = _BLUR_REASONS[name][left_out]
        if not left_out and added < math.inf:
            reason += _WITHOUT
        blurs.append(Step(name, not left_out, reason, added, extent))
    return noise_reduction, *blurs


def _curvature(inputs: TransitionInputs, network: DenoisedLight | None) -> tuple[float, float]:
    """`LightStatistics.curvature` of the light that is blurred."""
    if inputs.tolerance == 0.0:  # no blur is left out, however small
        return math.inf, math.inf
    if not (inputs.defocus_px or inputs.motion_px or inputs.aperture_px != math.inf):
        return math.inf, math.inf  # not needed: the network need not run for it
    light = inputs.statistics if network is None else network.statistics
    disc, row = light.curvature(inputs.ratio, inputs.target)
    # No second difference exceeds the Laplacian, in the root mean square: (k u)^4 <= |k|^4.
    return disc, row if inputs.path is None else _STREAK_TO_DISC * disc


def _decide_noise_reduction(inputs: TransitionInputs) -> Step:
    """The cheapest of all ways within the tolerance, or else the one with the least error."""
    name = "noise_reduction"
    if inputs.source.is_zero:
        return Step(name, False, "the source carries no noise")
    error = _noise_error(inputs)
    if not inputs.networks:
        return Step(name, False, "the simulator has no noise module", error)
    if inputs.opens_denoised and inputs.aperture_px:  # blur averages noise, too: not counted on
        reason = "the aperture module works on the noise-reduced light only" + _WITHOUT
        network = inputs.networks[-1]
        return Step(name, True, reason, error, 0.0, _network_error(inputs, network), network)
    if error <= inputs.tolerance:
        return Step(name, False, _small_noise(inputs, error), error)
    best, least = inputs.networks[0], math.inf
    for network in inputs.networks:
        residual = _network_error(inputs, network)
        if residual < least:
            best, least = network, residual
        if residual <= inputs.tolerance:
            break
    if error <= least:
        return Step(name, False, "no network would make a smaller error than the noise", error)
    reason = "the source is noisier than the target"
    if not inputs.noise:
        reason = "the light is wanted without noise"
    return Step(name, True, reason + _WITHOUT, error, 0.0, least, best)


def _network_error(inputs: TransitionInputs, network: DenoisedLight) -> float:
    """Error of a network itself, in units of the target's noise; 0 where it was not measured."""
    if network.residual is None:
        return 0.0
    return inputs.residuals.error(network.residual, inputs.ratio, inputs.target, noise=inputs.noise)


def _noise_error(inputs: TransitionInputs) -> float:
    """Error of leaving the source's noise in, in units of the target's."""
    error_of = inputs.statistics.excess_error if inputs.noise else inputs.statistics.relative_noise
    return error_of(inputs.ratio, inputs.source, inputs.target)


def _small_noise(inputs: TransitionInputs, error: float) -> str:
    if not inputs.noise:
        return "the source's noise is small against the target's"
    if error == 0.0:
        return "the target is at least as noisy: noise is added up to it"
    return "the source's noise beyond the target's is within the tolerance"


def _without_blur(name: str, inputs: TransitionInputs) -> str:
    """Reason why a blur would do nothing."""
    if name == "motion_blur":
        return "the image does not move"
    estimated = inputs.aperture_px is not None
    if name == "defocus":
        if estimated:
            return "none is given for the whole frame: each pixel's was estimated"
        return "the scene is taken as far or in focus throughout"
    if not estimated:
        return "the scene is taken as in focus: `depth` is not 'unknown'"
    if inputs.opens:
        return "the picture was found to be in focus throughout"
    return "the aperture does not open; what is blurred in the source stays so"


_WITHOUT = "; leaving it out would be an error of {error:.2g}"
#: Reasons why a blur runs, and why it is left out; filled in when a plan is shown.
_BLUR_REASONS = {
    "aperture": (
        "the aperture opens and adds blur (up to {extent:.2g} pixel)",
        "the blur that opening adds (up to {extent:.2g} pixel) would hardly show",
    ),
    "defocus": (
        "the defocus disc is {extent:.3g} pixel wide",
        "the defocus disc is {extent:.2g} pixel wide, which would hardly show",
    ),
    "motion_blur": (
        "the image moves by {extent:.3g} pixel during the exposure",
        "the image moves by {extent:.2g} pixel during the exposure, which would hardly show",
    ),
}


# -- predicting -------------------------------------------------------------------------------


def predict_errors(
    exposure: Exposure, clipped_source: float, depth_error: float
) -> dict[str, float]:
    """`simulator.capture.plan.SimulationPlan.errors` of an exposure that `decide` returned.

    Args:
        exposure: The exposure.
        clipped_source: Share of the pixels that are saturated in the source.
        depth_error: Error due to a depth that is not known, in units of the target's noise.
    """
    inputs = cast(TransitionInputs, exposure.inputs)
    extrapolated = abs(exposure.target.extrapolation) if inputs.noise else 0.0
    return {
        "left out": exposure.left_out,
        "network": exposure.steps[0].residual,
        "clipped highlights": _hidden_highlights(inputs, clipped_source),
        "unknown depth": depth_error,
        "ISO": EXTRAPOLATION_ERROR * extrapolated,
        "rounding": ROUNDING * inputs.statistics.relative_level(inputs.ratio, inputs.target),
    }


def _hidden_highlights(inputs: TransitionInputs, share: float) -> float:
    """Error of what a `share` of the pixels, saturated in the source, would show when darker.

    Light above white is taken to be distributed as natural highlights are, with a density that
    falls with its square; what is white stands for twice that, its median.
    """
    ratio, target = inputs.ratio, inputs.target
    if not share or ratio >= 1.0 or ratio <= 0.0:
        return 0.0
    shown = min(ABOVE_WHITE * ratio, 1.0)
    square = shown**2 * (1.0 - ratio) + 2.0 * shown * ratio * math.log(ratio)
    square += ratio * (1.0 - ratio) + ratio * (1.0 - shown) ** 2
    variance = sum(s * ratio + r for s, r in zip(target.shot, target.read, strict=True))
    return HIDDEN_LIGHT * math.sqrt(share * square / max(variance / 4.0, 1e-30))
