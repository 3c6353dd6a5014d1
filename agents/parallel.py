"""Several jobs at once, one process each, with progress in the process that waits."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from typing import Any

#: Seconds between two looks at the messages of the workers.
_PATIENCE = 0.2
#: In a worker: set when it is to end, and where its progress goes.
_stop: Any = None
_messages: Any = None


def run_in_parallel(
    work: Callable[[Any], object],
    jobs: Sequence[Any],
    *,
    workers: int | None = None,
    progress: Callable[..., None] | None = None,
) -> None:
    """Calls ``work(job)`` for every job, in processes of their own.

    Args:
        work: A function of a module, which reports with `tell`.
        jobs: Values that can be sent to another process.
        workers: Processes at a time, each with its share of the cores; by default one per core.
        progress: Called with the arguments of every `tell`.

    Raises:
        KeyboardInterrupt: After Ctrl-C, when every running job has ended at its next `tell`.
    """
    if not jobs:
        return
    cores = core_count()
    workers = min(workers or cores, len(jobs))
    context = multiprocessing.get_context("spawn")
    stop, messages = context.Event(), context.SimpleQueue()

    def deliver() -> None:
        while not messages.empty():
            message = messages.get()
            if progress is not None:
                progress(*message)

    with ProcessPoolExecutor(
        workers,
        mp_context=context,
        initializer=_start_worker,
        initargs=(stop, messages, max(1, cores // workers)),
    ) as pool:
        try:
            running = {pool.submit(_run, work, job) for job in jobs}
            while running:
                done, running = wait(running, timeout=_PATIENCE, return_when=FIRST_COMPLETED)
                deliver()
                for future in done:
                    future.result()
        finally:  # after an error or Ctrl-C, the jobs that still run end at their next `tell`
            stop.set()
            pool.shutdown(cancel_futures=True)


def core_count() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def tell(*message: object) -> None:
    """In a worker: sends progress to the process that waits.

    Raises:
        KeyboardInterrupt: If the worker is to end.
    """
    check_stop()
    _messages.put(message)


def check_stop() -> None:
    """In a worker: ends the job if it is to end; elsewhere does nothing.

    Raises:
        KeyboardInterrupt: If the worker is to end.
    """
    if _stop is not None and _stop.is_set():
        raise KeyboardInterrupt


def _run(work: Callable[[Any], object], job: Any) -> None:
    check_stop()  # a pool hands out one job more than it has workers, which cannot be cancelled
    work(job)


def _start_worker(stop: Any, messages: Any, threads: int) -> None:
    """Prepares a worker process."""
    global _stop, _messages
    _stop, _messages = stop, messages
    # Ctrl-C reaches every process of a terminal. Only the one that waits decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    import torch

    torch.set_num_threads(threads)


def _end_with_parent() -> None:
    """Ends this process as soon as the one that started it has ended, however that ended."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
