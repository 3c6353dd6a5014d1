"""The episodes behind both environments: n of them side by side, in one process.

`AutoExposureEnv` runs one, `AutoExposureVectorEnv` many; everything that happens in an episode
happens here, so that the two cannot differ. A step is `EpisodeCore.transition`, which applies the
actions, and `EpisodeCore.observe`, which photographs, scores and reports.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np

from ae_env.episodes.draws import Draws
from ae_env.episodes.light import FrameLight
from ae_env.episodes.recorded import RecordedBatch, nearest_recorded
from ae_env.episodes.scene_facts import SceneFacts
from ae_env.episodes.scores import PartScores
from ae_env.episodes.state import Episode, Episodes
from ae_env.lighting import Lighting
from ae_env.observation import (
    HISTOGRAM_BINS,
    PEDESTAL,
    ZONES,
    encode_sensors,
    encode_settings,
    frame_statistics,
)
from ae_env.options import COSTS, EnvOptions
from ae_env.scenes.folder import sequence_bounds
from ae_env.scenes.scene import Scene, SceneSet
from ae_env.scorers.score_table import ScoreTable, ScoreTables, in_episode, prepare_scene
from simulator.capture.batch import CaptureBatch
from simulator.capture.prepared_scene import PreparedScene
from simulator.noise.generator import Noise
from simulator.optics.disc_bank import DIAMETERS
from simulator.utils.cache import LruCache

#: Samples that are scored together: a chunk this small stays in the processor's cache.
CHUNK_SAMPLES = 2**18
#: Memory that the blurred light of all episodes together may take [byte]; else it is not cached.
LIGHT_CACHE_BYTES = 256 * 2**20
#: Memory for score tables [byte]: some eight thousand of 64 states.
TABLES_BYTES = 2**25
_RAW_DTYPES = {"uint8": np.uint8, "statistics": np.uint8, "linear": np.float32, "dn": np.uint16}
_STATE_INFO = ("iso", "exposure_time", "f_number", "ev100")
#: How the noise is made, by the environment's argument.
_NOISES: dict[bool | str, Noise | None] = {
    False: None,
    True: "bank",
    "bank": "bank",
    "exact": "exact",
    "sensor": "sensor",
}
#: Name of each kind of observation in `CaptureBatch.record`.
_OUTPUTS = {"uint8": "codes", "statistics": "codes", "linear": "signals", "dn": "numbers"}


@dataclass
class Frames:
    """Observations, info and rewards of n episodes after a reset or a step.

    Args:
        observation: Arrays by name, n long; new ones every time.
        info: Columns of numbers by name, n long; ``rewards`` is a dictionary of columns.
            ``scene_id`` and ``modules`` are indices into `EpisodeCore.scene_ids` and `MODULES`.
        reward: (n,) float64.
        raw: (n, 4, R, R) the whole frames, also where less of them is observed.
    """

    observation: dict[str, np.ndarray]
    info: dict[str, Any]
    reward: np.ndarray
    raw: np.ndarray


class EpisodeCore:
    """Scenes, grid, camera and scorer, and the episodes that run on them.

    A pickle holds its arguments and where the episodes are; scenes are loaded, and everything else
    is worked out again, where it is unpickled.

    Args:
        options: The environment's arguments.
        num_envs: Number of episodes side by side.
        scenes: Those of `options` where they are loaded already.
    """

    def __init__(
        self, options: EnvOptions, num_envs: int, scenes: Sequence[Scene] | None = None
    ) -> None:
        self.options = options
        self.grid = options.make_grid()
        self.camera = options.make_camera()
        self.scorer = options.make_scorer()
        self.lighting = options.make_lighting()
        self.scenes = options.scenes_on_demand() if scenes is None else SceneSet.of(scenes)
        self.tables = ScoreTables(
            self.grid,
            self.camera,
            self.scorer,
            noise=bool(options.noise),
            tolerance=options.tolerance,
        )
        self.episodes = Episodes(num_envs, self.grid, options.delays)
        # First and last frame of the sequence that each scene is a frame of.
        self._sequence = sequence_bounds(self.scenes) if options.in_sequences else None
        self._facts = first_facts = SceneFacts(self.scenes, len(self.grid))
        if self._sequence is not None:
            first_facts = SceneFacts(SceneSet.of(self.first_scenes), len(self.grid))
        self._draws = Draws(options, self.first_scenes, first_facts)
        self.scene_ids = self._facts.scene_ids
        states = self.grid.states
        apex = np.array([[s.aperture_value, s.time_value, s.speed_value] for s in states])
        self._settings = encode_settings(apex)
        # (4, S), see `_STATE_INFO`
        self._bounds = np.array([[getattr(s, name) for s in states] for name in _STATE_INFO])
        self._static = type(self.lighting) is Lighting
        self._light = FrameLight(
            self.lighting, self.episodes, self.scenes, self.camera, options.resolution
        )
        self._tables: LruCache[ScoreTable] = LruCache(
            max(TABLES_BYTES, 128 * num_envs * len(self.grid))
        )
        self._at_rest: dict[int, PreparedScene] = {}
        frame_bytes = 16 * options.resolution**2
        # A recorded capture is its own expectation.
        expected = options.reward == "expected" and options.recorded is None
        self._captures: CaptureBatch | RecordedBatch
        # (scenes, S) state that is shown where another is asked for; None where each can be.
        self._shown_state: np.ndarray | None = None
        if options.recorded is not None:
            self._captures = RecordedBatch(self.scenes, self._prepared, self.camera)
            self._shown_state = np.stack([nearest_recorded(s, self.grid) for s in self.scenes])
        else:
            self._captures = CaptureBatch(
                self._prepared,
                len(self.scenes) + num_envs,
                states,
                self.camera,
                noise=_NOISES[options.noise],
                cache_light=num_envs * self._cached_frames() * frame_bytes <= LIGHT_CACHE_BYTES,
            )
        #: Whether rewards are those of the tables, as some expectation has no closed form.
        self._reads_tables = expected and not self.tables.closed_form
        self._part_scores = PartScores(
            self.tables,
            self.scenes,
            self._facts,
            self.episodes,
            self._captures,
            static=self._static,
            expected=expected,
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (type(self), self._arguments(), self._progress())

    def __deepcopy__(self, memo: dict[int, Any]) -> EpisodeCore:
        progress = copy.deepcopy(self._progress(), memo)
        return _restored(type(self), {**self._arguments(), "scenes": self.scenes}, progress)

    def _arguments(self) -> dict[str, Any]:
        """What the constructor makes the same core from."""
        return {"options": self.options, "num_envs": len(self.episodes.begun)}

    def _progress(self) -> dict[str, Any]:
        """Where the episodes are."""
        return {"episodes": self.episodes.columns()}

    def _resume(self, progress: Mapping[str, Any]) -> None:
        for name, values in progress["episodes"].items():
            getattr(self.episodes, name)[:] = values
        begun = np.flatnonzero(self.episodes.begun)
        self._facts.look_at(self.episodes.scene[begun])
        self._set_light_index(begun)

    def _cached_frames(self) -> int:
        """Blurred frames that are cached for an episode at most."""
        apertures = len(self.grid.f_numbers)
        scenes = [self.scenes[index] for index in self.scenes.loaded]
        if any(scene.layout is not None for scene in scenes):  # what their discs make of it
            apertures += len(DIAMETERS)
        if self.options.depth == "unknown":  # also what opens them: a bank of blurs, its results
            apertures += len(DIAMETERS) + apertures
        as_recorded_and_denoised = 1 + any(s.denoised is not None for s in scenes)
        return as_recorded_and_denoised * apertures + 1

    # -- spaces -------------------------------------------------------------------------------

    def observation_space(self) -> gym.spaces.Dict:
        """Space of one episode's observation."""
        size = (self.options.resolution,) * 2
        if self.options.observation == "statistics":
            size = ZONES
        shape = (4, *size)
        low, high, dtype = {
            "uint8": (0.0, 255.0, np.uint8),
            "linear": (-PEDESTAL, 1.0, np.float32),
            "dn": (0.0, self.camera.white_level, np.uint16),
            "statistics": (0.0, 255.0, np.uint8),
        }[self.options.observation]
        spaces: dict[str, gym.Space[Any]] = {
            "raw": gym.spaces.Box(low, high, shape, dtype),
            "settings": gym.spaces.Box(-1.0, 1.0, (3,), np.float32),
        }
        if self.options.observation == "statistics":
            spaces["histogram"] = gym.spaces.Box(0.0, 1.0, (HISTOGRAM_BINS,), np.float32)
            spaces["clipped"] = gym.spaces.Box(0.0, 1.0, (2,), np.float32)
        if self.options.sensors:
            spaces["sensors"] = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        return gym.spaces.Dict(spaces)

    @property
    def num_actions(self) -> int:
        """Number of actions: one for each state of the grid."""
        return len(self.grid)

    def action_masks(self, env_indices: np.ndarray) -> np.ndarray:
        """(B, S) bool: states that the scenes shown allow; all of them before the first reset."""
        episodes = self.episodes
        return self._facts.allowed[episodes.scene[env_indices]] | ~episodes.begun[env_indices, None]

    @property
    def first_scenes(self) -> Sequence[Scene]:
        """Scenes that episodes draw from: of a sequence, its first frame."""
        if self._sequence is None:
            return self.scenes
        return [self.scenes[i] for i in np.unique(self._sequence[0])]

    # -- reset --------------------------------------------------------------------------------

    def begin(
        self,
        env_indices: np.ndarray,
        rngs: Sequence[np.random.Generator],
        options: Sequence[Mapping[str, Any]] | None = None,
    ) -> None:
        """Draws new episodes for `env_indices` (K,), where others may end; see `Draws.draw`."""
        drawn = self._draws.draw(rngs, options)
        if self._sequence is not None:
            first = np.unique(self._sequence[0])[drawn["scene"]]
            drawn["scene"] = self._shown_at(first, drawn["frame"])
        self._forget(env_indices)
        self.episodes.begin(env_indices, drawn)
        self._show_recorded(env_indices)
        self._set_light_index(env_indices)

    def _forget(self, env_indices: np.ndarray) -> None:
        """Drops what was worked out for the scenes that `env_indices` show."""
        lights = self.episodes.light_index[env_indices]
        own = lights[lights >= len(self.scenes)]  # the others are those of scenes at rest, and stay
        if len(own):
            self._captures.forget(own)
            self._part_scores.forget(own)

    def _set_light_index(self, env_indices: np.ndarray) -> None:
        """Sets `Episodes.light_index`: episodes at rest share the light of their scene."""
        episodes = self.episodes
        scenes = episodes.scene[env_indices]
        moves = episodes.speed[env_indices] > 0.0
        moves |= episodes.subject_speed[env_indices] > 0.0
        moves |= episodes.defocus[env_indices] > 0.0
        own = len(self.scenes) + env_indices
        if self._static:
            shared = ~(moves | self._facts.has_map[scenes])
            own = np.where(shared, scenes, own)
        episodes.light_index[env_indices] = own

    # -- step: the transition -----------------------------------------------------------------

    def transition(self, env_indices: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Advances the episodes of `env_indices` (K,) by one frame.

        Args:
            env_indices: Whose turn it is.
            actions: (K,) their actions, integers; applied after the delay.

        Returns:
            (K,) bool, which episodes have ended with it: none, but for other tasks.

        Raises:
            ValueError: If an action is not a state of the grid; no episode advances then.
        """
        self._check_begun(env_indices)
        wrong = (actions < 0) | (actions >= len(self.grid))
        if wrong.any():
            raise ValueError(f"`action` (={actions[wrong][0]}) must be in [0, {len(self.grid)})")
        self.episodes.act(env_indices, actions)
        if self._sequence is not None:
            self._show_next(env_indices)
        self._show_recorded(env_indices)
        return np.zeros(len(env_indices), bool)

    def _show_recorded(self, env_indices: np.ndarray) -> None:
        """Puts a state that was not recorded right: the nearest one that was is shown."""
        if self._shown_state is not None:
            episodes = self.episodes
            wanted = episodes.scene[env_indices], episodes.state[env_indices]
            episodes.state[env_indices] = self._shown_state[wanted]

    def _show_next(self, env_indices: np.ndarray) -> None:
        """Shows the scene of the current frame in each of `env_indices`."""
        episodes = self.episodes
        now = self._shown_at(episodes.scene[env_indices], episodes.frame[env_indices])
        changes = now != episodes.scene[env_indices]
        env_indices, now = env_indices[changes], now[changes]
        self._forget(env_indices)
        episodes.scene[env_indices] = now
        self._set_light_index(env_indices)

    def _shown_at(self, scenes: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """Scenes that the sequences of `scenes` show in `frames`; the last one stays."""
        assert self._sequence is not None
        first, last = self._sequence
        return np.minimum(first[scenes] + frames, last[scenes])

    # -- step: the observation ----------------------------------------------------------------

    def observe(self, env_indices: np.ndarray) -> Frames:
        """Photographs the episodes of `env_indices` (B,), each in its current state."""
        episodes, options = self.episodes, self.options
        states = episodes.state[env_indices]
        raw, columns = self._photograph(env_indices)
        shown = frame_statistics(raw) if options.observation == "statistics" else {"raw": raw}
        observation = shown | {"settings": self._settings[states]}
        if options.sensors:
            speed, focus_drive = episodes.speed[env_indices], episodes.focus_drive[env_indices]
            normals = columns.pop("sensor_normals")
            observation["sensors"] = encode_sensors(speed, focus_drive, normals)
        rewards, reward = self._reward(env_indices, columns)
        info: dict[str, Any] = {"scene_id": episodes.scene[env_indices]}
        info["state"] = states
        info |= zip(_STATE_INFO, self._bounds[:, states], strict=True)
        info |= columns | {"rewards": rewards}
        if options.with_oracle:
            tables = [self.score_table(env_index) for env_index in env_indices.tolist()]
            best = np.array([t.mean[t.oracle] for t in tables])
            info["oracle_state"] = np.array([t.oracle for t in tables])
            info["regret"] = best - [t.mean[s] for t, s in zip(tables, states, strict=True)]
        return Frames(observation, info, reward, raw)

    def _photograph(self, env_indices: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Observations of ``raw``, and columns: of `info`, scores by ``score:`` and part, and more.

        Worked out chunk by chunk where a part of the score reads the pixels.
        """
        size, episodes = self.options.resolution, self.episodes
        raw = np.empty((len(env_indices), 4, size, size), _RAW_DTYPES[self.options.observation])
        lights, states = episodes.light_index[env_indices], episodes.state[env_indices]
        gains, rows = np.ones(len(env_indices)), None
        if not self._static:
            gains, rows = self._light.of_each(env_indices, self._bounds[1, states])
        self._captures.prepare(lights, states, gains)
        reads = self._part_scores.reads_pixels or rows is not None
        step = max(1, CHUNK_SAMPLES // (4 * size**2) if reads else len(env_indices))
        chunks = []
        for start in range(0, len(env_indices), step):
            part = slice(start, start + step)
            some = None if rows is None else rows[part]
            chunks.append(self._photograph_some(env_indices[part], gains[part], some, raw[part]))
        if len(chunks) == 1:
            return raw, chunks[0]
        return raw, {name: np.concatenate([c[name] for c in chunks]) for name in chunks[0]}

    def _photograph_some(
        self, env_indices: np.ndarray, gains: np.ndarray, rows: np.ndarray | None, raw: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Columns of the episodes of `env_indices`; their observations are written to `raw`."""
        episodes, costs = self.episodes, self.options.costs
        outputs: dict[str, np.ndarray] = {_OUTPUTS[self.options.observation]: raw}
        if self._part_scores.reads_images:  # else no float of every sample is made
            outputs.setdefault("signals", np.empty(raw.shape, np.float32))
        if "flicker" in costs or self._part_scores.reads_codes:
            outputs.setdefault("codes", np.empty(raw.shape, np.uint8))
        frames = self._captures.record(
            episodes.light_index[env_indices],
            episodes.state[env_indices],
            episodes.noise_seed[env_indices],
            episodes.frame[env_indices],
            row_gain=rows,
            **outputs,
        )
        columns = {
            "clipped_high": frames.clipped_high,
            "clipped_low": frames.clipped_low,
            "excess_noise": frames.excess_variance,
            "predicted_error": frames.predicted_error,
            "modules": frames.modules,
        }
        if self.options.sensors:
            columns["sensor_normals"] = frames.sensor_normals(2)
        codes = outputs.get("codes") if self._part_scores.reads_codes else None
        images = outputs.get("signals") if self._part_scores.reads_images else None
        if not self._reads_tables:
            columns |= self._part_scores.of(env_indices, frames, codes, images, gains, rows)
        if self.options.observation == "linear":
            np.clip(raw, np.float32(-PEDESTAL), np.float32(1.0), out=raw)
        if "flicker" in costs:
            flat = outputs["codes"].reshape(len(raw), -1)
            columns["image_mean"] = flat.sum(axis=1, dtype=np.int64) / (255.0 * flat.shape[1])
        return columns

    def _prepared(self, light_index: int) -> PreparedScene:
        """The scene of a `Episodes.light_index` as the camera sees it, in its own light."""
        env_index = light_index - len(self.scenes)
        if env_index < 0:
            return self._prepared_at_rest(light_index)
        episode = self.episodes[env_index]
        at_rest = self._prepared_at_rest(episode.scene)
        return in_episode(at_rest, **episode.moves)

    def _prepared_at_rest(self, scene: int) -> PreparedScene:
        prepared = self._at_rest.get(scene)
        if prepared is None:
            prepared = prepare_scene(self.scenes[scene], self.camera)
            prepared = replace(prepared, tolerance=self.options.tolerance)
            if prepared.aperture_blur is None:  # which caches too much light to stay for long
                self._at_rest[scene] = prepared
        return prepared

    # -- step: the reward ---------------------------------------------------------------------

    def _reward(
        self, env_indices: np.ndarray, columns: dict[str, np.ndarray]
    ) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Terms of the reward by name, and the reward (B,): the score minus weighted costs.

        Takes the scores and the image means out of `columns`.
        """
        if self._reads_tables:
            rewards = self._from_tables(env_indices)
        else:
            rewards = {name: columns.pop(f"score:{name}") for name in self.scorer.parts}
            rewards["score"] = self.scorer.totals(rewards)
        reward = rewards["score"].copy()
        for name, cost in self._costs(env_indices, columns.pop("image_mean", None)).items():
            rewards[name] = cost
            reward -= self.options.costs[name] * cost
        return rewards, reward

    def _from_tables(self, env_indices: np.ndarray) -> dict[str, np.ndarray]:
        """(B,) expected scores by part, and "score", where they take captures to work out."""
        pairs = zip(env_indices.tolist(), self.episodes.state[env_indices].tolist(), strict=True)
        found = [(self.score_table(env_index), state) for env_index, state in pairs]
        rewards = {
            name: np.array([table.parts[name][state] for table, state in found])
            for name in self.scorer.parts
        }
        return rewards | {"score": np.array([table.mean[state] for table, state in found])}

    def _costs(self, env_indices: np.ndarray, means: np.ndarray | None) -> dict[str, np.ndarray]:
        """(B,) each; 0 in the first frame of an episode."""
        if not self.options.costs:
            return {}
        episodes = self.episodes
        first = episodes.previous[env_indices] < 0
        costs = {name: np.zeros(len(env_indices)) for name in COSTS if name in self.options.costs}
        if means is not None:
            change = np.abs(means - episodes.image_mean[env_indices])
            costs["flicker"] = np.where(first, 0.0, change)
            episodes.image_mean[env_indices] = means
        if "switch" in costs:
            now = self.grid.controls(episodes.state[env_indices])
            before = self.grid.controls(np.where(first, 0, episodes.previous[env_indices]))
            costs["switch"] = np.where(first, 0.0, (before != now).mean(axis=-1))
        return costs

    # -- what is known of an episode ----------------------------------------------------------

    def episode(self, env_index: int) -> Episode:
        """The episode of environment `env_index` as it is now."""
        self._check_begun(env_index)
        return self.episodes[env_index]

    def scene(self, env_index: int) -> Scene:
        """The scene that environment `env_index` photographs now."""
        return self.scenes[self.episode(env_index).scene]

    def _check_begun(self, env_indices: np.ndarray | int) -> None:
        if not self.episodes.begun[env_indices].all():
            raise gym.error.ResetNeeded("call reset() before step(), render() or scores")

    def score_table(self, env_index: int) -> ScoreTable:
        """Expected scores of all states in the current frame of environment `env_index`."""
        episode = self.episode(env_index)
        gain: float | np.ndarray = 1.0
        rows = None
        if self.lighting.within_frame:
            moment: tuple[float, ...] = (episode.frame, episode.phase)
        else:
            gain = self._light.of(env_index, 0.0)[0]
            moment = (gain,)
        # All that a table depends on: episodes that were seen before keep theirs.
        key = (episode.scene, episode.speed, episode.defocus, episode.movement, moment)
        table = self._tables.get(key)
        if table is None:
            if self.lighting.within_frame:
                gain, rows = self._light.of_states(env_index, self._bounds[1])
            table = self.tables.table(
                self.scenes[episode.scene],
                gain=gain,
                row_gain=rows,
                prepared=self._prepared(int(self.episodes.light_index[env_index])),
            )
            self._tables.put(key, table, table.nbytes)
        return table


def _restored(
    kind: type[EpisodeCore], arguments: dict[str, Any], progress: Mapping[str, Any]
) -> EpisodeCore:
    core = kind(**arguments)
    core._resume(progress)
    return core
