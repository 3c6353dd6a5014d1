"""Train Stable-Baselines3's PPO on many episodes in one batch, and test it on unseen scenes."""

import gymnasium as gym
from stable_baselines3 import PPO

import ae_env  # noqa: F401  (registers the environment)
from agents.learning.ppo import ExposureExtractor
from agents.learning.sb3_adapter import SB3VectorAdapter

STEPS = 50_000

envs = SB3VectorAdapter(
    gym.make_vec("ae_env/AutoExposure-v0", num_envs=64, split="train", autoreset_mode="SAME_STEP")
)
model = PPO(
    "MultiInputPolicy",
    envs,
    gamma=0.0,  # in static light no frame depends on the one before
    n_steps=16,
    batch_size=256,
    learning_rate=1e-3,
    ent_coef=0.02,
    policy_kwargs={"features_extractor_class": ExposureExtractor},  # leave out for SB3's own CNN
)
model.learn(STEPS)

test = gym.make_vec("ae_env/AutoExposure-v0", num_envs=64, split="test", with_oracle=True)
observations, _ = test.reset(seed=0)
for _ in range(4):
    actions, _ = model.predict(observations, deterministic=True)
    observations, reward, _, _, info = test.step(actions)
    print(f"mean reward {reward.mean():.3f}, regret {info['regret'].mean():.3f}")
