"""One capture: from linear light on the sensor to the numbers that the camera records.

The order is physical, and it matters: exposed light, not clipped -> motion and defocus blur of
that unclipped light -> noise of the blurred signal -> clip -> quantise, each of the last two once.
(Exposure and blur are linear and change places here: one blur then serves many exposures.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from simulator.blur import disc_blur, kernel_energy, motion_blur
from simulator.camera import CameraProfile, NoiseLevelFunction
from simulator.noise import noise_variance

#: Signals beyond this many times sensor white are clipped early: they end at white in any case,
#: and an infinite variance times a zero draw would be NaN.
SIGNAL_LIMIT = 1e6
#: Light beyond this many times the reference's white is clipped before it is blurred: it is white
#: at every exposure, and sums of larger numbers would no longer resolve the shadows.
LATENT_LIMIT = 1e9


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
    """

    ratio: float
    source: NoiseLevelFunction
    target: NoiseLevelFunction
    motion_px: float = 0.0
    defocus_px: float = 0.0
    denoised: bool = False
    opened_to: float | None = None
    remaining: torch.Tensor | None = None

    @property
    def source_noise(self) -> NoiseLevelFunction:
        """Noise that reaches the sensor from the latent: exposed, and averaged by the blur."""
        if self.source.is_zero:
            return self.source
        return self.source.exposed(self.ratio).scaled(
            kernel_energy(self.motion_px, self.defocus_px)
        )


def sensor_light(latent: torch.Tensor, exposure: Exposure) -> torch.Tensor:
    """Light on the sensor, (4, H, W): exposed and blurred, neither noisy nor clipped."""
    light = latent
    if exposure.defocus_px or exposure.motion_px:  # else even the brightest light stays exact
        light = motion_blur(defocused_light(latent, exposure.defocus_px), exposure.motion_px)
    return (light * exposure.ratio).clamp_(-SIGNAL_LIMIT, SIGNAL_LIMIT)


def defocused_light(latent: torch.Tensor, defocus_px: float) -> torch.Tensor:
    """Light (4, H, W) of a scene behind an aperture, still at the latent's exposure.

    Blur and exposure are linear, so the blur may come first: it then serves every exposure time
    and ISO.
    """
    return disc_blur(latent.clamp(-LATENT_LIMIT, LATENT_LIMIT), defocus_px)


def add_noise(
    light: torch.Tensor, exposures: Sequence[Exposure], generators: Sequence[torch.Generator]
) -> tuple[torch.Tensor, np.ndarray]:
    """Tops the noise of each image of `light` (B, 4, H, W) up to its target's.

    Each image draws from its own generator, so that it comes out the same alone or in a batch.

    Returns:
        The noisy signal, and per image the excess noise (B,): mean over the pixels of the variance
        that the source brings beyond the target's, relative to the target's; 0 where the source is
        clean enough.
    """
    sources = [e.source_noise for e in exposures]
    targets = [e.target for e in exposures]
    shot = _planes([t.shot for t in targets]) - _planes([s.shot for s in sources])
    read = _planes([t.read for t in targets]) - _planes([s.read for s in sources])
    missing = light.clamp(min=0.0).mul_(shot.to(light)).add_(read.to(light))
    excess_noise = np.zeros(len(exposures))
    for i, (source, target) in enumerate(zip(sources, targets, strict=True)):
        remaining = exposures[i].remaining
        if remaining is not None:  # what the blur of the aperture took away is to be added again
            missing[i] += (1.0 - remaining) * noise_variance(light[i], source)
        if not source.is_zero:
            wanted = noise_variance(light[i], target).clamp_(min=torch.finfo(torch.float32).tiny)
            relative = (missing[i] / wanted).clamp_(max=0.0).mean(dtype=torch.float64)
            excess_noise[i] = max(0.0, -float(relative))
    normals = torch.empty(light.shape, dtype=torch.float32)
    for normal, generator in zip(normals, generators, strict=True):
        normal.normal_(generator=generator)
    if not all(source.is_zero for source in sources):
        missing.clamp_(min=0.0)
    return missing.sqrt_().mul_(normals.to(light.device)).add_(light), excess_noise


def _planes(values: list[tuple[float, float, float, float]]) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)[:, :, None, None]  # (B, 4, 1, 1)


def clip_and_quantise(signal: torch.Tensor, camera: CameraProfile) -> torch.Tensor:
    """The camera's digital numbers of `signal` (..., 4, H, W), on the scale where white is 1."""
    device = signal.device
    span = torch.tensor(camera.span, dtype=torch.float32, device=device)[:, None, None]
    black = torch.tensor(camera.black_level, dtype=torch.float32, device=device)[:, None, None]
    numbers = (signal * span).add_(black).round_().clamp_(0.0, camera.white_level)
    return numbers.sub_(black).div_(span)
