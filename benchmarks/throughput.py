"""Steps per second of the environment against what the machine could do, and where the time goes.

    ae-env bench throughput

Two limits are measured in the same run, frame for frame of the same size:

* kernel: a bare torch loop of multiply, fresh normals, add, clip, quantise and encode. No scene, no
  blur, no score, no info.
* lookup: copying observations that were worked out beforehand.

Everything runs on one torch thread, alternating between the cases, round after round.
"""

from __future__ import annotations

import functools
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import ae_env.core
from ae_env.observation import PEDESTAL
from simulator.files import write_atomically
from simulator.results import result_meta, write_results

ID = "ae_env/AutoExposure-v0"
SCENES = "bundled:small"
#: What the profile times: the functions of each part, as they are called inside the core.
PARTS: dict[str, list[tuple[Any, str]]] = {
    "light and blur": [(ae_env.core.EpisodeCore, "_sensor_light")],
    "noise": [(ae_env.core, "add_noise"), (ae_env.core, "noise_generator")],
    "clip and quantise": [(ae_env.core, "clip_and_quantise")],
    "encode": [(ae_env.core, "encode_observation")],
    "scores": [
        (ae_env.core.EpisodeCore, "_part_scores"),
        (ae_env.core.EpisodeCore, "_scores"),
    ],
    "info": [
        (ae_env.core, "_share"),
        (ae_env.core, "_normals"),
        (ae_env.core.EpisodeCore, "_info"),
    ],
}


@dataclass
class Case:
    """One thing to time: `step` makes `num_envs` frames."""

    name: str
    num_envs: int
    size: int
    step: Callable[[], Any]
    error: int | None = None
    seconds: list[float] = field(default_factory=list)  # per frame, one for each round


def run(out: Path, seed: int = 0, quick: bool = False) -> None:
    """Measures and writes ``throughput.json`` and ``throughput.md`` under `out`."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        rounds, frames = (3, 64) if quick else (9, 512)
        cases = list(_cases(seed, quick))
        _measure(cases, rounds, frames)
        profile = _profile(seed, frames=frames if quick else 4 * frames)
        meta = result_meta(f"ae-env bench throughput{' --quick' * quick}", seed)
    finally:
        torch.set_num_threads(threads)
    rows = _rows(cases)
    meta |= {"rounds": rounds, "frames_per_round": frames, "profile": profile, "scenes": SCENES}
    write_results(out / "throughput.json", rows, meta)
    write_atomically(out / "throughput.md", _markdown(rows, meta))


# -- the cases ------------------------------------------------------------------------------------


def _cases(seed: int, quick: bool) -> Iterator[Case]:
    sizes = (128, 64)
    for size in sizes:
        yield Case("kernel", 64, size, _kernel(64, size, seed))
        yield Case("lookup", 64, size, _lookup(64, size, seed))
        for num_envs in (1, 8, 64):
            step, error = _native(num_envs, size, seed)
            yield Case("vector env", num_envs, size, step, error)
        step, error = _native(64, size, seed, hold=True)
        yield Case("vector env, each agent holds its state", 64, size, step, error)
        if size == 64 or not quick:
            count = 8 if quick else 64
            step = _sync(count, size, seed)
            yield Case("SyncVectorEnv of single environments", count, size, step)


def _native(
    num_envs: int, size: int, seed: int, *, hold: bool = False
) -> tuple[Callable[[], Any], int]:
    envs = gym.make_vec(
        ID, num_envs=num_envs, scenes=SCENES, resolution=size, autoreset_mode="SAME_STEP"
    )
    core = envs.unwrapped.core  # type: ignore[attr-defined]
    for scene in core.scenes:
        core.tables.closed_parts(scene)  # worked out once per scene, not part of a step
    error = _largest_difference(envs, size, seed)
    envs.reset(seed=seed)
    rng = np.random.default_rng(seed)
    held = rng.integers(64, size=num_envs)
    if hold:
        return lambda: envs.step(held), error
    return lambda: envs.step(rng.integers(64, size=num_envs)), error


def _largest_difference(envs: gym.vector.VectorEnv, size: int, seed: int) -> int:
    """Largest difference of a code between the last environment and the same episode alone."""
    last = envs.num_envs - 1
    alone = gym.make(ID, scenes=SCENES, resolution=size)
    pairs = [(envs.reset(seed=seed)[0], alone.reset(seed=seed + last)[0])]
    for action in (0, 21, 42, 63):
        actions = np.full(envs.num_envs, action)
        pairs.append((envs.step(actions)[0], alone.step(action)[0]))
    return max(
        int(np.abs(many["raw"][last].astype(int) - one["raw"].astype(int)).max())
        for many, one in pairs
    )


def _sync(num_envs: int, size: int, seed: int) -> Callable[[], Any]:
    make = functools.partial(gym.make, ID, scenes=SCENES, resolution=size)
    envs = SyncVectorEnv([make] * num_envs, autoreset_mode=AutoresetMode.SAME_STEP)
    for env in envs.envs:  # type: ignore[attr-defined]
        core = env.unwrapped.core  # type: ignore[attr-defined]
        for scene in core.scenes:
            core.tables.closed_parts(scene)
    envs.reset(seed=seed)
    rng = np.random.default_rng(seed)
    return lambda: envs.step(rng.integers(64, size=num_envs))


def _kernel(num_envs: int, size: int, seed: int) -> Callable[[], Any]:
    generator = torch.Generator().manual_seed(seed)
    light = torch.rand(num_envs, 4, size, size, generator=generator)
    ratios = np.random.default_rng(seed).uniform(0.1, 2.0, num_envs).tolist()
    span, black, white = 14_512.0, 1_008.0, 15_520.0
    frame = torch.empty(4, size, size)

    def step() -> np.ndarray:
        codes = np.empty(light.shape, np.uint8)
        for i, ratio in enumerate(ratios):
            frame.normal_(generator=generator).mul_(0.01).add_(light[i], alpha=ratio)
            frame.mul_(span).add_(black).round_().clamp_(0.0, white).sub_(black).div_(span)
            frame.clamp_(-PEDESTAL, 1.0).add_(PEDESTAL).div_(1.0 + PEDESTAL)
            torch.from_numpy(codes[i]).copy_(frame.sqrt_().mul_(255.0).round_())
        return codes

    return step


def _lookup(num_envs: int, size: int, seed: int) -> Callable[[], Any]:
    rng = np.random.default_rng(seed)
    known = rng.integers(256, size=(512, 4, size, size), dtype=np.uint8)
    return lambda: known[rng.integers(len(known), size=num_envs)]


# -- measuring ------------------------------------------------------------------------------------


def _measure(cases: Sequence[Case], rounds: int, frames: int) -> None:
    for i in range(rounds + 1):  # the first round only warms up
        for case in cases:
            steps = max(1, frames // case.num_envs)
            start = time.perf_counter()
            for _ in range(steps):
                case.step()
            if i:
                elapsed = time.perf_counter() - start
                case.seconds.append(elapsed / (steps * case.num_envs))


def _rows(cases: Sequence[Case]) -> list[dict[str, Any]]:
    limits = {(c.name, c.size): c.seconds for c in cases if c.name in ("kernel", "lookup")}
    rows = []
    for case in cases:
        ratios = {
            name: statistics.median(
                limit / own
                for limit, own in zip(limits[name, case.size], case.seconds, strict=True)
            )
            for name in ("kernel", "lookup")
        }
        low, high = np.quantile(case.seconds, (0.25, 0.75))
        rows.append(
            {
                "case": f"{case.name}, {case.size} x {case.size}",
                "num_envs": case.num_envs,
                "steps_per_second": 1.0 / statistics.median(case.seconds),
                "ratio_to_kernel": ratios["kernel"],
                "ratio_to_lookup": ratios["lookup"],
                "spread": (high - low) / statistics.median(case.seconds),
                "error_codes": case.error,
            }
        )
    return rows


@contextmanager
def _timers() -> Iterator[dict[str, float]]:
    """Seconds spent in each of `PARTS` while it is open."""
    spent = dict.fromkeys(PARTS, 0.0)

    def timed(part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                spent[part] += time.perf_counter() - start

        return call

    patches = [
        mock.patch.object(owner, name, timed(part, getattr(owner, name)))
        for part, functions in PARTS.items()
        for owner, name in functions
    ]
    for patch in patches:
        patch.start()
    try:
        yield spent
    finally:
        for patch in patches:
            patch.stop()


def _profile(seed: int, frames: int) -> list[dict[str, Any]]:
    """Share of each part in the time of a step of 64 environments at 128 x 128."""
    step, _ = _native(64, 128, seed)
    step()
    steps = max(8, frames // 64)
    with _timers() as spent:
        start = time.perf_counter()
        for _ in range(steps):
            step()
        total = time.perf_counter() - start
    spent["resets, bookkeeping and the rest"] = total - sum(spent.values())
    return [
        {
            "part": part,
            "share": seconds / total,
            "microseconds_per_step": seconds / (64 * steps) * 1e6,
        }
        for part, seconds in spent.items()
    ]


# -- the page -------------------------------------------------------------------------------------


def _markdown(rows: list[dict[str, Any]], meta: dict[str, Any]) -> str:
    machine = meta["machine"]
    lines = [
        "# Throughput",
        "",
        f"`{meta['command']}`, {machine['cpu']}, one torch thread, {meta['date'][:10]}. Frames are "
        "packed raws of four planes, companded to uint8. Median of "
        f"{meta['rounds']} rounds of {meta['frames_per_round']} frames; the spread is the distance "
        "between the quartiles. The error is the largest difference of a code between an episode "
        "in the batch and the same episode alone.",
        "",
        "*Kernel*: a bare torch loop of multiply, fresh normals, clip, quantise and encode for as "
        "many pixels. *Lookup*: copying observations that were worked out beforehand. Actions are "
        "random, so that most frames need a blur of their own; an agent that holds its state saves "
        "it.",
        "",
        "| case | environments | steps/s | of kernel | of lookup | spread | error [codes] |",
        "|---|--:|--:|--:|--:|--:|--:|",
    ]
    for row in rows:
        error = "" if row["error_codes"] is None else str(row["error_codes"])
        lines.append(
            f"| {row['case']} | {row['num_envs']} | {row['steps_per_second']:,.0f} "
            f"| {row['ratio_to_kernel']:.2f} | {row['ratio_to_lookup']:.3f} "
            f"| {row['spread']:.0%} | {error} |"
        )
    lines += [
        "",
        "## Where the time goes",
        "",
        "64 environments, 128 x 128, random actions.",
        "",
        "| part | share | per step [µs] |",
        "|---|--:|--:|",
    ]
    lines += [
        f"| {p['part']} | {p['share']:.0%} | {p['microseconds_per_step']:.0f} |"
        for p in meta["profile"]
    ]
    return "\n".join(lines) + "\n"
