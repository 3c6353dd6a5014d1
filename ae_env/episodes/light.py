"""The light of the current frame of each episode, for the exposure times that are asked for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ae_env.episodes.state import Episodes
from ae_env.lighting import Lighting, RollingShutter
from ae_env.scenes.scene import Scene
from simulator.camera import CameraProfile


class FrameLight:
    """Light relative to the scenes' own.

    Args:
        lighting: How it changes.
        episodes: In which frame each episode is.
        scenes: Scenes of the episodes.
        camera: The body, whose shutter rolls.
        resolution: Rows of a frame.
    """

    def __init__(
        self,
        lighting: Lighting,
        episodes: Episodes,
        scenes: Sequence[Scene],
        camera: CameraProfile,
        resolution: int,
    ) -> None:
        self.lighting, self.episodes, self.scenes = lighting, episodes, scenes
        self.camera, self.resolution = camera, resolution

    def of(self, env_index: int, exposure_time: float) -> tuple[float, np.ndarray | None]:
        """Light of an exposure in the current frame of the episode of environment `env_index`.

        Args:
            env_index: Which episode.
            exposure_time: Time the shutter is open [s].

        Returns:
            That of the frame, and (R,) that of each row relative to it; None where all rows have
            the same.
        """
        frame, phase = self.episodes.frame.item(env_index), self.episodes.phase.item(env_index)
        if not self.lighting.within_frame:
            return self.lighting.gain(frame, exposure_time, phase), None
        box = self.scenes[self.episodes.scene[env_index]].box_factor
        shutter = RollingShutter(self.resolution, self.camera.row_time, 2 * box)
        return self.lighting.rows(frame, exposure_time, phase, shutter)

    def of_each(
        self, env_indices: np.ndarray, exposure_times: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Light of one exposure of each of `env_indices` (B,).

        Returns:
            (B,) and (B, R) as of `of`; None where all rows of all frames are alike.
        """
        pairs = zip(env_indices.tolist(), exposure_times.tolist(), strict=True)
        return _together([self.of(env_index, time) for env_index, time in pairs])

    def of_states(
        self, env_index: int, exposure_times: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """The same for `exposure_times` (S,) in one environment; equal ones are worked out once."""
        times = exposure_times.tolist()
        known = {time: self.of(env_index, time) for time in set(times)}
        return _together([known[time] for time in times])


def _together(
    lights: Sequence[tuple[float, np.ndarray | None]],
) -> tuple[np.ndarray, np.ndarray | None]:
    gains = np.array([gain for gain, _ in lights])
    shown = [rows for _, rows in lights if rows is not None]
    if not shown:
        return gains, None
    alike = np.ones_like(shown[0])
    return gains, np.stack([alike if rows is None else rows for _, rows in lights])
