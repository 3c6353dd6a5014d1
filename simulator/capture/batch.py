"""Many scenes side by side, photographed in batches: what the environment runs on.

Nothing is worked out twice: all that a frame depends on, except for its noise, is planned when a
state is first used, and cached as a row of columns; blurred light, as long as its scene is shown. A
batch of frames is then one call of `simulator.capture.sensor.record`, which makes this light, too.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch

from simulator.camera import CameraProfile
from simulator.capture import blurred_frames, columns
from simulator.capture.blurred_light import new_frames
from simulator.capture.plan import noise_balances, opening_errors
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.sensor import CodeMeans, Transitions, record, record_units
from simulator.capture.statistics import BINS
from simulator.noise.generator import Noise, noise_keys
from simulator.noise.noise_level_function import ReadNoises
from simulator.settings import CameraSettings
from simulator.utils.compute import add_to, kernel, parallel_ranges

#: What it costs to record a frame, in the unit of `simulator.capture.blurred_frames.PASS`.
RECORDING = 100.0
#: Frames that are worth a thread when they are planned; those of noisy light take longer.
_WORTH_A_THREAD, _NOISY_WORTH_A_THREAD = 256, 8
#: The steps of a capture that a scene may not need, in order; the exposure always runs.
_STEPS = (
    *("noise_reduction", "aperture", "defocus", "motion_blur"),
    *("vignetting", "pixel_response", "noise"),
)
_BIT = {name: 1 << bit for bit, name in enumerate(_STEPS)}
#: Plans of batches keep no more than the sum of the errors.
_NO_DETAILS = np.empty((0, len(columns.ERRORS) + 3))
_BLURRING = sum(_BIT[name] for name in _STEPS[1:5])  # those that change the light
_DENOISING, _OPENING = _BIT["noise_reduction"], _BIT["aperture"]
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
    #: (B, 2, 4) shot and read noise of the source in the frame; None where no source has any.
    source_noise: np.ndarray | None
    keys: np.ndarray  # of the noise, uint64


class CaptureBatch:
    """Frames of n scenes, each at any of S states, simulated.

    For each batch of frames, call `prepare`, then `record`. When another scene is to be shown under
    an index, call `forget` first.

    `prepared` returns the scene of an index, in its own light, when it is first photographed. Of
    indices (K,), `moved` returns the scenes that they show in motion, -1 for none, and how these
    move, `MOVES` (K,). The light behind the lens at every f-number is cached until a scene is
    forgotten, as long as all takes no more than `light_bytes`; that behind opened apertures, and
    what these leave of its noise, in any case. Everything is planned on the CPU; light is blurred
    and frames are recorded there by compiled loops or, with a `device`, by torch operations on it.
    A pickled copy works everything out again.
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
        self.camera, self.noise, self._light_bytes = camera, noise, light_bytes
        self._moved, self._device = moved, device
        self._columns = columns.state_columns(camera, states)
        self._apertures, self._slots = np.unique(self._columns["f_number"], return_inverse=True)
        self._frames = new_frames(num_scenes, len(self._apertures), light_bytes, device)
        # Noise of captures, (S, 2, 4) for each of the box factors.
        self._boxes, self._targets = list[int](), np.empty((0, len(states), 2, 4))
        self._read_noise: ReadNoises | None = None  # of captures: box by box, those of the states
        # Scenes as columns, and at rest the one that each shows, whose light it has.
        self._scenes: dict[int, PreparedScene] = {}
        self._known = np.zeros(num_scenes, bool)
        self._scene_columns = np.zeros(num_scenes, columns.SCENE)
        self._rest = np.full(num_scenes, -1)
        self._size = tuple[int, ...]()  # of all lights
        # Of scenes at rest, what those that show them in motion share: the light, as recorded and
        # denoised, and its places, the vignetting, the noise of the light if any scene's has some,
        # and the statistics, where they are known.
        self._light: dict[int, tuple[torch.Tensor, torch.Tensor]] = {}
        self._place = np.zeros((num_scenes, 2), np.uintp)
        self._noises: np.ndarray | None = None
        self._vignetting = np.zeros((num_scenes, len(states)), np.uintp)
        self._opening = np.zeros((num_scenes, len(states)))
        self._statistics, self._counted = np.zeros((num_scenes, 4, 4, BINS)), self._known.copy()
        # Row of the blurred light that each scene has at present.
        self._blurred_row = np.full(num_scenes, -1)
        # Planned captures as columns, by scene and state: all that a frame depends on, except for
        # its noise. Memory of a row is taken when it is used.
        count = num_scenes * len(states)
        self._gain = np.full(count, np.nan)  # light that it was planned for; NaN where it was not
        self._table = np.zeros((count, 5, 4), np.float32)  # of `Transitions.table`
        self._blur = np.zeros(count, blurred_frames.BLUR)
        # As in `FrameStatistics`; NaN where it depends on light that is not made yet.
        self._excess_variance, self._predicted_error = np.zeros((2, count))
        self._modules = np.zeros(count, np.int64)
        # What is added to these for each step, and always; see `plan_frames`.
        always, response = _BIT["noise"], bool(camera.prnu) * _BIT["pixel_response"]
        more = np.array([always + response, always]) * (noise is not None)
        self._bits = np.array([*(_BIT[name] for name in columns.STEPS), *more])
        self._blurred = np.zeros(count, np.uintp)  # place of the light, blurred where it must be
        # Addresses of `Transitions.remaining_variance`; the maps that are not the lens's, by row.
        self._share, self._maps = np.zeros(count, np.uintp), np.empty(count, object)
        # By scene the light (4, H, W) behind an open aperture, by its number and whether it is the
        # denoised light.
        self._opened: dict[int, dict[tuple[int, bool], torch.Tensor]] = {}
        # Blur of so many frames that are prepared, which is still to be done.
        self._pending: tuple[int, blurred_frames.Passes] | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        options: dict[str, Any] = {"noise": self.noise, "light_bytes": self._light_bytes}
        made = partial(CaptureBatch, device=self._device, moved=self._moved, **options)
        return made, (self._prepared, self.num_scenes, self.states, self.camera)

    def forget(self, indices: np.ndarray) -> None:
        """Drops all that is cached for the scenes `indices`; the memory is used again."""
        pending, self._pending = self._pending, None
        if pending is not None:  # what its light is made of may be gone before
            indices = np.union1d(indices, pending[1].passes["scene"])
        self._gain.reshape(-1, len(self.states))[indices] = np.nan
        for index in indices.tolist():
            self._scenes.pop(index, None)
            self._opened.pop(index, None)
        if self._noises is not None:
            self._maps.reshape(-1, len(self.states))[indices] = None
        self._known[indices] = self._counted[indices] = False
        self._frames.release(indices)
        self._blurred_row[indices] = -1

    def prepare(self, indices: np.ndarray, states: np.ndarray, gains: np.ndarray) -> None:
        """Plans the next frames, and makes their light.

        All are (B,): scenes, the state of each, and its light relative to the scene's own.
        """
        rows = indices * len(self.states) + states
        self._finish()
        if np.count_nonzero(stale := self._gain.take(rows) != gains):
            self._plan(indices[stale], rows[stale], gains[stale])
        self._make_light(indices, rows)

    def transitions(self, indices: np.ndarray, states: np.ndarray) -> Transitions:
        """Light and exposures of the frames of scenes that are prepared; see `record`."""
        self._finish()
        return self._transitions(indices, indices * len(self.states) + states)

    def _finish(self) -> None:
        """Makes the light that is planned."""
        if self._pending is not None:
            planned = self._pending[1]
            with self._forgetting(planned.passes["scene"]):
                self._pending = None  # not before: an interrupt may come anywhere
                self._frames.run(planned)

    @contextmanager
    def _forgetting(self, indices: np.ndarray) -> Iterator[None]:
        """Drops what is cached for scenes `indices` if their light may not be made."""
        try:
            yield
        except BaseException:
            self.forget(indices)
            self._frames.forget_discs()
            raise

    def _transitions(self, indices: np.ndarray, rows: np.ndarray) -> Transitions:
        remaining = None
        if self._noises is not None and (shares := self._share[rows]).any():
            remaining = blurred_frames.FramesAt(shares, self._size)
        light = self._frames.at(self._blurred.take(rows))
        found = Transitions(light, self._table.take(rows, axis=0), remaining)
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
        means: CodeMeans | None = None,
        **outputs: Any,
    ) -> FrameStatistics:
        """Records scenes that are prepared, and fills the outputs.

        Args:
            indices, states: As they were prepared.
            seeds: (B,) integers >= 0, of the noise.
            frames: (B,) numbers that the noise of one seed differs by.
            row_gain: (B, H) light of each row relative to the gain that was prepared for; None
                where all rows have the same.
            means, outputs: Those of `simulator.capture.sensor.record`, arrays or, where there is
                a device, tensors on it, but then no `means`. These stay empty where there is
                `FrameStatistics.source_noise`, on which what they should sum depends.
        """
        rows = indices * len(self.states) + states
        read_noise, run = self._read_noise, None
        together = len(indices) >= 2 * torch.get_num_threads()
        together = together and not self.camera.prnu and not self._device
        if self._pending is None or not together or self._pending[0] != len(indices):
            self._finish()
        else:
            run = partial(self._photograph, indices)
        keys, transitions = noise_keys(seeds, frames), self._transitions(indices, rows)
        source_noise = None
        if self._noises is not None and transitions.table[:, 3:].any():
            source_noise, means = transitions.averaged_table()[:, 3:], None
        if read_noise is not None:
            boxes = self._scene_columns["targets"][indices]
            read_noise = read_noise.part(boxes * len(self.states) + states)
        counts = record(
            transitions,
            self.camera,
            keys=None if self.noise is None else keys,
            noise=self.noise or "bank",
            read_noise=read_noise,
            row_gain=row_gain,
            count=True,
            means=means,
            run=run,
            **outputs,
        )
        counted = counts.float() if isinstance(counts, torch.Tensor) else counts
        shares = counted / math.prod(transitions.shape)
        return FrameStatistics(
            clipped_low=shares[:, 0],
            clipped_high=shares[:, 1],
            excess_variance=self._excess_variance.take(rows),
            predicted_error=self._predicted_error.take(rows),
            modules=self._modules.take(rows),
            source_noise=source_noise,
            keys=keys,
        )

    def _photograph(self, indices: np.ndarray, units: int, fixed: tuple[Any, ...]) -> None:
        """Makes the light that is planned, and records frames of `indices` (B,)."""
        assert self._pending is not None
        planned = self._pending[1]
        with self._forgetting(indices):
            self._pending = None
            order = np.empty(len(planned.passes) + len(indices), np.int64)
            counter, ends = np.zeros(1, np.int64), np.zeros(len(indices) + 1, np.int64)
            # Light and discs of a scene stay in caches from one of its episodes to the next.
            turns = np.argsort(np.append(self._rest, self._rest.take(indices)), kind="stable")
            deal_out(planned.passes, indices, turns, order, ends)
            given = order, ends, units, (1, *planned), fixed
            parallel_ranges(lambda *_: photograph(counter, *given), torch.get_num_threads())

    def prepared_scene(self, index: int) -> PreparedScene:
        """The scene `index` in its own light, as it is photographed."""
        if index not in self._scenes:
            scene = self._prepared(index)
            # Scenes that are shown several times share their light, but not what is blurred of it.
            self._scenes[index] = scene.changed(blurred_light=scene.blurred_light.copy())
        return self._scenes[index]

    # -- planning -----------------------------------------------------------------------------

    def _add(self, indices: np.ndarray) -> None:
        """Makes the columns of scenes `indices`, which are new."""
        if self._moved is not None:
            rest, moves = self._moved(indices)
            for index in np.unique(rest[(rest >= 0) & ~self._known[rest]]).tolist():
                self._add_alone(index)
            inside = rest >= 0
            new, rest = indices[inside], rest[inside]
            if len(new):
                widest = moves["defocus"][inside].max().item()
                columns.check_disc(widest, self._apertures[0].item(), self._size)
            self._scene_columns[new] = self._scene_columns[rest]
            for name in columns.MOVES.names or ():
                self._scene_columns[name][new] = moves[name][inside]
            for index in np.unique(rest[~self._counted[rest]]).tolist():
                self._statistics[index] = self._scenes[index].statistics.columns
                self._counted[index] = True
            self._rest[new], self._known[new] = rest, True
            indices = indices[~inside]
        for index in indices.tolist():
            self._add_alone(index)

    def _add_alone(self, index: int) -> None:
        scene = self.prepared_scene(index)
        light, self._size = scene.light.contiguous(), tuple(scene.light.shape[-2:])
        self._light[index] = light, light
        columns.check_disc(scene.defocus, self._apertures[0].item(), self._size)
        box = scene.box_factor
        if box not in self._boxes:
            boxes = [*self._boxes, box]
            own = columns.noise_columns(self.camera, self.states, box)
            self._targets = np.stack([*self._targets[: len(self._boxes)], own])
            if self.noise == "sensor":
                each = [self.camera.read_noise(s.iso, b) for b in boxes for s in self.states]
                self._read_noise = ReadNoises.of(each)
            self._boxes = boxes  # last: what is interrupted is made again
        self._vignetting[index] = columns.vignetting_column(scene, self.states)
        self._opening[index] = columns.opening_column(scene, self._columns)
        assert len(scene.denoised_lights) < 2  # as those of environments have
        self._rest[index] = index
        self._scene_columns[index] = columns.scene_column(scene, self._boxes.index(box), index)
        self._statistics[index] = found = columns.statistics_column(scene)
        self._counted[index] = found.any()
        if not scene.nlf.is_zero:
            if self._noises is None:
                self._noises = np.zeros(self.num_scenes, columns.NOISE)
            self._noises[index] = columns.noise_column(scene, self._columns, errors=True)
            for network in scene.denoised_lights:
                self._light[index] = light, network.light.contiguous()
                lacking = columns.LACKING, columns.LACKING - 1
                columns.add_networks(self._noises[index], scene, lacking)
        elif self._noises is not None:
            self._noises[index] = np.zeros((), columns.NOISE)
        self._place[index] = self._frames.places(self._light[index])
        self._known[index] = True

    def _plan(self, indices: np.ndarray, rows: np.ndarray, gains: np.ndarray) -> None:
        """Works out `rows` (K,) for scenes `indices` in the light `gains`."""
        unknown = ~self._known[indices]
        if np.count_nonzero(unknown):
            self._add(np.unique(indices[unknown]))
        self._gain[rows] = np.nan  # what is interrupted stays unknown
        captures = self.noise is not None
        self._plan_rows(indices, rows, gains, captures)
        if self._noises is not None:
            self._plan_noisy(indices, rows, gains, captures)
        self._gain[rows] = gains
        self._blurred_row[indices] = -1

    def _plan_rows(self, *given: Any) -> None:
        """`columns.plan_frames` of the frames `given`."""
        known = self._scene_columns, self._statistics, self._vignetting, self._opening
        camera = self._columns, self._targets, self._size, self._bits, columns.blur_tables()
        made = self._blur, self._table, self._predicted_error, self._excess_variance
        more = self._share, self._modules, _NO_DETAILS
        fixed = known, self._noises, camera, given, (*made, *more)
        parallel_ranges(
            lambda first, last: columns.plan_frames(first, last, *fixed),
            len(given[0]),
            least=_WORTH_A_THREAD if self._noises is None else _NOISY_WORTH_A_THREAD,
        )

    def _plan_noisy(
        self, indices: np.ndarray, rows: np.ndarray, gains: np.ndarray, captures: bool
    ) -> None:
        """Completes what is planned where sources have noise, by what depends on the pixels."""
        assert self._noises is not None
        if not captures:  # frames are planned as captures; the error is that of light without noise
            errors = self._predicted_error[rows]
            self._plan_rows(indices, rows, gains, True)
            self._predicted_error[rows], self._excess_variance[rows] = errors, 0.0
        modules, rest = self._modules[rows], self._rest[indices]
        for k in np.flatnonzero(self._share[rows] == columns.TO_BE_MADE).tolist():
            row, f_number = rows.item(k), self._columns["f_number"].item(rows[k] % len(self.states))
            scene, opens = self._scenes[rest.item(k)], modules[k] & _OPENING
            fixed = scene.layout, scene.vignetting(f_number), f_number if opens else None
            found = scene.blurred_light.remaining_variance(self._blur[row], *fixed)
            self._maps[row] = found
            self._share[row] = 0 if found is None else found.data_ptr()
        some = np.flatnonzero((modules & _OPENING > 0) & (self._noises["noisy"][rest] > 0))
        if len(some):
            opened, denoised = rows[some], (modules[some] & _DENOISING > 0).tolist()
            places = zip(rest[some].tolist(), denoised, strict=True)
            lights = [self._light[scene][second] for scene, second in places]
            ratios, targets = self._table[opened, 0, 0].astype(float), self._target_noise(opened)
            errors = opening_errors(lights, self._open(opened), ratios, targets, captures)
            self._predicted_error[opened] = np.hypot(self._predicted_error[opened], errors)

    def _target_noise(self, rows: np.ndarray) -> np.ndarray:
        """(K, 2, 4) shot and read noise of captures `rows` (K,)."""
        count = len(self.states)
        return self._targets[self._scene_columns["targets"][rows // count], rows % count]

    def _make_light(self, indices: np.ndarray, rows: np.ndarray) -> None:
        """Finds the places of the light of `rows`, and makes what is not there."""
        source, given = np.empty(len(rows), np.uintp), (self._modules, self._rest, self._place)
        missing = find_light(indices, rows, *given, self._blurred_row, self._blurred, source)
        if not len(missing):
            return
        with self._forgetting(indices):
            indices, rows, light = (each.take(missing) for each in (indices, rows, source))
            if np.count_nonzero(opened := light == 0):
                light[opened] = self._frames.places(self._open(rows[opened]))
            slots, blurs = self._slots.take(rows % len(self.states)), self._blur.take(rows)
            rest = self._rest.take(indices)
            owners = np.where(light == self._place[rest, 0], rest, self.num_scenes + indices)
            self._blurred[rows], planned = self._frames.plan(indices, slots, blurs, light, owners)
            # Wide discs, which no kernel makes, and those that blends of several frames wait for.
            first = planned.passes["kind"] <= blurred_frames.LEVEL
            if np.count_nonzero(first):
                self._frames.run(planned._replace(passes=planned.passes[first]))
                planned = planned._replace(passes=planned.passes[~first])
            self._blurred_row[indices], self._pending = rows, (len(source), planned)
            if self._noises is not None:
                rows = rows[np.isnan(self._excess_variance[rows])]
                if len(rows):  # depends on the pixels
                    self._finish()
                    shares = blurred_frames.FramesAt(self._share[rows], self._size)
                    made = self._frames.at(self._blurred[rows]), shares, self._table[rows]
                    self._excess_variance[rows], _ = noise_balances(*made, self._target_noise(rows))

    def _open(self, rows: np.ndarray) -> list[torch.Tensor]:
        """Light behind the open apertures of rows (K,); it stays until its scene is forgotten."""
        keys = []
        for row in rows.tolist():
            index, state = divmod(row, len(self.states))
            keys.append((index, self._slots.item(state), bool(self._modules[row] & _DENOISING)))
        new = [key for key in {*keys} if key[1:] not in self._opened.setdefault(key[0], {})]

        def make(first: int, last: int) -> None:
            for index, slot, denoised in new[first:last]:
                scene = self._scenes[index]
                origin = scene.denoised_lights[0] if denoised else None, self._apertures.item(slot)
                light = scene.blurred_light.source(origin).contiguous()
                self._opened[index][slot, denoised] = light
                if self._frames.is_full and scene.aperture_blur is not None:
                    scene.aperture_blur.forget()

        parallel_ranges(make, len(new))
        return [self._opened[index][slot, denoised] for index, slot, denoised in keys]


@kernel(fastmath={"contract"})
def photograph(counter, order, ends, units, blurring, recording):  # type: ignore[no-untyped-def]
    """Does scenes of `order`, of `deal_out`: passes, and `record_units` of frames.

    Threads that share a `counter` share the scenes. A frame has so many `units`. What follows are
    the other arguments of the blur tasks (`BlurredFrames`) and of `record_units`. One frame comes
    after the other, and its light stays in the cache.
    """
    passes = blurring[2]
    while True:
        one = add_to(counter, 0, 1)  # type: ignore[call-arg, var-annotated]
        if one >= len(ends) - 1:
            return
        for at in order[ends[one] : ends[one + 1]]:
            if at >= len(passes):
                frame = at - len(passes)
                record_units(frame * units, (frame + 1) * units, *recording)
            elif passes[at].kind == blurred_frames.DISC:
                blurred_frames.blur_discs(at, at + 1, *blurring)
            elif passes[at].kind == blurred_frames.BLEND:
                blurred_frames.blend_discs(at, at + 1, *blurring)
            elif passes[at].kind == blurred_frames.ALONG_ROWS:
                blurred_frames.move_along_rows(at, at + 1, *blurring)
            elif passes[at].kind == blurred_frames.ALONG_PATH:
                blurred_frames.move_along_paths(at, at + 1, *blurring)
            else:
                blurred_frames.darken(at, at + 1, *blurring)


@kernel()
def deal_out(passes, scenes, turns, order, ends):  # type: ignore[no-untyped-def]
    """Puts passes (J,), and behind them frames of `scenes` (B,), in `order` (J + B,).

    They come scene by scene, the costly ones first, else in `turns`, which also have each frame as
    another scene; the passes of a scene before its frames. `ends` (B + 1,), zeros, get where each
    scene begins and the last ends; the length where there are less.
    """
    owner, total = np.empty(len(order), np.int64), len(turns)
    cost, counts, spent = np.zeros(total), np.zeros(total, np.int64), 0.0
    for unit in range(len(order)):
        k = unit - len(passes)
        if k < 0:
            one, more = passes[unit].scene, passes[unit].cost
        else:  # a frame without passes can be anywhere
            one, more = scenes[k] if counts[scenes[k]] else total - len(scenes) + k, RECORDING
        owner[unit] = one
        counts[one] += 1
        cost[one] += more
        spent += more
    begin, done, number = np.empty(total, np.int64), 0, 0
    for cheap in range(2):
        for one in turns:
            if counts[one] and cheap == (cost[one] * len(scenes) < spent):
                begin[one] = done
                done += counts[one]
                number += 1
                ends[number] = done
    ends[number + 1 :] = done
    for unit in range(len(order)):
        order[begin[owner[unit]]] = unit
        begin[owner[unit]] += 1


@kernel()
def find_light(  # type: ignore[no-untyped-def]
    indices, rows, modules, rest, place, blurred_row, blurred, source
):
    """The frames among `rows` (K,) of scenes `indices` whose light has to be blurred.

    See `CaptureBatch` for the columns. `source` (K,) become the places of the light that each frame
    starts from, 0 where the aperture opens, and `blurred` those of the frames that need no blur.
    """
    found, count = np.empty(len(rows), np.int64), 0
    for k in range(len(rows)):
        denoised = 1 if modules[rows[k]] & _DENOISING else 0
        opens = modules[rows[k]] & _OPENING
        source[k] = 0 if opens else place[rest[indices[k]], denoised]
        if not modules[rows[k]] & _BLURRING:
            blurred[rows[k]] = source[k]
        elif blurred_row[indices[k]] != rows[k]:
            found[count] = k
            count += 1
    return found[:count]
