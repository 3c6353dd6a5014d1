"""Jobs in processes of their own."""

from __future__ import annotations

import multiprocessing
import os
import time
from multiprocessing.connection import Connection
from pathlib import Path

import pytest
import torch

from agents import parallel
from agents.learning.training import AgentConfig, TrainingJob, is_trained, train_in_parallel
from agents.parallel import run_in_parallel, tell
from simulator.utils.files import sibling

pytestmark = pytest.mark.slow
ENVIRONMENT = {"scenes": "bundled:small", "resolution": 36}


def jobs(folder: Path, frames: int) -> list[TrainingJob]:
    ppo = {"total_timesteps": frames, "n_steps": 4, "batch_size": 8, "n_epochs": 1, "width": 8}
    trainings = {"regression": {"frames": frames, "width": 8}, "ppo": ppo}
    return [
        TrainingJob(
            name,
            AgentConfig(agent=name, num_envs=4, environment=ENVIRONMENT, training=training),  # type: ignore[arg-type]
            folder / name,
        )
        for name, training in trainings.items()
    ]


def test_an_interrupted_call_resumes(tmp_path: Path) -> None:
    todo = jobs(tmp_path, frames=240)
    running, waiting = (sibling(job.out, ".checkpoint") for job in todo)

    def stop(*_: object) -> None:
        raise KeyboardInterrupt  # as Ctrl-C does in the process that waits

    with pytest.raises(KeyboardInterrupt):
        train_in_parallel(todo, workers=1, progress=stop)
    assert running.is_file()
    assert not waiting.exists()
    seen: dict[str, list[int]] = {job.name: [] for job in todo}

    def report(name: str, done: int, total: int, values: dict[str, float]) -> None:
        assert total == 240
        seen[name].append(done)

    train_in_parallel(todo, progress=report)
    for job in todo:
        assert is_trained(job.config, job.out)
        assert seen[job.name][-1] == 240
        assert seen[job.name] == sorted(seen[job.name])
    assert seen["ppo"][0] == 4 < seen["regression"][0]
    # Nothing is left to do, and no process is started.
    train_in_parallel(todo, progress=lambda *_: pytest.fail("trained again"))


def _share(job: int) -> None:
    tell(job, torch.get_num_threads())
    if job == 2:
        raise ValueError("job 2 has failed")


def test_threads_are_shared_and_an_error_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "core_count", lambda: 6)
    seen: list[tuple[object, ...]] = []
    with pytest.raises(ValueError, match="job 2 has failed"):
        run_in_parallel(_share, [1, 2], progress=lambda *message: seen.append(message))
    assert (2, 3) in seen


def _never_end(job: int) -> None:
    tell(os.getpid())
    time.sleep(600)


def _wait_for_ever(pipe: Connection) -> None:
    run_in_parallel(_never_end, [0, 1], workers=2, progress=pipe.send)


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="needs /proc")
def test_workers_do_not_outlive_a_killed_parent() -> None:
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    parent = context.Process(target=_wait_for_ever, args=(there,))
    parent.start()
    workers = [here.recv(), here.recv()]
    assert all(_runs(pid) for pid in workers)
    parent.kill()
    parent.join()
    end = time.monotonic() + 30
    while any(_runs(pid) for pid in workers):
        assert time.monotonic() < end, "they work on for nobody"
        time.sleep(0.1)
