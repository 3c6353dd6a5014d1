"""Policies in a closed loop with delay, when the light jumps by six stops."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from agents import PolicyContext, make_policy
from agents.episodes import make_envs
from agents.policy import CLASSIC_METERS, Policy
from benchmarks.stability.case import Row

GROUP = "stiff control"
#: The agents that come with the package: learnt in steady light, in episodes of eight frames.
LEARNT = ("regression", "ppo")
#: The classic meters and the hand-made programs, and the agents.
POLICIES = (*(f"{m}:{p}" for m in CLASSIC_METERS for p in ("P", "A", "S")), *LEARNT)
DELAYS = (0, 1, 2, 4)
#: Frame of the step, and how many of the last frames tell whether it has come to rest.
_STEP, _LAST = 12, 12
#: Frames of an episode.
_FRAMES = 72
#: Scenes that an agent is shown.
_SCENES_LEARNT = 8
#: Largest swing at the end [EV]: none without noise, one state of the grid with it; an agent, two.
_STILL, _ONE_STATE, _TWO_STATES = 0.0, 1.2, 2.2
_STOPS = (-6.0, 6.0)


@dataclass(frozen=True)
class _Loop:
    """What a policy did: frames from the step until it stayed, and how far it swings at the end."""

    frames: int
    amplitude: float


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """The cases of this group."""
    for name in POLICIES:
        delays = (0, 2) if quick or name in LEARNT else DELAYS
        for noise in (False,) if name in LEARNT else (False, True):
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
        limit=_TWO_STATES if name in LEARNT else _ONE_STATE if noise else _STILL,
        dtype="",
        declared="learnt in steady light (docs/stability.md)" if name in LEARNT else "",
        note=f"frames to settle by delay: {settled}",
    )


def _loop(name: str, delay: int, stops: float, noise: bool, seed: int) -> _Loop:
    """One policy on every small bundled scene at once; an agent, on as many as take a minute."""
    options: dict[str, Any] = {
        "scenes": "bundled:small",
        "split": "all",
        "lighting": {"kind": "step", "stops": stops, "at": _STEP},
        "delay": delay,
        "motion": "none",
        "depth": "far",
        "noise": noise,
        "resolution": 64 if name in LEARNT else 36,  # theirs; the least
    }
    envs = make_envs(options, num_envs=1, frames=1)
    count = len(envs.unwrapped.scenes)  # type: ignore[attr-defined]
    envs.close()
    if name in LEARNT:
        count = min(count, _SCENES_LEARNT)
    envs = make_envs(options, num_envs=count, frames=_FRAMES)
    try:
        policy = make_policy(name, PolicyContext.from_envs(envs))
        evs = _evs(policy, envs, seed)
    finally:
        envs.close()
    last = evs[:, -_LAST:]
    amplitude = float((last.max(axis=1) - last.min(axis=1)).max())
    moved = np.abs(np.diff(evs, axis=1)) > 1e-9  # (E, T - 1)
    settled = [int(np.flatnonzero(row)[-1]) + 1 - _STEP if row.any() else 0 for row in moved]
    return _Loop(max(0, *settled), amplitude)


def _evs(policy: Policy, envs: Any, seed: int) -> np.ndarray:
    """(E, T) EV100 of every frame, each scene in its own environment."""
    policy.reset(envs.num_envs, seed)
    scenes = list(range(envs.num_envs))
    observations, info = envs.reset(seed=seed, options={"scene": scenes})
    evs = [info["ev100"]]
    masks = envs.unwrapped.action_masks()
    for _ in range(_FRAMES):
        actions = policy.act(observations, masks)
        observations, _, _, _, info = envs.step(actions)
        evs.append(info["ev100"])
    return np.stack(evs, axis=1)
