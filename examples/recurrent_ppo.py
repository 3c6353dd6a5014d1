"""sb3-contrib's RecurrentPPO on moving light: `python examples/recurrent_ppo.py`, some 20 minutes.

Then: ae-env evaluate --preset video --policy examples/recurrent_ppo.py:RecurrentAgent
"""

from pathlib import Path

import gymnasium as gym
import numpy as np
from safetensors.torch import load_model, save_model
from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.policies import RecurrentMultiInputActorCriticPolicy

import ae_env  # noqa: F401  (registers the environments)
from agents import Policy
from agents.learning.ppo import ExposureExtractor
from agents.learning.sb3_adapter import SB3VectorAdapter

WEIGHTS = "runs/recurrent.safetensors"
NETWORK = {
    "features_extractor_class": ExposureExtractor,
    "lstm_hidden_size": 256,
    "net_arch": [],  # the logits are linear in the memory
}


def train(weights=WEIGHTS, frames=300_000, seed=0, callback=None):
    """Trains on moving light, and writes the network."""
    envs = gym.make_vec(
        "ae_env/AutoExposureVideo-v0",
        num_envs=64,
        scenes="mixed",
        split="train",
        max_episode_steps=48,
        autoreset_mode="SAME_STEP",
    )
    model = RecurrentPPO(
        "MultiInputLstmPolicy",
        SB3VectorAdapter(envs),
        gamma=0.8,  # an action shows three frames later
        gae_lambda=0.9,
        n_steps=32,
        batch_size=256,
        n_epochs=4,
        learning_rate=lambda remaining: 1e-3 * (0.1 + 0.9 * remaining),
        ent_coef=0.01,
        policy_kwargs=NETWORK,
        seed=seed,
        device="cpu",
    )
    model.learn(frames, callback=callback)
    Path(weights).parent.mkdir(parents=True, exist_ok=True)
    save_model(model.policy, weights)


class RecurrentAgent(Policy):
    """The trained network: its memory is that of the episode."""

    def __init__(self, context, weights=WEIGHTS):
        super().__init__(context)
        if not Path(weights).is_file():
            raise ValueError(f"there is no {weights}: run `python examples/recurrent_ppo.py` first")
        actions = gym.spaces.Discrete(len(context.grid))
        self.network = RecurrentMultiInputActorCriticPolicy(
            context.observation_space, actions, lambda _: 0.0, **NETWORK
        )
        load_model(self.network, weights)

    def reset(self, num_envs, seed=None):
        """Forgets the frames so far."""
        super().reset(num_envs, seed)
        self.memory = None

    def act(self, observations, action_masks=None):
        """The most probable state."""
        begins = np.full(self.num_envs, self.memory is None)
        states, self.memory = self.network.predict(
            observations, self.memory, episode_start=begins, deterministic=True
        )
        return states.astype(np.int64)


if __name__ == "__main__":
    train()
