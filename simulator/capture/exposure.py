"""Exposure of one capture, and the limits that its numbers stay within."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch

from simulator.capture.denoised import Denoised
from simulator.capture.layout import Layout
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.noise.top_up import top_up_table
from simulator.optics.motion_path import Path
from simulator.optics.shapes import kernel_energy

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


class Step(NamedTuple):
    """A step that a transition may leave out; `simulator.capture.plan.decide` makes it.

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
    network: Denoised | None = None


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
        steps: Why each optional step runs or is left out.
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
    denoised: Denoised | None = None
    opened_to: float | None = None
    remaining_variance: torch.Tensor | None = None
    steps: tuple[Step, ...] = field(default=(), compare=False)

    @cached_property
    def source_noise(self) -> NoiseLevelFunction:
        """Noise that the source brings to the sensor: exposed, and averaged by the blur."""
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

    The rows: exposure ratio; then the rows of `simulator.noise.top_up.top_up_table`.
    """
    table = np.empty((len(exposures), 5, 4), np.float32)
    table[:, 0] = np.array([exposure.ratio for exposure in exposures])[:, None]
    table[:, 1:] = top_up_table([e.source_noise for e in exposures], [e.target for e in exposures])
    return table
