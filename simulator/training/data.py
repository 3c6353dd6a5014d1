"""Pairs of captures as batches, drawn by step number: the same step gives the same batch."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from simulator.camera import CameraProfile
from simulator.noise.generator import noise_generator
from simulator.reference.reference_camera import ReferenceCamera, ReferenceScene
from simulator.reference.sequences import Pair, Stage, draw_settings, select_pairs
from simulator.reference.sequences import Sequence as CaptureSequence
from simulator.settings import CameraSettings, exposure_ratio

#: Called with the number of scenes that are rendered, and of all.
Progress = Callable[[int, int], None]


class Batch(NamedTuple):
    """B pairs of captures of the same crop.

    Args:
        source: (B, 4, H, W) the input capture, noisy.
        target: (B, 4, H, W) the target capture without noise, clipped.
        sample: (B, 4, H, W) the target capture, noisy.
        ratio: (B,) nominal exposure ratio from source to target.
        shot: (B, 4) slope of the source's noise variance, on the source's scale.
        read: (B, 4) its noise variance at zero signal.
        f_source: (B,) effective f-number of the source.
        f_target: (B,) effective f-number of the target.
        parameters: (B, 6) log2 of ISO / 100, exposure time and f-number, source then target.
        defocus: (B, H, W) true circle of confusion of the source [pixel].
    """

    source: Tensor
    target: Tensor
    sample: Tensor
    ratio: Tensor
    shot: Tensor
    read: Tensor
    f_source: Tensor
    f_target: Tensor
    parameters: Tensor
    defocus: Tensor


def draw_sequences(
    scenes: Sequence[ReferenceScene], camera: CameraProfile, seed: int
) -> list[CaptureSequence]:
    """One sequence of 20 to 25 captures of each scene, as the paper took its own."""
    sequences = []
    for index, scene in enumerate(scenes):
        if scene.illuminance is None:
            raise ValueError(f"scene {scene.scene_id!r}: `illuminance` must be known to expose it")
        rng = np.random.default_rng([seed, index])
        settings = draw_settings(scene.illuminance, rng, camera)
        sequences.append(CaptureSequence(scene, tuple(settings)))
    return sequences


class ReferencePairs:
    """Pairs of one stage, photographed by the reference camera whenever they are asked for.

    The pairs are chosen once, at construction. Light behind every aperture is rendered once; a
    batch then costs the exposure and the noise of its crops. The noise is new every time: a pair
    that is shown twice was photographed twice.

    Args:
        sequences: Scenes and settings.
        camera: The body.
        stage: Stage to train, see `simulator.reference.sequences.select_pairs`.
        seed: Seed of pairs, crops and noise.
        blurred_light: Rendered light to share between stages; filled as needed.
        progress: Called while the light is rendered.

    Raises:
        ValueError: If the sequences hold no pair for this stage.
    """

    def __init__(
        self,
        sequences: Sequence[CaptureSequence],
        camera: ReferenceCamera,
        stage: Stage,
        *,
        seed: int = 0,
        blurred_light: dict[tuple[str, int], Tensor] | None = None,
        progress: Progress | None = None,
    ) -> None:
        self.sequences, self.camera, self.stage, self.seed = sequences, camera, stage, seed
        self.pairs: list[Pair] = select_pairs(list(sequences), stage, camera.camera)
        if not self.pairs:
            raise ValueError(f"`sequences` ({len(sequences)}) must hold a pair for stage {stage!r}")
        self._blurred_light = {} if blurred_light is None else blurred_light
        self._defocus: dict[tuple[str, int], Tensor] = {}
        self._render(progress)

    def batch(self, step: int, size: int, crop: int, *, process: int = 0) -> Batch:
        """The pairs of one step.

        Args:
            step: Number of the step.
            size: Pairs.
            crop: Height and width of the crops [packed pixel].
            process: Rank among several processes, each of which gets pairs of its own.

        Raises:
            ValueError: If a scene is smaller than `crop`.
        """
        words = [self.seed, len(self.stage), step, process]
        rng = np.random.default_rng(words)
        chosen = rng.integers(len(self.pairs), size=size)
        generator = noise_generator(self.seed, step, process, len(self.stage))
        items = [self._pair(self.pairs[i], crop, rng, generator) for i in chosen]
        return Batch(*(torch.stack([item[name] for item in items]) for name in Batch._fields))

    def _render(self, progress: Progress | None) -> None:
        wanted: dict[int, dict[int, CameraSettings]] = {}
        for pair in self.pairs:
            settings = self.sequences[pair.sequence].settings
            for index in (pair.source, pair.target):
                by_stop = wanted.setdefault(pair.sequence, {})
                by_stop[settings[index].aperture_stop] = settings[index]
        for done, (index, by_stop) in enumerate(sorted(wanted.items())):
            if progress is not None:
                progress(done, len(wanted))
            scene = self.sequences[index].scene
            for chosen in by_stop.values():
                key = _light_key(scene, chosen)
                if key not in self._blurred_light:
                    self._blurred_light[key] = self.camera.blurred_light(scene, chosen.f_number)
        if progress is not None:
            progress(len(wanted), len(wanted))

    def _pair(
        self, pair: Pair, crop: int, rng: np.random.Generator, generator: torch.Generator
    ) -> dict[str, Tensor]:
        sequence = self.sequences[pair.sequence]
        scene = sequence.scene
        source, target = sequence.settings[pair.source], sequence.settings[pair.target]
        k = self.camera.box_factor
        height, width = (n // k for n in scene.size)
        if crop > min(height, width):
            raise ValueError(
                f"`crop` (={crop}) must not exceed the {height} x {width} pixels of scene "
                f"{scene.scene_id!r}"
            )
        top = int(rng.integers(height - crop + 1))
        left = int(rng.integers(width - crop + 1))
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
            return signal, self.camera.record(signal, settings.iso, generator)

        _, noisy = record(source)
        signal, sample = record(target)
        nlf = self.camera.camera.nlf(source.iso).scaled(1.0 / k**2)
        return {
            "source": noisy,
            "target": self.camera.clip(signal, target.iso),
            "sample": sample,
            "ratio": torch.tensor(exposure_ratio(source, target), dtype=torch.float32),
            "shot": torch.tensor(nlf.shot),
            "read": torch.tensor(nlf.read),
            "f_source": torch.tensor(source.effective_f_number),
            "f_target": torch.tensor(target.effective_f_number),
            "parameters": torch.tensor(
                [*settings_parameters(source), *settings_parameters(target)]
            ),
            "defocus": cut(self._blur(pair, source)),
        }

    def _blur(self, pair: Pair, settings: CameraSettings) -> Tensor:
        scene = self.sequences[pair.sequence].scene
        key = (scene.scene_id, settings.aperture_stop)
        if key not in self._defocus:
            self._defocus[key] = self.camera.blur_diameter(scene, settings.effective_f_number)
        return self._defocus[key]


def _light_key(scene: ReferenceScene, settings: CameraSettings) -> tuple[str, int]:
    """Without depth, light is the same behind every aperture, and rendered once."""
    return scene.scene_id, 0 if scene.depth is None else settings.aperture_stop


def settings_parameters(settings: CameraSettings) -> tuple[float, float, float]:
    """Parameters for the baselines: log2 of ISO / 100, exposure time [s] and f-number."""
    return (
        math.log2(settings.iso / 100.0),
        math.log2(settings.exposure_time),
        math.log2(settings.effective_f_number),
    )
