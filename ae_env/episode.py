"""One running episode: what was drawn for it, and the light that it keeps for its next frames."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from ae_env.score_table import ScoreTable
from simulator.blur_kernels import Blur
from simulator.exposure import Exposure
from simulator.latent import Latent


@dataclass(frozen=True, eq=False)
class Shot:
    """A capture that was planned: all that a frame depends on, but for its light and its noise.

    Args:
        exposure: What happens to the light.
        table: (5, 4) float32, the exposure as `simulator.kernels.record_frames` takes it.
        excess_noise: As in `info`; None where it takes the blurred light to tell.
        modules: Names of the steps, joined by ``"+"``.
        light: (4, H, W) what is exposed, where that is the scene's own; None if it is blurred.
    """

    exposure: Exposure
    table: np.ndarray
    excess_noise: float | None
    modules: str
    light: torch.Tensor | None


#: Plans by state, each with the gain of the light that it was made for.
Shots = dict[int, tuple[float, Shot]]


class Buffers:
    """Images to write to that are used again: new memory costs more than what is written to it.

    Args:
        shape: Of each image.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.shape = shape
        self._free: list[torch.Tensor] = []

    def take(self) -> torch.Tensor:
        """A float32 image with any content."""
        try:
            return self._free.pop()  # atomic: threads share the list
        except IndexError:
            return torch.empty(self.shape)

    def give_back(self, image: torch.Tensor) -> None:
        """Lets `image` be taken again."""
        self._free.append(image)


@dataclass
class Episode:
    """One scene being photographed.

    Args:
        scene: Index of the scene.
        state: Current exposure state.
        speed: Image speed [frame heights per second].
        defocus: Blur diameter at f/4 [pixel of a 64-pixel frame].
        phase: Phase of a periodic lighting, in [0, 1).
        noise_seed: Seed of the noise; the frame number is added to it.
        frame: Number of the current frame.
        pending: States on their way to the camera, the next first.
        image_mean: Mean code of the latest frame / 255, where a cost needs it.
        table: Score table of the current frame, with its gain.
        closed_parts: Scores of all states that have a closed form, in static light.
        latent: What the camera sees of the scene in its own light, once it was asked for.
        shots: Captures that were planned.
        focus_drive: Blur at f/4 that the focus drive tells of [pixel of a 64-pixel frame].
    """

    scene: int
    state: int
    speed: float
    defocus: float
    phase: float
    noise_seed: int
    frame: int = 0
    pending: list[int] = field(default_factory=list)
    image_mean: float = float("nan")
    table: tuple[float, ScoreTable] | None = None
    closed_parts: dict[str, np.ndarray] | None = None
    latent: Latent | None = None
    shots: Shots = field(default_factory=dict)
    focus_drive: float = 0.0
    _defocused: dict[tuple[Any, ...], torch.Tensor] = field(default_factory=dict)  # by aperture
    _blurred: tuple[tuple[Any, ...], torch.Tensor] | None = None  # by all blur
    _streak: torch.Tensor | None = None  # of the buffers

    def blurred_light(
        self, exposure: Exposure, buffers: Buffers, keep: bool
    ) -> tuple[torch.Tensor, Blur | None]:
        """The light (4, H, W) of `latent` with the blur of `exposure`, valid until the next call.

        The latest one is kept, because an agent that has settled repeats it, and with `keep` also
        the defocused light of each f-number.

        Returns:
            The light, and what must be done (`simulator.blur_kernels.blur_many`) to fill it; None
            where that was done before.
        """
        lens = (exposure.denoised, exposure.opened_to, exposure.defocus_px)
        key = (*lens, exposure.motion_px)
        if self._blurred is not None and self._blurred[0] == key:
            return self._blurred[1], None
        light = self._defocused.get(lens)
        source = defocused = moved = None
        if light is None:
            assert self.latent is not None
            light = source = self.latent.source_light(exposure).contiguous()
            if exposure.defocus_px:
                self._drop_defocused(buffers, keep)
                light = defocused = self._defocused[lens] = buffers.take()
        if exposure.motion_px:
            source = light if source is None else source
            if self._streak is None:
                self._streak = buffers.take()
            light = moved = self._streak
        self._blurred = (key, light)
        if defocused is None and moved is None:
            return light, None
        assert source is not None
        return light, Blur(source, exposure.defocus_px, defocused, exposure.motion_px, moved)

    def _drop_defocused(self, buffers: Buffers, keep: bool) -> None:
        if not keep:
            for image in self._defocused.values():
                buffers.give_back(image)
            self._defocused.clear()

    def end(self, buffers: Buffers) -> None:
        """Gives back what the episode keeps."""
        self._drop_defocused(buffers, keep=False)
        if self._streak is not None:
            buffers.give_back(self._streak)
        self._streak = self._blurred = None
