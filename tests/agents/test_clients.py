"""Other people's training code runs every task unchanged."""

import runpy
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO

from ae_env.registration import TASKS
from agents import PolicyContext, make_policy
from tests.ae_env.environments import SMALL

ROOT = Path(__file__).parents[2]
every_task = pytest.mark.parametrize("task", TASKS)


@every_task
@pytest.mark.parametrize(
    ("algorithm", "policy"), [(PPO, "MultiInputPolicy"), (RecurrentPPO, "MultiInputLstmPolicy")]
)
def test_stable_baselines(task: str, algorithm: Any, policy: str) -> None:
    env = gym.make(task, **SMALL)
    agent = algorithm(policy, env, n_steps=16, batch_size=16, n_epochs=1, seed=0, device="cpu")
    assert agent.learn(32).num_timesteps == 32
    action, _ = agent.predict(env.reset(seed=0)[0])
    assert env.action_space.contains(np.int64(action))


@every_task
def test_a_loop_as_cleanrl_writes_it(task: str) -> None:
    """`ppo.py`: a vector environment in SAME_STEP mode, and statistics of its episodes."""
    envs = gym.make_vec(task, num_envs=4, autoreset_mode="SAME_STEP", **SMALL)
    envs = gym.wrappers.vector.RecordEpisodeStatistics(envs)
    envs.action_space.seed(1)
    envs.reset(seed=1)
    lengths: list[int] = []
    for _ in range(100 if "Video" in task else 20):
        _, rewards, terminated, truncated, info = envs.step(envs.action_space.sample())
        assert np.isfinite(rewards).all()
        done = terminated | truncated
        if done.any():
            assert set(np.flatnonzero(done)) == {i for i, o in enumerate(info["final_obs"]) if o}
            lengths += info["episode"]["l"][done].tolist()
    assert lengths
    limit = {"ae_env/AutoExposure-v0": 8, "ae_env/AutoExposureVideo-v0": 96}.get(task)
    assert set(lengths) == {limit} if limit else set(lengths) <= {1, 2, 3}


@every_task
def test_torchrl(task: str) -> None:
    """It makes environments itself too: tries arguments of its own, and expects a TypeError."""
    from torchrl.envs import GymEnv, GymWrapper, SerialEnv
    from torchrl.envs.utils import check_env_specs

    env = GymWrapper(gym.make(task, **SMALL))
    env.set_seed(0)
    check_env_specs(env)
    rollout = env.rollout(8)
    assert rollout["next", "reward"].isfinite().all()
    assert not rollout["next", "done"].flatten()[:-1].any()  # it ends with its last step
    envs = SerialEnv(2, lambda: GymEnv(task, frame_skip=2, **SMALL))
    assert envs.rollout(1)["next", "reward"].shape == (2, 1, 1)


@pytest.mark.slow
def test_the_recurrent_example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It trains, its weights come back, and a reset forgets the episode."""
    make_vec = gym.make_vec

    def with_few(task: str, **arguments: Any) -> gym.vector.VectorEnv:
        return make_vec(task, **{**arguments, **SMALL, "num_envs": 8})

    monkeypatch.setattr(gym, "make_vec", with_few)
    program, weights = ROOT / "examples" / "recurrent_ppo.py", tmp_path / "recurrent.safetensors"
    runpy.run_path(str(program))["train"](weights, frames=128)
    envs = gym.make_vec("ae_env/AutoExposureVideo-v0", split="test")
    context = PolicyContext.from_envs(envs)
    policy = make_policy(f"{program}:RecurrentAgent?weights={weights}", context)
    memories = []
    for _ in range(2):
        policy.reset(8)
        observations, _ = envs.reset(seed=0)
        for _ in range(3):
            observations, *_ = envs.step(policy.act(observations))
        memories.append(policy.memory)  # type: ignore[attr-defined]
    first, again = np.array(memories)
    np.testing.assert_array_equal(first, again)
    assert np.abs(first).max() > 0.0
