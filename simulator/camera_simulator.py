"""The camera simulator: plans which steps a change of settings needs, and runs those.

A raw or a scene is prepared once (`CameraSimulator.prepare`): everything that does not depend on
the target settings, the networks included, is in the `PreparedScene`. Exposing it at any settings
is then a few element-wise steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, cast, get_args

import torch
from torch import nn

from simulator.capture.aperture_blur import MapApertureBlur, NetworkApertureBlur
from simulator.capture.blurred_light import ApertureBlur, Denoised
from simulator.capture.plan import SimulationPlan
from simulator.capture.prepared_scene import HasPrepared, PreparedScene
from simulator.networks.aperture_module import ApertureModule, usable_defocus
from simulator.networks.exposure_module import ExposureModule
from simulator.networks.full_run import FullRun, Stages
from simulator.networks.network_cache import NetworkCache, Where
from simulator.networks.noise_module import NoiseModule, Preset, smoothed, variance_map
from simulator.noise.generator import Noise, check_noise
from simulator.raw.image import RawImage
from simulator.settings import CameraSettings
from simulator.utils.tiles import in_tiles, varying

#: Depth of a scene: it is far or in focus throughout, or it is not known.
Depth = Literal["far", "unknown"]
#: Sources of a simulation.
Source = RawImage | PreparedScene | HasPrepared
#: Reach of the compact networks around a pixel [pixel]; tiles overlap by it.
_NOISE_HALO, _MAP_HALO = 36, 56
#: How far the largest disc of `simulator.optics.disc_bank` reaches [pixel].
_DISC_REACH = 16


def check_depth(depth: str) -> None:
    """Raises a `ValueError` unless `depth` says what is known of the scene's."""
    if depth not in get_args(Depth):
        raise ValueError(f"`depth` (={depth!r}) must be one of {list(get_args(Depth))}")


def prepared_of(source: Source, device: torch.device) -> PreparedScene:
    """The light of `source` as it was recorded, or a prepared scene as it is, on `device`.

    Raises:
        ValueError: If `source` is neither a raw nor a prepared scene nor a scene.
    """
    if isinstance(source, RawImage):
        return _recorded(source, device)
    if isinstance(source, PreparedScene):
        if source.light.device == device:
            return source
        given = {name: getattr(source, name) for name in ("light", "denoised", "saturated")}
        moved = {name: part.to(device) for name, part in given.items() if part is not None}
        return replace(source, **moved)
    if hasattr(source, "prepared"):
        return prepared_of(source.prepared, device)
    raise ValueError(
        f"`source` (={type(source).__name__}) must be a RawImage, a PreparedScene or a scene"
    )


def _recorded(raw: RawImage, device: torch.device) -> PreparedScene:
    saturated, camera = raw.saturated, raw.camera
    if raw.nlf is not None and not camera.nlf_by_iso:
        camera = camera.with_nlf(raw.settings.iso, raw.nlf)
    return PreparedScene(
        light=raw.data.to(device),
        reference=raw.settings,
        camera=camera,
        nlf=raw.noise,
        saturated=saturated.to(device) if saturated.count_nonzero() else None,
        white_balance=raw.white_balance,
        box_factor=raw.box_factor,
    )


class CameraSimulator:
    """Simulates what a camera would have recorded at other settings.

    Args:
        preset: Networks with random weights to train or to time, ``"compact"`` or ``"paper"``; see
            `from_pretrained` for trained ones. None has none: noise is only added, and every scene
            is taken as far.
        device: ``"auto"`` (CUDA where there is one), or any torch device.
        precision: Of the networks, ``"float32"`` or ``"bfloat16"``; everything else is float32.
        cache: Where `prepare` stores the networks' results about a source, for the next time that
            it comes: ``"memory"`` (the last 256 MiB), ``"disk"`` (also in the cache folder,
            for later runs), or None: nowhere.

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
        cache: Where | None = "memory",
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
        self._results = NetworkCache(cache)
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
        cache: Where | None = "memory",
        body_correction: bool = False,
    ) -> CameraSimulator:
        """A simulator with trained networks.

        Args:
            name: ``"compact"``, or the path of weights that `ae-env train-simulator` wrote.
            device: See `CameraSimulator`.
            precision: See `CameraSimulator`.
            cache: See `CameraSimulator`.
            body_correction: Whether to apply the exposure module's w and b. They make up for the
                errors of the one body that was trained on and are wrong for any other.

        Raises:
            ValueError: If there are no such weights, or they are damaged or those of a baseline.
        """
        from simulator.networks.weights import load_modules

        modules, card = load_modules(name)
        if card["preset"] not in get_args(Preset):
            raise ValueError(f"`name` (={str(name)!r}) holds the baseline {card['preset']!r}")
        simulator = cls(device=device, precision=precision, cache=cache)
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
        source: Source,
        *,
        image_speed: float | None = None,
        defocus: float | None = None,
        depth: Depth = "far",
        tolerance: float | Literal["source"] = "source",
    ) -> PreparedScene:
        """Everything that does not depend on the target settings, done once, when first needed.

        The source's data must not be changed afterwards.

        Args:
            source: A raw, a prepared scene, or a scene.
            image_speed: Speed of the image along the rows [frame heights per second]; by default
                the source's own, 0 for a raw.
            defocus: Diameter of the defocus disc at f/4 [pixel]; by default the source's own. 0
                takes the scene as far or in focus throughout, where every aperture is exact.
            depth: ``"unknown"`` lets the aperture module find what is out of focus, and blur that
                more where the aperture opens; ``"far"`` takes the scene as in focus throughout.
            tolerance: How far the distribution of a capture may move by what is left out, in units
                of the target's noise; 0 leaves out only what changes nothing. By default what the
                source was prepared with, `DEFAULT_TOLERANCE` for a raw or a scene.

        Raises:
            ValueError: If an argument is out of range, or `depth` needs networks that are not here.
        """
        if tolerance is None:
            raise ValueError(
                "`tolerance` (=None) must be a number here: what is prepared is shared between "
                "transitions; ask `simulate` for the full run of one"
            )
        check_depth(depth)
        if depth == "unknown" and self.aperture is None:
            raise ValueError(
                "`depth` (='unknown') needs an aperture module: use CameraSimulator.from_pretrained"
            )
        prepared = self._seen(source, image_speed, defocus)
        if tolerance != "source":
            prepared = replace(prepared, tolerance=tolerance)
        # A prepared scene may be corrected already; a scene is no recording of this body.
        if isinstance(source, RawImage) and not self.exposure.is_identity:
            noise = prepared.nlf.exposed(float(self.exposure.w))
            prepared = replace(prepared, light=self.exposure(prepared.light, 1.0), nlf=noise)
        whole = prepared.tolerance == 0.0  # what was found with another one may leave parts out
        known, aperture_blur = prepared.denoised, prepared.aperture_blur
        if self.noise is not None and not prepared.nlf.is_zero and _lacks(known, whole):
            every = whole or self.noise.preset == "paper"
            light = partial(self._denoised, replace(prepared, denoised=None))
            prepared = replace(prepared, denoised=Denoised(light, everywhere=every))
        if depth == "unknown" or (
            aperture_blur is not None and self.aperture and _lacks(aperture_blur, whole)
        ):
            prepared = replace(prepared, aperture_blur=self._aperture_blur(prepared))
        return prepared

    def _seen(
        self, source: Source, image_speed: float | None, defocus: float | None
    ) -> PreparedScene:
        """The source's light, with its motion and blur where they are given."""
        prepared = prepared_of(source, self.device)
        if image_speed is not None:
            prepared = replace(prepared, image_speed=image_speed)
        return prepared if defocus is None else replace(prepared, defocus=defocus)

    @torch.no_grad()
    def denoise(self, prepared: PreparedScene) -> torch.Tensor:
        """The prepared scene's light (4, H, W) with little noise.

        The result serves every exposure: the compact network commutes with exposure. The paper's
        does not; it is run at the exposure of the source.

        Raises:
            ValueError: If this simulator has no noise module.
        """
        if self.noise is None:
            raise ValueError("there is no noise module: use CameraSimulator.from_pretrained")
        image, (shot, read) = prepared.light[None], self._noise_of(prepared)
        noise = self.noise

        def network(part: torch.Tensor) -> torch.Tensor:
            with self._autocast():
                return noise(part, shot, read)

        if noise.preset == "compact":
            needed = varying(prepared.light) if prepared.tolerance > 0 else None
            return in_tiles(network, image, halo=_NOISE_HALO, needed=needed, fallback=image)[0]
        return network(image)[0]

    @torch.no_grad()
    def estimate_defocus(self, prepared: PreparedScene) -> torch.Tensor:
        """Circle of confusion of each pixel (H, W), at the prepared scene's own aperture [pixel].

        Raises:
            ValueError: If this simulator's aperture module has no such map.
        """
        if self.aperture is None:
            raise ValueError("there is no aperture module: use CameraSimulator.from_pretrained")
        aperture = self.aperture
        shot, read = self._noise_of(prepared)
        light = prepared.light[None]
        image = light if prepared.denoised is None else prepared.denoised.light[None]

        def network(part: torch.Tensor, noisy: torch.Tensor) -> torch.Tensor:
            deviation = variance_map(smoothed(noisy), shot, read).sqrt()
            with self._autocast():
                return aperture.estimate_defocus(part, deviation)

        # No disc changes a pixel that sees a constant neighbourhood.
        needed = varying(prepared.light, _DISC_REACH) if prepared.tolerance > 0 else None
        sharp = light.new_zeros(light[:, 0].shape)
        diameter = in_tiles(network, image, light, halo=_MAP_HALO, needed=needed, fallback=sharp)
        return usable_defocus(diameter, image)[0]

    def _aperture_blur(self, prepared: PreparedScene) -> ApertureBlur:
        assert self.aperture is not None
        f_number = prepared.reference.effective_f_number
        denoised = prepared.denoised or Denoised(prepared.light)
        if self.aperture.preset == "paper":
            opened = partial(self._results.called, "opened", self.aperture)
            return NetworkApertureBlur(denoised, opened, f_number)
        estimate, everywhere = partial(self._defocus_map, prepared), prepared.tolerance == 0.0
        return MapApertureBlur(prepared.light, denoised, estimate, f_number, everywhere=everywhere)

    def _denoised(self, prepared: PreparedScene) -> torch.Tensor:
        """`denoise`, cached."""
        assert self.noise is not None
        make = partial(self.denoise, prepared)
        return self._cached("denoised", self.noise, prepared, make, prepared.light.shape)

    def _defocus_map(self, prepared: PreparedScene) -> torch.Tensor:
        """`estimate_defocus`, cached."""
        assert self.aperture is not None
        estimate = partial(self.estimate_defocus, prepared)
        shape = prepared.light.shape[-2:]
        return self._cached("defocus_maps", self.aperture, prepared, estimate, shape)

    def _cached(
        self,
        kind: str,
        module: nn.Module,
        prepared: PreparedScene,
        make: Callable[[], torch.Tensor],
        shape: Sequence[int],
    ) -> torch.Tensor:
        """The result of `make`, or that of an earlier call where everything was the same."""
        denoised = None if prepared.denoised is None else prepared.denoised.light
        inputs = {"light": prepared.light, "denoised": denoised, "saturated": prepared.saturated}
        return self._results.result(
            kind,
            [module],
            inputs,
            make,
            shape=shape,
            nlf=[prepared.nlf.shot, prepared.nlf.read],
            precision=self.precision,
            everywhere=prepared.tolerance == 0,
        )

    def _noise_of(self, prepared: PreparedScene) -> tuple[torch.Tensor, torch.Tensor]:
        shot, read = (torch.tensor([v]) for v in (prepared.nlf.shot, prepared.nlf.read))
        return shot.to(self.device), read.to(self.device)

    def _autocast(self) -> torch.autocast:
        enabled = self.precision == "bfloat16"
        return torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=enabled)

    def plan(
        self,
        source: Source,
        settings: CameraSettings,
        *,
        noise: bool = True,
        image_speed: float | None = None,
        defocus: float | None = None,
        depth: Depth = "far",
        tolerance: float | Literal["source"] = "source",
    ) -> SimulationPlan:
        """Which steps the change to `settings` takes, why others are left out, error and cost.

        Args:
            source: A raw, a prepared scene, or a scene.
            settings: Target settings.
            noise: False plans the light on the sensor alone (`PreparedScene.expected`).
            image_speed: See `prepare`.
            defocus: See `prepare`.
            depth: See `prepare`.
            tolerance: See `prepare`.
        """
        prepared = self.prepare(
            source, image_speed=image_speed, defocus=defocus, depth=depth, tolerance=tolerance
        )
        return prepared.plan(settings, noise=noise)

    def stages(
        self,
        source: Source,
        settings: CameraSettings,
        *,
        seed: int = 0,
        image_speed: float | None = None,
        defocus: float | None = None,
        depth: Depth = "unknown",
    ) -> Stages:
        """Runs the whole pipeline on one source, every module for this very transition.

        Nothing is left out and nothing shared: this is what `simulate` is an approximation of. The
        preset ``"paper"`` clips to [0, 1] after the exposure, as the paper does.

        Args:
            source: A raw, a prepared scene, or a scene.
            settings: Target settings. The aperture module only opens: a smaller aperture than the
                source's leaves its blur.
            seed: Seed of the output's noise.
            image_speed: See `prepare`.
            defocus: See `prepare`.
            depth: See `prepare`; unknown to a prepared scene that was prepared as such.

        Raises:
            ValueError: If this simulator has no networks, or an argument is out of range.
        """
        if self.noise is None or self.aperture is None:
            raise ValueError("there are no modules to run: use CameraSimulator.from_pretrained")
        check_depth(depth)
        prepared = self._seen(source, image_speed, defocus)
        opens = depth == "unknown" or prepared.aperture_blur is not None
        # A prepared scene may be corrected already; a scene is no recording of this body.
        exposure = self.exposure
        if not isinstance(source, RawImage):
            exposure = ExposureModule().requires_grad_(False).to(self.device)
        aperture, half = self.aperture if opens else None, self.precision == "bfloat16"
        return FullRun(exposure, self.noise, aperture, half).run(prepared, settings, seed=seed)

    def simulate(
        self,
        source: Source,
        settings: CameraSettings,
        *,
        seed: int = 0,
        noise: Noise = "exact",
        image_speed: float | None = None,
        defocus: float | None = None,
        depth: Depth = "far",
        tolerance: float | Literal["source"] | None = "source",
    ) -> RawImage:
        """The raw that the camera would have recorded at `settings`.

        Args:
            source: A raw, a prepared scene, or a scene.
            settings: Target ISO, exposure time and f-number.
            seed: Seed of the noise, >= 0; the same seed gives the same frame.
            noise: ``"exact"`` draws it, ``"bank"`` looks it up, faster (see
                `PreparedScene.capture`); the full run draws it.
            image_speed: See `prepare`.
            defocus: See `prepare`.
            depth: See `prepare`.
            tolerance: See `prepare`; None runs every module for this very transition (`stages`),
                and shares and leaves out nothing.

        Returns:
            A raw with the camera's noise at `settings`; ``metadata["excess_noise"]`` and
            ``metadata["clipped_source"]`` declare what could not be made exact.
        """
        check_noise(noise)
        if tolerance is None and self.noise is not None:
            stages = self.stages(
                source, settings, seed=seed, image_speed=image_speed, defocus=defocus, depth=depth
            )
            data, excess_noise = stages.capture, 0.0
            prepared = prepared_of(source, self.device)
            clean = replace(prepared, nlf=prepared.nlf.zero(), denoised=None, aperture_blur=None)
            output_noise = clean.output_noise(settings)
        else:  # without networks nothing is shared, and tolerance 0 is the full run
            prepared = self.prepare(
                source,
                image_speed=image_speed,
                defocus=defocus,
                depth=depth,
                tolerance=0.0 if tolerance is None else tolerance,
            )
            data, excess_noise = prepared.capture(settings, seed, noise=noise)
            output_noise = prepared.output_noise(settings)
        metadata = dict(source.metadata) if isinstance(source, RawImage) else {}
        metadata |= {
            "simulated_from": str(prepared.reference),
            "seed": seed,
            "excess_noise": excess_noise,
            "clipped_source": prepared.saturated_share,
        }
        return RawImage(
            data=data,
            settings=settings,
            camera=prepared.camera,
            nlf=output_noise,
            white_balance=prepared.white_balance,
            box_factor=prepared.box_factor,
            metadata=metadata,
        )


def _lacks(known: Denoised | ApertureBlur | None, whole: bool) -> bool:
    """Whether there is none, or one that leaves out parts of the frame where it must not."""
    return known is None or (whole and not known.everywhere)
