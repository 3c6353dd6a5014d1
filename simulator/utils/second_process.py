"""A second process that compiles some kernels while this one compiles others.

Numba compiles in one thread of a process, but what it compiles is cached in files: this process
loads from there what the other has compiled. Without the other, this one compiles all of it.
"""

from __future__ import annotations

import atexit
import logging
import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from simulator.utils.threads import thread_count

logger = logging.getLogger(__name__)
#: Longest time that a kernel is waited for [s]: by then something is wrong.
_PATIENCE = 60.0
#: Folder of the packages.
_ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class _Second:
    process: subprocess.Popen[bytes]
    kernels: frozenset[str]
    owner: int
    deadline: float


_second: _Second | None = None
#: Whether this process is such a one itself.
_is_second = False


def compile_beside(module: str, kernels: Collection[str]) -> None:
    """Starts a second process, once, that runs ``python -m module``.

    None is started where only one thread is to be used, in processes of `multiprocessing`, which
    are many, and where there is no Python to start.

    Args:
        module: Compiles kernels when it is run.
        kernels: Their names, ``module.function``; this process waits for them where it needs one.
    """
    global _second
    is_child = multiprocessing.parent_process() is not None
    python = Path(sys.executable or "").name.lower().startswith("python")  # no application with one
    if _second is not None or _is_second or is_child or thread_count() < 2 or not python:
        return
    paths = [str(_ROOT), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    try:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", module],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))},
        )
    except OSError as error:
        logger.info("no second process compiles: %s", error)
        return
    deadline = time.monotonic() + _PATIENCE
    _second = _Second(process, frozenset(kernels), os.getpid(), deadline)
    atexit.register(_end, process, os.getpid())


def begin() -> None:
    """Makes this process one that compiles for another: it starts none itself."""
    global _is_second
    _is_second = True


def is_compiling(kernel: str) -> bool:
    """Whether a second process of this one may still be about to compile `kernel`."""
    if _second is None or kernel not in _second.kernels or os.getpid() != _second.owner:
        return False
    return _second.process.poll() is None and time.monotonic() < _second.deadline


def _end(process: subprocess.Popen[bytes], owner: int) -> None:
    """At exit, ends the second process: files are written whole or not at all."""
    if os.getpid() == owner:
        process.kill()
        process.wait()
