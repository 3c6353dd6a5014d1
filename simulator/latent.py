"""The light of a scene, ready to be exposed at any settings."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import torch

from simulator.blur import kernel_energy
from simulator.camera import CameraProfile, NoiseLevelFunction
from simulator.capture import Exposure, add_noise, clip_and_quantise, sensor_light
from simulator.noise import noise_generator
from simulator.opening import NEGLIGIBLE_ADDED_BLUR, Opening
from simulator.plan import NEGLIGIBLE_BLUR, SimulationPlan, make_plan
from simulator.raw_image import check_packed
from simulator.settings import CameraSettings, exposure_ratio

#: Noise variance in excess of the target's, relative to it, from which the source is denoised.
TOLERATED_EXCESS = 0.01
#: Noise below this share of the light is not worth denoising: the networks err as much.
WORTH_DENOISING = 0.006
#: Quantiles of the light at which a source's noise is compared with a target's.
_LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)


class HasLatent(Protocol):
    """Anything that can be photographed, such as a scene of the environment."""

    @property
    def latent(self) -> Latent:
        """Its light."""


@dataclass(frozen=True, eq=False)
class Latent:
    """Light of a scene at reference settings, ready to be exposed at any others.

    Args:
        light: (4, H, W) float32, linear, not clipped: above 1 where highlights are known.
        reference: Settings at which `light` is on the scale where sensor white is 1.
        camera: The body that takes the captures.
        nlf: Noise left in `light`, at the reference settings.
        saturated: (H, W) bool, pixels whose light is only known to be at least this; None if none.
        white_balance: Gains of R, G, B of the scene's light.
        box_factor: Sensor pixels averaged per side into one pixel of `light`.
        image_speed: Speed of the image along the rows [frame heights per second].
        defocus: Diameter of the defocus disc at f/4 [pixel of `light`]; 0 for a scene that is far
            or in focus throughout.
        gain: Light relative to `light`, where it changes over time.
        denoised: (4, H, W) `light` with its noise removed by a noise module, for targets that are
            cleaner than the source; None where there is no such module or no noise.
        opening: Adds the blur of apertures wider than the reference's to a scene whose depth is not
            known; None takes it as far.
    """

    light: torch.Tensor
    reference: CameraSettings
    camera: CameraProfile
    nlf: NoiseLevelFunction
    saturated: torch.Tensor | None = None
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    box_factor: int = 1
    image_speed: float = 0.0
    defocus: float = 0.0
    gain: float = 1.0
    denoised: torch.Tensor | None = None
    opening: Opening | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "light", check_packed("light", self.light))
        if self.denoised is not None and self.denoised.shape != self.light.shape:
            raise ValueError(
                f"`denoised` (shape {tuple(self.denoised.shape)}) must have the shape of `light`, "
                f"{tuple(self.light.shape)}"
            )
        for name in ("image_speed", "defocus"):
            value = getattr(self, name)
            if not 0.0 <= value < float("inf"):
                raise ValueError(f"`{name}` (={value!r}) must be finite and >= 0")

    def exposure(self, settings: CameraSettings) -> Exposure:
        """What a capture at `settings` does to this light."""
        if not isinstance(settings, CameraSettings):
            raise ValueError(f"`settings` (={settings!r}) must be CameraSettings")
        f_number = settings.effective_f_number
        motion_px = self.image_speed * settings.exposure_time * self.light.shape[-2]
        defocus_px = self.defocus * 4.0 / f_number
        ratio = self.gain * exposure_ratio(self.reference, settings)
        target = _averaged_nlf(self.camera, settings.iso, self.box_factor)
        motion_px = motion_px if motion_px > NEGLIGIBLE_BLUR else 0.0
        defocus_px = defocus_px if defocus_px > NEGLIGIBLE_BLUR else 0.0
        opened_to = self._opened_to(f_number)
        denoised = self._needs_denoising(ratio, target, opened_to)
        remaining = None
        known = denoised or self.nlf.is_zero
        if self.opening is not None and opened_to is not None and not known:
            # Noise that one blur has smeared is correlated: a second, smaller one hardly averages
            # it further. Both together leave about what the larger leaves alone.
            energy = kernel_energy(motion_px, defocus_px)
            share = self.opening.remaining(opened_to)
            remaining = None if share is None else (share / energy).clamp(max=1.0)
        return Exposure(
            ratio=ratio,
            source=NoiseLevelFunction.zero() if denoised else self.nlf,
            target=target,
            motion_px=motion_px,
            defocus_px=defocus_px,
            denoised=denoised,
            opened_to=opened_to,
            remaining=remaining,
        )

    def _opened_to(self, f_number: float) -> float | None:
        """`f_number` where it blurs more than the reference's aperture did, else None."""
        if self.opening is None or self.opening.extent(f_number) <= NEGLIGIBLE_ADDED_BLUR:
            return None
        return f_number

    def _needs_denoising(
        self, ratio: float, target: NoiseLevelFunction, opened_to: float | None
    ) -> bool:
        if self.denoised is None:
            return False
        if opened_to is not None and self.opening is not None and self.opening.needs_denoised:
            return True
        return self.is_noisy and self._excess(ratio, target) > TOLERATED_EXCESS

    @cached_property
    def is_noisy(self) -> bool:
        """Whether the noise is more than `WORTH_DENOISING` of the light, at its median level."""
        signal = self._levels[len(_LEVELS) // 2]
        read, shot = (torch.tensor(v, dtype=torch.float64) for v in (self.nlf.read, self.nlf.shot))
        return bool(((read + shot * signal).sqrt() > WORTH_DENOISING * signal).any())

    @cached_property
    def _levels(self) -> torch.Tensor:
        """(Q, 4) quantiles of the light of each plane, at least 0."""
        planes = self.light.flatten(1)[:, :: max(1, self.light[0].numel() // 65_536)]
        levels = torch.tensor(_LEVELS, device=planes.device)
        return torch.quantile(planes.clamp(min=0.0), levels, dim=1).double().cpu()

    def _excess(self, ratio: float, target: NoiseLevelFunction) -> float:
        """Mean over light levels of the source's variance beyond the target's, relative to it."""
        if self.nlf.is_zero:
            return 0.0
        source = self.nlf.exposed(ratio)
        signal = self._levels * ratio
        variances = [
            torch.tensor(n.read, dtype=torch.float64)
            + torch.tensor(n.shot, dtype=torch.float64) * signal
            for n in (source, target)
        ]
        relative = variances[0] / variances[1].clamp(min=1e-30) - 1.0
        return float(relative.clamp(min=0.0).mean())

    def source_light(self, exposure: Exposure) -> torch.Tensor:
        """The light (4, H, W) that `exposure` starts from, still at the reference's exposure."""
        if exposure.opened_to is not None and self.opening is not None:
            return self.opening.opened(exposure.opened_to, denoised=exposure.denoised)
        return self.denoised if exposure.denoised and self.denoised is not None else self.light

    def output_noise(self, settings: CameraSettings) -> NoiseLevelFunction:
        """Noise of a native pixel of the capture: the camera's, or the source's where that is more.

        Shot and read noise are compared apart, so that a mixed case is stated too high rather than
        too low.
        """
        exposure = self.exposure(settings)
        source = exposure.source_noise.scaled(float(self.box_factor**2))
        return self.camera.nlf(settings.iso).at_least(source)

    def plan(self, settings: CameraSettings) -> SimulationPlan:
        """Steps, reasons, predicted error and cost of a capture at `settings`."""
        return make_plan(self, settings)

    def expected(self, settings: CameraSettings) -> torch.Tensor:
        """Noise-free light on the sensor at `settings`, (4, H, W), blurred and not clipped."""
        exposure = self.exposure(settings)
        return sensor_light(self.source_light(exposure), exposure)

    def capture(self, settings: CameraSettings, seed: int = 0) -> tuple[torch.Tensor, float]:
        """One simulated capture.

        The noise is a function of `seed` and of `settings`: the same frame comes back alone or in
        a sweep, and the frames of a sweep are independent.

        Returns:
            (4, H, W) float32 in [-pedestal, 1], and its excess noise (see `SimulationPlan`).
        """
        exposure = self.exposure(settings)
        light = sensor_light(self.source_light(exposure), exposure)
        generator = noise_generator(seed, settings.iso, settings.exposure_time, settings.f_number)
        noisy, excess_noise = add_noise(light[None], [exposure], [generator])
        return clip_and_quantise(noisy[0], self.camera), float(excess_noise[0])

    def expose(self, states: Iterable[CameraSettings], *, seed: int = 0) -> torch.Tensor:
        """A sweep: one capture per state, (S, 4, H, W) float32."""
        return torch.stack(list(self.stream(states, seed=seed)))

    def stream(self, states: Iterable[CameraSettings], *, seed: int = 0) -> Iterator[torch.Tensor]:
        """The sweep one capture (4, H, W) at a time, for frames too large to hold all at once."""
        for settings in states:
            yield self.capture(settings, seed)[0]


@functools.lru_cache(maxsize=4096)
def _averaged_nlf(camera: CameraProfile, iso: float, box_factor: int) -> NoiseLevelFunction:
    """Noise of `box_factor` squared sensor pixels averaged."""
    return camera.nlf(iso).scaled(1.0 / box_factor**2)
