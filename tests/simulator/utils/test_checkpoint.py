"""Training states: restored exactly, or begun anew with a warning."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from simulator.utils.checkpoint import Checkpoint


class Run:
    """A module with AdamW and a one-cycle schedule, on fixed data."""

    def __init__(self, path: Path | None, *, hidden: int = 8, identity: object = "a") -> None:
        generator = torch.Generator().manual_seed(3)
        self.inputs = torch.randn(40, 16, 5, generator=generator)
        self.module = nn.Sequential(nn.Linear(5, hidden), nn.Tanh(), nn.Linear(hidden, 1))
        with torch.no_grad():
            for parameter in self.module.parameters():
                parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.3)
        self.optimiser = torch.optim.AdamW(self.module.parameters(), lr=1e-2, weight_decay=1e-2)
        self.schedule = torch.optim.lr_scheduler.OneCycleLR(
            self.optimiser, max_lr=1e-2, total_steps=41, pct_start=0.3
        )
        parts = {"module": self.module, "optimiser": self.optimiser, "schedule": self.schedule}
        self.store = Checkpoint(path, parts, identity=identity)

    def steps(self, first: int, last: int) -> list[float]:
        losses = []
        for step in range(first, last):
            loss = (self.module(self.inputs[step]) - 1.0).square().mean()
            self.optimiser.zero_grad()
            loss.backward()
            self.optimiser.step()
            self.schedule.step()
            losses.append(loss.item())
        return losses

    def weights(self) -> list[torch.Tensor]:
        return [p.detach().clone() for p in self.module.parameters()]


def test_training_goes_on_exactly(tmp_path: Path) -> None:
    whole = Run(None)
    expected = whole.steps(0, 40)
    path = tmp_path / "run.checkpoint"
    first = Run(path)
    losses = first.steps(0, 17)
    first.store.save(17, force=True)
    second = Run(path)
    assert second.store.restore() == 17
    assert second.schedule.last_epoch == 17
    assert second.optimiser.param_groups[0]["lr"] == first.optimiser.param_groups[0]["lr"]
    losses += second.steps(17, 40)
    assert losses == expected
    assert all(torch.equal(a, b) for a, b in zip(second.weights(), whole.weights(), strict=True))


def test_nothing_to_restore(tmp_path: Path) -> None:
    assert Run(tmp_path / "none").store.restore() == 0
    run = Run(None)
    run.store.save(3, force=True)
    assert run.store.restore() == 0


def test_saves_now_and_then(tmp_path: Path) -> None:
    path = tmp_path / "run"
    run = Run(path)
    run.store.save(1)
    assert not path.exists()
    run.store.interval = 0.0
    run.store.save(2)
    assert path.exists()


def damage_cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-50])


def damage_text(path: Path) -> None:
    path.write_text("not a checkpoint at all")


def damage_empty(path: Path) -> None:
    path.write_bytes(b"")


def damage_foreign(path: Path) -> None:
    save_file({"weight": torch.zeros(2)}, path)


def damage_structure(path: Path) -> None:
    save_file({"t0": torch.zeros(2)}, path, metadata={"structure": '{"step": 4, "parts": []}'})


def damage_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


@pytest.mark.parametrize(
    "damage",
    [damage_cut, damage_text, damage_empty, damage_foreign, damage_structure, damage_folder],
)
def test_damaged_or_foreign(tmp_path: Path, damage, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "run.checkpoint"
    first = Run(path)
    first.steps(0, 5)
    first.store.save(5, force=True)
    damage(path)
    second = Run(path)
    before = second.weights()
    with caplog.at_level(logging.WARNING):
        assert second.store.restore() == 0
    assert "training begins anew" in caplog.text
    assert str(path) in caplog.text
    assert all(torch.equal(a, b) for a, b in zip(second.weights(), before, strict=True))
    assert second.steps(0, 3) == Run(None).steps(0, 3)


def test_another_network_leaves_no_trace(tmp_path: Path, caplog) -> None:
    path = tmp_path / "run"
    wide = Run(path, hidden=9)
    wide.steps(0, 5)
    wide.store.save(5, force=True)
    with caplog.at_level(logging.WARNING):
        run = Run(path)
        assert run.store.restore() == 0
    assert "size mismatch" in caplog.text
    assert run.steps(0, 3) == Run(None).steps(0, 3)


def test_one_of_an_earlier_version_says_what_it_lacks(tmp_path: Path, caplog) -> None:
    path = tmp_path / "run"
    run = Run(path)
    Checkpoint(path, {"module": run.module}, identity="a").save(5, force=True)
    with caplog.at_level(logging.WARNING):
        assert run.store.restore() == 0
    assert "it lacks 'optimiser', 'schedule', as those of an earlier version do" in caplog.text


def test_another_training_is_not_resumed(tmp_path: Path, caplog) -> None:
    path = tmp_path / "run"
    one = Run(path, identity={"seed": 0, "rate": (1, 2)})
    one.steps(0, 5)
    one.store.save(5, force=True)
    assert Run(path, identity={"seed": 0, "rate": (1, 2)}).store.restore() == 5
    with caplog.at_level(logging.WARNING):
        assert Run(path, identity={"seed": 1, "rate": (1, 2)}).store.restore() == 0
    assert "other settings" in caplog.text
