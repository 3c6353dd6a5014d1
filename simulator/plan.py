"""What a change of settings takes, why the rest is left out, and what it costs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from simulator.capture import SIGNAL_LIMIT, Exposure
from simulator.noise import noise_variance, top_up_variance
from simulator.settings import CameraSettings

if TYPE_CHECKING:
    from simulator.latent import Latent

#: Blur below this extent [pixel] changes nothing that a digital number could show.
NEGLIGIBLE_BLUR = 1e-3
_EXPOSE_OPERATIONS = 2
_NOISE_OPERATIONS = 14
_CLIP_OPERATIONS = 6
_STREAK_OPERATIONS = 6
_GATHER_OPERATIONS = 4


@dataclass(frozen=True)
class SimulationPlan:
    """What a change of settings takes, and what it will cost in error and in work.

    Args:
        settings: Settings to simulate.
        exposure_ratio: How much brighter than the source the result is.
        modules: Steps that run, in order.
        left_out: Every other step and the reason why this scene does not need it.
        excess_noise: Variance that the source brings beyond the target's, relative to the target's,
            mean over the pixels. 0 means that the noise is exact.
        clipped_source: Share of the pixels that are saturated in the source: what they would show
            at a darker exposure is unknown.
        extrapolated_noise: Whether the target's ISO lies outside the camera's calibration.
        predicted_rmse: Root mean square of the excess noise, 1 is sensor white.
        operations: Arithmetic operations that the steps need, all pixels together; what
            `CameraSimulator.prepare` does once per scene, such as denoising, is not counted.
    """

    settings: CameraSettings
    exposure_ratio: float
    modules: tuple[str, ...]
    left_out: Mapping[str, str]
    excess_noise: float
    clipped_source: float
    extrapolated_noise: bool
    predicted_rmse: float
    operations: int

    def __str__(self) -> str:
        lines = [
            f"{self.settings}: {self.exposure_ratio:.4g} x the light of the source",
            f"  runs      {' -> '.join(self.modules)}",
        ]
        lines += [f"  left out  {name}: {reason}" for name, reason in self.left_out.items()]
        if "noise_reduction" in self.modules or "aperture" in self.modules:
            lines.append(
                "  networks  ran once for all settings; their error: docs/results/simulator.md"
            )
        lines.append(
            f"  error     noise variance {self.excess_noise:.1%} above the target's "
            f"(RMSE {self.predicted_rmse:.2e} of white); "
            f"{self.clipped_source:.2%} of the source is saturated"
        )
        if self.extrapolated_noise:
            lines.append("  warning   the ISO is outside the camera's noise calibration")
        lines.append(f"  cost      {self.operations / 1e6:.1f} million operations")
        return "\n".join(lines)


def make_plan(latent: Latent, settings: CameraSettings) -> SimulationPlan:
    """Steps, reasons, predicted error and cost of a capture of `latent` at `settings`."""
    exposure = latent.exposure(settings)
    light = latent.source_light(exposure)
    signal = (light * exposure.ratio).clamp_(-SIGNAL_LIMIT, SIGNAL_LIMIT)
    missing, excess = top_up_variance(
        signal, exposure.source_noise, exposure.target, exposure.remaining
    )
    wanted = noise_variance(signal, exposure.target).clamp_(min=torch.finfo(torch.float32).tiny)
    steps = _steps(latent, settings, exposure, signal.numel(), bool((missing > 0).any()))
    return SimulationPlan(
        settings=settings,
        exposure_ratio=exposure.ratio,
        modules=tuple(name for name, (cost, _) in steps.items() if cost),
        left_out={name: reason for name, (cost, reason) in steps.items() if not cost},
        excess_noise=float((excess / wanted).mean(dtype=torch.float64)),
        clipped_source=0.0
        if latent.saturated is None
        else float(latent.saturated.float().mean(dtype=torch.float64)),
        extrapolated_noise=exposure.target.extrapolated,
        predicted_rmse=float(excess.mean(dtype=torch.float64)) ** 0.5,
        operations=sum(cost for cost, _ in steps.values()),
    )


def _steps(
    latent: Latent, settings: CameraSettings, exposure: Exposure, pixels: int, lacks_noise: bool
) -> dict[str, tuple[int, str]]:
    """Operations of every step, and the reason why it is left out where they are 0."""
    taps = 1 + int(exposure.defocus_px) ** 2
    return {
        "exposure": (_EXPOSE_OPERATIONS * pixels, ""),
        "noise_reduction": (pixels * exposure.denoised, _why_not_denoised(latent)),
        "aperture": (
            _GATHER_OPERATIONS * pixels * (exposure.opened_to is not None),
            _why_not_opened(latent, settings),
        ),
        "defocus": (
            taps * 2 * pixels * (exposure.defocus_px > 0),
            _why_not_defocused(latent),
        ),
        "motion_blur": (
            _STREAK_OPERATIONS * pixels * (exposure.motion_px > 0),
            "the image does not move"
            if latent.image_speed == 0
            else f"the image moves less than {NEGLIGIBLE_BLUR} pixel during the exposure",
        ),
        "noise": (
            _NOISE_OPERATIONS * pixels * lacks_noise,
            "no pixel lacks noise: the source has the target's already, or more",
        ),
        "clip_and_quantise": (_CLIP_OPERATIONS * pixels, ""),
    }


def _why_not_denoised(latent: Latent) -> str:
    if latent.nlf.is_zero:
        return "the source carries no noise"
    if latent.denoised is None:
        return "the simulator has no noise module"
    if not latent.is_noisy:
        return "the source has so little noise that the network would err as much"
    return "the target is at least as noisy: noise is added up to it"


def _why_not_defocused(latent: Latent) -> str:
    if latent.defocus:
        return f"the defocus disc is below {NEGLIGIBLE_BLUR} pixel"
    if latent.opening is not None:
        return "none is given for the whole frame: each pixel's was estimated"
    return "the scene is taken as far or in focus throughout"


def _why_not_opened(latent: Latent, settings: CameraSettings) -> str:
    if latent.opening is None:
        return "no defocus was estimated: `depth` is not 'unknown'"
    if settings.effective_f_number >= latent.opening.f_number:
        return "the aperture does not open; what is blurred in the source stays so"
    return "the picture was found to be in focus throughout"
