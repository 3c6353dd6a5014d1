"""A scene ready to be exposed at any settings: its light, and how it lies before the lens."""

from __future__ import annotations

import copy
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, cast, get_args

import numpy as np
import torch

from simulator.camera import CameraProfile
from simulator.capture.blurred_frames import Layout
from simulator.capture.blurred_light import ApertureBlur, BlurredLight
from simulator.capture.columns import NETWORKS, check_disc, noise_columns, plan_captures
from simulator.capture.limits import DEFAULT_TOLERANCE, SIGNAL_LIMIT, check_tolerance
from simulator.capture.plan import SimulationPlan, noise_balances, plan_capture
from simulator.capture.sensor import Transitions, pixel_response, record, sweep_keys
from simulator.capture.statistics import DenoisedLight, LightStatistics
from simulator.noise.generator import Noise
from simulator.noise.noise_level_function import NoiseLevelFunction, ReadNoises
from simulator.optics.motion import ALONG_ROWS, Movement
from simulator.optics.vignetting import Vignetting
from simulator.raw.image import check_packed, new_frame
from simulator.settings import CameraSettings
from simulator.utils.checks import check_flag, check_number, check_type, check_word

#: Blurred light of a sweep that may be held at once [byte], to record all of its frames together.
_TOGETHER_BYTES = 2**26
#: Fastest image [frame heights per second]: even 1/1000 s smears it over the whole frame.
MAX_IMAGE_SPEED = 1000.0


@dataclass(frozen=True, eq=False, repr=False)
class PreparedScene:
    """Light of a scene at reference settings, ready to be exposed at any others."""

    #: (4, H, W) float32, linear, not clipped: above 1 where highlights are known.
    light: torch.Tensor
    reference: CameraSettings  #: settings at which `light` is on the scale where sensor white is 1
    camera: CameraProfile  #: the body that takes the captures
    nlf: NoiseLevelFunction  #: noise left in `light`, at the reference settings
    #: (H, W) bool, pixels that were white in the source: their light is a guess; None if there are
    #: none.
    saturated: torch.Tensor | None = None
    #: Gains of R, G, B of the scene's light.
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    box_factor: int = 1  #: sensor pixels averaged per side into one pixel of `light`
    #: Speed of the image [frame heights per second], at most 1000; along the rows, unless
    #: `movement` says otherwise.
    image_speed: float = 0.0
    #: Diameter of the defocus disc at f/4 [pixel of `light`], with a `layout` that of the largest;
    #: 0 for a scene that is far or in focus throughout. No disc may be wider than both the frame
    #: and 512 pixel; with a `layout`, it stays at 32.
    defocus: float = 0.0
    gain: float = 1.0  #: light relative to `light`, where it changes over time
    #: `light` with its noise removed by each noise module, the cheapest first, for targets that are
    #: cleaner than the source; at most 3, none where there is no module or no noise.
    denoised_lights: tuple[DenoisedLight, ...] = ()
    #: Adds the blur of apertures wider than the reference's to a scene whose depth is not known;
    #: None takes it as far.
    aperture_blur: ApertureBlur | None = None
    #: In which directions the image moves, and the subject of `layout` of its own.
    movement: Movement = ALONG_ROWS
    #: What is out of focus, and what is the subject; None for one disc everywhere.
    layout: Layout | None = None
    #: The lens whose vignetting captures have; None for one without.
    lens: Vignetting | None = None
    #: Whether `light` was taken through that lens, at the reference's f-number, as that of a raw.
    seen_through_lens: bool = False
    #: Error that a capture may have, in units of the target's noise: the cheapest steps that keep
    #: it are taken, or else, as at 0, those with the least error.
    tolerance: float = DEFAULT_TOLERANCE
    #: Blurs the light and caches what it has blurred. It is made here, and copies
    #: (`dataclasses.replace`) with the same light, `nlf` and `aperture_blur` share it.
    blurred_light: BlurredLight = field(default=cast(BlurredLight, None))

    def __post_init__(self) -> None:
        cached = cast(BlurredLight | None, self.blurred_light)
        if cached is None or cached.light is not self.light:  # else the light was checked before
            object.__setattr__(self, "light", check_packed("light", self.light))
            cached = None
        known = None if cached is None else (cached.residuals.nlf, cached.aperture_blur)
        if known != (self.nlf, self.aperture_blur):
            statistics = None if cached is None else cached.statistics
            lights = BlurredLight(self.light, self.nlf, self.aperture_blur, statistics)
            object.__setattr__(self, "blurred_light", lights)
        for denoised in self.denoised_lights:
            check_type("denoised_lights", denoised, DenoisedLight)
            if denoised.shape not in (None, self.light.shape):
                raise ValueError(
                    f"`denoised_lights` (shape {tuple(denoised.shape)}) must have the shape of "
                    f"`light`, {tuple(self.light.shape)}"
                )
        if len(self.denoised_lights) > NETWORKS:
            count = len(self.denoised_lights)
            raise ValueError(f"`denoised_lights` (length {count}) must be at most {NETWORKS}")
        unit = " frame heights per second"
        check_number("image_speed", self.image_speed, 0.0, MAX_IMAGE_SPEED, more=unit)
        check_number("defocus", self.defocus, 0.0, sys.float_info.max)
        check_disc(self.defocus, 4.0, self.light.shape)
        check_number("gain", self.gain, 0.0, sys.float_info.max)
        check_type("lens", self.lens, Vignetting, None)
        if self.layout is not None and self.layout.defocus.shape != self.light.shape[-2:]:
            raise ValueError(
                f"`layout` (shape {tuple(self.layout.defocus.shape)}) must have the height and "
                f"width of `light`, {tuple(self.light.shape[-2:])}"
            )
        object.__setattr__(self, "tolerance", check_tolerance(self.tolerance))

    def changed(self, **values: Any) -> PreparedScene:
        """A copy with the fields `values`, which are known to be right: not checked.

        An environment makes one an episode. `light`, `nlf` and `aperture_blur` stay: what blurs the
        light has them.
        """
        assert values.keys().isdisjoint(("light", "nlf", "aperture_blur"))
        copied = copy.copy(self)
        vars(copied).update(values)
        return copied

    def vignetting(self, f_number: float) -> np.ndarray | None:
        """(H, W) share of the light that the lens leaves at `f_number`; None for all."""
        source = self.reference.effective_f_number if self.seen_through_lens else None
        if self.lens is None or f_number == source:
            return None
        height, width = self.light.shape[-2:]
        return self.lens.illumination(f_number, (height, width), source)

    @property
    def response(self) -> torch.Tensor | None:
        """(4, H, W) gains of the photosites relative to their mean; None where all are 1.

        The pattern of a source with noise is in its light already.
        """
        if not self.camera.prnu or not self.nlf.is_zero:
            return None
        return pixel_response(self.camera, tuple(self.light.shape), self.box_factor)

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

    @property
    def clipped_light(self) -> tuple[float, float]:
        """Share of the samples that are clipped in the source, and their mean estimated light.

        Of averages no one knows which: all of their saturated pixels count.
        """
        if self.saturated is None:
            return 0.0, 1.0
        light = self.light[:, self.saturated]
        light = light[light >= 1.0] if self.box_factor == 1 else light
        share = light.numel() / self.light.numel()
        return share, max(float(light.double().mean()), 1.0) if share else 1.0

    # -- what a change of settings takes ------------------------------------------------------

    def plan(self, settings: CameraSettings, *, noise: bool = True) -> SimulationPlan:
        """Steps, reasons, error and cost of a capture at `settings`, or without `noise`."""
        check_type("settings", settings, CameraSettings)
        check_flag("noise", noise)
        return plan_capture(self, settings, noise=noise)

    def output_noise(self, settings: CameraSettings) -> NoiseLevelFunction:
        """Noise of a native pixel at `settings`: the camera's, or the source's where that is more.

        Shot and read noise are compared apart: a mixed case is stated too high, not too low.
        """
        check_type("settings", settings, CameraSettings)
        planned = plan_captures(self, [settings])
        beyond = np.maximum(-planned.table[0, 1:3].astype(float), 0.0) * self.box_factor**2
        nlf = self.camera.nlf(settings.iso, settings.exposure_time)
        shot, read = (np.array([nlf.shot, nlf.read]) + beyond).tolist()
        return nlf.at_least(NoiseLevelFunction(shot, read))

    # -- captures -----------------------------------------------------------------------------

    def expected(self, settings: CameraSettings, *, gain: float = 1.0) -> torch.Tensor:
        """Light on the sensor at `settings`, (4, H, W), without noise or clipping, times `gain`.

        `gain` is a finite number >= 0.
        """
        check_type("settings", settings, CameraSettings)
        check_number("gain", gain, 0.0, sys.float_info.max)
        ((_, known),) = self.transitions([settings], noise=False, gain=np.array([gain]))
        return (known.light[0] * known.table[0, 0, 0].item()).clamp_(-SIGNAL_LIMIT, SIGNAL_LIMIT)

    def capture(
        self, settings: CameraSettings, seed: int = 0, *, noise: Noise = "exact"
    ) -> tuple[torch.Tensor, float]:
        """One simulated capture.

        The noise is a function of `seed` and of `settings`: the same frame comes back alone or in
        a sweep, and the frames of a sweep are independent.

        Args:
            settings: Settings to simulate.
            seed: Seed of the noise, >= 0.
            noise: ``"exact"`` draws it, ``"bank"`` looks it up (`simulator.capture.sensor`),
                ``"sensor"`` draws it with the camera's row noise and the tails of its read noise
                (`CameraProfile.read_noise`).

        Returns:
            (4, H, W) float32 in [-pedestal, 1], and its excess noise (see `SimulationPlan`).
        """
        check_type("settings", settings, CameraSettings)
        check_word("noise", noise, get_args(Noise))
        frames = self._frames(1, None)
        known = self._record([settings], frames, seed, noise)
        if known is None or self.nlf.is_zero:
            return frames[0], 0.0
        shares = known.remaining_variance or [None]
        targets = noise_columns(self.camera, [settings], self.box_factor)
        excess, _ = noise_balances([known.light[0]], shares, known.table, targets)
        return frames[0], excess.item()

    def expose(
        self,
        states: Iterable[CameraSettings],
        *,
        seed: int = 0,
        noise: Noise | None = "exact",
        gain: np.ndarray | None = None,
        row_gain: np.ndarray | None = None,
        out: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """A sweep: one capture per state, (S, 4, H, W) float32.

        Args:
            states: Settings to simulate.
            seed, noise: See `capture`; None for the light without noise (`expected`), recorded.
            gain: (S,) light of each state relative to this scene's, where it depends on the
                exposure time, as flickering light does; None for the same.
            row_gain: (S, H) light of each row relative to that; None where all rows have the same.
            out: (S, 4, H, W) contiguous float32 to write to, instead of new memory.
        """
        check_word("noise", "exact" if noise is None else noise, get_args(Noise))
        states = list(states) if isinstance(states, Iterable) else states
        if not isinstance(states, list) or not all(isinstance(s, CameraSettings) for s in states):
            raise ValueError(f"`states` (={states!r}) must be several CameraSettings")
        _check_light("gain", gain, (len(states),))
        _check_light("row_gain", row_gain, (len(states), self.light.shape[-2]))
        frames = self._frames(len(states), out)
        self._record(states, frames, seed, noise, gain, row_gain)
        return frames

    def _record(
        self,
        states: Sequence[CameraSettings],
        frames: torch.Tensor,
        seed: int,
        noise: Noise | None,
        gain: np.ndarray | None = None,
        row_gain: np.ndarray | None = None,
    ) -> Transitions | None:
        """Records captures to `frames`; returns what the last part of them was made of."""
        keys = sweep_keys(seed, states)  # a bad seed raises before any work
        read_noise: ReadNoises | None = None
        if noise == "sensor":
            each = [self.camera.read_noise(s.iso, self.box_factor) for s in states]
            read_noise = ReadNoises.of(each)
        transitions = None
        for some, transitions in self.transitions(states, noise=noise is not None, gain=gain):
            record(
                transitions,
                self.camera,
                keys=keys[some] if noise is not None and transitions.lacks_noise else None,
                noise=noise or "exact",
                read_noise=None if read_noise is None else read_noise.part(some),
                row_gain=None if row_gain is None else row_gain[some],
                signals=frames[some],
            )
        return transitions

    def transitions(
        self,
        states: Sequence[CameraSettings],
        *,
        noise: bool = True,
        gain: np.ndarray | None = None,
    ) -> Iterator[tuple[slice, Transitions]]:
        """All that captures at `states` depend on, except for their noise: parts of them.

        States that share their blur follow each other, so that none is computed twice; they are one
        part where the light of all may be held at once. Without `noise`, that of the source cannot
        count as part of the target's. `gain` is that of `expose`.
        """
        if not states:
            return
        planned = plan_captures(self, states, gain, noise=noise)
        extents = planned.blurs[["defocus_px", "motion_px"]].tolist()
        kinds, parts = [*zip(planned.origins, extents, strict=True)], [slice(0, len(states))]
        ranks = {kind: rank for rank, kind in enumerate(kinds)}
        if len(ranks) * self.light.nbytes > _TOGETHER_BYTES:
            order = sorted(range(len(kinds)), key=lambda i: ranks[kinds[i]])
            parts = [slice(i, i + 1) for i in order]
        for some in parts:
            blurs, owners = (planned.origins[some], planned.blurs[some]), (self.layout, self.lens)
            lights = [light.contiguous() for light in self.blurred_light.lights(*blurs, owners)]
            shares = None if self.nlf.is_zero else planned.shares[some]
            found = Transitions(lights, planned.table[some], shares)
            yield some, found.seen_by([self.response] * len(lights)) if noise else found

    def _frames(self, count: int, out: torch.Tensor | None) -> torch.Tensor:
        """Memory for `count` frames, `out` if that fits."""
        wanted = self.light.expand(count, *self.light.shape)
        if out is None:
            return new_frame(wanted)
        fits = isinstance(out, torch.Tensor) and out.shape == wanted.shape
        fits = fits and (out.dtype, out.device) == (torch.float32, wanted.device)
        fits = fits and out.untyped_storage().data_ptr() != self.light.untyped_storage().data_ptr()
        if not fits or not out.is_contiguous() or out.requires_grad:
            raise ValueError(
                f"`out` (={type(out).__name__}) must be a contiguous float32 tensor of shape "
                f"{tuple(wanted.shape)} on {wanted.device}, without gradient, and not the light's"
            )
        return out

    def stream(
        self, states: Iterable[CameraSettings], *, seed: int = 0, noise: Noise = "exact"
    ) -> Iterator[torch.Tensor]:
        """`expose` `states`, `seed` and `noise` alike, one capture (4, H, W) at a time.

        For frames too large to hold all at once. Each state is taken from `states` when its frame
        is: the next one may depend on the last frame.
        """
        for settings in states:
            yield self.expose([settings], seed=seed, noise=noise)[0]


def _check_light(name: str, light: Any, shape: tuple[int, ...]) -> None:
    if light is None:
        return
    known = isinstance(light, np.ndarray) and light.shape == shape and light.dtype.kind in "fiu"
    if not known or not (np.isfinite(light) & (light >= 0.0)).all():
        raise ValueError(f"`{name}` (={light!r}) must be an array {shape} of finite numbers >= 0")
