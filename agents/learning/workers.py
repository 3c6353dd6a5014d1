"""Jobs in processes of their own, which report their progress."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from typing import Any

#: In a worker: where its progress goes.
_messages: Any = None


def run_in_parallel(
    work: Callable[[Any], object],
    jobs: Sequence[Any],
    *,
    workers: int | None = None,
    progress: Callable[..., None] | None = None,
) -> None:
    """Calls ``work(job)`` for every job, in `workers` processes that share the cores.

    By default there is one per core. `progress` is called with the arguments of every
    `send_progress` in them. After an error or Ctrl-C the jobs that still run are terminated.
    """
    if not jobs:
        return
    cores = core_count()
    workers = min(workers or cores, len(jobs))
    context = multiprocessing.get_context("spawn")
    messages, others = context.SimpleQueue(), set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(
        workers, context, initializer=_start_worker, initargs=(messages, max(1, cores // workers))
    )
    with pool:
        try:
            running = {pool.submit(work, job) for job in jobs}
            while running:
                done, running = wait(running, timeout=0.2, return_when=FIRST_COMPLETED)
                while not messages.empty():
                    message = messages.get()
                    if progress is not None:
                        progress(*message)
                for future in done:
                    future.result()
        except BaseException:
            for process in set(multiprocessing.active_children()) - others:
                process.terminate()
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def core_count() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def send_progress(*message: object) -> None:
    """In a worker: sends progress to the process that waits."""
    _messages.put(message)


def _start_worker(messages: Any, threads: int) -> None:
    global _messages
    _messages = messages
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
