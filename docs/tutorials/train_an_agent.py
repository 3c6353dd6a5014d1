# %% [markdown]
# # Train an agent
#
# From an environment to an agent that is judged on scenes that it has not seen, in one script,
# `docs/tutorials/train_an_agent.py`. Some two minutes on two cores with the numbers below.

# %%
import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
from stable_baselines3 import PPO

import ae_env

STEPS = 50_000
SCENES = "bundled"

# %% [markdown]
# An observation is the last frame (64 x 64 pixels of four raw planes, as 8-bit codes), the settings it
# was taken at and what the camera's sensors tell of motion and focus. An action is one of 64 states. The
# reward is the score of the capture that it gives.

# %%
env = gym.make("ae_env/AutoExposure-v0", scenes=SCENES, split="train")
observation, info = env.reset(seed=0)
print({name: (value.shape, str(value.dtype)) for name, value in observation.items()})
print(f"starts at {env.unwrapped.grid[info['state']]}, score {info['rewards.score']:.2f}")
observation, reward, terminated, truncated, info = env.step(20)
print(f"then at {env.unwrapped.grid[info['state']]}, reward {reward:.2f}")

# %% [markdown]
# Many episodes run as one batch. Stable-Baselines3 wants environments of its own kind: one line makes
# one of them. In light that stays, no frame depends on the one before, so `gamma=0`. The features are a
# small network for raws; without that line, SB3's own CNN learns the same more slowly.

# %%
from agents.learning.ppo import ExposureExtractor
from agents.learning.sb3_adapter import SB3VectorAdapter

envs = gym.make_vec(
    "ae_env/AutoExposure-v0",
    num_envs=64,
    scenes=SCENES,
    split="train",
    autoreset_mode="SAME_STEP",
)
agent = PPO(
    "MultiInputPolicy",
    SB3VectorAdapter(envs),
    gamma=0.0,
    n_steps=16,
    batch_size=256,
    learning_rate=1e-3,
    ent_coef=0.02,
    policy_kwargs={"features_extractor_class": ExposureExtractor},
    seed=0,
)
agent.learn(STEPS)
agent.save("agent")

# %% [markdown]
# Unseen scenes: the regret is how far a frame's expected score is from that of the best state, which
# the environment knows (`with_oracle=True`).


# %%
def regrets(choose, episodes=32):
    """Mean regret by frame of a function from observations to actions."""
    test = gym.make_vec(
        "ae_env/AutoExposure-v0",
        num_envs=episodes,
        scenes=SCENES,
        split="test",
        with_oracle=True,
        max_episode_steps=8,
    )
    observations, info = test.reset(seed=1)
    found = [info["regret"].mean()]
    for _ in range(7):
        observations, _, _, _, info = test.step(choose(observations))
        found.append(info["regret"].mean())
    return found


rng = np.random.default_rng(0)
curves = {
    "PPO": regrets(lambda o: agent.predict(o, deterministic=True)[0]),
    "random": regrets(lambda o: rng.integers(0, 64, len(o["raw"]))),
}
print({name: round(float(np.mean(curve[1:])), 3) for name, curve in curves.items()})

# %% [markdown]
# Light meters are beside it with two more lines: a policy has the same interface as an agent.

# %%
from agents import PolicyContext, make_policy

for name in ("average", "regression"):
    policy = make_policy(name, PolicyContext.from_envs(envs))
    policy.reset(32)
    curves[name] = regrets(policy.act)

figure, axes = plt.subplots(figsize=(6, 3.5), constrained_layout=True)
for name, curve in curves.items():
    axes.plot(curve, marker="o", label=name)
axes.set(xlabel="frame", ylabel="regret", ylim=(0, None))
axes.legend()
figure.savefig("train_an_agent.png", dpi=80)

# %% [markdown]
# ![regret by frame of PPO, a light meter, the agent of the package and random actions](train_an_agent.png)
#
# The agent of the package, `regression`, has seen many more frames. Longer trainings with checkpoints
# and configurations: [train](../train.md); other libraries: [clients](../clients.md); confidence
# intervals, conditions of light and a report: [judge](../judge.md).
