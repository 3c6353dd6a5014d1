import importlib.util
import json
import multiprocessing
import os
import signal
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from agents.learning import training, workers
from agents.learning.training import LearningCurve, load_curve
from simulator.utils.files import sibling

CONFIGS = sorted((Path(__file__).parents[3] / "configs").glob("*.yaml"))
ENVIRONMENT = {"scenes": "bundled:small", "resolution": 36}
HYPERPARAMETERS: dict[str, dict[str, Any]] = {
    "regression": {"frames": 24, "width": 8},
    "ppo": {"total_timesteps": 32, "n_steps": 4, "batch_size": 8, "n_epochs": 1, "width": 8},
}


def tiny(agent: str = "regression", **changes: Any) -> training.AgentConfig:
    own = {"environment": ENVIRONMENT, "training": HYPERPARAMETERS[agent] | changes}
    return training.AgentConfig(agent=agent, num_envs=4, **own)


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_shipped_configs(path: Path) -> None:
    config, text = training.load_config(path), yaml.safe_load(path.read_text())
    assert text["training"].items() <= config.hyperparameters().model_dump().items()
    assert config.environment["split"] == "train"
    assert config.with_seed(7).hyperparameters().seed == 7
    assert json.loads(json.dumps(config.card())) == config.card()
    with pytest.raises(ValueError, match="seed"):
        config.with_seed(-1)
    with pytest.raises(ValueError, match="JSON"):
        training.AgentConfig(agent="regression", environment={"scenes": Path("raws")})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("agent: dqn", r"agent \(='dqn'\)"),
        ("agent: ppo\ntraining: {n_step: 3}", r"training.n_step \(=3\).*`n_steps`"),
        ("agent: ppo\ntraining: {batch_size: 100}", r"`batch_size` \(=100\)"),
        ("agent: ppo\nenvironment: {resolutoin: 64}", "`resolutoin`.*`resolution`"),
        ("agent: ppo\nenvironment: {scorer: balnced}", "environment: .*balnced"),
        ("agent: ppo\nenvironment: {observation: linear}", "`observation`.*'statistics'"),
        ("agent: regression\nenvironment: {delay: .inf}", "environment: .*`delay`"),
        ("agent: forecaster\ntraining: {mixed: 2}", r"training.mixed \(=2\)"),
        ("agent: forecaster\nenvironment: {split: train}", "`environment`"),
        ("agent: forecaster\nnum_envs: 3", "`num_envs`"),
    ],
)
def test_bad_configs_name_file_and_entry(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"^.*mine\.yaml.*{message}.*\Z"):  # one line
        training.load_config(path)


@pytest.mark.parametrize("agent", ["regression", "ppo"])
def test_trained_once_and_a_failed_save_loses_nothing(agent: str, tmp_path: Path) -> None:
    config, out = tiny(agent), tmp_path / "runs" / f"{agent}-0.1"
    log = tmp_path / "log" if importlib.util.find_spec("tensorboard") else None
    blocked = sibling(out, ".json")
    blocked.mkdir(parents=True)  # so that the agent cannot be written
    calls: list[int] = []
    with pytest.raises(OSError, match="json"):
        training.train_agent(config, out, progress=lambda n, *_: calls.append(n), tensorboard=log)
    assert calls[-1] == {"regression": 24, "ppo": 32}[agent]
    if log is not None:
        assert next(log.glob("events*")).stat().st_size > 200
    blocked.rmdir()
    assert not training.is_trained(config, out)
    for _ in range(2):  # saved, and then known
        training.train_agent(config, out, progress=lambda *_: pytest.fail("trained again"))
        assert training.is_trained(config, out)
    names = {path.name for path in out.parent.iterdir()}  # no checkpoint is left
    assert names == {f"{agent}-0.1{ending}" for ending in (".csv", ".json", ".safetensors")}
    # Another training, or a damaged file, is not taken for this one.
    assert not training.is_trained(config.with_seed(1), out)
    assert not training.is_trained(tiny(agent, width=9), out)
    blocked.write_text("[]")
    assert not training.is_trained(config, out)


@pytest.mark.usefixtures("quick_spawn")
def test_an_interrupted_call_ends_its_workers_and_keeps_what_is_trained(tmp_path: Path) -> None:
    configs = {"0": tiny(), "1": tiny(frames=24_000)}  # the second is stopped long before its end
    todo = [training.TrainingJob(name, own, tmp_path / name) for name, own in configs.items()]
    seen: list[int] = []

    def report(name: str, done: int, *_: Any) -> None:
        if name == "1":
            raise KeyboardInterrupt  # as Ctrl-C does in the process that waits
        seen.append(done)

    others = set(multiprocessing.active_children())
    with pytest.raises(KeyboardInterrupt):
        training.train_in_parallel(todo, workers=1, progress=report)
    assert seen == [*range(4, 25, 4)]
    assert [training.is_trained(job.config, job.out) for job in todo] == [True, False]
    for process in set(multiprocessing.active_children()) - others:
        process.join(60)
        assert not process.is_alive()


def _share(job: int) -> None:
    workers.send_progress(job, torch.get_num_threads())
    if job == 2:
        raise ValueError("job 2 has failed")


@pytest.mark.usefixtures("quick_spawn")
def test_threads_are_shared_and_an_error_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "core_count", lambda: 6)
    seen: list[tuple[object, ...]] = []
    with pytest.raises(ValueError, match="job 2 has failed"):
        workers.run_in_parallel(_share, [1, 2], progress=lambda *message: seen.append(message))
    assert (2, 3) in seen


def _never_end(job: int) -> None:
    workers.send_progress(job)
    time.sleep(600)


def _wait_for_ever(pipe: Connection) -> None:
    contexts = {"spawn": multiprocessing.get_context("fork")}  # its workers have the pipe, too
    multiprocessing.get_context = contexts.__getitem__  # type: ignore[assignment]
    workers.run_in_parallel(_never_end, [0, 1], workers=2, progress=pipe.send)


def test_workers_do_not_outlive_a_killed_parent(forkserver: Any) -> None:
    here, there = forkserver.Pipe()
    parent = forkserver.Process(target=_wait_for_ever, args=(there,))
    parent.start()
    there.close()
    assert {here.recv(), here.recv()} == {0, 1}
    parent.kill()
    parent.join()
    assert here.poll(30), "they work on for nobody"
    with pytest.raises(EOFError):  # nobody holds the other end
        here.recv()


def test_a_curve_has_means_over_parts_and_a_training_that_resumes_repeats_no_frames(tmp_path):
    path = tmp_path / "agent.csv"

    def report(name: str, values: dict[int, float]) -> dict[str, list[float]]:
        curve = LearningCurve(path)
        for done, value in values.items():
            curve(done, 1000, {name: value})
        return load_curve(path)

    found = report("mse", {done: done for done in range(1, 1001)})  # a row every 5 frames
    assert found == {"frames": list(range(5, 1001, 5)), "mse": list(range(3, 1000, 5))}
    path.unlink()
    report("mse", dict.fromkeys((200, 400, 600, 800), 1))
    # Its checkpoint was written after 500 frames.
    found = report("mse", dict.fromkeys((600, 800, 1000), 2))
    assert found == {"frames": [200, 400, 600, 800, 1000], "mse": [1, 1, 2, 2, 2]}
    # Another training of the same name.
    assert report("reward", {1000: 3}) == {"frames": [1000], "reward": [3]}


@pytest.mark.parametrize("text", ["name,price\ntable,12\n", "", "frames,mse\n1\n", "\x00"])
def test_a_file_of_something_else_is_not_replaced(text: str, tmp_path: Path) -> None:
    (tmp_path / "agent.csv").write_text(text)
    with pytest.raises(ValueError, match=r"agent.csv is not a learning curve"):
        LearningCurve(tmp_path / "agent.csv")
    assert (tmp_path / "agent.csv").read_text() == text


def test_a_terminated_command_goes_on(ae_env, tmp_path: Path, monkeypatch) -> None:
    """SIGTERM in its step 4, as Ctrl-C: a checkpoint and the curve so far are kept."""
    config, out, seen, curve = tiny(), tmp_path / "agent", [], LearningCurve.__call__
    (tmp_path / "mine.yaml").write_text(json.dumps(config.model_dump(mode="json")))

    def report(self: LearningCurve, done: int, *values: Any) -> None:
        curve(self, done, *values)
        if done == 16:
            os.kill(os.getpid(), signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr(LearningCurve, "__call__", report)
        assert ae_env("train", "mine.yaml", "--out", out)[0] == 143
    assert {p.name for p in tmp_path.iterdir()} == {"mine.yaml", "agent.checkpoint", "agent.csv"}
    training.train_agent(config, out, progress=lambda done, *_: seen.append(done))
    assert seen == [20, 24]
    assert training.is_trained(config, out)
