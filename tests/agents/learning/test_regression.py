"""The regression agent: how it adds up its predictions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from agents.learning.regression import RegressionPolicy, ScoreRegressor
from agents.policy import PolicyContext


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


def test_network_predicts_scores(context: PolicyContext, photograph) -> None:
    network = ScoreRegressor(context.observation_space, context.grid, width=8).eval()
    policy = RegressionPolicy(context, network=network)
    policy.reset(3)
    frames = photograph(np.ones((64, 64)), 8.0, [0, 31, 63])
    actions = policy.act(frames)
    assert actions.shape == (3,)
    assert actions.dtype == np.int64
