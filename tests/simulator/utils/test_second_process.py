"""A second process that compiles: waited for while it may help, and never needed."""

import multiprocessing
import os
import subprocess
import sys
import time
from types import SimpleNamespace
from typing import Any

import numba
import pytest
import torch

from simulator.utils import jit, second_process
from simulator.utils.jit import is_cached, kernel

NAME = "package.module.kernel"


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """No second process was started yet, and two threads may be used."""
    monkeypatch.setattr(second_process, "_second", None)
    monkeypatch.setattr(second_process, "thread_count", lambda: 2)


def started() -> subprocess.Popen[bytes]:
    assert second_process._second is not None
    return second_process._second.process


@pytest.mark.usefixtures("alone")
def test_one_that_fails_is_not_waited_for() -> None:
    second_process.compile_beside("simulator.no_such_module", [NAME])
    process = started()
    assert process.wait(60) != 0
    assert not second_process.is_compiling(NAME)
    second_process.compile_beside("simulator.no_such_module", [NAME])
    assert started() is process  # once is enough


@pytest.mark.usefixtures("alone")
def test_one_that_does_not_end_is_waited_for_a_while_and_ended(monkeypatch) -> None:
    monkeypatch.setattr(second_process, "_PATIENCE", 1e9)
    second_process.compile_beside("http.server", [NAME])  # serves until it is ended
    process, known = started(), second_process._second
    try:
        assert second_process.is_compiling(NAME)
        assert not second_process.is_compiling("another")
        monkeypatch.setattr(os, "getpid", lambda: -1)  # in a fork of this process
        assert not second_process.is_compiling(NAME)
        second_process._end(process, 1)  # its parent's
        assert process.poll() is None
        monkeypatch.undo()
        assert known is not None
        late = second_process._Second(process, known.kernels, known.owner, time.monotonic() - 1.0)
        monkeypatch.setattr(second_process, "_second", late)
        assert not second_process.is_compiling(NAME)
    finally:
        monkeypatch.undo()
        second_process._end(process, os.getpid())
    assert process.poll() is not None


@pytest.mark.usefixtures("alone")
@pytest.mark.parametrize(
    "reason", ["one thread", "a child", "no Python", "an application", "itself", "not to start"]
)
def test_none_is_started_where_it_would_not_help(reason: str, monkeypatch) -> None:
    patches: dict[str, tuple[Any, str, Any]] = {
        "one thread": (second_process, "thread_count", lambda: 1),
        "a child": (multiprocessing, "parent_process", lambda: object()),
        "no Python": (sys, "executable", ""),
        "an application": (sys, "executable", "/usr/bin/editor"),
        "itself": (second_process, "_is_second", True),
        "not to start": (sys, "executable", "/no/such/python3"),
    }
    monkeypatch.setattr(*patches[reason])
    second_process.compile_beside("this", [NAME])
    assert second_process._second is None


def test_a_kernel_is_loaded_as_soon_as_the_other_process_has_compiled_it(
    monkeypatch, tmp_path
) -> None:
    """Else both would compile it, and the second process save nothing."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))  # not what an earlier run left

    def twice(a: int) -> int:
        return 2 * a

    compiled = kernel()(twice)
    asked: list[str] = []

    def is_compiling(name: str) -> bool:
        asked.append(name)
        return len(asked) < 4

    monkeypatch.setattr(jit, "is_compiling", is_compiling)
    assert compiled(4) == 8  # compiled here in the end: nobody else has
    assert asked[:4] == [f"{__name__}.twice"] * 4
    assert is_cached(compiled)
    asked.clear()
    again = kernel()(twice)
    assert again(4) == 8
    assert len(asked) == 1  # found at once
    assert is_cached(torch.nn.Identity())  # what has no cache is not compiled beforehand


@pytest.mark.parametrize(
    ("cache", "words"),
    [(SimpleNamespace(_cache_file=None), "for this and later runs"), (None, "as in every run")],
)
def test_it_says_once_that_it_compiles_and_whether_that_is_kept(
    caplog, monkeypatch, cache, words
) -> None:
    def function() -> None: ...

    function.__module__ = "simulator.any"
    event = SimpleNamespace(data={"dispatcher": SimpleNamespace(py_func=function, _cache=cache)})
    announcer = jit._Announcer()
    for _ in range(2):
        announcer.on_start(event)
        announcer.on_end(event)
    (record,) = caplog.records
    assert words in record.getMessage()
    caplog.clear()
    monkeypatch.setattr(multiprocessing, "parent_process", lambda: object())  # one of many
    jit._Announcer().on_start(event)
    assert not caplog.records
