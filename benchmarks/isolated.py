"""Tasks in a process of their own: their peak memory is theirs, and so are their threads."""

import contextlib
import importlib
import json
import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).absolute().parents[1]
#: Threads of everything that is not measured on one: targets are stated for two cores.
CORES = min(2, os.cpu_count() or 1)


def peak_memory() -> float:
    """Most memory that this process has held since it started or `forget_peak` [MiB]; of Linux.

    The resource module counts what the parent held before it became this program, too.
    """
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    (kib,) = (line.split()[1] for line in lines if line.startswith("VmHWM:"))
    return int(kib) / 1024.0


def forget_peak() -> None:
    """Lets `peak_memory` count from what is held now, where the system can."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def timed(call: Callable[[], Any]) -> float:
    """Seconds that one call takes; what it returns is dropped within that time."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def median_seconds(call: Callable[[], Any], *, least: float, calls: int = 3) -> float:
    """Median time of a call: at least `calls` calls and `least` seconds."""
    seconds: list[float] = []
    while len(seconds) < calls or sum(seconds) < least:
        seconds.append(timed(call))
    return statistics.median(seconds)


if __name__ == "__main__":
    module, _, name = sys.argv[1].partition(":")
    print(json.dumps(getattr(importlib.import_module(module), name)(**json.loads(sys.argv[2]))))
