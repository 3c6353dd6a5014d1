from pathlib import Path

import numpy as np
import pytest
import torch

from agents.learning.networks import Session
from agents.learning.ppo import PPOPolicy, PPOTraining, train_ppo
from agents.learning.weights import describe_agent, save_agent
from agents.policy import PolicyContext
from agents.policy_names import make_policy

TRAINING = PPOTraining(total_timesteps=96, n_steps=4, batch_size=8, n_epochs=2, width=16, seed=3)


def test_progress_and_determinism(make_tiny_envs) -> None:
    seen: list[tuple[int, int, dict[str, float]]] = []

    def train(seed: int) -> dict[str, torch.Tensor]:
        training = TRAINING.model_copy(update={"seed": seed, "total_timesteps": 32})
        return train_ppo(
            make_tiny_envs(), training, Session(progress=lambda *a: seen.append(a))
        ).state_dict()

    first, again, other = train(3), train(3), train(4)
    assert [(done, total) for done, total, _ in seen] == [(n, 32) for n in range(4, 33, 4)] * 3
    assert all(0.0 <= values["reward"] <= 1.0 for _, _, values in seen)
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert any(not torch.equal(first[name], other[name]) for name in first)


@pytest.mark.slow
def test_it_learns(make_tiny_envs) -> None:
    rewards: list[float] = []
    training = PPOTraining(
        total_timesteps=2048, n_steps=8, batch_size=64, n_epochs=4, width=32, learning_rate=3e-3
    )
    # Always sharp: short times and small apertures gain nothing, low ISO does.
    envs = make_tiny_envs(num_envs=16, motion="none", depth="far")
    train_ppo(
        envs, training, Session(progress=lambda d, t, values: rewards.append(values["reward"]))
    )
    assert rewards[-1] > rewards[15] + 0.1


def test_saved_weights_act_identically(make_tiny_envs, tmp_path: Path) -> None:
    envs = make_tiny_envs(num_envs=6)
    context = PolicyContext.from_envs(envs)
    training = TRAINING.model_copy(update={"total_timesteps": 24, "batch_size": 12})
    network = train_ppo(envs, training)
    save_agent(tmp_path / "ppo", "ppo", network, describe_agent(network.width, context, {}))
    loaded = make_policy(f"ppo:{tmp_path / 'ppo'}", context)
    assert isinstance(loaded, PPOPolicy)
    ours = PPOPolicy(context, network=network)
    # The three extractors of SB3's policy are one again.
    extractor = loaded.network.features_extractor
    assert loaded.network.pi_features_extractor is extractor
    rng = np.random.default_rng(0)
    observations, _ = envs.reset(seed=9)
    for policy in (ours, loaded):
        policy.reset(6)
    for _ in range(5):
        chosen = ours.act(observations)
        assert chosen.dtype == np.int64
        assert np.array_equal(chosen, loaded.act(observations))
        # SB3's own deterministic prediction is the same.
        assert np.array_equal(chosen, network.predict(observations, deterministic=True)[0])
        masks = rng.random((6, 64)) < 0.3
        masks[:, 5] = True
        allowed = loaded.act(observations, masks)
        assert masks[np.arange(6), allowed].all()
        observations, *_ = envs.step(chosen)


def test_a_stopped_training_goes_on(make_tiny_envs, tmp_path: Path) -> None:
    path = tmp_path / "ppo.checkpoint"

    def stop(done: int, total: int, values: dict[str, float]) -> None:
        if done == 56:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_ppo(make_tiny_envs(), TRAINING, Session(checkpoint=path, progress=stop))
    half = torch.load(path, weights_only=True)["state"]
    assert half["timesteps"] == 48  # the last complete update of 4 x 4 frames before frame 56
    seen: list[int] = []
    network = train_ppo(
        make_tiny_envs(), TRAINING, Session(checkpoint=path, progress=lambda *a: seen.append(a[0]))
    )
    assert seen == list(range(52, 97, 4))
    # The learning rate falls over the whole training, it does not start at its top again.
    optimizer = network.optimizer
    assert optimizer.param_groups[0]["lr"] < 0.3 * TRAINING.learning_rate
    # 6 updates of 2 epochs of 2 batches: Adam goes on counting, so its moments were restored.
    assert {float(s["step"]) for s in optimizer.state_dict()["state"].values()} == {24.0}
    end, weights = torch.load(path, weights_only=True)["state"], network.state_dict()
    assert all(torch.equal(end["policy"][k], v) for k, v in weights.items())
    assert any(not torch.equal(half["policy"][k], v) for k, v in weights.items())


def test_it_learns_from_statistics_and_says_so(make_tiny_envs, tmp_path: Path) -> None:
    envs = make_tiny_envs(num_envs=6, observation="statistics")
    context = PolicyContext.from_envs(envs)
    training = TRAINING.model_copy(update={"total_timesteps": 24, "batch_size": 12})
    network = train_ppo(envs, training)
    save_agent(tmp_path / "ppo", "ppo", network, describe_agent(network.width, context, {}))
    policy = make_policy(f"ppo:{tmp_path / 'ppo'}", context)
    policy.reset(6)
    observations, _ = envs.reset(seed=9)
    assert envs.action_space.contains(policy.act(observations))
    with pytest.raises(ValueError, match=r"resolution = \[4, 12, 16\]"):
        make_policy(f"ppo:{tmp_path / 'ppo'}", PolicyContext.from_envs(make_tiny_envs()))
