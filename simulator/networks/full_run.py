"""The full run: every module for one transition alone, nothing shared and nothing left out.

`simulator.capture.plan` predicts the distance to it, and other costs are measured against its own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from simulator.capture.blurred_light import BlurredLight
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.sensor import Transitions, exposed_light, record
from simulator.networks.aperture_module import ApertureModule
from simulator.networks.exposure_module import ExposureModule
from simulator.networks.noise_module import NoiseModule, smoothed, variance_map
from simulator.noise.generator import sweep_keys
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.settings import CameraSettings


@dataclass(frozen=True, eq=False)
class Stages:
    """Every intermediate result of the full pipeline (paper, figure 2), each (4, H, W).

    Args:
        exposed: After the exposure module (EXP).
        denoised: After the noise module (NS).
        opened: After the aperture module (Full).
        light: With the blur of a known disc and of motion, before the output's noise.
        capture: With the output settings' noise, clipped and quantised.
    """

    exposed: torch.Tensor
    denoised: torch.Tensor
    opened: torch.Tensor
    light: torch.Tensor
    capture: torch.Tensor


@dataclass(frozen=True, eq=False)
class FullRun:
    """The paper's pipeline.

    Args:
        exposure: The exposure module.
        noise: The noise module; that of ``"paper"`` and ``"ncs"`` has its input clipped to
            [0, 1], as in the paper.
        aperture: The aperture module, or None to take the scene as far.
        half: Whether the networks run in bfloat16.
    """

    exposure: ExposureModule
    noise: NoiseModule
    aperture: ApertureModule | None
    half: bool = False

    @torch.no_grad()
    def run(self, prepared: PreparedScene, settings: CameraSettings, *, seed: int = 0) -> Stages:
        """One transition.

        Args:
            prepared: The light as it was recorded; what networks found out about it is not used.
            settings: Target settings. The aperture module only opens: a smaller aperture than the
                source's leaves its blur.
            seed: Seed of the output's noise.
        """
        keys = sweep_keys(seed, [settings])  # a bad seed raises before any work
        bare = replace(prepared, denoised_lights=(), aperture_blur=None, tolerance=0.0)
        exposure = bare.exposure(settings)
        exposed = self.exposure(prepared.light[None], exposure.ratio)
        if not self.noise.commutes:
            exposed = exposed.clamp(0.0, 1.0)
        brought = prepared.nlf.exposed(float(self.exposure.w) * exposure.ratio)
        shot, read = (torch.tensor([v]).to(exposed) for v in (brought.shot, brought.read))
        with torch.autocast(exposed.device.type, dtype=torch.bfloat16, enabled=self.half):
            denoised = self.noise(exposed, shot, read)
            opened = denoised
            if self.aperture is not None:
                deviation = variance_map(smoothed(exposed), shot, read).sqrt()
                f_numbers = (
                    torch.tensor([s.effective_f_number], device=exposed.device)
                    for s in (prepared.reference, settings)
                )
                opened = self.aperture(denoised, deviation, *f_numbers)
        at_target = replace(exposure, ratio=1.0, source=NoiseLevelFunction.zero())
        lights = BlurredLight(opened[0], (), at_target.source, None)
        light = exposed_light(lights.blurred(at_target), at_target)
        capture = torch.empty_like(light)[None]
        transition = Transitions.of([light], [at_target])
        record(transition, prepared.camera, keys=keys, signals=capture)
        return Stages(exposed[0], denoised[0], opened[0], light, capture[0])
