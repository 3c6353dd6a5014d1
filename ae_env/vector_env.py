"""`ae_env/AutoExposure-v0`, many episodes side by side in one process."""

import copy
from collections.abc import Mapping, Sequence, Set
from dataclasses import replace
from typing import Any, Unpack

import gymnasium as gym
import numpy as np
import torch
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from ae_env.env import AutoExposureBase, Observation
from ae_env.episodes.core import Frames, check_actions
from ae_env.episodes.state import check_options
from ae_env.grid import plain, plain_list
from ae_env.options import EnvArguments, takes_env_arguments
from simulator.utils.checks import check_integer, check_seed, check_word

#: Most environments in one process: at 64 pixels, they observe 1 GiB.
MAX_ENVS = 2**16


class AutoExposureVectorEnv(
    AutoExposureBase, gym.vector.VectorEnv[Observation, np.ndarray, np.ndarray]
):
    """`num_envs` episodes of `AutoExposureEnv`, photographed in batches.

    Environment i behaves exactly as a single environment seeded with ``seed + i``. Its info holds
    numbers only, as wrappers for torch and JAX need: ``scene_id`` and ``modules`` are indices into
    `scene_ids` and `module_names`.

    Args:
        num_envs: Number of episodes side by side.
        autoreset_mode: ``"NEXT_STEP"`` (default), ``"SAME_STEP"`` (``final_obs``, ``final_info``)
            or ``"DISABLED"`` (``reset(options={"reset_mask": mask})``); Gymnasium's enum and its
            values (``"SameStep"``), too.
        max_episode_steps: Steps after which an episode is truncated; None for never.

    All other arguments are those of `AutoExposureEnv`. With a `device`, observations, rewards,
    flags and info are torch tensors on it, floats in float32; actions may be.
    """

    @takes_env_arguments()
    def __init__(
        self,
        num_envs: int = 1,
        *,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = 8,
        render_mode: str | None = None,
        **arguments: Unpack[EnvArguments],
    ) -> None:
        self.num_envs = num_envs = check_integer("num_envs", num_envs, 1, MAX_ENVS)
        if max_episode_steps is not None:
            rule = ", or None for never"
            max_episode_steps = check_integer("max_episode_steps", max_episode_steps, 1, more=rule)
        self.max_episode_steps = max_episode_steps
        if not isinstance(autoreset_mode, AutoresetMode):
            modes = {known: one for one in AutoresetMode for known in (one.name, one.value)}
            check_word("autoreset_mode", autoreset_mode, tuple(modes))
            autoreset_mode = modes[autoreset_mode]
        self.autoreset_mode = autoreset_mode
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": 30}
        self.metadata |= {"autoreset_mode": autoreset_mode}
        self._set_up(arguments, num_envs, render_mode)
        self.single_action_space = gym.spaces.Discrete(self.core.num_actions)
        self.single_observation_space = self.core.observation_space()
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._all = np.arange(num_envs)
        self._rngs: dict[int, np.random.Generator] = {}  # by environment, from the first reset on
        self._steps = np.zeros(num_envs, dtype=np.int64)
        self._done = np.zeros(num_envs, dtype=bool)

    @property
    def states(self) -> np.ndarray:
        """(N,) int64: current exposure state of each episode."""
        self.core.episode(0)
        return self.core.episodes.state.copy()

    def action_masks(self) -> np.ndarray:
        """(N, S) bool: states that the scene of each environment allows."""
        return self.core.task.allowed(self._all)

    def expected_scores(self) -> np.ndarray:
        """(N, S) float64: expected score of every state in the current frame of each episode."""
        return np.stack([self.score_table(i).mean for i in range(self.num_envs)])

    def right_ev100(self) -> np.ndarray:
        """(N,) float64: EV100 of the right exposure of the current frame; its mean if unknown."""
        episodes = self.core.episodes
        scenes = [episodes.scenes[i].ev100 for i in episodes.scene.tolist()]
        times = np.array([self.grid[state].exposure_time for state in episodes.state.tolist()])
        return np.array(scenes) + np.log2(episodes.gains(self._all, times)[0])

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
        per_env: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for name, value in options.items():
            values = self._entries(f"options[{name!r}]", value)
            values = [plain(value)] * self.num_envs if values is None else values
            for single, own in zip(per_env, values, strict=True):
                single[name] = own
        env_indices = np.flatnonzero(mask)
        if not self.core.episodes.begun[~mask].all():
            raise gym.error.ResetNeeded("the first reset() must be of all environments")
        for i in env_indices.tolist():
            if seeds[i] is not None or i not in self._rngs:
                self._rngs[i], _ = seeding.np_random(seeds[i])
        self._begin(env_indices, per_env)
        fresh = self.core.observe(env_indices)
        info = self._vector_info(fresh.info, env_indices)
        if len(env_indices) == self.num_envs:
            return self._shown(fresh), info
        # The others show their frames again; the same noise keys give the same frames.
        shown = self._last or self.core.observe(self._all)
        _assign_rows(vars(shown), vars(fresh), env_indices)
        return self._shown(shown), info

    def step(self, actions: Any) -> tuple[Observation, Any, Any, Any, dict[str, Any]]:
        """Takes the next frame of every episode with the states `actions` (N,)."""
        if torch.is_tensor(actions):
            actions = actions.cpu().numpy()
        actions = check_actions("actions", actions, (self.num_envs,))
        resetting = None
        if np.count_nonzero(self._done):
            if self.autoreset_mode == AutoresetMode.DISABLED:
                raise gym.error.ResetNeeded("reset the finished episodes with `reset_mask` first")
            resetting, running = np.flatnonzero(self._done), np.flatnonzero(~self._done)
            terminated = np.zeros(self.num_envs, dtype=bool)
            terminated[running] = self.core.transition(running, actions[running])
            self._steps[running] += 1
            self._begin(resetting)  # NEXT_STEP: this step begins their new episodes
        else:
            terminated = self.core.transition(self._all, actions)
            self._steps += 1
        frames = self.core.observe(self._all)
        if resetting is not None:
            frames.reward[resetting] = 0.0
        most = np.inf if self.max_episode_steps is None else self.max_episode_steps
        truncated = self._steps >= most
        done = terminated | truncated
        if self.autoreset_mode == AutoresetMode.SAME_STEP and np.count_nonzero(done):
            observation, infos = self._restart(np.flatnonzero(done), frames)
        else:
            self._done = done
            infos = self._vector_info(frames.info, self._all)
            observation = self._shown(frames)
        placed = self.core.options.placed
        return observation, frames.reward, placed(terminated), placed(truncated), infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """One picture (H, W, 3) uint8 per environment, as `AutoExposureEnv.render` draws it.

        None, and a warning in the log, without a `render_mode`.
        """
        return self._pictures(self.num_envs)

    def _begin(
        self, env_indices: np.ndarray, options: Sequence[dict[str, Any]] | None = None
    ) -> None:
        rngs = [self._rngs[i] for i in env_indices.tolist()]
        self.core.begin(env_indices, rngs, [options[i] for i in env_indices] if options else None)
        self._steps[env_indices] = 0
        self._done[env_indices] = False

    def _restart(self, finished: np.ndarray, frames: Frames) -> tuple[Observation, dict[str, Any]]:
        """Begins new episodes in the environments `finished`, whose last frames are `frames`."""
        whole = len(finished) == self.num_envs
        last = vars(frames) if whole else _rows_of(vars(frames), finished)
        final_obs = np.full(self.num_envs, None, dtype=object)
        names = last["observation"].keys()
        for i, *values in zip(finished.tolist(), *last["observation"].values(), strict=True):
            final_obs[i] = dict(zip(names, values, strict=True))
        mask = np.zeros(self.num_envs, dtype=bool)
        mask[finished] = True
        placed = self.core.options.placed
        infos: dict[str, Any] = {"final_obs": final_obs, "_final_obs": placed(mask)}
        infos |= {"final_info": self._vector_info(last["info"], finished)}
        infos["_final_info"] = placed(mask.copy())
        self._begin(finished)
        fresh = replace(self.core.observe(finished), reward=last["reward"])
        if whole:
            frames = fresh
        else:
            _assign_rows(vars(frames), vars(fresh), finished)
        infos |= self._vector_info(frames.info, self._all)
        return self._shown(frames), infos

    def _shown(self, frames: Frames) -> Observation:
        """The observation of `frames` of all; a copy of them is kept where they are shown again.

        That is in `render`, and in a masked reset where autoreset is off. The caller may write to
        the arrays that it gets.
        """
        if self.render_mode is not None or self.autoreset_mode == AutoresetMode.DISABLED:
            self._last = copy.deepcopy(frames)
        return frames.observation

    def _vector_info(self, columns: dict[str, Any], env_indices: np.ndarray) -> dict[str, Any]:
        """Info columns of `env_indices` in the layout of Gymnasium's vector environments.

        Every column has one entry per environment, 0 for those that are not in `env_indices`, and
        a mask beside it, the same read-only one for all.
        """
        placed, partial = self.core.options.placed, len(env_indices) < self.num_envs
        mask = np.full(self.num_envs, not partial)
        if partial:
            mask[env_indices] = True
            columns = dict(columns)
            for name, some in columns.items():
                made: Any = torch.zeros if torch.is_tensor(some) else np.zeros
                columns[name] = placed(made((self.num_envs, *some.shape[1:]), dtype=some.dtype))
                columns[name][env_indices] = some
        shared = dict.fromkeys([f"_{name}" for name in columns], placed(mask))
        mask.setflags(write=False)
        return columns | shared

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        seeds = self._entries("seed", seed)
        if seeds is not None:
            return [check_seed(single, f"seed[{i}]") for i, single in enumerate(seeds)]
        first = check_integer("seed", plain(seed), 0, more=f", or {self.num_envs} of them")
        return list(range(first, first + self.num_envs))

    def _reset_mask(self, mask: Any) -> np.ndarray:
        if mask is None:
            return np.ones(self.num_envs, dtype=bool)
        mask = mask.cpu().numpy() if torch.is_tensor(mask) else mask
        fits = isinstance(mask, np.ndarray) and mask.shape == (self.num_envs,)
        if not fits or mask.dtype != np.bool_ or not mask.any():
            raise ValueError(
                f"`options['reset_mask']` (={mask!r}) must be a boolean array "
                f"({self.num_envs},) with at least one True"
            )
        return mask

    def _entries(self, name: str, value: Any) -> list[Any] | None:
        """The entries of an ordered collection, one per environment; None for a single value."""
        if isinstance(value, Mapping | Set) or not hasattr(value, "__len__"):
            return None
        values = plain_list(value)
        if values is not None and len(values) != self.num_envs:
            raise ValueError(f"`{name}` (length {len(values)}) must have {self.num_envs} entries")
        return values


def _rows_of(columns: Mapping[str, Any], rows: np.ndarray) -> dict[str, Any]:
    """Copies of `rows` of columns, which may be nested dictionaries."""
    return {
        name: _rows_of(values, rows) if isinstance(values, dict) else _signed(values)[rows]
        for name, values in columns.items()
    }


def _assign_rows(columns: Mapping[str, Any], new: Mapping[str, Any], rows: np.ndarray) -> None:
    """Writes `new` to `rows` of columns, which may be nested dictionaries."""
    for name, values in columns.items():
        if isinstance(values, dict):
            _assign_rows(values, new[name], rows)
        else:
            _signed(values)[rows] = _signed(new[name])


def _signed(values: Any) -> Any:
    """`values`, or the same memory as int16: torch cannot index uint16."""
    is_uint16 = torch.is_tensor(values) and values.dtype == torch.uint16
    return values.view(torch.int16) if is_uint16 else values
