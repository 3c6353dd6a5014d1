"""Loops that run for long: policies after a jump of the light, and a hundred thousand steps."""

from __future__ import annotations

import gc
import os
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import ae_env  # noqa: F401  registers the environment
from agents import PolicyContext, make_policy
from agents.policy_names import CLASSIC_METERS
from agents.rollouts import make_envs
from benchmarks.harness import Row
from benchmarks.stability.case import row

#: The agents that come with the package: learnt in steady light, in episodes of eight frames.
LEARNT = ("regression", "ppo")
#: The classic meters and the hand-made programs, and the agents.
POLICIES = (*(f"{m}:{p}" for m in CLASSIC_METERS for p in ("P", "A", "S")), *LEARNT)
DELAYS = (0, 1, 2, 4)
#: Frame of the step, frames of an episode, and how many of the last tell whether it came to rest.
_STEP, _FRAMES, _LAST = 12, 72, 12
#: Largest swing at the end [EV]: one state of the grid.
_ONE_STATE = 1.2


def control(seed: int, quick: bool) -> list[Row]:
    """Frames until a policy stays, over the delay, when the light jumps by six stops."""
    rows = []
    for name in POLICIES:
        delays = (0, 2) if quick or name in LEARNT else DELAYS
        loops = [[_loop(name, delay, s, seed) for s in (-6.0, 6.0)] for delay in delays]
        frames = [max(int(settled.max()) for settled, _ in pair) for pair in loops]
        swings = np.concatenate([amplitudes for pair in loops for _, amplitudes in pair])
        swing, learnt = float(swings.max()), name in LEARNT
        still = swing <= _ONE_STATE
        note = f"swings by {swing:.2f} EV at the end"
        if not still:
            note += (
                f", by more than {_ONE_STATE} in {(swings > _ONE_STATE).mean():.1%} of the cases"
            )
        note += f"; {len(swings)} cases" + ", learnt in steady light" * learnt
        case = f"{name}, steps of +-6 EV"
        rows.append(
            row(case, delays, frames, unit="frames to settle", dtype="", ok=still, note=note)
        )
    return rows


def _loop(name: str, delay: int, stops: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Frames from the step until it stayed, and its swing at the end [EV], of each scene.

    Agents see all scenes of the test split, as they were trained on others.
    """
    learnt = name in LEARNT
    options: dict[str, Any] = {
        "scenes": "bundled" if learnt else "bundled:small",
        "split": "test" if learnt else "all",
        "lighting": {"kind": "step", "stops": stops, "at": _STEP},
        "delay": delay,
        "motion": "none",
        "depth": "far",
        "resolution": 64 if learnt else 36,  # theirs; the least
    }
    first = make_envs(options, num_envs=1, frames=1)
    count = len(first.unwrapped.scenes)  # type: ignore[attr-defined]
    first.close()
    envs = make_envs(options, num_envs=count, frames=_FRAMES)
    policy = make_policy(name, PolicyContext.from_envs(envs))
    policy.reset(envs.num_envs, seed)
    observations, info = envs.reset(seed=seed, options={"scene": list(range(envs.num_envs))})
    evs = [info["ev100"]]
    for _ in range(_FRAMES):
        masks = envs.unwrapped.action_masks()  # type: ignore[attr-defined]
        observations, _, _, _, info = envs.step(policy.act(observations, masks))
        evs.append(info["ev100"])
    envs.close()
    track = np.stack(evs, axis=1)  # (E, T)
    moved = np.abs(np.diff(track, axis=1)) > 1e-9
    settled = [int(np.flatnonzero(own)[-1]) + 1 - _STEP if own.any() else 0 for own in moved]
    return np.maximum(settled, 0), np.ptp(track[:, -_LAST:], axis=1)


# -- a long run -----------------------------------------------------------------------------------

#: Steps and episodes, and memory that may be added once everything was in use once [MiB].
STEPS, EPISODES, _GROWTH_MIB = 100_000, 1_000, 16.0


def long_runs(seed: int, quick: bool) -> list[Row]:
    """Memory of a process over the steps of one environment."""
    steps, episodes = (2_000, 20) if quick else (STEPS, EPISODES)
    env = gym.make("ae_env/AutoExposure-v0", scenes="bundled:small", max_episode_steps=None)
    rng, x, memory = np.random.default_rng(seed), list[int](), list[float]()
    for step in range(steps):
        if step % (steps // episodes) == 0:
            env.reset(seed=seed if step == 0 else None)
        if step >= steps // 5 and step % (steps // 20) == 0:
            gc.collect()
            x.append(step)
            memory.append(_memory_mib())
        env.step(rng.integers(64))
    growth = [max(0.0, value - memory[0]) for value in memory]
    case = f"{steps:,} steps in {episodes:,} episodes"
    return [row(case, x, growth, unit="MiB more", limit=_GROWTH_MIB, dtype="")]


def _memory_mib() -> float:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
