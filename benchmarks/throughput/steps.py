"""Environment steps per second beside the kernel limit, copies of the environment, and a lookup."""

from __future__ import annotations

import functools
import multiprocessing
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode

import ae_env  # noqa: F401  registers the environment
from ae_env.scorers import Captures
from benchmarks.harness import Row, quartiles
from benchmarks.throughput.kernel_limit import KernelLimit, lookup

ID = "ae_env/AutoExposure-v0"
SCENES = "bundled:small"
#: Neither motion nor defocus: every frame is exposed from the scene's own light.
CACHED: dict[str, Any] = {"motion": "none", "depth": "far"}
#: Rounds, and seconds that a case takes in each.
QUICK, FULL = (3, 0.08), (9, 0.3)
#: Names of the limits that others are compared with.
KERNEL = {"bank": "fused kernel, noise bank", "exact": "fused kernel, exact noise"}
LOOKUP = "lookup"


class LiveScore:
    """Well-exposedness of the recorded pixels (Mertens 2007), in encoded light."""

    domain = "raw"

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        """Scores (B,) of `images` (B, 4, H, W)."""
        away = images.sqrt() - 0.5
        return away.square_().mul_(-1 / (2 * 0.2**2)).exp_().mean(dim=(1, 2, 3))


@dataclass
class Case:
    """One thing to time: `step` makes `num_envs` frames.

    Args:
        name: In the table.
        num_envs: Frames of one step.
        step: What is timed.
        noise: Names the kernel that it is compared with.
        observation: What the environment shows.
        error: Largest difference of a code between an episode in the batch and the same one alone.
        close: Called at the end.
        seconds: Time per frame, one for each round.
    """

    name: str
    num_envs: int
    step: Callable[[], Any]
    noise: str = "bank"
    observation: str = "uint8"
    error: float | None = None
    close: Callable[[], Any] = lambda: None
    seconds: list[float] = field(default_factory=list)


def measure_steps(threads: int, size: int, seed: int, quick: bool) -> list[Row]:
    """Rows of results at one frame size and number of threads."""
    torch.set_num_threads(1)  # while children are forked: threads would not come along
    cases = [_copies(8 if quick else 64, size, seed)] if threads > 1 else []
    torch.set_num_threads(threads)
    cases += [*_limits(threads, size, seed), *_environments(size, seed, threads > 1)]
    try:
        _measure(cases, *(QUICK if quick else FULL))
    finally:
        for case in cases:
            case.close()
    return _rows(cases, threads, size)


# -- the cases ------------------------------------------------------------------------------------


def _limits(threads: int, size: int, seed: int) -> Iterator[Case]:
    scenes: Any = gym.make(ID, scenes=SCENES, resolution=size).unwrapped
    lights = np.stack([scene.light.numpy() for scene in scenes.scenes])
    for noise, name in KERNEL.items():
        kernel = KernelLimit(lights, 64, noise=noise, threads=threads, seed=seed)
        yield Case(name, 64, kernel.step, noise)
    yield Case(LOOKUP, 64, lookup((4, size, size), 64, seed))


def _environments(size: int, seed: int, full: bool) -> Iterator[Case]:
    """Cases of the environment itself; without `full` only the chief ones."""
    live, exact = {"scorer": f"{__name__}:LiveScore"}, {"noise": "exact"}
    # An episode of 8 steps takes 9 frames; the kernel takes one per step.
    endless: dict[str, Any] = {"max_episode_steps": None}
    cases: list[tuple[str, int, dict[str, Any]]] = [
        ("one environment, cached scene", 1, CACHED),
        ("vector env, cached scene", 64, CACHED),
        ("vector env, cached scene, endless episodes", 64, CACHED | endless),
        ("vector env, cached scene, live scoring", 64, CACHED | live),
        ("vector env, cached scene, exact noise", 64, CACHED | exact),
        ("vector env, motion and defocus", 64, {}),
    ]
    if full:
        for observation in ("linear", "dn"):
            name = f"vector env, cached scene, {observation}"
            cases.append((name, 64, CACHED | {"observation": observation}))
        for lighting in ("sine", "flicker"):
            name = f"vector env, motion and defocus, {lighting} light"
            cases.append((name, 64, {"lighting": lighting}))
        cases.append(("one environment, motion and defocus", 1, {}))
        for count in (8, 512):
            cases.append(("vector env, cached scene", count, CACHED))
            cases.append(("vector env, motion and defocus", count, {}))
    for name, count, options in cases:
        make: dict[str, Any] = {"scenes": SCENES, "resolution": size} | options
        yield _single(name, make, seed) if count == 1 else _batch(name, count, make, seed)


def _single(name: str, make: dict[str, Any], seed: int) -> Case:
    env, rng = warm_environment(make, seed), np.random.default_rng(seed)

    def step() -> None:
        if env.step(rng.integers(64))[3]:
            env.reset()

    return Case(name, 1, step, make.get("noise", "bank"))


def _batch(name: str, num_envs: int, make: dict[str, Any], seed: int) -> Case:
    envs = gym.make_vec(ID, num_envs=num_envs, autoreset_mode="SAME_STEP", **make)
    scenes = len(envs.unwrapped.scenes)  # type: ignore[attr-defined]
    for first in range(0, scenes, num_envs):  # everything that is computed once for a scene
        chosen = [(first + i) % scenes for i in range(num_envs)]
        envs.reset(seed=seed, options={"scene": chosen})
    error, shown = _largest_difference(envs, make, seed), make.get("observation", "uint8")
    return Case(name, num_envs, _stepper(envs, seed), make.get("noise", "bank"), shown, error)


def _copies(count: int, size: int, seed: int) -> Case:
    """The single environment many times: what users have who do not batch.

    They are forked, so that they share the scenes and the libraries that are loaded once; nothing
    may have run on several threads before.
    """
    options: dict[str, Any] = {"scenes": SCENES, "resolution": size, **CACHED}
    make = functools.partial(_copy, options)
    make().close()
    context = "fork" if "fork" in multiprocessing.get_all_start_methods() else "spawn"
    mode = AutoresetMode.SAME_STEP
    envs = AsyncVectorEnv([make] * count, context=context, autoreset_mode=mode)
    error, name = _largest_difference(envs, options, seed), "copies in subprocesses, cached scene"
    return Case(name, count, _stepper(envs, seed), error=error, close=envs.close)


def _copy(options: dict[str, Any]) -> gym.Env:
    torch.set_num_threads(1)
    return warm_environment(options, 0)


def warm_environment(make: dict[str, Any], seed: int) -> gym.Env:
    """An environment that has seen every scene."""
    env = gym.make(ID, **make)
    for number in range(len(env.unwrapped.scenes)):  # type: ignore[attr-defined]
        env.reset(seed=seed, options={"scene": number})
    return env


def _stepper(envs: gym.vector.VectorEnv, seed: int) -> Callable[[], Any]:
    """A step of `envs` with random actions."""
    envs.reset(seed=seed)
    rng = np.random.default_rng(seed)
    return lambda: envs.step(rng.integers(64, size=envs.num_envs))


def _largest_difference(envs: gym.vector.VectorEnv, make: dict[str, Any], seed: int) -> float:
    """Largest difference of a code between the last environment and the same episode alone."""
    last = envs.num_envs - 1
    alone = gym.make(ID, **make)
    pairs = [(envs.reset(seed=seed)[0], alone.reset(seed=seed + last)[0])]
    for action in (0, 21, 42, 63):
        actions = np.full(envs.num_envs, action)
        pairs.append((envs.step(actions)[0], alone.step(action)[0]))
    return max(
        float(np.abs(many["raw"][last].astype(float) - one["raw"].astype(float)).max())
        for many, one in pairs
    )


# -- measuring ------------------------------------------------------------------------------------


def _measure(cases: Sequence[Case], rounds: int, slice_seconds: float) -> None:
    """Case after case, round after round; the first round warms up and sets the repeats."""
    repeats = [1] * len(cases)
    for i in range(rounds + 1):
        for k, case in enumerate(cases):
            start = time.perf_counter()
            for _ in range(repeats[k]):
                case.step()
            elapsed = time.perf_counter() - start
            if i:
                case.seconds.append(elapsed / (repeats[k] * case.num_envs))
                continue
            start = time.perf_counter()
            case.step()  # warm now
            # Whole episodes, so that resets have their share.
            count = slice_seconds / (time.perf_counter() - start)
            repeats[k] = 8 * max(1, round(count / 8))


def _rows(cases: Sequence[Case], threads: int, size: int) -> list[Row]:
    limits = {case.name: case.seconds for case in cases}

    def ratio(case: Case, limit: str) -> float:
        pairs = zip(limits[limit], case.seconds, strict=True)
        return statistics.median(least / own for least, own in pairs)

    rows = []
    for case in cases:
        low, middle, high = quartiles(case.seconds)
        row: Row = {"case": case.name, "num_envs": case.num_envs, "observation": case.observation}
        row |= {
            "steps_per_second": 1.0 / middle,
            "ratio_to_kernel": ratio(case, KERNEL[case.noise]),
        }
        row |= {"ratio_to_lookup": ratio(case, LOOKUP), "spread": (high - low) / middle}
        rows.append(row | {"error_codes": case.error, "size": size, "threads": threads})
    return rows
