"""Many scenes side by side, photographed in batches: what the environment runs on.

Nothing is worked out twice: all that a frame depends on, except for its noise, is planned when a
state is first used, and cached as a row of columns; blurred light, as long as its scene is shown. A
batch of frames is then one call of `simulator.capture.sensor.record`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np

from simulator.camera import CameraProfile
from simulator.capture.blurred_light import Pool
from simulator.capture.decision import LIGHT_LIMIT, Exposure, decide
from simulator.capture.plan import noise_balance, predict_errors
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.sensor import Noise, Transitions, exposure_table, noise_keys, record
from simulator.capture.statistics import LightStatistics
from simulator.optics.discs import Blur, blur_many
from simulator.settings import CameraSettings
from simulator.utils.compute import parallel_ranges

#: The steps of a capture that a scene may not need, in order; the exposure always runs.
_STEPS = ("noise_reduction", "aperture", "defocus", "motion_blur", "noise")
_NOISE_BIT = 1 << _STEPS.index("noise")
#: Names of the steps that made a frame, joined by ``"+"``: one entry for each combination.
MODULES = tuple(
    "+".join(["exposure", *(name for bit, name in enumerate(_STEPS) if index >> bit & 1)])
    for index in range(1 << len(_STEPS))
)


@dataclass
class FrameStatistics:
    """Statistics of a batch of frames, (B,) each."""

    clipped_low: np.ndarray  # share of the samples that are clipped low: at most 2**-10 of white
    clipped_high: np.ndarray  # share of the samples that are clipped high: at white
    #: Mean over the pixels of the noise variance beyond the target's, relative to it; in flickering
    #: light, that of the frame's mean light.
    excess_variance: np.ndarray
    #: `SimulationPlan.predicted_error`; of a light without noise only what is left out.
    predicted_error: np.ndarray
    modules: np.ndarray  # int64 index into `MODULES`; of a recorded frame, their number
    source_noise: np.ndarray  # (B, 2, 4) shot and read noise of the source in the frame
    keys: np.ndarray  # of the noise, uint64


class FrameSource(Protocol):
    """Frames of n scenes, each at any of S states: simulated, or looked up if they were recorded.

    For each batch of frames, call `prepare`, then `record`. When another scene is to be shown under
    an index, call `forget` first.
    """

    def forget(self, indices: np.ndarray) -> None:
        """Drops all that is cached for the scenes `indices`."""

    def prepare(self, indices: np.ndarray, states: np.ndarray, gains: np.ndarray) -> None:
        """Plans the next frames, and makes their light.

        All are (B,): scenes, the state of each, and its light relative to the scene's own.
        """

    def record(
        self,
        indices: np.ndarray,
        states: np.ndarray,
        seeds: np.ndarray,
        frames: np.ndarray,
        row_gain: np.ndarray | None = None,
        **outputs: np.ndarray,
    ) -> FrameStatistics:
        """Records scenes that are prepared, and fills the outputs.

        Args:
            indices, states: As they were prepared.
            seeds: (B,) integers >= 0, of the noise.
            frames: (B,) numbers that the noise of one seed differs by.
            row_gain: (B, H) light of each row relative to the gain that was prepared for; None
                where all rows have the same.
            outputs: Any of ``codes``, ``numbers`` and ``signals`` of `simulator.capture.sensor`,
                each (B, 4, H, W).
        """

    def prepared_scene(self, index: int) -> PreparedScene:
        """The scene `index` in its own light, as it is photographed."""


class CaptureBatch:
    """`FrameSource` that simulates the frames, on the CPU.

    `prepared` returns the scene of an index, in its own light, when it is first photographed. With
    `cache_light` the defocused light of every f-number is cached until a scene is forgotten; else
    only that of the latest f-number. A pickled copy works everything out again.
    """

    def __init__(
        self,
        prepared: Callable[[int], PreparedScene],
        num_scenes: int,
        states: Sequence[CameraSettings],
        camera: CameraProfile,
        *,
        noise: Noise | None,
        cache_light: bool,
    ) -> None:
        self._prepared, self.num_scenes, self.states = prepared, num_scenes, states
        self.camera, self.noise, self._cache_light = camera, noise, cache_light
        self._scenes: dict[int, PreparedScene] = {}
        self._pool = Pool(cache_light)
        # Row of the blurred light that each scene has at present.
        self._blurred_row = np.full(num_scenes, -1)
        # Planned captures as columns, by scene and state: all that a frame depends on, except for
        # its noise. A row takes some 40 bytes, the rest of its memory when it is used.
        count = num_scenes * len(states)
        self._gain = np.full(count, np.nan)  # light that it was planned for; NaN where it was not
        self._table = np.zeros((count, 5, 4), np.float32)  # of `exposure_table`
        # As in `FrameStatistics`; NaN where it depends on blurred light that is not made yet.
        self._excess_variance, self._predicted_error = np.zeros((2, count))
        self._modules = np.zeros(count, np.int64)
        # Whether the light must be blurred, else it is the scene's own; and whether any ever was.
        self._blurs, self._any_blurs = np.zeros(count, bool), False
        # Light (4, H, W), of a blur until its scene blurs another; `Exposure.remaining_variance` of
        # it; and the exposure, where it must be blurred.
        self._light, self._remaining_variance, self._exposure = np.empty((3, count), object)

    def __reduce__(self) -> tuple[Any, ...]:
        made = partial(CaptureBatch, noise=self.noise, cache_light=self._cache_light)
        return made, (self._prepared, self.num_scenes, self.states, self.camera)

    def forget(self, indices: np.ndarray) -> None:
        """See `FrameSource`; the memory is used again."""
        count, objects = len(self.states), (self._light, self._remaining_variance, self._exposure)
        for index in indices.tolist():
            rows = slice(index * count, (index + 1) * count)
            self._gain[rows] = np.nan
            for column in objects:
                column[rows] = None
            scene = self._scenes.pop(index, None)
            if scene is not None:
                scene.blurred_light.release()
            self._blurred_row[index] = -1

    def prepare(self, indices: np.ndarray, states: np.ndarray, gains: np.ndarray) -> None:
        """See `FrameSource`."""
        rows = indices * len(self.states) + states
        stale = self._gain[rows] != gains
        if stale.any():
            self._plan(indices[stale], rows[stale], gains[stale])
        if self._any_blurs:
            missing = self._blurs[rows] & (self._blurred_row[indices] != rows)
            if missing.any():
                self._blur(indices[missing], rows[missing])

    def transitions(self, indices: np.ndarray, states: np.ndarray) -> Transitions:
        """Light and exposures of the frames of scenes that are prepared; see `record`."""
        rows, remaining = indices * len(self.states) + states, None
        if self._any_blurs:  # else all of the source's variance remains
            remaining = self._remaining_variance[rows]
        return Transitions(self._light[rows], self._table[rows], remaining)

    def record(
        self,
        indices: np.ndarray,
        states: np.ndarray,
        seeds: np.ndarray,
        frames: np.ndarray,
        row_gain: np.ndarray | None = None,
        **outputs: np.ndarray,
    ) -> FrameStatistics:
        """See `FrameSource`."""
        rows = indices * len(self.states) + states
        keys, transitions = noise_keys(seeds, frames), self.transitions(indices, states)
        read_noise = None
        if self.noise == "sensor":
            pairs = zip(indices.tolist(), states.tolist(), strict=True)
            boxes = [(self.states[s].iso, self.prepared_scene(i).box_factor) for i, s in pairs]
            read_noise = [self.camera.read_noise(iso, box) for iso, box in boxes]
        counts = record(
            transitions,
            self.camera,
            keys=None if self.noise is None else keys,
            noise=self.noise or "bank",
            read_noise=read_noise,
            row_gain=row_gain,
            count=True,
            **outputs,
        )
        samples = transitions.light[0].numel()
        return FrameStatistics(
            clipped_low=counts[:, 0] / samples,
            clipped_high=counts[:, 1] / samples,
            excess_variance=self._excess_variance[rows],
            predicted_error=self._predicted_error[rows],
            modules=self._modules[rows],
            source_noise=transitions.averaged_table()[:, 3:],
            keys=keys,
        )

    def prepared_scene(self, index: int) -> PreparedScene:
        """See `FrameSource`."""
        scene = self._scenes.get(index)
        if scene is None:
            scene = self._prepared(index)
            # Scenes that are shown several times share their light, but not what is blurred of it.
            light = scene.blurred_light.copy(pool=self._pool)
            scene = self._scenes[index] = scene.changed(blurred_light=light)
        return scene

    # -- planning -----------------------------------------------------------------------------

    def _plan(self, indices: np.ndarray, rows: np.ndarray, gains: np.ndarray) -> None:
        """Works out `rows` (K,) for scenes `indices` in the light `gains`."""
        noisy, exposures = self.noise is not None, []
        for index, row, gain in zip(indices.tolist(), rows.tolist(), gains.tolist(), strict=True):
            scene, settings = self.prepared_scene(index), self.states[row % len(self.states)]
            exposure = decide(scene, settings, gain=gain)
            blurs = exposure.defocus_px or exposure.motion_px or exposure.opened_to is not None
            self._blurs[row], self._exposure[row] = blurs, exposure if blurs else None
            self._remaining_variance[row] = None  # `_begin_blur` knows it
            self._any_blurs |= bool(blurs)
            if not blurs:
                self._light[row] = scene.blurred_light.source(exposure).contiguous()
            excess = _excess_variance(scene.blurred_light.statistics, exposure) if noisy else 0.0
            self._excess_variance[row] = excess
            error = exposure.left_out
            if not scene.nlf.is_zero:
                shown = exposure if noisy else decide(scene, settings, noise=False, gain=gain)
                error = math.hypot(*predict_errors(scene, settings, shown).values())
            self._predicted_error[row] = error
            found = noisy * _NOISE_BIT
            for step in exposure.steps:
                found |= step.runs << _STEPS.index(step.name)
            self._modules[row] = found
            exposures.append(exposure)
        self._table[rows] = exposure_table(exposures)
        self._gain[rows] = gains  # last: what is interrupted stays unknown
        self._blurred_row[indices] = -1

    def _blur(self, indices: np.ndarray, rows: np.ndarray) -> None:
        """Makes the light of `rows`, on as many threads as torch may use."""
        planned = list(zip(indices.tolist(), rows.tolist(), strict=True))
        try:
            _each(self._open, planned)
            begun = [self._begin_blur(index, row) for index, row in planned]
            blur_many([blur for blur in begun if isinstance(blur, Blur)], limit=LIGHT_LIMIT)
            _each(lambda task: task(), [(task,) for task in begun if callable(task)])
            _each(self._balance, planned)
        except BaseException:  # some of the light is not made
            self.forget(indices)
            raise
        self._blurred_row[indices] = rows

    def _open(self, index: int, row: int) -> None:
        """Opens the aperture where that is needed; the scene caches its result."""
        if self._exposure[row].opened_to is not None:
            self._scenes[index].blurred_light.source(self._exposure[row])

    def _begin_blur(self, index: int, row: int) -> Blur | Callable[[], None] | None:
        exposure = self._exposure[row]
        self._light[row], blur = self._scenes[index].blurred_light.begin(exposure)
        remaining = exposure.remaining_variance
        if remaining is not None:
            remaining = remaining.float().contiguous()
        self._remaining_variance[row] = remaining
        return blur

    def _balance(self, index: int, row: int) -> None:
        """Computes the excess variance where it depends on the pixels."""
        exposure = self._exposure[row]
        if np.isnan(self._excess_variance[row]):
            self._excess_variance[row], _ = noise_balance(self._light[row], exposure)
        aperture_blur = self._scenes[index].aperture_blur
        if exposure.opened_to is not None and aperture_blur is not None and not self._cache_light:
            aperture_blur.forget()


def _each(task: Callable[..., object], arguments: Sequence[tuple[Any, ...]]) -> None:
    """Calls `task` with each of `arguments`, on as many threads as torch may use."""
    parallel_ranges(lambda a, b: [task(*each) for each in arguments[a:b]], len(arguments))


def _excess_variance(statistics: LightStatistics, exposure: Exposure) -> float:
    """See `FrameStatistics`; NaN where it depends on the pixels."""
    if exposure.source.is_zero:
        return 0.0
    source, target = exposure.source_noise, exposure.target
    pairs = zip((*source.shot, *source.read), (*target.shot, *target.read), strict=True)
    if all(present <= wanted for present, wanted in pairs):
        return 0.0
    if exposure.remaining_variance is not None:
        return math.nan
    return statistics.relative_excess_variance(exposure.ratio, source, target)
