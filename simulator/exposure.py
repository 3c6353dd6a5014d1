"""What one capture does to the light of a scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import torch

from simulator.blur_shapes import kernel_energy
from simulator.camera import NoiseLevelFunction

#: Signals beyond this many times sensor white are clipped early: they end at white in any case,
#: and an infinite variance times a zero draw would be NaN.
SIGNAL_LIMIT = 1e6
#: Light beyond this many times the reference's white is clipped before it is blurred: it is white
#: at every exposure, and sums of larger numbers would no longer resolve the shadows.
LATENT_LIMIT = 1e9
#: Exposure ratios beyond it are limited: float32 must hold them, and any two settings keep below.
RATIO_LIMIT = 2.0**107


@dataclass(frozen=True)
class Exposure:
    """What happens to the light of a scene during one capture.

    Args:
        ratio: Exposure ratio from the latent's reference to the capture.
        source: Noise in the latent at its reference settings.
        target: Noise of the camera at the capture's settings.
        motion_px: How far the image moves while the shutter is open [pixel].
        defocus_px: Diameter of the defocus disc [pixel].
        denoised: Whether it starts from the noise-reduced light; `source` is zero then.
        opened_to: Effective f-number whose wider aperture blurs what the source shows out of focus;
            None where it does not.
        remaining: (H, W) share that this blur leaves of the noise variance which the other blurs
            have left; None for all.
        errors: What leaving out each step that would do something errs or would err by, in units of
            the target's noise (see `simulator.tolerance.Budget`).
    """

    ratio: float
    source: NoiseLevelFunction
    target: NoiseLevelFunction
    motion_px: float = 0.0
    defocus_px: float = 0.0
    denoised: bool = False
    opened_to: float | None = None
    remaining: torch.Tensor | None = None
    errors: Mapping[str, float] = field(default_factory=dict, compare=False)

    @cached_property
    def source_noise(self) -> NoiseLevelFunction:
        """Noise that reaches the sensor from the latent: exposed, and averaged by the blur."""
        if self.source.is_zero:
            return self.source
        return self.source.exposed(self.ratio).scaled(
            kernel_energy(self.motion_px, self.defocus_px)
        )
