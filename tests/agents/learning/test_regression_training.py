from pathlib import Path

import numpy as np
import pytest
import torch

from agents.learning.regression import RegressionTraining, Replay, train_regression

TRAINING = RegressionTraining(frames=160, width=16, seed=5)


def test_training_lowers_the_loss(make_tiny_envs) -> None:
    losses = []
    train_regression(
        make_tiny_envs(num_envs=8),
        RegressionTraining(frames=480, width=32),
        progress=lambda done, total, values: losses.append((done, total, values["mse"])),
    )
    assert [(done, total) for done, total, _ in losses] == [(n, 480) for n in range(8, 481, 8)]
    begin, end = (np.mean([v for _, _, v in part]) for part in (losses[:10], losses[-20:]))
    assert end < 0.6 * begin


def test_same_seed_same_weights_whatever_the_global_state(make_tiny_envs) -> None:
    def train(seed: int) -> dict[str, torch.Tensor]:
        training = RegressionTraining(frames=40, width=16, seed=seed)
        return train_regression(make_tiny_envs(), training).state_dict()

    first = train(1)
    torch.rand(3), np.random.rand(3)  # noqa: NPY002
    before = torch.random.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    again = train(1)
    after = torch.random.get_rng_state(), np.random.get_state()[1]  # noqa: NPY002
    assert all(np.array_equal(*pair) for pair in zip(before, after, strict=True))
    assert all(torch.equal(first[name], again[name]) for name in first)
    other = train(2)
    assert any(not torch.equal(first[name], other[name]) for name in first)


def test_a_stopped_training_goes_on(make_tiny_envs, tmp_path: Path) -> None:
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
    assert all(torch.equal(v, end["network"][name]) for name, v in network.state_dict().items())


@pytest.mark.parametrize("memory", [1, 4, 10])
def test_replay_memory_is_bounded(memory: int) -> None:
    replay = Replay(RegressionTraining(memory=memory), np.random.default_rng(0))
    for step in range(12):
        new = {"raw": np.full((4, 4, 2, 2), step, np.uint8), "settings": np.zeros((4, 3))}
        batch, target = replay.batch(new, np.full((4, 64), float(step)))
        assert (batch["raw"][:4] == step).all()
        assert (batch["raw"][:, 0, 0, 0] == target[:, 0]).all()  # frames keep their own scores
    assert len(replay.memory) == max(1, memory // 4)
