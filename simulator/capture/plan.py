"""The plan of a capture: which steps run, why the others do not, its error and its cost."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numba
import numpy as np
import torch

from simulator.camera import get_camera
from simulator.capture.decision import EXTRAPOLATION_ERROR, SIGNAL_LIMIT, Exposure, Step
from simulator.capture.sensor import Transitions, exposure_table, record
from simulator.capture.statistics import ROUNDING, SUMS, hidden_highlights, noise_numbers
from simulator.noise.noise_level_function import VARIANCE_LIMIT, NoiseLevelFunction
from simulator.settings import CameraSettings
from simulator.utils.compute import addresses, as_pointer, kernel, parallel_ranges

if TYPE_CHECKING:
    from simulator.capture.prepared_scene import PreparedScene

#: Factor on the predicted error below which 90 % of the measured ones are, by its largest part:
#: conformal prediction on maps of 44 places that no network was trained on, of unknown depth on
#: scenes that have it (`ae-env bench work-precision`). The network's comes on top of its own
#: `spread`; no case was led by the ISO: that of cameras without their last ISOs.
_BOUND = {
    "left out": 1.16,
    "network": 1.01,
    "clipped highlights": 1.42,
    "unknown depth": 1.03,
    "ISO": 2.5,
    "rounding": 0.55,
}
#: Error that is always added to the predicted one for it: single noisy samples that were clipped or
#: rounded in the source.
_LEAST_BOUND = 0.05
#: Arithmetic operations per sample of the steps whose cost does not depend on anything.
_OPERATIONS = {
    "exposure": 2,
    "aperture": 4,
    "motion_blur": 6,
    "vignetting": 1,
    "pixel_response": 1,
    "noise": 14,
    "clip_and_quantise": 6,
}
#: Errors of the estimated map of defocus: its relative error of the blur that it adds, the blur
#: that it cannot see [pixel of diameter], and the factor by which what a blurred picture changes
#: when it is blurred again understates what it would change if it were sharpened.
DEPTH_ERROR, MISSED_BLUR, KEPT_BLUR_ERROR = 0.6, 0.7, 3.0
_TINY = torch.finfo(torch.float32).tiny
#: Samples that are worth a thread where noise is balanced.
_BALANCED = 2**15


@dataclass(frozen=True)
class SimulationPlan:
    """Steps of a change of settings, with their cost in error and in work.

    Errors are distances between the distributions of a pixel, as they are and as a camera's would
    be, over the noise of the source and of the capture: root mean square over the pixels of
    ``sqrt(dm^2 + ds^2) / s``, where the mean moves by dm, the standard deviation by ds, and s is
    the standard deviation that the target's noise should have.
    """

    settings: CameraSettings  #: to simulate
    exposure: Exposure  #: the exposure that was decided for them
    #: The parts of the error by what they come from; ``"left out"``, ``"network"``, ``"clipped
    #: highlights"``, ``"unknown depth"``, ``"ISO"``, ``"rounding"``.
    errors: Mapping[str, float]
    #: Variance of the source's noise beyond the target's, relative to the target's: mean over the
    #: pixels. 0 means that the noise is exact.
    excess_noise: float
    lacks_noise: bool  #: whether any pixel has less noise than the target
    #: Share of the pixels that are saturated in the source: what they would show at a darker
    #: exposure is unknown.
    clipped_source: float
    tolerance: float  #: error that the capture may have
    samples: int  #: of the raw

    @functools.cached_property
    def steps(self) -> tuple[Step, ...]:
        """Every step in order, with the reason why it runs or not."""
        wanted, lacks = self.exposure.noise, self.lacks_noise
        unwanted = "" if wanted else "only the light is wanted"
        enough = "no pixel lacks noise: the source has the target's already, or more"
        steps = (
            Step("exposure", True, ""),
            *self.exposure.steps,
            Step("noise", wanted and lacks, unwanted or ("" if lacks else enough)),
            Step("clip_and_quantise", wanted, unwanted),
        )
        return tuple(_planned(step, self.samples) for step in steps)

    @property
    def network(self) -> str | None:
        """Name of the noise module that runs; None for none."""
        denoised = self.exposure.denoised
        return None if denoised is None else denoised.name

    @property
    def extrapolated(self) -> float:
        """Stops by which the target's ISO lies outside the camera's calibration."""
        return abs(self.exposure.target.extrapolation) if self.exposure.noise else 0.0

    @property
    def error_bound(self) -> float:
        """Bound below which the error is in 90 % of all cases, whatever its largest part."""
        leading, denoised = max(self.errors, key=self.errors.__getitem__), self.exposure.denoised
        factor = _BOUND[leading]
        if leading == "network" and denoised is not None and denoised.residual is not None:
            factor *= denoised.residual.spread
        predicted = self.predicted_error
        return max(predicted, factor * math.hypot(_LEAST_BOUND, predicted))

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
        denoised = self.exposure.denoised
        shared = 0.0 if denoised is None else denoised.seconds()
        return 1e3 * own * seconds_per_operation(), 1e3 * shared

    def explain(self) -> str:
        """The plan in three lines: the steps that run, the error, the cost."""
        named = {"noise_reduction": f"noise_reduction ({self.network})"}
        runs = " -> ".join(named.get(name, name) for name in self.modules)
        parts = [f"{name} {_short(error)}" for name, error in self.errors.items() if error >= 0.005]
        avoidable = math.hypot(self.errors["left out"], self.errors["network"])
        within = "kept"
        if avoidable > self.tolerance:
            within = "out of reach, the least of these networks"
        elif self.predicted_error > self.tolerance + 0.005:
            within = "kept, except for errors that no module can fix"
        capture, shared = self.milliseconds
        once = f" and {_short(shared)} ms once for all settings" if shared else ""
        return (
            f"{self.settings}: {self.exposure.ratio:.4g} x the light; {runs}\n"
            f"error {_short(self.predicted_error)} of the target's noise, 90 % bound "
            f"{_short(self.error_bound)}{': ' * bool(parts)}{', '.join(parts)} "
            f"(tolerance {self.tolerance:g}: {within})\n"
            f"cost {_counted(self.operations)} operations, about {_short(max(capture, 0.01))} ms a "
            f"capture{once}"
        )

    def details(self) -> str:
        """Why each step runs or does not, and what cannot be made exact."""
        lines = []
        for step in self.steps:
            if step.reason:
                error = f" (error {_short(step.error)})" if step.error else ""
                verb = "runs" if step.runs else "left out"
                lines.append(f"{verb} {step.name}: {step.reason}{error}")
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
    noises = NoiseLevelFunction.zero(), NoiseLevelFunction((1e-4,) * 4, (1e-7,) * 4)
    exposure = Exposure(1.0, *noises)
    transition, camera = Transitions.of([light], [exposure]), get_camera("nikon_z6")
    signals, keys, times = torch.empty(1, 4, 128, 128), np.ones(1, np.uint64), []
    for _ in range(5):
        start = time.perf_counter()
        record(transition, camera, keys=keys, signals=signals)
        times.append(time.perf_counter() - start)
    each = sum(_OPERATIONS[name] for name in ("exposure", "noise", "clip_and_quantise"))
    return min(times) / (each * light.numel())


def _planned(step: Step, samples: int) -> Step:
    """`step` as a plan shows it; what runs leaves no error."""
    reason = step.reason.format(extent=step.extent, error=step.error)
    if not step.runs:
        return step._replace(reason=reason)
    per_sample = _OPERATIONS.get(step.name) or 2 * (1 + int(step.extent) ** 2)  # taps of a disc
    operations = per_sample * samples if step.network is None else step.network.operations
    return step._replace(reason=reason, estimate=0.0, operations=operations)


def predict_errors(
    scene: PreparedScene, settings: CameraSettings, exposure: Exposure
) -> dict[str, float]:
    """`SimulationPlan.errors` of the exposure that was decided for `settings`."""
    ratio, target = exposure.ratio, exposure.target
    extrapolated = abs(target.extrapolation) if exposure.noise else 0.0
    rounding = ROUNDING * scene.statistics.relative_level(ratio, target)
    if exposure.denoised is not None and exposure.denoised.rounding is not None:
        error_of, bfloat16 = scene.blurred_light.residuals.error, exposure.denoised.rounding
        rounding = math.hypot(rounding, error_of(bfloat16, ratio, target, noise=exposure.noise))
    return {
        "left out": exposure.left_out,
        "network": exposure.steps[0].residual,
        "clipped highlights": hidden_highlights(ratio, noise_numbers(target), *scene.clipped_light),
        "unknown depth": _depth_error(scene, settings, exposure),
        "ISO": EXTRAPOLATION_ERROR * extrapolated,
        "rounding": rounding,
    }


def _depth_error(scene: PreparedScene, settings: CameraSettings, exposure: Exposure) -> float:
    """Error due to a depth that is not known, in units of the target's noise."""
    blur, noise, ratio = scene.aperture_blur, exposure.noise, exposure.ratio
    if blur is None or settings.effective_f_number == blur.f_number:  # no map is needed
        return 0.0
    disc = scene.statistics.blur_change(ratio, scene.nlf, exposure.target, noise=noise)
    wide, mean_square = blur.f_number / settings.effective_f_number, blur.mean_square_diameter
    error = map_error(disc, wide, mean_square)
    if exposure.opened_to is None:
        return error
    light = scene.light if exposure.denoised is None else exposure.denoised.light
    lights = [light], [scene.blurred_light.source(exposure.origin)]
    targets = noise_numbers(exposure.target)[None]
    return math.hypot(error, *opening_errors(*lights, np.array([ratio]), targets, noise))


@kernel()
def map_error(disc, wide, mean_square):  # type: ignore[no-untyped-def]
    """Error of a map of defocus where the aperture is so many times as `wide` as the source's.

    `disc` is `LightStatistics.blur_change`; the `mean_square` of the map's diameters counts at
    smaller apertures only: what they would sharpen stays blurred.
    """
    if wide <= 1.0:
        return KEPT_BLUR_ERROR * disc * mean_square * (1.0 - wide * wide)
    return disc * MISSED_BLUR**2 * (wide * wide - 1.0)


def opening_errors(
    lights: Sequence[torch.Tensor],
    opened: Sequence[torch.Tensor],
    ratios: np.ndarray,
    targets: np.ndarray,
    noise: bool,
) -> np.ndarray:
    """(B,) errors of what opening the aperture adds to lights (4, H, W), as far as maps are wrong.

    `ratios` (B,) and `targets` (B, 2, 4) are of the captures. Where `noise` is wanted, white is
    white in them.
    """
    white = 1.0 if noise else math.inf
    squares = _sums(_add_changes, lights, opened, ratios, targets, white)[:, 0]
    return DEPTH_ERROR * np.sqrt(squares / lights[0].numel())


def noise_balance(light: torch.Tensor, exposure: Exposure) -> tuple[float, bool]:
    """`SimulationPlan.excess_noise` and `lacks_noise` of `light` (4, H, W) in an `exposure`.

    Neither the ratio of the exposure nor its noise are in `light` yet.
    """
    target = exposure.target
    if exposure.source_noise.is_zero:
        return 0.0, not target.is_zero
    shares, table = [exposure.remaining_variance], exposure_table([exposure])
    excess, lacks = noise_balances([light], shares, table, noise_numbers(target)[None])
    return excess.item(), lacks.item()


def noise_balances(
    lights: Sequence[torch.Tensor],
    shares: Sequence[torch.Tensor | None],
    table: np.ndarray,
    targets: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """`noise_balance` (B,) each of lights (4, H, W).

    `shares` are their `Exposure.remaining_variance`, `table` that of the exposures, `targets`
    (B, 2, 4) shot and read noise.
    """
    excess, lacks = _sums(_balance, lights, shares, table, targets).T
    return np.minimum(excess / lights[0].numel(), VARIANCE_LIMIT), lacks > 0.0


def _sums(task: Any, lights: Sequence[Any], others: Sequence[Any], *fixed: Any) -> np.ndarray:
    """(B, 2) sums over the planes of frames, of what `task` finds for each of these."""
    pairs: list[Any] = [lights, others]
    for i, some in enumerate(pairs):
        if not hasattr(some, "addresses"):
            on_cpu = (None if x is None else x.float().cpu().contiguous() for x in some)
            pairs[i] = [*on_cpu]
    samples, found = lights[0][0].numel(), np.zeros((4 * len(lights), 2))
    whole = *map(addresses, pairs), *fixed, samples, found
    least = max(1, _BALANCED // samples)
    parallel_ranges(lambda a, b: task(a, b, *whole), len(found), least=least)
    return found.reshape(-1, 4, 2).sum(axis=1)


@kernel()
def _plane(address, plane, samples):  # type: ignore[no-untyped-def]
    """A plane of the frame (4, samples) at an address."""
    frame = numba.carray(as_pointer(address), (4 * samples,))  # type: ignore[attr-defined, call-arg]
    return frame[plane * samples : (plane + 1) * samples]


@kernel(fastmath=SUMS)
def _add_changes(first, last, lights, opened, ratios, targets, white, samples, found):  # type: ignore[no-untyped-def]
    """Sums of the squared changes of planes `first` to `last`, in units of the target's noise."""
    for unit in range(first, last):
        frame, plane = unit // 4, unit % 4
        ratio, shot, read = ratios[frame], targets[frame, 0, plane], targets[frame, 1, plane]
        before, after = _plane(lights[frame], plane, samples), _plane(opened[frame], plane, samples)
        total = 0.0
        for i in range(samples):
            sharp = min(before[i] * ratio, white)
            change = min(after[i] * ratio, white) - sharp
            total += change * change / max(read + shot * max(sharp, 0.0), 1e-30)
        found[unit, 0] = total


@kernel(fastmath=SUMS)
def _balance(first, last, lights, shares, table, targets, samples, found):  # type: ignore[no-untyped-def]
    """Sums of the relative excess of planes `first` to `last`, and whether any pixel lacks noise.

    Over no noise the excess is large, but finite.
    """
    for unit in range(first, last):
        frame, plane = unit // 4, unit % 4
        ratio, shot, read, source_shot, source_read = table[frame, :, plane]
        total, lacks = 0.0, shot >= 0.0 and read > 0.0  # at every pixel, whatever its light
        light, target = _plane(lights[frame], plane, samples), targets[frame, :, plane]
        size = samples if shares[frame] else 0
        left = numba.carray(as_pointer(shares[frame]), (size,))  # type: ignore[attr-defined, call-arg]
        for i in range(0 if lacks else samples):
            signal = min(max(light[i] * ratio, 0.0), SIGNAL_LIMIT)
            missing = signal * shot + read
            if size:
                missing += (1.0 - left[i]) * (signal * source_shot + source_read)
            lacks |= missing > 0.0
            total += max(-missing, 0.0) / max(signal * target[0] + target[1], _TINY)
        found[unit, 0], found[unit, 1] = total, lacks
