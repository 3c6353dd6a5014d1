"""Trainings that are stopped or killed go on from their last checkpoint."""

import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch

from agents.learning import training
from agents.learning.training import is_trained, load_config, train_agent
from simulator.utils import checkpoint

STOPPED = "stopped; run the same command again to continue"


def command(folder: Path, started: Any, interval: float) -> None:
    """Runs as `ae-env train` in the process that is stopped, in its step 4."""
    from agents.cli.main import main

    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background ignores it
    checkpoint.INTERVAL = interval
    curve = training.LearningCurve.__call__

    def wait(self: Any, done: int, *report: Any) -> None:
        curve(self, done, *report)
        if done == 16:  # the fourth report; with a negative interval the third step is saved
            started.set()
            for _ in range(600):  # a signal just before a single sleep would not end it
                time.sleep(0.1)

    training.LearningCurve.__call__ = wait  # type: ignore[method-assign]
    torch.set_num_threads(1)
    words = os.open(folder / "words", os.O_WRONLY | os.O_CREAT)
    os.dup2(words, 2)
    sys.stderr = os.fdopen(2, "w", buffering=1)
    sys.argv = ["ae-env", "train", str(folder / "mine.yaml"), "--out", str(folder / "agent")]
    main()


@pytest.mark.parametrize(
    ("number", "status", "words", "steps"),
    [
        (signal.SIGTERM, 143, STOPPED, 4),
        (signal.SIGINT, 130, STOPPED, 4),
        (signal.SIGKILL, -signal.SIGKILL, "", 3),  # what was written before counts
    ],
)
def test_a_stopped_command(
    number: int, status: int, words: str, steps: int, forkserver: Any, tmp_path: Path
) -> None:
    (tmp_path / "mine.yaml").write_text(
        "{agent: regression, num_envs: 4, environment: {scenes: 'bundled:small', resolution: 36},"
        " training: {frames: 24, width: 8}}"
    )
    started = forkserver.Event()
    arguments = (tmp_path, started, -1.0 if number == signal.SIGKILL else 20.0)
    process = forkserver.Process(target=command, args=arguments, daemon=True)
    process.start()
    assert started.wait(120)
    os.kill(process.pid, number)
    process.join(60)
    assert process.exitcode == status
    assert (tmp_path / "words").read_text().strip() == words
    names = {"mine.yaml", "words", "agent.checkpoint", "agent.csv"}  # the curve so far is kept
    assert {p.name for p in tmp_path.iterdir()} == names
    stored = torch.load(tmp_path / "agent.checkpoint", weights_only=True)
    assert stored["state"]["step"] == steps
    config, seen = load_config(tmp_path / "mine.yaml"), []
    train_agent(config, tmp_path / "agent", progress=lambda *report: seen.append(report[:2]))
    assert seen == [(done, 24) for done in range(4 * steps + 4, 25, 4)]
    assert is_trained(config, tmp_path / "agent")
