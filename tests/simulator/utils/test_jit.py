"""Compilation: announced, kept on disk, and possible where nothing can be kept."""

from __future__ import annotations

import logging

import numba
import pytest
from numba.core import caching

from simulator.utils.jit import kernel


def add(a: int, b: int) -> int:
    return a + b


def test_kernels_run_without_the_lock_and_are_kept() -> None:
    compiled = kernel(fastmath=True)(add)
    assert isinstance(compiled, numba.core.dispatcher.Dispatcher)
    assert compiled(1, 2) == 3
    assert compiled.targetoptions["nogil"]
    assert compiled.targetoptions["fastmath"]
    assert compiled.stats.cache_path is not None


def test_they_run_where_nothing_can_be_kept(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(caching.CacheImpl, "_locator_classes", [])
    with caplog.at_level(logging.INFO, "simulator.utils.jit"):
        assert kernel()(add)(1, 2) == 3
    assert "compiled anew" in caplog.text


def test_only_kernels_of_the_package_are_announced(caplog: pytest.LogCaptureFixture) -> None:
    def ours(a: int) -> int:
        return a + 1

    ours.__module__ = "simulator.example"
    with caplog.at_level(logging.INFO, "simulator.utils.jit"):
        assert numba.njit(ours)(1) == 2
        assert numba.njit(add)(1, 1) == 2  # of the tests
    assert [r.getMessage() for r in caplog.records] == ["compiling simulator.example.ours"]
