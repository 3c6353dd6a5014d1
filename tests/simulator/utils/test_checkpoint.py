"""Training states: resumed where they fit, and a warning where they do not."""

from __future__ import annotations

import errno
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from simulator.utils import checkpoint
from simulator.utils.checkpoint import Checkpoint, load_checkpoint, save_checkpoint


def store(path: Path | None, identity: Any = "a", **values: Any) -> Checkpoint:
    return Checkpoint(path, identity, lambda: {"step": 7, **values})


def test_a_training_goes_on_as_if_it_had_not_stopped(tmp_path: Path) -> None:
    """AdamW and a one-cycle schedule on fixed data: their states come back complete."""
    generator = torch.Generator().manual_seed(3)
    inputs = torch.randn(40, 16, 5, generator=generator)

    class Run:
        def __init__(self) -> None:
            with torch.random.fork_rng():
                torch.manual_seed(1)
                self.module = nn.Linear(5, 1)
            self.optimizer = torch.optim.AdamW(self.module.parameters(), lr=1e-2)
            self.schedule = torch.optim.lr_scheduler.OneCycleLR(self.optimizer, 1e-2, 41)
            self.store = Checkpoint(
                tmp_path / "run",
                {"width": (5, 1)},
                lambda: {name: part.state_dict() for name, part in self.parts().items()},
            )

        def parts(self) -> dict[str, Any]:
            return {name: getattr(self, name) for name in ("module", "optimizer", "schedule")}

        def steps(self, first: int, last: int) -> list[float]:
            losses = []
            for step in range(first, last):
                loss = (self.module(inputs[step]) - 1.0).square().mean()
                self.optimizer.zero_grad()
                loss.backward()
                self.optimizer.step()
                self.schedule.step()
                losses.append(loss.item())
            return losses

    expected, first, second = Run().steps(0, 40), Run(), Run()
    losses = first.steps(0, 17)
    first.store.save()
    state = second.store.load()
    assert state is not None
    for name, part in second.parts().items():
        part.load_state_dict(state[name])
    assert losses + second.steps(17, 40) == expected


def test_it_saves_when_it_is_due_and_at_the_end(tmp_path: Path, monkeypatch: Any) -> None:
    path = tmp_path / "run"
    now = 100.0
    monkeypatch.setattr("time.monotonic", lambda: now)
    own = store(path)
    now += checkpoint.INTERVAL
    own.save_when_due()
    assert not path.exists()
    now += 1.0
    own.save_when_due()
    assert path.exists()
    path.unlink()
    own.save_when_due()
    assert not path.exists()
    with own:
        pass
    assert path.exists()
    path.unlink()
    with store(None) as nowhere, Checkpoint(path, "a", dict, writes=False) as silent:
        assert nowhere.load() is silent.load() is None
    assert not path.exists()


def test_a_full_disk_stops_no_training(tmp_path: Path, monkeypatch: Any, caplog: Any) -> None:
    path = tmp_path / "run"
    save_checkpoint(path, {"step": 1})

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("simulator.utils.files.os.replace", full)
    save_checkpoint(path, {"step": 2})
    assert "not saved" in caplog.text
    assert [p.name for p in tmp_path.iterdir()] == ["run"]
    assert load_checkpoint(path) == {"step": 1}


@pytest.mark.parametrize(
    ("error", "kept"), [(KeyboardInterrupt, True), (SystemExit, True), (ValueError, False)]
)
def test_what_ends_a_training_decides_whether_its_state_is_kept(
    error: type[BaseException], kept: bool, tmp_path: Path
) -> None:
    with pytest.raises(error), store(tmp_path / "run"):
        raise error
    assert (tmp_path / "run").exists() == kept


def flip_a_byte(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1  # the weights are by far the largest part
    path.write_bytes(content)


class Harm:
    """Would run code on unpickling."""

    def __reduce__(self) -> Any:
        return Path.touch, (Path("harmed"),)


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.write_bytes(path.read_bytes()[:-50]),
        lambda path: path.write_text("not a checkpoint at all"),
        lambda path: path.write_bytes(b""),
        lambda path: save_file({"weight": torch.zeros(2)}, path),
        lambda path: torch.save([1, 2], path),
        lambda path: torch.save({"identity": Harm()}, path),
        flip_a_byte,
    ],
)
def test_damaged_or_foreign(
    damage: Callable[[Path], object], tmp_path: Path, monkeypatch: Any, caplog: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "run"
    store(path, weight=torch.ones(1000)).save()
    damage(path)
    assert store(path).load() is None
    assert f"{path} is damaged, training restarts" in caplog.text
    assert not (tmp_path / "harmed").exists()


def test_another_training_or_version(tmp_path: Path, monkeypatch: Any, caplog: Any) -> None:
    path = tmp_path / "run"
    store(path, {"seed": 0}).save()
    assert store(path, {"seed": 0}).load() == {"step": 7}
    assert store(path, {"seed": 1}).load() is None
    monkeypatch.setattr(checkpoint, "package_version", lambda: "77")
    assert store(path, {"seed": 0}).load() is None
    assert caplog.text.count("other settings or of another version, training restarts") == 2
