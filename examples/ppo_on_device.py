"""PPO in one file, all of it on one device: frames, rewards, network and updates stay there.

On a GPU the frames are made there. On the CPU the compiled loops are the faster ones: leave out
`device` for them, and turn what comes into tensors.
"""

from time import perf_counter

import gymnasium as gym
import torch

import ae_env  # noqa: F401  (registers the environment)
from agents.learning.networks import ExposureFeatures
from agents.learning.regression import observation_tensors

#: In still light an action changes the next frame alone: the discount is 0, the return the reward.
EPOCHS, BATCH, CLIP, ENTROPY, RATE = 4, 256, 0.2, 0.02, 1e-3


class ActorCritic(torch.nn.Module):
    """A distribution over the states, and the expected reward, from an observation."""

    def __init__(self, envs: gym.vector.VectorEnv, width: int = 256) -> None:
        super().__init__()
        self.features = ExposureFeatures(envs.single_observation_space, width)
        self.actor = torch.nn.Linear(width, int(envs.single_action_space.n))
        self.critic = torch.nn.Linear(width, 1)

    def forward(self, *observation):
        """A distribution over states (B,), and values (B,)."""
        hidden = torch.relu(self.features(*observation))
        return torch.distributions.Categorical(logits=self.actor(hidden)), self.critic(hidden)[:, 0]


def train(device: str, updates: int = 200, num_envs: int = 64, steps: int = 16) -> ActorCritic:
    """A network that PPO trained in `updates` rollouts of `num_envs` times `steps` frames."""
    fixed = {"split": "train", "autoreset_mode": "SAME_STEP", "device": device}
    envs = gym.make_vec("ae_env/AutoExposure-v0", num_envs=num_envs, **fixed)
    torch.manual_seed(0)
    network = ActorCritic(envs).to(device)
    optimiser = torch.optim.Adam(network.parameters(), lr=RATE)
    observations, _ = envs.reset(seed=0)
    begun, stepping = now(device), 0.0
    for update in range(1, updates + 1):
        rollout = []
        for _ in range(steps):
            seen = observation_tensors(observations, device)
            with torch.no_grad():
                choice, _ = network(*seen)
            actions, before = choice.sample(), now(device)
            observations, rewards, *_ = envs.step(actions)
            stepping += now(device) - before
            rollout.append((*seen, actions, choice.log_prob(actions), rewards))
        improve(network, optimiser, [torch.cat(parts) for parts in zip(*rollout, strict=True)])
        if update % 10 == 0 or update == updates:
            seconds, frames = now(device) - begun, update * steps * num_envs
            print(
                f"{frames} frames: mean reward {rewards.mean().item():.3f}, {frames / seconds:.0f} "
                f"frames a second, {stepping / seconds:.0%} of the time in the environment",
                flush=True,
            )
    return network


def improve(network: ActorCritic, optimiser: torch.optim.Optimizer, rollout) -> None:
    """Updates the network from a rollout: observations, actions, log probabilities, rewards."""
    *frames, actions, log_probs, rewards = rollout
    for _ in range(EPOCHS):
        for rows in torch.randperm(len(actions), device=actions.device).split(BATCH):
            choice, values = network(*(frame[rows] for frame in frames))
            advantages = rewards[rows] - values.detach()
            advantages = (advantages - advantages.mean()) / (advantages.std(correction=0) + 1e-8)
            ratio = torch.exp(choice.log_prob(actions[rows]) - log_probs[rows])
            gain = torch.min(ratio * advantages, ratio.clamp(1 - CLIP, 1 + CLIP) * advantages)
            off = 0.5 * (rewards[rows] - values).square()
            loss = (off - gain - ENTROPY * choice.entropy()).mean()
            optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 0.5)
            optimiser.step()


def now(device: str) -> float:
    """The time [s] when `device` has done all that it was asked for."""
    if device.startswith("cuda"):
        torch.cuda.synchronize(device)
    return perf_counter()


if __name__ == "__main__":
    train("cuda" if torch.cuda.is_available() else "cpu")
