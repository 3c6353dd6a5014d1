"""Trainings that are killed at random moments end with the weights of one that was not."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from simulator.utils.checkpoint import Checkpoint
from simulator.utils.files import sibling
from tests.agents.conftest import TINY

#: Signals in turn; each interrupts a process in another way.
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
#: Reports that a training makes in all; a kill comes after some of them.
REPORTS = {"regression": 30, "ppo": 48, "simulator": 30}


def train_agent(kind: str, out: Path, report: Callable[[], None]) -> None:
    from agents.learning.training import AgentConfig
    from agents.learning.training import train_agent as train

    hyperparameters: dict[str, dict[str, Any]] = {
        # The memory forgets the first frames, so that a resumed one must forget the same.
        "regression": {"frames": 120, "width": 8, "memory": 40},
        # A discount makes the starts of episodes count.
        "ppo": {
            "total_timesteps": 192,
            "n_steps": 4,
            "batch_size": 8,
            "n_epochs": 2,
            "width": 8,
            "gamma": 0.5,
        },
    }
    environment = {**TINY, "lighting": "sine", "delay": 1}
    config = AgentConfig(
        agent=kind,  # type: ignore[arg-type]
        num_envs=4,
        environment=environment,
        training=hyperparameters[kind],
    )
    train(config, out, progress=lambda *_: report())


def train_simulator(out: Path, report: Callable[[], None]) -> None:
    from simulator.training import loop
    from simulator.training.train import train_and_save
    from tests.simulator.training.test_train import config, scenes

    stage = {"steps": 10, "batch": 2, "crop": 16}
    loop._LOG_EVERY = 1
    train_and_save(
        config(exposure=stage, noise=stage, aperture=stage),
        scenes,
        out,
        command="",
        progress=lambda name, *_: report() if name.endswith("training") else None,
    )


def heed_interrupts() -> None:
    """What runs in the background of a shell ignores them."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


def child(kind: str, out: Path, pipe: Connection) -> None:
    """What runs in the process that is killed; a checkpoint is written after every step."""
    logging.basicConfig(level=logging.WARNING)
    heed_interrupts()
    torch.set_num_threads(1)
    save, restore = Checkpoint.save, Checkpoint.restore

    def always(self: Checkpoint, step: int, *, force: bool = False) -> None:
        save(self, step, force=True)

    def told(self: Checkpoint) -> int:
        step = restore(self)
        pipe.send(("resumed", step))
        return step

    Checkpoint.save, Checkpoint.restore = always, told  # type: ignore[method-assign]

    def report() -> None:
        pipe.send(("step", 0))

    if kind == "simulator":
        train_simulator(out, report)
    else:
        train_agent(kind, out, report)


def run(
    context: Any, kind: str, out: Path, *, kill: tuple[int, float, int] | None
) -> tuple[int, list[int]]:
    """Runs a training, killed `kill[1]` seconds after so many reports: exit code, resumed steps."""
    here, there = context.Pipe()
    process = context.Process(target=child, args=(kind, out, there), daemon=True)
    process.start()
    there.close()
    resumed: list[int] = []
    seen = 0
    try:
        while True:
            word, step = here.recv()
            resumed += [step] if word == "resumed" else []
            seen += word == "step"
            if kill is not None and seen == kill[0]:
                time.sleep(kill[1])
                os.kill(process.pid, kill[2])
                kill = None
    except EOFError:  # it has ended
        pass
    process.join(60)
    assert process.exitcode is not None
    return process.exitcode, resumed


@pytest.fixture(scope="module")
def context() -> Any:
    """Processes from a server that has imported everything, and never computed anything."""
    if "forkserver" not in multiprocessing.get_all_start_methods():
        pytest.skip("needs POSIX signals")
    found = multiprocessing.get_context("forkserver")
    used = (
        "agents.cli.main",
        "agents.learning.ppo",
        "agents.learning.training",
        "ae_env.vector_env",
        "torch._dynamo",
    )
    tests = ("tests.simulator.training.test_train", "tests.agents.test_killed")
    found.set_forkserver_preload([*used, *tests])
    return found


@pytest.mark.parametrize("kind", ["regression", "ppo", "simulator"])
def test_killed_at_random_moments(kind: str, context: Any, tmp_path: Path) -> None:
    """Three kills each: whatever was drawn, seen, remembered or scheduled is there again."""
    whole = tmp_path / "whole" / "net"
    assert run(context, kind, whole, kill=None)[0] == 0
    out, rng = tmp_path / "killed" / "net", np.random.default_rng(len(kind))
    resumed: list[int] = []
    for number in SIGNALS:
        kill = int(rng.integers(3, REPORTS[kind] // 3)), float(rng.uniform(0, 0.02)), number
        code, steps = run(context, kind, out, kill=kill)
        resumed += steps
        assert code == (1 if number == signal.SIGINT else -number)
        for left in out.parent.iterdir():
            if left.suffix == ".checkpoint":
                load_file(left)  # every file is whole, whenever the kill came
    code, steps = run(context, kind, out, kill=None)
    assert code == 0
    assert max([*resumed, *steps]) > 0  # it did go on, and did not begin anew
    expected, found = (load_file(sibling(path, ".safetensors")) for path in (whole, out))
    assert found.keys() == expected.keys()
    assert all(torch.equal(found[name], expected[name]) for name in expected)


def command(folder: Path, started: Any) -> None:
    """What runs as `ae-env train` in the process that is stopped, between its steps 3 and 4."""
    from agents.cli.main import main

    heed_interrupts()
    save = Checkpoint.save

    def told(self: Checkpoint, step: int, *, force: bool = False) -> None:
        save(self, step, force=force)  # the first one would be due after twenty seconds
        if step == 3 and not force:
            started.set()
            time.sleep(60)

    Checkpoint.save = told  # type: ignore[method-assign]
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
    assert "stopped; the same command goes on where it was" in (tmp_path / "words").read_text()
    left = {path.name for path in tmp_path.iterdir()} - {"mine.yaml", "words"}
    assert left == {"agent.checkpoint"}
    load_file(tmp_path / "agent.checkpoint")
