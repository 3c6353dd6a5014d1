"""Tianshou's PPO: `python examples/tianshou_ppo.py`, a minute."""

import gymnasium as gym
import torch
from tianshou.algorithm import PPO
from tianshou.algorithm.modelfree.reinforce import DiscreteActorPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, VectorReplayBuffer
from tianshou.env import DummyVectorEnv
from tianshou.trainer import OnPolicyTrainerParams
from tianshou.utils.net.common import Net
from tianshou.utils.net.discrete import DiscreteActor, DiscreteCritic
from torch import nn

import ae_env  # noqa: F401  (registers the environments)


def make_env(split="train"):
    """The environment with one flat observation: pixels, settings and sensors."""
    env = gym.make("ae_env/AutoExposure-v0", split=split, resolution=36)
    return gym.wrappers.FlattenObservation(env)


def main(epochs=3, steps=4096, num_envs=8, seed=0):
    """Trains; returns the mean return of random actions and of the last test."""
    torch.manual_seed(seed)
    env = make_env()
    shape = env.observation_space.shape
    body = Net(state_shape=shape, hidden_sizes=[128], norm_layer=nn.LayerNorm)
    actor = DiscreteActor(
        preprocess_net=body, action_shape=env.action_space.n, softmax_output=False
    )
    policy = DiscreteActorPolicy(
        actor=actor, action_space=env.action_space, observation_space=env.observation_space
    )
    algorithm = PPO(
        policy=policy,
        critic=DiscreteCritic(preprocess_net=body),
        optim=AdamOptimizerFactory(lr=1e-3),
        gamma=0.0,
        gae_lambda=1.0,
    )
    envs = DummyVectorEnv([make_env for _ in range(num_envs)])
    tests = DummyVectorEnv([lambda: make_env("test") for _ in range(num_envs)])
    envs.seed(seed)
    tests.seed(seed)
    buffer = VectorReplayBuffer(2048, num_envs)
    collector, judge = Collector(algorithm, envs, buffer), Collector(algorithm, tests)
    judge.reset()
    before = judge.collect(n_episode=64).returns.mean()
    found = algorithm.run_training(
        OnPolicyTrainerParams(
            training_collector=collector,
            test_collector=judge,
            max_epochs=epochs,
            epoch_num_steps=steps,
            collection_step_num_env_steps=512,
            update_step_num_repetitions=4,
            batch_size=128,
            test_step_num_episodes=64,
            verbose=False,
        )
    )
    return before, found.best_score


if __name__ == "__main__":
    print("return of 8 frames: {:.2f} before, {:.2f} at best".format(*main()))
