"""Checkpoints: the state that was saved, or none with a warning; nothing in a file is run."""

from __future__ import annotations

import errno
import logging
import os
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from simulator.utils.checkpoint import load_checkpoint, save_checkpoint


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "runs" / "a.checkpoint"


def test_states_come_back(path: Path) -> None:
    module = nn.Linear(3, 2)
    optimiser = torch.optim.AdamW(module.parameters(), lr=0.5)
    module(torch.ones(3)).sum().backward()
    optimiser.step()
    parts = {"module": module.state_dict(), "optimiser": optimiser.state_dict()}
    save_checkpoint(path, {"step": 7, "identity": ["a", None, {"seed": 0}], **parts})
    found = load_checkpoint(path)
    assert found is not None
    assert (found["step"], found["identity"]) == (7, ["a", None, {"seed": 0}])
    other = nn.Linear(3, 2)
    other.load_state_dict(found["module"])
    assert torch.equal(other.weight, module.weight)
    fresh = torch.optim.AdamW(other.parameters())
    fresh.load_state_dict(found["optimiser"])
    moments, expected = (o.state_dict()["state"][0]["exp_avg"] for o in (fresh, optimiser))
    assert torch.equal(moments, expected)
    assert fresh.param_groups[0]["lr"] == 0.5


def test_no_file_is_no_state(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert load_checkpoint(path) is None
    assert not caplog.records


@pytest.mark.parametrize("damage", ["cut", "empty", "text", "byte", "no dict"])
def test_damaged_files_are_no_state(
    path: Path, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    save_checkpoint(path, {"weights": torch.arange(1000.0)})
    content = bytearray(path.read_bytes())
    content[content.index(torch.arange(8.0, 9.0).numpy().tobytes())] ^= 1
    damaged = {"cut": content[:-50], "empty": b"", "text": b"not a checkpoint", "byte": content}
    if damage == "no dict":
        torch.save([1], path)
    else:
        path.write_bytes(damaged[damage])
    with caplog.at_level(logging.WARNING):
        assert load_checkpoint(path) is None
    assert f"checkpoint {path} is damaged, training restarts" in caplog.text


class Harmful:
    """Makes a folder when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, ("ran",)


def test_nothing_in_a_checkpoint_is_run(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    save_checkpoint(path, {"step": Harmful()})
    assert load_checkpoint(path) is None
    assert not (tmp_path / "ran").exists()


def test_a_full_disk_keeps_the_one_before(
    path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    save_checkpoint(path, {"step": 1})

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", full)
        save_checkpoint(path, {"step": 2})
    assert "checkpoint not saved, the one before stays" in caplog.text
    assert "No space left" in caplog.text
    assert [p.name for p in path.parent.iterdir()] == ["a.checkpoint"]
    assert load_checkpoint(path) == {"step": 1}
