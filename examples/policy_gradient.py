"""A training loop in one file: policy gradient with a learnt baseline, discount 0."""

import gymnasium as gym
import torch

import ae_env  # noqa: F401  (registers the environment)
from agents.learning.networks import ExposureFeatures
from agents.learning.regression import observation_tensors

STEPS = 300

envs = gym.make_vec(
    "ae_env/AutoExposure-v0", num_envs=64, split="train", autoreset_mode="SAME_STEP"
)
features = ExposureFeatures(envs.single_observation_space, width=128)
actor, critic = torch.nn.Linear(128, envs.single_action_space.n), torch.nn.Linear(128, 1)
network = torch.nn.ModuleList([features, actor, critic])
optimiser = torch.optim.Adam(network.parameters(), lr=1e-3)
observations, _ = envs.reset(seed=0)
for step in range(STEPS):
    hidden = features(*observation_tensors(observations))
    choice = torch.distributions.Categorical(logits=actor(hidden))
    actions = choice.sample()
    observations, reward, *_ = envs.step(actions.numpy())
    advantage = torch.as_tensor(reward, dtype=torch.float32) - critic(hidden)[:, 0]
    loss = (advantage.square() - advantage.detach() * choice.log_prob(actions)).mean()
    loss = loss - 0.01 * choice.entropy().mean()
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    if step % 20 == 0:
        print(f"step {step}: mean reward {reward.mean():.3f}")
