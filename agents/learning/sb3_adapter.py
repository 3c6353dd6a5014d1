"""From a Gymnasium vector environment to Stable-Baselines3's `VecEnv`."""

from collections.abc import Sequence
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from agents.learning.networks import MeterHistory, random_shift, with_history
from agents.policy import PolicyContext


class SB3VectorAdapter(VecEnv):
    """Lets SB3 and sb3-contrib train on a Gymnasium vector environment, wrapped or not.

    Rollouts are those of SB3's `DummyVecEnv` over single environments with the same seeds, without
    the cost of stepping them one by one. A `ValueError` if the autoreset mode is not SAME_STEP, or
    they have a `device`.
    """

    def __init__(self, envs: gym.vector.VectorEnv) -> None:
        mode = envs.metadata.get("autoreset_mode")
        if mode != AutoresetMode.SAME_STEP:
            raise ValueError(f"`envs` must have autoreset_mode='SAME_STEP', got {mode}")
        if (device := cast(Any, envs.unwrapped).core.options.device) is not None:
            rule = "SB3 takes arrays (examples/ppo_on_device.py trains on tensors)"
            raise ValueError(f"`envs` must have device=None, got {device!r}: {rule}")
        self.envs = envs
        self.render_mode = envs.render_mode
        self._info_of = cast(Any, envs.unwrapped).info_of
        self._actions: np.ndarray | None = None
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> Any:
        """Begins an episode in every environment, with the seeds and options that were set."""
        seeds: Any = None if all(s is None for s in self._seeds) else self._seeds
        names = {name for own in self._options for name in own}
        options = {name: [own.get(name) for own in self._options] for name in names}
        observations, infos = self.envs.reset(seed=seeds, options=options)
        columns = _columns(infos)
        self.reset_infos = [self._info_of(columns, i) for i in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Stores the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Takes the step and returns observations, float32 rewards, dones and infos."""
        observations, rewards, terminated, truncated, infos = self.envs.step(self._actions)
        dones = terminated | truncated
        columns, last = _columns(infos), _columns(infos.get("final_info", {}))
        rows: list[dict[str, Any]] = []
        for i in range(self.num_envs):
            row: dict[str, Any] = {"TimeLimit.truncated": bool(truncated[i] and not terminated[i])}
            rows.append(row | self._info_of(last if dones[i] else columns, i))
            if dones[i]:
                self.reset_infos[i] = self._info_of(columns, i)
                rows[i]["terminal_observation"] = infos["final_obs"][i]
        return observations, rewards.astype(np.float32), dones, rows

    def close(self) -> None:
        """Closes the vector environment."""
        self.envs.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """One picture per environment, for `render` and SB3's video recorder."""
        pictures: Any = self.envs.render()
        return [None] * self.num_envs if pictures is None else list(pictures)

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The attribute, once per environment: all share one object."""
        value = self._find(attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Raises an `AttributeError`, as the environments share one object."""
        raise AttributeError(f"`{attr_name}` cannot be set on the environments of a batch")

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Calls the method of the batch and returns its rows."""
        rows = self._find(method_name)(*method_args, **method_kwargs)
        return [rows[i] for i in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Whether each environment is wrapped: none is, wrappers of the batch do not count."""
        return [False for _ in self._get_indices(indices)]

    def _find(self, name: str) -> Any:
        """An attribute of the batch, or of the outermost of its wrappers that has it."""
        layer: Any = self.envs
        while not hasattr(layer, name) and isinstance(layer, gym.vector.VectorWrapper):
            layer = layer.env
        return getattr(layer, name)

    def _get_indices(self, indices: Any) -> list[int]:
        """Any of SB3's ways to name environments, or a NumPy integer, as a list."""
        named = range(self.num_envs) if indices is None else np.atleast_1d(indices)
        return [int(i) for i in named]


class TrainingFrames(VecEnvWrapper):
    """Shows frames shifted by `random_shift`, those of each step otherwise.

    With them comes ``right_ev100`` (1,), for a loss: no policy sees it.
    """

    def __init__(self, venv: VecEnv, rng: np.random.Generator) -> None:
        assert isinstance(venv.observation_space, gym.spaces.Dict)
        right = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
        spaces = {**venv.observation_space.spaces, "right_ev100": right}
        super().__init__(venv, gym.spaces.Dict(spaces))
        self.rng = rng

    def reset(self) -> Any:
        """Begins an episode in every environment."""
        return self._shown(self.venv.reset())

    def step_wait(self) -> Any:
        """Takes the step."""
        observations, *rest = self.venv.step_wait()
        return self._shown(observations), *rest

    def _shown(self, observations: Any) -> dict[str, np.ndarray]:
        right = np.array(self.venv.env_method("right_ev100"), np.float32)
        raw = random_shift(observations["raw"], self.rng)
        return {**observations, "raw": raw, "right_ev100": right[:, None]}


class WithHistory(VecEnvWrapper):
    """Adds the ``history`` of so many `frames` to the observations, see `MeterHistory`."""

    def __init__(self, venv: VecEnv, context: PolicyContext, frames: int) -> None:
        assert isinstance(venv.observation_space, gym.spaces.Dict)
        super().__init__(venv, with_history(venv.observation_space, frames))
        self._history = MeterHistory(context, venv.num_envs, frames)

    def reset(self) -> Any:
        """Begins an episode in every environment."""
        self._history.forget(np.ones(self.num_envs, bool))
        observations: Any = self.venv.reset()
        return {**observations, "history": self._history.observe(observations)}

    def step_async(self, actions: np.ndarray) -> None:
        """Remembers the actions, and takes the step."""
        self._history.record_action(actions)
        self.venv.step_async(actions)

    def step_wait(self) -> Any:
        """Takes the step."""
        observations, rewards, dones, infos = self.venv.step_wait()
        assert isinstance(observations, dict)
        last, ended = observations, np.flatnonzero(dones)
        if len(ended):
            last = {name: values.copy() for name, values in observations.items()}
            for i in ended:
                for name, value in infos[i]["terminal_observation"].items():
                    last[name][i] = value
        history = self._history.observe(last)
        if len(ended):
            for i in ended:
                infos[i]["terminal_observation"]["history"] = history[i]
            self._history.forget(dones)
            history = np.where(dones[:, None], self._history.observe(observations, dones), history)
        return {**observations, "history": history}, rewards, dones, infos


def _columns(infos: dict[str, Any]) -> dict[str, Any]:
    """The columns of a vector environment's info, without their masks and the final ones."""
    return {
        name: _columns(values) if isinstance(values, dict) else values
        for name, values in infos.items()
        if not name.startswith(("_", "final_"))
    }
