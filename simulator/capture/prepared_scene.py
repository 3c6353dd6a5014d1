"""The light of a scene, ready to be exposed at any settings."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import torch

from simulator.camera import CameraProfile, NoiseLevelFunction
from simulator.capture.aperture_blur import ApertureBlur
from simulator.capture.blurred_light import BlurredLight, blur_key
from simulator.capture.denoised import Denoised
from simulator.capture.exposure import (
    DEFAULT_TOLERANCE,
    RATIO_LIMIT,
    Budget,
    Exposure,
    check_tolerance,
)
from simulator.capture.light_statistics import LightStatistics
from simulator.capture.plan import SimulationPlan, make_plan
from simulator.capture.record import exposed_light, noise_balance, record, record_batch
from simulator.noise.generator import FrameNoise, Noise, check_noise, sweep_keys
from simulator.optics.shapes import kernel_energy
from simulator.raw.image import check_packed, new_frame
from simulator.settings import CameraSettings, exposure_ratio

#: Noise below this share of the light is not worth denoising: the networks err as much.
WORTH_DENOISING = 0.006
#: Blurred light of a sweep that may be held at once [byte], to record all of its frames together.
_TOGETHER_BYTES = 2**26


class HasPrepared(Protocol):
    """Anything that can be photographed, such as a scene of the environment."""

    @property
    def prepared(self) -> PreparedScene:
        """Its light."""


@dataclass(frozen=True, eq=False)
class PreparedScene:
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
        denoised: `light` with its noise removed by a noise module, for targets that are cleaner
            than the source; None where there is no such module or no noise.
        opening: Adds the blur of apertures wider than the reference's to a scene whose depth is not
            known; None takes it as far.
        tolerance: How far the distribution of a capture may move by what is left out, in units of
            the target's noise; 0 leaves out only what changes nothing.
        statistics: Of `light`; made here, and shared by copies with that light.
        optics: Blurs the light and keeps what it has blurred; made here, and shared likewise.
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
    denoised: Denoised | None = None
    aperture_blur: ApertureBlur | None = None
    tolerance: float = DEFAULT_TOLERANCE
    statistics: LightStatistics = None  # type: ignore[assignment]
    blurred_light: BlurredLight = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        known = self.blurred_light is not None and self.blurred_light.is_of(
            self.light, self.denoised, self.aperture_blur
        )
        if not known:  # a copy's light was checked before
            object.__setattr__(self, "light", check_packed("light", self.light))
        denoised = self.denoised
        if denoised is not None and not isinstance(denoised, Denoised):
            raise ValueError(f"`denoised` (={type(denoised).__name__}) must be Denoised or None")
        if denoised is not None and denoised.shape not in (None, self.light.shape):
            raise ValueError(
                f"`denoised` (shape {tuple(denoised.shape)}) must have the shape of `light`, "
                f"{tuple(self.light.shape)}"
            )
        for name in ("image_speed", "defocus", "gain"):
            value = getattr(self, name)
            if not 0.0 <= value < float("inf"):
                raise ValueError(f"`{name}` (={value!r}) must be finite and >= 0")
        object.__setattr__(self, "tolerance", check_tolerance(self.tolerance))
        if self.statistics is None or self.statistics.light is not self.light:
            object.__setattr__(self, "statistics", LightStatistics(self.light))
        if not known:
            object.__setattr__(
                self, "blurred_light", BlurredLight(self.light, self.denoised, self.aperture_blur)
            )

    def exposure(self, settings: CameraSettings, *, noise: bool = True) -> Exposure:
        """What a capture at `settings` does to this light, and what `tolerance` leaves out of it.

        Tens of microseconds: what must be known of the light is in `statistics`, and kept.

        Args:
            settings: Settings to simulate.
            noise: Whether the capture will be noisy; if not, noise of the source cannot count as
                part of the target's.
        """
        if not isinstance(settings, CameraSettings):
            raise ValueError(f"`settings` (={settings!r}) must be CameraSettings")
        f_number = settings.effective_f_number
        ratio = min(self.gain * exposure_ratio(self.reference, settings), RATIO_LIMIT)
        target = _averaged_nlf(self.camera, settings.iso, self.box_factor)
        budget = Budget(self.tolerance)
        added_px = self.blurred_light.added_blur(f_number)
        denoised = self._denoises(ratio, target, added_px, budget, noise=noise)

        def kept(name: str, extent: float) -> float:
            """`extent` of a disc or of a streak, 0 where it may be left out."""
            if not extent:
                return 0.0
            error = self._blur_error(ratio, target, name, extent, denoised)
            return 0.0 if budget.leaves_out_blur(name, error) else extent

        opened_to = f_number if kept("aperture", added_px) else None
        defocus_px = kept("defocus", self.defocus * 4.0 / f_number)
        motion_px = kept(
            "motion_blur", self.image_speed * settings.exposure_time * self.light.shape[-2]
        )
        remaining = None
        known = denoised or self.nlf.is_zero
        if opened_to is not None and not known:
            # Noise that one blur has smeared is correlated: a second, smaller one hardly averages
            # it further. Both together leave about what the larger leaves alone.
            remaining = self.blurred_light.remaining(
                opened_to, kernel_energy(motion_px, defocus_px)
            )
        return Exposure(
            ratio=ratio,
            source=NoiseLevelFunction.zero() if denoised else self.nlf,
            target=target,
            motion_px=motion_px,
            defocus_px=defocus_px,
            denoised=denoised,
            opened_to=opened_to,
            remaining=remaining,
            errors=budget.errors,
        )

    def _denoises(
        self,
        ratio: float,
        target: NoiseLevelFunction,
        added_px: float,
        budget: Budget,
        *,
        noise: bool,
    ) -> bool:
        """Whether the noise-reduced light is needed; `noise` as in `exposure`."""
        if self.denoised is None or self.nlf.is_zero:
            return False
        left = self.statistics.excess if noise else self.statistics.relative_noise
        error = left(ratio, self.nlf, target)
        # Blur averages noise, too. That is not counted on: it may be left out itself.
        if self.aperture_blur is not None and self.aperture_blur.needs_denoised and added_px:
            budget.errors["noise_reduction"] = error
            return True
        return not budget.leaves_out_noise_reduction(error, pointless=not self.is_noisy)

    def _blur_error(
        self, ratio: float, target: NoiseLevelFunction, name: str, extent: float, denoised: bool
    ) -> float:
        if self.tolerance == 0.0 or extent == math.inf:  # it is applied in any case
            return math.inf
        streak = name == "motion_blur"
        return float(
            self.statistics_of(denoised).blur_error(
                ratio, target, motion_px=extent * streak, disc_px=extent * (not streak)
            )
        )

    def statistics_of(self, denoised: bool) -> LightStatistics:
        """Of the light that a transition starts from, denoised or as it was recorded."""
        return self.denoised.statistics if denoised and self.denoised else self.statistics

    @cached_property
    def is_noisy(self) -> bool:
        """Whether the noise is more than `WORTH_DENOISING` of the light, at its median level."""
        signal = self.statistics.median
        deviation = np.sqrt(np.array(self.nlf.read) + np.array(self.nlf.shot) * signal)
        return bool((deviation > WORTH_DENOISING * signal).any())

    def source_light(self, exposure: Exposure) -> torch.Tensor:
        """The light (4, H, W) that `exposure` starts from, still at the reference's exposure."""
        return self.blurred_light.source(exposure)

    def output_noise(self, settings: CameraSettings) -> NoiseLevelFunction:
        """Noise of a native pixel of the capture: the camera's, or the source's where that is more.

        Shot and read noise are compared apart, so that a mixed case is stated too high rather than
        too low.
        """
        exposure = self.exposure(settings)
        source = exposure.source_noise.scaled(float(self.box_factor**2))
        return self.camera.nlf(settings.iso).at_least(source)

    def plan(self, settings: CameraSettings, *, noise: bool = True) -> SimulationPlan:
        """Steps, reasons, predicted error and cost of a capture at `settings`.

        Args:
            settings: Settings to simulate.
            noise: False plans `expected`, the light without noise, instead of a capture.
        """
        return make_plan(self, settings, noise=noise)

    def expected(self, settings: CameraSettings) -> torch.Tensor:
        """Noise-free light on the sensor at `settings`, (4, H, W), blurred and not clipped."""
        exposure = self.exposure(settings, noise=False)
        return exposed_light(self.blurred_light.blurred(exposure), exposure)

    def capture(
        self, settings: CameraSettings, seed: int = 0, *, noise: Noise = "exact"
    ) -> tuple[torch.Tensor, float]:
        """One simulated capture.

        The noise is a function of `seed` and of `settings`: the same frame comes back alone or in
        a sweep, and the frames of a sweep are independent.

        Args:
            settings: Settings to simulate.
            seed: Seed of the noise, >= 0.
            noise: ``"exact"`` draws it, ``"bank"`` looks it up (`simulator.noise.generator`).

        Returns:
            (4, H, W) float32 in [-pedestal, 1], and its excess noise (see `SimulationPlan`).
        """
        exposure = self.exposure(settings)
        (frame,) = self.expose([settings], seed=seed, noise=noise)
        return frame, noise_balance(self.blurred_light.blurred(exposure), exposure).relative_excess

    def expose(
        self,
        states: Iterable[CameraSettings],
        *,
        seed: int = 0,
        noise: Noise = "exact",
        out: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """A sweep: one capture per state, (S, 4, H, W) float32.

        States that share their blur follow each other, so that none is computed twice; the order
        of `states` is kept in the result.

        Args:
            states: Settings to simulate.
            seed: See `capture`.
            noise: See `capture`.
            out: (S, 4, H, W) contiguous float32 to write to, instead of new memory.
        """
        check_noise(noise)
        states = list(states) if isinstance(states, Iterable) else states
        if not isinstance(states, list) or not all(isinstance(s, CameraSettings) for s in states):
            raise ValueError(f"`states` (={states!r}) must be several CameraSettings")
        frames = self._frames(len(states), out)
        keys = sweep_keys(seed, states)  # a bad seed is told before any work
        exposures = [self.exposure(settings) for settings in states]
        groups: dict[tuple[object, ...], list[int]] = {}
        for index, exposure in enumerate(exposures):
            groups.setdefault(blur_key(exposure), []).append(index)
        if len(groups) * self.light.nbytes <= _TOGETHER_BYTES and self.light.device.type == "cpu":
            lights = [self.blurred_light.blurred(exposure) for exposure in exposures]
            record_batch(lights, exposures, self.camera, keys, noise, out=frames)
            return frames
        for i in itertools.chain.from_iterable(groups.values()):
            light, drawn = self.blurred_light.blurred(exposures[i]), FrameNoise(int(keys[i]), noise)
            record(light, exposures[i], self.camera, drawn, out=frames[i])
        return frames

    def _frames(self, count: int, given: torch.Tensor | None) -> torch.Tensor:
        """Memory for `count` frames, `given` if that fits."""
        wanted = self.light.expand(count, *self.light.shape)
        if given is None:
            return new_frame(wanted)
        if not isinstance(given, torch.Tensor):
            raise ValueError(f"`out` (={type(given).__name__}) must be a torch tensor")
        if given.untyped_storage().data_ptr() == self.light.untyped_storage().data_ptr():
            raise ValueError("`out` must not be the memory of the light that is exposed")
        if (
            given.shape != wanted.shape
            or (given.dtype, given.device) != (torch.float32, wanted.device)
            or not given.is_contiguous()
            or given.requires_grad
        ):
            raise ValueError(
                f"`out` ({given.dtype}, shape {tuple(given.shape)}, on {given.device}) must be "
                f"contiguous float32 {tuple(wanted.shape)} on {wanted.device}, without gradient"
            )
        return given

    def stream(
        self, states: Iterable[CameraSettings], *, seed: int = 0, noise: Noise = "exact"
    ) -> Iterator[torch.Tensor]:
        """The sweep one capture (4, H, W) at a time, for frames too large to hold all at once.

        A state is asked for when its frame is: the next one may depend on the last frame.

        Args:
            states: Settings to simulate.
            seed: See `capture`.
            noise: See `capture`.

        Yields:
            One capture (4, H, W) per state.
        """
        for settings in states:
            yield self.expose([settings], seed=seed, noise=noise)[0]


@functools.lru_cache(maxsize=4096)
def _averaged_nlf(camera: CameraProfile, iso: float, box_factor: int) -> NoiseLevelFunction:
    """Noise of `box_factor` squared sensor pixels averaged."""
    return camera.nlf(iso).scaled(1.0 / box_factor**2)
