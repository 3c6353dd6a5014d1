"""Trainings in processes of their own."""

from __future__ import annotations

import multiprocessing
import time
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from agents.learning import parallel
from agents.learning.parallel import TrainingJob, train_in_parallel
from agents.learning.training import AgentConfig, is_trained

ENVIRONMENT = {"scenes": "bundled:small", "resolution": 36}


def jobs(folder: Path, frames: int = 48) -> list[TrainingJob]:
    return [
        TrainingJob(
            "first",
            AgentConfig(
                agent="regression",
                num_envs=4,
                environment=ENVIRONMENT,
                training={"frames": frames, "width": 8},
            ),
            folder / "first",
        ),
        TrainingJob(
            "second",
            AgentConfig(
                agent="ppo",
                num_envs=4,
                environment=ENVIRONMENT,
                training={
                    "total_timesteps": frames,
                    "n_steps": 4,
                    "batch_size": 8,
                    "n_epochs": 1,
                    "width": 8,
                },
            ),
            folder / "second",
        ),
    ]


@pytest.mark.slow
def test_two_trainings_with_progress(tmp_path: Path) -> None:
    todo = jobs(tmp_path)
    seen: dict[str, list[tuple[int, int]]] = {"first": [], "second": []}
    train_in_parallel(todo, progress=lambda name, done, total, _: seen[name].append((done, total)))
    for job in todo:
        assert is_trained(job.config, job.out)
        assert seen[job.name][-1] == (48, 48)
        assert seen[job.name] == sorted(seen[job.name])
    # Nothing is left to do, and no process is begun.
    train_in_parallel(todo, progress=lambda *_: pytest.fail("trained again"))


@pytest.mark.slow
def test_an_interrupt_ends_every_job(tmp_path: Path, monkeypatch) -> None:
    endless = jobs(tmp_path, frames=10**7)

    def stop(messages: object, progress: object) -> None:
        raise KeyboardInterrupt  # as Ctrl-C does in the process that waits

    monkeypatch.setattr(parallel, "_deliver", stop)
    with pytest.raises(KeyboardInterrupt):  # and does not wait for the one that has not begun
        train_in_parallel(endless, workers=1)
    assert not any(is_trained(job.config, job.out) for job in endless)


@pytest.mark.slow
def test_an_error_in_a_job_is_raised(tmp_path: Path) -> None:
    config = AgentConfig(
        agent="regression", num_envs=4, environment={"scenes": str(tmp_path), "resolution": 36}
    )
    with pytest.raises(ValueError, match="must hold raws"):
        train_in_parallel([TrainingJob("bad", config, tmp_path / "bad")])


def _train_for_long(folder: Path, pipe: Connection) -> None:
    def report(*_: object) -> None:
        pipe.send([process.pid for process in multiprocessing.active_children()])

    train_in_parallel(jobs(folder, frames=40_000), progress=report)  # reports every 200


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="needs /proc")
def test_workers_do_not_outlive_a_killed_parent(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    parent = context.Process(target=_train_for_long, args=(tmp_path, there))
    parent.start()
    workers = here.recv()
    assert workers
    assert all(_runs(pid) for pid in workers)
    parent.kill()
    parent.join()
    end = time.monotonic() + 30
    while any(_runs(pid) for pid in workers):
        assert time.monotonic() < end, "they train on for nobody"
        time.sleep(0.1)
