"""Environment steps per second beside the kernel limit, copies of the environment, and a lookup."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
import torch

import ae_env  # noqa: F401  registers the environment
from ae_env.scorers import Captures
from benchmarks.throughput.copies import in_one_process, in_subprocesses, memory_of_children
from benchmarks.throughput.kernel_limit import KernelLimit, lookup, torch_loop

ID = "ae_env/AutoExposure-v0"
SCENES = "bundled:small"
#: Neither motion nor defocus: every frame is exposed from the scene's own light.
CACHED = {"motion": "none", "depth": "far"}
#: Rounds, and seconds that a case takes in each.
QUICK, FULL = (3, 0.08), (9, 0.3)
#: Names of the limits that others are compared with.
KERNEL = {"bank": "fused kernel, noise bank", "exact": "fused kernel, exact noise"}
DIGITAL_KERNEL = "fused kernel, noise bank, whole digital numbers"
LOOKUP = "lookup"


class LiveScore:
    """Well-exposedness of the recorded pixels (Mertens 2007), in encoded light: looks at all."""

    domain = "raw"

    def __call__(self, images: torch.Tensor, captures: Captures) -> torch.Tensor:
        """Scores (B,) of `images` (B, 4, H, W)."""
        away = images.sqrt() - 0.5
        return away.square_().mul_(-1 / (2 * 0.2**2)).exp_().mean(dim=(1, 2, 3))


class LiveSrgbScore(LiveScore):
    """The same of the developed picture."""

    domain = "srgb"


@dataclass
class Case:
    """One thing to time: `step` makes `num_envs` frames.

    `noise` names the kernel that it is compared with.
    """

    name: str
    num_envs: int
    step: Callable[[], Any]
    noise: str = "bank"
    error: int | None = None
    memory: float | None = None
    close: Callable[[], Any] = lambda: None
    seconds: list[float] = field(default_factory=list)  # per frame, one for each round


def measure_steps(threads: int, size: int, seed: int, quick: bool) -> list[dict[str, Any]]:
    """Rows of results at one frame size and number of threads.

    Args:
        threads: Threads of torch and of the kernels.
        size: Height and width of a frame [packed pixel].
        seed: Of episodes, actions and noise.
        quick: Fewer cases, rounds and copies.
    """
    torch.set_num_threads(1)  # while children are forked: threads would not come along
    cases: list[Case] = []
    if threads > 1:
        cases += _copies(8 if quick else 64, size, seed)
    torch.set_num_threads(threads)
    cases += [*_limits(threads, size, seed), *_environments(size, seed, quick, threads > 1)]
    try:
        _measure(cases, *(QUICK if quick else FULL))
    finally:
        for case in cases:
            case.close()
    return _rows(cases, threads, size)


# -- the cases ------------------------------------------------------------------------------------


def _limits(threads: int, size: int, seed: int) -> Iterator[Case]:
    lights = _lights(size)
    for noise, name in KERNEL.items():
        kernel = KernelLimit(lights, 64, noise=noise, threads=threads, seed=seed)
        yield Case(name, 64, kernel.step, noise)
    kernel = KernelLimit(
        lights, 64, noise="bank", result="digital codes", threads=threads, seed=seed
    )
    yield Case(DIGITAL_KERNEL, 64, kernel.step)
    yield Case("torch loop, exact noise", 64, torch_loop(lights, 64, seed), "exact")
    yield Case(LOOKUP, 64, lookup((4, size, size), 64, seed))


def _lights(size: int) -> np.ndarray:
    """(S, 4, H, W) float32 light of the scenes of the environment, as many as it has."""
    env = gym.make(ID, scenes=SCENES, resolution=size).unwrapped
    return np.stack([scene.light.numpy() for scene in env.scenes])  # type: ignore[attr-defined]


def _environments(size: int, seed: int, quick: bool, full: bool) -> Iterator[Case]:
    """Cases of the environment itself; without `full` only the chief ones."""
    live = {"scorer": f"{__name__}:LiveScore"}
    cached = "cached scene"
    yield _single(f"one environment, {cached}", size, seed, **CACHED)
    yield _batch(f"vector env, {cached}", 64, size, seed, **CACHED)
    # An episode of 8 steps takes 9 frames; the kernel takes one per step.
    endless = f"vector env, {cached}, endless episodes"
    yield _batch(endless, 64, size, seed, max_episode_steps=None, **CACHED)
    yield _batch(f"vector env, {cached}, live scoring", 64, size, seed, **CACHED, **live)
    yield _batch("vector env, motion and defocus", 64, size, seed)
    yield _batch("vector env, motion and defocus, held states", 64, size, seed, hold=True)
    yield _batch(f"vector env, {cached}, exact noise", 64, size, seed, noise="exact", **CACHED)
    if not full:
        return
    yield _single(f"one environment, {cached}, live scoring", size, seed, **CACHED, **live)
    yield _single("one environment, motion and defocus", size, seed)
    yield _batch(f"vector env, {cached}", 8, size, seed, **CACHED)
    yield _batch("vector env, motion and defocus", 8, size, seed)
    if not quick:
        srgb = {"scorer": f"{__name__}:LiveSrgbScore"}
        name = f"vector env, {cached}, live scoring in sRGB"
        yield _batch(name, 64, size, seed, **CACHED, **srgb)
        name = "vector env, motion and defocus, exact noise"
        yield _batch(name, 64, size, seed, noise="exact")


def _single(name: str, size: int, seed: int, **options: Any) -> Case:
    env = gym.make(ID, scenes=SCENES, resolution=size, **options)
    for number in range(len(env.unwrapped.scenes)):  # type: ignore[attr-defined]
        env.reset(seed=seed, options={"scene": number})
    rng = np.random.default_rng(seed)

    def step() -> None:
        if env.step(rng.integers(64))[3]:
            env.reset()

    return Case(name, 1, step, options.get("noise", "bank"))


def _batch(
    name: str, num_envs: int, size: int, seed: int, *, hold: bool = False, **options: Any
) -> Case:
    make = {"scenes": SCENES, "resolution": size, "autoreset_mode": "SAME_STEP"} | options
    envs = gym.make_vec(ID, num_envs=num_envs, **make)
    scenes = len(envs.unwrapped.scenes)  # type: ignore[attr-defined]
    for first in range(0, scenes, num_envs):  # works out what is kept for each scene
        chosen = [(first + i) % scenes for i in range(num_envs)]
        envs.reset(seed=seed, options={"scene": chosen})
    error = largest_difference(envs, size, seed, options)
    step = stepper(envs, seed, hold=hold)
    return Case(name, num_envs, step, options.get("noise", "bank"), error)


def _copies(count: int, size: int, seed: int) -> Iterator[Case]:
    options = {"scenes": SCENES, "resolution": size, **CACHED}
    for make, where in (
        (in_subprocesses, "in subprocesses (AsyncVectorEnv)"),
        (in_one_process, "in one process (SyncVectorEnv)"),
    ):
        envs = make(ID, count, options)
        error = largest_difference(envs, size, seed, CACHED)
        case = Case(f"copies {where}, cached scene", count, stepper(envs, seed), error=error)
        if make is in_subprocesses:
            case.memory, case.close = memory_of_children(), envs.close
        yield case


def stepper(envs: gym.vector.VectorEnv, seed: int, *, hold: bool = False) -> Callable[[], Any]:
    """A step of `envs` with random actions, or with the same ones again and again."""
    envs.reset(seed=seed)
    rng = np.random.default_rng(seed)
    held = rng.integers(64, size=envs.num_envs)
    if hold:
        return lambda: envs.step(held)
    return lambda: envs.step(rng.integers(64, size=envs.num_envs))


def largest_difference(
    envs: gym.vector.VectorEnv, size: int, seed: int, options: dict[str, Any]
) -> int:
    """Largest difference of a code between the last environment and the same episode alone."""
    last = envs.num_envs - 1
    alone = gym.make(ID, scenes=SCENES, resolution=size, **options)
    pairs = [(envs.reset(seed=seed)[0], alone.reset(seed=seed + last)[0])]
    for action in (0, 21, 42, 63):
        actions = np.full(envs.num_envs, action)
        pairs.append((envs.step(actions)[0], alone.step(action)[0]))
    return max(
        int(np.abs(many["raw"][last].astype(int) - one["raw"].astype(int)).max())
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


def _rows(cases: Sequence[Case], threads: int, size: int) -> list[dict[str, Any]]:
    limits = {case.name: case.seconds for case in cases}

    def ratio(case: Case, limit: str) -> float:
        pairs = zip(limits[limit], case.seconds, strict=True)
        return statistics.median(least / own for least, own in pairs)

    rows = []
    for case in cases:
        low, middle, high = np.quantile(case.seconds, (0.25, 0.5, 0.75))
        rows.append(
            {
                "case": case.name,
                "num_envs": case.num_envs,
                "steps_per_second": 1.0 / middle,
                "ratio_to_kernel": ratio(case, KERNEL[case.noise]),
                "ratio_to_lookup": ratio(case, LOOKUP),
                "spread": (high - low) / middle,
                "error_codes": case.error,
                "memory_mib": case.memory,
                "size": size,
                "threads": threads,
            }
        )
    return rows
