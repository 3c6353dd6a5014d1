"""Work shared between a few threads of this process, for kernels that release Python's lock.

As many threads as torch would use (`torch.set_num_threads`, ``OMP_NUM_THREADS``). They belong to
the process that made them: a forked child makes its own, where an OpenMP pool would hang or die.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise

_POOLS: dict[tuple[int, int], ThreadPoolExecutor] = {}  # by process and size
_inside = threading.local()


def thread_count() -> int:
    """Number of threads that share work: `torch.get_num_threads()`."""
    import torch

    return torch.get_num_threads()


def parallel_ranges(
    task: Callable[[int, int], object], count: int, *, least: int = 1, threads: int | None = None
) -> None:
    """Call ``task(first, last)`` on contiguous shares of ``range(count)``, one per thread.

    The caller's thread takes the first share. A task that calls `parallel_ranges` itself gets one
    share. Returns when all shares are done.

    Args:
        task: Safe to run on several threads at once; an error in any share is raised here.
        count: Number of items, >= 0.
        least: Items below which another thread is not worth waking.
        threads: Most threads to use; `thread_count()` by default.
    """
    shares = min(thread_count() if threads is None else threads, count // max(least, 1))
    if shares <= 1 or getattr(_inside, "task", False):
        if count:
            task(0, count)
        return
    bounds = [count * i // shares for i in range(shares + 1)]
    others: list[Future[None]] = [
        _pool(shares - 1).submit(_run, task, first, last) for first, last in pairwise(bounds[1:])
    ]
    try:
        _run(task, 0, bounds[1])
    finally:
        _inside.task = False
        errors = [other.exception() for other in others]  # waits for every one of them
    for error in errors:
        if error is not None:
            raise error


def _run(task: Callable[[int, int], object], first: int, last: int) -> None:
    _inside.task = True  # a worker that waited for workers would wait for itself
    task(first, last)


def _pool(size: int) -> ThreadPoolExecutor:
    key = (os.getpid(), size)
    if key not in _POOLS:
        _POOLS[key] = ThreadPoolExecutor(size, thread_name_prefix="simulator")
    return _POOLS[key]
