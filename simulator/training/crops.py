"""Pairs of captures, and crops for the noise stage, as batches: a step always gives the same."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from simulator.camera import CameraProfile
from simulator.noise.generator import noise_generator
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.reference.reference_camera import (
    ReferenceCamera,
    ReferenceScene,
    average_planes,
    lens_blur,
    sample_mosaic,
)
from simulator.reference.sequences import Pair, Stage, draw_settings, select_pairs
from simulator.reference.sequences import Sequence as CaptureSequence
from simulator.settings import CameraSettings, exposure_ratio

#: Called with the share that is done, in [0, 1], and the latest values.
Progress = Callable[[float, dict[str, float]], None]
#: Samples averaged per side and plane, and how often.
_AVERAGED = (1, 2, 3, 4, 6, 8)
_AVERAGED_SHARE = (0.55, 0.2, 0.08, 0.07, 0.05, 0.05)
#: Share of crops whose four planes coincide, as after averaging by a large k.
_COINCIDING = 0.1
#: Light of a crop, log2 of its mean [white].
_LEVEL = (-11.0, -0.5)
#: ISO, log2.
_ISO = (math.log2(50.0), math.log2(25600.0))
#: How often kinds are drawn, where it is not 1.
_WEIGHTS = {"radiance": 3.0, "photograph": 3.0, "leaves": 1.5, "linear": 0.7, "chart": 0.7}
#: A recorded mosaic serves where the noise that is added has this many times its own variance.
_CLEAN_RATIO = 16.0

_CLEAN = NoiseLevelFunction.zero()
#: See `DetailCrops._draw`.
_Crop = tuple[Tensor, Tensor, Tensor, CameraProfile, int]


def no_progress(*_: object) -> None:
    """Shows no progress."""


class Batch(NamedTuple):
    """B pairs of captures of the same crop."""

    source: Tensor  # (B, 4, H, W) the input capture, noisy
    target: Tensor  # (B, 4, H, W) the target capture without noise, clipped
    sample: Tensor  # (B, 4, H, W) the target capture, noisy
    ratio: Tensor  # (B,) nominal exposure ratio from source to target
    shot: Tensor  # (B, 4) slope of the source's noise variance, on the source's scale
    read: Tensor  # (B, 4) its noise variance at zero signal
    f_source: Tensor  # (B,) effective f-number of the source
    f_target: Tensor  # (B,) effective f-number of the target
    parameters: Tensor  # (B, 6) log2 of ISO / 100, exposure time, f-number, source then target
    defocus: Tensor  # (B, H, W) true circle of confusion of the source [pixel]


def draw_sequences(
    scenes: Sequence[ReferenceScene], camera: CameraProfile, seed: int
) -> list[CaptureSequence]:
    """One sequence of 20 to 25 captures of each scene, as the paper took its own."""
    sequences = []
    for index, scene in enumerate(scenes):
        assert scene.illuminance is not None
        settings = draw_settings(scene.illuminance, np.random.default_rng([seed, index]), camera)
        sequences.append(CaptureSequence(scene, tuple(settings)))
    return sequences


class ReferencePairs:
    """Pairs of one stage, photographed by the reference camera whenever they are asked for.

    Light behind every aperture is rendered once, into `blurred_light`, which stages may share. The
    noise is new every time: a pair that is shown twice was photographed twice.
    """

    def __init__(
        self,
        sequences: Sequence[CaptureSequence],
        camera: ReferenceCamera,
        stage: Stage,
        *,
        seed: int = 0,
        blurred_light: dict[tuple[str, int], Tensor] | None = None,
        progress: Progress = no_progress,
    ) -> None:
        self.sequences, self.camera, self.stage, self.seed = sequences, camera, stage, seed
        self.pairs: list[Pair] = select_pairs(list(sequences), stage, camera.camera)
        if not self.pairs:
            raise ValueError(f"`sequences` ({len(sequences)}) must hold a pair for stage {stage!r}")
        self._blurred_light = {} if blurred_light is None else blurred_light
        self._defocus: dict[tuple[str, int], Tensor] = {}
        wanted = {}
        for pair in self.pairs:
            sequence = sequences[pair.sequence]
            for settings in (sequence.settings[pair.source], sequence.settings[pair.target]):
                wanted[_light_key(sequence.scene, settings)] = sequence.scene, settings.f_number
        for done, (key, (scene, f_number)) in enumerate(wanted.items()):
            progress(done / len(wanted), {})
            if key not in self._blurred_light:
                self._blurred_light[key] = camera.blurred_light(scene, f_number)
        progress(1.0, {})

    def batch(self, step: int, size: int, crop: int, *, process: int = 0) -> Batch:
        """`size` pairs of one step, their crops `crop` packed pixels a side.

        Each of several processes, numbered by `process`, gets pairs of its own.
        """
        rng = np.random.default_rng([self.seed, len(self.stage), step, process])
        chosen = rng.integers(len(self.pairs), size=size)
        generator = noise_generator(self.seed, step, process, len(self.stage))
        return stacked([self._pair(self.pairs[i], crop, rng, generator) for i in chosen])

    def _pair(
        self, pair: Pair, crop: int, rng: np.random.Generator, generator: torch.Generator
    ) -> dict[str, Tensor]:
        sequence = self.sequences[pair.sequence]
        scene = sequence.scene
        source, target = sequence.settings[pair.source], sequence.settings[pair.target]
        k = self.camera.box_factor
        top, left = (int(rng.integers(n // k - crop + 1)) for n in scene.size)
        # The one symmetry of a mosaic: transposed, G1 and G2 change places. Mirrored, its planes
        # would lie where no photosites are.
        transposed = rng.random() < 0.5

        def cut(image: Tensor, scale: int = 1) -> Tensor:
            rows, columns = (slice(scale * n, scale * (n + crop)) for n in (top, left))
            part = image[..., rows, columns]
            return (part.transpose(-2, -1) if transposed else part).contiguous()

        def record(settings: CameraSettings) -> tuple[Tensor, Tensor]:
            light = cut(self._blurred_light[_light_key(scene, settings)], k)
            light = light[[0, 2, 1, 3]] if transposed else light
            signal = self.camera.expose(light, scene.reference, settings)
            time = settings.exposure_time
            return signal, self.camera.record(signal, settings.iso, generator, time)

        _, noisy = record(source)
        signal, sample = record(target)
        nlf = self.camera.camera.nlf(source.iso, source.exposure_time)
        known = scene.scene_id, source.aperture_stop
        if known not in self._defocus:
            self._defocus[known] = self.camera.blur_diameter(scene, source.effective_f_number)
        return {
            "source": noisy,
            "target": self.camera.clip(signal, target.iso),
            "sample": sample,
            "defocus": cut(self._defocus[known]),
            **stated_fields(source, target, nlf.scaled(1.0 / k**2)),
        }


def _light_key(scene: ReferenceScene, settings: CameraSettings) -> tuple[str, int]:
    """Without depth, light is the same behind every aperture, and rendered once."""
    return scene.scene_id, 0 if scene.depth is None else settings.aperture_stop


def stacked(items: list[dict[str, Tensor]]) -> Batch:
    """A batch of pairs, each given by its fields."""
    return Batch(*(torch.stack([item[name] for item in items]) for name in Batch._fields))


def stated_fields(
    source: CameraSettings, target: CameraSettings, nlf: NoiseLevelFunction
) -> dict[str, Tensor]:
    """The fields of a `Batch` that a pair's settings and its source's noise decide."""
    return {
        "ratio": torch.tensor(exposure_ratio(source, target), dtype=torch.float32),
        "shot": torch.tensor(nlf.shot),
        "read": torch.tensor(nlf.read),
        "f_source": torch.tensor(source.effective_f_number),
        "f_target": torch.tensor(target.effective_f_number),
        "parameters": torch.tensor([*settings_parameters(source), *settings_parameters(target)]),
    }


def settings_parameters(settings: CameraSettings) -> tuple[float, float, float]:
    """Parameters for the baselines: log2 of ISO / 100, exposure time [s] and f-number."""
    values = settings.iso / 100.0, settings.exposure_time, settings.effective_f_number
    return tuple(math.log2(value) for value in values)  # type: ignore[return-value]


# -- crops of the noise stage ---------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class DetailPicture:
    """A sharp picture with little noise.

    Its light, float32 and >= 0 but for noise, is (3, H, W) in camera colours at the pitch of the
    photosites, or (4, H, W) the planes of a recorded mosaic.
    """

    name: str
    group: str  # source group, the unit of splitting
    kind: str  # of source, which decides how often it is drawn
    light: Tensor
    nlf: NoiseLevelFunction = _CLEAN  # noise left in it, on the scale of `light`

    @property
    def photosites(self) -> int:
        """Samples per packed pixel and side: a recorded mosaic is packed already."""
        return 1 if self.light.shape[0] == 4 else 2


class NoiseBatch(NamedTuple):
    """B crops with and without noise.

    `noisy` (B, 4, H, W) is as recorded: clipped, whole digital numbers where nothing is averaged.
    `clean` is its light, clipped at white. The noise variance is ``read + shot * clean``, (B, 4).
    """

    noisy: Tensor
    clean: Tensor
    shot: Tensor
    read: Tensor


class DetailCrops:
    """Batches of the noise stage: crops of `pictures` at ISO 50 to 25,600 of one of `cameras`.

    Half of the crops have read noise of 0.4 to 7 times as much, as other sensors have. Averages
    over k x k samples of a plane, as of a frame that was reduced, are among the crops.
    """

    def __init__(
        self, pictures: Sequence[DetailPicture], cameras: Sequence[CameraProfile], seed: int = 0
    ) -> None:
        self.cameras, self.seed = list(cameras), seed
        names = sorted({picture.kind for picture in pictures})
        self.kinds = [[p for p in pictures if p.kind == name] for name in names]
        weights = np.array([_WEIGHTS.get(name, 1.0) for name in names])
        self._shares = weights / weights.sum()
        self.pairs = list(pictures)
        #: Side of the largest crop that there is [packed pixel].
        self.largest = max(min(p.light.shape[1:]) // p.photosites for p in self.pairs)

    def batch(self, step: int, size: int, crop: int, *, process: int = 0) -> NoiseBatch:
        """`size` crops of one step, see `ReferencePairs.batch`."""
        rng = np.random.default_rng([self.seed, 0xDE7A, step, process])
        generator = noise_generator(self.seed, step, process, 0xDE7A)
        return _recorded((self._draw(crop, rng) for _ in range(size)), generator)

    def captures(self, index: int, count: int, crop: int) -> NoiseBatch:
        """`count` captures of crop number `index`, which differ by their noise."""
        generator = noise_generator(self.seed, index, 0xCA9)
        drawn = self._draw(crop, np.random.default_rng([self.seed, 0xCA9, index]))
        return _recorded([drawn] * count, generator)

    def _draw(self, crop: int, rng: np.random.Generator) -> _Crop:
        """Light, shot and read noise, camera and averaged samples of a crop."""
        if crop > self.largest:
            raise ValueError(f"`crop` (={crop}) must not exceed the largest, {self.largest}")
        while True:
            kind = self.kinds[int(rng.choice(len(self.kinds), p=self._shares))]
            picture = kind[int(rng.integers(len(kind)))]
            k = int(rng.choice(_AVERAGED, p=_AVERAGED_SHARE))
            made = _planes(picture, crop, k, rng)
            if made is None:
                continue
            planes, nlf = made
            camera = self.cameras[int(rng.integers(len(self.cameras)))]
            known = camera.nlf(float(np.exp2(rng.uniform(*_ISO))))
            shot, read = np.array(known.shot), np.array(known.read)
            if rng.random() < 0.5:  # a sensor like it
                shot = shot * np.exp(rng.normal(0.0, 0.4))
                read = read * np.exp(rng.uniform(-1.0, 2.0))
            shot, read = shot / k**2, read / k**2
            level = float(np.exp2(rng.uniform(*_LEVEL)))
            scale = level / max(float(planes.mean()), 1e-12)
            own = nlf.exposed(scale)
            if (_CLEAN_RATIO * np.array([own.read, own.shot]) > np.stack([read, shot])).any():
                continue
            shots, reads = (torch.from_numpy(v.astype(np.float32)) for v in (shot, read))
            return planes * scale, shots, reads, camera, k


def _planes(
    picture: DetailPicture, crop: int, k: int, rng: np.random.Generator
) -> tuple[Tensor, NoiseLevelFunction] | None:
    """A crop averaged by k, its mean arbitrary, and the noise in it; None if it is too small."""
    side = crop * k * picture.photosites
    height, width = picture.light.shape[1:]
    if side > min(height, width):
        return None
    top, left = (int(rng.integers(n - side + 1)) for n in (height, width))
    part = picture.light[:, top : top + side, left : left + side]
    if picture.photosites == 1:  # flipping packed planes would not be flipping the mosaic
        if rng.random() < 0.5:
            part = part.transpose(-2, -1)[[0, 2, 1, 3]]
        return average_planes(part, k), picture.nlf.scaled(1.0 / k**2)
    part = part.flip([axis for axis in (-2, -1) if rng.random() < 0.5])
    if rng.random() < 0.5:
        part = part.transpose(-2, -1)
    light = _other_colours(part, rng)
    if rng.random() < _COINCIDING:
        return average_planes(light[[0, 1, 1, 2]], 2 * k), _CLEAN
    sigma = 0.0 if rng.random() < 0.25 else float(rng.uniform(0.3, 0.9))
    return average_planes(sample_mosaic(lens_blur(light, sigma)), k), NoiseLevelFunction.zero()


def _other_colours(light: Tensor, rng: np.random.Generator) -> Tensor:
    """The picture under another light, by another sensor: mixed colours, gains, contrast."""
    if rng.random() < 0.3:
        light = light.clamp(min=0.0) ** float(rng.uniform(0.7, 1.4))
    mix = np.eye(3) + rng.uniform(-0.25, 0.25, (3, 3)) * rng.random()
    mix /= mix.sum(axis=1, keepdims=True)
    gains = np.exp2([rng.uniform(-1.6, 0.4), 0.0, rng.uniform(-1.6, 0.4)])
    matrix = torch.from_numpy((mix * gains[:, None]).astype(np.float32))
    return torch.einsum("ij,jhw->ihw", matrix, light).clamp(min=0.0)


def _recorded(crops: Iterable[_Crop], generator: torch.Generator) -> NoiseBatch:
    """The crops as they are recorded: photons, read noise, rounding, clip.

    An average of k x k samples is rounded to 1/k^2 of a digital number; rounding is part of the
    calibrated read noise.
    """
    items = []
    for light, shot, read, camera, k in crops:
        shots, reads = shot[:, None, None], read[:, None, None]
        step = 1.0 / (torch.tensor(camera.span, dtype=torch.float32)[:, None, None] * k**2)
        electrons = 1.0 / shots
        counted = torch.poisson(light.clamp(0.0, 2.0) * electrons, generator=generator) / electrons
        normal = torch.empty_like(light).normal_(generator=generator)
        noisy = counted + (reads - step.square() / 12.0).clamp(min=0.0).sqrt() * normal
        pedestal = torch.tensor(camera.pedestal, dtype=torch.float32)[:, None, None]
        rounded = torch.maximum((noisy / step).round() * step, -pedestal).clamp(max=1.0)
        items.append((rounded, light.clamp(max=1.0), shot, read))
    return NoiseBatch(*(torch.stack(parts) for parts in zip(*items, strict=True)))
