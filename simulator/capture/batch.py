"""Many scenes side by side, photographed in batches: what the environment runs on.

Nothing is worked out twice: all that a frame depends on, except for its noise, is planned when a
state is first used, and cached as a row of columns; blurred light, as long as its scene is shown. A
batch of frames is then one call of `simulator.capture.sensor.record`.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np
import torch

from simulator.camera import CameraProfile
from simulator.capture.blurred_frames import BLUR
from simulator.capture.blurred_light import new_frames
from simulator.capture.columns import (
    BLURS,
    SCENE,
    blur_column,
    fits_columns,
    moved_columns,
    noise_columns,
    plan_frames,
    scene_column,
    state_columns,
    statistics_column,
    subject_column,
    vignetting_column,
    widest_defocus,
)
from simulator.capture.decision import Exposure, decide
from simulator.capture.plan import noise_balance, predict_errors
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.sensor import Transitions, exposure_table, record
from simulator.capture.statistics import BINS, LightStatistics
from simulator.noise.generator import Noise, noise_keys
from simulator.settings import CameraSettings
from simulator.utils.compute import parallel_ranges

#: Frames that are worth a thread when they are planned.
_WORTH_A_THREAD = 256
#: The steps of a capture that a scene may not need, in order; the exposure always runs.
_STEPS = (
    *("noise_reduction", "aperture", "defocus", "motion_blur"),
    *("vignetting", "pixel_response", "noise"),
)
_BIT = {name: 1 << bit for bit, name in enumerate(_STEPS)}
#: Names of the steps that made a frame, joined by ``"+"``: one entry for each combination.
MODULES = tuple(
    "+".join(["exposure", *(name for bit, name in enumerate(_STEPS) if index >> bit & 1)])
    for index in range(1 << len(_STEPS))
)


@dataclass
class FrameStatistics:
    """Statistics of a batch of frames, (B,) each; of frames on a device, what is counted stays."""

    clipped_low: Any  # share of the samples that are clipped low: at most 2**-10 of white
    clipped_high: Any  # share of the samples that are clipped high: at white
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
        **outputs: Any,
    ) -> FrameStatistics:
        """Records scenes that are prepared, and fills the outputs.

        Args:
            indices, states: As they were prepared.
            seeds: (B,) integers >= 0, of the noise.
            frames: (B,) numbers that the noise of one seed differs by.
            row_gain: (B, H) light of each row relative to the gain that was prepared for; None
                where all rows have the same.
            outputs: Those of `simulator.capture.sensor.record`, arrays or, where there is a
                device, tensors on it.
        """

    def prepared_scene(self, index: int) -> PreparedScene:
        """The scene `index` in its own light, as it is photographed."""


class CaptureBatch:
    """`FrameSource` that simulates the frames.

    `prepared` returns the scene of an index, in its own light, when it is first photographed. Of
    indices (K,), `moved` returns the scenes that they show in motion, -1 for none, and how these
    move, `MOVES` (K,). The light behind the lens at every f-number is cached until a scene is
    forgotten, as long as all takes no more than `light_bytes`. Everything is planned on the CPU;
    light is blurred and frames are recorded there by compiled loops or, with a `device`, by torch
    operations on it. A pickled copy works everything out again.
    """

    def __init__(
        self,
        prepared: Callable[[int], PreparedScene],
        num_scenes: int,
        states: Sequence[CameraSettings],
        camera: CameraProfile,
        *,
        noise: Noise | None,
        light_bytes: int,
        device: torch.device | None = None,
        moved: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]] | None = None,
    ) -> None:
        self._prepared, self.num_scenes, self.states = prepared, num_scenes, states
        self._moved = moved
        self.camera, self.noise, self._light_bytes = camera, noise, light_bytes
        self._device = device
        self._columns = state_columns(states)
        apertures, self._slots = np.unique(self._columns["f_number"], return_inverse=True)
        self._frames = new_frames(num_scenes, len(apertures), light_bytes, device)
        # Noise of captures, (S, 2, 4) for each of the box factors.
        self._boxes, self._targets = list[int](), np.empty((0, len(states), 2, 4))
        # Scenes as columns; whether their captures are planned in columns, too: where the light has
        # no noise of its own, and no aperture is opened.
        self._scenes: dict[int, PreparedScene] = {}
        self._known = np.zeros(num_scenes, bool)
        self._scene_columns, self._in_columns = np.zeros(num_scenes, SCENE), self._known.copy()
        # Of scenes at rest, what those that show them in motion share: the light, the largest
        # defocus, the subject, the vignetting, and the statistics, where they are known.
        self._light, self._widest = np.empty(num_scenes, object), np.zeros(num_scenes)
        self._height, self._subjects = 0, np.zeros((num_scenes, 2), np.uintp)
        self._vignetting = np.zeros((num_scenes, len(states)), np.uintp)
        self._statistics, self._counted = np.zeros((num_scenes, 4, 4, BINS)), self._known.copy()
        # Row of the blurred light that each scene has at present.
        self._blurred_row = np.full(num_scenes, -1)
        # Planned captures as columns, by scene and state: all that a frame depends on, except for
        # its noise. Memory of a row is taken when it is used.
        count = num_scenes * len(states)
        self._gain = np.full(count, np.nan)  # light that it was planned for; NaN where it was not
        self._table = np.zeros((count, 5, 4), np.float32)  # of `exposure_table`
        self._blur = np.zeros(count, BLUR)
        # As in `FrameStatistics`; NaN where it depends on blurred light that is not made yet.
        self._excess_variance, self._predicted_error = np.zeros((2, count))
        self._modules = np.zeros(count, np.int64)
        # What is added to these for each blur, and always; see `plan_frames`.
        always = _BIT["noise"] + bool(camera.prnu) * _BIT["pixel_response"]
        self._bits = np.array([_BIT[name] for name in BLURS] + [always * (noise is not None)])
        self._blurs = np.zeros(count, bool)  # whether it must be, else the light is the source
        self._blurred = np.zeros(count, np.uintp)  # its place
        # Of captures that are not planned in columns, the light (4, H, W) that they start from,
        # `Exposure.remaining_variance` and the exposure.
        self._source, self._remaining_variance, self._exposure = np.empty((3, count), object)
        self._any_remaining = False

    def __reduce__(self) -> tuple[Any, ...]:
        options: dict[str, Any] = {"noise": self.noise, "light_bytes": self._light_bytes}
        made = partial(CaptureBatch, device=self._device, moved=self._moved, **options)
        return made, (self._prepared, self.num_scenes, self.states, self.camera)

    def forget(self, indices: np.ndarray) -> None:
        """See `FrameSource`; the memory is used again."""
        count, objects = len(self.states), (self._source, self._remaining_variance, self._exposure)
        self._gain.reshape(-1, count)[indices] = np.nan
        for column in objects if self._any_remaining else ():
            column.reshape(-1, count)[indices] = None
        for index in indices.tolist():
            self._scenes.pop(index, None)
        self._known[indices] = self._counted[indices] = False
        self._frames.release(indices)
        self._blurred_row[indices] = -1

    def prepare(self, indices: np.ndarray, states: np.ndarray, gains: np.ndarray) -> None:
        """See `FrameSource`."""
        rows = indices * len(self.states) + states
        stale = self._gain[rows] != gains
        if stale.any():
            self._plan(indices[stale], rows[stale], gains[stale])
        missing = self._blurs[rows] & (self._blurred_row[indices] != rows)
        if missing.any():
            self._blur_frames(np.unique(rows[missing]))

    def transitions(self, indices: np.ndarray, states: np.ndarray) -> Transitions:
        """Light and exposures of the frames of scenes that are prepared; see `record`."""
        rows = indices * len(self.states) + states
        remaining = self._remaining_variance[rows] if self._any_remaining else None
        places, plain = self._blurred[rows], np.flatnonzero(~self._blurs[rows])
        if len(plain):
            places[plain] = self._places(indices[plain], rows[plain])
        found = Transitions(self._frames.at(places), self._table[rows], remaining)
        if not self.camera.prnu or self.noise is None:
            return found
        return found.seen_by([self.prepared_scene(i).response for i in indices.tolist()])

    def record(
        self,
        indices: np.ndarray,
        states: np.ndarray,
        seeds: np.ndarray,
        frames: np.ndarray,
        row_gain: np.ndarray | None = None,
        **outputs: Any,
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
        counted = counts.float() if isinstance(counts, torch.Tensor) else counts
        shares = counted / math.prod(transitions.shape)
        return FrameStatistics(
            clipped_low=shares[:, 0],
            clipped_high=shares[:, 1],
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
            scene = scene.changed(blurred_light=scene.blurred_light.copy())
            self._scenes[index] = scene
        return scene

    # -- planning -----------------------------------------------------------------------------

    def _add(self, indices: np.ndarray) -> None:
        """Makes the columns of scenes `indices`, which are new."""
        if self._moved is not None:
            rest, moves = self._moved(indices)
            for index in np.unique(rest[(rest >= 0) & ~self._known[rest]]).tolist():
                self._add_alone(index)
            inside = (rest >= 0) & self._in_columns[rest]
            inside &= moves["defocus"] <= self._widest[rest]
            new, rest = indices[inside], rest[inside]
            own = self._scene_columns[rest], moves[inside], self._subjects[rest]
            self._scene_columns[new] = moved_columns(*own)
            for index in np.unique(rest[~self._counted[rest]]).tolist():
                self._statistics[index] = self._scenes[index].statistics.columns
                self._counted[index] = True
            self._in_columns[new] = self._known[new] = True
            indices = indices[~inside]
        for index in indices.tolist():
            self._add_alone(index)

    def _add_alone(self, index: int) -> None:
        scene = self.prepared_scene(index)
        self._light[index], self._height = scene.light.contiguous(), scene.light.shape[-2]
        box = scene.box_factor
        if box not in self._boxes:
            self._boxes.append(box)
            own = noise_columns(self.camera, self.states, box)
            self._targets = np.stack([*self._targets, own])
        self._vignetting[index] = vignetting_column(scene, self.states)
        self._in_columns[index] = fits_columns(scene, self._columns)
        if self._in_columns[index]:
            self._scene_columns[index] = scene_column(scene, self._boxes.index(box), index)
            self._statistics[index] = found = statistics_column(scene)
            self._counted[index] = found.any()
            self._widest[index] = widest_defocus(scene, self._columns)
            self._subjects[index] = subject_column(scene)
        self._known[index] = True

    def _plan(self, indices: np.ndarray, rows: np.ndarray, gains: np.ndarray) -> None:
        """Works out `rows` (K,) for scenes `indices` in the light `gains`."""
        unknown = ~self._known[indices]
        if unknown.any():
            self._add(np.unique(indices[unknown]))
        inside = self._in_columns[indices]
        others = np.flatnonzero(~inside).tolist()
        for i in others:
            self._plan_alone(self._scenes[indices[i]], int(rows[i]), float(gains[i]))
        if len(others) < len(rows):
            planned = rows[inside]
            known = self._scene_columns, self._statistics, self._vignetting
            columns = self._blur, self._table, self._predicted_error, self._modules
            fixed = *known, self._columns, self._targets, self._height, self._bits
            given = indices[inside], planned, gains[inside]
            parallel_ranges(
                lambda first, last: plan_frames(first, last, *fixed, *given, *columns),
                len(planned),
                least=_WORTH_A_THREAD,
            )
            self._blurs[planned] = self._modules[planned] != self._bits[-1]
            self._excess_variance[planned] = 0.0
        self._gain[rows] = gains  # last: what is interrupted stays unknown
        self._blurred_row[indices] = -1

    def _plan_alone(self, scene: PreparedScene, row: int, gain: float) -> None:
        """Works out a row for a scene with noise of its own, or one whose aperture opens."""
        noisy, settings = self.noise is not None, self.states[row % len(self.states)]
        exposure = decide(scene, settings, gain=gain)
        blurs = exposure.defocus_px or exposure.motion_px or exposure.opened_to
        self._blurs[row] = blurs or exposure.vignetting is not None
        self._exposure[row], self._any_remaining = exposure, True
        self._blur[row] = blur_column(exposure)
        remaining = exposure.remaining_variance
        remaining = None if remaining is None else remaining.float().contiguous()
        self._remaining_variance[row] = remaining
        if exposure.opened_to is None:  # else the network runs when the light is made
            self._source[row] = scene.blurred_light.source(exposure.origin).contiguous()
        excess = _excess_variance(scene.blurred_light.statistics, exposure) if noisy else 0.0
        self._excess_variance[row] = excess
        error = exposure.left_out
        if not scene.nlf.is_zero:
            shown = exposure if noisy else decide(scene, settings, noise=False, gain=gain)
            error = math.hypot(*predict_errors(scene, settings, shown).values())
        self._predicted_error[row] = error
        self._modules[row] = noisy * _BIT["noise"]
        self._modules[row] += sum(_BIT[step.name] for step in exposure.steps if step.runs)
        self._table[row] = exposure_table([exposure])[0]

    def _blur_frames(self, rows: np.ndarray) -> None:
        """Makes the light of `rows`, all different, on as many threads as torch may use."""
        indices, states = np.divmod(rows, len(self.states))
        alone = rows[~self._in_columns[indices]]
        try:
            opens = [row for row in alone.tolist() if self._exposure[row].opened_to is not None]
            if opens:
                parallel_ranges(lambda a, b: [*map(self._open, opens[a:b])], len(opens))
                # Light that was opened before may have had the same address.
                self._frames.release(np.array(opens) // len(self.states))
            light = self._places(indices, rows)
            made = self._frames.make(indices, self._slots[states], self._blur[rows], light)
            self._blurred[rows] = made
            for row in alone.tolist():
                self._balance(row)
        except BaseException:  # some of the light is not made
            self.forget(indices)
            raise
        self._blurred_row[indices] = rows

    def _places(self, indices: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Places of the light that `rows` (K,) of scenes `indices` start from."""
        inside, places = self._in_columns[indices], np.empty(len(rows), np.uintp)
        if inside.any():
            shown = self._scene_columns["rest"][indices[inside]]
            rest = np.flatnonzero(np.bincount(shown))  # once each; `np.unique` would sort
            found = self._frames.places(self._light[rest].tolist())
            places[inside] = found[np.searchsorted(rest, shown)]
        if not inside.all():
            places[~inside] = self._frames.places(self._source[rows[~inside]])
        return places

    def _open(self, row: int) -> None:
        """Opens the aperture; the scene caches its result."""
        exposure, lights = self._exposure[row], self._scenes[row // len(self.states)].blurred_light
        self._source[row] = lights.source(exposure.origin).contiguous()
        if self._frames.is_full and lights.aperture_blur is not None:
            lights.aperture_blur.forget()

    def _balance(self, row: int) -> None:
        """Computes the excess variance where it depends on the pixels."""
        if np.isnan(self._excess_variance[row]):
            light = self._frames.at(self._blurred[[row]])[0]
            self._excess_variance[row], _ = noise_balance(light.cpu(), self._exposure[row])


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
