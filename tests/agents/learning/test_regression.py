import numpy as np
import pytest
import torch
from torch import nn

from agents.learning.regression import RegressionPolicy
from agents.policy import PolicyContext


class Stub(nn.Module):
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
        masks = rng.random((2, 64)) < 0.5
        masks[0, best[0].argmax()] = False  # even the best may be forbidden
        best = np.where(masks, best, -1.0)
        assert policy.act(frame, masks).tolist() == best.argmax(axis=1).tolist()


SURE = np.full((2, 64), -2.0)


def best_at(state: int, score: float) -> tuple[np.ndarray, np.ndarray]:
    """A prediction for two cameras, and its log variance."""
    scores = np.full((2, 64), 0.1)
    scores[:, state] = score
    return scores, SURE


def test_episodes_do_not_mix(context: PolicyContext, frame) -> None:
    frames = [best_at(3, 0.9), best_at(9, 0.8), best_at(9, 0.8)]
    policy = RegressionPolicy(context, network=Stub(frames))
    policy.reset(2)
    assert policy.act(frame).tolist() == [3, 3]
    policy.forget(np.array([False, True]))
    assert policy.act(frame).tolist() == [3, 9]  # 0.5 * (0.9 + 0.1) against 0.5 * (0.8 + 0.1)
    policy.reset(2)
    assert policy.act(frame).tolist() == [9, 9]


def test_frames_of_other_light_are_forgotten(context: PolicyContext, photograph) -> None:
    """The first camera's light falls by a stop; the second's stays, at other settings."""
    policy = RegressionPolicy(context, network=Stub([best_at(3, 0.9), best_at(9, 0.8)]))
    policy.reset(2)
    ev100 = context.grid.ev100
    near, far = (int(np.abs(ev100 - ev).argmin()) for ev in (8.0, 9.0))  # neither clips
    assert policy.act(photograph(np.ones((64, 64)), 8.0, [near, near])).tolist() == [3, 3]
    darker = photograph(np.full((64, 64), 0.5), 8.0, [near])
    same = photograph(np.ones((64, 64)), 8.0, [far])
    frames = {name: np.concatenate([darker[name], same[name]]) for name in same}
    assert policy.act(frames).tolist() == [9, 3]
