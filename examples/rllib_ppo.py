"""RLlib's PPO on the native vector environment, with two remote runners.

In an environment of its own, as RLlib pins another Gymnasium: pip install "ae-env[ray]", then
python examples/rllib_ppo.py, a minute.
"""

import os

import torch
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis.value_function_api import ValueFunctionAPI
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.core.rl_module.torch import TorchRLModule
from torch import nn

RUNNERS, ENVS = 2, 16
#: With "ae_env:", each runner imports the package before it makes the environment.
ENV_ID = "ae_env:ae_env/AutoExposure-v0"


class ExposureModule(TorchRLModule, ValueFunctionAPI):
    """Logits and a value from the frame in 6 x 6 zones, its settings and the sensors."""

    def setup(self):
        """Makes the layers."""
        self.pool = nn.AdaptiveAvgPool2d(6)
        self.body = nn.Sequential(
            nn.Linear(4 * 36 + 5, 128), nn.Tanh(), nn.Linear(128, 128), nn.Tanh()
        )
        self.logits = nn.Linear(128, int(self.action_space.n))
        self.value = nn.Linear(128, 1)

    def _features(self, batch):
        seen = batch[Columns.OBS]
        zones = self.pool(seen["raw"].float() / 255.0).flatten(1)
        return self.body(torch.cat([zones, seen["settings"], seen["sensors"]], dim=1))

    def _forward(self, batch, **kwargs):
        features = self._features(batch)
        return {Columns.EMBEDDINGS: features, Columns.ACTION_DIST_INPUTS: self.logits(features)}

    def compute_values(self, batch, embeddings=None):
        """Values (B,)."""
        features = self._features(batch) if embeddings is None else embeddings
        return self.value(features)[:, 0]


def main(iterations=12, scenes="bundled"):
    """Trains; returns the mean return of an episode's 8 frames in each iteration."""
    config = (
        PPOConfig()
        .environment(ENV_ID, env_config={"scenes": scenes})
        .env_runners(
            num_env_runners=RUNNERS,
            num_envs_per_env_runner=ENVS,
            gym_env_vectorize_mode="vector_entry_point",
            rollout_fragment_length="auto",
        )
        .rl_module(rl_module_spec=RLModuleSpec(module_class=ExposureModule))
        .training(
            gamma=0.0,  # in still light no frame depends on the one before
            lr=1e-3,
            train_batch_size_per_learner=2048,
            minibatch_size=256,
            num_epochs=6,
            entropy_coeff=0.01,
        )
        .debugging(seed=0, log_level="ERROR")
    )
    algorithm = config.build_algo()
    returns = []
    for _ in range(iterations):
        found = algorithm.train()["env_runners"]
        returns.append(found["episode_return_mean"])
        print(
            f"{int(found['num_env_steps_sampled_lifetime']):>7,} frames: {returns[-1]:.2f}",
            flush=True,
        )
    algorithm.stop()
    return returns


if __name__ == "__main__":
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    main()
