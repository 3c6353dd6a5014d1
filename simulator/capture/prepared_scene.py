"""The light of a scene, ready to be exposed at any settings."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from numbers import Real
from typing import Any, Protocol, cast

import numpy as np
import torch

from simulator.camera import CameraProfile
from simulator.capture.blurred_light import ApertureBlur, BlurredLight
from simulator.capture.denoised import Denoised
from simulator.capture.exposure import RATIO_LIMIT, Exposure
from simulator.capture.layout import Layout
from simulator.capture.light_statistics import LightStatistics
from simulator.capture.plan import (
    DEFAULT_TOLERANCE,
    DEPTH_ERROR,
    KEPT_BLUR_ERROR,
    MISSED_BLUR,
    SimulationPlan,
    Situation,
    check_tolerance,
    decide,
    make_plan,
)
from simulator.capture.scene_blur import remaining_noise
from simulator.capture.sensor import Transitions, exposed_light, noise_balance, record
from simulator.noise.generator import Noise, check_noise, sweep_keys
from simulator.noise.noise_level_function import NoiseLevelFunction, noise_variance
from simulator.noise.read_noise import ReadNoise
from simulator.optics.motion_path import ALONG_ROWS, Movement
from simulator.optics.shapes import kernel_energy
from simulator.raw.image import check_packed, new_frame
from simulator.settings import CameraSettings, exposure_ratio

#: Blurred light of a sweep that may be held at once [byte], to record all of its frames together.
_TOGETHER_BYTES = 2**26
#: Fastest image [frame heights per second]: even 1/1000 s smears it over the whole frame.
MAX_IMAGE_SPEED = 1000.0
#: Discs of defocus may be as wide as the frame, on small frames this wide [pixel]: the memory that
#: a blur takes grows with the square of it.
MAX_DISC_PX = 512.0


class HasPrepared(Protocol):
    """Anything that can be photographed, such as a scene of the environment."""

    @property
    def prepared(self) -> PreparedScene:
        """Its light."""


@dataclass(frozen=True, eq=False, repr=False)
class PreparedScene:
    """Light of a scene at reference settings, ready to be exposed at any others.

    Args:
        light: (4, H, W) float32, linear, not clipped: above 1 where highlights are known.
        reference: Settings at which `light` is on the scale where sensor white is 1.
        camera: The body that takes the captures.
        nlf: Noise left in `light`, at the reference settings.
        saturated: (H, W) bool, pixels that were white in the source: their light is a guess; None
            if there are none.
        white_balance: Gains of R, G, B of the scene's light.
        box_factor: Sensor pixels averaged per side into one pixel of `light`.
        image_speed: Speed of the image [frame heights per second], at most 1000; along the rows,
            unless `movement` says otherwise.
        defocus: Diameter of the defocus disc at f/4 [pixel of `light`], with a `layout` that of the
            largest; 0 for a scene that is far or in focus throughout. No disc may be wider than
            both the frame and 512 pixel; with a `layout`, it stays at 32.
        movement: In which directions the image moves, and the subject of `layout` of its own.
        layout: What is out of focus, and what is the subject; None for one disc everywhere.
        gain: Light relative to `light`, where it changes over time.
        denoised: `light` with its noise removed by each noise module, the cheapest first, for
            targets that are cleaner than the source; none where there is no module or no noise.
        aperture_blur: Adds the blur of apertures wider than the reference's to a scene whose depth
            is not known; None takes it as far.
        tolerance: Error that a capture may have, in units of the target's noise: the cheapest
            steps that keep it are taken, or else, as at 0, those with the least error.
        blurred_light: Blurs the light and caches what it has blurred. It is made here, and copies
            with the same light (`dataclasses.replace`) share it.
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
    denoised: tuple[Denoised, ...] = ()
    aperture_blur: ApertureBlur | None = None
    movement: Movement = ALONG_ROWS
    layout: Layout | None = None
    tolerance: float = DEFAULT_TOLERANCE
    blurred_light: BlurredLight = field(default=cast(BlurredLight, None))

    def __post_init__(self) -> None:
        cached = cast(BlurredLight | None, self.blurred_light)
        if cached is None or not cached.is_of(
            self.light, self.denoised, self.nlf, self.aperture_blur
        ):
            same_light = cached is not None and cached.light is self.light
            if not same_light:  # a copy's light was checked before
                object.__setattr__(self, "light", check_packed("light", self.light))
            self._check_denoised()
            statistics = cached.statistics if cached is not None and same_light else None
            lights = BlurredLight(
                self.light, self.denoised, self.nlf, self.aperture_blur, statistics
            )
            object.__setattr__(self, "blurred_light", lights)
        for name in ("image_speed", "defocus", "gain"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, Real):
                raise ValueError(f"`{name}` (={value!r}) must be a number")
        if not 0.0 <= self.image_speed <= MAX_IMAGE_SPEED:
            raise ValueError(
                f"`image_speed` (={self.image_speed!r}) must be in [0, {MAX_IMAGE_SPEED:g}] frame "
                "heights per second"
            )
        if not self.defocus >= 0.0:
            raise ValueError(f"`defocus` (={self.defocus!r}) must be finite and >= 0")
        self._disc(4.0)
        if not 0.0 <= self.gain < float("inf"):
            raise ValueError(f"`gain` (={self.gain!r}) must be finite and >= 0")
        if self.layout is not None and self.layout.defocus.shape != self.light.shape[-2:]:
            raise ValueError(
                f"`layout` (shape {tuple(self.layout.defocus.shape)}) must have the height and "
                f"width of `light`, {tuple(self.light.shape[-2:])}"
            )
        object.__setattr__(self, "tolerance", check_tolerance(self.tolerance))

    def _check_denoised(self) -> None:
        for denoised in self.denoised:
            if not isinstance(denoised, Denoised):
                raise ValueError(f"`denoised` (={type(denoised).__name__}) must be Denoised")
            if denoised.shape not in (None, self.light.shape):
                raise ValueError(
                    f"`denoised` (shape {tuple(denoised.shape)}) must have the shape of `light`, "
                    f"{tuple(self.light.shape)}"
                )

    def __repr__(self) -> str:
        _, height, width = self.light.shape
        return f"PreparedScene({height} x {width} packed, {self.reference}, {self.camera.name})"

    @property
    def statistics(self) -> LightStatistics:
        """Statistics of `light`."""
        return self.blurred_light.statistics

    @property
    def saturated_share(self) -> float:
        """Share of the pixels that are saturated in the source."""
        marks = self.saturated
        return 0.0 if marks is None else int(marks.count_nonzero()) / marks.numel()

    # -- what a change of settings takes ------------------------------------------------------

    def exposure(
        self, settings: CameraSettings, *, noise: bool = True, gain: float = 1.0
    ) -> Exposure:
        """Exposure of a capture at `settings`, without the steps that `tolerance` leaves out.

        Tens of microseconds: the statistics of the light are worked out once.

        Args:
            settings: Settings to simulate.
            noise: Whether the capture will be noisy; if not, noise of the source cannot count as
                part of the target's.
            gain: Light relative to this scene's.
        """
        return self._exposure(settings, self._situation(settings, noise, gain))

    def _situation(self, settings: CameraSettings, noise: bool, gain: float) -> Situation:
        if not isinstance(settings, CameraSettings):
            raise ValueError(f"`settings` (={settings!r}) must be CameraSettings")
        f_number = settings.effective_f_number
        defocus_px = motion_px = 0.0  # where there is none, this is called in sweeps for each state
        if self.defocus:
            defocus_px = self._disc(f_number)
        if self.image_speed or self._subject_moves:
            motion_px = self._motion(settings)
        aperture_px, opens, opens_denoised = None, False, False
        if self.aperture_blur is not None:
            aperture_px = self.blurred_light.added_blur(f_number)
            opens = f_number < self.aperture_blur.f_number
            opens_denoised = self.aperture_blur.needs_denoised
        return Situation(
            min(self.gain * gain * exposure_ratio(self.reference, settings), RATIO_LIMIT),
            self.nlf,
            _averaged_nlf(self.camera, settings.iso, self.box_factor),
            self.tolerance,
            noise,
            self.blurred_light.statistics,
            self.blurred_light.residuals,
            self.denoised,
            defocus_px,
            motion_px,
            aperture_px,
            opens,
            opens_denoised,
            self.movement.along_rows and not self._subject_moves,
        )

    @property
    def _subject_moves(self) -> bool:
        """Whether there is a subject that moves apart from the rest."""
        subject = None if self.layout is None else self.layout.subject
        return subject is not None and self.movement.subject_speed > 0.0

    def _motion(self, settings: CameraSettings) -> float:
        """Length of the longest path at `settings` [pixel]."""
        height = self.light.shape[-2]
        length = self.image_speed * settings.exposure_time * height
        if not self._subject_moves:
            return length
        own = self.movement.subject_path(self.image_speed, settings.exposure_time, height)
        return max(length, own.length)

    def _disc(self, f_number: float) -> float:
        """Diameter of the defocus disc at `f_number` [pixel]."""
        diameter = self.defocus * 4.0 / f_number
        if diameter > MAX_DISC_PX and diameter > max(self.light.shape[-2:]):
            most = max(*self.light.shape[-2:], MAX_DISC_PX)
            raise ValueError(
                f"`defocus` (={self.defocus!r} pixel at f/4) makes a disc of {diameter:.4g} pixel "
                f"at f/{f_number:.3g}: it must be at most {most:g} pixel, as wide as the frame "
                f"({MAX_DISC_PX:g} on smaller ones)"
            )
        return diameter

    def _exposure(self, settings: CameraSettings, given: Situation) -> Exposure:
        steps = noise_reduction, aperture, defocus, motion_blur = decide(given)
        defocus_px = defocus.extent if defocus.runs else 0.0
        motion_px = motion_blur.extent if motion_blur.runs else 0.0
        opened_to = settings.effective_f_number if aperture.runs else None
        denoised = noise_reduction.network
        exposure = Exposure(
            ratio=given.ratio,
            source=self.nlf if denoised is None else NoiseLevelFunction.zero(),
            target=given.target,
            motion_px=motion_px,
            defocus_px=defocus_px,
            denoised=denoised,
            opened_to=opened_to,
            steps=steps,
            **self._paths(settings, motion_px, defocus_px),
        )
        if exposure.source.is_zero:
            return exposure
        return self._with_remaining_noise(exposure)

    def _paths(
        self, settings: CameraSettings, motion_px: float, defocus_px: float
    ) -> dict[str, Any]:
        """Layout and paths of an exposure that has these blurs; what it does not need is None."""
        if not motion_px and (self.layout is None or not defocus_px):
            return {}
        given = self.image_speed, settings.exposure_time, self.light.shape[-2]
        own = motion_px > 0.0 and self._subject_moves
        follows = motion_px > 0.0 and (own or not self.movement.along_rows)
        return {
            "layout": self.layout if own or defocus_px else None,
            "path": self.movement.path(*given) if follows else None,
            "subject_path": self.movement.subject_path(*given) if own else None,
        }

    def _with_remaining_noise(self, exposure: Exposure) -> Exposure:
        """`exposure` with the shares of the source's noise variance that its blurs leave."""
        left: torch.Tensor | None = None
        if exposure.is_uniform:
            energy = kernel_energy(exposure.motion_px, exposure.defocus_px)
        else:
            energy, left = remaining_noise(exposure, *self.light.shape[-2:])
            left = None if left is None else left.to(self.light.device)
        if exposure.opened_to is not None:
            # Noise that one blur has smeared is correlated: a second, smaller one hardly averages
            # it further. Both together leave about what the larger leaves alone.
            opened = self.blurred_light.remaining_variance(exposure.opened_to, energy)
            if left is None or opened is None:
                left = opened if left is None else left
            else:
                left = torch.minimum(left, opened)
        return replace(exposure, energy=energy, remaining_variance=left)

    def plan(
        self, settings: CameraSettings, *, noise: bool = True, gain: float = 1.0
    ) -> SimulationPlan:
        """Steps, reasons, predicted error and cost of a capture at `settings`.

        Args:
            settings: Settings to simulate.
            noise: False plans `expected`, the light without noise, instead of a capture.
            gain: Light relative to this scene's.
        """
        given = self._situation(settings, noise, gain)
        exposure = self._exposure(settings, given)
        # A clean source lacks all of the noise: its light need not be made to see that.
        light = self.light if exposure.source.is_zero else self.source_light(exposure)
        balance = noise_balance(light, exposure)
        depth = self._depth_error(settings, exposure, noise)
        return make_plan(settings, exposure, given, balance, self.saturated_share, depth)

    def _depth_error(self, settings: CameraSettings, exposure: Exposure, noise: bool) -> float:
        """Error due to a depth that is not known, in units of the target's noise.

        Where noise is wanted it is that of a capture, in which white is white.
        """
        blur = self.aperture_blur
        if blur is None or settings.effective_f_number == blur.f_number:  # no map is needed
            return 0.0
        wider = (blur.f_number / settings.effective_f_number) ** 2
        noises = self.nlf, exposure.target
        disc = self.statistics.blur_change(exposure.ratio, *noises, noise=noise)
        if wider <= 1.0:  # what a smaller aperture would sharpen stays blurred
            return KEPT_BLUR_ERROR * disc * blur.mean_square_diameter * (1.0 - wider)
        missed = disc * MISSED_BLUR**2 * (wider - 1.0)
        return math.hypot(missed, DEPTH_ERROR * self._added_blur(exposure, noise))

    def _added_blur(self, exposure: Exposure, noise: bool) -> float:
        """What the blur of the opening aperture changes, in units of the target's noise."""
        if exposure.opened_to is None:
            return 0.0
        light = self.light if exposure.denoised is None else exposure.denoised.light
        lights, white = (light, self.source_light(exposure)), 1.0 if noise else float("inf")
        sharp, opened = ((part * exposure.ratio).clamp_(max=white) for part in lights)
        wanted = noise_variance(sharp, exposure.target).clamp_(min=1e-30)
        return float(((opened - sharp).square_() / wanted).double().mean().sqrt())

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

    def read_noise(self, settings: CameraSettings) -> ReadNoise:
        """Rows and tails of the read noise of a capture.

        Raises:
            ValueError: If the camera has no calibration of them.
        """
        return self.camera.read_noise(settings.iso, self.box_factor)

    # -- captures -----------------------------------------------------------------------------

    def expected(self, settings: CameraSettings, *, gain: float = 1.0) -> torch.Tensor:
        """Noise-free light on the sensor at `settings`, (4, H, W), blurred and not clipped.

        Args:
            settings: Settings to simulate.
            gain: Light relative to this scene's.
        """
        exposure = self.exposure(settings, noise=False, gain=gain)
        return exposed_light(self.blurred_light.blurred(exposure), exposure)

    def expected_sweep(
        self,
        states: Sequence[CameraSettings],
        *,
        gain: np.ndarray | None = None,
        row_gain: np.ndarray | None = None,
    ) -> torch.Tensor:
        """`expected` at each state, (S, 4, H, W); arguments of `expose`."""
        gains = np.ones(len(states)) if gain is None else gain
        pairs = zip(states, gains.tolist(), strict=True)
        light = torch.stack([self.expected(s, gain=g) for s, g in pairs])
        if row_gain is None:
            return light
        return light * torch.from_numpy(row_gain).to(light)[:, None, :, None]

    def capture(
        self, settings: CameraSettings, seed: int = 0, *, noise: Noise = "exact"
    ) -> tuple[torch.Tensor, float]:
        """One simulated capture.

        The noise is a function of `seed` and of `settings`: the same frame comes back alone or in
        a sweep, and the frames of a sweep are independent.

        Args:
            settings: Settings to simulate.
            seed: Seed of the noise, >= 0.
            noise: ``"exact"`` draws it, ``"bank"`` looks it up (`simulator.noise.generator`),
                ``"sensor"`` draws it with the camera's row noise and the tails of its read noise
                (`CameraProfile.read_noise`).

        Returns:
            (4, H, W) float32 in [-pedestal, 1], and its excess noise (see `SimulationPlan`).
        """
        exposure = self.exposure(settings)
        (frame,) = self.expose([settings], seed=seed, noise=noise)
        balance = noise_balance(self.blurred_light.blurred(exposure), exposure)
        return frame, balance.relative_excess_variance

    def expose(
        self,
        states: Iterable[CameraSettings],
        *,
        seed: int = 0,
        noise: Noise = "exact",
        gain: np.ndarray | None = None,
        row_gain: np.ndarray | None = None,
        out: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """A sweep: one capture per state, (S, 4, H, W) float32.

        States that share their blur follow each other, so that none is computed twice; the order
        of `states` stays in the result.

        Args:
            states: Settings to simulate.
            seed: See `capture`.
            noise: See `capture`.
            gain: (S,) light of each state relative to this scene's, where it depends on the
                exposure time, as flickering light does; None for the same.
            row_gain: (S, H) light of each row relative to that; None where all rows have the same.
            out: (S, 4, H, W) contiguous float32 to write to, instead of new memory.
        """
        check_noise(noise)
        states = list(states) if isinstance(states, Iterable) else states
        if not isinstance(states, list) or not all(isinstance(s, CameraSettings) for s in states):
            raise ValueError(f"`states` (={states!r}) must be several CameraSettings")
        frames = self._frames(len(states), out)
        keys = sweep_keys(seed, states)  # a bad seed raises before any work
        read_noise = [self.read_noise(s) for s in states] if noise == "sensor" else None
        gains = np.ones(len(states)) if gain is None else gain
        exposures = [self.exposure(s, gain=g) for s, g in zip(states, gains.tolist(), strict=True)]
        groups: dict[tuple[object, ...], list[int]] = {}
        for index, exposure in enumerate(exposures):
            groups.setdefault(exposure.blur, []).append(index)
        parts = [slice(0, len(states))]
        if len(groups) * self.light.nbytes > _TOGETHER_BYTES:
            parts = [slice(i, i + 1) for group in groups.values() for i in group]
        for some in parts:
            chosen = exposures[some]
            lights = [self.blurred_light.blurred(exposure) for exposure in chosen]
            transitions = Transitions.of(lights, chosen)
            record(
                transitions,
                self.camera,
                keys=keys[some] if transitions.lacks_noise else None,
                noise=noise,
                read_noise=None if read_noise is None else read_noise[some],
                row_gain=None if row_gain is None else row_gain[some],
                signals=frames[some],
            )
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
