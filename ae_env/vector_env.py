"""`ae_env/AutoExposure-v0`, many episodes side by side in one process."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence, Set
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from ae_env.episodes.core import EpisodeCore, Frames
from ae_env.episodes.draws import check_options
from ae_env.episodes.state import Episode
from ae_env.grid import ExposureGrid, plain, plain_list
from ae_env.options import EnvOptions
from ae_env.registration import SpecProperty
from ae_env.scenes import Scene
from ae_env.scorers.score_table import ScoreTable
from ae_env.utils.checks import check_actions, check_integer, check_seed, check_word
from simulator.camera import CameraProfile

Observation = dict[str, np.ndarray]
#: Most environments in one process: at 64 pixels, they observe 1 GiB.
MAX_ENVS = 2**16


class AutoExposureVectorEnv(
    SpecProperty, gym.vector.VectorEnv[Observation, np.ndarray, np.ndarray]
):
    """`num_envs` episodes of `AutoExposureEnv`, photographed in batches; see there.

    Environment i behaves exactly as a single environment seeded with ``seed + i``.

    Args:
        num_envs: Number of episodes side by side.
        autoreset_mode: ``"NEXT_STEP"`` (default), ``"SAME_STEP"`` (``final_obs``, ``final_info``)
            or ``"DISABLED"`` (``reset(options={"reset_mask": mask})``).
        max_episode_steps: Steps after which an episode is truncated; None for never.
        render_mode: None or ``"rgb_array"``.
        arguments: As of `AutoExposureEnv`.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = 8,
        render_mode: str | None = None,
        **arguments: Any,
    ) -> None:
        num_envs = check_integer("num_envs", num_envs, 1, MAX_ENVS)
        if max_episode_steps is not None:
            rule = ", or None for never"
            max_episode_steps = check_integer("max_episode_steps", max_episode_steps, 1, more=rule)
        check_word("render_mode", render_mode, ("rgb_array",), None)
        self.autoreset_mode = _autoreset_mode(autoreset_mode)
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": 30,
            "autoreset_mode": self.autoreset_mode,
        }
        self.num_envs, self.render_mode = num_envs, render_mode
        self.max_episode_steps = max_episode_steps
        self.core = EpisodeCore(EnvOptions.from_kwargs(arguments), num_envs)
        self.single_action_space = gym.spaces.Discrete(len(self.core.grid))
        self.single_observation_space = self.core.observation_space()
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._everyone = np.arange(num_envs)
        self._rngs: list[np.random.Generator | None] = [None] * num_envs
        self._steps = np.zeros(num_envs, dtype=np.int64)
        self._done = np.zeros(num_envs, dtype=bool)
        self._shown: Observation | None = None  # a copy, where autoreset is off
        self._last: Frames | None = None

    @property
    def grid(self) -> ExposureGrid:
        """The states that actions choose from."""
        return self.core.grid

    @property
    def camera(self) -> CameraProfile:
        """The simulated body."""
        return self.core.camera

    @property
    def scenes(self) -> list[Scene]:
        """Scenes that episodes draw from; of a sequence, its first frame."""
        return self.core.first_scenes

    @property
    def delay(self) -> int:
        """Frames between an action and the first capture that has it."""
        return self.core.delay

    @property
    def states(self) -> np.ndarray:
        """(N,) int64: current exposure state of each episode."""
        self.core.episode(0)
        return self.core.episodes.state.copy()

    def episode(self, env_index: int = 0) -> Episode:
        """What was drawn for the running episode of an environment, and where it is now."""
        return self.core.episode(env_index)

    def scene(self, env_index: int = 0) -> Scene:
        """The scene that an environment photographs now; of a sequence, the current frame's."""
        return self.core.scene(env_index)

    def action_masks(self) -> np.ndarray:
        """(N, S) bool: states that the scene of each environment allows."""
        return self.core.action_masks(self._everyone)

    def expected_scores(self) -> np.ndarray:
        """(N, S) float64: expected score of every state in the current frame of each episode."""
        return np.stack([self.score_table(i).mean for i in range(self.num_envs)])

    def score_table(self, env_index: int = 0) -> ScoreTable:
        """Expected scores in an environment's current frame, with standard errors and parts."""
        return self.core.score_table(env_index)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins an episode in every environment, or in those of ``options["reset_mask"]``.

        Args:
            seed: Environment i is seeded with ``seed + i``, or with ``seed[i]``.
            options: ``scene``, ``state`` and ``frame`` as of `AutoExposureEnv`, each one value for
                all or a list, array or tensor with one per environment; ``reset_mask`` (N,) bool.
        """
        seeds = self._seeds(seed)
        options = check_options(options, "reset_mask")
        mask = self._reset_mask(options.pop("reset_mask", None))
        per_env = self._split_options(options)
        places = np.flatnonzero(mask)
        if not self.core.episodes.begun[~mask].all():
            raise gym.error.ResetNeeded("the first reset() must be of all environments")
        for i in places.tolist():
            if seeds[i] is not None or self._rngs[i] is None:
                self._rngs[i], _ = seeding.np_random(seeds[i])
        self._begin(places, per_env)
        frames = self.core.observe(places)
        self._remember(frames, places)
        return self._place(frames.observation, places), self._vector_info(frames.info, places)

    def step(
        self, actions: np.ndarray
    ) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Takes the next frame of every episode with the states `actions` (N,)."""
        actions = check_actions("actions", actions, (self.num_envs,))
        resetting = np.flatnonzero(self._done)
        if len(resetting) and self.autoreset_mode == AutoresetMode.DISABLED:
            raise gym.error.ResetNeeded("reset the finished episodes with `reset_mask` first")
        running = np.flatnonzero(~self._done)
        self.core.transition(running, actions[running])
        self._steps[running] += 1
        if len(resetting):  # NEXT_STEP: this step begins their new episodes
            self._begin(resetting)
        frames = self.core.observe(self._everyone)
        frames.reward[resetting] = 0.0
        truncated = np.zeros(self.num_envs, dtype=bool)
        if self.max_episode_steps is not None:
            truncated = self._steps >= self.max_episode_steps
        if self.autoreset_mode == AutoresetMode.SAME_STEP and truncated.any():
            observation, infos = self._restart(np.flatnonzero(truncated), frames)
        else:
            self._done = truncated.copy()
            self._remember(frames)
            observation = frames.observation
            infos = self._vector_info(frames.info, self._everyone)
        self._keep(observation)
        return observation, frames.reward, np.zeros_like(truncated), truncated, infos

    def render(self) -> tuple[np.ndarray, ...] | None:  # type: ignore[override]
        """One (H, W, 3) uint8 picture per environment; None without a render mode."""
        from ae_env.rendering import render_frame

        if self.render_mode is None:
            return None
        if self._last is None:
            raise gym.error.ResetNeeded("call reset() before render()")
        return tuple(render_frame(self.core, i, self._last) for i in range(self.num_envs))

    # -- helpers ------------------------------------------------------------------------------

    def _begin(self, places: np.ndarray, options: Sequence[dict[str, Any]] | None = None) -> None:
        rngs = []
        for i in places.tolist():
            rng = self._rngs[i]
            if rng is None:
                raise gym.error.ResetNeeded("call reset() before step()")
            rngs.append(rng)
        self.core.begin(places, rngs, [options[i] for i in places] if options else None)
        self._steps[places] = 0
        self._done[places] = False

    def _restart(self, finished: np.ndarray, frames: Frames) -> tuple[Observation, dict[str, Any]]:
        """Begins new episodes in place of those whose last frames are shown, at `finished`."""
        whole = len(finished) == self.num_envs
        last = frames.observation if whole else _taken(frames.observation, finished)
        last_info = frames.info if whole else _taken(frames.info, finished)
        final_obs = np.full(self.num_envs, None, dtype=object)
        for row, i in enumerate(finished.tolist()):
            final_obs[i] = {name: values[row] for name, values in last.items()}
        mask = np.zeros(self.num_envs, dtype=bool)
        mask[finished] = True
        infos: dict[str, Any] = {"final_obs": final_obs, "_final_obs": mask}
        infos["final_info"] = self._vector_info(last_info, finished)
        infos["_final_info"] = mask.copy()
        self._begin(finished)
        fresh = self.core.observe(finished)
        if whole:
            frames = Frames(fresh.observation, fresh.info, frames.reward)
        else:
            _put(frames.observation, fresh.observation, finished)
            _put(frames.info, fresh.info, finished)
        self._remember(frames)
        return frames.observation, infos | self._vector_info(frames.info, self._everyone)

    def _remember(self, frames: Frames, places: np.ndarray | None = None) -> None:
        """Keeps `frames`, of all or of `places`, for rendering."""
        if self.render_mode is None:
            return
        if self._last is not None and places is not None:
            last = copy.deepcopy(self._last)  # the caller has its arrays
            _put(last.observation, frames.observation, places)
            _put(last.info, frames.info, places)
            last.reward[places] = frames.reward
            frames = last
        self._last = frames

    def _place(self, observation: Observation, places: np.ndarray) -> Observation:
        """`observation` of `places` among what the others show; it is theirs to change."""
        if len(places) < self.num_envs:
            shown = self._shown
            if shown is None:  # the same frames again
                shown = self.core.observe(self._everyone).observation
            _put(shown, observation, places)
            observation = shown
        self._keep(observation)
        return observation

    def _keep(self, observation: Observation) -> None:
        if self.autoreset_mode == AutoresetMode.DISABLED:
            self._shown = {name: values.copy() for name, values in observation.items()}

    def _vector_info(self, columns: dict[str, Any], places: np.ndarray) -> dict[str, Any]:
        """Columns of `places` as Gymnasium wants them: as long as there are environments.

        Each has a mask beside it; what is not of `places` is 0 or None.
        """
        info: dict[str, Any] = {}
        masks = np.zeros((len(columns), self.num_envs), dtype=bool)
        masks[:, places] = True
        for mask, (name, values) in zip(masks, columns.items(), strict=True):
            if isinstance(values, dict):
                values = self._vector_info(values, places)
            elif len(places) < self.num_envs:
                empty = None if values.dtype == object else 0
                some, values = values, np.full(self.num_envs, empty, values.dtype)
                values[places] = some
            info[name], info[f"_{name}"] = values, mask
        return info

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        seeds = _entries(seed)
        if seeds is not None:
            if len(seeds) != self.num_envs:
                raise ValueError(f"`seed` (length {len(seeds)}) must have {self.num_envs} entries")
            return [check_seed(single, f"seed[{i}]") for i, single in enumerate(seeds)]
        first = check_integer("seed", plain(seed), 0, more=f", or {self.num_envs} of them")
        return list(range(first, first + self.num_envs))

    def _reset_mask(self, mask: Any) -> np.ndarray:
        if mask is None:
            return np.ones(self.num_envs, dtype=bool)
        shaped = isinstance(mask, np.ndarray) and mask.shape == (self.num_envs,)
        if not shaped or mask.dtype != np.bool_ or not mask.any():
            raise ValueError(
                f"`options['reset_mask']` (={mask!r}) must be a boolean array "
                f"({self.num_envs},) with at least one True"
            )
        return mask

    def _split_options(self, options: dict[str, Any]) -> list[dict[str, Any]]:
        split: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for name, value in options.items():
            values = _entries(value)
            if values is None:
                values = [plain(value)] * self.num_envs
            if len(values) != self.num_envs:
                raise ValueError(
                    f"`options[{name!r}]` (length {len(values)}) must have {self.num_envs} entries"
                )
            for single, own in zip(split, values, strict=True):
                single[name] = own
        return split


def _entries(value: Any) -> list[Any] | None:
    """One for each environment, of anything that has a length and an order; None for one of all."""
    if isinstance(value, Mapping | Set) or not hasattr(value, "__len__"):
        return None
    return plain_list(value)


def _taken(columns: dict[str, Any], rows: np.ndarray) -> dict[str, Any]:
    """Copies of `rows` of columns, which may be grouped."""
    return {
        name: _taken(values, rows) if isinstance(values, dict) else values[rows]
        for name, values in columns.items()
    }


def _put(columns: dict[str, Any], new: dict[str, Any], rows: np.ndarray) -> None:
    """Writes `new` to `rows` of columns, which may be grouped."""
    for name, values in columns.items():
        if isinstance(values, dict):
            _put(values, new[name], rows)
        else:
            values[rows] = new[name]


def _autoreset_mode(mode: str | AutoresetMode) -> AutoresetMode:
    if isinstance(mode, AutoresetMode):
        return mode
    check_word("autoreset_mode", mode, tuple(AutoresetMode.__members__))
    return AutoresetMode[mode]
