"""One running episode: what was drawn for it, and the light that it keeps for its next frames."""

from __future__ import annotations

from dataclasses import dataclass, field

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
    _defocused: dict[float, torch.Tensor] = field(default_factory=dict)  # by blur diameter
    _blurred: tuple[tuple[float, float], torch.Tensor] | None = None  # by both blurs

    def latent(self, scene: Scene, camera: CameraProfile, gain: float) -> Latent:
        """What `camera` sees of the episode's `scene` at `gain` times its own light."""
        if self._latent is None or self._latent[0] != gain:
            latent = scene_latent(scene, camera, speed=self.speed, defocus=self.defocus, gain=gain)
            self._latent = (gain, latent)
        return self._latent[1]

    def blurred_light(self, light: torch.Tensor, exposure: Exposure, keep: bool) -> torch.Tensor:
        """The scene's `light` (4, H, W) with the blur of `exposure`, before it is exposed.

        The latest one is kept, because an agent that has settled repeats it, and with `keep` also
        the defocused light of each f-number.
        """
        key = (exposure.defocus_px, exposure.motion_px)
        if self._blurred is not None and self._blurred[0] == key:
            return self._blurred[1]
        defocused = self._defocused.get(exposure.defocus_px)
        if defocused is None:
            defocused = defocused_light(light, exposure.defocus_px)
            if keep:
                self._defocused[exposure.defocus_px] = defocused
        self._blurred = (key, motion_blur(defocused, exposure.motion_px))
        return self._blurred[1]
