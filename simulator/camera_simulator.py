"""The camera simulator: plans which steps a change of settings needs, and runs those.

A raw or a scene is prepared once (`CameraSimulator.prepare`): everything that does not depend on
the target settings, the networks included, is in the `Latent`. Exposing it at any settings is then
a few element-wise steps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, cast, get_args

import torch

from simulator.capture import add_noise, clip_and_quantise
from simulator.latent import HasLatent, Latent
from simulator.modules.aperture import ApertureModule, usable_defocus
from simulator.modules.exposure import ExposureModule
from simulator.modules.noise import NoiseModule, Preset, smoothed, variance_map
from simulator.noise import noise_generator
from simulator.opening import MapOpening, NetworkOpening, Opening
from simulator.plan import SimulationPlan
from simulator.raw_image import RawImage
from simulator.settings import CameraSettings, exposure_ratio
from simulator.tiles import in_tiles

Depth = Literal["far", "unknown"]
#: What the compact networks see around a pixel [pixel]; tiles overlap by it.
_NOISE_HALO, _MAP_HALO = 48, 64


@dataclass(frozen=True, eq=False)
class Stages:
    """Every intermediate result of the full pipeline (paper, figure 2), each (4, H, W).

    Args:
        exposed: After the exposure module (EXP).
        denoised: After the noise module (NS).
        opened: After the aperture module, before the output's noise (Full).
        capture: With the output settings' noise, clipped and quantised.
    """

    exposed: torch.Tensor
    denoised: torch.Tensor
    opened: torch.Tensor
    capture: torch.Tensor


class CameraSimulator:
    """Simulates what a camera would have recorded at other settings.

    Args:
        preset: Networks with random weights to train or to time, ``"compact"`` or ``"paper"``; see
            `from_pretrained` for trained ones. None has none: noise is only added, and every scene
            is taken as far.
        device: ``"auto"`` (CUDA where there is one), or any torch device.
        precision: Of the networks, ``"float32"`` or ``"bfloat16"``; everything else is float32.

    >>> import torch
    >>> from simulator import RawImage, get_camera
    >>> raw = RawImage(torch.full((4, 16, 16), 0.1), CameraSettings(100, 1 / 64, 4),
    ...                camera=get_camera("nikon_z6"))
    >>> out = CameraSimulator(device="cpu").simulate(raw, CameraSettings(400, 1 / 64, 4), seed=0)
    >>> round(float(out.data.mean()), 2)
    0.4
    """

    def __init__(
        self,
        preset: Preset | None = None,
        *,
        device: str | torch.device = "auto",
        precision: Literal["float32", "bfloat16"] = "float32",
    ) -> None:
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        try:
            self.device = torch.device(device)
        except RuntimeError as error:
            raise ValueError(f"`device` (={device!r}) is not a torch device: {error}") from None
        if self.device.type == "cuda" and not torch.cuda.is_available():
            raise ValueError(f"`device` (={str(device)!r}) must be 'cpu': there is no CUDA here")
        if precision not in ("float32", "bfloat16"):
            raise ValueError(f"`precision` (={precision!r}) must be 'float32' or 'bfloat16'")
        self.precision = precision
        self.exposure = ExposureModule().requires_grad_(False).to(self.device)
        self.noise = None if preset is None else self._ready(NoiseModule(preset))
        self.aperture = None if preset is None else self._ready(ApertureModule(preset))

    @classmethod
    def from_pretrained(
        cls,
        name: str | Path = "compact",
        *,
        device: str | torch.device = "auto",
        precision: Literal["float32", "bfloat16"] = "float32",
        body_correction: bool = False,
    ) -> CameraSimulator:
        """A simulator with trained networks.

        Args:
            name: ``"compact"``, or the path of weights that `ae-env train-simulator` wrote.
            device: See `CameraSimulator`.
            precision: See `CameraSimulator`.
            body_correction: Whether to apply the exposure module's w and b. They make up for the
                errors of the one body that was trained on and are wrong for any other.

        Raises:
            ValueError: If there are no such weights, or they are damaged or those of a baseline.
        """
        from simulator.weights import load_modules

        modules, card = load_modules(name)
        if card["preset"] not in get_args(Preset):
            raise ValueError(f"`name` (={str(name)!r}) holds the baseline {card['preset']!r}")
        simulator = cls(device=device, precision=precision)
        simulator.noise = simulator._ready(cast(NoiseModule, modules["noise"]))
        simulator.aperture = simulator._ready(cast(ApertureModule, modules["aperture"]))
        if body_correction:
            simulator.exposure = cast(ExposureModule, modules["exposure"]).to(simulator.device)
        return simulator

    def _ready(self, module: Any) -> Any:
        module = module.eval().requires_grad_(False)
        return module.to(device=self.device, memory_format=torch.channels_last)

    def prepare(
        self,
        source: RawImage | Latent | HasLatent,
        *,
        image_speed: float | None = None,
        defocus: float | None = None,
        depth: Depth = "far",
    ) -> Latent:
        """Everything that does not depend on the target settings, done once.

        Args:
            source: A raw, a latent, or a scene.
            image_speed: Speed of the image along the rows [frame heights per second]; by default
                the source's own, 0 for a raw.
            defocus: Diameter of the defocus disc at f/4 [pixel]; by default the source's own. 0
                takes the scene as far or in focus throughout, where every aperture is exact.
            depth: ``"unknown"`` lets the aperture module find what is out of focus, and blur that
                more where the aperture opens; ``"far"`` takes the scene as in focus throughout.

        Raises:
            ValueError: If an argument is out of range, or `depth` needs networks that are not here.
        """
        if depth not in get_args(Depth):
            raise ValueError(f"`depth` (={depth!r}) must be one of {list(get_args(Depth))}")
        if depth == "unknown" and self.aperture is None:
            raise ValueError(
                "`depth` (='unknown') needs an aperture module: use CameraSimulator.from_pretrained"
            )
        latent = self._latent(source)
        if image_speed is not None:
            latent = replace(latent, image_speed=image_speed)
        if defocus is not None:
            latent = replace(latent, defocus=defocus)
        # A latent may come from here, corrected already; a scene is no recording of this body.
        if isinstance(source, RawImage) and not self.exposure.is_identity:
            noise = latent.nlf.exposed(float(self.exposure.w))
            latent = replace(latent, light=self.exposure(latent.light, 1.0), nlf=noise)
        if self.noise is not None and latent.denoised is None and not latent.nlf.is_zero:
            latent = replace(latent, denoised=self.denoise(latent))
        if depth == "unknown":
            latent = replace(latent, opening=self._opening(latent))
        return latent

    def _latent(self, source: RawImage | Latent | HasLatent) -> Latent:
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
            return latent
        if isinstance(source, Latent):
            return replace(
                source,
                light=source.light.to(self.device),
                denoised=self._moved(source.denoised),
                saturated=self._moved(source.saturated),
            )
        if hasattr(source, "latent"):
            return self._latent(source.latent)
        raise ValueError(
            f"`source` (={type(source).__name__}) must be a RawImage, a Latent or a scene"
        )

    def _moved(self, tensor: torch.Tensor | None) -> torch.Tensor | None:
        return None if tensor is None else tensor.to(self.device)

    @torch.no_grad()
    def denoise(self, latent: Latent) -> torch.Tensor:
        """The latent's light (4, H, W) with little noise.

        The result serves every exposure: the compact network commutes with exposure. The paper's
        does not; it is run at the exposure of the source.

        Raises:
            ValueError: If this simulator has no noise module.
        """
        if self.noise is None:
            raise ValueError("there is no noise module: use CameraSimulator.from_pretrained")
        image, (shot, read) = latent.light[None], self._noise_of(latent)
        noise = self.noise

        def network(part: torch.Tensor) -> torch.Tensor:
            with self._autocast():
                return noise(part, shot, read)

        if noise.preset == "compact":
            return in_tiles(network, image, halo=_NOISE_HALO)[0]
        return network(image)[0]

    @torch.no_grad()
    def estimate_defocus(self, latent: Latent) -> torch.Tensor:
        """Circle of confusion of each pixel (H, W), at the latent's own aperture [pixel].

        Raises:
            ValueError: If this simulator's aperture module has no such map.
        """
        if self.aperture is None:
            raise ValueError("there is no aperture module: use CameraSimulator.from_pretrained")
        aperture = self.aperture
        shot, read = self._noise_of(latent)
        deviation = variance_map(smoothed(latent.light[None]), shot, read).sqrt()
        image = latent.light if latent.denoised is None else latent.denoised

        def network(part: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
            with self._autocast():
                return aperture.estimate_defocus(part, noise)

        diameter = in_tiles(network, image[None], deviation, halo=_MAP_HALO)
        return usable_defocus(diameter, image[None])[0]

    def _opening(self, latent: Latent) -> Opening:
        assert self.aperture is not None
        f_number = latent.reference.effective_f_number
        denoised = latent.light if latent.denoised is None else latent.denoised
        if self.aperture.preset == "paper":
            return NetworkOpening(denoised, self.aperture, f_number)
        return MapOpening(latent.light, denoised, self.estimate_defocus(latent), f_number)

    def _noise_of(self, latent: Latent) -> tuple[torch.Tensor, torch.Tensor]:
        shot, read = (torch.tensor([v]) for v in (latent.nlf.shot, latent.nlf.read))
        return shot.to(self.device), read.to(self.device)

    def _autocast(self) -> torch.autocast:
        enabled = self.precision == "bfloat16"
        return torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=enabled)

    def plan(
        self, source: RawImage | Latent | HasLatent, settings: CameraSettings, **scene: Any
    ) -> SimulationPlan:
        """Which steps the change to `settings` takes, why others are left out, error and cost."""
        return self.prepare(source, **scene).plan(settings)

    @torch.no_grad()
    def stages(self, source: RawImage, settings: CameraSettings, *, seed: int = 0) -> Stages:
        """Runs the whole pipeline on one raw, every module for this very transition.

        Nothing is left out and nothing shared: this is what `simulate` is an approximation of. The
        preset ``"paper"`` clips to [0, 1] after the exposure, as the paper does.

        Args:
            source: The raw.
            settings: Target settings. The aperture module only opens: a smaller aperture than the
                source's leaves its blur.
            seed: Seed of the output's noise.

        Raises:
            ValueError: If this simulator has no networks.
        """
        if self.noise is None or self.aperture is None:
            raise ValueError("there are no modules to run: use CameraSimulator.from_pretrained")
        latent = self._latent(source)
        ratio = exposure_ratio(latent.reference, settings)
        exposed = self.exposure(latent.light[None], ratio)
        if self.noise.preset == "paper":
            exposed = exposed.clamp(0.0, 1.0)
        shot, read = self._noise_of(latent)
        scale = float(self.exposure.w) * ratio
        shot, read = shot * scale, read * scale * scale
        with self._autocast():
            denoised = self.noise(exposed, shot, read)
            deviation = variance_map(smoothed(exposed), shot, read).sqrt()
            f_numbers = (
                torch.tensor([s.effective_f_number], device=self.device)
                for s in (latent.reference, settings)
            )
            opened = self.aperture(denoised, deviation, *f_numbers)
        clean = replace(latent.exposure(settings), source=latent.nlf.zero(), remaining=None)
        generator = noise_generator(seed, settings.iso, settings.exposure_time, settings.f_number)
        noisy, _ = add_noise(opened, [clean], [generator])
        capture = clip_and_quantise(noisy[0], latent.camera)
        return Stages(exposed[0], denoised[0], opened[0], capture)

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
            scene: Further arguments of `prepare`: ``image_speed``, ``defocus``, ``depth``.

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
