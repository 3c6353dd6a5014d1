"""The pairs of captures of the paper's table: which there are, and what each of them asks for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from simulator import CameraSettings, RawImage, exposure_ratio
from simulator.noise.noise_level_function import noise_variance
from simulator.reference.reference_camera import ReferenceCamera, ReferenceCapture, ReferenceScene
from simulator.reference.sequences import Pair, select_pairs
from simulator.reference.sequences import Sequence as CaptureSequence

#: Defocus that can be seen [packed pixel], and the share of white pixels from which a source counts
#: as saturated.
VISIBLE_BLUR, SATURATED = 1.5, 0.01


@dataclass(frozen=True, eq=False)
class Case:
    """One pair, photographed.

    Args:
        scene: What was photographed.
        source: The noisy input.
        target: The noisy output and its mean.
        blur: Largest circle of confusion of the source in the crop [pixel].
    """

    scene: ReferenceScene
    source: RawImage
    target: ReferenceCapture
    blur: float

    @property
    def ratio(self) -> float:
        """Exposure ratio from source to target."""
        return exposure_ratio(self.source.settings, self.target.settings)

    @property
    def iso_ratio(self) -> float:
        """ISO of the target over that of the source."""
        return self.target.settings.iso / self.source.settings.iso

    @property
    def stops(self) -> int:
        """By how many sixths of an octave the aperture opens."""
        return self.source.settings.aperture_stop - self.target.settings.aperture_stop

    @property
    def opens_on_blur(self) -> bool:
        """Whether the aperture opens on something that is visibly out of focus."""
        return self.stops > 0 and self.blur >= VISIBLE_BLUR

    @property
    def opens_on_focus(self) -> bool:
        """Whether it opens on a scene with depth of which nothing visible is out of focus."""
        return self.stops > 0 and self.blur < VISIBLE_BLUR and self.scene.depth is not None

    @property
    def opens_flat(self) -> bool:
        """Whether it opens on a scene whose depth is not known, and which stays as it is."""
        return self.stops > 0 and self.scene.depth is None

    @property
    def cleaner(self) -> bool:
        """Whether the target has less noise than the source brings, averaged over the crop."""
        camera, mean = self.source.camera, self.target.mean
        exposed = camera.nlf(self.source.settings.iso).exposed(self.ratio)
        wanted = camera.nlf(self.target.settings.iso)
        return bool(noise_variance(mean, wanted).mean() < noise_variance(mean, exposed).mean())


#: What a pair asks for, in the order of the report.
GROUPS: dict[str, Callable[[Case], bool]] = {
    "all": lambda case: True,
    "ISO up": lambda case: case.iso_ratio > 1,
    "ISO down": lambda case: case.iso_ratio < 1,
    "brighter": lambda case: case.ratio > 1,
    "darker": lambda case: case.ratio < 1,
    "target noisier than the source": lambda case: not case.cleaner,
    "target cleaner than the source": lambda case: case.cleaner,
    "aperture closes": lambda case: case.stops < 0,
    "same aperture": lambda case: case.stops == 0,
    "aperture opens": lambda case: case.stops > 0,
    "opens, blur >= 1.5 px": lambda case: case.opens_on_blur,
    "opens, blur < 1.5 px": lambda case: case.opens_on_focus,
    "opens, no depth known": lambda case: case.opens_flat,
    "source saturated in > 1 %": lambda case: (
        float(case.source.saturated.float().mean()) > SATURATED
    ),
}
#: Groups of which every pair is in exactly one: where the average margin comes from.
PARTITION: dict[str, Callable[[Case], bool]] = {
    "opens, blur >= 1.5 px": lambda case: case.opens_on_blur,
    "opens, blur < 1.5 px": lambda case: case.opens_on_focus,
    "opens, no depth known": lambda case: case.opens_flat,
    "does not open, cleaner target": lambda case: case.stops <= 0 and case.cleaner,
    "does not open, noisier target": lambda case: case.stops <= 0 and not case.cleaner,
}


def pairs_of(mix: str, sequences: Sequence[CaptureSequence], camera: ReferenceCamera) -> list[Pair]:
    """The pairs of a mix, in ascending order.

    Args:
        mix: ``"all"``: any two captures of a sequence. ``"opening"``: the aperture opens, or in a
            tenth of them stays, and the scene has depth. ``"f/11 to f/4"``: these settings only.
        sequences: Where to choose from.
        camera: The body that takes the sequences.
    """
    if mix == "all":
        return select_pairs(sequences, "all", camera.camera)
    with_depth = {i for i, s in enumerate(sequences) if s.scene.depth is not None}
    aperture_blur = select_pairs(sequences, "aperture", camera.camera)
    pairs = [p for p in aperture_blur if p.sequence in with_depth]
    if mix == "opening":
        return pairs
    wanted = tuple(CameraSettings(100, 1.0, n).aperture_stop for n in (11, 4))

    def stops(pair: Pair) -> tuple[int, int]:
        settings = sequences[pair.sequence].settings
        return settings[pair.source].aperture_stop, settings[pair.target].aperture_stop

    return [p for p in pairs if stops(p) == wanted]


def drawn(pairs: list[Pair], count: int, seed: list[int]) -> list[Pair]:
    """`count` of the pairs, or all, in ascending order."""
    if count >= len(pairs):
        return pairs
    chosen = np.random.default_rng(seed).choice(len(pairs), count, replace=False)
    return [pairs[i] for i in sorted(chosen)]


def photographed(
    pairs: list[Pair],
    sequences: Sequence[CaptureSequence],
    camera: ReferenceCamera,
    crop: int,
    seed: int,
) -> Iterator[Case]:
    """The captures of every pair, of the same crop, each with noise of its own."""
    blurred_light: dict[tuple[int, int], Tensor] = {}
    for number, pair in enumerate(pairs):
        sequence = sequences[pair.sequence]
        scene = sequence.scene
        for old in [key for key in blurred_light if key[0] != pair.sequence]:
            del blurred_light[old]  # pairs come in order of their sequence
        rng = np.random.default_rng([seed, number, pair.sequence, pair.source, pair.target])
        top, left = (int(rng.integers(n - crop + 1)) for n in scene.light.shape[1:])
        window = (..., slice(top, top + crop), slice(left, left + crop))
        captures = []
        for settings in (sequence.settings[pair.source], sequence.settings[pair.target]):
            key = (pair.sequence, settings.aperture_stop)
            if key not in blurred_light:
                blurred_light[key] = camera.blurred_light(scene, settings.f_number)
            noise = int(rng.integers(2**31))
            light = blurred_light[key][window]
            captures.append(camera.capture(scene, settings, noise, light=light))
        source, target = captures
        blur = camera.blur_diameter(scene, source.settings.effective_f_number)[window]
        raw = RawImage(source.sample, source.settings, camera.camera)
        yield Case(scene, raw, target, float(blur.max()))
