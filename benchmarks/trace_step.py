"""Files and functions of the packages that a reset and a step enter.

Run ``python -m benchmarks.trace_step``: it prints a table in Markdown, and then the files. Counted
with `sys.setprofile` in a default environment, after scenes are loaded and kernels compiled.
Comprehensions and compiled kernels that Python calls are functions, too. Episodes differ in what
moves, so several are traced: the table has the median and the most.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from statistics import median
from types import FrameType
from typing import Any

import gymnasium as gym

#: Folders of the repository whose code counts.
PACKAGES = ("simulator", "ae_env", "agents")
#: Episodes that are traced.
EPISODES = 12
STEPS = ("step, new state", "step, same state")
_ROOT = Path(__file__).resolve().parents[1]


def entered(call: Callable[[], Any]) -> list[tuple[str, str]]:
    """The functions that `call` enters, (file, name) each, in the order in which it does."""
    found: list[tuple[str, str]] = []

    def note(frame: FrameType, event: str, argument: object) -> None:
        path = Path(frame.f_code.co_filename)
        if event == "call" and path.is_relative_to(_ROOT):
            file = path.relative_to(_ROOT)
            if file.parts[0] in PACKAGES:
                found.append((file.as_posix(), frame.f_code.co_qualname))

    sys.setprofile(note)
    try:
        call()
    finally:
        sys.setprofile(None)
    return found


def trace(seed: int) -> dict[str, list[tuple[str, str]]]:
    """Calls of a reset, a step to a new state, and a step that stays in its state."""
    env: Any = gym.make("ae_env:ae_env/AutoExposure-v0", max_episode_steps=1000).unwrapped
    list(env.scenes)  # draws them
    for warm_up in range(100, 103):
        env.reset(seed=warm_up)
        for state in (0, 21, 42, 63):
            env.step(state)
    found = {"reset": entered(lambda: env.reset(seed=seed))}
    return found | {name: entered(lambda: env.step(37)) for name in STEPS}


def main() -> None:
    """Prints the table, and how many of the episodes enter each file."""
    traced = [trace(seed) for seed in range(EPISODES)]
    counted: list[str] = []
    print("| call | files | most | functions | moves between files |\n|---|--:|--:|--:|--:|")
    for name in ("reset", *STEPS):
        paths = [[file for file, _ in calls[name]] for calls in traced]
        files = [len(set(path)) for path in paths]
        functions = median(len(set(calls[name])) for calls in traced)
        moves = median(sum(a != b for a, b in pairwise(path)) for path in paths)
        print(f"| {name} | {median(files):g} | {max(files)} | {functions:g} | {moves:g} |")
        count = Counter(file for path in paths for file in set(path))
        counted += [f"{name}: {number:3} {file}" for file, number in count.most_common()]
    print("", *counted, sep="\n")


if __name__ == "__main__":
    main()
