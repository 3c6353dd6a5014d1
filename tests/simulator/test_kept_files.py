"""Files that several processes write and read at once, or that cannot be read or written at all."""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import multiprocessing
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import nn

from agents.learning.agent_weights import load_agent, save_agent
from benchmarks.keeping import Kept
from simulator.networks.network_cache import NetworkCache
from simulator.networks.weights import build_modules, load_modules, save_modules
from simulator.utils import files
from simulator.utils.cache import CACHE_KINDS, DiskCache, cache_dir, cache_key
from simulator.utils.results import write_results

KEY = cache_key({"a": 1})
#: Seconds that processes work against each other.
_SECONDS = 1.5


def filled(module: nn.Module, value: float) -> nn.Module:
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.fill_(value)
    return module


# -- weights and caches under several processes ---------------------------------------------------


def _write(folder: Path, value: float, started: Any) -> None:
    """Writes files whose every number is `value`, again and again."""
    torch.set_num_threads(1)
    disk, agent = DiskCache(folder), filled(nn.Linear(30, 20), value)
    modules = filled(build_modules("compact"), value)
    training = {"training": {"value": value}}
    started.wait()
    end = time.monotonic() + _SECONDS
    while time.monotonic() < end:
        disk.put("denoised", KEY, {"result": torch.full((5000,), value)})
        save_agent(folder / "agent", "ppo", agent, {"width": 8, "context": {}, **training})
        save_modules(folder / "simulator", modules, "compact", training)


def _read(what: str, folder: Path) -> tuple[float, set[float]] | None:
    """What the card says, and all numbers there are; None where the reader got nothing."""
    if what == "cache":
        found = DiskCache(folder).get("denoised", KEY)
        return None if found is None else (found["result"][0].item(), set(found["result"].tolist()))
    try:
        if what == "agent":
            tensors, card = load_agent(folder / "agent", "ppo")
        else:
            loaded, card = load_modules(folder / "simulator")
            tensors = dict(loaded.named_parameters())
    except FileNotFoundError:
        return None
    except ValueError as error:
        assert "being written at this moment" in str(error) or "there is no" in str(error)  # noqa: PT017
        return None
    values = {v for tensor in tensors.values() for v in tensor.flatten()[[0, -1]].tolist()}
    return card["training"]["value"], values


def test_two_write_and_one_reads(tmp_path: Path, caplog: Any) -> None:
    """A reader gets the files of one writer, or is told so: never a part of one and of another."""
    context = multiprocessing.get_context("spawn")
    started = context.Barrier(3)
    writers = [context.Process(target=_write, args=(tmp_path, v, started)) for v in (0.25, 0.5)]
    for writer in writers:
        writer.start()
    started.wait(120)
    seen = set()
    with caplog.at_level(logging.WARNING):
        while any(writer.is_alive() for writer in writers):
            for what in ("cache", "agent", "simulator"):
                found = _read(what, tmp_path)
                if found is not None:
                    assert found[1] == {found[0]}
                    seen.add(what)
    for writer in writers:
        writer.join()
        assert writer.exitcode == 0
    assert seen == {"cache", "agent", "simulator"}  # it did read while they wrote
    assert not caplog.records  # and nothing was taken for damaged
    assert not list(tmp_path.rglob("*.tmp"))


def test_new_weights_beside_the_card_of_an_earlier_version(tmp_path: Path, monkeypatch) -> None:
    """A writer that is killed between its two files leaves no pair of two trainings."""
    description = {"width": 8, "context": {}, "training": {}}
    save_agent(tmp_path / "net", "ppo", nn.Linear(2, 2), description)
    card = json.loads((tmp_path / "net.json").read_text())
    del card["sha256"]  # as earlier versions wrote it
    (tmp_path / "net.json").write_text(json.dumps(card))
    load_agent(tmp_path / "net", "ppo")
    real, written = files.write_atomically, []

    def killed(path: Path, content: Any) -> Path:
        if written:
            raise KeyboardInterrupt
        written.append(path)
        return real(path, content)

    monkeypatch.setattr("simulator.networks.weights.write_atomically", killed)
    with pytest.raises(KeyboardInterrupt):
        save_agent(tmp_path / "net", "ppo", nn.Linear(2, 2), description)
    with pytest.raises(ValueError, match=r"the hash of net.safetensors .* of another training"):
        load_agent(tmp_path / "net", "ppo")


@pytest.mark.parametrize("load", [lambda p: load_agent(p, "ppo"), load_modules])
def test_weights_that_may_not_be_read(load: Callable, tmp_path: Path, monkeypatch) -> None:
    save_modules(tmp_path / "net", build_modules("compact"), "compact", {})

    def denied(self: Path) -> bytes:
        raise PermissionError(errno.EACCES, "Permission denied", str(self))

    monkeypatch.setattr(Path, "read_bytes", denied)
    with pytest.raises(ValueError, match=r"net'\) cannot be read: .*net.safetensors"):
        load(tmp_path / "net")


# -- caches that are no good ----------------------------------------------------------------------


def _no_digest(path: Path) -> None:
    save_file({"result": torch.zeros(3)}, path)


def _other_digest(path: Path) -> None:
    save_file({"result": torch.zeros(3)}, path, {"digest": "3", "key": path.stem})


def _another_file(path: Path) -> None:
    disk = DiskCache(path.parents[1])
    disk.put("opened", "0" * 24, {"result": torch.zeros(3)})
    disk.path("opened", "0" * 24).rename(path)


def _other_tensors(path: Path) -> None:
    DiskCache(path.parents[1]).put(path.parent.name, path.stem, {"else": torch.zeros(3)})


@pytest.mark.parametrize("spoil", [_no_digest, _other_digest, _another_file, _other_tensors])
def test_foreign_files_change_no_result(
    spoil: Callable[[Path], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whole files that are not what was asked for: no result, and the right one is made anew."""
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path))
    module = filled(nn.Conv2d(1, 1, 1), 0.5)
    light = torch.full((1, 1, 4, 4), 0.5)
    expected = NetworkCache("disk").called("denoised", module, light)
    assert expected.flatten()[0] == 0.75
    (path,) = (tmp_path / "denoised").iterdir()
    path.unlink()
    spoil(path)
    for _ in range(2):  # made again, then read
        assert torch.equal(NetworkCache("disk").called("denoised", module, light), expected)
    with safe_open(path, framework="pt") as file:
        assert list(file.keys()) == ["result"]
        assert file.metadata()["key"] == path.stem


LONG = "x" * 300


@pytest.mark.parametrize("place", ["file", f"{LONG}/deep", "loop"])
def test_a_folder_that_is_none_costs_one_warning(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: Any
) -> None:
    (tmp_path / "file").write_text("in the way")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path / place))
    module, lights = nn.Conv2d(1, 1, 1), [torch.full((1, 1, 4, 4), v) for v in (0.1, 0.2)]
    with caplog.at_level(logging.WARNING):
        for light in lights:  # every environment has a cache of its own
            result = NetworkCache("disk").called("denoised", module, light)
            assert torch.equal(result, module(light))
    assert len(caplog.records) == 1
    assert DiskCache().usage() == dict.fromkeys(CACHE_KINDS, (0, 0))
    DiskCache().clear()


def test_a_folder_that_may_not_be_read_costs_one_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: Any
) -> None:
    disk = DiskCache(tmp_path)
    disk.put("denoised", KEY, {"x": torch.zeros(1)})

    def denied(*_: object) -> Any:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "read_bytes", denied)
    monkeypatch.setattr("simulator.utils.cache.os.listdir", denied)
    with caplog.at_level(logging.WARNING):
        assert [DiskCache(tmp_path).get("denoised", KEY) for _ in range(3)] == [None] * 3
        DiskCache(tmp_path).put("opened", KEY, {"x": torch.zeros(1)})  # counts the files
    assert len(caplog.records) == 1
    assert "cannot be read" in caplog.text


def test_the_home_of_nobody(monkeypatch: pytest.MonkeyPatch, caplog: Any) -> None:
    monkeypatch.delenv("AE_ENV_CACHE")
    own = cache_dir()
    monkeypatch.setenv("AE_ENV_CACHE", "~no-such-user/cache")
    with caplog.at_level(logging.WARNING):
        assert [cache_dir(), cache_dir()] == [own, own]
    assert len(caplog.records) == 1
    assert "AE_ENV_CACHE (='~no-such-user/cache')" in caplog.text


# -- results ---------------------------------------------------------------------------------------


def test_results_are_those_of_before_or_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that fills up while a result is written leaves the one before, and nothing else."""
    path = write_results(tmp_path / "a.json", [{"x": 1}], {"seed": 0})
    before = hashlib.sha256(path.read_bytes()).hexdigest()

    class Full:
        def __enter__(self) -> Full:
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def writelines(self, pieces: Any) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("simulator.utils.files.os.fdopen", lambda *_: Full())
    with pytest.raises(OSError, match="No space left"):
        write_results(path, [{"x": 2}], {"seed": 0})
    assert hashlib.sha256(path.read_bytes()).hexdigest() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_damaged_parts_of_a_stopped_run_are_measured_again(tmp_path: Path) -> None:
    kept = Kept(tmp_path, 0, code=())
    assert kept("part", lambda: [1, 2]) == [1, 2]
    assert kept("part", lambda: [3]) == [1, 2]
    (path,) = tmp_path.iterdir()
    path.write_text("[1, 2")
    assert kept("part", lambda: [3]) == [3]
    assert json.loads(path.read_text()) == [3]
    kept.forget()
    assert list(tmp_path.iterdir()) == []
