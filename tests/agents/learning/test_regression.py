"""The regression agent: its training, its resumption, and how it adds up its predictions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from agents.learning.regression import (
    RegressionPolicy,
    RegressionTraining,
    ScoreRegressor,
    train_regression,
)
from agents.learning.regression_training import Replay
from agents.policy import PolicyContext

TRAINING = RegressionTraining(frames=160, width=16, seed=5)


def test_training_lowers_the_loss(make_tiny_envs) -> None:
    losses = []
    train_regression(
        make_tiny_envs(num_envs=8),
        RegressionTraining(frames=480, width=32),
        progress=lambda done, total, values: losses.append((done, total, values["mse"])),
    )
    assert [done for done, _, _ in losses] == list(range(8, 481, 8))
    assert {total for _, total, _ in losses} == {480}
    begin, end = (np.mean([v for _, _, v in part]) for part in (losses[:10], losses[-20:]))
    assert end < 0.6 * begin


def test_same_seed_same_weights(make_tiny_envs) -> None:
    def train(seed: int) -> dict[str, torch.Tensor]:
        training = RegressionTraining(frames=80, width=16, seed=seed)
        return train_regression(make_tiny_envs(), training).state_dict()

    first, again, other = train(1), train(1), train(2)
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert any(not torch.equal(first[name], other[name]) for name in first)


def test_global_random_state_is_left_alone(make_tiny_envs) -> None:
    before = torch.random.get_rng_state()
    numpy_before = np.random.get_state()[1].copy()  # noqa: NPY002
    train_regression(make_tiny_envs(), RegressionTraining(frames=16, width=8))
    assert torch.equal(torch.random.get_rng_state(), before)
    assert np.array_equal(np.random.get_state()[1], numpy_before)  # noqa: NPY002


def test_a_killed_training_goes_on(make_tiny_envs, tmp_path) -> None:
    """Ctrl-C keeps the state, however short a time ago the last checkpoint was."""
    path = tmp_path / "regression.checkpoint"
    first: list[int] = []

    def stop(done: int, total: int, values: dict[str, float]) -> None:
        first.append(done)
        if done == 100:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_regression(make_tiny_envs(), TRAINING, checkpoint=path, progress=stop)
    assert path.exists()
    second: list[int] = []
    network = train_regression(
        make_tiny_envs(),
        TRAINING,
        checkpoint=path,
        progress=lambda done, total, values: second.append(done),
    )
    assert second == list(range(104, 161, 4))
    # The state that is kept is that of the network: a third call has nothing left to do.
    third: list[int] = []
    again = train_regression(
        make_tiny_envs(), TRAINING, checkpoint=path, progress=lambda *a: third.append(a[0])
    )
    assert third == []
    weights = again.state_dict()
    assert all(torch.equal(v, weights[name]) for name, v in network.state_dict().items())


class Stub(nn.Module):
    """Predicts what it is told, frame by frame."""

    def __init__(self, frames: list[tuple[np.ndarray, np.ndarray]]) -> None:
        super().__init__()
        self.anchor = nn.Parameter(torch.zeros(()))
        self.frames = list(frames)

    def forward(self, codes, settings, sensors):
        scores, log_variance = self.frames.pop(0)
        return torch.from_numpy(scores), torch.from_numpy(log_variance)


@pytest.fixture
def frame(photograph):
    return photograph(np.ones((64, 64)), 8.0, [0, 1])


def test_predictions_are_weighted_by_their_precision(context: PolicyContext, frame) -> None:
    rng = np.random.default_rng(0)
    scores = rng.random((3, 2, 64))
    variance = np.exp(rng.uniform(-6, 0, (3, 2, 64)))
    stub = Stub(list(zip(scores, np.log(variance), strict=True)))
    policy = RegressionPolicy(context, network=stub)
    policy.reset(2)
    for t in range(3):
        # The minimum-variance mean of independent estimates (inverse-variance weights).
        weights = 1.0 / variance[: t + 1]
        best = np.average(scores[: t + 1], axis=0, weights=weights)
        assert policy.act(frame).tolist() == best.argmax(axis=1).tolist()


def test_episodes_do_not_mix(context: PolicyContext, frame) -> None:
    low, high = np.full((2, 64), 0.1), np.full((2, 64), 0.1)
    low[:, 3], high[:, 9] = 0.9, 0.8
    sure = np.full((2, 64), -2.0)
    frames = [(low, sure), (high, sure), (high, sure)]
    policy = RegressionPolicy(context, network=Stub(frames))
    policy.reset(2)
    assert policy.act(frame).tolist() == [3, 3]
    policy.forget(np.array([False, True]))
    assert policy.act(frame).tolist() == [3, 9]  # 0.5 * (0.9 + 0.1) against 0.5 * (0.8 + 0.1)
    policy.reset(2)
    assert policy.act(frame).tolist() == [9, 9]


def test_frames_of_other_light_are_forgotten(context: PolicyContext, photograph) -> None:
    """The first camera's light falls by a stop, the second's stays."""
    first, second = np.full((2, 64), 0.1), np.full((2, 64), 0.1)
    first[:, 3], second[:, 9] = 0.9, 0.8
    sure = np.full((2, 64), -2.0)
    policy = RegressionPolicy(context, network=Stub([(first, sure), (second, sure)]))
    policy.reset(2)
    states = [20, 20]
    assert policy.act(photograph(np.ones((64, 64)), 8.0, states)).tolist() == [3, 3]
    darker, same = (photograph(np.full((64, 64), light), 8.0, [20]) for light in (0.5, 1.0))
    frames = {name: np.concatenate([darker[name], same[name]]) for name in same}
    assert policy.act(frames).tolist() == [9, 3]


def test_other_settings_in_the_same_light_are_remembered(context, photograph) -> None:
    known, other = np.full((1, 64), 0.1), np.full((1, 64), 0.1)
    known[:, 3], other[:, 9] = 0.9, 0.8
    sure = np.full((1, 64), -2.0)
    policy = RegressionPolicy(context, network=Stub([(known, sure), (other, sure)]))
    policy.reset(1)
    ev100 = context.grid.ev100
    near = [int(np.abs(ev100 - ev).argmin()) for ev in (8.0, 9.0)]  # neither clips
    for state in near:
        chosen = policy.act(photograph(np.ones((64, 64)), 8.0, [state]))
        assert chosen.tolist() == [3]


def test_masked_states_are_not_chosen(context: PolicyContext, frame) -> None:
    scores = np.tile(np.linspace(0, 1, 64), (2, 1))
    masks = np.ones((2, 64), bool)
    masks[0, 60:] = False
    masks[1] = False
    masks[1, 17] = True
    policy = RegressionPolicy(context, network=Stub([(scores, np.zeros((2, 64)))]))
    policy.reset(2)
    assert policy.act(frame, masks).tolist() == [59, 17]


def test_weights_or_network(context: PolicyContext) -> None:
    with pytest.raises(ValueError, match="either `weights` or `network`"):
        RegressionPolicy(context)


def test_network_predicts_scores(context: PolicyContext, photograph) -> None:
    network = ScoreRegressor(context.observation_space, context.grid, width=8).eval()
    policy = RegressionPolicy(context, network=network)
    policy.reset(3)
    frames = photograph(np.ones((64, 64)), 8.0, [0, 31, 63])
    actions = policy.act(frames)
    assert actions.shape == (3,)
    assert actions.dtype == np.int64
    with torch.inference_mode():
        scores, log_variance = network(
            torch.rand(2, 4, 64, 64), torch.zeros(2, 3), torch.zeros(2, 2)
        )
    assert scores.shape == log_variance.shape == (2, 64)
    assert ((scores > 0) & (scores < 1)).all()


@pytest.mark.parametrize("memory", [1, 4, 10])
def test_replay_memory_is_bounded(memory: int) -> None:
    replay = Replay(RegressionTraining(memory=memory), np.random.default_rng(0))
    for step in range(12):
        new = {"raw": np.full((4, 4, 2, 2), step, np.uint8), "settings": np.zeros((4, 3))}
        batch, target = replay.batch(new, np.full((4, 64), float(step)))
        assert (batch["raw"][:4] == step).all()
        assert (batch["raw"][:, 0, 0, 0] == target[:, 0]).all()  # frames keep their own scores
    assert len(replay.memory) == max(1, memory // 4)


@pytest.mark.parametrize(
    "wrong",
    [{"frames": 0}, {"learning_rate": -1.0}, {"explore": 1.5}, {"replay": -1}, {"dropout": 1.0}],
)
def test_bad_hyperparameters(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=rf"`{next(iter(wrong))}` \(=.*\) must be in \["):
        RegressionTraining(**wrong)


def test_checkpoint_of_another_training(make_tiny_envs, tmp_path: Path, caplog) -> None:
    path = tmp_path / "c"
    train_regression(make_tiny_envs(), RegressionTraining(frames=16, width=8), checkpoint=path)
    done: list[int] = []
    train_regression(
        make_tiny_envs(),
        RegressionTraining(frames=24, width=8),
        checkpoint=path,
        progress=lambda *a: done.append(a[0]),
    )
    assert done == [4, 8, 12, 16, 20, 24]
    assert "other settings" in caplog.text
