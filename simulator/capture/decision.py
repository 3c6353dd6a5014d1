"""Exposure of one capture: the steps from a scene's light to the sensor, and why they are taken.

`decide` looks at numbers only. Captures follow the `Exposure` that it returns, and
`simulator.capture.plan.SimulationPlan` shows it.
"""

from __future__ import annotations

import functools
import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from simulator.camera import CameraProfile
from simulator.capture.blurred_frames import Layout
from simulator.capture.statistics import DenoisedLight
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.optics.motion import Path
from simulator.optics.vignetting import Vignetting
from simulator.settings import CameraSettings
from simulator.utils.checks import check_number
from simulator.utils.compute import kernel

if TYPE_CHECKING:
    from simulator.capture.prepared_scene import PreparedScene

#: Error that a capture may have, in units of the target's noise: by default the distribution of a
#: pixel may move by a tenth of its noise's standard deviation.
DEFAULT_TOLERANCE = 0.1
#: Relative error of the noise's standard deviation for each stop of ISO beyond the calibration:
#: without their last ISOs the Z6's table is off by 0.03 to 0.05, the 70D's by 0.17 to 0.25.
EXTRAPOLATION_ERROR = 0.1
#: Signals beyond this many times sensor white are clipped early: they end at white in any case,
#: and an infinite variance times a zero draw would be NaN.
SIGNAL_LIMIT = 1e6
#: Exposure ratios are limited to this: float32 must hold them, and any two settings keep below.
RATIO_LIMIT = 2.0**107
#: Most negative signal that a companded 8-bit code shows; the offset under its square root.
PEDESTAL = 1.0 / 1024.0
#: Discs of defocus may be as wide as the frame, on small frames this wide [pixel]: the memory that
#: a blur takes grows with the square of it.
MAX_DISC_PX = 512.0
#: Second moment of a streak over that of a disc of the same extent, per axis: (1/12) / (1/16).
STREAK_TO_DISC = 4.0 / 3.0


def check_tolerance(tolerance: float) -> float:
    """`tolerance` as a float; a `ValueError` unless it is a finite number >= 0."""
    more = "; ask `simulate` for the full run" if tolerance is None else ""
    return check_number("tolerance", tolerance, 0.0, sys.float_info.max, more=more)


#: A light of a scene: noise-reduced, opened to an effective f-number, or as recorded.
Origin = tuple[DenoisedLight | None, float | None]


@functools.lru_cache(maxsize=4096)
def averaged_nlf(
    camera: CameraProfile, iso: float, exposure_time: float, box_factor: int
) -> NoiseLevelFunction:
    """Noise of `box_factor` squared sensor pixels averaged."""
    return camera.nlf(iso, exposure_time).scaled(1.0 / box_factor**2)


class Step(NamedTuple):
    """A step that a capture may leave out."""

    name: str  # in `SimulationPlan.modules`
    runs: bool
    reason: str  # why it runs, or does not; ``{extent}`` and ``{error}`` stand for the numbers
    #: Error of leaving it out, in units of the target's noise; or a function for it where nothing
    #: is decided by it, and its statistics take time.
    estimate: float | Callable[[], float] = 0.0
    extent: float = 0.0  # of its blur [pixel], where it is one
    residual: float = 0.0  # error that it makes itself where it runs, as far as that is known
    network: DenoisedLight | None = None  # that it runs
    #: Arithmetic operations, all pixels together, in a plan; a network's once for all settings.
    operations: int = 0

    @property
    def error(self) -> float:
        """Error of leaving it out, in units of the target's noise."""
        return self.estimate() if callable(self.estimate) else self.estimate


@dataclass(frozen=True)
class Exposure:
    """Exposure of one capture: ratio, noise and blur, from a scene's light to the sensor."""

    ratio: float  # from the prepared scene's reference to the capture
    source: NoiseLevelFunction  # in the prepared scene at its reference settings
    target: NoiseLevelFunction  # of the camera at the capture's settings
    motion_px: float = 0.0  # how far the image moves while the shutter is open [pixel], at most
    defocus_px: float = 0.0  # diameter of the largest defocus disc [pixel]
    #: What is out of focus and what is the subject; None for one disc everywhere, and where all of
    #: the frame moves together.
    layout: Layout | None = None
    path: Path | None = None  # of the background; None for a streak along the rows
    subject_path: Path | None = None  # of the layout's subject where it moves on its own
    energy: float = 1.0  # share of the source's noise variance that blurs leave
    #: Noise-reduced light that it starts from, `source` is zero then; None for the recorded one.
    denoised: DenoisedLight | None = None
    #: Effective f-number whose wider aperture blurs what the source shows out of focus, if any.
    opened_to: float | None = None
    #: (H, W) contiguous float32 share of the source's noise variance that the blurs leave, beyond
    #: `energy`: of all of them with a layout, else of `opened_to`; None for all.
    remaining_variance: torch.Tensor | None = None
    lens: Vignetting | None = None  # that darkens the frame, see `PreparedScene.lens`
    #: (H, W) float32 share of the light that it leaves; None for all.
    vignetting: np.ndarray | None = field(default=None, compare=False)
    #: Whether a capture is wanted; else the light without noise, in which that of the source cannot
    #: count as part of the target's.
    noise: bool = True
    #: Noise reduction, aperture, defocus, motion blur, vignetting, pixel response, in the order in
    #: which they run; of the last two those that there are.
    steps: tuple[Step, ...] = field(default=(), compare=False)

    @functools.cached_property
    def source_noise(self) -> NoiseLevelFunction:
        """Noise of the source on the sensor: exposed, and averaged by the blur."""
        if self.source.is_zero:
            return self.source
        exposed = self.source.exposed(self.ratio)
        return exposed if self.energy == 1.0 else exposed.scaled(self.energy)

    @property
    def left_out(self) -> float:
        """Error of the steps that are left out, in units of the target's noise."""
        return math.hypot(*(s.error for s in self.steps if s.estimate and not s.runs))

    @property
    def origin(self) -> Origin:
        """The light that it starts from."""
        return self.denoised, self.opened_to


def decide(
    scene: PreparedScene, settings: CameraSettings, *, noise: bool = True, gain: float = 1.0
) -> Exposure:
    """The exposure of a capture; see `PreparedScene.exposure`."""
    time = settings.exposure_time if scene.camera.dark_current else 0.0
    target = averaged_nlf(scene.camera, settings.iso, time, scene.box_factor)
    f_number = settings.effective_f_number
    ratio = 2.0 ** (settings.log2_exposure - scene.reference.log2_exposure)
    ratio = min(scene.gain * gain * ratio, RATIO_LIMIT)
    motion_px, path, subject_path = _motion(scene, settings.exposure_time)
    blur = scene.aperture_blur
    extents = {
        "aperture": 0.0 if blur is None else blur.extent(f_number),
        "defocus": disc_px(scene, f_number) if scene.defocus else 0.0,
        "motion_blur": motion_px,
    }
    opens = bool(extents["aperture"])
    noise_reduction = _decide_noise_reduction(scene, ratio, target, noise=noise, opens=opens)
    denoised = noise_reduction.network
    given = ratio, target, f_number, extents, path is None
    aperture, defocus, motion_blur = blurs = _decide_blurs(scene, noise_reduction, *given)
    defocus_px = defocus.extent if defocus.runs else 0.0
    moves, vignetting = motion_blur.runs, scene.vignetting(f_number)
    subject_path = subject_path if moves else None
    exposure = Exposure(
        ratio=ratio,
        source=scene.nlf if denoised is None else NoiseLevelFunction.zero(),
        target=target,
        motion_px=motion_blur.extent if moves else 0.0,
        defocus_px=defocus_px,
        layout=scene.layout if defocus_px or subject_path is not None else None,
        path=path if moves else None,
        subject_path=subject_path,
        denoised=denoised,
        opened_to=f_number if aperture.runs else None,
        lens=scene.lens,
        vignetting=vignetting,
        noise=noise,
        steps=(noise_reduction, *blurs, *_decide_products(scene, f_number, noise)),
    )
    if exposure.source.is_zero:
        return exposure
    return scene.blurred_light.with_remaining_noise(exposure)


def _motion(scene: PreparedScene, time: float) -> tuple[float, Path | None, Path | None]:
    """How far the image moves at most [pixel], and the paths of the background and of the subject.

    The first path is None for a streak along the rows, the other where the subject does not move on
    its own.
    """
    layout, movement, height = scene.layout, scene.movement, scene.light.shape[-2]
    path = movement.path(scene.image_speed, time, height)
    if layout is not None and layout.subject is not None and movement.subject_speed > 0.0:
        own = movement.subject_path(scene.image_speed, time, height)
        return max(path.extent, own.length), path, own
    return path.extent, None if movement.along_rows else path, None


def disc_px(scene: PreparedScene, f_number: float) -> float:
    """Diameter of the defocus disc at `f_number` [pixel]."""
    diameter = scene.defocus * 4.0 / f_number
    most = max(*scene.light.shape[-2:], MAX_DISC_PX)
    if diameter > most:
        raise ValueError(
            f"`defocus` (={scene.defocus!r} pixel at f/4) makes a disc of {diameter:.4g} pixel at "
            f"f/{f_number:.3g}: it must be at most {most:g} pixel, as wide as the frame "
            f"({MAX_DISC_PX:g} on smaller ones)"
        )
    return diameter


def _decide_noise_reduction(
    scene: PreparedScene, ratio: float, target: NoiseLevelFunction, *, noise: bool, opens: bool
) -> Step:
    """The cheapest of all ways within the tolerance, or else the one with the least error."""
    name, blur = "noise_reduction", scene.aperture_blur
    if scene.nlf.is_zero:
        return Step(name, False, "the source carries no noise")
    statistics, residuals = scene.blurred_light.statistics, scene.blurred_light.residuals
    error_of = statistics.excess_error if noise else statistics.relative_noise
    networks = scene.denoised_lights
    if not networks:
        estimate = functools.partial(error_of, ratio, scene.nlf, target)
        return Step(name, False, "the simulator has no noise module", estimate)
    error = error_of(ratio, scene.nlf, target)

    def own_error(network: DenoisedLight) -> float:  # 0 where it was not measured
        found = network.residual
        return 0.0 if found is None else residuals.error(found, ratio, target, noise=noise)

    if blur is not None and blur.needs_denoised and opens:
        # Blur averages noise, too: not counted on.
        reason = "the aperture module works on the noise-reduced light only" + _WITHOUT
        network = networks[-1]
        return Step(name, True, reason, error, 0.0, own_error(network), network)
    if error <= scene.tolerance:
        reason = "the source's noise beyond the target's is within the tolerance"
        if not noise:
            reason = "the source's noise is small against the target's"
        elif error == 0.0:
            reason = "the target is at least as noisy: noise is added up to it"
        return Step(name, False, reason, error)
    best, least = networks[0], math.inf
    for network in networks:
        residual = own_error(network)
        if residual < least:
            best, least = network, residual
        if residual <= scene.tolerance:
            break
    if error <= least:
        return Step(name, False, "no network would make a smaller error than the noise", error)
    reason = "the source is noisier than the target"
    if not noise:
        reason = "the light is wanted without noise"
    return Step(name, True, reason + _WITHOUT, error, 0.0, least, best)


def _decide_blurs(
    scene: PreparedScene,
    noise_reduction: Step,
    ratio: float,
    target: NoiseLevelFunction,
    f_number: float,
    extents: dict[str, float],
    along_rows: bool,
) -> list[Step]:
    """Aperture, defocus and motion blur of `extents` [pixel], inf where that is not known.

    Noise that stays widens a pixel's distribution, blur that is missing shifts it: squares add.
    Several missing blurs shift it the same way and add up; the error of each is what it adds to the
    square, so that the root of the sum of squares of all errors is right for any set of steps.
    """
    blur = scene.aperture_blur
    known = 0 if blur is None else 1 + (f_number < blur.f_number)  # see `_NO_BLUR_REASONS`
    if not any(extents.values()):
        return [Step(name, False, _NO_BLUR_REASONS[name][known]) for name in extents]
    missing_noise = 0.0
    if scene.denoised_lights:
        missing_noise = noise_reduction.residual if noise_reduction.runs else noise_reduction.error
    if missing_noise > scene.tolerance:  # no network can mend it: blur has it all to itself
        missing_noise = 0.0
    disc = row = math.inf  # at a tolerance of 0 no blur is left out, however small
    decides = extents["defocus"] or extents["motion_blur"] or extents["aperture"] != math.inf
    if scene.tolerance > 0.0 and decides:  # else the network need not run for it
        network = noise_reduction.network
        light = scene.blurred_light.statistics if network is None else network.statistics
        disc, row = light.curvature(ratio, target)
        # No second difference exceeds the Laplacian, in the root mean square: (k u)^4 <= |k|^4.
        row = row if along_rows else STREAK_TO_DISC * disc
    values, errors, runs = np.array([*extents.values()]), np.empty(3), np.empty(3, bool)
    weigh_blurs(values, disc, row, missing_noise, scene.tolerance, errors, runs)
    blurs = []
    for i, (name, extent) in enumerate(extents.items()):
        if not extent:
            blurs.append(Step(name, False, _NO_BLUR_REASONS[name][known]))
            continue
        reason, added = "the aperture opens and adds blur", float(errors[i])
        if extent < math.inf:
            reason = _BLUR_REASONS[name][not runs[i]]
        if runs[i] and added < math.inf:
            reason += _WITHOUT
        blurs.append(Step(name, bool(runs[i]), reason, added, extent))
    return blurs


@kernel()
def weigh_blurs(  # type: ignore[no-untyped-def]
    extents, disc, row, missing_noise, tolerance, errors, runs
):
    """Which of aperture, defocus and motion blur run, and the error of leaving each out, (3,) each.

    `extents` (3,) are in pixels, inf where it is not known; `disc` and `row` are the
    `LightStatistics.curvature` of the light; `missing_noise` cannot be mended, and counts as well.
    """
    missing_blur = 0.0
    for i in range(3):
        errors[i], runs[i], extent = 0.0, False, extents[i]
        if extent == 0.0:
            continue
        error = math.inf
        if extent < math.inf:
            error = (row if i == 2 else disc) * extent * extent
        together = missing_blur + error
        runs[i] = not math.hypot(missing_noise, together) <= tolerance
        if error:
            errors[i] = math.sqrt(error * (together + missing_blur))
        if not runs[i]:
            missing_blur = together


def _decide_products(scene: PreparedScene, f_number: float, noise: bool) -> Iterator[Step]:
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
            reason = "only the light is wanted"
        elif not scene.nlf.is_zero:
            reason = "the source has the pattern of its own sensor"
        yield Step("pixel_response", noise and scene.nlf.is_zero, reason)


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
