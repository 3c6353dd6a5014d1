"""Where the time of a step goes, by sampling: what is measured runs as it is, unpatched."""

from __future__ import annotations

import signal
import time
from collections import Counter
from collections.abc import Callable
from types import FrameType
from typing import Any

import torch

from benchmarks.throughput.steps import CACHED, ID, SCENES, stepper

#: Time between samples [s]; a long call of compiled code delays one, which then counts as more.
_INTERVAL = 0.001
_PACKAGES = ("ae_env", "simulator")
#: Functions with less than this share are summed up.
_LEAST_SHARE = 0.01


def measure_profile(threads: int, seconds: float, seed: int) -> dict[str, list[dict[str, Any]]]:
    """Share of each function in steps of 64 environments at 128 x 128, by kind of scene.

    Args:
        threads: Threads to use; with one, the kernels run where they are called.
        seconds: How long steps are taken.
        seed: Of episodes and actions.
    """
    import gymnasium as gym

    torch.set_num_threads(threads)
    found = {}
    for name, options in (("cached scene", CACHED), ("motion and defocus", {})):
        make: dict[str, Any] = {"scenes": SCENES, "resolution": 128, "autoreset_mode": "SAME_STEP"}
        step = stepper(gym.make_vec(ID, num_envs=64, **make, **options), seed)
        for _ in range(16):
            step()
        found[name] = profiled(step, seconds, frames=64)
    return found


def profiled(step: Callable[[], Any], seconds: float, *, frames: int) -> list[dict[str, Any]]:
    """Functions by their own share of the time, those of other libraries counted for the caller.

    Args:
        step: Called again and again.
        seconds: How long.
        frames: That one call makes.

    Returns:
        Rows of ``function``, ``share``, ``microseconds`` (per frame), the largest first.
    """
    spent: Counter[str] = Counter()
    last = time.perf_counter()

    def sample(_signal: int, frame: FrameType | None) -> None:
        nonlocal last
        now = time.perf_counter()
        spent[_own(frame)] += now - last  # type: ignore[assignment]
        last = now

    before = signal.signal(signal.SIGALRM, sample)
    signal.setitimer(signal.ITIMER_REAL, _INTERVAL, _INTERVAL)
    start = last = time.perf_counter()
    calls = 0
    try:
        while time.perf_counter() - start < seconds:
            step()
            calls += 1
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    total = sum(spent.values())
    each = (time.perf_counter() - start) / (calls * frames) * 1e6
    rows = [
        {"function": name, "share": own / total, "microseconds": own / total * each}
        for name, own in spent.most_common()
        if own >= _LEAST_SHARE * total
    ]
    rest = 1.0 - sum(row["share"] for row in rows)
    return [*rows, {"function": "the rest", "share": rest, "microseconds": rest * each}]


def _own(frame: FrameType | None) -> str:
    """The innermost function of this project that is running."""
    while frame is not None:
        module = frame.f_globals.get("__name__", "")
        if module.split(".")[0] in _PACKAGES:
            function = frame.f_code.co_qualname.partition(".<locals>")[0]
            return f"{module}.{function}"
        frame = frame.f_back
    return "gymnasium and the benchmark"
