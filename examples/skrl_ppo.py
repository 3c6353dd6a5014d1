"""skrl's PPO on the native vector environment: `python examples/skrl_ppo.py`, a minute.

skrl flattens the observations, here 4 x 36 x 36 pixels, settings and sensors.
"""

import gymnasium as gym
import torch
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import CategoricalMixin, DeterministicMixin, Model
from skrl.trainers.torch import SequentialTrainer
from torch import nn

import ae_env  # noqa: F401  (registers the environments)

ROLLOUT = 16


def network(inputs, outputs):
    """Two layers on the flat observation; the pixels come as 0 to 255."""
    return nn.Sequential(
        nn.LayerNorm(inputs), nn.Linear(inputs, 128), nn.Tanh(), nn.Linear(128, outputs)
    )


class Actor(CategoricalMixin, Model):
    """A logit for each state."""

    def __init__(self, **spaces):
        Model.__init__(self, **spaces)
        CategoricalMixin.__init__(self)
        self.net = network(self.num_observations, self.num_actions)

    def compute(self, inputs, role=""):
        """Logits (N, S)."""
        return self.net(inputs["observations"].float()), {}


class Critic(DeterministicMixin, Model):
    """The value of an observation."""

    def __init__(self, **spaces):
        Model.__init__(self, **spaces)
        DeterministicMixin.__init__(self)
        self.net = network(self.num_observations, 1)

    def compute(self, inputs, role=""):
        """Values (N, 1)."""
        return self.net(inputs["observations"].float()), {}


def main(steps=400, num_envs=32, seed=0):
    """Trains for `steps` of all environments; returns the mean reward of the first and last 50."""
    torch.manual_seed(seed)
    envs = gym.make_vec("ae_env/AutoExposure-v0", num_envs=num_envs, resolution=36)
    rewards = []
    step = envs.step

    def counted(actions):
        result = step(actions)
        rewards.append(float(result[1].mean()))
        return result

    envs.step = counted
    env = wrap_env(envs, wrapper="gymnasium", verbose=False)
    spaces = {
        "observation_space": env.observation_space,
        "action_space": env.action_space,
        "device": "cpu",
    }
    agent = PPO(
        models={"policy": Actor(**spaces), "value": Critic(**spaces)},
        memory=RandomMemory(memory_size=ROLLOUT, num_envs=num_envs, device="cpu"),
        cfg=PPO_CFG(
            rollouts=ROLLOUT,
            learning_epochs=4,
            mini_batches=4,
            discount_factor=0.0,
            gae_lambda=1.0,
            learning_rate=1e-3,
        ),
        **spaces,
    )
    SequentialTrainer(env=env, agents=agent, cfg={"timesteps": steps, "headless": True}).train()
    return sum(rewards[:50]) / 50, sum(rewards[-50:]) / 50


if __name__ == "__main__":
    print("mean reward {:.3f} at first, {:.3f} at last".format(*main()))
