"""What one capture does to the light of a scene."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from numbers import Real

import torch

from simulator.camera import NoiseLevelFunction
from simulator.optics.shapes import kernel_energy

# How much of a transition may be left out, in units of the target's noise.
#: By default the distribution of a pixel may move by a tenth of its noise's standard deviation.
DEFAULT_TOLERANCE = 0.1


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


class Budget:
    """Errors of the steps of one transition, and which of them a tolerance leaves out.

    Noise that stays widens a pixel's distribution, blur that is missing shifts it: squares add.
    Several missing blurs shift it the same way and add up; each is booked with what it adds to the
    square, so that the root of the sum of squares of all errors is right for any set of steps.

    Args:
        tolerance: Bound on the root of the sum of squares of what is left out. 0 leaves out nothing
            that changes a pixel.
    """

    def __init__(self, tolerance: float) -> None:
        self.tolerance = tolerance
        self.errors: dict[str, float] = {}
        self._noise = self._blur = 0.0

    def leaves_out_noise_reduction(self, error: float, *, pointless: bool = False) -> bool:
        """Books noise reduction, which errs by `error` if left out.

        Args:
            error: See `simulator.capture.light_statistics.LightStatistics.excess`.
            pointless: Whether the network would err as much: it is left out then whatever it costs,
                unless nothing is to be left out.
        """
        self.errors["noise_reduction"] = error
        left_out = self.tolerance > 0.0 and (error <= self.tolerance or pointless)
        self._noise = error if left_out else 0.0
        return left_out

    def leaves_out_blur(self, name: str, error: float) -> bool:
        """Books a blur, which errs by `error` if it alone is left out."""
        together = self._blur + error
        left_out = self.tolerance > 0.0 and math.hypot(self._noise, together) <= self.tolerance
        self.errors[name] = math.sqrt(error * (together + self._blur)) if error else 0.0
        if left_out:
            self._blur = together
        return left_out


#: Signals beyond this many times sensor white are clipped early: they end at white in any case,
#: and an infinite variance times a zero draw would be NaN.
SIGNAL_LIMIT = 1e6
#: Light beyond this many times the reference's white is clipped before it is blurred: it is white
#: at every exposure, and sums of larger numbers would no longer resolve the shadows.
LIGHT_LIMIT = 1e9
#: Exposure ratios beyond it are limited: float32 must hold them, and any two settings keep below.
RATIO_LIMIT = 2.0**107


@dataclass(frozen=True)
class Exposure:
    """What happens to the light of a scene during one capture.

    Args:
        ratio: Exposure ratio from the prepared scene's reference to the capture.
        source: Noise in the prepared scene at its reference settings.
        target: Noise of the camera at the capture's settings.
        motion_px: How far the image moves while the shutter is open [pixel].
        defocus_px: Diameter of the defocus disc [pixel].
        denoised: Whether it starts from the noise-reduced light; `source` is zero then.
        opened_to: Effective f-number whose wider aperture blurs what the source shows out of focus;
            None where it does not.
        remaining: (H, W) share that this blur leaves of the noise variance which the other blurs
            have left; None for all.
        errors: What leaving out each step that would do something errs or would err by, in units of
            the target's noise (see `simulator.capture.exposure.Budget`).
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
        """Noise that reaches the sensor from the prepared scene: exposed, and averaged by the blur."""
        if self.source.is_zero:
            return self.source
        return self.source.exposed(self.ratio).scaled(
            kernel_energy(self.motion_px, self.defocus_px)
        )
