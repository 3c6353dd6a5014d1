"""What the regression agent learns from: frames that it meets, and those that it remembers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

from agents.learning.history import History
from agents.policy import Observations

if TYPE_CHECKING:
    from agents.learning.regression import RegressionPolicy, RegressionTraining


class Replay:
    """The last frames and their scores, to be seen again mirrored or not."""

    def __init__(self, training: RegressionTraining, rng: np.random.Generator) -> None:
        self.training, self.rng = training, rng
        self.memory: list[dict[str, NDArray[Any]]] = []

    def batch(
        self, observations: Observations, target: NDArray[np.float64]
    ) -> tuple[dict[str, NDArray[Any]], NDArray[np.float64]]:
        """The new frames and some old ones."""
        new = {**observations, "target": target}
        parts = [new]
        for _ in range(min(self.training.replay, len(self.memory))):
            chosen = [self.memory[i] for i in self.rng.integers(len(self.memory), size=4)]
            rows = self.rng.integers(len(target), size=(4, max(1, len(target) // 4)))
            mixed = {
                k: np.concatenate([c[k][r] for c, r in zip(chosen, rows, strict=True)]) for k in new
            }
            if self.rng.random() < 0.5:
                mixed["raw"] = mixed["raw"][..., ::-1]
            parts.append(mixed)
        self.remember(observations, target)
        merged = {key: np.concatenate([p[key] for p in parts]) for key in new}
        return merged, merged.pop("target")

    def remember(self, observations: Observations, target: NDArray[np.float64]) -> None:
        """Keeps the new frames, and forgets the oldest beyond the memory."""
        count = self.batches(len(target))
        self.memory = [*self.memory, {**observations, "target": target}][-count:]

    def batches(self, num_envs: int) -> int:
        """How many steps of that many frames are remembered."""
        return max(1, self.training.memory // num_envs)


class Rollout:
    """Frames and the scores of all states, from episodes that the policy itself drives."""

    def __init__(
        self,
        envs: gym.vector.VectorEnv,
        policy: RegressionPolicy,
        training: RegressionTraining,
        history: History,
    ) -> None:
        self.envs, self.policy, self.history = envs, policy, history
        self.explore, self.base = training.explore, cast(Any, envs.unwrapped)
        self.rng = np.random.default_rng([training.seed, 0])
        self.replay = Replay(training, np.random.default_rng([training.seed, 0, 1]))
        self.observations: Observations | None = None

    def batch(self) -> tuple[dict[str, NDArray[Any]], NDArray[np.float64]]:
        """The next frame of every episode, with its scores, and some earlier ones."""
        if self.observations is None:
            self._reset()
        else:
            actions = self.policy.act(self.observations)
            random = self.rng.random(len(actions)) < self.explore
            others = self.rng.integers(len(self.policy.context.grid), size=len(actions))
            self.policy.forget(self._step(np.where(random, others, actions)))
        return self.replay.batch(self._shown(), self.base.expected_scores())

    def mark(self) -> None:
        """Makes this moment the one that a checkpoint holds."""
        known = {name: torch.tensor(own) for name, own in self.policy.accumulated.items()}
        self.history.mark(
            rng=self.rng.bit_generator.state,
            replay_rng=self.replay.rng.bit_generator.state,
            **known,
        )

    def resume(self) -> None:
        """Goes to the moment of the history's mark."""
        past, marked = self.history.actions, self.history.marked
        self.history.actions = []
        self._reset()
        for left in range(len(past), -1, -1):
            if left < self.replay.batches(self.envs.num_envs):
                self.replay.remember(self._shown(), self.base.expected_scores())
            if left:
                self._step(past[-left])
        self.rng.bit_generator.state = marked["rng"]
        self.replay.rng.bit_generator.state = marked["replay_rng"]
        self.policy.accumulated = {name: marked[name].numpy() for name in self.policy.accumulated}

    def _reset(self) -> None:
        self.observations, _ = self.envs.reset(seed=int(self.rng.integers(2**31)))
        self.policy.reset(self.envs.num_envs)

    def _step(self, actions: NDArray[Any]) -> NDArray[np.bool_]:
        self.history.add(actions)
        self.observations, _, terminated, truncated, _ = self.envs.step(actions)
        return terminated | truncated

    def _shown(self) -> Observations:
        assert self.observations is not None
        return self.observations
