"""The PPO agent: Stable-Baselines3's PPO on the native vector environment.

The image of a static scene does not depend on what was done before, so that the problem is a
contextual bandit: the default discount is 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import MultiInputActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from ae_env.grid import ExposureGrid
from agents.learning.agent_weights import MAX_WIDTH, describe_context, save_agent
from agents.learning.history import History
from agents.learning.network_policy import NetworkPolicy
from agents.learning.networks import ExposureFeatures, StateHead, check_ranges
from agents.learning.sb3_adapter import SB3VectorAdapter
from agents.policy import Observations, PolicyContext, masked_argmax
from simulator.utils.checkpoint import Checkpoint


class ExposureExtractor(BaseFeaturesExtractor):
    """`ExposureFeatures` as SB3 wants it, with the sensors kept beside for the `StateHead`.

    SB3 has divided the raw by 255 already.
    """

    def __init__(self, observation_space: gym.spaces.Dict, width: int = 256) -> None:
        sensors = 2 if "sensors" in observation_space.spaces else 0
        super().__init__(observation_space, width + sensors)
        self.features = ExposureFeatures(observation_space, width)

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """Features (B, features_dim)."""
        sensors = observations.get("sensors")
        features = self.features(observations["raw"], observations["settings"], sensors)
        return features if sensors is None else torch.cat([features, sensors], dim=1)


class _StateLogits(nn.Module):
    """Logit of each state from what `ExposureExtractor` gives."""

    def __init__(
        self, grid: ExposureGrid, width: int, has_sensors: bool, trained_on: ExposureGrid | None
    ) -> None:
        super().__init__()
        self.width = width
        self.head = StateHead(grid, width, has_sensors, trained_on=trained_on)
        nn.init.orthogonal_(self.head.values.weight, 0.01)  # begin with all states alike
        nn.init.zeros_(self.head.values.bias)

    def forward(self, prepared: torch.Tensor) -> torch.Tensor:
        """Logits (B, S)."""
        features, sensors = prepared[:, : self.width], prepared[:, self.width :]
        return self.head(features, sensors if sensors.shape[1] else None)[..., 0]


class ExposureActorCritic(MultiInputActorCriticPolicy):
    """SB3's actor and critic on the exposure features, with a `StateHead` for the logits.

    Args:
        observation_space: Observation of a single environment.
        action_space: `Discrete`, one per state.
        lr_schedule: As SB3 calls it.
        grid: The exposure states.
        width: Features that describe a frame.
        trained_on: See `StateHead`.
        kwargs: Further arguments of SB3's policy.
    """

    def __init__(
        self,
        observation_space: gym.spaces.Dict,
        action_space: gym.Space,
        lr_schedule: Any,
        *,
        grid: ExposureGrid,
        width: int = 256,
        trained_on: ExposureGrid | None = None,
        **kwargs: Any,
    ) -> None:
        self.grid, self.width, self.trained_on = grid, width, trained_on
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            features_extractor_class=ExposureExtractor,
            features_extractor_kwargs={"width": width},
            net_arch={"pi": [], "vf": [128]},
            activation_fn=nn.ReLU,
            **kwargs,
        )

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        has_sensors = self.features_dim > self.width
        self.action_net = _StateLogits(self.grid, self.width, has_sensors, self.trained_on)
        rate = lr_schedule(1)
        self.optimizer = self.optimizer_class(self.parameters(), lr=rate, **self.optimizer_kwargs)  # type: ignore[call-arg]


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
    ent_coef: float = 0.02
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5
    width: int = 256
    seed: int = 0

    def __post_init__(self) -> None:
        check_ranges(
            self,
            total_timesteps=(1, 1e12),
            n_steps=(1, 1e6),
            batch_size=(2, 1e9),
            n_epochs=(1, 1e4),
            learning_rate=(1e-9, 1.0),
            gamma=(0.0, 1.0),
            gae_lambda=(0.0, 1.0),
            clip_range=(1e-6, 1e6),
            ent_coef=(0.0, 1e6),
            vf_coef=(0.0, 1e6),
            max_grad_norm=(1e-9, 1e9),
            width=(1, MAX_WIDTH),
            seed=(0, 2**32 - 1),
        )

    def check_batch(self, num_envs: int) -> None:
        """Raises a `ValueError` unless `num_envs` rollouts divide into gradient steps."""
        frames = self.n_steps * num_envs
        if frames % self.batch_size:
            raise ValueError(
                f"`batch_size` (={self.batch_size}) must divide the frames of a rollout, n_steps * "
                f"num_envs (={self.n_steps} * {num_envs} = {frames})"
            )


class PPOPolicy(NetworkPolicy):
    """Takes the most probable state; remembers nothing between frames. See `NetworkPolicy`."""

    kind = "ppo"

    @staticmethod
    def make_network(
        context: PolicyContext, width: int, trained_on: ExposureGrid | None = None
    ) -> ExposureActorCritic:
        """See `NetworkPolicy`."""
        return ExposureActorCritic(
            context.observation_space,
            gym.spaces.Discrete(len(context.grid)),
            lambda _: 0.0,
            grid=context.grid,
            width=width,
            trained_on=trained_on,
        )

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
        history: History,
        progress: Callable[[int, int, dict[str, float]], None] | None,
    ) -> None:
        super().__init__()
        self.training, self.store, self.progress = training, store, progress
        self.history = history
        self.updated: int | None = None  # frames learnt from; None within an update
        self._rewards: list[float] = []

    def _on_step(self) -> bool:
        self.history.add(self.locals["actions"])
        self._rewards.append(float(np.mean(self.locals["rewards"])))
        if self.progress is not None:
            recent = float(np.mean(self._rewards[-50:]))
            self.progress(self.num_timesteps, self.training.total_timesteps, {"reward": recent})
        return True

    def _on_rollout_start(self) -> None:
        done = self.num_timesteps / self.training.total_timesteps
        self.model.ent_coef = self.training.ent_coef * (1.0 - 0.9 * min(done, 1.0))  # type: ignore[attr-defined]
        self.history.mark(**_random_state(self.model.device))
        self.updated = self.num_timesteps
        self.store.save(self.updated)

    def _on_rollout_end(self) -> None:
        self.updated = None


def train_ppo(
    envs: gym.vector.VectorEnv,
    training: PPOTraining,
    *,
    checkpoint: Path | None = None,
    progress: Callable[[int, int, dict[str, float]], None] | None = None,
    device: str = "cpu",
    identity: Any = None,
) -> ExposureActorCritic:
    """Trains PPO on the scenes of `envs` (autoreset mode SAME_STEP).

    Args:
        envs: Vector environments.
        training: Hyperparameters.
        checkpoint: Where to keep the state of the training; a second run goes on there and ends
            with the weights that the first would have ended with.
        progress: Called with frames done, frames in all, and the mean reward.
        device: Torch device of the network.
        identity: JSON value; the checkpoint of a training with another one is not resumed. By
            default the hyperparameters.

    Returns:
        The trained policy network.
    """
    training.check_batch(envs.num_envs)
    context = PolicyContext.from_envs(envs)
    model = PPO(
        ExposureActorCritic,
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
        policy_kwargs={"grid": context.grid, "width": training.width},
        seed=training.seed,
        device=device,
    )
    history = History(envs.num_envs)
    store = Checkpoint(
        checkpoint,
        {"policy": model.policy, "optimiser": model.policy.optimizer, "history": history},
        identity=identity or asdict(training),
    )
    done = store.restore()
    model.num_timesteps = done
    remaining = training.total_timesteps - done
    if remaining > 0:
        if done:
            _resume(model, history)
        callback = _TrainingCallback(training, store, history, progress)
        try:
            model.learn(remaining, callback=callback, reset_num_timesteps=done == 0)
        except (KeyboardInterrupt, SystemExit):
            if callback.updated is not None:
                store.save(callback.updated, force=True)
            raise
    store.save(model.num_timesteps, force=True)
    return model.policy  # type: ignore[return-value]


def _resume(model: PPO, history: History) -> None:
    """Takes the environments and the random generators to where the history was marked."""
    envs = cast(SB3VectorAdapter, model.env)
    observations, starts = envs.reset(), np.ones(envs.num_envs, dtype=bool)
    for actions in history.actions:
        observations, _, starts, _ = envs.step(actions)
    model._last_obs, model._last_episode_starts = observations, starts
    marked = history.marked
    words = {"key": marked["numpy_key"].numpy().astype(np.uint32), "pos": marked["numpy_pos"]}
    np.random.set_state({"bit_generator": "MT19937", "state": words})  # noqa: NPY002
    torch.set_rng_state(marked["torch"])
    if model.device.type == "cuda":
        torch.cuda.set_rng_state(marked["cuda"], model.device)


def _random_state(device: torch.device) -> dict[str, Any]:
    """The global generators that SB3 draws from: torch's for actions, numpy's for batches."""
    words: Any = np.random.get_state(legacy=False)["state"]  # type: ignore[call-overload]  # noqa: NPY002
    state = {
        "torch": torch.get_rng_state(),
        "numpy_key": torch.from_numpy(words["key"].astype(np.int64)),
        "numpy_pos": int(words["pos"]),
    }
    return state | ({"cuda": torch.cuda.get_rng_state(device)} if device.type == "cuda" else {})


def save_ppo(
    path: Path,
    network: ExposureActorCritic,
    context: PolicyContext,
    training: dict[str, Any],
) -> None:
    """Writes the agent as ``path.safetensors`` and ``path.json``."""
    description = {
        "width": network.width,
        "context": describe_context(context),
        "training": training,
    }
    save_agent(path, "ppo", network, description)
