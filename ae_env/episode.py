"""One running episode: what was drawn for it, and the light that it keeps for its next frames."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from ae_env.scenes.scene import Scene
from ae_env.score_table import ScoreTable, scene_latent
from simulator.blur import motion_blur
from simulator.camera import CameraProfile
from simulator.capture import Exposure, defocused_light
from simulator.latent import Latent


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
    _latent: tuple[float, Latent] | None = None  # by gain
    _defocused: dict[tuple[Any, ...], torch.Tensor] = field(default_factory=dict)  # by aperture
    _blurred: tuple[tuple[Any, ...], torch.Tensor] | None = None  # by all blur

    def latent(self, scene: Scene, camera: CameraProfile, gain: float) -> Latent:
        """What `camera` sees of the episode's `scene` at `gain` times its own light."""
        if self._latent is None:
            latent = scene_latent(scene, camera, speed=self.speed, defocus=self.defocus, gain=gain)
            self._latent = (gain, latent)
        elif self._latent[0] != gain:  # the light that its aperture has opened serves on
            self._latent = (gain, replace(self._latent[1], gain=gain))
        return self._latent[1]

    def blurred_light(self, latent: Latent, exposure: Exposure, keep: bool) -> torch.Tensor:
        """The light (4, H, W) of `latent` with the blur of `exposure`, before it is exposed.

        The latest one is kept, because an agent that has settled repeats it, and with `keep` also
        the defocused light of each f-number.
        """
        lens = (exposure.denoised, exposure.opened_to, exposure.defocus_px)
        key = (*lens, exposure.motion_px)
        if self._blurred is not None and self._blurred[0] == key:
            return self._blurred[1]
        defocused = self._defocused.get(lens)
        if defocused is None:
            defocused = defocused_light(latent.source_light(exposure), exposure.defocus_px)
            if keep:
                self._defocused[lens] = defocused
            elif latent.opening is not None:
                self._latent = None  # it keeps the light of each f-number, too
        self._blurred = (key, motion_blur(defocused, exposure.motion_px))
        return self._blurred[1]
