"""Policies without eyes: the floor (random), the best constant, and the ceiling (oracle)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from agents.episodes import episode_batches
from agents.policy import Observations, Policy, PolicyContext, masked_argmax

if TYPE_CHECKING:
    import gymnasium as gym

#: Episodes per scene from which the best constant state is taken.
FIT_EPISODES = 4


class Random(Policy):
    """A state drawn uniformly from the allowed ones, anew at every frame."""

    def __init__(self, context: PolicyContext) -> None:
        super().__init__(context)
        self.name = "random"
        self._rng = np.random.default_rng(0)

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Begin new episodes; the same seed draws the same states."""
        super().reset(num_envs, seed)
        self._rng = np.random.default_rng(seed)

    def act(
        self, observations: Observations, action_masks: NDArray[np.bool_] | None = None
    ) -> NDArray[np.int64]:
        """Draw a state per camera."""
        draws = self._rng.random((len(observations["raw"]), len(self.context.grid)))
        return masked_argmax(draws, action_masks)


class BestFixed(Policy):
    """The one state with the best mean expected score on the training scenes."""

    def __init__(self, context: PolicyContext) -> None:
        super().__init__(context)
        self.name = "best_fixed"
        self.mean_scores: NDArray[np.float64] | None = None

    def fit(self, envs: gym.vector.VectorEnv, seed: int = 0) -> None:
        """Average the expected scores of all states over the scenes of `envs`."""
        batches = episode_batches(envs, episodes_per_scene=FIT_EPISODES, seed=seed)
        self.mean_scores = np.concatenate([b.scores[b.valid] for b in batches]).mean(axis=0)

    def act(
        self, observations: Observations, action_masks: NDArray[np.bool_] | None = None
    ) -> NDArray[np.int64]:
        """Always the best state, or the best allowed one."""
        if self.mean_scores is None:
            raise ValueError("policy 'best_fixed' learns from scenes first: call fit(envs)")
        shape = (len(observations["raw"]), len(self.mean_scores))
        return masked_argmax(np.broadcast_to(self.mean_scores, shape), action_masks)


class Oracle(Policy):
    """Knows the expected score of every state: the ceiling that regret is measured from."""

    privileged = True

    def __init__(self, context: PolicyContext) -> None:
        super().__init__(context)
        self.name = "oracle"

    def act(
        self,
        observations: Observations,
        action_masks: NDArray[np.bool_] | None = None,
        info: Mapping[str, Any] | None = None,
    ) -> NDArray[np.int64]:
        """The best state, from ``info["oracle_state"]``."""
        if info is None or "oracle_state" not in info:
            raise ValueError("policy 'oracle' needs `info` of environments made with_oracle=True")
        return np.asarray(info["oracle_state"], dtype=np.int64).copy()
