"""The episodes behind both environments: n of them side by side, in one process.

`AutoExposureEnv` runs one, `AutoExposureVectorEnv` many; everything that happens in an episode
happens here, so that the two cannot differ.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from ae_env.episode import Episode
from ae_env.lighting import Lighting, make_lighting
from ae_env.observation import PEDESTAL, encode_sensors, encode_settings
from ae_env.options import COSTS, EnvOptions
from ae_env.recorder import Recorder
from ae_env.score_table import ScoreTable, ScoreTables, describe_captures
from ae_env.scorers.protocol import DependsOn
from simulator.cache import LruCache
from simulator.modules.disc_bank import DIAMETERS
from simulator.noise_bank import single_normals

#: Share of the episodes in which nothing moves.
STATIC_SHARE = 1.0 / 3.0
#: Standard deviation of the natural logarithm of the image speed.
SPEED_SIGMA = 1.3
#: Median and spread of the blur diameter at f/4 [pixel of a 64-pixel frame], and its least value.
DEFOCUS_MEDIAN, DEFOCUS_SIGMA, DEFOCUS_MIN, DEFOCUS_MAX = 1.0, 0.9, 0.1, 8.0
#: Samples that are scored together: a chunk this small stays in the processor's cache.
CHUNK_SAMPLES = 4 * 64 * 64 * 8
#: Samples whose noise is drawn together: enough for several threads, in bounded memory.
DRAWN_SAMPLES = 16 * CHUNK_SAMPLES
#: Memory that the blurred light of all episodes together may take [byte]; larger is not kept.
OPTICS_BYTES = 256 * 2**20
#: Memory for the scores of scenes at rest that have a closed form [byte].
STILL_BYTES = 2**25
_RAW_DTYPES = {"uint8": np.uint8, "linear": np.float32, "dn": np.uint16}
_OUTPUTS = {"uint8": "codes", "linear": "signals", "dn": "numbers"}


@dataclass
class Frames:
    """What n episodes show after a reset or a step.

    Args:
        observation: Arrays by name, n long; new ones every time.
        info: Columns by name, n long; ``rewards`` is a dictionary of columns.
        reward: (n,) float64.
    """

    observation: dict[str, np.ndarray]
    info: dict[str, Any]
    reward: np.ndarray


class EpisodeCore:
    """Scenes, grid, camera and scorer, and the episodes that run on them.

    Args:
        options: The environment's arguments.
        num_envs: Number of episodes side by side.
    """

    def __init__(self, options: EnvOptions, num_envs: int) -> None:
        self.options = options
        self.grid = options.make_grid()
        self.camera = options.make_camera()
        self.scorer = options.make_scorer()
        self.lighting = make_lighting(options.lighting)
        self.scenes = options.load_scenes()
        self.tables = ScoreTables(
            self.grid,
            self.camera,
            self.scorer,
            noise=bool(options.noise),
            tolerance=options.tolerance,
        )
        self.episodes: list[Episode | None] = [None] * num_envs
        self._scene_index = {scene.scene_id: i for i, scene in enumerate(self.scenes)}
        states = self.grid.states
        self._apex = np.array([[s.aperture_value, s.time_value, s.speed_value] for s in states])
        self._bounds = np.array([[s.iso, s.exposure_time, s.f_number, s.ev100] for s in states])
        frame_bytes = 16 * options.resolution**2
        self._still_parts: LruCache[dict[str, np.ndarray]] = LruCache(STILL_BYTES)
        self._static = type(self.lighting) is Lighting
        keep = num_envs * self._kept_frames() * frame_bytes <= OPTICS_BYTES
        self.recorder = Recorder(
            options,
            self.grid,
            self.camera,
            self.scenes,
            num_envs,
            keep=keep,
            shares=self._static,
        )
        self._scores_images = not self.scorer.closed_form

    def _kept_frames(self) -> int:
        """Blurred frames that an episode keeps at most."""
        apertures = len(self.grid.f_numbers)
        if (
            self.options.depth == "unknown"
        ):  # also what opens them: a bank of blurs, and its results
            apertures += len(DIAMETERS) + apertures
        as_recorded_and_denoised = 1 + any(s.denoised is not None for s in self.scenes)
        return as_recorded_and_denoised * apertures + 1

    # -- spaces -------------------------------------------------------------------------------

    def observation_space(self) -> gym.spaces.Dict:
        """Space of one episode's observation."""
        shape = (4, self.options.resolution, self.options.resolution)
        low, high, dtype = {
            "uint8": (0.0, 255.0, np.uint8),
            "linear": (-PEDESTAL, 1.0, np.float32),
            "dn": (0.0, self.camera.white_level, np.uint16),
        }[self.options.observation]
        spaces: dict[str, gym.Space] = {
            "raw": gym.spaces.Box(low, high, shape, dtype),
            "settings": gym.spaces.Box(-1.0, 1.0, (3,), np.float32),
        }
        if self.options.sensors:
            spaces["sensors"] = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        return gym.spaces.Dict(spaces)

    def action_masks(self) -> np.ndarray:
        """(S,) bool: states that may be chosen. Every aperture is exact here, so all of them."""
        return np.ones(len(self.grid), dtype=bool)

    # -- life of an episode -------------------------------------------------------------------

    def start(self, index: int, rng: np.random.Generator, options: Mapping[str, Any]) -> None:
        """Begins episode `index`; see `drawn`."""
        self.begin(index, self.drawn(rng, options))

    def begin(self, index: int, episode: Episode) -> None:
        """Puts `episode` in place `index`, where another one may end."""
        ended = self.episodes[index]
        if ended is not None:
            self.recorder.end(index, ended)
        self.episodes[index] = episode

    def drawn(self, rng: np.random.Generator, options: Mapping[str, Any]) -> Episode:
        """An episode: draws the scene, the start state, the motion and the defocus.

        The draws do not depend on `options`, which only replace what was drawn.

        Raises:
            ValueError: If there is no such scene, state or frame as `options` ask for.
        """
        scene = int(rng.integers(len(self.scenes)))
        state = int(rng.integers(len(self.grid)))
        moves, speed, defocus = rng.random() >= STATIC_SHARE, *rng.standard_normal(2)
        phase, noise_seed = rng.random(), int(rng.integers(2**62))
        scene = self._chosen_scene(options.get("scene"), scene)
        median = self.scenes[scene].median_speed
        drawn_speed = moves * median * np.exp(SPEED_SIGMA * speed)
        drawn_defocus = DEFOCUS_MEDIAN * np.exp(DEFOCUS_SIGMA * defocus)
        episode = Episode(
            scene=scene,
            state=self._chosen("state", options.get("state"), state, len(self.grid)),
            speed=_fixed_or_drawn(self.options.motion, float(drawn_speed)),
            defocus=_fixed_or_drawn(
                self.options.depth, float(np.clip(drawn_defocus, DEFOCUS_MIN, DEFOCUS_MAX))
            ),
            phase=float(phase),
            noise_seed=noise_seed,
            frame=self._chosen("frame", options.get("frame"), 0, 2**31),
        )
        episode.pending = [episode.state] * int(self.options.delay)
        own = self.scenes[scene].own_blur(4.0) * 64.0 / self.options.resolution
        episode.focus_drive = math.hypot(episode.defocus, own)
        return episode

    def _chosen_scene(self, wanted: Any, drawn: int) -> int:
        if wanted is None:
            return drawn
        if isinstance(wanted, str) and wanted in self._scene_index:
            return self._scene_index[wanted]
        if isinstance(wanted, int | np.integer) and 0 <= wanted < len(self.scenes):
            return int(wanted)
        raise ValueError(
            f"`options['scene']` (={wanted!r}) must be a scene id, such as "
            f"{self.scenes[0].scene_id!r}, or an index below {len(self.scenes)}"
        )

    @staticmethod
    def _chosen(name: str, wanted: Any, drawn: int, limit: int) -> int:
        if wanted is None:
            return drawn
        if isinstance(wanted, int | np.integer) and 0 <= wanted < limit:
            return int(wanted)
        raise ValueError(f"`options[{name!r}]` (={wanted!r}) must be an integer in [0, {limit})")

    def episode(self, index: int) -> Episode:
        """Running episode `index`."""
        episode = self.episodes[index]
        if episode is None:
            raise gym.error.ResetNeeded("call reset() before step(), render() or scores")
        return episode

    def act(self, index: int, action: Any) -> None:
        """Lets episode `index` go on by one frame with `action`, applied after the delay."""
        self.check_action(action)
        episode = self.episode(index)
        episode.pending.append(int(action))
        episode.state = episode.pending.pop(0)
        episode.frame += 1

    def check_action(self, action: Any) -> None:
        """Raises a `ValueError` unless `action` is a state of the grid."""
        if not (isinstance(action, int) and 0 <= action < len(self.grid)):
            number = np.asarray(action)
            if number.ndim or number.dtype.kind not in "iu" or not 0 <= number < len(self.grid):
                raise ValueError(f"`action` (={action!r}) must be in [0, {len(self.grid)})")

    def gain(self, episode: Episode, exposure_time: float) -> float:
        """Light of an exposure in the current frame relative to the scene's own."""
        if self._static:
            return 1.0
        return self.lighting.gain(episode.frame, exposure_time, episode.phase)

    def expected_scores(self, index: int) -> ScoreTable:
        """Scores of all states in the current frame of episode `index`."""
        episode = self.episode(index)
        gain = self.gain(episode, 0.0)
        if episode.table is None or episode.table[0] != gain:
            table = self.tables.table(
                self.scenes[episode.scene],
                speed=episode.speed,
                defocus=episode.defocus,
                gain=gain,
            )
            episode.table = (gain, table)
        return episode.table[1]

    def _closed_parts(self, episode: Episode) -> dict[str, np.ndarray]:
        if episode.closed_parts is None:
            at_rest = not episode.speed and not episode.defocus
            parts = self._still_parts.get(episode.scene) if at_rest else None
            if parts is None:
                parts = self.tables.closed_parts(
                    self.scenes[episode.scene], speed=episode.speed, defocus=episode.defocus
                )
                if at_rest:
                    size = sum(values.nbytes for values in parts.values())
                    self._still_parts.put(episode.scene, parts, size)
            episode.closed_parts = parts
        return episode.closed_parts

    # -- what the camera records --------------------------------------------------------------

    def observe(self, indices: Sequence[int], previous: Sequence[int] | None = None) -> Frames:
        """Photographs the episodes `indices`, each in its current state.

        Args:
            indices: Episodes.
            previous: State of each before this step, for the costs; None after a reset.
        """
        raw, columns = self._capture_all(indices)
        episodes = [self.episode(i) for i in indices]
        rewards = {name: columns.pop(f"score:{name}") for name in self.scorer.parts}
        rewards["score"] = self._scores(rewards, indices)
        costs = self._costs(episodes, columns.pop("image_mean", None), previous)
        reward = rewards["score"].copy()
        for name, cost in costs.items():
            rewards[name] = cost
            reward -= self.options.costs[name] * cost
        settings = encode_settings(self._apex[[e.state for e in episodes]])
        observation = {"raw": raw, "settings": settings}
        if self.options.sensors:
            speed, defocus = np.array([(e.speed, e.focus_drive) for e in episodes]).T
            observation["sensors"] = encode_sensors(speed, defocus, columns.pop("sensor_noise"))
        info = self._info(episodes) | columns | {"rewards": rewards}
        if self.options.with_oracle:
            tables = [self.expected_scores(i) for i in indices]
            best = np.array([t.mean[t.oracle] for t in tables])
            info["oracle_state"] = np.array([t.oracle for t in tables])
            info["regret"] = best - [t.mean[e.state] for t, e in zip(tables, episodes, strict=True)]
        return Frames(observation, info, reward)

    def _scores(self, parts: dict[str, np.ndarray], indices: Sequence[int]) -> np.ndarray:
        if self.options.reward == "expected":
            return np.array([self.expected_scores(i).mean[self.episode(i).state] for i in indices])
        return np.asarray(self.scorer.combine(parts), dtype=np.float64)

    def _capture_all(self, indices: Sequence[int]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Observations of `raw` and the info columns, worked out chunk by chunk."""
        size = self.options.resolution
        raw = np.empty((len(indices), 4, size, size), _RAW_DTYPES[self.options.observation])
        episodes = [self.episode(i) for i in indices]
        gains = [self.gain(e, self._bounds[e.state, 1]) for e in episodes]
        planned = zip(indices, episodes, gains, strict=True)
        blurs = [(i, e) for i, e, gain in planned if self.recorder.prepare(i, e, gain)]
        self.recorder.blur(blurs)
        # Only codes and digital numbers are made without a float of every sample, and only in
        # static light scored without one.
        few = self._scores_images or not self._static
        samples = CHUNK_SAMPLES if few else DRAWN_SAMPLES
        every = not few and self.options.noise != "exact"
        step = len(indices) if every else max(1, samples // (4 * size**2))
        chunks = []
        for start in range(0, len(indices), step):
            part = slice(start, start + step)
            chunks.append(self._capture(indices[part], episodes[part], gains[part], raw[part]))
        columns = {name: np.concatenate([c[name] for c in chunks]) for name in chunks[0]}
        return raw, columns

    def _capture(
        self,
        indices: Sequence[int],
        episodes: Sequence[Episode],
        gains: Sequence[float],
        raw: np.ndarray,
    ) -> dict[str, np.ndarray]:
        """Info columns of the episodes `indices`; their observations are written to `raw`."""
        outputs: dict[str, np.ndarray] = {_OUTPUTS[self.options.observation]: raw}
        if self._scores_images:
            outputs.setdefault("signals", np.empty(raw.shape, np.float32))
        if "flicker" in self.options.costs:
            outputs.setdefault("codes", np.empty(raw.shape, np.uint8))
        columns = self.recorder.record(indices, episodes, **outputs)
        key = columns.pop("noise_key")
        if self.options.sensors:
            columns["sensor_noise"] = single_normals(key, 2)
        columns |= self._part_scores(indices, outputs.get("signals"), gains)
        if self.options.observation == "linear":
            np.clip(raw, np.float32(-PEDESTAL), np.float32(1.0), out=raw)
        if "flicker" in self.options.costs:
            codes = outputs["codes"].reshape(len(raw), -1)
            columns["image_mean"] = codes.sum(axis=1, dtype=np.int64) / (255.0 * codes.shape[1])
        return columns

    def _part_scores(
        self, indices: Sequence[int], frames: np.ndarray | None, gains: Sequence[float]
    ) -> dict[str, np.ndarray]:
        episodes = [self.episode(i) for i in indices]
        scores: dict[str, np.ndarray] = {}
        kinds: list[DependsOn] = [] if self.scorer.closed_form else ["image"]
        if self._static:  # one table per scene serves every frame
            closed = [self._closed_parts(e) for e in episodes]
            for name in self.scorer.names("light", "blur"):
                pairs = zip(closed, episodes, strict=True)
                scores[f"score:{name}"] = np.array([parts[name][e.state] for parts, e in pairs])
        else:
            kinds += ["light", "blur"]
        if kinds:
            captures = describe_captures(
                [self.scenes[e.scene] for e in episodes],
                [self.grid[e.state] for e in episodes],
                self.camera,
                speed=np.array([e.speed for e in episodes]),
                defocus=np.array([e.defocus for e in episodes]),
                gain=np.array(gains),
            )
            images = None if frames is None else torch.from_numpy(frames).clamp(0.0, 1.0)
            for name, values in self.scorer.score_parts(images, captures, tuple(kinds)).items():
                scores[f"score:{name}"] = values.numpy()
        return scores

    def _costs(
        self, episodes: list[Episode], means: np.ndarray | None, previous: Sequence[int] | None
    ) -> dict[str, np.ndarray]:
        costs = {name: np.zeros(len(episodes)) for name in COSTS if name in self.options.costs}
        if means is not None:
            before = np.array([e.image_mean for e in episodes])
            for episode, mean in zip(episodes, means, strict=True):
                episode.image_mean = float(mean)
            if previous is not None:
                costs["flicker"] = np.abs(means - before)
        if "switch" in costs and previous is not None:
            now = np.array([e.state for e in episodes])
            changed = self.grid.controls(np.array(previous)) != self.grid.controls(now)
            costs["switch"] = changed.mean(axis=-1)
        return costs

    def _info(self, episodes: list[Episode]) -> dict[str, Any]:
        states = np.array([e.state for e in episodes])
        bounds = self._bounds[states]
        return {
            "scene_id": np.array([self.scenes[e.scene].scene_id for e in episodes], object),
            "state": states,
            "iso": bounds[:, 0],
            "exposure_time": bounds[:, 1],
            "f_number": bounds[:, 2],
            "ev100": bounds[:, 3],
        }


def _fixed_or_drawn(option: str | float, drawn: float) -> float:
    """`drawn` for ``"random"``, 0 for every other word, or the number itself."""
    if option == "random":
        return drawn
    return 0.0 if isinstance(option, str) else float(option)
