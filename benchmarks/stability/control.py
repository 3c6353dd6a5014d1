"""Policies in a closed loop with delay, when the light jumps by six stops."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from agents import PolicyContext, make_policy
from agents.episodes import make_envs
from agents.policy import METERS, Policy
from benchmarks.stability.case import Row

GROUP = "stiff control"
#: The agents that come with the package: learnt in steady light, in episodes of eight frames.
LEARNT = ("regression", "ppo")
#: Meters and the hand-made programs, and the agents.
POLICIES = (*(f"{m}:{p}" for m in METERS for p in ("P", "A", "S")), *LEARNT)
DELAYS = (0, 1, 2, 4)
#: Frame of the step, and frames of an episode; in the last ones nothing may move.
_STEP, _FRAMES, _LAST = 12, 48, 12
_STOPS = (-6.0, 6.0)


@dataclass(frozen=True)
class _Loop:
    """What a policy did: frames from the step until it stayed, and how far it swings at the end."""

    frames: int
    amplitude: float


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """The cases of this group."""
    delays = (0, 2) if quick else DELAYS
    for name in POLICIES:
        for noise in (False, True):
            loops = [_loop(name, delay, stops, noise, seed) for delay in delays for stops in _STOPS]
            yield _row(name, noise, loops, delays)


def _row(name: str, noise: bool, loops: list[_Loop], delays: tuple[int, ...]) -> Row:
    amplitude = max(loop.amplitude for loop in loops)
    by_delay = [max(p.frames for p in loops[2 * i : 2 * i + 2]) for i in range(len(delays))]
    settled = ", ".join(f"{d}: {f}" for d, f in zip(delays, by_delay, strict=True))
    kind = "with noise" if noise else "without noise"
    return Row(
        GROUP,
        f"{name}, {kind}, steps of +-6 EV",
        amplitude,
        error="EV of swing",
        # A meter with hysteresis in constant light without noise must come to rest.
        limit=None if noise or name in LEARNT else 0.0,
        dtype="",
        declared="learnt in steady light (docs/stability.md)" if name in LEARNT else "",
        note=f"frames to settle by delay: {settled}",
    )


def _loop(name: str, delay: int, stops: float, noise: bool, seed: int) -> _Loop:
    """One policy on every small bundled scene at once."""
    options: dict[str, Any] = {
        "scenes": "bundled:small",
        "split": "all",
        "lighting": {"kind": "step", "stops": stops, "at": _STEP},
        "delay": delay,
        "motion": "none",
        "depth": "far",
        "noise": noise,
    }
    envs = make_envs(options, num_envs=1, frames=1)
    count = len(envs.unwrapped.scenes)  # type: ignore[attr-defined]
    envs.close()
    envs = make_envs(options, num_envs=count, frames=_FRAMES)
    try:
        policy = make_policy(name, PolicyContext.from_envs(envs))
        evs = _evs(policy, envs, list(range(count)), seed)
    finally:
        envs.close()
    last = evs[:, -_LAST:]
    amplitude = float((last.max(axis=1) - last.min(axis=1)).max())
    moved = np.abs(np.diff(evs, axis=1)) > 1e-9  # (E, T - 1)
    frames = [int(np.flatnonzero(row)[-1]) + 1 - _STEP if row.any() else 0 for row in moved]
    return _Loop(max(0, *frames), amplitude)


def _evs(policy: Policy, envs: Any, scenes: list[int], seed: int) -> np.ndarray:
    """(E, T) EV100 of every frame."""
    policy.reset(envs.num_envs, seed)
    observations, info = envs.reset(seed=seed, options={"scene": scenes})
    evs = [info["ev100"]]
    masks = envs.unwrapped.action_masks()
    for _ in range(_FRAMES):
        actions = policy.act(observations, masks)
        observations, _, _, _, info = envs.step(actions)
        evs.append(info["ev100"])
    return np.stack(evs, axis=1)
