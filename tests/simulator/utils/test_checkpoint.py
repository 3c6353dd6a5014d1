import errno
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from safetensors.torch import save

from simulator.utils import checkpoint
from simulator.utils.checkpoint import Checkpoint


def store(path: Path | None, identity: Any = "a", **values: Any) -> Checkpoint:
    return Checkpoint(path, identity, lambda: {"step": 7, **values})


def test_it_saves_when_it_is_due_and_at_the_end(tmp_path, monkeypatch):
    path, now = tmp_path / "run", 100.0
    monkeypatch.setattr("time.monotonic", lambda: now)
    own = store(path)
    for seconds, due in ((checkpoint.INTERVAL, False), (1.0, True), (0.0, False)):
        now += seconds
        own.save_when_due()
        assert path.exists() == due
        path.unlink(missing_ok=True)
    with own:  # at the end
        assert not path.exists()
    assert path.exists()
    path.unlink()
    with store(None) as nowhere, Checkpoint(path, "a", dict, writes=False) as silent:
        assert nowhere.load() is silent.load() is None
    assert not path.exists()


def test_a_full_disk_stops_no_training(tmp_path, monkeypatch, caplog):
    path = tmp_path / "run"
    store(path, step=1).save()
    error = OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr("simulator.utils.files.os.replace", Mock(side_effect=error))
    store(path, step=2).save()
    assert "not saved" in caplog.text
    assert [p.name for p in tmp_path.iterdir()] == ["run"]
    assert store(path).load() == {"step": 1}


@pytest.mark.parametrize(
    ("error", "kept"), [(KeyboardInterrupt, True), (SystemExit, True), (ValueError, False)]
)
def test_what_ends_a_training_decides_whether_its_state_is_kept(error, kept, tmp_path):
    with pytest.raises(error), store(tmp_path / "run"):
        raise error
    assert (tmp_path / "run").exists() == kept


class Harm:
    """Would run code on unpickling."""

    def __reduce__(self) -> Any:
        return Path.touch, (Path("harmed"),)


def test_damaged_or_foreign(tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "run"
    store(path, weight=torch.ones(1000)).save()
    good, files = path.read_bytes(), []
    middle = len(good) // 2  # the weights are by far the largest part
    flipped = good[:middle] + bytes([good[middle] ^ 1]) + good[middle + 1 :]
    for content in ([1, 2], {"identity": Harm()}):
        torch.save(content, path)
        files.append(path.read_bytes())
    foreign = save({"weight": torch.zeros(2)})
    for damaged in (good[:-50], b"not a checkpoint at all", b"", foreign, flipped, *files):
        path.write_bytes(damaged)
        caplog.clear()
        assert store(path).load() is None
        assert f"{path} is damaged, training restarts" in caplog.text
    assert not (tmp_path / "harmed").exists()


def test_another_training_or_version(tmp_path, monkeypatch, caplog):
    path = tmp_path / "run"
    store(path, {"seed": 0}).save()
    assert store(path, {"seed": 0}).load() == {"step": 7}
    assert store(path, {"seed": 1}).load() is None
    monkeypatch.setattr(checkpoint, "package_version", lambda: "77")
    assert store(path, {"seed": 0}).load() is None
    assert caplog.text.count("training restarts") == 2
