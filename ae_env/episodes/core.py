"""The episodes behind all environments: n of them side by side, in one process.

`AutoExposureEnv` runs one, `AutoExposureVectorEnv` many; everything that happens in an episode
happens here, so that the two cannot differ. A step is `EpisodeCore.transition`, which applies the
actions, and `EpisodeCore.observe`, which captures, rewards and reports. What differs between tasks
are the functions of a `Task`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from ae_env.episodes.lookup import LookupBatch
from ae_env.episodes.state import Episode, Episodes
from ae_env.observation import (
    HISTOGRAM_BINS,
    PEDESTAL,
    ZONES,
    encode_sensors,
    encode_settings,
    frame_statistics,
    tensor_statistics,
)
from ae_env.options import RANDOM_LENS, EnvOptions
from ae_env.scenes.scene import Scene
from ae_env.scorers.captures import in_episode, prepare_scene
from ae_env.scorers.score_table import ScoreTable
from ae_env.scorers.terms import CompositeScorer
from simulator.capture.batch import CaptureBatch, FrameStatistics
from simulator.capture.columns import MOVES
from simulator.capture.prepared_scene import PreparedScene
from simulator.capture.sensor import CodeMeans, Transitions
from simulator.noise.generator import Noise, single_normals
from simulator.utils.checks import check_integer
from simulator.utils.compute import outside_inference_mode

#: Samples that are recorded and scored together, at most.
CHUNK_SAMPLES = 2**24
_STATE_INFO = ("iso", "exposure_time", "f_number", "ev100")
#: Outputs of `CaptureBatch.record`, and the one that each kind of observation is made of.
_DTYPES = {"codes": np.uint8, "linear": np.float32, "images": np.float32, "numbers": np.uint16}
_OUTPUTS = {"uint8": "codes", "statistics": "codes", "linear": "linear", "dn": "numbers"}


@dataclass
class Frames:
    """Observations, info and rewards of n episodes after a reset or a step."""

    #: Arrays by name, n long; new ones every time. Where the environment has a device, all are
    #: tensors on it, with floats in float32.
    observation: dict[str, Any]
    #: Columns of numbers by name, n long. ``scene_id`` and ``modules`` are indices into
    #: `EpisodeCore.scene_ids` and `AutoExposureBase.module_names`.
    info: dict[str, Any]
    reward: Any  # (n,) float64, or a float32 tensor
    raw: Any  # (n, 4, R, R) the whole frames, also where less of them is observed


@dataclass(frozen=True)
class FrameBatch:
    """Frames that were just recorded, of the B environments `env_indices`."""

    env_indices: np.ndarray
    statistics: FrameStatistics
    #: The frames (B, 4, R, R), by the names of `Task.outputs`; tensors where there is a device.
    outputs: Mapping[str, Any]
    gains: np.ndarray  # (B,) light relative to the scenes' own
    rows: np.ndarray | None  # (B, R) light of each row relative to that, or None; see `Captures`
    means: CodeMeans | None  # of `Task.code_means`


class Task:
    """What an action does and what a frame is worth, as functions of running episodes.

    Here every action takes a frame, moves nothing else, and no episode ends by itself; a task gives
    at least `measure`, `reward` and `score_table`.
    """

    outputs: tuple[str, ...] = ()  # of `CaptureBatch.record`, that `measure` reads

    def __init__(self, episodes: Episodes) -> None:
        self.episodes = episodes
        #: Those below the number of states take a frame there.
        self.num_actions = len(episodes.grid)

    def spaces(self) -> dict[str, gym.Space[Any]]:
        """Spaces of `observation`."""
        return {}

    def initial(self, env_indices: np.ndarray, options: Sequence[Mapping[str, Any]] | None) -> None:
        """Sets up the episodes that were drawn for `env_indices` (K,) with the reset's options."""

    def forget(self, lights: np.ndarray) -> None:
        """Drops what was worked out under these `Episodes.light_index`."""

    def allowed(self, env_indices: np.ndarray) -> np.ndarray:
        """(B, A) bool: actions that the episodes allow now; all of them before the first reset."""
        scenes, begun = self.episodes.scene[env_indices], self.episodes.begun[env_indices, None]
        return self.episodes.allowed[scenes] | ~begun

    def transition(
        self, env_indices: np.ndarray, actions: np.ndarray
    ) -> tuple[np.ndarray | None, np.ndarray, np.ndarray]:
        """Applies the actions (K,).

        Returned are (K,) bool, which of them take a frame, or None for all; the episodes whose
        `displaced` changed; and (K,) bool, which have ended.
        """
        return None, env_indices[:0], np.zeros(len(env_indices), bool)

    def displaced(self, env_index: int) -> Scene | None:
        """The scene of an episode where its subject has moved since the first frame; else None."""
        return None

    def observation(self, env_indices: np.ndarray) -> dict[str, np.ndarray]:
        """What is observed beside the latest frame, (B, ...) by name."""
        return {}

    def code_means(self, env_indices: np.ndarray) -> CodeMeans | None:
        """What `measure` reads of the output ``codes`` of frames (B,), to be filled; or None."""
        return None

    def measure(self, frames: FrameBatch) -> dict[str, Any]:
        """Columns (B,) that `reward` takes, from the frames just recorded."""
        raise NotImplementedError

    def reward(
        self, env_indices: np.ndarray, columns: dict[str, Any]
    ) -> tuple[dict[str, Any], Any]:
        """Terms of the reward by name, and the reward (B,); `columns` become those of the info."""
        raise NotImplementedError

    def columns(self) -> dict[str, np.ndarray]:
        """The task's own columns of the episodes, by name, n long: a pickle holds them."""
        return {}

    def score_table(self, env_index: int) -> ScoreTable:
        """Expected scores of all states in the current frame of environment `env_index`."""
        raise NotImplementedError


#: `CaptureBatch.transitions`: light and exposures behind the frames of scenes (B,) at states (B,).
FindTransitions = Callable[[np.ndarray, np.ndarray], Transitions]
#: What records frames: it simulates them, or looks them up.
FrameSource = CaptureBatch | LookupBatch
#: Constructor of a task, from the episodes, what records their frames, the scorer, and the light
#: and exposures behind frames where rewards are expectations.
MakeTask = Callable[[Episodes, FrameSource, CompositeScorer, FindTransitions | None], Task]


class EpisodeCore:
    """Scenes, grid, camera and task, and the episodes that run on them, `num_envs` side by side.

    A pickle holds its arguments and where the episodes are; scenes are loaded, and everything else
    is worked out again, where it is unpickled. `make_task` must pickle; `scenes` are those of
    `options` where they are loaded already.
    """

    @outside_inference_mode
    def __init__(
        self,
        options: EnvOptions,
        num_envs: int,
        make_task: MakeTask,
        scenes: Sequence[Scene] | None = None,
    ) -> None:
        self.options, self._make_task = options, make_task
        scorer = options.make_scorer()  # what it raises comes before scenes are loaded
        self.episodes = episodes = Episodes(options, num_envs, scenes)
        self.scenes = episodes.scenes
        self.grid, self.camera = episodes.grid, episodes.camera
        self.scene_ids = episodes.scene_ids
        states = self.grid.states
        self._settings = encode_settings(self.grid.apex)
        # (4, S), see `_STATE_INFO`
        self._state_info = np.array([[getattr(s, name) for s in states] for name in _STATE_INFO])
        self._at_rest: dict[int, PreparedScene] = {}
        self._outputs: dict[str, Any] = {}  # memory that is used again
        self._unchanged = np.ones(num_envs)  # gains of static light
        self._captures: FrameSource
        transitions = None
        if options.recorded is not None:  # a recorded capture is its own expectation
            self._captures = LookupBatch(self.scenes, self._prepared, self.camera)
        else:
            noise: Noise | None = "bank" if options.noise is True else options.noise or None
            batch = self._captures = CaptureBatch(
                self._prepared,
                len(self.scenes) + num_envs,
                states,
                self.camera,
                noise=noise,
                light_bytes=int(options.blur_memory * 2**20),
                device=options.torch_device,
                moved=self._moved,
            )
            transitions = batch.transitions if options.reward == "expected" else None
        self.task = make_task(episodes, self._captures, scorer, transitions)
        self.num_actions = self.task.num_actions

    def __reduce__(self) -> tuple[Any, ...]:
        arguments = self.options, len(self.episodes.begun), self._make_task
        return _restored, (arguments, self.episodes.columns(), self.task.columns())

    def __deepcopy__(self, memo: dict[int, Any]) -> EpisodeCore:
        restored, (arguments, *columns) = self.__reduce__()
        return restored((*arguments, self.scenes), *columns)

    def observation_space(self) -> gym.spaces.Dict:
        """Space of one episode's observation."""
        kind, size = self.options.observation, (self.options.resolution,) * 2
        shape = (4, *(ZONES if kind == "statistics" else size))
        low, high, dtype = {
            "uint8": (0.0, 255.0, np.uint8),
            "linear": (-PEDESTAL, 1.0, np.float32),
            "dn": (0.0, self.camera.white_level, np.uint16),
            "statistics": (0.0, 255.0, np.uint8),
        }[kind]
        spaces: dict[str, gym.Space[Any]] = {
            "raw": gym.spaces.Box(low, high, shape, dtype),
            "settings": gym.spaces.Box(-1.0, 1.0, (3,), np.float32),
        }
        if kind == "statistics":
            spaces["histogram"] = gym.spaces.Box(0.0, 1.0, (HISTOGRAM_BINS,), np.float32)
            spaces["clipped"] = gym.spaces.Box(0.0, 1.0, (2,), np.float32)
        if self.options.sensors:
            spaces["sensors"] = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        return gym.spaces.Dict(spaces | self.task.spaces())

    def begin(
        self,
        env_indices: np.ndarray,
        rngs: Sequence[np.random.Generator],
        options: Sequence[Mapping[str, Any]] | None = None,
    ) -> None:
        """Draws new episodes for `env_indices` (K,), as `Episodes.draw`; those there end."""
        drawn = self.episodes.draw(rngs, options)
        own = env_indices[self.episodes.light_index[env_indices] >= len(self.scenes)]
        if len(own):
            self._forget(own)
        self.episodes.begun[env_indices] = False  # whatever interrupts what follows
        self.episodes.begin(env_indices, drawn)
        self.task.initial(env_indices, options)
        self.episodes.begun[env_indices] = True

    def _forget(self, env_indices: np.ndarray) -> None:
        """Drops what was worked out for the scenes of `env_indices` in motion or in their light."""
        lights = len(self.scenes) + env_indices
        self._captures.forget(lights)
        self.task.forget(lights)

    def transition(self, env_indices: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Advances the episodes of `env_indices` (K,) by one frame; which end with it, (K,) bool.

        A `ValueError` if there is no such action; no episode advances then.
        """
        self.check_begun(env_indices)
        wrong = (actions < 0) | (actions >= self.num_actions)
        if np.count_nonzero(wrong):
            raise ValueError(f"`action` (={actions[wrong][0]}) must be in [0, {self.num_actions})")
        takes, moved, ended = self.task.transition(env_indices, actions)
        if takes is not None:
            env_indices, actions = env_indices[takes], actions[takes]
        changed = self.episodes.act(env_indices, actions)
        for others in (moved, changed):
            if len(others):
                self._forget(others)
        return ended

    @outside_inference_mode
    def observe(self, env_indices: np.ndarray) -> Frames:
        """Captures the episodes of `env_indices` (B,), each in its current state."""
        episodes, options = self.episodes, self.options
        states = episodes.state.take(env_indices)
        raw, columns = self._capture(env_indices)
        shown = {"raw": raw}
        if options.observation == "statistics":
            shown = (frame_statistics if options.device is None else tensor_statistics)(raw)
        observation = shown | {"settings": self._settings.take(states, axis=0)}
        if options.sensors:
            drive, normals = episodes.focus_drive.take(env_indices), columns.pop("sensor_normals")
            observation["sensors"] = encode_sensors(
                episodes.speed.take(env_indices), drive, normals
            )
        terms, reward = self.task.reward(env_indices, columns)
        observation |= self.task.observation(env_indices)
        info: dict[str, Any] = {"scene_id": episodes.scene.take(env_indices), "state": states}
        info |= zip(_STATE_INFO, self._state_info.take(states, axis=1), strict=True)
        info |= columns | {f"rewards.{name}": values for name, values in terms.items()}
        if options.with_subject:
            info["subject"] = np.zeros((len(states), *[options.resolution] * 2), bool)
            for mask, scene in zip(info["subject"], info["scene_id"].tolist(), strict=True):
                layout = self.scenes[scene].layout
                if layout is not None and layout.subject is not None:
                    mask[:] = layout.subject.numpy()
        if options.device is not None:
            observation = {name: options.placed(values) for name, values in observation.items()}
            info = {name: options.placed(values) for name, values in info.items()}
        return Frames(observation, info, reward, raw)

    def _memory(self, count: int, name: str) -> Any:
        """Memory for `count` frames of an output of `CaptureBatch.record`."""
        shape, device = (count, 4, *[self.options.resolution] * 2), self.options.torch_device
        if device is None:
            return np.empty(shape, _DTYPES[name])
        return torch.empty(shape, dtype=getattr(torch, np.dtype(_DTYPES[name]).name), device=device)

    def _capture(self, env_indices: np.ndarray) -> tuple[Any, dict[str, Any]]:
        """Frames (B, 4, R, R) as they are observed, and columns of the info and of the task."""
        options, episodes = self.options, self.episodes
        size = options.resolution
        raw = self._memory(len(env_indices), _OUTPUTS[options.observation])
        lights, states = episodes.light_index.take(env_indices), episodes.state.take(env_indices)
        gains, rows = self._unchanged[: len(env_indices)], None
        if not episodes.static:
            gains, rows = episodes.gains(env_indices, self._state_info[1, states])
        self._captures.prepare(lights, states, gains)
        step = max(1, CHUNK_SAMPLES // (4 * size**2))
        chunks = []
        for start in range(0, len(env_indices), step):
            part = slice(start, start + step)
            some = None if rows is None else rows[part]
            chunks.append(self._capture_chunk(env_indices[part], gains[part], some, raw[part]))
        if len(chunks) == 1:
            return raw, chunks[0]
        each = {name: [chunk[name] for chunk in chunks] for name in chunks[0]}
        join: dict[bool, Any] = {True: torch.cat, False: np.concatenate}
        return raw, {n: join[torch.is_tensor(values[0])](values) for n, values in each.items()}

    def _capture_chunk(
        self, env_indices: np.ndarray, gains: np.ndarray, rows: np.ndarray | None, raw: Any
    ) -> dict[str, Any]:
        """Columns of the episodes of `env_indices`; their observations are written to `raw`."""
        episodes = self.episodes
        outputs: dict[str, Any] = {_OUTPUTS[self.options.observation]: raw}
        for name in self.task.outputs:
            if name not in outputs:
                kept = self._outputs.get(name)
                if kept is None or len(kept) < len(raw):
                    kept = self._outputs[name] = self._memory(len(raw), name)
                outputs[name] = kept[: len(raw)]
        means, scenes = self.task.code_means(env_indices), episodes.scene.take(env_indices)
        found = self._captures.record(
            episodes.light_index.take(env_indices),
            episodes.state.take(env_indices),
            episodes.noise_seed.take(env_indices),
            episodes.frame.take(env_indices),
            row_gain=rows,
            means=means,
            **outputs,
        )
        columns = {
            "clipped_high": found.clipped_high,
            "clipped_low": found.clipped_low,
            "excess_noise": found.excess_variance,
            "predicted_error": found.predicted_error,
            "modules": found.modules,
            "illuminance_spread": episodes.illuminance_spread.take(scenes),
        }
        if self.options.sensors:
            columns["sensor_normals"] = single_normals(found.keys, 2)
        columns |= self.task.measure(FrameBatch(env_indices, found, outputs, gains, rows, means))
        return columns

    def _moved(self, lights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of lights (K,) those of the scenes that they show in motion, else -1, and `MOVES`."""
        own, moves = lights >= len(self.scenes), np.zeros(len(lights), MOVES)
        env_indices = np.where(own, lights - len(self.scenes), 0)
        rest = np.where(own, self.episodes.scene[env_indices], -1)
        for name in MOVES.names or ():
            moves[name] = getattr(self.episodes, name)[env_indices]
        moves["defocus"] *= self.options.resolution / 64.0
        for i in np.flatnonzero(rest >= 0).tolist():
            if self.task.displaced(env_indices.item(i)) is not None:
                rest[i] = -1
        # Opened apertures take too much memory to stay for long.
        rest[self.episodes.has_map[self.episodes.scene[env_indices]]] = -1
        if self.options.lens == RANDOM_LENS:
            rest[:] = -1
        return rest, moves

    def _prepared(self, light_index: int) -> PreparedScene:
        """The scene of a `Episodes.light_index` as the camera sees it, in its own light."""
        env_index = light_index - len(self.scenes)
        if env_index < 0:
            return self._prepared_at_rest(light_index)
        episode, displaced = self.episodes[env_index], self.task.displaced(env_index)
        lens = self.episodes.lens(env_index)
        if displaced is None:
            prepared = in_episode(self._prepared_at_rest(episode.scene), **episode.moves)
            return prepared if lens is prepared.lens else prepared.changed(lens=lens)
        prepared = prepare_scene(displaced, self.camera, **episode.moves)
        return prepared.changed(tolerance=self.options.tolerance, lens=lens)

    def _prepared_at_rest(self, scene: int) -> PreparedScene:
        prepared = self._at_rest.get(scene)
        if prepared is None:
            options, prepared = self.options, prepare_scene(self.scenes[scene], self.camera)
            prepared = prepared.changed(tolerance=options.tolerance, lens=options.make_lens())
            if prepared.aperture_blur is None:  # which caches too much light to stay for long
                self._at_rest[scene] = prepared
        return prepared

    def episode(self, env_index: int) -> Episode:
        """The episode of environment `env_index` as it is now."""
        self.check_begun(env_index)
        return self.episodes[env_index]

    def scene(self, env_index: int) -> Scene:
        """The scene that environment `env_index` photographs now."""
        return self.scenes[self.episode(env_index).scene]

    def score_table(self, env_index: int) -> ScoreTable:
        """Expected scores of all states in the current frame of environment `env_index`."""
        self.check_begun(env_index)
        return self.task.score_table(env_index)

    def check_begun(self, env_indices: np.ndarray | int) -> None:
        """Raises `ResetNeeded` unless these have begun, a `ValueError` for a wrong index."""
        begun = self.episodes.begun
        if not isinstance(env_indices, np.ndarray):
            check_integer("env_index", env_indices, 0, len(begun) - 1)
        if np.count_nonzero(begun) < len(begun) and not begun[env_indices].all():
            raise gym.error.ResetNeeded("call reset() before step(), render() or scores")


def check_actions(name: str, actions: Any, shape: tuple[int, ...]) -> np.ndarray:
    """`actions` as an array; a `ValueError` unless they are integers of `shape`, () for one."""
    try:
        array = np.asarray(actions)
    except ValueError:  # rows of different lengths
        array = np.empty(0, object)
    if array.shape != shape or array.dtype.kind not in "iu":
        rule = f"integers of shape {shape}" if shape else "an integer"
        raise ValueError(
            f"`{name}` (={actions!r}, {array.dtype}, shape {array.shape}) must be {rule}"
        )
    return array


def _restored(
    arguments: tuple[Any, ...], episodes: dict[str, np.ndarray], task: dict[str, np.ndarray]
) -> EpisodeCore:
    core = EpisodeCore(*arguments)
    core.episodes.resume(episodes)
    for name, values in core.task.columns().items():
        values[:] = task[name]
    return core
