"""The PPO agent: Stable-Baselines3's PPO on the native vector environment.

The image of a static scene does not depend on what was done before, so that the problem is a
contextual bandit: the default discount is 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import MultiInputActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from agents.checkpoint import Checkpoint
from agents.networks import ExposureFeatures
from agents.policy import Observations, Policy, PolicyContext, masked_argmax
from agents.sb3_adapter import SB3VectorAdapter
from agents.weights import check_context, describe_context, load_agent, save_agent


class ExposureExtractor(BaseFeaturesExtractor):
    """`ExposureFeatures` as SB3 wants it; SB3 has divided the raw by 255 already."""

    def __init__(self, observation_space: gym.spaces.Dict, features_dim: int = 256) -> None:
        super().__init__(observation_space, features_dim)
        self.features = ExposureFeatures(observation_space, features_dim)

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """Features (B, features_dim)."""
        sensors = observations.get("sensors")
        return self.features(observations["raw"], observations["settings"], sensors)


@dataclass(frozen=True)
class PPOTraining:
    """Hyperparameters of PPO, named as in Stable-Baselines3.

    Args:
        total_timesteps: Frames in all environments together.
        n_steps: Frames per environment and update.
        batch_size: Frames of a gradient step.
        n_epochs: Passes over each rollout.
        learning_rate: At the start; falls linearly to a tenth.
        gamma: Discount; 0 because a static scene is a contextual bandit.
        gae_lambda: Of the advantage estimate.
        clip_range: Of the probability ratio.
        ent_coef: Weight of the entropy at the start; falls linearly to a tenth.
        vf_coef: Weight of the value loss.
        max_grad_norm: Gradient clipping.
        width: Hidden features of the network.
        seed: Of scenes, noise, weights and actions.
    """

    total_timesteps: int = 200_000
    n_steps: int = 16
    batch_size: int = 256
    n_epochs: int = 4
    learning_rate: float = 1e-3
    gamma: float = 0.0
    gae_lambda: float = 1.0
    clip_range: float = 0.2
    ent_coef: float = 0.01
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5
    width: int = 256
    seed: int = 0


def make_policy_network(
    observation_space: gym.spaces.Dict, action_space: gym.Space, width: int
) -> MultiInputActorCriticPolicy:
    """SB3's policy with the exposure features, on its own, to load weights into."""
    return MultiInputActorCriticPolicy(
        observation_space, action_space, lambda _: 0.0, **_policy_kwargs(width)
    )


def _policy_kwargs(width: int) -> dict[str, Any]:
    return {
        "features_extractor_class": ExposureExtractor,
        "features_extractor_kwargs": {"features_dim": width},
        "net_arch": {"pi": [128], "vf": [128]},
        "activation_fn": torch.nn.ReLU,
    }


class PPOPolicy(Policy):
    """Takes the most probable state; remembers nothing between frames.

    Args:
        context: The camera, the grid and the observation.
        weights: File written by `save_ppo`; or give `network`.
        network: A network in memory.

    Raises:
        ValueError: If the weights were trained for another grid or observation.
    """

    def __init__(
        self,
        context: PolicyContext,
        weights: str | Path | None = None,
        network: MultiInputActorCriticPolicy | None = None,
    ) -> None:
        super().__init__(context)
        if (weights is None) == (network is None):
            raise ValueError("give either `weights` or `network`")
        if network is None:
            tensors, card = load_agent(str(weights), "ppo")
            check_context(card, context)
            actions = gym.spaces.Discrete(len(context.grid))
            network = make_policy_network(context.observation_space, actions, card["width"])
            network.load_state_dict(tensors)
        network.set_training_mode(False)
        self.network = network

    def act(
        self, observations: Observations, action_masks: NDArray[np.bool_] | None = None
    ) -> NDArray[np.int64]:
        """Most probable allowed state (N,)."""
        with torch.inference_mode():
            tensors, _ = self.network.obs_to_tensor(dict(observations))
            distribution: Any = self.network.get_distribution(tensors).distribution
        return masked_argmax(distribution.logits.cpu().numpy(), action_masks)


class _TrainingCallback(BaseCallback):
    """Progress, falling entropy, and checkpoints between the updates."""

    def __init__(
        self,
        training: PPOTraining,
        store: Checkpoint,
        progress: Callable[[int, int, dict[str, float]], None] | None,
    ) -> None:
        super().__init__()
        self.training, self.store, self.progress = training, store, progress
        self._rewards: list[float] = []

    def _on_step(self) -> bool:
        self._rewards.append(float(np.mean(self.locals["rewards"])))
        if self.progress is not None:
            recent = float(np.mean(self._rewards[-50:]))
            self.progress(self.num_timesteps, self.training.total_timesteps, {"reward": recent})
        return True

    def _on_rollout_start(self) -> None:
        done = self.num_timesteps / self.training.total_timesteps
        self.model.ent_coef = self.training.ent_coef * (1.0 - 0.9 * min(done, 1.0))  # type: ignore[attr-defined]
        self.store.save(self.num_timesteps)


def train_ppo(
    envs: gym.vector.VectorEnv,
    training: PPOTraining,
    *,
    checkpoint: Path | None = None,
    progress: Callable[[int, int, dict[str, float]], None] | None = None,
    device: str = "cpu",
) -> MultiInputActorCriticPolicy:
    """Trains PPO on the scenes of `envs` (autoreset mode SAME_STEP).

    Args:
        envs: Vector environments.
        training: Hyperparameters.
        checkpoint: Where to keep the state of the training; a second run resumes there.
        progress: Called with frames done, frames in all, and the mean reward.
        device: Torch device of the network.

    Returns:
        The trained policy network.
    """
    model = PPO(
        MultiInputActorCriticPolicy,
        SB3VectorAdapter(envs),
        learning_rate=lambda remaining: training.learning_rate * (0.1 + 0.9 * remaining),
        n_steps=training.n_steps,
        batch_size=training.batch_size,
        n_epochs=training.n_epochs,
        gamma=training.gamma,
        gae_lambda=training.gae_lambda,
        clip_range=training.clip_range,
        ent_coef=training.ent_coef,
        vf_coef=training.vf_coef,
        max_grad_norm=training.max_grad_norm,
        policy_kwargs=_policy_kwargs(training.width),
        seed=training.seed,
        device=device,
    )
    store = Checkpoint(checkpoint, {"policy": model.policy, "optimiser": model.policy.optimizer})
    done = store.restore()
    model.num_timesteps = done
    if done:  # a resumed run sees other episodes than the first
        model.env.seed(training.seed + done)  # type: ignore[union-attr]
    remaining = training.total_timesteps - done
    if remaining > 0:
        callback = _TrainingCallback(training, store, progress)
        model.learn(remaining, callback=callback, reset_num_timesteps=done == 0)
    store.remove()
    return model.policy  # type: ignore[return-value]


def save_ppo(
    path: Path,
    network: MultiInputActorCriticPolicy,
    context: PolicyContext,
    training: dict[str, Any],
) -> None:
    """Writes the agent as ``path.safetensors`` and ``path.json``."""
    description = {
        "width": network.features_dim,
        "context": describe_context(context),
        "training": training,
    }
    save_agent(path, "ppo", network, description)
