"""PPO and regression: they learn, resume and act; their files, configurations and workers."""

import importlib.util
import json
import multiprocessing
import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
import yaml
from torch import nn

from ae_env.grid import ExposureGrid
from agents.learning import regression, training, workers
from agents.learning.networks import Session
from agents.learning.policy_file import load_agent, save_agent
from agents.learning.ppo import PPOTraining, train_ppo
from agents.learning.regression import RegressionPolicy, RegressionTraining, train_regression
from agents.learning.training import LearningCurve, load_curve
from agents.policy import PolicyContext
from agents.policy_names import make_policy
from simulator.utils.files import sibling

TRAINING = PPOTraining(total_timesteps=96, n_steps=4, batch_size=8, n_epochs=2, width=16, seed=3)


def test_it_learns(make_tiny_envs) -> None:
    rewards: list[float] = []
    session = Session(progress=lambda d, t, values: rewards.append(values["reward"]))
    sizes = {"total_timesteps": 1024, "n_steps": 8, "batch_size": 64, "n_epochs": 4, "width": 16}
    # Always sharp: short times and small apertures gain nothing, low ISO does.
    envs = make_tiny_envs(num_envs=16, motion="none", depth="far")
    train_ppo(envs, PPOTraining(**sizes, learning_rate=3e-3), session)
    assert rewards[-1] > rewards[15] + 0.1


@pytest.mark.parametrize("observation", ["uint8", "statistics"])
def test_saved_weights_act_identically(make_tiny_envs, tmp_path: Path, observation: str) -> None:
    envs = make_tiny_envs(num_envs=6, observation=observation)
    context = PolicyContext.from_envs(envs)
    training = TRAINING.model_copy(update={"total_timesteps": 24, "batch_size": 12})
    network = train_ppo(envs, training)
    save_agent(tmp_path / "ppo", "ppo", network, network.width, context, {})
    loaded = make_policy(f"ppo:{tmp_path / 'ppo'}", context)
    observations, _ = envs.reset(seed=9)
    for _ in range(3):
        loaded.reset(6)  # else a last state may be kept
        chosen = loaded.act(observations)
        assert np.array_equal(chosen, network.predict(observations, deterministic=True)[0])
        masks = np.random.default_rng(0).random((6, 64)) < 0.3
        masks[:, 5] = True
        assert masks[np.arange(6), loaded.act(observations, masks)].all()
        observations, *_ = envs.step(chosen)


@pytest.mark.parametrize(
    ("train", "training", "stopped_at", "done"),
    [
        (train_ppo, TRAINING, 56, 48),
        (train_regression, RegressionTraining(frames=48, width=16, seed=5), 28, 28),
    ],
)
def test_a_stopped_training_goes_on(train, training, stopped_at, done, make_tiny_envs, tmp_path):
    """PPO from its last complete update of 4 x 4 frames."""
    path, seen = tmp_path / "agent.checkpoint", []

    def stop(done: int, total: int, values: dict[str, float]) -> None:
        if done == stopped_at:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(make_tiny_envs(), training, Session(checkpoint=path, progress=stop))
    session = Session(checkpoint=path, progress=lambda *a: seen.append(a[0]))
    network = train(make_tiny_envs(), training, session)
    assert seen == list(range(done + 4, 97 if train is train_ppo else 49, 4))
    end = session.store(training, dict).load()
    name, steps = ("policy", 24) if train is train_ppo else ("network", 12)
    assert all(torch.equal(v, end[name][key]) for key, v in network.state_dict().items())
    # Adam goes on counting, so its moments were restored.
    assert {float(s["step"]) for s in end["optimizer"]["state"].values()} == {steps}
    if train is train_ppo:  # the learning rate falls over the whole training
        assert network.optimizer.param_groups[0]["lr"] < 0.3 * TRAINING.learning_rate
    else:
        assert end["schedule"]["last_epoch"] == end["step"] == steps


class Stub(nn.Module):
    """Predicts the scores (N, S) and log variances of each frame as they are given."""

    def __init__(self, *frames: tuple[np.ndarray, np.ndarray]) -> None:
        super().__init__()
        self.anchor = nn.Parameter(torch.zeros(()))
        self.frames = list(frames)

    def forward(self, codes, settings, sensors):
        scores, log_variance = self.frames.pop(0)
        return torch.from_numpy(scores), torch.from_numpy(log_variance)


def test_predictions_are_weighted_by_their_precision(context: PolicyContext, photograph) -> None:
    rng = np.random.default_rng(0)
    scores = rng.random((3, 2, 64))
    variance = np.exp(rng.uniform(-6, 0, (3, 2, 64)))
    policy = RegressionPolicy(context, network=Stub(*zip(scores, np.log(variance), strict=True)))
    policy.reset(2)
    frame = photograph(np.ones((64, 64)), 8.0, [0, 1])
    for t in range(3):
        # The minimum-variance mean of independent estimates (inverse-variance weights).
        weights = 1.0 / variance[: t + 1]
        best = np.average(scores[: t + 1], axis=0, weights=weights)
        masks = rng.random((2, 64)) < 0.5
        masks[0, best[0].argmax()] = False  # even the best may be forbidden
        best = np.where(masks, best, -1.0)
        assert policy.act(frame, masks).tolist() == best.argmax(axis=1).tolist()


def test_a_state_is_kept_unless_another_is_clearly_better(context, photograph) -> None:
    """By 0.002 of the mean score; a camera that was forgotten has no state to keep."""
    scores = np.zeros((4, 1, 64))
    scores[:, 0, 3] = 0.5
    scores[:, 0, 9] = 0.4, 0.602, 0.5085, 0.501  # means 0.4, 0.501, 0.5035; then alone
    policy = RegressionPolicy(context, network=Stub(*((s, np.zeros((1, 64))) for s in scores)))
    policy.reset(1)
    frame = photograph(np.ones((64, 64)), 8.0, 0)
    assert [policy.act(frame).item() for _ in range(3)] == [3, 3, 9]
    policy.reset(1)
    assert policy.act(frame).item() == 9


def test_episodes_do_not_mix_and_frames_of_other_light_are_forgotten(context, photograph):
    """The first camera's light falls by a stop; the second's stays, at other settings."""
    first, then = np.full((2, 2, 64), 0.1)
    first[:, 3], then[:, 9] = 0.9, 0.8  # 0.5 * (0.9 + 0.1) against 0.5 * (0.8 + 0.1)
    sure, grey = np.full((2, 64), -2.0), np.ones((64, 64))
    stub = Stub(*((scores, sure) for scores in (first, then, then, first, then)))
    policy = RegressionPolicy(context, network=stub)
    policy.reset(2)
    near, far = (context.grid.nearest(ev) for ev in (8.0, 9.0))  # neither clips
    before = photograph(grey, 8.0, [near, near])
    assert policy.act(before).tolist() == [3, 3]
    policy.forget(np.array([False, True]))
    assert policy.act(before).tolist() == [3, 9]
    policy.reset(2)
    assert policy.act(before).tolist() == [9, 9]
    policy.reset(2)
    assert policy.act(before).tolist() == [3, 3]
    darker, same = photograph(0.5 * grey, 8.0, near), photograph(grey, 8.0, far)
    after = {name: np.concatenate([darker[name], same[name]]) for name in same}
    assert policy.act(after).tolist() == [9, 3]


def test_training_lowers_the_loss(make_tiny_envs) -> None:
    losses: list[float] = []
    session = Session(progress=lambda done, total, values: losses.append(values["mse"]))
    train_regression(make_tiny_envs(num_envs=8), RegressionTraining(frames=160, width=32), session)
    assert np.mean(losses[-8:]) < 0.6 * np.mean(losses[:4])


@pytest.mark.parametrize(
    ("train", "training"),
    [
        (train_regression, RegressionTraining(frames=16, width=8)),
        (train_ppo, TRAINING.model_copy(update={"total_timesteps": 16})),
    ],
)
def test_the_seed_alone_decides_and_progress_is_complete(train, training, make_tiny_envs):
    seen: list[tuple[int, int, dict[str, float]]] = []

    def weights(seed: int) -> dict[str, torch.Tensor]:
        session = Session(progress=lambda *a: seen.append(a))
        seeded = training.model_copy(update={"seed": seed})
        return train(make_tiny_envs(), seeded, session).state_dict()

    first = weights(1)
    torch.rand(3)
    before = torch.random.get_rng_state()
    again, after = weights(1), torch.random.get_rng_state()
    if train is train_regression:  # Stable-Baselines3 seeds torch itself
        assert torch.equal(before, after)
    other = weights(2)
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert any(not torch.equal(first[name], other[name]) for name in first)
    assert [(done, total) for done, total, _ in seen] == [(n, 16) for n in range(4, 17, 4)] * 3
    assert all(0.0 <= values.get("reward", 0.0) <= 1.0 for _, _, values in seen)


@pytest.mark.parametrize("memory", [1, 4, 10])
def test_replay_memory_is_bounded(memory: int) -> None:
    replay = regression.Replay(RegressionTraining(memory=memory), np.random.default_rng(0))
    for step in range(12):
        new = {"raw": np.full((4, 4, 2, 2), step, np.uint8), "settings": np.zeros((4, 3))}
        batch, target, right = replay.batch(new, np.full((4, 64), float(step)), np.full(4, step))
        assert (batch["raw"][:4] == step).all()
        assert (batch["raw"][:, 0, 0, 0] == target[:, 0]).all()  # frames keep their own scores
        assert (right == target[:, 0]).all()
    assert len(replay.memory) == max(1, memory // 4)


@pytest.fixture
def network(context: PolicyContext) -> nn.Module:
    return regression.ScoreRegressor(context.observation_space, context.grid, width=8)


@pytest.fixture
def agent(context: PolicyContext, network: nn.Module, tmp_path: Path) -> Path:
    path, training = tmp_path / "regression-0.5", {"agent": "regression"}
    save_agent(path, "regression", network, 8, context, training)
    return path


def test_weights_that_are_not_finite_replace_none(agent: Path, context, network) -> None:
    _, card = load_agent(agent, "regression")
    assert (card["width"], card["training"]) == (8, {"agent": "regression"})
    next(network.parameters()).data.fill_(float("nan"))
    with pytest.raises(ValueError, match="finite"):
        save_agent(agent, "regression", network, 8, context, {})
    assert load_agent(agent, "regression")[1] == card


@pytest.mark.parametrize(
    ("suffix", "content", "message"),
    [
        *((suffix, None, f"regression-0.5{suffix}") for suffix in (".json", ".safetensors")),
        (".json", b'{"kind": "regression", "format": 1}', "width: .*context: "),
        (".json", {"format": 2}, "format 2"),
        (".json", {"width": 10**9}, r"width \(=1000000000\)"),
        (".json", {"width": 9}, r"[^\n]*weight[^\n]*\Z"),
        *((".json", {"training": {"training": {"history": h}}}, "history") for h in (10**9, -1)),
        (".json", {"context": {"observation": "uint8", "resolution": [4]}}, "resolution = "),
    ],
)
def test_damaged_and_wrong_files(agent, context, suffix, content, message):
    file = sibling(agent, suffix)
    if isinstance(content, dict):
        card = json.loads(file.read_text())
        del card["sha256"]  # a card of an earlier version, which is fine
        file.write_text(json.dumps(card))
        assert make_policy(f"regression:{agent}", context).name == "regression"
        content = json.dumps(card | content).encode()
    file.unlink()
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(FileNotFoundError if content is None else ValueError, match=message):
        make_policy(f"regression:{agent}", context)


def test_another_grid_or_observation_than_the_trained(agent: Path, context: PolicyContext) -> None:
    inside = {"isos": (100, 200), "exposure_times": (0.01, 0.1), "f_numbers": (4.0, 8.0)}
    make_policy(f"regression:{agent}", replace(context, grid=ExposureGrid(**inside)))
    space = gym.spaces.Dict({n: context.observation_space[n] for n in ("raw", "settings")})
    grids = {
        "isos from 100 to 6400": {"isos": (50, 200)},
        "exposure_times from 0.001 to 0.5": {"exposure_times": (0.01, 1.0)},
        "f_numbers from 4 to 11": {"f_numbers": (4.0, 16.0)},
    }
    others = {message: {"grid": ExposureGrid(**inside | own)} for message, own in grids.items()}
    for message, other in {**others, "sensors = True": {"observation_space": space}}.items():
        with pytest.raises(ValueError, match=message):
            make_policy(f"regression:{agent}", replace(context, **other))
    with pytest.raises(ValueError, match="either `weights` or `network`"):
        RegressionPolicy(context)


@pytest.mark.parametrize("name", ["regression", "ppo"])
def test_a_finer_grid_gives_known_states_their_values(name: str, context: PolicyContext) -> None:
    """The states' scale is that of the training: it is not worked out anew from the grid."""
    coarse = context.grid
    isos, times = {*coarse.isos, 200.0, 3200.0}, {*coarse.exposure_times, 1 / 30}
    finer = ExposureGrid(tuple(sorted(isos)), tuple(sorted(times)), coarse.f_numbers[:3])
    frame = {"raw": torch.rand(2, 4, 64, 64), "settings": torch.rand(2, 3) * 2 - 1}
    frame["sensors"] = torch.rand(2, 2) * 2 - 1
    shared = [s for s in coarse if s.f_number < 11]
    values = []
    for grid in (coarse, finer):
        network = make_policy(name, replace(context, grid=grid)).network
        with torch.inference_mode():
            if name == "ppo":
                codes = {**frame, "raw": frame["raw"] * 255}
                found = network.get_distribution(codes).distribution.logits
            else:
                found = network(*frame.values())[0]
        known = found[:, [grid.states.index(s) for s in shared]]
        values.append(known - known[:, :1])  # logits are known up to their norm
    torch.testing.assert_close(*values, rtol=1e-5, atol=1e-5)


# -- configurations, workers and learning curves ---------------------------------------------------


CONFIGS = sorted((Path(__file__).parents[3] / "configs").glob("*.yaml"))
ENVIRONMENT = {"scenes": "bundled:small", "resolution": 36}
HYPERPARAMETERS = {
    "regression": {"frames": 24, "width": 8},
    "ppo": {"total_timesteps": 32, "n_steps": 4, "batch_size": 8, "n_epochs": 1, "width": 8},
}


def tiny(agent="regression", **changes):
    own = {"environment": ENVIRONMENT, "training": HYPERPARAMETERS[agent] | changes}
    return training.AgentConfig(agent=agent, num_envs=4, **own)


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_shipped_configs(path: Path) -> None:
    if path.stem == "legibility":
        pytest.importorskip("zxingcpp")
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
        ("agent: regression\nenvironment: {device: cpu}", "`device`.*None"),
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

    def report(name, done, *_):
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


def _wait_for_ever(pipe):
    contexts = {"spawn": multiprocessing.get_context("fork")}  # its workers have the pipe, too
    multiprocessing.get_context = contexts.__getitem__
    workers.run_in_parallel(_never_end, [0, 1], workers=2, progress=pipe.send)


def test_workers_do_not_outlive_a_killed_parent(forkserver):
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


def test_a_terminated_command_keeps_what_it_has(ae_env, tmp_path: Path, monkeypatch) -> None:
    """SIGTERM in its step 4, as Ctrl-C: a checkpoint and the curve so far are kept."""
    config, out, curve = tiny(), tmp_path / "agent", LearningCurve.__call__
    (tmp_path / "mine.yaml").write_text(json.dumps(config.model_dump(mode="json")))

    def report(self, done, *values):
        curve(self, done, *values)
        if done == 16:
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(LearningCurve, "__call__", report)
    assert ae_env("train", "mine.yaml", "--out", out)[0] == 143
    assert {p.name for p in tmp_path.iterdir()} == {"mine.yaml", "agent.checkpoint", "agent.csv"}
