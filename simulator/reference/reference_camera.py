"""The reference camera: the ground truth that the simulator's error is measured against.

From noise-free light and depth to digital numbers, each step as the physics has it: thin-lens
defocus with occlusion, the softness of a lens in focus (about a pixel), the colour filter array,
the light of the true exposure time and aperture, motion blur, photon noise in electrons, full well,
read noise, black level, clip, whole digital numbers, and only then an average of neighbours. Each
body has a small hidden error of shutter, aperture and black level, as real ones do.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Self

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from simulator.camera import BayerPattern, CameraProfile
from simulator.capture.limits import SIGNAL_LIMIT
from simulator.capture.sensor import clip_and_quantise, pixel_response
from simulator.noise.generator import noise_generator
from simulator.noise.noise_level_function import plane_tensor
from simulator.optics.flicker_integral import Lamp
from simulator.optics.motion import motion_blur
from simulator.optics.vignetting import Vignetting
from simulator.raw.image import check_packed
from simulator.reference.thin_lens import Lens, defocus
from simulator.settings import CameraSettings, exposure_ratio
from simulator.utils.checks import check_integer

#: Standard deviation of a sharp lens's blur [photosite]: a point is about a pixel wide (its full
#: width at half maximum is 1.2), between diffraction at f/4 and at f/11 for a pitch of 4 to 6 um.
LENS_SIGMA = 0.5
#: A well holds this much more than white at the base ISO: makers set the white level just below it,
#: so that a saturated pixel reads white in spite of its read noise and of its black level.
WELL_MARGIN = 0.004
#: Aperture stops (sixths of the f-number's octave) from f/1 to f/64.
_STOPS = range(37)
#: Kind of a scene whose picture is also there without the depth that it was given.
DRAPED = "draped"
#: Kind of a scene that a real sensor recorded, with a little noise left.
MOSAIC = "mosaic"


def lens_blur(light: Tensor, sigma: float = LENS_SIGMA) -> Tensor:
    """Gaussian blur of a lens in focus, borders repeated; `sigma` is in pixels of (C, H, W)."""
    if sigma == 0.0:
        return light
    reach = max(1, math.ceil(3.0 * sigma))
    weights = [math.exp(-0.5 * (offset / sigma) ** 2) for offset in range(-reach, reach + 1)]
    total = sum(weights)
    height, width = light.shape[-2:]
    padded = F.pad(light[None], (reach,) * 4, mode="replicate")[0]
    # Sums of shifted views: for these few taps three times as fast as a depthwise convolution.
    rows, blurred = torch.zeros_like(padded[:, :height]), torch.zeros_like(light)
    for i, weight in enumerate(weights):
        rows += weight / total * padded[:, i : i + height]
    for i, weight in enumerate(weights):
        blurred += weight / total * rows[..., i : i + width]
    return blurred


def sample_mosaic(light: Tensor, cfa: BayerPattern = BayerPattern.RGGB) -> Tensor:
    """The planes R, G1, G2, B (4, H, W) that photosites behind colour filters take of `light`.

    `light` is (3, 2H, 2W) red, green and blue at every photosite; a last odd row or column is cut.
    """
    height, width = (n // 2 * 2 for n in light.shape[-2:])
    planes = [
        light[..., colour, row:height:2, column:width:2]
        for colour, (row, column) in zip((0, 1, 1, 2), cfa.offsets, strict=True)
    ]
    return torch.stack(planes, dim=-3)


def packed_pitch(camera: CameraProfile) -> float:
    """Distance between packed pixels of `camera` [m], twice the sensor's, which must be known."""
    if camera.pixel_pitch_um is None:
        raise ValueError(f"`camera` (={camera.name!r}) must have a pixel pitch")
    return 2e-6 * camera.pixel_pitch_um


def average_planes(planes: Tensor, k: int) -> Tensor:
    """Means over k x k samples of one plane, (..., 4, H, W) to (..., 4, H // k, W // k)."""
    return planes if k == 1 else F.avg_pool2d(planes, k)


@dataclass(frozen=True, eq=False)
class ReferenceScene:
    """A scene before the camera, without noise and in focus throughout."""

    scene_id: str
    group: str  # the unit of splitting: a photograph, panorama or physical subject
    kind: str  # of source, such as "dead_leaves"
    #: Float32 >= 0, linear, in camera colours, at `reference`; 1.0 is sensor white, not clipped.
    #: (3, 2H, 2W): red, green and blue at the pitch of the photosites, which the camera samples.
    #: (4, H, W): planes that are recorded as they are, those of a real mosaic or of a scene too
    #: coarse to be sampled.
    light: Tensor
    reference: CameraSettings
    #: Distance from the lens [m] at each pixel of `light`, float32, above the focal length, inf
    #: allowed; None if all is in focus.
    depth: Tensor | None = None
    lens: Lens = field(default_factory=Lens)
    illuminance: float | None = None  # incident light [lux], if known
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)  # gains of R, G, B
    source: str = ""  # where the light comes from
    #: Whether it has the detail of a sensor, each plane at its own place. Always so where `light`
    #: is at the pitch of the photosites; planes that share their places say nothing about detail.
    sampled: bool = False
    #: Whether `light` itself is sharp throughout. A photograph with a blur of its own says nothing
    #: about what a wider aperture does.
    in_focus: bool = True

    def __post_init__(self) -> None:
        light = self.light
        if light.ndim == 3 and light.shape[0] == 3:
            if light.shape[1] % 2 or light.shape[2] % 2:
                raise ValueError(f"`light` (shape {tuple(light.shape)}) must have even sides")
            # The green twice, to be checked like planes.
            light = check_packed("light", light[[0, 1, 1, 2]])[[0, 1, 3]]
            object.__setattr__(self, "sampled", True)
        else:
            light = check_packed("light", light)
        if bool((light < 0).any()):
            raise ValueError(f"`light` (minimum {float(light.min()):g}) must be >= 0")
        object.__setattr__(self, "light", light)
        if self.depth is None:
            return
        size, nearest = light.shape[-2:], self.lens.focal_length
        if self.depth.shape != size or not bool((self.depth > nearest).all()):  # also refuses NaN
            found = f"shape {tuple(self.depth.shape)}, minimum {float(self.depth.min()):g} m"
            rule = f"must be {tuple(size)} and above the focal length ({nearest:g} m)"
            raise ValueError(f"`depth` ({found}) {rule}")
        object.__setattr__(self, "depth", self.depth.to(torch.float32))

    @property
    def pitch(self) -> int:
        """Pixels of `light` a side in a packed pixel: 2 where they are photosites, else 1."""
        return 2 if self.light.shape[0] == 3 else 1

    @property
    def size(self) -> tuple[int, int]:
        """Height and width [packed pixel]."""
        height, width = self.light.shape[1:]
        return height // self.pitch, width // self.pitch


@dataclass(frozen=True)
class BodyError:
    """Hidden errors of one body: how far its exposures are from what its settings promise."""

    shutter_delay: float = 0.0  # added to every exposure time [s]
    shutter_scale: float = 0.0  # relative error of every exposure time
    #: Relative error of the light by aperture stop (`CameraSettings.aperture_stop`), 0 for others.
    transmission: Mapping[int, float] = field(default_factory=dict)
    #: Error of the black level on the packed scale, R, G1, G2, B.
    black_offset: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    @classmethod
    def draw(cls, camera: CameraProfile, seed: int) -> Self:
        """Draw a body of `camera` as it might leave the factory; the same `seed` gives the same.

        Shutter: 15 us (standard deviation, at most 60 us, so that 1/8000 s stays open) and 1 %.
        Light of each aperture stop: 2 %, at most 6 %. Black: up to 2 digital numbers per plane.
        """
        rng = np.random.default_rng([seed, 0xB0D1])
        errors = np.clip(rng.normal(0.0, 0.02, len(_STOPS)), -0.06, 0.06)
        offsets = rng.uniform(-2.0, 2.0, 4) / np.array(camera.span)
        return cls(
            shutter_delay=float(np.clip(rng.normal(0.0, 15e-6), -60e-6, 60e-6)),
            shutter_scale=float(np.clip(rng.normal(0.0, 0.01), -0.03, 0.03)),
            transmission=dict(zip(_STOPS, errors.tolist(), strict=True)),
            black_offset=tuple(offsets.tolist()),
        )

    def exposure_time(self, nominal: float) -> float:
        """True exposure time [s] of a `nominal` one; an error if the shutter would not open."""
        time = nominal * (1.0 + self.shutter_scale) + self.shutter_delay
        if time <= 0.0:
            rule = f"must be above this body's shutter error ({self})"
            raise ValueError(f"`exposure_time` (={nominal!r}) {rule}")
        return time

    def light_error(self, settings: CameraSettings) -> float:
        """True light at `settings` divided by the light that they promise."""
        time = self.exposure_time(settings.exposure_time) / settings.exposure_time
        return time * (1.0 + self.transmission.get(settings.aperture_stop, 0.0))


@dataclass(frozen=True, eq=False)
class ReferenceCapture:
    """One capture and its ground truth."""

    mean: Tensor  # (4, H, W) without noise, clipped as the capture is, not quantised
    sample: Tensor  # (4, H, W) with noise, clipped, whole digital numbers (or averages of them)
    settings: CameraSettings  # nominal, as the file would state them


class ReferenceCamera:
    """A body that photographs `ReferenceScene`.

    Its sensor has a noise calibration and, for scenes with depth, a pixel pitch; `box_factor` are
    the samples k that are averaged per side and plane after they were recorded, each with noise of
    its own: captures then have H // k x W // k pixels. With `sensor_noise` the read noise has the
    camera's rows and tails (`CameraProfile.read_noise`); else it is normal and independent. A lens
    with `vignetting` darkens what is on the sensor.
    """

    def __init__(
        self,
        camera: CameraProfile,
        *,
        body: BodyError | None = None,
        box_factor: int = 1,
        sensor_noise: bool = False,
        vignetting: Vignetting | None = None,
    ) -> None:
        camera.nlf(100.0)  # raises where there is no noise calibration
        self.camera = camera
        self.body = BodyError() if body is None else body
        self.box_factor = check_integer("box_factor", box_factor, 1)
        self.sensor_noise, self.vignetting = sensor_noise, vignetting
        if sensor_noise:
            camera.read_noise(min(camera.nlf_by_iso))  # raises where there is none

    def blur_diameter(self, scene: ReferenceScene, f_number: float) -> Tensor:
        """Diameter of the circle of confusion (H, W) in the pixels of a capture, >= 0.

        Where depth is finer than that it is the root of the mean square, as second moments add. The
        blur is that of the stop that the marked `f_number` stands for.
        """
        diameter, pixels = self._signed_diameter(scene, f_number), scene.pitch * self.box_factor
        if pixels == 1:
            return diameter.abs().to(torch.float32)
        squares = F.avg_pool2d(diameter.square()[None], pixels)[0]
        return (squares.sqrt() / pixels).to(torch.float32)

    def _signed_diameter(self, scene: ReferenceScene, f_number: float) -> Tensor:
        """The same with its sign, at and in the pixels of ``scene.light``."""
        if scene.depth is None:
            return torch.zeros_like(scene.light[0], dtype=torch.float64)
        exact = CameraSettings(100.0, 1.0, f_number).effective_f_number
        pitch = packed_pitch(self.camera) / scene.pitch
        return scene.lens.circle_of_confusion(scene.depth.double(), exact) / pitch

    def blurred_light(self, scene: ReferenceScene, f_number: float) -> Tensor:
        """Light on the photosites behind the aperture `f_number`, (4, H, W).

        It is at the exposure of ``scene.reference``, unclipped, without noise and not averaged.
        """
        light = scene.light
        if scene.depth is not None:
            light = defocus(light, self._signed_diameter(scene, f_number))
        return sample_mosaic(lens_blur(light), self.camera.cfa) if scene.pitch == 2 else light

    def expose(
        self,
        light: Tensor,
        reference: CameraSettings,
        settings: CameraSettings,
        *,
        image_speed: float = 0.0,
        lamp: Lamp | None = None,
        start: float = 0.0,
    ) -> Tensor:
        """Signal without noise at `settings`, with this body's hidden errors, unclipped.

        Where the image moves in light that changes, each is integrated by itself.

        Args:
            light: (..., 4, H, W) at the exposure of `reference`, from `blurred_light`.
            reference, settings: Settings of `light`, and nominal ones of the capture.
            image_speed: Speed of the image along the rows [frame heights per second].
            lamp: The scene's lamp, whose long-term mean `light` is; None for steady light.
                Rows are read one after the other (`CameraProfile.row_time`).
            start: When the first row begins its exposure [s].
        """
        ratio = exposure_ratio(reference, settings) * self.body.light_error(settings)
        time = self.body.exposure_time(settings.exposure_time)
        moved = motion_blur(light, image_speed * time * light.shape[-2])
        if lamp is not None:
            bands = lamp.row_light(start, time, light.shape[-2], self.camera.row_time, 2)
            moved = moved * torch.from_numpy(bands).to(moved)[:, None]
        if self.vignetting is not None:
            shape, f_number = (light.shape[-2], light.shape[-1]), settings.effective_f_number
            moved = moved * torch.from_numpy(self.vignetting.illumination(f_number, shape))
        return moved * ratio + self._black_offset(light)

    def _black_offset(self, signal: Tensor) -> Tensor:
        return torch.tensor(self.body.black_offset).to(signal)[:, None, None]

    def record(
        self, signal: Tensor, iso: float, generator: torch.Generator, exposure_time: float = 0.0
    ) -> Tensor:
        """Digital numbers of `signal` (..., 4, H, W), sensor white is 1; averaged after that.

        In the `exposure_time` [s] the dark current is collected, whose mean is no signal.

        The variance of a sample is that of the camera's noise level function: the noise of the
        rounding to whole numbers is part of the calibrated read noise, and is not counted twice.
        """
        nlf = self.camera.nlf(iso)
        shot, read = (plane_tensor(values, signal.device) for values in (nlf.shot, nlf.read))
        black, well = self._black_offset(signal), self._well(signal, iso)
        # Light far above a full well fills it in any case; its photon count would overflow.
        light = torch.minimum((signal - black).clamp(min=0.0), 2.0 * well)
        if self.camera.prnu:
            light = light * pixel_response(self.camera, tuple(signal.shape[-3:]), 1)
        electrons = torch.where(shot > 0, 1.0 / shot, 1.0)  # per unit of signal
        dark = self.camera.dark_current * exposure_time
        counted = torch.poisson(light * electrons + dark, generator=generator) - dark
        counted = counted / electrons
        collected = torch.minimum(torch.where(shot > 0, counted, light), well)
        span = torch.tensor(self.camera.span).to(signal)[:, None, None]
        rounding = 1.0 / (12.0 * span**2)
        normal = torch.empty_like(collected).normal_(generator=generator)
        if self.sensor_noise:
            given = self.camera.read_noise(iso)
            rows = signal.new_empty(*signal.shape[:-3], 2, signal.shape[-2])
            left = ((1.0 - given.row**2) * read - rounding).clamp(min=0.0)
            noise = given.row_part(read, rows.normal_(generator=generator))
            noise = noise + given.pixel_part(left, normal)
        else:
            noise = (read - rounding).clamp(min=0.0).sqrt() * normal
        recorded = clip_and_quantise(collected + noise + black, self.camera)
        return average_planes(recorded, self.box_factor)

    def _well(self, signal: Tensor, iso: float) -> Tensor:
        """Signal of a full well, (4, 1, 1): just above white at the base ISO, more beyond it."""
        base = self.camera.nlf(min(self.camera.nlf_by_iso)).shot
        wells = [
            (1.0 + WELL_MARGIN) * shot / lowest if shot > 0 and lowest > 0 else SIGNAL_LIMIT
            for shot, lowest in zip(self.camera.nlf(iso).shot, base, strict=True)
        ]
        return torch.tensor(wells).to(signal)[:, None, None]

    def clip(self, signal: Tensor, iso: float) -> Tensor:
        """The mean of a capture of `signal` (..., 4, H, W): clipped to [-pedestal, 1], averaged."""
        held = torch.minimum(signal, self._well(signal, iso) + self._black_offset(signal))
        pedestal = torch.tensor(self.camera.pedestal).to(signal)[:, None, None]
        return average_planes(torch.maximum(held, -pedestal).clamp(max=1.0), self.box_factor)

    def capture(
        self,
        scene: ReferenceScene,
        settings: CameraSettings,
        seed: int,
        *,
        light: Tensor | None = None,
        lamp: Lamp | None = None,
        start: float = 0.0,
    ) -> ReferenceCapture:
        """Photograph a scene that stands still, with noise that `seed` and the settings decide.

        `light` is the result of ``blurred_light(scene, settings.f_number)`` if known, which serves
        every capture at that f-number; `lamp` and `start` are those of `expose`.
        """
        if light is None:
            light = self.blurred_light(scene, settings.f_number)
        signal = self.expose(light, scene.reference, settings, lamp=lamp, start=start)
        generator = noise_generator(seed, settings.iso, settings.exposure_time, settings.f_number)
        sample = self.record(signal, settings.iso, generator, settings.exposure_time)
        return ReferenceCapture(self.clip(signal, settings.iso), sample, settings)
