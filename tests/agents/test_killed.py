"""Trainings that are killed go on from their last checkpoint."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from simulator.utils import checkpoint
from simulator.utils.checkpoint import Checkpoint, load_checkpoint
from simulator.utils.files import sibling
from tests.agents.conftest import TINY

#: Signals in turn; each interrupts a process in another way.
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
#: Steps that each training takes in all, and reports between two of its checkpoints.
STEPS = {"regression": 30, "ppo": 48, "simulator": 30}
PER_CHECKPOINT = {"regression": 1, "ppo": 4, "simulator": 1}
TRAININGS: dict[str, dict[str, Any]] = {
    "regression": {"frames": 120, "width": 8, "memory": 40},
    "ppo": {"total_timesteps": 192, "n_steps": 4, "batch_size": 8, "n_epochs": 2, "width": 8},
}


def train_agent(kind: str, out: Path, pipe: Connection) -> None:
    from agents.learning.training import AgentConfig
    from agents.learning.training import train_agent as train

    config = AgentConfig(
        agent=kind,  # type: ignore[arg-type]
        num_envs=4,
        environment={**TINY, "lighting": "sine", "delay": 1},
        training=TRAININGS[kind],
    )
    train(config, out, progress=lambda done, *_: pipe.send(("step", done // 4)))


def train_simulator(out: Path, pipe: Connection) -> None:
    from simulator.training import train
    from tests.simulator.training.test_train import config, scenes

    stage = {"steps": 10, "batch": 2, "crop": 16}
    stages = ("exposure", "noise", "aperture")
    train._LOG_EVERY = 1

    def report(task: str, share: float, values: dict[str, float]) -> None:
        name, _, what = task.partition(": ")
        if what == "training":
            pipe.send(("step", round(10 * (stages.index(name) + share))))

    config = config(**dict.fromkeys(stages, stage))
    train.train_and_save(config, scenes, out, command="", progress=report)


def child(kind: str, out: Path, pipe: Connection) -> None:
    """Runs in the process that is killed; a checkpoint is written whenever one may be."""
    logging.basicConfig(level=logging.WARNING)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background ignores it
    torch.set_num_threads(1)
    checkpoint.INTERVAL = -1.0
    load = Checkpoint.load

    def reported(self: Checkpoint) -> dict[str, Any] | None:
        state = load(self)
        if state is not None:
            pipe.send(("resumed", int(state.get("step", state.get("timesteps", 0)))))
        return state

    Checkpoint.load = reported  # type: ignore[method-assign]
    if kind == "simulator":
        train_simulator(out, pipe)
    else:
        train_agent(kind, out, pipe)


def run(
    context: Any, kind: str, out: Path, *, kill: tuple[int, float, int] | None
) -> tuple[int, list[int], list[int]]:
    """Runs a training, killed `kill[1]` seconds after `kill[0]` reports.

    Returns:
        Exit code, the steps it resumed at, and the steps it took.
    """
    here, there = context.Pipe()
    process = context.Process(target=child, args=(kind, out, there), daemon=True)
    process.start()
    there.close()
    resumed: list[int] = []
    steps: list[int] = []
    try:
        while True:
            word, step = here.recv()
            (resumed if word == "resumed" else steps).append(step)
            if kill is not None and len(steps) == kill[0]:
                time.sleep(kill[1])
                os.kill(process.pid, kill[2])
                kill = None
    except EOFError:  # it has ended
        pass
    process.join(60)
    assert process.exitcode is not None
    return process.exitcode, resumed, steps


@pytest.fixture(scope="module")
def context() -> Any:
    """Processes from a server that has imported everything, and never computed anything."""
    if "forkserver" not in multiprocessing.get_all_start_methods():
        pytest.skip("needs POSIX signals")
    found = multiprocessing.get_context("forkserver")
    used = ("agents.cli.main", "agents.learning.ppo", "agents.learning.training", "torch._dynamo")
    tests = ("tests.simulator.training.test_train", "tests.agents.test_killed")
    found.set_forkserver_preload([*used, "ae_env.vector_env", *tests])
    return found


@pytest.mark.parametrize("kind", ["regression", "ppo", "simulator"])
def test_killed_at_random_moments(kind: str, context: Any, tmp_path: Path) -> None:
    """Three kills; every run goes on where the one before was, and the last one ends."""
    out, rng = tmp_path / "net", np.random.default_rng(len(kind))
    last = 0
    for number in (*SIGNALS, None):
        kill = None
        if number is not None:
            count = int(rng.integers(PER_CHECKPOINT[kind] + 2, STEPS[kind] // 4))
            kill = count, float(rng.uniform(0, 0.02)), number
        code, resumed, steps = run(context, kind, out, kill=kill)
        # It goes on at the last checkpoint, which is no older than the last report but one.
        assert steps == list(range(steps[0], steps[-1] + 1))
        assert last - PER_CHECKPOINT[kind] <= steps[0] - 1 <= last + PER_CHECKPOINT[kind]
        assert bool(resumed) == (last > 0)
        last = steps[-1]
        if number is None:
            assert code == 0
        else:
            assert code == (1 if number == signal.SIGINT else -number)
            for file in out.parent.glob("*.checkpoint"):
                assert load_checkpoint(file) is not None  # whole, whenever the kill came
    assert last == STEPS[kind]
    assert all(
        tensor.isfinite().all() for tensor in load_file(sibling(out, ".safetensors")).values()
    )


def command(folder: Path, started: Any) -> None:
    """Runs as `ae-env train` in the process that is stopped, between its steps 3 and 4."""
    from agents.cli.main import main

    signal.signal(signal.SIGINT, signal.default_int_handler)
    calls: list[int] = []

    def wait(self: Checkpoint) -> None:  # the first checkpoint would be due after 20 seconds
        calls.append(1)
        if len(calls) == 3:
            started.set()
            time.sleep(60)

    Checkpoint.save_when_due = wait  # type: ignore[method-assign]
    torch.set_num_threads(1)
    words = os.open(folder / "words", os.O_WRONLY | os.O_CREAT)
    os.dup2(words, 2)
    sys.stderr = os.fdopen(2, "w", buffering=1)
    sys.argv = ["ae-env", "train", str(folder / "mine.yaml"), "--out", str(folder / "agent")]
    main()


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_stopped_command(number: int, status: int, context: Any, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(
        "{agent: regression, num_envs: 4, environment: {scenes: 'bundled:small', resolution: 36},"
        " training: {frames: 1000000, width: 8}}"
    )
    started = context.Event()
    process = context.Process(target=command, args=(tmp_path, started), daemon=True)
    process.start()
    assert started.wait(120)
    os.kill(process.pid, number)
    process.join(60)
    assert process.exitcode == status
    assert "stopped; run the same command again to continue" in (tmp_path / "words").read_text()
    left = {path.name for path in tmp_path.iterdir()} - {"mine.yaml", "words"}
    assert left == {"agent.checkpoint"}
    stored = load_checkpoint(tmp_path / "agent.checkpoint")
    assert stored is not None
    assert stored["state"]["step"] == 3
