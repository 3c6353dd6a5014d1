"""Runs that last: constant memory, no file left open, the same frames again, in any process.

And trainings that are killed and end with the weights of one that was not.
"""

from __future__ import annotations

import functools
import gc
import hashlib
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch

import ae_env
from benchmarks.isolated import ROOT, isolated
from benchmarks.stability.case import Row

GROUP = "long runs"
STEPS, RESETS = 100_000, 1_000
#: Memory that may be added once everything was in use once [MiB].
_GROWTH_MIB = 16.0
_FILES = 6
#: Frames of a training that is killed, and seconds from a checkpoint to the kill.
_FRAMES, _DELAY = 1024, (0.1, 1.0)


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """The cases of this group."""
    steps, resets = (2_000, 20) if quick else (STEPS, RESETS)
    yield _rollout(steps, resets, seed)
    for method in ("spawn", "forkserver"):
        if method in multiprocessing.get_all_start_methods():
            yield _workers(2 if quick else 8, method, seed)
    signals = (signal.SIGKILL,) if quick else (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
    for agent in ("regression",) if quick else ("regression", "ppo"):
        yield _killed(agent, signals, seed)


def _rollout(steps: int, resets: int, seed: int) -> Row:
    run = functools.partial(
        isolated, roll_out, num_threads=1, steps=steps, resets=resets, seed=seed, timeout=7200.0
    )
    with ThreadPoolExecutor(2) as pool:  # both at once, each in a process of its own
        runs = [future.result() for future in [pool.submit(run) for _ in range(2)]]
    same = runs[0]["hash"] == runs[1]["hash"]
    files = max(run["files"] for run in runs)
    growth = max(run["growth_mib"] for run in runs)
    return Row(
        GROUP,
        f"{steps:,} steps and {resets:,} resets, scenes from files, twice",
        max(growth, 0.0),
        error="MiB more",
        limit=_GROWTH_MIB,
        dtype="",
        finite=same and files <= 0,
        note=f"{'the same' if same else 'other'} frames again, {max(files, 0)} files left open",
    )


def roll_out(steps: int, resets: int, seed: int) -> dict[str, Any]:
    """One environment on raw files: hash of all it shows, files and memory that are left."""
    with tempfile.TemporaryDirectory() as folder:
        _write_raws(Path(folder))
        env = gym.make("ae_env/AutoExposure-v0", scenes=folder, split="all", max_episode_steps=None)
        digest, rng = hashlib.sha256(), np.random.default_rng(seed)
        env.action_space.seed(seed)
        every, warm, files, memory = steps // resets, steps // 5, 0, 0.0
        for step in range(steps):
            if step % every == 0:
                observation, _ = env.reset(seed=seed if step == 0 else None)
            if step == warm:
                gc.collect()
                files, memory = _open_files(), _memory_mib()
            observation, reward, *_ = env.step(rng.integers(64))
            digest.update(observation["raw"].data)
            digest.update(np.float64(reward).tobytes())
        gc.collect()
        return {
            "hash": digest.hexdigest(),
            "files": _open_files() - files,
            "growth_mib": _memory_mib() - memory,
        }


def _write_raws(folder: Path) -> None:
    from simulator import CameraSettings, RawImage, get_camera, write_dng

    for number in range(_FILES):
        generator = torch.Generator().manual_seed(number)
        coarse = torch.rand(1, 4, 10, 10, generator=generator)
        data = torch.nn.functional.interpolate(coarse, size=(80, 80), mode="bilinear")[0]
        settings = CameraSettings(400.0 * 2 ** (number % 3), 1 / 60, 4.0)
        write_dng(folder / f"{number}.dng", RawImage(data, settings, camera=get_camera("nikon_z6")))


def _open_files() -> int:
    try:
        return len(os.listdir("/proc/self/fd"))
    except OSError:
        return 0  # a system that does not tell


def _memory_mib() -> float:
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def _workers(count: int, method: str, seed: int) -> Row:
    """Processes against the same environments in one."""
    here = gym.make_vec(
        "ae_env/AutoExposure-v0", num_envs=count, scenes="bundled:small", max_episode_steps=4
    )
    threads = torch.get_num_threads()
    multiprocessing.set_forkserver_preload(["gymnasium", "torch", __name__])
    apart = gym.vector.AsyncVectorEnv([_make_one] * count, context=method)
    different, rng = 0, np.random.default_rng(seed)
    try:
        pairs = [(here.reset(seed=seed)[0], apart.reset(seed=seed)[0])]
        for _ in range(12):
            actions = rng.integers(64, size=count)
            pairs.append((here.step(actions)[0], apart.step(actions)[0]))
        different = sum(int((one["raw"] != other["raw"]).sum()) for one, other in pairs)
    finally:
        apart.close()
        here.close()
        torch.set_num_threads(threads)
    return Row(
        GROUP,
        f"{count} workers by {method}",
        float(different),
        error="codes that differ",
        limit=0.0,
        dtype="uint8",
    )


def _make_one() -> gym.Env:
    """What a worker runs; it takes one thread."""
    torch.set_num_threads(1)
    ae_env.register_envs()
    return gym.make("ae_env/AutoExposure-v0", scenes="bundled:small", max_episode_steps=4)


def _killed(agent: str, signals: Sequence[int], seed: int) -> Row:
    """A training that is killed at random moments and resumed, against one that is not."""
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as name:
        out, whole = Path(name) / "killed", _start(agent, Path(name) / "whole")
        file, killed = out.with_suffix(".checkpoint"), 0
        for number in signals:
            process, before = _start(agent, out), _changed(file)
            while process.poll() is None and _changed(file) == before:
                time.sleep(0.02)
            time.sleep(rng.uniform(*_DELAY))
            process.send_signal(number)
            process.communicate()
            killed += process.returncode != 0
        last = _start(agent, out)
        results = [_result(process.communicate()[0]) for process in (whole, last)]
        failed = whole.returncode or last.returncode
    (expected, _), (found, step) = results
    names = ", ".join(signal.Signals(number).name for number in signals)
    return Row(
        GROUP,
        f"{agent} training, killed by {names} and resumed",
        float(found != expected),
        error="weights that differ",
        limit=0.0,
        finite=not failed and killed == len(signals) and step > 0,
        note=f"ended by {killed} of {len(signals)} signals, a checkpoint after every step; the "
        f"last run went on at step {step}",
    )


def _result(printed: str) -> tuple[str, int]:
    """Hash and step that `train` returned; those of nothing where it failed."""
    try:
        result = json.loads(printed.strip().splitlines()[-1])
    except (IndexError, ValueError):
        return "", 0
    return result["hash"], result["step"]


def _changed(file: Path) -> int:
    try:
        return file.stat().st_mtime_ns
    except FileNotFoundError:
        return 0


def _start(agent: str, out: Path) -> subprocess.Popen[str]:
    task = f"{train.__module__}:{train.__qualname__}"
    arguments = json.dumps({"agent": agent, "out": str(out)})
    return subprocess.Popen(
        [sys.executable, "-m", "benchmarks.isolated", task, arguments],
        cwd=ROOT,
        env=os.environ | {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )


def train(agent: str, out: str) -> dict[str, Any]:
    """Trains an agent with a checkpoint after every step.

    Returns:
        Hash of its weights, and the step that it was resumed at, 0 where it was not.
    """
    import agents.learning.ppo
    import agents.learning.regression_training
    from agents.learning.training import AgentConfig, train_agent
    from simulator.utils.checkpoint import Checkpoint

    # What runs in the background of a shell ignores interrupts.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    steps: list[int] = []

    class Often(Checkpoint):
        def save(self, step: int, *, force: bool = False) -> None:
            if step > steps[-1]:  # a kill after it comes after some learning
                super().save(step, force=True)

        def restore(self) -> int:
            steps.append(super().restore())
            return steps[-1]

    agents.learning.ppo.Checkpoint = agents.learning.regression_training.Checkpoint = Often  # type: ignore[misc]
    training: dict[str, dict[str, Any]] = {
        "regression": {"frames": _FRAMES, "width": 16},
        "ppo": {"total_timesteps": _FRAMES, "n_steps": 8, "batch_size": 64, "width": 16},
    }
    config = AgentConfig(
        agent=agent,  # type: ignore[arg-type]
        num_envs=8,
        environment={"scenes": "bundled:small", "resolution": 36},
        training=training[agent],
    )
    path = train_agent(config, Path(out)).with_suffix(".safetensors")
    return {"hash": hashlib.sha256(path.read_bytes()).hexdigest(), "step": max(steps, default=0)}
