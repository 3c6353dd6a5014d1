"""Recorded frames in place of simulated ones: what an environment on recorded grids runs on."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from ae_env.grid import ExposureGrid
from ae_env.observation import encode_observation
from ae_env.scenes.scene import Scene
from simulator.camera import LOW_CLIP, CameraProfile
from simulator.capture.batch import MODULES, FrameStatistics
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.sensor import LEAST_SIGNALS, CodeMeans
from simulator.noise.generator import noise_keys

#: The step that makes a recorded frame, and its index behind those of the simulator.
RECORDED, _MODULE = "recorded", len(MODULES)


class LookupBatch:
    """Looks frames up, where `simulator.capture.batch.CaptureBatch` would photograph them.

    It is used alike. Nothing is cached or planned.

    The scenes have `Scene.recorded`; `prepared` returns the merged light of one by its index.
    """

    def __init__(
        self,
        scenes: Sequence[Scene],
        prepared: Callable[[int], PreparedScene],
        camera: CameraProfile,
    ) -> None:
        self._scenes, self._prepared = scenes, prepared
        self._span, self._black = camera.digits[:2, :, None, None]
        self._white = camera.white_level

    def forget(self, indices: np.ndarray) -> None:
        """See `CaptureBatch.forget`."""

    def prepare(self, indices: np.ndarray, states: np.ndarray, gains: np.ndarray) -> None:
        """See `CaptureBatch.prepare`."""

    def prepared_scene(self, index: int) -> PreparedScene:
        """The merged light of the scene `index`."""
        return self._prepared(index)

    def record(
        self,
        indices: np.ndarray,
        states: np.ndarray,
        seeds: np.ndarray,
        frames: np.ndarray,
        row_gain: np.ndarray | None = None,
        means: CodeMeans | None = None,
        **outputs: np.ndarray,
    ) -> FrameStatistics:
        """Copies frames to the outputs; see `CaptureBatch.record`."""
        pairs: Any = [(self._scenes[i], s) for i, s in zip(indices, states, strict=True)]
        shown = np.stack([one.recorded[one.frame_of_state[s]].numpy() for one, s in pairs])
        digital = np.rint(shown * self._span + self._black).clip(0.0, self._white)
        if "codes" in outputs:
            encode_observation(torch.from_numpy(shown), out=torch.from_numpy(outputs["codes"]))
        if means is not None:
            means.fill(outputs["codes"])
        if "numbers" in outputs:
            outputs["numbers"][:] = digital
        for name in LEAST_SIGNALS.keys() & outputs:
            np.clip(shown, LEAST_SIGNALS[name], 1.0, out=outputs[name])
        count, nothing = len(shown), np.zeros(len(shown))
        return FrameStatistics(
            clipped_low=(shown <= LOW_CLIP).reshape(count, -1).mean(axis=1),
            clipped_high=(digital >= self._white).reshape(count, -1).mean(axis=1),
            excess_variance=nothing,
            predicted_error=nothing,
            modules=np.full(count, _MODULE),
            source_noise=None,
            keys=noise_keys(seeds, frames),
        )


def nearest_recorded(scene: Scene, grid: ExposureGrid) -> np.ndarray:
    """(S,) int64: each state itself where it was recorded, else the recorded one nearest to it.

    Nearest in exposure, then in the three controls, all in stops; ties to the lower ISO.
    """
    assert scene.allowed is not None
    there = np.flatnonzero(scene.allowed)
    states = grid.apex
    controls = np.abs(states[:, None] - states[there]).sum(axis=-1)
    exposure = np.abs(grid.ev100[:, None] - grid.ev100[there])
    # A tenth of a stop of exposure is worth more than any distance of the controls.
    distance = (exposure * 10.0).round() * 1000.0 + controls
    return there[distance.argmin(axis=1)]
