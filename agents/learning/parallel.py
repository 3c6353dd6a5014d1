"""Several trainings at once, one process each, with progress in the process that waits."""

from __future__ import annotations

import multiprocessing
import os
import queue
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agents.learning.training import AgentConfig, is_trained, train_agent

#: Seconds between two looks at the queue.
_PATIENCE = 0.2
#: In a worker: set when it is to end, and where its progress goes.
_stop: Any = None
_messages: Any = None


@dataclass(frozen=True)
class TrainingJob:
    """An agent to train.

    Args:
        name: Shown to the user.
        config: What to train.
        out: File name of the agent, without suffix.
        device: Torch device of the network.
    """

    name: str
    config: AgentConfig
    out: Path
    device: str = "cpu"


def train_in_parallel(
    jobs: Sequence[TrainingJob],
    *,
    workers: int | None = None,
    progress: Callable[[str, int, int, dict[str, float]], None] | None = None,
) -> None:
    """Trains every job that is not trained yet.

    Args:
        jobs: What to train.
        workers: Processes at a time, each with its share of the cores; by default one per core.
        progress: Called with the job's name, frames done, frames in all, and losses.

    Raises:
        KeyboardInterrupt: After Ctrl-C; every job has its checkpoint, the same call resumes.
        SystemExit: Of status 143, where a worker gets SIGTERM; likewise.
    """
    waiting = [job for job in jobs if not is_trained(job.config, job.out)]
    run_in_parallel(_train, waiting, workers=workers, progress=progress)


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
        progress: Called with what `tell` is called with.

    Raises:
        KeyboardInterrupt: After Ctrl-C, when every job has ended at its next `tell`.
        SystemExit: Of status 143, where a worker gets SIGTERM.
    """
    if not jobs:
        return
    cores = core_count()
    workers = min(workers or cores, len(jobs))
    threads = max(1, cores // workers)
    context = multiprocessing.get_context("spawn")
    stop, messages = context.Event(), context.Queue()
    with ProcessPoolExecutor(
        workers, mp_context=context, initializer=_obey, initargs=(stop, messages)
    ) as executor:
        with _ignored(signal.SIGINT):
            running: set[Future[None]] = {
                executor.submit(_with_threads, work, job, threads) for job in jobs
            }
        try:
            while running:
                done, running = wait(running, timeout=_PATIENCE, return_when=FIRST_COMPLETED)
                _deliver(messages, progress)
                for future in done:
                    future.result()
            _deliver(messages, progress)
        except BaseException:
            stop.set()
            # `timeout` and the like send SIGTERM twice: a shutdown cut short hangs at exit.
            with _ignored(signal.SIGTERM):
                executor.shutdown(wait=True, cancel_futures=True)
            raise


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
    """In a worker: see `tell`; elsewhere nothing.

    Raises:
        KeyboardInterrupt: If the worker is to end.
    """
    if _stop is not None and _stop.is_set():
        raise KeyboardInterrupt


@contextmanager
def _ignored(signal_number: int) -> Iterator[None]:
    """Within, a signal does nothing; of SIGINT, processes started within leave it to this one."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal_number, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal_number, before)


def _obey(stop: Any, messages: Any) -> None:
    """Begins a worker, which ends its training when `stop` is set, or at SIGTERM.

    It does not outlive the process that began it.
    """
    global _stop, _messages
    _stop, _messages = stop, messages
    messages.cancel_join_thread()  # nobody reads the last ones of a training that is stopped
    signal.signal(signal.SIGTERM, _terminate)
    threading.Thread(target=_follow_parent, daemon=True).start()


def _follow_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _terminate(*_: Any) -> None:
    """Handler that lets SIGTERM end a training as Ctrl-C does: its checkpoint is written first.

    Raises:
        SystemExit: Of status 143, as shells call a process that SIGTERM ended.
    """
    raise SystemExit(128 + signal.SIGTERM)


def _deliver(messages: Any, progress: Callable[..., None] | None) -> None:
    while True:
        try:
            message = messages.get_nowait()
        except queue.Empty:
            return
        if progress is not None:
            progress(*message)


def _with_threads(work: Callable[[Any], object], job: Any, threads: int) -> None:
    import torch

    torch.set_num_threads(threads)
    if _stop is None or not _stop.is_set():
        work(job)


def _train(job: TrainingJob) -> None:
    last = 0

    def report(done: int, total: int, values: dict[str, float]) -> None:
        nonlocal last
        check_stop()
        if done == total or done - last >= total // 200:
            last = done
            tell(job.name, done, total, values)

    train_agent(job.config, job.out, progress=report, device=job.device)
