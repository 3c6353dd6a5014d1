"""The environment as copies of the single one: what users have who do not batch."""

from __future__ import annotations

import functools
import multiprocessing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv


def in_one_process(name: str, count: int, options: Mapping[str, Any]) -> gym.vector.VectorEnv:
    """`count` copies, stepped one after the other."""
    make = functools.partial(_prepared, name, dict(options))
    return SyncVectorEnv([make] * count, autoreset_mode=AutoresetMode.SAME_STEP)


def in_subprocesses(name: str, count: int, options: Mapping[str, Any]) -> gym.vector.VectorEnv:
    """`count` copies, each in a process of its own with one thread.

    They are forked, so that they share the scenes and the libraries that are loaded once here;
    nothing may have run on several threads before.
    """
    context = "fork" if "fork" in multiprocessing.get_all_start_methods() else "spawn"
    make = functools.partial(_prepared, name, dict(options))
    make().close()
    makes = [functools.partial(_on_one_thread, make)] * count
    return AsyncVectorEnv(makes, context=context, autoreset_mode=AutoresetMode.SAME_STEP)


def _prepared(name: str, options: dict[str, Any]) -> gym.Env:
    env = gym.make(name, **options)
    for number in range(len(env.unwrapped.scenes)):  # type: ignore[attr-defined]
        env.reset(seed=0, options={"scene": number})  # works out what is kept for each
    return env


def _on_one_thread(make: Any) -> gym.Env:
    torch.set_num_threads(1)
    return make()


def memory_of_children() -> float | None:
    """Memory of all child processes, shared pages split among them [MiB]; None if not known."""
    total = 0
    for child in multiprocessing.active_children():
        try:
            text = Path(f"/proc/{child.pid}/smaps_rollup").read_text(encoding="ascii")
        except OSError:
            return None
        total += sum(int(line.split()[1]) for line in text.splitlines() if line.startswith("Pss:"))
    return total / 1024.0
