"""The camera simulator: plans which steps a change of settings needs, and runs those.

A raw or a scene is prepared once (`CameraSimulator.prepare`): everything that does not depend on
the target settings is in the `Latent`. Exposing it at any settings is then a few element-wise
steps.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

import torch

from simulator.camera import CameraProfile, NoiseLevelFunction
from simulator.capture import (
    SIGNAL_LIMIT,
    Exposure,
    add_noise,
    clip_and_quantise,
    sensor_light,
)
from simulator.noise import noise_generator, noise_variance, top_up_variance
from simulator.raw_image import RawImage, check_packed
from simulator.settings import CameraSettings, exposure_ratio

#: Blur below this extent [pixel] changes nothing that a digital number could show.
NEGLIGIBLE_BLUR = 1e-3
_EXPOSE_OPERATIONS = 2
_NOISE_OPERATIONS = 14
_CLIP_OPERATIONS = 6
_STREAK_OPERATIONS = 6


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
        operations: Arithmetic operations that the steps need, all pixels together.
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
        lines.append(
            f"  error     noise variance {self.excess_noise:.1%} above the target's "
            f"(RMSE {self.predicted_rmse:.2e} of white); "
            f"{self.clipped_source:.2%} of the source is saturated"
        )
        if self.extrapolated_noise:
            lines.append("  warning   the ISO is outside the camera's noise calibration")
        lines.append(f"  cost      {self.operations / 1e6:.1f} million operations")
        return "\n".join(lines)


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

    def __post_init__(self) -> None:
        object.__setattr__(self, "light", check_packed("light", self.light))
        for name in ("image_speed", "defocus"):
            value = getattr(self, name)
            if not 0.0 <= value < float("inf"):
                raise ValueError(f"`{name}` (={value!r}) must be finite and >= 0")

    def exposure(self, settings: CameraSettings) -> Exposure:
        """What a capture at `settings` does to this light."""
        if not isinstance(settings, CameraSettings):
            raise ValueError(f"`settings` (={settings!r}) must be CameraSettings")
        motion_px = self.image_speed * settings.exposure_time * self.light.shape[-2]
        defocus_px = self.defocus * 4.0 / settings.effective_f_number
        return Exposure(
            ratio=self.gain * exposure_ratio(self.reference, settings),
            source=self.nlf,
            target=_averaged_nlf(self.camera, settings.iso, self.box_factor),
            motion_px=motion_px if motion_px > NEGLIGIBLE_BLUR else 0.0,
            defocus_px=defocus_px if defocus_px > NEGLIGIBLE_BLUR else 0.0,
        )

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
        exposure = self.exposure(settings)
        pixels = self.light.numel()
        signal = (self.light * exposure.ratio).clamp_(-SIGNAL_LIMIT, SIGNAL_LIMIT)
        missing, excess = top_up_variance(signal, exposure.source_noise, exposure.target)
        wanted = noise_variance(signal, exposure.target).clamp_(min=torch.finfo(torch.float32).tiny)
        relative_excess = float((excess / wanted).mean(dtype=torch.float64))

        steps = {"exposure": (_EXPOSE_OPERATIONS * pixels, "")}
        taps = 1 + int(exposure.defocus_px) ** 2
        steps["defocus"] = (
            taps * 2 * pixels * (exposure.defocus_px > 0),
            "the scene is taken as far or in focus throughout"
            if self.defocus == 0
            else f"the defocus disc is below {NEGLIGIBLE_BLUR} pixel",
        )
        steps["motion_blur"] = (
            _STREAK_OPERATIONS * pixels * (exposure.motion_px > 0),
            "the image does not move"
            if self.image_speed == 0
            else f"the image moves less than {NEGLIGIBLE_BLUR} pixel during the exposure",
        )
        steps["noise"] = (
            _NOISE_OPERATIONS * pixels * bool((missing > 0).any()),
            "no pixel lacks noise: the source has the target's already, or more",
        )
        steps["clip_and_quantise"] = (_CLIP_OPERATIONS * pixels, "")
        return SimulationPlan(
            settings=settings,
            exposure_ratio=exposure.ratio,
            modules=tuple(name for name, (cost, _) in steps.items() if cost),
            left_out={name: reason for name, (cost, reason) in steps.items() if not cost},
            excess_noise=relative_excess,
            clipped_source=0.0
            if self.saturated is None
            else float(self.saturated.float().mean(dtype=torch.float64)),
            extrapolated_noise=exposure.target.extrapolated,
            predicted_rmse=float(excess.mean(dtype=torch.float64)) ** 0.5,
            operations=sum(cost for cost, _ in steps.values()),
        )

    def expected(self, settings: CameraSettings) -> torch.Tensor:
        """Noise-free light on the sensor at `settings`, (4, H, W), blurred and not clipped."""
        return sensor_light(self.light, self.exposure(settings))

    def capture(self, settings: CameraSettings, seed: int = 0) -> tuple[torch.Tensor, float]:
        """One simulated capture.

        The noise is a function of `seed` and of `settings`: the same frame comes back alone or in
        a sweep, and the frames of a sweep are independent.

        Returns:
            (4, H, W) float32 in [-pedestal, 1], and its excess noise (see `SimulationPlan`).
        """
        exposure = self.exposure(settings)
        light = sensor_light(self.light, exposure)
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


class CameraSimulator:
    """Simulates what a camera would have recorded at other settings.

    Args:
        device: ``"auto"`` (CUDA where there is one), or any torch device.

    >>> import torch
    >>> from simulator import RawImage, get_camera
    >>> raw = RawImage(torch.full((4, 16, 16), 0.1), CameraSettings(100, 1 / 64, 4),
    ...                camera=get_camera("nikon_z6"))
    >>> out = CameraSimulator(device="cpu").simulate(raw, CameraSettings(400, 1 / 64, 4), seed=0)
    >>> round(float(out.data.mean()), 2)
    0.4
    """

    def __init__(self, device: str | torch.device = "auto") -> None:
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        try:
            self.device = torch.device(device)
        except RuntimeError as error:
            raise ValueError(f"`device` (={device!r}) is not a torch device: {error}") from None

    def prepare(
        self,
        source: RawImage | Latent | HasLatent,
        *,
        image_speed: float | None = None,
        defocus: float | None = None,
    ) -> Latent:
        """Everything that does not depend on the target settings, done once.

        Args:
            source: A raw, a latent, or a scene.
            image_speed: Speed of the image along the rows [frame heights per second]; by default
                the source's own, 0 for a raw.
            defocus: Diameter of the defocus disc at f/4 [pixel]; by default the source's own. 0
                takes the scene as far or in focus throughout, where every aperture is exact.

        Raises:
            ValueError: If an argument is out of range.
        """
        if isinstance(source, RawImage):
            saturated = source.saturated
            latent = Latent(
                light=source.data.to(self.device),
                reference=source.settings,
                camera=source.camera,
                nlf=source.noise,
                saturated=saturated.to(self.device) if bool(saturated.any()) else None,
                white_balance=source.white_balance,
                box_factor=source.box_factor,
            )
            if source.nlf is not None and not source.camera.nlf_by_iso:
                camera = source.camera.with_nlf(source.settings.iso, source.nlf)
                latent = replace(latent, camera=camera)
        elif isinstance(source, Latent):
            latent = replace(source, light=source.light.to(self.device))
        elif hasattr(source, "latent"):
            latent = self.prepare(source.latent)
        else:
            raise ValueError(
                f"`source` (={type(source).__name__}) must be a RawImage, a Latent or a scene"
            )
        if image_speed is not None:
            latent = replace(latent, image_speed=image_speed)
        if defocus is not None:
            latent = replace(latent, defocus=defocus)
        return latent

    def plan(
        self, source: RawImage | Latent | HasLatent, settings: CameraSettings, **scene: Any
    ) -> SimulationPlan:
        """Which steps the change to `settings` takes, why others are left out, error and cost."""
        return self.prepare(source, **scene).plan(settings)

    def simulate(
        self,
        source: RawImage | Latent | HasLatent,
        settings: CameraSettings,
        *,
        seed: int = 0,
        **scene: Any,
    ) -> RawImage:
        """The raw that the camera would have recorded at `settings`.

        Args:
            source: A raw, a latent, or a scene.
            settings: Target ISO, exposure time and f-number.
            seed: Seed of the noise, >= 0; the same seed gives the same frame.
            scene: Further arguments of `prepare`: ``image_speed``, ``defocus``.

        Returns:
            A raw with the camera's noise at `settings`; ``metadata["excess_noise"]`` and
            ``metadata["clipped_source"]`` declare what could not be made exact.
        """
        latent = self.prepare(source, **scene)
        data, excess_noise = latent.capture(settings, seed)
        clipped = 0.0 if latent.saturated is None else float(latent.saturated.float().mean())
        metadata = dict(source.metadata) if isinstance(source, RawImage) else {}
        metadata |= {
            "simulated_from": str(latent.reference),
            "seed": seed,
            "excess_noise": excess_noise,
            "clipped_source": clipped,
        }
        return RawImage(
            data=data,
            settings=settings,
            camera=latent.camera,
            nlf=latent.output_noise(settings),
            white_balance=latent.white_balance,
            box_factor=latent.box_factor,
            metadata=metadata,
        )
