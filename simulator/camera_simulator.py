"""The camera simulator: plans which steps a change of settings needs, and runs those."""

import timeit
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import (
    Any,
    Literal,
    Protocol,
    Self,
    TypeAlias,
    TypedDict,
    TypeVar,
    Unpack,
    cast,
    get_args,
)

import torch
from torch import nn

from simulator.capture.blurred_light import (
    ApertureBlur,
    BlurredLight,
    MapApertureBlur,
    NetworkApertureBlur,
)
from simulator.capture.limits import RATIO_LIMIT
from simulator.capture.plan import SimulationPlan
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.sensor import sweep_keys
from simulator.capture.statistics import DenoisedLight, Residual
from simulator.networks.aperture_module import ApertureModule, usable_defocus
from simulator.networks.exposure_module import ExposureModule
from simulator.networks.network_cache import NetworkCache, Where
from simulator.networks.noise_module import (
    BFLOAT16_ERROR,
    SIZES,
    Denoiser,
    NoiseModule,
    Preset,
    smoothed,
    variance_map,
)
from simulator.noise.generator import Noise
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.optics.discs import DISC_REACH
from simulator.optics.vignetting import Vignetting, get_lens
from simulator.raw.develop import neutral_highlights
from simulator.raw.image import RawImage
from simulator.settings import CameraSettings, exposure_ratio
from simulator.utils.checks import check_type, check_word
from simulator.utils.compute import check_bfloat16, check_device
from simulator.utils.tiles import in_tiles, varying

Module = TypeVar("Module", bound=nn.Module)
#: Depth of a scene: it is far or in focus throughout, or it is not known.
Depth = Literal["far", "unknown"]


class HasPrepared(Protocol):
    """Anything that can be photographed, such as a scene of the environment."""

    @property
    def prepared(self) -> PreparedScene:
        """Its light."""


#: Sources of a simulation.
Source: TypeAlias = RawImage | PreparedScene | HasPrepared
#: Reach of the family's networks around a pixel [pixel], a multiple of 8; tiles overlap by it.
_NOISE_HALO, _MAP_HALO = 80, 56
#: What bfloat16 changes of the family's results.
_ROUNDING = {name: Residual.alike(error) for name, error in BFLOAT16_ERROR.items()}
#: Size of the raw that a network's time is measured on [packed pixel].
_TIMED = 128


class SceneArguments(TypedDict, total=False):
    """What may be said of the scene of a source; see `CameraSimulator.prepare`."""

    image_speed: float | None
    defocus: float | None
    depth: Depth
    lens: str | Vignetting | None


@dataclass(frozen=True, eq=False)
class Stages:
    """Every intermediate result of the full pipeline (paper, figure 2), each (4, H, W)."""

    exposed: torch.Tensor  # after the exposure module (EXP)
    denoised: torch.Tensor  # after the noise module (NS)
    opened: torch.Tensor  # after the aperture module (Full)
    light: torch.Tensor  # with the blur of a known disc and of motion, before the output's noise
    capture: torch.Tensor  # with the output settings' noise, clipped and quantised


def prepared_of(source: Source, device: torch.device) -> PreparedScene:
    """The light of `source` as it was recorded, or a prepared scene as it is, on `device`."""
    if isinstance(source, RawImage):
        marks, camera = source.saturated, source.camera
        if source.nlf is not None and not camera.nlf_by_iso:
            camera = camera.with_nlf(source.settings.iso, source.nlf)
        light, noise = neutral_highlights(source, marks).to(device), source.noise
        return PreparedScene(
            light=light,
            reference=source.settings,
            camera=camera,
            nlf=noise,
            saturated=marks.to(device) if marks.cpu().numpy().any() else None,
            white_balance=source.white_balance,
            box_factor=source.box_factor,
            blurred_light=BlurredLight(light, noise, None),  # the raw was checked
        )
    if isinstance(source, PreparedScene):
        if source.light.device == device:
            return source
        saturated = None if source.saturated is None else source.saturated.to(device)
        denoised = tuple(d.to(device) for d in source.denoised_lights)
        light = source.light.to(device)
        return replace(source, light=light, denoised_lights=denoised, saturated=saturated)
    if hasattr(source, "prepared"):
        return prepared_of(source.prepared, device)
    raise ValueError(
        f"`source` (={type(source).__name__}) must be a RawImage, a PreparedScene or a scene"
    )


def _for_the_map(prepared: PreparedScene) -> torch.Tensor | None:
    """The light with little noise that defocus is estimated on; None if there is none.

    The smallest network is enough, whatever the tolerance: with it, the error of the blur of 24
    validation scenes was 2 % larger than with the largest at ISO 6400, and the same at ISO 100.
    """
    return prepared.denoised_lights[0].light if prepared.denoised_lights else None


def _required(kind: str, module: Module | None) -> Module:
    """`module`, which the caller needs."""
    if module is None:
        raise ValueError(f"there is no {kind} module: use CameraSimulator.from_pretrained")
    return module


class CameraSimulator:
    """Simulates what a camera would have recorded at other settings.

    Args:
        preset: Networks with random weights to train or to time, ``"nano"``, ``"compact"``,
            ``"large"``, ``"paper"`` or ``"ncs"``; see `from_pretrained` for trained ones. None has
            none: noise is only added, and every scene is taken as far.
        device: ``"auto"`` (CUDA where there is one), or any torch device.
        precision: Of the networks, ``"float32"`` or ``"bfloat16"``; everything else is float32, as
            are networks whose rounding would be more than the tolerance (`BFLOAT16_ERROR`).
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
        self.device = check_device(device)
        check_word("precision", precision, ("float32", "bfloat16"))
        if precision == "bfloat16":
            check_bfloat16(self.device)
        self.precision = precision
        self._results = NetworkCache(cache)
        self.exposure = ExposureModule().requires_grad_(False).to(self.device)
        self.noises: tuple[NoiseModule, ...] = ()
        self.aperture: ApertureModule | None = None
        self._seconds: dict[str, float] = {}
        if preset is not None:
            self.noises = (self._ready(NoiseModule(preset)),)
            aperture: Any = preset if preset in ("paper", "ncs") else "compact"
            self.aperture = self._ready(ApertureModule(aperture))

    @property
    def noise(self) -> NoiseModule | None:
        """The best of its noise modules, `noises`, which are in the order of their cost."""
        return self.noises[-1] if self.noises else None

    @classmethod
    def from_pretrained(
        cls,
        name: str | Path = "compact",
        *,
        device: str | torch.device = "auto",
        precision: Literal["float32", "bfloat16"] = "float32",
        cache: Where | None = "memory",
        body_correction: bool = False,
    ) -> Self:
        """A simulator with trained networks.

        A `ValueError` if there are no such weights, or they are damaged.

        Args:
            name: Largest noise module that may run, ``"nano"``, ``"compact"`` or ``"large"``; which
                one up to it does, `tolerance` decides. Or the path of weights that
                `ae-env train-simulator` wrote, or of the authors' (docs/networks.md), whose noise
                module is the only one then.
            device, precision, cache: See `CameraSimulator`.
            body_correction: Whether to apply the exposure module's w and b. They make up for the
                errors of the one body that was trained on and are wrong for any other.
        """
        from simulator.networks.weights import load_modules

        sizes = list(SIZES)
        names = sizes[: sizes.index(str(name)) + 1] if str(name) in sizes else [name]
        loaded = {n: load_modules(n) for n in names}
        whole = next((m for m, _ in loaded.values() if "aperture" in m), None)
        if whole is None:  # a noise module alone
            whole = load_modules("compact")[0]
        simulator = cls(device=device, precision=precision, cache=cache)
        simulator.noises = tuple(
            simulator._ready(cast(NoiseModule, modules["noise"])) for modules, _ in loaded.values()
        )
        simulator.aperture = simulator._ready(cast(ApertureModule, whole["aperture"]))
        if body_correction:
            simulator.exposure = cast(ExposureModule, whole["exposure"]).to(simulator.device)
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
        lens: str | Vignetting | None = None,
        tolerance: float | Literal["source"] = "source",
    ) -> PreparedScene:
        """Everything that does not depend on the target settings, done once, when first needed.

        The source's data must not be changed afterwards. A `ValueError` if an argument is out of
        range, or `depth` needs networks that are not here.

        Args:
            source: A raw, a prepared scene, or a scene.
            image_speed: Speed of the image [frame heights per second], along the rows unless the
                source has a movement; by default the source's own, 0 for a raw.
            defocus: Diameter of the defocus disc at f/4 [pixel]; by default the source's own. 0
                takes the scene as far or in focus throughout, where every aperture is exact.
            depth: ``"unknown"`` lets the aperture module find what is out of focus, and blur that
                more where the aperture opens; ``"far"`` takes the scene as in focus throughout.
            lens: Whose vignetting captures have (`simulator.optics.vignetting.get_lens`), such as
                ``"lensfun:Canon EF 24-70mm f/2.8L II USM"``; by default the source's own. A raw
                was taken through it: only what the f-number changes is changed.
            tolerance: Error that a capture may have, in units of the target's noise: the cheapest
                steps that keep it are taken, or else, as at 0, those with the least error. By
                default what the source was prepared with, `DEFAULT_TOLERANCE` for a raw or a scene.
        """
        check_word("depth", depth, get_args(Depth))
        if depth == "unknown" and self.aperture is None:
            raise ValueError(
                "`depth` (='unknown') needs an aperture module: use CameraSimulator.from_pretrained"
            )
        prepared = self._seen(source, image_speed, defocus, lens)
        if tolerance != "source":
            prepared = replace(prepared, tolerance=tolerance)
        # A prepared scene may be corrected already; a scene is no recording of this body.
        if isinstance(source, RawImage) and not self.exposure.is_identity:
            noise = prepared.nlf.exposed(float(self.exposure.w))
            prepared = replace(prepared, light=self.exposure(prepared.light, 1.0), nlf=noise)
        whole = prepared.tolerance == 0.0  # what was found with another one may leave parts out
        known, aperture_blur = prepared.denoised_lights, prepared.aperture_blur
        lacks = not known or (whole and not all(d.everywhere for d in known))
        if self.noises and not prepared.nlf.is_zero and lacks:
            bare = replace(prepared, denoised_lights=())
            prepared = replace(
                prepared, denoised_lights=tuple(self._denoised(m, bare) for m in self.noises)
            )
        if depth == "unknown" or (
            aperture_blur is not None and self.aperture and whole and not aperture_blur.everywhere
        ):
            prepared = replace(prepared, aperture_blur=self._aperture_blur(prepared))
        return prepared

    def _seen(
        self,
        source: Source,
        image_speed: float | None,
        defocus: float | None,
        lens: str | Vignetting | None,
    ) -> PreparedScene:
        """The source's light, with its motion, blur and lens unless they are None."""
        given = {"image_speed": image_speed, "defocus": defocus, "lens": get_lens(lens)}
        known: Any = {name: value for name, value in given.items() if value is not None}
        if lens is not None and isinstance(source, RawImage):
            known["seen_through_lens"] = True
        prepared = prepared_of(source, self.device)
        return replace(prepared, **known) if known else prepared

    @torch.no_grad()
    def denoise(self, prepared: PreparedScene, noise: NoiseModule | None = None) -> torch.Tensor:
        """Light (4, H, W) of `prepared` with little noise, by the module `noise` or the best one.

        The result serves every exposure: the family commutes with exposure. Those of the paper
        and of its authors' code do not; they are run at the exposure of the source. A `ValueError`
        if there is no noise module.
        """
        noise = _required("noise", self.noise if noise is None else noise)
        image, (shot, read) = prepared.light[None], self._noise_of(prepared)
        precision = self._precision_of(noise, prepared)
        if not noise.commutes:
            with self._autocast(precision):
                return noise(image, shot, read)[0]
        network = cast(Denoiser, noise.network)

        def uncorrected(part: torch.Tensor, far: torch.Tensor) -> torch.Tensor:
            with self._autocast(precision):
                return network.uncorrected(part, far, shot, read)

        needed = varying(prepared.light) if prepared.tolerance > 0 else None
        clean = in_tiles(
            uncorrected,
            *(image, network.surroundings(image, shot, read)),
            halo=_NOISE_HALO,
            needed=needed,
            fallback=image,
        )
        clean = network.corrected(clean, image, shot, read)[0]
        return clean if needed is None else torch.where(needed, clean, prepared.light)

    @torch.no_grad()
    def estimate_defocus(self, prepared: PreparedScene) -> torch.Tensor:
        """Circle of confusion (H, W) of each pixel of `prepared`, at its own aperture [pixel].

        A `ValueError` if the aperture module has no such map.
        """
        aperture = _required("aperture", self.aperture)
        shot, read = self._noise_of(prepared)
        light = prepared.light[None]
        clean = _for_the_map(prepared)
        image = light if clean is None else clean[None]

        def network(part: torch.Tensor, noisy: torch.Tensor) -> torch.Tensor:
            deviation = variance_map(smoothed(noisy), shot, read).sqrt()
            with self._autocast(self._precision_of(aperture, prepared)):
                return aperture.estimate_defocus(part, deviation)

        # No disc changes a pixel that sees a constant neighbourhood.
        needed = varying(prepared.light, DISC_REACH) if prepared.tolerance > 0 else None
        sharp = light.new_zeros(light[:, 0].shape)
        diameter = in_tiles(network, image, light, halo=_MAP_HALO, needed=needed, fallback=sharp)
        return usable_defocus(diameter, image)[0]

    def _aperture_blur(self, prepared: PreparedScene) -> ApertureBlur:
        aperture, f_number = self.aperture, prepared.reference.effective_f_number
        assert aperture is not None
        if not aperture.has_map:
            lights = prepared.denoised_lights or (DenoisedLight(prepared.light),)
            opened = partial(self._results.called, "opened", aperture)
            return NetworkApertureBlur(lights[-1], opened, f_number)
        make, shape = partial(self.estimate_defocus, prepared), prepared.light.shape[-2:]
        estimate = partial(self._cached, "defocus_maps", aperture, prepared, make, shape)
        everywhere = prepared.tolerance == 0.0
        return MapApertureBlur(prepared.light, estimate, f_number, everywhere=everywhere)

    def _denoised(self, noise: NoiseModule, prepared: PreparedScene) -> DenoisedLight:
        """`denoise` when it is first needed, cached."""
        pixels, make = prepared.light[0].numel(), partial(self.denoise, prepared, noise)
        rounds = self._precision_of(noise, prepared) == "bfloat16"
        return DenoisedLight(
            lambda: self._cached("denoised", noise, prepared, make, prepared.light.shape),
            name=noise.preset,
            residual=noise.residual,
            rounding=_ROUNDING.get(noise.preset) if rounds else None,
            operations=noise.operations * pixels,
            seconds=lambda: self._seconds_of(noise) * pixels,
            everywhere=prepared.tolerance == 0.0 or not noise.commutes,
        )

    @torch.no_grad()
    def _seconds_of(self, noise: NoiseModule) -> float:
        """Time that a noise module takes for a packed pixel on this machine [s], measured once."""
        if noise.preset not in self._seconds:
            image = torch.zeros(1, 4, _TIMED, _TIMED, device=self.device)
            variance = torch.full((1, 4), 1e-4, device=self.device)

            def run() -> None:
                with self._autocast(self.precision):
                    noise(image, variance, variance).sum().item()

            self._seconds[noise.preset] = min(timeit.repeat(run, number=1, repeat=2)) / _TIMED**2
        return self._seconds[noise.preset]

    def _cached(
        self,
        kind: str,
        module: NoiseModule | ApertureModule,
        prepared: PreparedScene,
        make: Callable[[], torch.Tensor],
        shape: Sequence[int],
    ) -> torch.Tensor:
        """The result of `make`, or that of an earlier call where everything was the same."""
        inputs = {"light": prepared.light, "saturated": prepared.saturated}
        inputs["denoised"] = _for_the_map(prepared)
        return self._results.result(
            kind,
            [module],
            inputs,
            make,
            shape=shape,
            nlf=[prepared.nlf.shot, prepared.nlf.read],
            precision=self._precision_of(module, prepared),
            everywhere=prepared.tolerance == 0,
        )

    def _noise_of(self, prepared: PreparedScene) -> tuple[torch.Tensor, torch.Tensor]:
        shot, read = (torch.tensor([v]) for v in (prepared.nlf.shot, prepared.nlf.read))
        return shot.to(self.device), read.to(self.device)

    def _precision_of(self, module: NoiseModule | ApertureModule, prepared: PreparedScene) -> str:
        """Float32 where bfloat16 would be an error beyond the tolerance."""
        within = BFLOAT16_ERROR.get(module.preset, 0.0) <= prepared.tolerance
        return self.precision if within else "float32"

    def _autocast(self, precision: str) -> torch.autocast:
        enabled = precision == "bfloat16"
        return torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=enabled)

    def plan(
        self,
        source: Source,
        settings: CameraSettings,
        *,
        noise: bool = True,
        tolerance: float | Literal["source"] = "source",
        **scene: Unpack[SceneArguments],
    ) -> SimulationPlan:
        """Steps from `source` to `settings`, why others are left out, error and cost.

        Without `noise`, of the light alone. `tolerance` and the others of `scene`: see `prepare`.
        """
        return self.prepare(source, tolerance=tolerance, **scene).plan(settings, noise=noise)

    @torch.no_grad()
    def stages(
        self,
        source: Source,
        settings: CameraSettings,
        *,
        seed: int = 0,
        image_speed: float | None = None,
        defocus: float | None = None,
        depth: Depth = "unknown",
        lens: str | Vignetting | None = None,
    ) -> Stages:
        """Runs the whole pipeline on one source, every module for this very transition.

        Nothing is left out and nothing shared: this is what `simulate` is an approximation of. The
        presets ``"paper"`` and ``"ncs"`` clip to [0, 1] after the exposure, as the paper does. A
        `ValueError` if this simulator has no networks, or an argument is out of range.

        Args:
            source, image_speed, defocus, depth, lens: See `prepare`.
            settings: Target settings. The aperture module only opens: a smaller aperture than the
                source's leaves its blur.
            seed: Seed of the output's noise.
        """
        noise, aperture = _required("noise", self.noise), _required("aperture", self.aperture)
        check_word("depth", depth, get_args(Depth))
        check_type("settings", settings, CameraSettings)
        sweep_keys(seed, [settings])  # a bad seed raises before any work
        prepared = self._seen(source, image_speed, defocus, lens)
        # A prepared scene may be corrected already; a scene is no recording of this body.
        module = self.exposure if isinstance(source, RawImage) else ExposureModule().to(self.device)
        own = exposure_ratio(prepared.reference, settings)
        ratio = min(prepared.gain * own, RATIO_LIMIT)
        exposed = module(prepared.light[None], ratio)
        if not noise.commutes:
            exposed = exposed.clamp(0.0, 1.0)
        nlf = prepared.nlf.exposed(float(module.w) * ratio)
        shot, read = (torch.tensor([v]).to(exposed) for v in (nlf.shot, nlf.read))
        with self._autocast(self.precision):
            denoised = opened = noise(exposed, shot, read)
            if depth == "unknown" or prepared.aperture_blur is not None:
                deviation = variance_map(smoothed(exposed), shot, read).sqrt()
                f_numbers = (
                    torch.tensor([s.effective_f_number], device=exposed.device)
                    for s in (prepared.reference, settings)
                )
                opened = aperture(denoised, deviation, *f_numbers)
        # What follows has the pattern of the source's sensor already, if that is in its light.
        prnu = prepared.camera.prnu if prepared.nlf.is_zero else 0.0
        seen = replace(
            prepared,
            light=opened[0],
            camera=replace(prepared.camera, prnu=prnu),
            nlf=NoiseLevelFunction.zero(),
            gain=1.0 / own,  # it is exposed already
            denoised_lights=(),  # what networks found out about the scene is not used
            aperture_blur=None,
            tolerance=0.0,
        )
        light, capture = seen.expected(settings), seen.expose([settings], seed=seed)
        return Stages(exposed[0], denoised[0], opened[0], light, capture[0])

    def simulate(
        self,
        source: Source,
        settings: CameraSettings,
        *,
        seed: int = 0,
        noise: Noise = "exact",
        tolerance: float | Literal["source"] | None = "source",
        **scene: Unpack[SceneArguments],
    ) -> RawImage:
        """The raw that the camera would have recorded at `settings`.

        Args:
            source: A raw, a prepared scene, or a scene.
            settings: Target ISO, exposure time and f-number.
            seed: Seed of the noise, >= 0; the same seed gives the same frame.
            noise: ``"exact"`` draws it, ``"bank"`` looks it up, faster, ``"sensor"`` draws it with
                row noise and tails (see `PreparedScene.capture`); the full run knows ``"exact"``.
            tolerance: See `prepare`; None runs every module for this very transition (`stages`),
                and shares and leaves out nothing.
            scene: See `prepare`.

        Returns:
            A raw with the camera's noise at `settings`; ``metadata["excess_noise"]`` and
            ``metadata["clipped_source"]`` declare what could not be made exact.
        """
        check_word("noise", noise, get_args(Noise))
        if tolerance is None and self.noise is not None:
            if noise != "exact":
                raise ValueError(f"`noise` (={noise!r}) needs a `tolerance`: not in the full run")
            scene.setdefault("depth", "far")
            data, excess_noise = self.stages(source, settings, seed=seed, **scene).capture, 0.0
            prepared = prepared_of(source, self.device)
            zero = NoiseLevelFunction.zero()
            clean = replace(prepared, nlf=zero, denoised_lights=(), aperture_blur=None)
            output_noise = clean.output_noise(settings)
        else:  # without networks nothing is shared, and tolerance 0 is the full run
            exact = 0.0 if tolerance is None else tolerance
            prepared = self.prepare(source, tolerance=exact, **scene)
            data, excess_noise = prepared.capture(settings, seed, noise=noise)
            output_noise = prepared.output_noise(settings)
        metadata = dict(source.metadata) if isinstance(source, RawImage) else {}
        metadata |= {
            "simulated_from": str(prepared.reference),
            "seed": seed,
            "excess_noise": excess_noise,
            "clipped_source": prepared.saturated_share,
        }
        return RawImage.from_finite(
            data,
            settings=settings,
            camera=prepared.camera,
            nlf=output_noise,
            white_balance=prepared.white_balance,
            box_factor=prepared.box_factor,
            metadata=metadata,
        )
