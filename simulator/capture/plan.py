"""Which steps a transition takes: decided, explained and priced in one place.

`decide` looks at numbers only and says for each step whether it runs and why; captures follow it
(`PreparedScene.exposure`), and `SimulationPlan` shows it.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from numbers import Real
from typing import NamedTuple

import numpy as np
import torch

from simulator.camera import get_camera
from simulator.capture.denoised import Denoised
from simulator.capture.exposure import Exposure, Step
from simulator.capture.light_statistics import LightStatistics
from simulator.capture.residual import ResidualStatistics
from simulator.capture.sensor import NoiseBalance, Transitions, record
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.raw.develop import ABOVE_WHITE
from simulator.settings import CameraSettings

#: Error that a capture may have, in units of the target's noise: by default the distribution of a
#: pixel may move by a tenth of its noise's standard deviation.
DEFAULT_TOLERANCE = 0.1
#: Rounding error of float32 in a transition, as a share of the light.
ROUNDING = 2.0**-20
#: Errors of the estimated map of defocus: the share of the blur that it adds by which it errs, the
#: blur that it cannot see [pixel of diameter], and by how much what a blurred picture changes when
#: it is blurred again understates what it would change if it were sharpened.
DEPTH_ERROR, MISSED_BLUR, KEPT_BLUR_ERROR = 0.6, 0.7, 3.0
#: Root mean square light hidden by white, over what a density that falls with the square of the
#: light would have.
HIDDEN_LIGHT = 0.3
#: Second moment of a streak over that of a disc of the same extent, per axis: (1/12) / (1/16).
_STREAK_TO_DISC = 4.0 / 3.0
#: Relative error of the noise's standard deviation for each stop of ISO beyond the calibration:
#: without their last ISOs the Z6's table is off by 0.03 to 0.05, the 70D's by 0.17 to 0.25.
EXTRAPOLATION_ERROR = 0.1
#: Factors on predicted errors, below which 90 % of the measured ones are: `ae-env bench
#: work-precision` on validation scenes. The network's comes on top of its own `spread`.
_BOUND = {
    "left out": 1.1,
    "network": 1.05,
    "clipped highlights": 1.2,
    "unknown depth": 1.1,
    "ISO": 2.5,
}
#: Below this are 90 % of the errors where no part is predicted: single noisy samples that were
#: clipped or rounded in the source.
_LEAST_BOUND = 0.05
#: Arithmetic operations per sample of the steps whose cost does not depend on anything.
_OPERATIONS = {
    "exposure": 2,
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
        tolerance: Error that the capture may have: the cheapest way within it is taken, or else
            the one with the least error. At 0 that is always the one with the least.
        noise: Whether a capture is wanted; else the light without noise, in which noise of the
            source cannot count as part of the target's.
        statistics: Of the light as it was recorded.
        residuals: Errors of networks on that light.
        networks: The noise modules that there are, the cheapest first.
        defocus_px: Diameter of the defocus disc [pixel].
        motion_px: Length of the streak of motion [pixel].
        aperture_px: Largest diameter of the blur that the opening aperture adds [pixel], inf where
            it is not known; None where no defocus was estimated.
        opens: Whether the aperture opens.
        opens_denoised: Whether it is opened by a network that needs the noise-reduced light.
        along_rows: Whether the motion is a streak along the rows.
    """

    ratio: float
    source: NoiseLevelFunction
    target: NoiseLevelFunction
    tolerance: float
    noise: bool
    statistics: LightStatistics
    residuals: ResidualStatistics
    networks: tuple[Denoised, ...] = ()
    defocus_px: float = 0.0
    motion_px: float = 0.0
    aperture_px: float | None = None
    opens: bool = False
    opens_denoised: bool = False
    along_rows: bool = True


def decide(given: Situation) -> tuple[Step, Step, Step, Step]:
    """Noise reduction, aperture, defocus and motion blur, in the order in which they run.

    Noise that stays widens a pixel's distribution, blur that is missing shifts it: squares add.
    Several missing blurs shift it the same way and add up; the error of each is what it adds to the
    square, so that the root of the sum of squares of all errors is right for any set of steps.
    """
    noise_reduction = _decide_noise_reduction(given)
    if not (given.aperture_px or given.defocus_px or given.motion_px):
        return noise_reduction, _no_aperture(given), _no_defocus(given), _NO_MOTION
    missing_blur = 0.0
    missing_noise = noise_reduction.residual if noise_reduction.runs else noise_reduction.error
    if missing_noise > given.tolerance:  # beyond anybody's reach: blur has the tolerance to itself
        missing_noise = 0.0
    disc, row = _curvature(given, noise_reduction.network)

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


def _curvature(given: Situation, network: Denoised | None) -> tuple[float, float]:
    """`LightStatistics.curvature` of the light that is blurred."""
    if given.tolerance == 0.0:  # no blur is left out, however small
        return math.inf, math.inf
    if not (given.defocus_px or given.motion_px or given.aperture_px != math.inf):
        return math.inf, math.inf  # nobody asks: the network need not run for it
    light = given.statistics if network is None else network.statistics
    disc, row = light.curvature(given.ratio, given.target)
    # No second difference exceeds the Laplacian, in the root mean square: (k u)^4 <= |k|^4.
    return disc, row if given.along_rows else _STREAK_TO_DISC * disc


def _decide_noise_reduction(given: Situation) -> Step:
    """The cheapest of all ways within the tolerance, or else the one with the least error."""
    if given.source.is_zero:
        return _CLEAN_SOURCE
    if not given.networks:  # its error need not be known to decide: `make_plan` works it out
        return _NO_NOISE_MODULE
    name, error = "noise_reduction", _noise_error(given)
    if given.opens_denoised and given.aperture_px:  # blur averages noise, too: not counted on
        reason = "the aperture module works on the noise-reduced light only" + _WITHOUT
        network = given.networks[-1]
        return Step(name, True, reason, error, 0.0, _own_error(given, network), network)
    if error <= given.tolerance:
        return Step(name, False, _small_noise(given, error), error)
    best, least = given.networks[0], math.inf
    for network in given.networks:
        residual = _own_error(given, network)
        if residual < least:
            best, least = network, residual
        if residual <= given.tolerance:
            break
    if error <= least:
        return Step(name, False, "no network would err less than the noise", error)
    reason = "the source is noisier than the target"
    if not given.noise:
        reason = "no noise of the target's is there to take the source's up"
    return Step(name, True, reason + _WITHOUT, error, 0.0, least, best)


def _own_error(given: Situation, network: Denoised) -> float:
    """Error of a network itself, in units of the target's noise; 0 where it was not measured."""
    if network.residual is None:
        return 0.0
    return given.residuals.error(network.residual, given.ratio, given.target, noise=given.noise)


def _noise_error(given: Situation) -> float:
    """Error of leaving the source's noise in, in units of the target's."""
    error_of = given.statistics.excess_error if given.noise else given.statistics.relative_noise
    return error_of(given.ratio, given.source, given.target)


def _small_noise(given: Situation, error: float) -> str:
    if not given.noise:
        return "the source's noise is small against the target's"
    if error == 0.0:
        return "the target is at least as noisy: noise is added up to it"
    return "the source's noise beyond the target's is within the tolerance"


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
        operations: Arithmetic operations that it takes, all pixels together; those of a network
            once for all settings.
    """

    name: str
    runs: bool
    reason: str
    error: float
    operations: int


@dataclass(frozen=True)
class SimulationPlan:
    """Steps of a change of settings, with their cost in error and in work.

    Errors are distances between the distributions of a pixel, as they are and as a camera's would
    be, over the noise of the source and of the capture: root mean square over the pixels of
    ``sqrt(dm^2 + ds^2) / s``, where the mean moves by dm, the standard deviation by ds, and s is
    the standard deviation that the target's noise should have.

    Args:
        settings: Settings to simulate.
        exposure_ratio: How much brighter than the source the result is.
        steps: Every step in order, with the reason why it runs or not.
        tolerance: Error that was asked for.
        network: Name of the noise module that runs; None for none.
        errors: The parts of the error by what they come from; ``"left out"``, ``"network"``,
            ``"clipped highlights"``, ``"unknown depth"``, ``"ISO"``, ``"rounding"``.
        error_bound: Bound below which the error is in 90 % of all cases.
        excess_noise: Variance that the source brings beyond the target's, relative to the target's,
            mean over the pixels. 0 means that the noise is exact.
        clipped_source: Share of the pixels that are saturated in the source: what they would show
            at a darker exposure is unknown.
        extrapolated: Stops by which the target's ISO lies outside the camera's calibration.
        network_seconds: Estimated time of the network on this machine [s].
    """

    settings: CameraSettings
    exposure_ratio: float
    steps: tuple[PlannedStep, ...]
    tolerance: float
    network: str | None
    errors: Mapping[str, float]
    error_bound: float
    excess_noise: float
    clipped_source: float
    extrapolated: float
    network_seconds: Callable[[], float]

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
        """Arithmetic operations that the steps need, all pixels together, the networks included."""
        return sum(step.operations for step in self.steps)

    @property
    def predicted_error(self) -> float:
        """Distance to what the camera would have recorded: root of the sum of squares."""
        return math.hypot(*self.errors.values())

    @property
    def milliseconds(self) -> tuple[float, float]:
        """Estimated time on this machine [ms]: of this capture, and once for all settings."""
        own = sum(s.operations for s in self.steps if s.name != "noise_reduction")
        shared = 0.0 if self.network is None else self.network_seconds()
        return 1e3 * own * seconds_per_operation(), 1e3 * shared

    def explain(self) -> str:
        """The plan in three lines: what runs, what it errs by, what it costs."""
        runs = [
            f"{name} ({self.network})" if name == "noise_reduction" else name
            for name in self.modules
        ]
        parts = [f"{name} {_short(error)}" for name, error in self.errors.items() if error >= 0.005]
        avoidable = math.hypot(self.errors["left out"], self.errors["network"])
        within = "kept"
        if avoidable > self.tolerance:
            within = "out of reach, the least of these networks"
        elif self.predicted_error > self.tolerance + 0.005:
            within = "kept by what can be chosen"
        capture, shared = self.milliseconds
        once = f" and {_short(shared)} ms once for all settings" if shared else ""
        return (
            f"{self.settings}: {self.exposure_ratio:.4g} x the light; {' -> '.join(runs)}\n"
            f"error {_short(self.predicted_error)} of the target's noise, 90 % bound "
            f"{_short(self.error_bound)}{': ' * bool(parts)}{', '.join(parts)} "
            f"(tolerance {self.tolerance:g}: {within})\n"
            f"cost {_counted(self.operations)} operations, about {_short(max(capture, 0.01))} ms a "
            "capture"
            f"{once}"
        )

    def details(self) -> str:
        """Why each step runs or does not, and what cannot be made exact."""
        lines = []
        for step in self.steps:
            if step.reason:
                error = f" (error {_short(step.error)})" if step.error else ""
                lines.append(
                    f"{'runs' if step.runs else 'left out'} {step.name}: {step.reason}{error}"
                )
        if self.excess_noise:
            lines.append(
                f"noise variance {1.0 + self.excess_noise:.4g} times the target's, white included"
            )
        if self.clipped_source >= 5e-5:
            lines.append(f"{self.clipped_source:.2%} of the source is saturated")
        if self.extrapolated:
            stops = f"{self.extrapolated:.2g} stop{'s' * (self.extrapolated != 1.0)}"
            lines.append(f"the ISO is {stops} beyond the noise calibration")
        return "\n".join(lines)

    def __str__(self) -> str:
        return self.explain()


def _short(number: float) -> str:
    """Two significant digits, without an exponent unless it is tiny."""
    return f"{float(f'{number:.2g}'):,.15g}"


def _counted(number: int) -> str:
    for unit, name in ((1e9, "billion"), (1e6, "million")):
        if number >= unit:
            return f"{_short(number / unit)} {name}"
    return str(number)


@functools.cache
def seconds_per_operation() -> float:
    """Time of one of the operations that `SimulationPlan` counts, measured on this machine [s]."""
    light = torch.zeros(4, 128, 128)
    exposure = Exposure(
        1.0, NoiseLevelFunction.zero(), NoiseLevelFunction((1e-4,) * 4, (1e-7,) * 4)
    )
    transition, camera = Transitions.of([light], [exposure]), get_camera("nikon_z6")
    signals, keys, times = torch.empty(1, 4, 128, 128), np.ones(1, np.uint64), []
    for _ in range(5):
        start = time.perf_counter()
        record(transition, camera, keys=keys, signals=signals)
        times.append(time.perf_counter() - start)
    each = sum(_OPERATIONS[name] for name in ("exposure", "noise", "clip_and_quantise"))
    return min(times) / (each * light.numel())


def make_plan(
    settings: CameraSettings,
    exposure: Exposure,
    given: Situation,
    balance: NoiseBalance,
    clipped_source: float,
    depth_error: float,
) -> SimulationPlan:
    """Steps, reasons, predicted error and cost of a capture, or of the light without noise.

    Args:
        settings: Settings to simulate.
        exposure: The exposure that was decided for them.
        given: The numbers that it was decided on.
        balance: The source's noise against the target's.
        clipped_source: See `SimulationPlan`.
        depth_error: Error due to a depth that is not known, in units of the target's noise.
    """
    samples = given.statistics.light.numel()
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
    network = noise_reduction.network
    extrapolated = abs(exposure.target.extrapolation) if given.noise else 0.0
    errors = {
        "left out": math.hypot(*(step.error for step in optional)),
        "network": noise_reduction.residual,
        "clipped highlights": _hidden_highlights(given, clipped_source),
        "unknown depth": depth_error,
        "ISO": EXTRAPOLATION_ERROR * extrapolated,
        "rounding": ROUNDING * given.statistics.relative_level(given.ratio, given.target),
    }
    spread = network.residual.spread if network and network.residual else 1.0
    factors = {**_BOUND, "network": spread * _BOUND["network"]}
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
        network=None if network is None else network.name,
        errors=errors,
        error_bound=math.hypot(
            _LEAST_BOUND, *(factors.get(name, 1.0) * error for name, error in errors.items())
        ),
        excess_noise=balance.relative_excess_variance,
        clipped_source=clipped_source,
        extrapolated=extrapolated,
        network_seconds=float if network is None else network.seconds,
    )


def _hidden_highlights(given: Situation, share: float) -> float:
    """Error of what a `share` of the pixels, saturated in the source, would show when darker.

    Light above white is taken to be distributed as natural highlights are, with a density that
    falls with its square; what is white stands for twice that, its median.
    """
    ratio = given.ratio
    if not share or ratio >= 1.0 or ratio <= 0.0:
        return 0.0
    shown = min(ABOVE_WHITE * ratio, 1.0)
    square = shown**2 * (1.0 - ratio) + 2.0 * shown * ratio * math.log(ratio)
    square += ratio * (1.0 - ratio) + ratio * (1.0 - shown) ** 2
    variance = sum(s * ratio + r for s, r in zip(given.target.shot, given.target.read, strict=True))
    return HIDDEN_LIGHT * math.sqrt(share * square / max(variance / 4.0, 1e-30))


def _planned(step: Step, samples: int) -> PlannedStep:
    reason = step.reason.format(extent=step.extent, error=step.error)
    if not step.runs:
        return PlannedStep(step.name, False, reason, step.error, 0)
    if step.network is not None:
        return PlannedStep(step.name, True, reason, 0.0, step.network.operations)
    per_sample = _OPERATIONS.get(step.name) or 2 * (1 + int(step.extent) ** 2)  # taps of a disc
    return PlannedStep(step.name, True, reason, 0.0, per_sample * samples)
