"""The plan of a capture: which steps run, why the others do not, its error and its cost."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numba
import numpy as np
import torch

from simulator.camera import get_camera
from simulator.capture.columns import ERRORS, STEPS, Planned, noise_columns, plan_captures
from simulator.capture.limits import SIGNAL_LIMIT
from simulator.capture.sensor import Transitions, record
from simulator.capture.statistics import SUMS, DenoisedLight, network_error
from simulator.noise.noise_level_function import VARIANCE_LIMIT
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
#: Relative error of an estimated map of defocus in the blur that it adds.
DEPTH_ERROR = 0.6
_TINY = torch.finfo(torch.float32).tiny
#: Samples that are worth a thread where noise is balanced.
_BALANCED = 2**15
_NOT_WANTED, _LIGHT_WANTED = "only the light is wanted", "the light is wanted without noise"
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
#: Reasons why there is no blur: where no pixel's defocus was estimated; and where it was, as the
#: aperture does not open, and as it does.
_NO_BLUR_REASONS = {
    "aperture": (
        "the scene is taken as in focus: `depth` is not 'unknown'",
        "the aperture does not open; what is blurred in the source stays so",
        "the picture was found to be in focus throughout",
    ),
    "defocus": (
        "the scene is taken as far or in focus throughout",
        *["none is given for the whole frame: each pixel's was estimated"] * 2,
    ),
    "motion_blur": ("the image does not move",) * 3,
}


class Step(NamedTuple):
    """A step that a capture may leave out."""

    name: str  # in `SimulationPlan.modules`
    runs: bool
    reason: str  # why it runs, or does not
    #: Error of leaving it out where it does not run, in units of the target's noise.
    error: float = 0.0
    operations: int = 0  # arithmetic operations, all pixels together; a network's for all settings


@dataclass(frozen=True)
class SimulationPlan:
    """Steps of a change of settings, with their cost in error and in work.

    Errors are distances between the distributions of a pixel, as they are and as a camera's would
    be, over the noise of the source and of the capture: root mean square over the pixels of
    ``sqrt(dm^2 + ds^2) / s``, where the mean moves by dm, the standard deviation by ds, and s is
    the standard deviation that the target's noise should have.
    """

    settings: CameraSettings  #: to simulate
    ratio: float  #: of the exposure, from the prepared scene's reference to the capture
    steps: tuple[Step, ...]  #: all in the order in which they run, with the reason for each
    denoised: DenoisedLight | None  #: noise-reduced light that it starts from
    #: The parts of the error by what they come from; ``"left out"``, ``"network"``, ``"clipped
    #: highlights"``, ``"unknown depth"``, ``"ISO"``, ``"rounding"``.
    errors: Mapping[str, float]
    #: Variance of the source's noise beyond the target's, relative to the target's: mean over the
    #: pixels. 0 means that the noise is exact.
    excess_noise: float
    #: Share of the pixels that are saturated in the source: what they would show at a darker
    #: exposure is unknown.
    clipped_source: float
    tolerance: float  #: error that the capture may have
    extrapolated: float  #: stops by which the ISO is outside the noise calibration of the camera

    @property
    def network(self) -> str | None:
        """Name of the noise module that runs; None for none."""
        return None if self.denoised is None else self.denoised.name

    @property
    def error_bound(self) -> float:
        """Bound below which the error is in 90 % of all cases, whatever its largest part."""
        leading, denoised = max(self.errors, key=self.errors.__getitem__), self.denoised
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
        shared = 0.0 if self.denoised is None else self.denoised.seconds()
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
            f"{self.settings}: {self.ratio:.4g} x the light; {runs}\n"
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

    __str__ = explain


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
    light, table = torch.zeros(4, 128, 128), np.zeros((1, 5, 4), np.float32)
    table[0, :3] = [[1.0], [1e-4], [1e-7]]
    transition, camera = Transitions([light], table), get_camera("nikon_z6")
    signals, keys, times = torch.empty(1, 4, 128, 128), np.ones(1, np.uint64), []
    for _ in range(5):
        start = time.perf_counter()
        record(transition, camera, keys=keys, signals=signals)
        times.append(time.perf_counter() - start)
    each = sum(_OPERATIONS[name] for name in ("exposure", "noise", "clip_and_quantise"))
    return min(times) / (each * light.numel())


def plan_capture(
    scene: PreparedScene, settings: CameraSettings, *, noise: bool = True
) -> SimulationPlan:
    """The plan of a capture of a scene at `settings`, or of its light without `noise`."""
    planned = plan_captures(scene, [settings], noise=noise, errors=True)
    targets = noise_columns(scene.camera, [settings], scene.box_factor)
    excess, lacks = 0.0, bool(targets.any())
    if planned.table[0, 3:].any():  # else the light need not be made to see that
        lights = [scene.blurred_light.source(planned.origins[0])]
        balance = noise_balances(lights, planned.shares, planned.table, targets)
        excess, lacks = balance[0].item(), balance[1].item()
    denoised, samples = planned.origins[0][0], scene.light.numel()
    operations = {name: each * samples for name, each in _OPERATIONS.items()}
    operations["defocus"] = 2 * (1 + int(planned.blurs["defocus_px"].item()) ** 2) * samples
    operations["noise_reduction"] = 0 if denoised is None else denoised.operations
    unwanted = "" if noise else _NOT_WANTED
    enough = "" if lacks else "no pixel lacks noise: the source has the target's already, or more"
    steps = [
        Step("exposure", True, ""),
        *_blurs_and_noise(scene, settings.effective_f_number, planned, noise),
        *_products(scene, settings.effective_f_number, noise),
        Step("noise", noise and lacks, unwanted or enough),
        Step("clip_and_quantise", noise, unwanted),
    ]
    steps = [s._replace(operations=operations[s.name]) if s.runs else s for s in steps]
    (nlf,) = scene.camera.nlfs([settings])
    return SimulationPlan(
        settings=settings,
        ratio=planned.table[0, 0, 0].item(),
        steps=tuple(steps),
        denoised=denoised,
        errors={"left out": math.hypot(*(step.error for step in steps))}
        | _predict_errors(scene, planned, targets, noise),
        excess_noise=excess,
        clipped_source=scene.saturated_share,
        tolerance=scene.tolerance,
        extrapolated=abs(nlf.extrapolation) if noise else 0.0,
    )


def _blurs_and_noise(
    scene: PreparedScene, f_number: float, planned: Planned, noise: bool
) -> Iterator[Step]:
    """The steps that `plan_frames` decides on."""
    ((denoised, opened_to),), (blur,), (found,) = planned.origins, planned.blurs, planned.details
    opens = blur["defocus_px"] > 0.0, blur["motion_px"] > 0.0
    runs = denoised is not None, opened_to is not None, *map(bool, opens)
    extents, source = found[len(ERRORS) :].tolist(), scene.aperture_blur
    reasons = [_reason_of_noise(scene, runs[0], found[0], extents[0] > 0.0, noise)]
    known = 0 if source is None else 1 + (f_number < source.f_number)
    for name, ran, extent in zip(STEPS[1:], runs[1:], extents, strict=False):
        if not extent:
            reasons.append(_NO_BLUR_REASONS[name][known])
        elif extent == math.inf:  # not known before the network runs
            reasons.append("the aperture opens and adds blur")
        else:
            reasons.append(_BLUR_REASONS[name][not ran].format(extent=extent))
    for name, ran, reason, error in zip(STEPS, runs, reasons, found.tolist(), strict=False):
        without = f"; leaving it out would be an error of {error:.2g}"
        reason += without * (ran and error < math.inf)
        yield Step(name, ran, reason, 0.0 if ran else error)


def _reason_of_noise(
    scene: PreparedScene, runs: bool, error: float, opens: bool, noise: bool
) -> str:
    """Why noise reduction runs, or does not; leaving it out makes an `error`."""
    blur = scene.aperture_blur
    if scene.nlf.is_zero:
        return "the source carries no noise"
    if not scene.denoised_lights:
        return "the simulator has no noise module"
    if runs and blur is not None and blur.needs_denoised and opens:
        return "the aperture module works on the noise-reduced light only"
    if runs:
        return "the source is noisier than the target" if noise else _LIGHT_WANTED
    if error > scene.tolerance:
        return "no network would make a smaller error than the noise"
    if not noise:
        return "the source's noise is small against the target's"
    if error == 0.0:
        return "the target is at least as noisy: noise is added up to it"
    return "the source's noise beyond the target's is within the tolerance"


def _products(scene: PreparedScene, f_number: float, noise: bool) -> Iterator[Step]:
    """Vignetting and pixel response, where there are any: too cheap to weigh their errors."""
    lens, prnu = scene.lens, scene.camera.prnu
    if lens is not None:
        reason, runs = "the source was taken through the same aperture", False
        if scene.vignetting(f_number) is not None:
            loss, runs = lens.corner_loss(f_number), True
            reason = f"the lens takes {loss:.2g} EV of the corners' light"
            if scene.seen_through_lens:
                source = lens.corner_loss(scene.reference.effective_f_number)
                reason += f", {source:.2g} in the source"
        yield Step("vignetting", runs, reason)
    if prnu:
        reason = f"the gains of photosites differ by {prnu:.2%}"
        if not noise:
            reason = _NOT_WANTED
        elif not scene.nlf.is_zero:
            reason = "the source has the pattern of its own sensor"
        yield Step("pixel_response", noise and scene.nlf.is_zero, reason)


def _predict_errors(
    scene: PreparedScene, planned: Planned, targets: np.ndarray, noise: bool
) -> dict[str, float]:
    """The `SimulationPlan.errors` of what runs, and of what is not known."""
    errors = dict(zip(ERRORS[4:], planned.details[0, 4:].tolist(), strict=False))
    (denoised, opened_to), ratios = planned.origins[0], planned.table[:, 0, 0].astype(float)
    if opened_to is not None:
        before = scene.light if denoised is None else denoised.light
        lights = [before], [scene.blurred_light.source(planned.origins[0])]
        opening = opening_errors(*lights, ratios, targets, noise).item()
        errors["unknown depth"] = math.hypot(errors["unknown depth"], opening)
    if denoised is not None and denoised.rounding is not None:
        columns = scene.blurred_light.residuals.columns(denoised.rounding)
        source = np.array([scene.nlf.shot, scene.nlf.read])
        bfloat16 = network_error(*columns, ratios.item(), source, targets[0], noise)
        errors["rounding"] = math.hypot(errors["rounding"], bfloat16)
    return errors


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


def noise_balances(
    lights: Sequence[torch.Tensor],
    shares: Sequence[torch.Tensor | None],
    table: np.ndarray,
    targets: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Excess variance (B,) of lights (4, H, W), and whether any pixel lacks noise.

    See `SimulationPlan.excess_noise`. `shares` are `Transitions.remaining_variance`, `table` is
    `Transitions.table`, `targets` (B, 2, 4) are shot and read noise. Lights are not exposed yet.
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
