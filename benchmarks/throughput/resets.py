"""What a reset costs beside a step: with 8 frames an episode, it is one frame in nine."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

import ae_env  # noqa: F401  registers the environment
from benchmarks.harness import Row, quartiles
from benchmarks.isolated import timed
from benchmarks.throughput.steps import ID, warm_environment

#: Environments, episodes that warm up after each scene has been seen, and episodes that are timed.
CASES = ((1, 500, 400), (64, 100, 100))
QUICK_CASES = ((1, 20, 20), (64, 5, 5))
#: Steps of an episode after its reset.
STEPS = 8


def measure_resets(seed: int, quick: bool) -> list[Row]:
    """Rows of one environment and of 64, in motion and out of focus, with random actions."""
    return [
        _row(count, warm, number, seed) for count, warm, number in (QUICK_CASES if quick else CASES)
    ]


def _row(num_envs: int, warm: int, number: int, seed: int) -> Row:
    reset, step = _episodes(num_envs, seed)
    for _ in range(warm):
        reset()
    resets, steps = [], []
    for _ in range(number):
        resets.append(timed(reset))
        steps += [timed(step) for _ in range(STEPS)]
    low, middle, high = quartiles(resets)
    return {
        "case": "one environment" if num_envs == 1 else "vector env",
        "num_envs": num_envs,
        "reset_ms": middle * 1e3,
        "step_ms": quartiles(steps)[1] * 1e3,
        "ratio": middle / quartiles(steps)[1],
        "ratio_of_means": float(np.mean(resets) / np.mean(steps)),
        "spread": (high - low) / middle,
    }


def _episodes(num_envs: int, seed: int) -> tuple[Callable[[], Any], Callable[[], Any]]:
    """Functions that reset the environments and that take a step of them."""
    rng = np.random.default_rng(seed)
    if num_envs == 1:
        env = warm_environment({}, seed).unwrapped
        return env.reset, lambda: env.step(rng.integers(64))
    envs = gym.make_vec(ID, num_envs=num_envs, max_episode_steps=None)
    for number in range(len(envs.unwrapped.scenes)):  # type: ignore[attr-defined]
        envs.reset(seed=seed, options={"scene": number})
    return envs.reset, lambda: envs.step(rng.integers(64, size=num_envs))
