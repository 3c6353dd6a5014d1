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


def child(out: Path, pipe: Connection) -> None:
    """Runs in the process that is killed; a checkpoint is written whenever one may be."""
    torch.set_num_threads(1)
    checkpoint.INTERVAL = -1.0
    load = Checkpoint.load

    def reported(self: Checkpoint) -> dict[str, Any] | None:
        state = load(self)
        pipe.send(None if state is None else state["step"])
        return state

    Checkpoint.load = reported  # type: ignore[method-assign]
    config = AgentConfig(
        agent="regression",
        num_envs=4,
        environment={**TINY, "lighting": "sine", "delay": 1},
        training={"frames": 96, "width": 8, "memory": 40},
    )
    train_agent(config, out, progress=lambda done, *_: pipe.send(done // 4))


def run(context: Any, out: Path, kill: tuple[int, float] | None) -> tuple[Any, ...]:
    """Exit code, step resumed at, and steps, of a training killed after steps and seconds."""
    here, there = context.Pipe()
    process = context.Process(target=child, args=(out, there), daemon=True)
    process.start()
    there.close()
    resumed, steps = here.recv(), []
    try:
        while True:
            steps.append(here.recv())
            if kill is not None and len(steps) == kill[0]:
                time.sleep(kill[1])
                process.kill()
    except EOFError:  # it has ended
        pass
    process.join(60)
    return process.exitcode, resumed, steps


def test_killed_at_random_moments(forkserver: Any, tmp_path: Path) -> None:
    out, rng, last = tmp_path / "net", np.random.default_rng(0), 0
    for _ in range(2):
        kill = int(rng.integers(3, 8)), float(rng.uniform(0, 0.02))
        code, resumed, steps = run(forkserver, out, kill)
        assert code == -signal.SIGKILL
        assert load_checkpoint(sibling(out, ".checkpoint")) is not None  # whole, whenever it came
        # It goes on at the last checkpoint, which is no older than the last report but one.
        assert (resumed or 0) in range(max(last - 1, 0), last + 2)
        assert steps == list(range((resumed or 0) + 1, steps[-1] + 1))
        last = steps[-1]
    code, resumed, steps = run(forkserver, out, None)
    assert code == 0
    assert resumed in (last - 1, last, last + 1)
    assert steps == list(range(resumed + 1, 25))
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
