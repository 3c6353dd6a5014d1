"""Many scenes side by side, photographed in batches: what the environment runs on.

A capture here is cheap because nothing is worked out twice. All that a frame depends on, except for
its noise, is planned when a state is first used, and cached as a row of columns. Blurred light is
cached as long as its scene is shown. A batch of frames is then one call of
`simulator.capture.sensor.record`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch

from simulator.camera import CameraProfile
from simulator.capture.blurred_light import Pool
from simulator.capture.exposure import LIGHT_LIMIT, Exposure, decide
from simulator.capture.plan import noise_balance, predict_errors
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.sensor import (
    Noise,
    Transitions,
    exposure_table,
    noise_keys,
    record,
    single_normals,
)
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
    """Statistics of a batch of frames, (B,) each.

    Args:
        clipped_low: Share of the samples that are clipped low: at most 2**-10 of white.
        clipped_high: Share of the samples that are clipped high: at white.
        excess_variance: Mean over the pixels of the noise variance beyond the target's, relative
            to it; in flickering light, that of the frame's mean light.
        predicted_error: `SimulationPlan.predicted_error`, in units of the target's noise; of a
            light without noise only what is left out.
        modules: (B,) int64 index into `MODULES`: the steps that ran.
        source_noise: (B, 2, 4) shot and read noise of the source in the frame.
        keys: Keys of the noise, uint64.
    """

    clipped_low: np.ndarray
    clipped_high: np.ndarray
    excess_variance: np.ndarray
    predicted_error: np.ndarray
    modules: np.ndarray
    source_noise: np.ndarray
    keys: np.ndarray

    def sensor_normals(self, count: int) -> np.ndarray:
        """(B, count) standard normals of each frame, apart from those of its pixels."""
        return single_normals(self.keys, count)


class FrameSource(Protocol):
    """Frames of n scenes, each at any of S states: simulated, or looked up if they were recorded.

    For each batch of frames, call `prepare`, then `record`. When another scene is to be shown under
    an index, call `forget` first.
    """

    def forget(self, indices: np.ndarray) -> None:
        """Drops all that is cached for the scenes `indices`."""

    def prepare(self, indices: np.ndarray, states: np.ndarray, gains: np.ndarray) -> None:
        """Plans the next frames, and makes their light.

        Args:
            indices: (B,) of the scenes.
            states: (B,) at which each is photographed.
            gains: (B,) light of each exposure relative to the scene's own.
        """

    def record(
        self,
        indices: np.ndarray,
        states: np.ndarray,
        seeds: np.ndarray,
        frames: np.ndarray,
        *,
        row_gain: np.ndarray | None = None,
        codes: np.ndarray | None = None,
        numbers: np.ndarray | None = None,
        signals: np.ndarray | None = None,
    ) -> FrameStatistics:
        """Records scenes that are prepared, and fills every output that is given.

        Args:
            indices: (B,) of the scenes.
            states: (B,) at which each is photographed.
            seeds: (B,) integers >= 0, of the noise.
            frames: (B,) numbers that the noise of one seed differs by.
            row_gain: (B, H) light of each row relative to the gain that was prepared for; None
                where all rows have the same.
            codes: (B, 4, H, W) uint8, companded (`simulator.capture.exposure.PEDESTAL`).
            numbers: (B, 4, H, W) uint16, digital numbers.
            signals: (B, 4, H, W) float32, on the scale where white is 1.
        """

    def prepared_scene(self, index: int) -> PreparedScene:
        """The scene `index` in its own light, as it is photographed."""


class CaptureBatch:
    """`FrameSource` that simulates the frames, on the CPU.

    A pickled copy works everything out again.

    Args:
        prepared: Function that returns the scene of an index, in its own light; called when the
            scene is first photographed.
        num_scenes: Number of scenes, n.
        states: The settings of the S states.
        camera: The body.
        noise: How the noise is made; None for no noise.
        cache_light: Whether the defocused light of every f-number is cached until a scene is
            forgotten; else only that of the latest f-number.
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
        self._forget_all()

    def _forget_all(self) -> None:
        self._table = FrameTable(self.num_scenes * len(self.states))
        self._scenes: dict[int, PreparedScene] = {}
        self._pool = Pool(self._cache_light)
        # Row of the blurred light that each scene has at present.
        self._blurred_row = np.full(self.num_scenes, -1)

    def __getstate__(self) -> dict[str, Any]:
        cached = ("_table", "_scenes", "_pool", "_blurred_row")
        return {name: value for name, value in vars(self).items() if name not in cached}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._forget_all()

    def forget(self, indices: np.ndarray) -> None:
        """See `FrameSource`; the memory is used again."""
        count = len(self.states)
        for index in indices.tolist():
            self._table.forget(slice(index * count, (index + 1) * count))
            scene = self._scenes.pop(index, None)
            if scene is not None:
                scene.blurred_light.release()
            self._blurred_row[index] = -1

    def prepare(self, indices: np.ndarray, states: np.ndarray, gains: np.ndarray) -> None:
        """See `FrameSource`."""
        rows = indices * len(self.states) + states
        stale = self._table.gain[rows] != gains
        if stale.any():
            self._plan(indices[stale], rows[stale], gains[stale])
        if self._table.any_blurs:
            missing = self._table.blurs[rows] & (self._blurred_row[indices] != rows)
            if missing.any():
                self._blur(indices[missing], rows[missing])

    def transitions(self, indices: np.ndarray, states: np.ndarray) -> Transitions:
        """Light and exposures of the frames of scenes that are prepared; see `record`."""
        rows, remaining = indices * len(self.states) + states, None
        if self._table.any_blurs:  # else all of the source's variance remains
            remaining = self._table.remaining_variance[rows]
        return Transitions(self._table.light[rows], self._table.table[rows], remaining)

    def record(
        self,
        indices: np.ndarray,
        states: np.ndarray,
        seeds: np.ndarray,
        frames: np.ndarray,
        *,
        row_gain: np.ndarray | None = None,
        codes: np.ndarray | None = None,
        numbers: np.ndarray | None = None,
        signals: np.ndarray | None = None,
    ) -> FrameStatistics:
        """See `FrameSource`."""
        rows, columns = indices * len(self.states) + states, self._table
        keys, transitions = noise_keys(seeds, frames), self.transitions(indices, states)
        read_noise = None
        if self.noise == "sensor":
            pairs = zip(indices.tolist(), states.tolist(), strict=True)
            read_noise = [self.prepared_scene(i).read_noise(self.states[s]) for i, s in pairs]
        counts = record(
            transitions,
            self.camera,
            keys=None if self.noise is None else keys,
            noise=self.noise or "bank",
            read_noise=read_noise,
            row_gain=row_gain,
            codes=codes,
            numbers=numbers,
            signals=None if signals is None else torch.from_numpy(signals),
            count=True,
        )
        samples = transitions.light[0].numel()
        return FrameStatistics(
            clipped_low=counts[:, 0] / samples,
            clipped_high=counts[:, 1] / samples,
            excess_variance=columns.excess_variance[rows],
            predicted_error=columns.predicted_error[rows],
            modules=columns.modules[rows],
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
            if len(scene.targets) < len(self.states):  # else another episode asked for them
                for settings in self.states:
                    scene.targets[settings]
        return scene

    # -- planning -----------------------------------------------------------------------------

    def _plan(self, indices: np.ndarray, rows: np.ndarray, gains: np.ndarray) -> None:
        """Works out `rows` (K,) for scenes `indices` in the light `gains`."""
        columns, noisy, exposures = self._table, self.noise is not None, []
        for index, row, gain in zip(indices.tolist(), rows.tolist(), gains.tolist(), strict=True):
            scene, settings = self.prepared_scene(index), self.states[row % len(self.states)]
            exposure = decide(scene, settings, gain=gain)
            blurs = exposure.defocus_px or exposure.motion_px or exposure.opened_to is not None
            columns.blurs[row], columns.exposure[row] = blurs, exposure if blurs else None
            columns.remaining_variance[row] = None  # `_begin_blur` knows it
            columns.any_blurs |= bool(blurs)
            if not blurs:
                columns.light[row] = scene.blurred_light.source(exposure).contiguous()
            excess = _excess_variance(scene.blurred_light.statistics, exposure) if noisy else 0.0
            columns.excess_variance[row] = excess
            error = exposure.left_out
            if not scene.nlf.is_zero:
                shown = exposure if noisy else decide(scene, settings, noise=False, gain=gain)
                error = math.hypot(*predict_errors(scene, settings, shown).values())
            columns.predicted_error[row] = error
            columns.modules[row] = _modules(exposure, noisy)
            exposures.append(exposure)
        columns.table[rows] = exposure_table(exposures)
        columns.gain[rows] = gains  # last: what is interrupted stays unknown
        self._blurred_row[indices] = -1

    def _blur(self, indices: np.ndarray, rows: np.ndarray) -> None:
        """Makes the light of `rows`, on as many threads as torch may use."""
        planned = list(zip(indices.tolist(), rows.tolist(), strict=True))
        exposures = self._table.exposure
        try:
            opened = [pair for pair in planned if exposures[pair[1]].opened_to is not None]
            _each(self._open, opened)
            begun = [self._begin_blur(index, row) for index, row in planned]
            blur_many([blur for blur in begun if isinstance(blur, Blur)], limit=LIGHT_LIMIT)
            _each(lambda task: task(), [(task,) for task in begun if callable(task)])
            _each(self._balance, planned)
        except BaseException:  # some of the light is not made
            self.forget(indices)
            raise
        self._blurred_row[indices] = rows

    def _open(self, index: int, row: int) -> None:
        """Opens the aperture, which caches its result."""
        self._scenes[index].blurred_light.source(self._table.exposure[row])

    def _begin_blur(self, index: int, row: int) -> Blur | Callable[[], None] | None:
        columns, exposure = self._table, self._table.exposure[row]
        columns.light[row], blur = self._scenes[index].blurred_light.begin(exposure)
        remaining = exposure.remaining_variance
        if remaining is not None:
            remaining = remaining.float().contiguous()
        columns.remaining_variance[row] = remaining
        return blur

    def _balance(self, index: int, row: int) -> None:
        """Computes the excess variance where it depends on the pixels."""
        columns = self._table
        if np.isnan(columns.excess_variance[row]):
            balance = noise_balance(columns.light[row], columns.exposure[row])
            columns.excess_variance[row] = balance.relative_excess_variance
        if columns.exposure[row].opened_to is not None and not self._cache_light:
            self._scenes[index].blurred_light.forget_opened()


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


def _modules(exposure: Exposure, noise: bool) -> int:
    """Index into `MODULES`."""
    found = noise * _NOISE_BIT
    for step in exposure.steps:
        found |= step.runs << _STEPS.index(step.name)
    return found


class FrameTable:
    """Planned captures: all that a frame depends on except for its noise, as columns.

    A row takes some 40 bytes from the start, the rest of its memory when it is used.

    Attributes:
        gain: Light that the row was planned for; NaN where it was not planned.
        table: (5, 4) float32 each, of `exposure_table`.
        excess_variance: As in `FrameStatistics`; NaN where it depends on blurred light that is not
            made yet.
        predicted_error: As in `FrameStatistics`.
        modules: As in `FrameStatistics`.
        light: (4, H, W) that is exposed; where it is blurred, until its scene blurs another.
        remaining_variance: `Exposure.remaining_variance` of that light; None for all.
        blurs: Whether the light must be blurred; else it is the scene's own.
        any_blurs: Whether that was ever so in any row.
        exposure: `Exposure` of light that must be blurred; else None.
    """

    def __init__(self, count: int) -> None:
        self.gain, self.excess_variance = np.full(count, np.nan), np.zeros(count)
        self.predicted_error = np.zeros(count)
        self.modules = np.zeros(count, np.int64)
        self.table, self.blurs = np.zeros((count, 5, 4), np.float32), np.zeros(count, bool)
        self.any_blurs = False
        objects = np.empty((3, count), object)
        self.light, self.remaining_variance, self.exposure = objects

    def forget(self, rows: slice) -> None:
        """Makes `rows` unknown."""
        self.gain[rows] = np.nan
        self.light[rows] = self.remaining_variance[rows] = self.exposure[rows] = None
