"""`ae_env/AutoExposure-v0`, many episodes side by side in one process."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from ae_env.core import EpisodeCore, Frames
from ae_env.env import single_info
from ae_env.grid import ExposureGrid
from ae_env.options import EnvOptions
from ae_env.registration import SpecProperty
from ae_env.scenes import Scene
from simulator.camera import CameraProfile

Observation = dict[str, np.ndarray]


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
        if num_envs < 1:
            raise ValueError(f"`num_envs` (={num_envs}) must be at least 1")
        if max_episode_steps is not None and max_episode_steps < 1:
            raise ValueError(f"`max_episode_steps` (={max_episode_steps}) must be at least 1")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"`render_mode` (={render_mode!r}) must be None or 'rgb_array'")
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
        """Scenes that episodes draw from."""
        return self.core.scenes

    @property
    def states(self) -> np.ndarray:
        """(N,) int64: current exposure state of each episode."""
        return np.array([self.core.episode(i).state for i in range(self.num_envs)])

    def action_masks(self) -> np.ndarray:
        """(N, S) bool: states that may be chosen."""
        return np.tile(self.core.action_masks(), (self.num_envs, 1))

    def expected_scores(self) -> np.ndarray:
        """(N, S) float64: expected score of every state in the current frame of each episode."""
        return np.stack([self.core.expected_scores(i).mean for i in range(self.num_envs)])

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
                all or a sequence with one per environment; ``reset_mask`` (N,) bool.
        """
        seeds = self._seeds(seed)
        options = dict(options or {})
        mask = self._reset_mask(options.pop("reset_mask", None))
        per_env = self._split_options(options)
        indices = np.flatnonzero(mask).tolist()
        if any(self.core.episodes[i] is None for i in np.flatnonzero(~mask)):
            raise gym.error.ResetNeeded("the first reset() must be of all environments")
        for i in indices:
            if seeds[i] is not None or self._rngs[i] is None:
                self._rngs[i], _ = seeding.np_random(seeds[i])
        self._begin(indices, per_env)
        frames = self.core.observe(indices)
        self._remember(frames, indices)
        shown = self._place(frames.observation, indices)
        return shown, self._vector_info(frames.info, indices)

    def step(
        self, actions: np.ndarray
    ) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Takes the next frame of every episode with the states `actions` (N,)."""
        actions = np.asarray(actions)
        if actions.shape != (self.num_envs,) or actions.dtype.kind not in "iu":
            raise ValueError(
                f"`actions` ({actions.dtype}, shape {actions.shape}) must be integers "
                f"({self.num_envs},)"
            )
        everyone = list(range(self.num_envs))
        resetting: list[int] = []
        if self._done.any():
            if self.autoreset_mode == AutoresetMode.DISABLED:
                raise gym.error.ResetNeeded("reset the finished episodes with `reset_mask` first")
            resetting = np.flatnonzero(self._done).tolist()
        running = [i for i in everyone if i not in set(resetting)]
        previous = {i: self.core.episode(i).state for i in running}
        chosen = actions.tolist()
        for i in running:  # before any of them acts
            self.core.check_action(chosen[i])
        for i in running:
            self.core.act(i, chosen[i])
        self._steps[running] += 1
        if resetting:  # NEXT_STEP: this step begins their new episodes
            self._begin(resetting, [{}] * self.num_envs)
            frames = self._merge(
                self.core.observe(running, [previous[i] for i in running]) if running else None,
                self.core.observe(resetting),
                running,
                resetting,
            )
            frames.reward[resetting] = 0.0
        else:
            frames = self.core.observe(everyone, [previous[i] for i in everyone])
        reward, infos = frames.reward, self._vector_info(frames.info, everyone)
        truncated = np.zeros(self.num_envs, dtype=bool)
        if self.max_episode_steps is not None:
            truncated[running] = self._steps[running] >= self.max_episode_steps
        observation = frames.observation
        finished = np.flatnonzero(truncated).tolist()
        if finished and self.autoreset_mode == AutoresetMode.SAME_STEP:
            observation, infos = self._restart(finished, frames, infos)
        else:
            self._done = truncated.copy()
            self._remember(frames)
        self._keep(observation)
        return observation, reward, np.zeros(self.num_envs, dtype=bool), truncated, infos

    def render(self) -> tuple[np.ndarray, ...] | None:  # type: ignore[override]
        """One (H, W, 3) uint8 picture per environment; None without a render mode."""
        from ae_env.rendering import render_frame

        if self.render_mode is None:
            return None
        if self._last is None:
            raise gym.error.ResetNeeded("call reset() before render()")
        return tuple(render_frame(self.core, i, self._last) for i in range(self.num_envs))

    # -- helpers ------------------------------------------------------------------------------

    def _begin(self, indices: list[int], options: list[dict[str, Any]]) -> None:
        drawn = []
        for i in indices:
            rng = self._rngs[i]
            if rng is None:
                raise gym.error.ResetNeeded("call reset() before step()")
            drawn.append(self.core.drawn(rng, options[i]))
        for i, episode in zip(indices, drawn, strict=True):
            self.core.begin(i, episode)
        self._steps[indices] = 0
        self._done[indices] = False

    def _restart(
        self, finished: list[int], frames: Frames, infos: dict[str, Any]
    ) -> tuple[Observation, dict[str, Any]]:
        final_obs = np.full(self.num_envs, None, dtype=object)
        final_info: dict[str, Any] = {}
        for i in finished:
            final_obs[i] = {name: values[i].copy() for name, values in frames.observation.items()}
            final_info = self._add_info(final_info, single_info(frames.info, i), i)
        self._begin(finished, [{}] * self.num_envs)
        fresh = self.core.observe(finished)
        if len(finished) == self.num_envs:
            observation, merged = fresh.observation, fresh.info
        else:
            observation = frames.observation
            for name, values in fresh.observation.items():
                observation[name][finished] = values
            merged = _overwrite(frames.info, fresh.info, finished)
        self._remember(Frames(observation, merged, frames.reward))
        mask = np.zeros(self.num_envs, dtype=bool)
        mask[finished] = True
        infos = {"final_obs": final_obs, "_final_obs": mask}
        infos |= {"final_info": final_info, "_final_info": mask.copy()}
        return observation, infos | self._vector_info(merged, list(range(self.num_envs)))

    def _merge(
        self, first: Frames | None, second: Frames, running: list[int], resetting: list[int]
    ) -> Frames:
        if first is None:
            return second
        order = np.argsort(running + resetting)

        def join(a: Any, b: Any) -> Any:
            if isinstance(a, dict):
                return {name: join(a[name], b[name]) for name in a}
            return np.concatenate([a, b])[order]

        return Frames(
            join(first.observation, second.observation),
            join(first.info, second.info),
            join(first.reward, second.reward),
        )

    def _remember(self, frames: Frames, rows: list[int] | None = None) -> None:
        if self.render_mode is None:
            return
        if self._last is not None and rows is not None and len(rows) < self.num_envs:
            last = self._last
            frames = Frames(
                _overwrite(last.observation, frames.observation, rows),
                _overwrite(last.info, frames.info, rows),
                _overwrite(last.reward, frames.reward, rows),
            )
        self._last = frames

    def _place(self, observation: Observation, indices: list[int]) -> Observation:
        """`observation` of `indices` among what the others show; it is theirs to change."""
        if len(indices) < self.num_envs:
            shown = self._shown
            if shown is None:  # the same frames again
                shown = self.core.observe(list(range(self.num_envs))).observation
            observation = _overwrite(shown, observation, indices)
        self._keep(observation)
        return observation

    def _keep(self, observation: Observation) -> None:
        if self.autoreset_mode == AutoresetMode.DISABLED:
            self._shown = {name: values.copy() for name, values in observation.items()}

    def _vector_info(self, columns: dict[str, Any], indices: list[int]) -> dict[str, Any]:
        if len(indices) < self.num_envs:
            info: dict[str, Any] = {}
            for row, i in enumerate(indices):
                info = self._add_info(info, single_info(columns, row), i)
            return info
        info = {}
        for name, values in columns.items():
            is_group = isinstance(values, dict)
            info[name] = self._vector_info(values, indices) if is_group else values
            info[f"_{name}"] = np.ones(self.num_envs, dtype=bool)
        return info

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, int | np.integer):
            return [int(seed) + i for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(f"`seed` (length {len(seed)}) must have {self.num_envs} entries")
        return list(seed)

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
        known = ("scene", "state", "frame")
        split: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for name, value in options.items():
            if name not in known:
                raise ValueError(f"`options` has {name!r}; it may have {[*known, 'reset_mask']}")
            alike = value is None or isinstance(value, str | int | np.integer)
            if not alike and len(value) != self.num_envs:
                raise ValueError(
                    f"`options[{name!r}]` (length {len(value)}) must have {self.num_envs} entries"
                )
            for i, single in enumerate(split):
                single[name] = value if alike else value[i]
        return split


def _overwrite(old: Any, new: Any, rows: list[int]) -> Any:
    if isinstance(old, dict):
        return {name: _overwrite(old[name], new[name], rows) for name in old}
    merged = old.copy()
    merged[rows] = new
    return merged


def _autoreset_mode(mode: str | AutoresetMode) -> AutoresetMode:
    if isinstance(mode, AutoresetMode):
        return mode
    if mode in AutoresetMode.__members__:
        return AutoresetMode[mode]
    known = list(AutoresetMode.__members__)
    raise ValueError(f"`autoreset_mode` (={mode!r}) must be one of {known}")
