"""Environment steps per second beside the kernel limit; resets; the first episode of all."""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode

import ae_env  # noqa: F401  registers the environment
from ae_env.scorers import Captures
from agents.learning.ppo import PPOTraining, train_ppo
from benchmarks.harness import Row, quartiles
from benchmarks.isolated import CORES, timed
from benchmarks.throughput.kernel_limit import KernelLimit
from simulator.utils.cache import CACHE_VARIABLE

ID = "ae_env/AutoExposure-v0"
#: Neither motion nor defocus: every frame is exposed from the scene's own light.
CACHED: dict[str, Any] = {"motion": "none", "depth": "far"}
SCENES = "bundled:small"
#: Rounds, and seconds that a case takes in each.
QUICK, FULL = (3, 0.08), (9, 0.3)
#: Numbers of environments, kinds of light, and numbers of threads, which take turns.
COUNTS, LIGHTS, THREADS = (1, 8, 64, 512), ("sine", "flicker"), tuple(dict.fromkeys((1, CORES)))
#: Names of the limits that others are compared with.
KERNEL = {"bank": "fused kernel, noise bank", "exact": "fused kernel, exact noise"}


class LiveScore:
    """Well-exposedness of the recorded pixels (Mertens 2007), in encoded light.

    It is timed alone on `recorded` frames: torch's square root takes longer for their zeros.
    """

    domain = "raw"

    def __call__(self, images: torch.Tensor, captures: Captures | None) -> torch.Tensor:
        """Scores (B,) of `images` (B, 4, H, W)."""
        return ((images.sqrt() - 0.5) ** 2 / (-2 * 0.2**2)).exp().mean(dim=(1, 2, 3))


def recorded(num_envs: int, **make: Any) -> torch.Tensor:
    """(N, 4, H, W) frames of environments at random states, as a scorer gets them."""
    envs = gym.make_vec(
        ID, num_envs=num_envs, scenes=SCENES, **CACHED, observation="linear", **make
    )
    envs.reset(seed=0)
    observation, *_ = envs.step(np.random.default_rng(0).integers(64, size=num_envs))
    return torch.from_numpy(observation["raw"]).clamp(min=0.0)


def warm_environments(num_envs: int, make: dict[str, Any], seed: int = 0) -> Any:
    """One environment, or a batch of them, after all that is computed once for a scene."""
    many = num_envs > 1
    envs: Any = gym.make_vec(ID, num_envs=num_envs, **make) if many else gym.make(ID, **make)
    scenes = len(envs.unwrapped.scenes)
    for first in range(0, scenes, num_envs):
        chosen = [(first + i) % scenes for i in range(num_envs)]
        envs.reset(seed=seed, options={"scene": chosen if many else first})
    return envs


@dataclass
class Case:
    """One thing to time: `step` makes `num_envs` frames; `noise` names its kernel limit.

    `seconds` are the times per frame by `threads`, one for each round.
    """

    name: str
    num_envs: int
    step: Callable[[], Any]
    noise: str = "bank"
    threads: tuple[int, ...] = THREADS
    seconds: dict[int, list[float]] = field(default_factory=lambda: defaultdict(list))


def measure_steps(size: int, seed: int, quick: bool) -> list[Row]:
    torch.set_num_threads(1)  # while children are forked: threads would not come along
    cases = [_copies(8 if quick else 64, size, seed)]
    torch.set_num_threads(CORES)
    scenes: Any = gym.make(ID, scenes=SCENES, resolution=size).unwrapped
    lights = np.stack([scene.light.numpy() for scene in scenes.scenes])
    for noise, name in KERNEL.items():
        kernel = KernelLimit(lights, 64, noise=noise, seed=seed)
        cases.append(Case(name, 64, kernel.step, noise))
    images = recorded(64, resolution=size)
    cases.append(Case("a torch scorer alone", 64, partial(LiveScore(), images, None)))
    cases += _cases(size, seed)
    if size == 64 and not quick:
        cases.append(_ppo(seed))
    _measure(cases, *(QUICK if quick else FULL))
    return [row | {"size": size} for threads in THREADS[::-1] for row in _rows(cases, threads)]


# -- the cases ------------------------------------------------------------------------------------


def _cases(size: int, seed: int) -> Iterator[Case]:
    """Cases of the environment itself, by compiled loops and by torch on each device."""
    live, many, rest = {"scorer": f"{__name__}:LiveScore"}, "vector env", "cached scene"
    moved = "motion and defocus"
    cases: list[tuple[str, int, dict[str, Any]]] = [
        (f"{many}, {rest}, torch scorer", 64, CACHED | live),
        (f"{many}, {rest}, exact noise", 64, CACHED | {"noise": "exact"}),
        (f"{many}, {rest}, linear", 64, CACHED | {"observation": "linear"}),
        *((f"{many}, {moved}, {kind} light", 64, {"lighting": kind}) for kind in LIGHTS),
    ]
    for count in COUNTS:
        name = many if count > 1 else "one environment"
        cases += [(f"{name}, {rest}", count, CACHED), (f"{name}, {moved}", count, {})]
    for device in ("cpu", *["cuda"] * torch.cuda.is_available()):
        for count, own in product((64, 4096) if device == "cuda" else (64,), (CACHED, {})):
            kind = rest if own else moved
            cases.append((f"{many}, {kind}, torch on {device}", count, own | {"device": device}))
    for name, count, options in cases:
        make: dict[str, Any] = {"scenes": SCENES, "resolution": size} | options
        make |= {"autoreset_mode": "SAME_STEP"} if count > 1 else {}
        envs = warm_environments(count, make, seed)
        yield Case(name, count, _stepper(envs, seed), make.get("noise", "bank"))


def _ppo(seed: int) -> Case:
    """PPO's whole loop in the environment that it has by default."""
    envs = warm_environments(64, {"scenes": SCENES, "autoreset_mode": "SAME_STEP"}, seed)
    train = partial(train_ppo, envs, PPOTraining(total_timesteps=1024))
    return Case("PPO, motion and defocus", 1024, train, threads=(CORES,))


def _copies(count: int, size: int, seed: int) -> Case:
    """Forks of the single environment: no thread may have been started before."""
    options: dict[str, Any] = {"scenes": SCENES, "resolution": size, **CACHED}
    warm_environments(1, options).close()
    copies, mode = [partial(warm_environments, 1, options)] * count, AutoresetMode.SAME_STEP
    envs = AsyncVectorEnv(copies, context="fork", autoreset_mode=mode)  # on one thread each
    name, step = "copies in subprocesses, cached scene", _stepper(envs, seed)
    return Case(name, count, step, threads=(CORES,))


def _stepper(envs: Any, seed: int) -> Callable[[], Any]:
    """A step of `envs` with random actions; a single one is reset where its episode ends."""
    envs.reset(seed=seed)
    rng, count = np.random.default_rng(seed), getattr(envs, "num_envs", None)

    def step() -> None:
        if envs.step(rng.integers(64, size=count))[3] is True:
            envs.reset()

    return step


# -- measuring ------------------------------------------------------------------------------------


def _measure(cases: list[Case], rounds: int, slice_seconds: float) -> None:
    """Case after case, round after round; the first round warms up and sets the repeats."""
    turns = [(case, threads) for case in cases for threads in case.threads]
    repeats = [1] * len(turns)
    for i in range(rounds + 1):
        for k, (case, threads) in enumerate(turns):
            torch.set_num_threads(threads)
            start = time.perf_counter()
            for _ in range(repeats[k]):
                case.step()
            elapsed = time.perf_counter() - start
            if i:
                case.seconds[threads].append(elapsed / (repeats[k] * case.num_envs))
            else:  # warm now; whole episodes, so that resets have their share
                repeats[k] = 8 * max(1, round(slice_seconds / timed(case.step) / 8))


def _rows(cases: list[Case], threads: int) -> list[Row]:
    limits, rows = {case.name: case.seconds for case in cases}, []
    for case in cases:
        if threads in case.threads:
            low, middle, high = quartiles(own := np.array(case.seconds[threads]))
            row: Row = {"case": case.name, "num_envs": case.num_envs, "threads": threads}
            row |= {"steps_per_second": 1.0 / middle, "spread": (high - low) / middle}
            row["ratio_to_kernel"] = float(np.median(limits[KERNEL[case.noise]][threads] / own))
            if case.threads[0] < threads:
                row["of_one_thread"] = float(np.median(case.seconds[1] / own))
            rows.append(row)
    return rows


# -- resets: with 8 frames an episode, one frame in nine -------------------------------------------

#: Environments, episodes that warm up after each scene has been seen, and episodes that are timed.
RESETS, QUICK_RESETS = ((1, 500, 400), (64, 100, 100)), ((1, 20, 20), (64, 5, 5))


def measure_resets(seed: int, quick: bool) -> list[Row]:
    rows = []
    for num_envs, warm, number in QUICK_RESETS if quick else RESETS:
        envs = warm_environments(num_envs, {"max_episode_steps": None}, seed).unwrapped
        rng, resets, steps = np.random.default_rng(seed), [], []
        for _ in range(warm):
            envs.reset()
        for _ in range(number):
            resets.append(timed(envs.reset))
            for _ in range(8):
                actions = rng.integers(64, size=num_envs if num_envs > 1 else None)
                steps.append(timed(partial(envs.step, actions)))
        (low, reset, high), (_, step, _) = quartiles(resets), quartiles(steps)
        row: Row = {"case": "vector env" if num_envs > 1 else "one environment"}
        row |= {"num_envs": num_envs, "reset_ms": reset * 1e3, "step_ms": step * 1e3}
        row |= {"ratio": reset / step, "spread": (high - low) / reset}
        rows.append(row | {"ratio_of_means": float(np.mean(resets) / np.mean(steps))})
    return rows


# -- the first episode ----------------------------------------------------------------------------

#: Cases, and how often each is measured, quick and in full.
CASES, REPEATS = ("nothing cached", "all but scenes cached"), (1, 5)
#: The times of a row, in seconds; the last are more episodes, in which motion comes up.
TIMES = ("import", "make", "reset", "step", "episodes")
_PROGRAM = f"""
import json, time
times = [time.perf_counter()]
def lap(): times.append(time.perf_counter())
import gymnasium, ae_env
lap()
env = gymnasium.make({ID!r})
lap()
env.reset(seed=0)
lap()
env.step(0)
lap()
cpu = time.process_time()
for episode in range(8):
    env.reset()
    for action in range(0, 64, 8):
        env.step(action)
lap()
print(json.dumps([after - before for before, after in zip(times, times[1:])] + [cpu]))
"""


def measure_cold_start(quick: bool) -> list[Row]:
    """A row for each of `CASES`: medians of the `TIMES` of fresh processes, and of their sum."""
    found: dict[str, list[list[float]]] = {case: [] for case in CASES}
    for _ in range(REPEATS[not quick]):
        with tempfile.TemporaryDirectory() as folder:
            caches = {"NUMBA_CACHE_DIR": f"{folder}/kernels", CACHE_VARIABLE: f"{folder}/cache"}
            for case in CASES:
                output = subprocess.check_output(
                    [sys.executable, "-c", _PROGRAM], env=os.environ | caches
                )
                found[case].append(json.loads(output.splitlines()[-1]))
    rows = []
    for case, runs in found.items():
        low, middle, high = quartiles([sum(run[:4]) for run in runs])
        row: Row = {"case": case, "threads": CORES, "total_s": middle}
        for name, values in zip((*TIMES, "cpu"), zip(*runs, strict=True), strict=True):
            row[f"{name}_s"] = statistics.median(values)
        rows.append(row | {"spread": (high - low) / middle})
    return rows
