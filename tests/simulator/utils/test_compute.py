import logging
import multiprocessing
import threading
from functools import partial
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core import caching

from simulator.utils import compute as jit
from simulator.utils.compute import kernel, parallel_ranges


def add(a: int, b: int) -> int:
    return a + b


def test_kernels_run_without_the_lock_and_are_cached_where_they_can(monkeypatch, caplog):
    compiled = kernel(fastmath=True)(add)
    assert isinstance(compiled, numba.core.dispatcher.Dispatcher)
    assert compiled(1, 2) == 3
    assert {"nogil": True, "fastmath": True}.items() <= compiled.targetoptions.items()
    assert compiled.stats.cache_path is not None
    monkeypatch.setattr(caching.CacheImpl, "_locator_classes", [])
    with caplog.at_level(logging.INFO, "simulator.utils.compute"):
        assert kernel()(add)(1, 2) == 3
    assert "compiled again in each process" in caplog.text


def test_a_kernel_is_stale_when_a_module_changes_that_it_depends_on(tmp_path, monkeypatch):
    """Numba itself would run the kernel that it compiled with a constant's old value."""
    monkeypatch.setattr(jit, "_ROOT", tmp_path)
    texts = {
        "ae_env/kernels.py": "from ae_env.part import (\n    middle,\n)\nimport numpy",
        "ae_env/part/middle.py": "    from simulator.a.constants import FACTOR",
        "simulator/a/constants.py": "FACTOR = 2.0",
        "simulator/a/others.py": "FACTOR = 2.0",
    }
    for name, text in texts.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)

    checksum = partial(jit._checksum.__wrapped__, tmp_path / "ae_env/kernels.py")
    before = checksum()
    (tmp_path / "simulator/a/others.py").write_text("FACTOR = 3.0")
    assert checksum() == before
    for name in list(texts)[:3]:
        (tmp_path / name).write_text(texts[name] + " # changed")
        assert checksum() != before
        (tmp_path / name).write_text(texts[name])
    monkeypatch.undo()
    stamp = kernel()(add)._cache._cache_file._source_stamp
    assert stamp[1] == jit._checksum(Path(__file__))


@pytest.mark.parametrize("threads", [1, 2, 3, 8])
@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_every_item_is_done_once(count, threads):
    done = np.zeros((count, 10), int)

    def task(first: int, last: int) -> None:
        for row in done[first:last]:  # a task may ask for shares itself

            def inner(a: int, b: int, row: np.ndarray = row) -> None:
                row[a:b] += 1

            parallel_ranges(inner, 10, threads=2)

    parallel_ranges(task, count, threads=threads)
    assert (done == 1).all()


def test_shares_are_contiguous_and_run_at_the_same_time():
    barrier, shares = threading.Barrier(3, timeout=30), []

    def task(first: int, last: int) -> None:
        barrier.wait()  # passes only if all three are under way
        shares.append((first, last))

    parallel_ranges(task, 9, threads=3)
    assert sorted(shares) == [(0, 3), (3, 6), (6, 9)]
    names = []  # little work stays on the caller's thread
    parallel_ranges(lambda *_: names.append(threading.current_thread()), 5, least=3, threads=4)
    assert names == [threading.current_thread()]


@pytest.mark.parametrize("bad", [0, 3])
def test_errors_of_any_share_are_raised_once_all_are_done(bad):
    done: list[int] = []

    def task(first: int, last: int) -> None:
        if first == bad:
            raise ValueError(f"share {first}")
        done.append(first)

    with pytest.raises(ValueError, match=f"share {bad}"):
        parallel_ranges(task, 6, threads=2)
    assert done == [3 - bad]


def _sum_in_child(queue: multiprocessing.Queue) -> None:
    totals = np.zeros(2)

    def task(first: int, last: int) -> None:
        totals[first:last] = last

    parallel_ranges(task, 2, threads=2)
    queue.put(totals.tolist())


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # forking a process that has threads
def test_child_processes_make_threads_of_their_own():
    parallel_ranges(lambda *_: None, 2, threads=2)  # this process has some already
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=_sum_in_child, args=(queue,))
    child.start()
    assert queue.get(timeout=60) == [1.0, 2.0]
    child.join(timeout=60)
