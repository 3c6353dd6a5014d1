"""The light of a scene, ready to be exposed at any settings."""

from __future__ import annotations

import copy
import functools
import math
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, cast

import numpy as np
import torch

from simulator.camera import CameraProfile
from simulator.capture.blurred_light import ApertureBlur, BlurredLight
from simulator.capture.exposure import (
    RATIO_LIMIT,
    Exposure,
    TransitionInputs,
    decide,
    predict_errors,
)
from simulator.capture.layout import Layout
from simulator.capture.plan import DEFAULT_TOLERANCE, SimulationPlan, check_tolerance
from simulator.capture.sensor import Transitions, exposed_light, noise_balance, record
from simulator.capture.statistics import DenoisedLight, LightStatistics
from simulator.noise.generator import Noise, check_noise, sweep_keys
from simulator.noise.noise_level_function import NoiseLevelFunction, ReadNoise, noise_variance
from simulator.optics.motion import ALONG_ROWS, Movement, Path
from simulator.raw.image import check_packed, new_frame
from simulator.settings import CameraSettings, exposure_ratio
from simulator.utils.checks import check_number

#: Blurred light of a sweep that may be held at once [byte], to record all of its frames together.
_TOGETHER_BYTES = 2**26
#: Fastest image [frame heights per second]: even 1/1000 s smears it over the whole frame.
MAX_IMAGE_SPEED = 1000.0
#: Discs of defocus may be as wide as the frame, on small frames this wide [pixel]: the memory that
#: a blur takes grows with the square of it.
MAX_DISC_PX = 512.0
#: Errors of the estimated map of defocus: its relative error of the blur that it adds, the blur
#: that it cannot see [pixel of diameter], and the factor by which what a blurred picture changes
#: when it is blurred again understates what it would change if it were sharpened.
DEPTH_ERROR, MISSED_BLUR, KEPT_BLUR_ERROR = 0.6, 0.7, 3.0


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
        denoised_lights: `light` with its noise removed by each noise module, the cheapest first,
            for targets that are cleaner than the source; none where there is no module or no noise.
        aperture_blur: Adds the blur of apertures wider than the reference's to a scene whose depth
            is not known; None takes it as far.
        tolerance: Error that a capture may have, in units of the target's noise: the cheapest
            steps that keep it are taken, or else, as at 0, those with the least error.
        blurred_light: Blurs the light and caches what it has blurred. It is made here, and copies
            with the same light (`dataclasses.replace`) share it.

    Raises:
        ValueError: If a value has the wrong shape or lies outside its range.
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
    denoised_lights: tuple[DenoisedLight, ...] = ()
    aperture_blur: ApertureBlur | None = None
    movement: Movement = ALONG_ROWS
    layout: Layout | None = None
    tolerance: float = DEFAULT_TOLERANCE
    blurred_light: BlurredLight = field(default=cast(BlurredLight, None))

    def __post_init__(self) -> None:
        cached = cast(BlurredLight | None, self.blurred_light)
        known = self.denoised_lights, self.nlf, self.aperture_blur
        if cached is None or not cached.is_of(self.light, *known):
            same_light = cached is not None and cached.light is self.light
            if not same_light:  # a copy's light was checked before
                object.__setattr__(self, "light", check_packed("light", self.light))
            for denoised in self.denoised_lights:
                if not isinstance(denoised, DenoisedLight):
                    found = type(denoised).__name__
                    raise ValueError(f"`denoised_lights` (={found}) must be DenoisedLight")
                if denoised.shape not in (None, self.light.shape):
                    raise ValueError(
                        f"`denoised_lights` (shape {tuple(denoised.shape)}) must have the shape of "
                        f"`light`, {tuple(self.light.shape)}"
                    )
            statistics = cached.statistics if cached is not None and same_light else None
            lights = BlurredLight(self.light, *known, statistics)
            object.__setattr__(self, "blurred_light", lights)
        unit = " frame heights per second"
        check_number("image_speed", self.image_speed, 0.0, MAX_IMAGE_SPEED, more=unit)
        check_number("defocus", self.defocus, 0.0, math.inf)
        self._disc(4.0)
        check_number("gain", self.gain, 0.0, sys.float_info.max)
        if self.layout is not None and self.layout.defocus.shape != self.light.shape[-2:]:
            raise ValueError(
                f"`layout` (shape {tuple(self.layout.defocus.shape)}) must have the height and "
                f"width of `light`, {tuple(self.light.shape[-2:])}"
            )
        object.__setattr__(self, "tolerance", check_tolerance(self.tolerance))

    def changed(self, **values: Any) -> PreparedScene:
        """A copy of the same light with other values, which are known to be right.

        Nothing is checked, as `dataclasses.replace` would: an environment makes one an episode.
        """
        copied = copy.copy(self)
        vars(copied).update(values)
        return copied

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
        exposure = decide(self._inputs(settings, noise, gain))
        if exposure.source.is_zero:
            return exposure
        return self.blurred_light.with_remaining_noise(exposure)

    def _inputs(self, settings: CameraSettings, noise: bool, gain: float) -> TransitionInputs:
        if not isinstance(settings, CameraSettings):
            raise ValueError(f"`settings` (={settings!r}) must be CameraSettings")
        f_number, blur = settings.effective_f_number, self.aperture_blur
        motion_px, path, subject_path = 0.0, None, None
        if self.image_speed or self._subject_moves:
            motion_px, path, subject_path = self._motion(settings.exposure_time)
        return TransitionInputs(
            ratio=min(self.gain * gain * exposure_ratio(self.reference, settings), RATIO_LIMIT),
            source=self.nlf,
            target=_averaged_nlf(self.camera, settings.iso, self.box_factor),
            tolerance=self.tolerance,
            noise=noise,
            statistics=self.blurred_light.statistics,
            residuals=self.blurred_light.residuals,
            networks=self.denoised_lights,
            defocus_px=self._disc(f_number) if self.defocus else 0.0,
            motion_px=motion_px,
            layout=self.layout,
            path=path,
            subject_path=subject_path,
            f_number=f_number,
            aperture_px=None if blur is None else blur.extent(f_number),
            opens=blur is not None and f_number < blur.f_number,
            opens_denoised=blur is not None and blur.needs_denoised,
        )

    @property
    def _subject_moves(self) -> bool:
        """Whether there is a subject that moves apart from the rest."""
        subject = None if self.layout is None else self.layout.subject
        return subject is not None and self.movement.subject_speed > 0.0

    def _motion(self, time: float) -> tuple[float, Path | None, Path | None]:
        """Length of the longest path in an exposure [pixel], and both paths.

        That of the background is None for a streak along the rows, that of the subject where it
        does not move on its own.
        """
        moment = self.image_speed, time, self.light.shape[-2]
        length = self.image_speed * time * self.light.shape[-2]
        if self._subject_moves:
            own = self.movement.subject_path(*moment)
            return max(length, own.length), self.movement.path(*moment), own
        return length, None if self.movement.along_rows else self.movement.path(*moment), None

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

    def plan(
        self, settings: CameraSettings, *, noise: bool = True, gain: float = 1.0
    ) -> SimulationPlan:
        """Steps, reasons, predicted error and cost of a capture at `settings`.

        Args:
            settings: Settings to simulate.
            noise: False plans `expected`, the light without noise, instead of a capture.
            gain: Light relative to this scene's.
        """
        exposure = self.exposure(settings, noise=noise, gain=gain)
        # A clean source lacks all of the noise: its light need not be made to see that.
        light = self.light if exposure.source.is_zero else self.blurred_light.source(exposure)
        return SimulationPlan(
            settings=settings,
            exposure=exposure,
            errors=self.predicted_errors(settings, exposure),
            balance=noise_balance(light, exposure),
            clipped_source=self.saturated_share,
        )

    def predicted_errors(self, settings: CameraSettings, exposure: Exposure) -> dict[str, float]:
        """`SimulationPlan.errors` of the exposure that `exposure` returned for `settings`."""
        noise = exposure.inputs is None or exposure.inputs.noise
        depth = self._depth_error(settings, exposure, noise)
        return predict_errors(exposure, self.saturated_share, depth)

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
        lights, white = (light, self.blurred_light.source(exposure)), 1.0 if noise else float("inf")
        sharp, opened = ((part * exposure.ratio).clamp_(max=white) for part in lights)
        wanted = noise_variance(sharp, exposure.target).clamp_(min=1e-30)
        return float(((opened - sharp).square_() / wanted).double().mean().sqrt())

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

    def _frames(self, count: int, out: torch.Tensor | None) -> torch.Tensor:
        """Memory for `count` frames, `out` if that fits."""
        wanted = self.light.expand(count, *self.light.shape)
        if out is None:
            return new_frame(wanted)
        fits = isinstance(out, torch.Tensor) and out.shape == wanted.shape
        fits = fits and (out.dtype, out.device) == (torch.float32, wanted.device)
        if not fits or not out.is_contiguous() or out.requires_grad:
            raise ValueError(
                f"`out` (={type(out).__name__}) must be a contiguous float32 tensor of shape "
                f"{tuple(wanted.shape)} on {wanted.device}, without gradient"
            )
        if out.untyped_storage().data_ptr() == self.light.untyped_storage().data_ptr():
            raise ValueError("`out` must not be the memory of the light that is exposed")
        return out

    def stream(
        self, states: Iterable[CameraSettings], *, seed: int = 0, noise: Noise = "exact"
    ) -> Iterator[torch.Tensor]:
        """The sweep one capture (4, H, W) at a time, for frames too large to hold all at once.

        Each state is taken when its frame is: the next one may depend on the last frame.

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
