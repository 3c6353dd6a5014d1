"""Training of the regression agent: it learns, is reproducible, and goes on after Ctrl-C."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from agents.learning.regression_training import RegressionTraining, Replay, train_regression

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


def test_a_stopped_training_goes_on(make_tiny_envs, tmp_path: Path) -> None:
    """Ctrl-C keeps the state, however short a time ago the last checkpoint was."""
    path = tmp_path / "regression.checkpoint"

    def stop(done: int, total: int, values: dict[str, float]) -> None:
        if done == 100:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_regression(make_tiny_envs(), TRAINING, checkpoint=path, progress=stop)
    half = torch.load(path, weights_only=True)["state"]
    assert half["step"] == 25
    seen: list[int] = []
    network = train_regression(
        make_tiny_envs(), TRAINING, checkpoint=path, progress=lambda *a: seen.append(a[0])
    )
    assert seen == list(range(104, 161, 4))
    end = torch.load(path, weights_only=True)["state"]
    assert end["schedule"]["last_epoch"] == end["step"] == 40
    assert all(float(s["step"]) == 40 for s in end["optimizer"]["state"].values())
    # The state on disk is that of the network: a third call has nothing left to do.
    again = train_regression(
        make_tiny_envs(), TRAINING, checkpoint=path, progress=lambda *_: pytest.fail("trains")
    ).state_dict()
    assert all(torch.equal(v, again[name]) for name, v in network.state_dict().items())


def test_an_error_leaves_no_checkpoint_of_it(make_tiny_envs, tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "c"
    monkeypatch.setattr("simulator.utils.checkpoint.INTERVAL", -1.0)
    training = RegressionTraining(frames=160, width=8, seed=5, learning_rate=1.0)

    def poison(done: int, total: int, values: dict[str, float]) -> None:
        if done == 16:
            raise ValueError("anything")

    with pytest.raises(ValueError, match="anything"):
        train_regression(make_tiny_envs(), training, checkpoint=path, progress=poison)
    assert torch.load(path, weights_only=True)["state"]["step"] == 3


@pytest.mark.parametrize("memory", [1, 4, 10])
def test_replay_memory_is_bounded(memory: int) -> None:
    replay = Replay(RegressionTraining(memory=memory), np.random.default_rng(0))
    for step in range(12):
        new = {"raw": np.full((4, 4, 2, 2), step, np.uint8), "settings": np.zeros((4, 3))}
        batch, target = replay.batch(new, np.full((4, 64), float(step)))
        assert (batch["raw"][:4] == step).all()
        assert (batch["raw"][:, 0, 0, 0] == target[:, 0]).all()  # frames keep their own scores
    assert len(replay.memory) == max(1, memory // 4)
