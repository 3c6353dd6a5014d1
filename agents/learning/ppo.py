"""The PPO agent: Stable-Baselines3's PPO on the native vector environment.

The image of a static scene does not depend on earlier actions, so the problem is a contextual
bandit: the default discount is 0.
"""

from collections import deque
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from pydantic import Field
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import MultiInputActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from ae_env.grid import ExposureGrid
from agents.learning import networks
from agents.learning.policy_file import MAX_HISTORY, MAX_WIDTH, NetworkPolicy, trained_grid
from agents.learning.sb3_adapter import SB3VectorAdapter, TrainingFrames, WithHistory
from agents.policy import Bools, Ints, Observations, PolicyContext
from simulator.utils.checkpoint import Checkpoint
from simulator.utils.config_file import Configuration


class ExposureExtractor(BaseFeaturesExtractor):
    """`ExposureFeatures` as SB3 wants it, followed by what the `StateHead` needs beside it.

    That is the light's histograms and the sensors. SB3 has divided the raw by 255 already.
    """

    def __init__(self, observation_space: gym.spaces.Dict, width: int = 256) -> None:
        sensors = 2 if "sensors" in observation_space.spaces else 0
        super().__init__(observation_space, width + networks.LIGHT_NUMBERS + sensors)
        self.features = networks.ExposureFeatures(observation_space, width)

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """Features (B, features_dim)."""
        raw, settings = observations["raw"], observations["settings"]
        sensors = observations.get("sensors")
        features = self.features(raw, settings, sensors, observations.get("history"))
        light = self.features.light(raw, settings, observations.get("histogram"))
        return torch.cat([features, light] + ([] if sensors is None else [sensors]), dim=1)


class _StateLogits(nn.Module):
    """Logit of each state from the output of `ExposureExtractor`."""

    def __init__(
        self, grid: ExposureGrid, width: int, has_sensors: bool, trained_on: ExposureGrid | None
    ) -> None:
        super().__init__()
        self.sizes = [width, networks.LIGHT_NUMBERS, 2 if has_sensors else 0]
        self.head = networks.StateHead(grid, width, has_sensors, trained_on=trained_on)
        nn.init.orthogonal_(self.head.values.weight, 0.01)  # all states start alike
        nn.init.zeros_(self.head.values.bias)

    def forward(self, extracted: torch.Tensor) -> torch.Tensor:
        """Logits (B, S)."""
        features, light, sensors = torch.split(extracted, self.sizes, dim=1)
        return self.head(features, light, sensors if sensors.shape[1] else None)[..., 0]

    def loss(self, extracted: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
        """Loss of what the head says of the right exposure, whose EV100 is `right` (B,)."""
        features, light, _ = torch.split(extracted, self.sizes, dim=1)
        return networks.exposure_loss(*self.head.right_ev100(features, light), right)


class _WithLoss(torch.autograd.Function):
    """A tensor as it is; backwards the gradient of a scalar `loss`, which SB3's PPO cannot take."""

    @staticmethod
    def forward(ctx: Any, tensor: torch.Tensor, loss: torch.Tensor) -> torch.Tensor:
        return tensor.view_as(tensor)

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return gradient, gradient.new_ones(())


class ExposureActorCritic(MultiInputActorCriticPolicy):
    """SB3's actor and critic on the exposure features, with a `StateHead` for the logits."""

    action_net: _StateLogits

    def __init__(
        self,
        observation_space: gym.spaces.Dict,
        action_space: gym.spaces.Discrete,
        lr_schedule: Callable[[float], float],
        *,
        grid: ExposureGrid,
        width: int = 256,
        trained_on: ExposureGrid | None = None,
        ev_coef: float = 0.0,
        use_sde: bool = False,
    ) -> None:
        self.grid, self.width, self.trained_on = grid, width, trained_on
        self.ev_coef = ev_coef
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            features_extractor_class=ExposureExtractor,
            features_extractor_kwargs={"width": width},
            net_arch={"pi": [], "vf": [128]},
            activation_fn=nn.ReLU,
            use_sde=use_sde,
        )

    def _build(self, lr_schedule: Callable[[float], float]) -> None:
        super()._build(lr_schedule)
        # SB3 has made a plain linear layer for the logits, and an optimiser that knows only that.
        has_sensors = self.features_dim > self.width + networks.LIGHT_NUMBERS
        self.action_net = _StateLogits(self.grid, self.width, has_sensors, self.trained_on)
        rate = lr_schedule(1)
        self.optimizer = self.optimizer_class(self.parameters(), lr=rate, **self.optimizer_kwargs)  # type: ignore[call-arg]

    def evaluate_actions(
        self, obs: Any, actions: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
        """Values, log probabilities of `actions`, and entropy, which brings the exposure's loss."""
        extracted: Any = self.extract_features(obs)
        latent, of_value = self.mlp_extractor(extracted)
        distribution = self._get_action_dist_from_latent(latent)
        entropy = distribution.entropy()
        if self.ev_coef > 0.0 and entropy is not None:
            loss = self.action_net.loss(extracted, obs["right_ev100"][:, 0])
            entropy = _WithLoss.apply(entropy, self.ev_coef * loss)  # type: ignore[no-untyped-call]
        return self.value_net(of_value), distribution.log_prob(actions), entropy


#: Hyperparameters that are not arguments of Stable-Baselines3's PPO.
_OF_OURS = {"total_timesteps", "learning_rate", "ev_coef", "width", "history", "seed"}


class PPOTraining(Configuration):
    """Hyperparameters of PPO, named as in Stable-Baselines3."""

    total_timesteps: int = Field(default=200_000, ge=1, le=10**12)  # of all environments together
    n_steps: int = Field(default=16, ge=1, le=10**6)  # frames per environment and update
    batch_size: int = Field(default=256, ge=2, le=10**9)  # frames of a gradient step
    n_epochs: int = Field(default=4, ge=1, le=10**4)  # passes over each rollout
    learning_rate: float = Field(default=1e-3, ge=1e-9, le=1.0)  # falls linearly to a tenth
    gamma: float = Field(default=0.0, ge=0.0, le=1.0)  # 0: a still scene is a contextual bandit
    gae_lambda: float = Field(default=1.0, ge=0.0, le=1.0)  # of the advantage estimate
    clip_range: float = Field(default=0.2, ge=1e-6, le=1e6)  # of the probability ratio
    ent_coef: float = Field(default=0.02, ge=0.0, le=1e6)  # of the entropy; falls to a tenth
    vf_coef: float = Field(default=0.5, ge=0.0, le=1e6)  # weight of the value loss
    max_grad_norm: float = Field(default=0.5, ge=1e-9, le=1e9)  # gradient clipping
    #: Weight of the loss of the right exposure's EV100, see `StateHead`.
    ev_coef: float = Field(default=0.05, ge=0.0, le=100.0)
    width: int = Field(default=256, ge=1, le=MAX_WIDTH)  # hidden features of the network
    #: Frames of which the network sees what a light meter read and what was asked for
    #: (`MeterHistory`); 0 for none.
    history: int = Field(default=0, ge=0, le=MAX_HISTORY)
    seed: int = Field(default=0, ge=0, le=2**32 - 1)  # seed of scenes, noise, weights and actions

    def check_batch(self, num_envs: int) -> None:
        """Raises a `ValueError` unless `num_envs` rollouts divide into gradient steps."""
        frames = self.n_steps * num_envs
        if frames % self.batch_size:
            rollout = f"n_steps * num_envs (={self.n_steps} * {num_envs} = {frames})"
            raise ValueError(f"`batch_size` (={self.batch_size}) must divide a rollout, {rollout}")


class PPOPolicy(NetworkPolicy):
    """Takes the most probable state; remembers its last one, and what its network learnt with."""

    kind = "ppo"
    #: Log of how many times as probable; the least of 0, 0.05, 0.2, 0.5, 1 and 2 that ends the
    #: swings of grey cards.
    hysteresis = 0.5

    @staticmethod
    def make_network(context: PolicyContext, card: dict[str, Any]) -> ExposureActorCritic:
        """See `NetworkPolicy.make_network`."""
        history, space = card["history"], context.observation_space
        return ExposureActorCritic(
            networks.with_history(space, history) if history else space,
            gym.spaces.Discrete(len(context.grid)),
            lambda _: 0.0,
            grid=context.grid,
            width=card["width"],
            trained_on=trained_grid(card),
        )

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Forgets the frames so far."""
        super().reset(num_envs, seed)
        frames = self.network.features_extractor.features.history // networks.NUMBERS
        self._history = networks.MeterHistory(self.context, num_envs, frames) if frames else None

    def act(self, observations: Observations, action_masks: Bools | None = None) -> Ints:
        """Most probable allowed state (N,)."""
        self.check_reset(observations)
        shown = dict(observations)
        if self._history is not None:
            shown["history"] = self._history.observe(observations)
        with torch.inference_mode():
            tensors, _ = self.network.obs_to_tensor(shown)
            distribution: Any = self.network.get_distribution(tensors).distribution
        states = self._choose(distribution.logits.double().cpu().numpy(), action_masks)
        if self._history is not None:
            self._history.record_action(states)
        return states


def train_ppo(
    envs: gym.vector.VectorEnv,
    training: PPOTraining,
    session: networks.Session = networks.UNWATCHED,
) -> ExposureActorCritic:
    """A policy network, trained by PPO on the scenes of `envs` (autoreset mode SAME_STEP)."""
    training.check_batch(envs.num_envs)
    context = PolicyContext.from_envs(envs)
    callback = _TrainingCallback(training, session)
    store = session.store(training, callback.state)
    past = store.load()
    done = 0 if past is None else int(past["timesteps"])
    seen: VecEnv = SB3VectorAdapter(envs)
    if training.history:
        seen = WithHistory(seen, context, training.history)
    seed = training.seed
    if done:  # a training that resumes must not repeat its first draws
        seed = int(np.random.SeedSequence([seed, done]).generate_state(1)[0])
    model = PPO(
        ExposureActorCritic,
        TrainingFrames(seen, np.random.default_rng([training.seed, done])),
        learning_rate=lambda remaining: training.learning_rate * (0.1 + 0.9 * remaining),
        policy_kwargs={"grid": context.grid, **training.model_dump(include={"width", "ev_coef"})},
        seed=seed,
        device=session.device,
        **training.model_dump(exclude=_OF_OURS),
    )
    if past is not None:
        model.policy.load_state_dict(past["policy"])
        model.policy.optimizer.load_state_dict(past["optimizer"])
        model.num_timesteps = done
    callback.start(model, store)
    remaining = training.total_timesteps - done
    if remaining > 0:
        with store:
            model.learn(remaining, callback=callback, reset_num_timesteps=done == 0)
    network = model.policy
    assert isinstance(network, ExposureActorCritic)
    return network


class _TrainingCallback(BaseCallback):
    """Progress, falling entropy, and checkpoints between the updates."""

    def __init__(self, training: PPOTraining, session: networks.Session) -> None:
        super().__init__()
        self.training, self.session = training, session
        self._rewards: deque[float] = deque(maxlen=50)

    def start(self, model: PPO, checkpoint: Checkpoint) -> None:
        """Takes the model that is trained, and where its checkpoints go."""
        self.model, self.checkpoint = model, checkpoint
        self.learnt = model.num_timesteps  # frames of complete updates

    def state(self) -> dict[str, Any]:
        """State of the training for its checkpoint. A half-done rollout is taken again."""
        policy, optimizer = self.model.policy.state_dict(), self.model.policy.optimizer.state_dict()
        return {"timesteps": self.learnt, "policy": policy, "optimizer": optimizer}

    def _on_step(self) -> bool:
        self._rewards.append(float(np.mean(self.locals["rewards"])))
        recent = float(np.mean(self._rewards))
        self.session.report(self.num_timesteps, self.training.total_timesteps, {"reward": recent})
        return True

    def _on_rollout_start(self) -> None:
        done = self.num_timesteps / self.training.total_timesteps
        model: Any = self.model
        model.ent_coef = self.training.ent_coef * (1.0 - 0.9 * min(done, 1.0))
        self.learnt = self.num_timesteps
        self.checkpoint.save_when_due()

    def _on_training_end(self) -> None:
        self.learnt = self.num_timesteps
