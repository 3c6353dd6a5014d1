"""Trainings that are killed go on from their last checkpoint."""

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

from agents.learning.training import AgentConfig, train_agent
from simulator.utils import checkpoint
from simulator.utils.checkpoint import Checkpoint, load_checkpoint
from simulator.utils.files import sibling
from tests.agents.conftest import TINY

#: Steps that each training takes in all, and reports between two of its checkpoints.
STEPS = {"regression": 24, "ppo": 24}
PER_CHECKPOINT = {"regression": 1, "ppo": 4}
TRAININGS: dict[str, dict[str, Any]] = {
    "regression": {"frames": 96, "width": 8, "memory": 40},
    "ppo": {"total_timesteps": 96, "n_steps": 4, "batch_size": 8, "n_epochs": 2, "width": 8},
}


def child(kind: str, out: Path, pipe: Connection) -> None:
    """Runs in the process that is killed; a checkpoint is written whenever one may be."""
    torch.set_num_threads(1)
    checkpoint.INTERVAL = -1.0
    load = Checkpoint.load

    def reported(self: Checkpoint) -> dict[str, Any] | None:
        state = load(self)
        pipe.send(("resumed", state is not None))
        return state

    Checkpoint.load = reported  # type: ignore[method-assign]
    environment = {**TINY, "lighting": "sine", "delay": 1}
    config = AgentConfig(
        agent=kind,  # type: ignore[arg-type]
        num_envs=4,
        environment=environment,
        training=TRAININGS[kind],
    )
    train_agent(config, out, progress=lambda done, *_: pipe.send(("step", done // 4)))


def run(context: Any, kind: str, out: Path, kill: tuple[int, float] | None) -> tuple[Any, ...]:
    """Exit code, whether it resumed, and the steps of a training, killed after reports and time."""
    here, there = context.Pipe()
    process = context.Process(target=child, args=(kind, out, there), daemon=True)
    process.start()
    there.close()
    told: dict[str, list[int]] = {"resumed": [], "step": []}
    try:
        while True:
            word, value = here.recv()
            told[word].append(value)
            if kill is not None and len(told["step"]) == kill[0]:
                time.sleep(kill[1])
                process.kill()
    except EOFError:  # it has ended
        pass
    process.join(60)
    return process.exitcode, *told["resumed"], told["step"]


@pytest.mark.parametrize("kind", ["regression", "ppo"])
def test_killed_at_a_random_moment(kind: str, forkserver: Any, tmp_path: Path) -> None:
    out, rng, per = tmp_path / "net", np.random.default_rng(len(kind)), PER_CHECKPOINT[kind]
    kill = int(rng.integers(per + 2, STEPS[kind] // 2)), float(rng.uniform(0, 0.02))
    code, resumed, steps = run(forkserver, kind, out, kill)
    assert (code, resumed) == (-signal.SIGKILL, False)
    assert load_checkpoint(sibling(out, ".checkpoint")) is not None  # whole, whenever it came
    code, resumed, more = run(forkserver, kind, out, None)
    assert (code, resumed) == (0, True)
    # It goes on at the last checkpoint, which is no older than the last report but one.
    assert steps[-1] - per <= more[0] - 1 <= steps[-1] + per
    assert more == list(range(more[0], STEPS[kind] + 1))
    assert all(values.isfinite().all() for values in load_file(f"{out}.safetensors").values())


def command(folder: Path, started: Any) -> None:
    """Runs as `ae-env train` in the process that is stopped, between its steps 3 and 4."""
    from agents.cli.main import main

    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background ignores it
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
def test_a_stopped_command(number: int, status: int, forkserver: Any, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(
        "{agent: regression, num_envs: 4, environment: {scenes: 'bundled:small', resolution: 36},"
        " training: {frames: 1000000, width: 8}}"
    )
    started = forkserver.Event()
    process = forkserver.Process(target=command, args=(tmp_path, started), daemon=True)
    process.start()
    assert started.wait(120)
    os.kill(process.pid, number)
    process.join(60)
    assert process.exitcode == status
    assert "stopped; the same command goes on where it was" in (tmp_path / "words").read_text()
    assert {p.name for p in tmp_path.iterdir()} == {"mine.yaml", "words", "agent.checkpoint"}
    stored = load_checkpoint(tmp_path / "agent.checkpoint")
    assert stored is not None
    assert stored["state"]["step"] == 3
