"""A stack of the last frames as numbers: what a light meter read, and what was asked for."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from ae_env.observation import encode_settings
from agents.metering.meters import make_meter
from agents.metering.reading import frame_ev100
from agents.policy import Observations, PolicyContext

#: Numbers of a frame: metered EV against the newest frame's, exposure, clipping, what was asked for
#: after the frame before it (Av, Tv, Sv).
NUMBERS = 6
#: Numbers are within this.
_LARGEST = 4.0


class MeterHistory:
    """What a light meter read in the last frames of each camera, and what was asked for.

    Args:
        context: The camera and the grid.
        num_envs: Cameras.
        frames: Frames that are kept, the one in hand among them.
    """

    def __init__(self, context: PolicyContext, num_envs: int, frames: int) -> None:
        self._meter = make_meter("average", context.camera)
        states = context.grid.states
        apex = np.array([[s.aperture_value, s.time_value, s.speed_value] for s in states])
        self._apex = encode_settings(apex)
        self._frames = np.full((num_envs, frames, NUMBERS), np.nan)
        self._asked = np.full((num_envs, 3), np.nan)

    def observe(
        self, observations: Observations, rows: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float32]:
        """Takes in a frame of each camera; returns the history (N, frames * NUMBERS), newest first.

        Args:
            observations: Of all cameras.
            rows: Which of them have a new frame; by default all.
        """
        reading, exposed = self._meter(observations), frame_ev100(observations)
        asked = np.where(np.isnan(self._asked), observations["settings"], self._asked)
        numbers = [reading.ev100, (reading.ev100 - exposed) / 4.0, reading.saturated, *asked.T]
        new = np.stack(numbers, axis=1)
        shifted = np.concatenate([new[:, None], self._frames[:, :-1]], axis=1)
        # Before the first frame there was the same.
        shifted = np.where(np.isnan(shifted), new[:, None], shifted)
        which = np.ones(len(new), bool) if rows is None else rows
        self._frames[which] = shifted[which]
        shown = self._frames.copy()
        shown[:, :, 0] = (shown[:, :, 0] - shown[:, :1, 0]) / 2.0
        flat = np.clip(shown, -_LARGEST, _LARGEST).reshape(len(shown), -1)
        return flat.astype(np.float32)

    def asked(self, states: NDArray[np.int64]) -> None:
        """Remembers the states that were asked for after the frame in hand, ``(N,)``."""
        self._asked = self._apex[states].astype(np.float64)

    def forget(self, rows: NDArray[np.bool_]) -> None:
        """Forgets the frames of the cameras that `rows` marks."""
        self._frames[rows], self._asked[rows] = np.nan, np.nan


class WithHistory(VecEnvWrapper):
    """Adds ``history`` to the observations, see `MeterHistory`.

    Args:
        venv: SB3's view of the environments.
        context: The camera and the grid.
        frames: Frames that are kept.
    """

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
        self._history.asked(actions)
        self.venv.step_async(actions)

    def step_wait(self) -> Any:
        """Takes the step."""
        observations, rewards, dones, infos = self.venv.step_wait()
        assert isinstance(observations, dict)
        if not dones.any():
            history = self._history.observe(observations)
            return {**observations, "history": history}, rewards, dones, infos
        last = {name: values.copy() for name, values in observations.items()}
        for i in np.flatnonzero(dones):
            for name, value in infos[i]["terminal_observation"].items():
                last[name][i] = value
        history = self._history.observe(last)
        for i in np.flatnonzero(dones):
            infos[i]["terminal_observation"]["history"] = history[i]
        self._history.forget(dones)
        history = np.where(dones[:, None], self._history.observe(observations, dones), history)
        return {**observations, "history": history}, rewards, dones, infos


def with_history(space: gym.spaces.Dict, frames: int) -> gym.spaces.Dict:
    """The observation `space` of a single environment with the history of so many frames."""
    box = gym.spaces.Box(-_LARGEST, _LARGEST, (frames * NUMBERS,), np.float32)
    return gym.spaces.Dict({**space.spaces, "history": box})
