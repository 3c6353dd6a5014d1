"""Training code of others and of `examples` runs the tasks, and recorded episodes are read."""

from dataclasses import asdict
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from filelock import FileLock
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO

from ae_env import UserCodeError
from ae_env.observation import encode_settings
from ae_env.registration import TASKS
from ae_env.wrappers import VectorContinuousActions
from agents import Policy, PolicyContext, evaluate, make_policy
from agents.recording import record_dataset
from agents.rollouts import fitting_arguments, training_arguments
from agents.rollouts import make_envs as envs_of
from examples import learners, ppo_on_device, recurrent_ppo
from tests.ae_env.environments import SMALL, make_envs
from tests.ae_env.scene_files import GRID, write_raws

every_task = pytest.mark.parametrize("task", TASKS)


@every_task
@pytest.mark.parametrize(
    ("algorithm", "policy"), [(PPO, "MultiInputPolicy"), (RecurrentPPO, "MultiInputLstmPolicy")]
)
def test_stable_baselines(task, algorithm, policy):
    env = gym.make(task, **SMALL)
    agent = algorithm(policy, env, n_steps=16, batch_size=16, n_epochs=1, seed=0, device="cpu")
    assert agent.learn(32).num_timesteps == 32
    action, _ = agent.predict(env.reset(seed=0)[0])
    assert env.action_space.contains(np.int64(action))


@every_task
def test_a_loop_as_cleanrl_writes_it(task: str) -> None:
    """`ppo.py`: a vector environment in SAME_STEP mode, and statistics of its episodes."""
    envs = gym.make_vec(task, num_envs=4, autoreset_mode="SAME_STEP", **SMALL)
    envs = gym.wrappers.vector.RecordEpisodeStatistics(envs)
    envs.action_space.seed(1)
    envs.reset(seed=1)
    lengths: list[int] = []
    for _ in range(100 if "Video" in task else 20):
        _, rewards, terminated, truncated, info = envs.step(envs.action_space.sample())
        assert np.isfinite(rewards).all()
        done = terminated | truncated
        if done.any():
            assert set(np.flatnonzero(done)) == {i for i, o in enumerate(info["final_obs"]) if o}
            lengths += info["episode"]["l"][done].tolist()
    assert lengths
    limit = {"ae_env/AutoExposure-v0": 8, "ae_env/AutoExposureVideo-v0": 96}.get(task)
    assert set(lengths) == {limit} if limit else set(lengths) <= {1, 2, 3}


@every_task
def test_torchrl(task: str) -> None:
    """It makes environments itself too: tries arguments of its own, and expects a TypeError."""
    from torchrl.envs import GymEnv, GymWrapper, SerialEnv
    from torchrl.envs.utils import check_env_specs

    env = GymWrapper(gym.make(task, **SMALL))
    env.set_seed(0)
    check_env_specs(env)
    rollout = env.rollout(8)
    assert rollout["next", "reward"].isfinite().all()
    assert not rollout["next", "done"].flatten()[:-1].any()  # it ends with its last step
    many = GymWrapper(gym.make_vec(task, num_envs=2, autoreset_mode="SAME_STEP", **SMALL))
    assert many.rollout(4, break_when_any_done=False)["next", "rewards.score"].isfinite().all()
    envs = SerialEnv(2, lambda: GymEnv(task, frame_skip=2, **SMALL))
    assert envs.rollout(1)["next", "reward"].shape == (2, 1, 1)


def test_ppo_on_one_device() -> None:
    """Whatever a GPU would run runs on the CPU, and the updates change the network."""
    trained = (ppo_on_device.train("cpu", updates, num_envs=2, steps=2) for updates in (0, 1))
    before, after = (torch.nn.utils.parameters_to_vector(n.parameters()) for n in trained)
    assert torch.isfinite(after).all()
    assert not torch.equal(before, after)


def test_the_recurrent_example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It trains, its weights come back, and a reset forgets the episode."""
    make_vec, few = gym.make_vec, {**SMALL, "num_envs": 8}
    monkeypatch.setattr(gym, "make_vec", lambda task, **given: make_vec(task, **given | few))
    weights = tmp_path / "recurrent.safetensors"
    recurrent_ppo.train(weights, frames=128)
    envs = gym.make_vec("ae_env/AutoExposureVideo-v0", split="test")
    context = PolicyContext.from_envs(envs)
    policy = make_policy(f"{recurrent_ppo.__file__}:RecurrentAgent?weights={weights}", context)
    memories = []
    for _ in range(2):
        policy.reset(8)
        observations, _ = envs.reset(seed=0)
        for _ in range(3):
            observations, *_ = envs.step(policy.act(observations))
        memories.append(policy.memory)
    first, again = np.array(memories)
    np.testing.assert_array_equal(first, again)
    assert np.abs(first).max() > 0.0


TASK, RECORDED = "ae_env/AutoExposure-v0", {**SMALL, "split": "test"}


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", "minari")
    return tmp_path / "minari"


@pytest.fixture
def context() -> PolicyContext:
    return PolicyContext.from_envs(make_envs(1, split="test"))


@pytest.mark.parametrize("name", ["centre_weighted:P", "oracle"])
def test_recorded_episodes_happen_again(name: str, context: PolicyContext) -> None:
    policy = make_policy(name, context)
    dataset = record_dataset(policy, name, TASK, RECORDED, "ae/mine-v0", episodes=3, seed=5)
    assert (dataset.total_episodes, dataset.total_steps) == (3, 24)
    env = dataset.recover_environment()
    metadata = dataset.storage.get_episode_metadata(range(3))
    for seed, episode, own in zip((5, 6, 7), dataset.iterate_episodes(), metadata, strict=True):
        assert own["seed"] == seed
        shown, _ = env.reset(seed=seed, options=own["options"])
        for step, action in enumerate(episode.actions):
            for key, value in shown.items():
                np.testing.assert_array_equal(episode.observations[key][step], value)
            shown, reward, *_ = env.step(action)
            assert reward == pytest.approx(episode.rewards[step], abs=1e-9)
        assert episode.truncations.tolist() == [False] * 7 + [True]


class Stops(Policy):
    def act(self, observations, action_masks=None):
        raise KeyError("lost")


def test_what_is_unfinished_is_removed_and_names_are_checked(folder, context):
    with pytest.raises(UserCodeError, match=r"'stops'.*KeyError: 'lost'"):
        record_dataset(Stops(context), "stops", TASK, RECORDED, "mine-v0", episodes=1)
    assert list(folder.iterdir()) == []
    policy = make_policy("random", context)
    for left in ("mine-v0", "other-v1", "x81nf"):  # of processes that have died
        (folder / f".unfinished-{left}").mkdir()
    with FileLock(folder / ".unfinished-ae.mine-v0.lock"):  # another process records it
        (folder / ".unfinished-ae.mine-v0").mkdir()
        with pytest.raises(ValueError, match=r"`out`.* another process"):
            record_dataset(policy, "random", TASK, RECORDED, "ae/mine-v0", episodes=1)
        for name in ("mine-v0", "ae-mine-v0"):
            record_dataset(policy, "random", TASK, RECORDED, name, episodes=1)
        left = {path.name for path in folder.iterdir() if path.is_dir()}
        assert left == {".unfinished-ae.mine-v0", "mine-v0", "ae-mine-v0"}
    (folder / "other-v0").mkdir()
    for wrong in ("mine", "a/mine-v0", "mine-v0", "other-v0"):  # the last two are there
        with pytest.raises(ValueError, match=rf"`out` \(='{wrong}'\)"):
            record_dataset(policy, "random", TASK, RECORDED, wrong, episodes=1)


STATES = {name: list(values) for name, values in asdict(GRID).items()}


def test_recorded_grids_are_trained_for_on_their_own_states(tmp_path: Path) -> None:
    write_raws(tmp_path / "a")
    named = f"recorded:{tmp_path}"
    for spec in (named, {"recorded": str(tmp_path)}):
        assert training_arguments(spec, 36) == ({"scenes": "bundled", "grid": STATES}, True)
    assert training_arguments(str(tmp_path), 36) == ({"scenes": "bundled"}, True)
    assert training_arguments("bundled") == ({"scenes": "bundled"}, False)
    judged = {"scenes": named, "split": "test", "grid": "video"}
    assert fitting_arguments(judged, 36) == {**judged, "scenes": "bundled"}  # what is named stays


def test_a_fitted_policy_is_recorded_and_judged_on_a_recorded_grid(ae_env, tmp_path, monkeypatch):
    few = ({"scenes": "bundled:small", "grid": STATES}, True)
    monkeypatch.setattr("agents.rollouts.training_arguments", lambda *_: few)
    write_raws(tmp_path / "grid" / "a")
    (tmp_path / "env.yaml").write_text("{scenes: 'recorded:grid', split: train, resolution: 36}")
    options = ("--env", "env.yaml", "--split", "all", "--episodes", "1")  # no scene to train on
    code, _, error = ae_env("record", "--policy", "average", "-o", "ae/mine-v0", *options)
    assert code == 0, error
    write_raws(tmp_path / "grid" / "b", tuple(GRID)[1:], seed=1)
    policies = ("--policy", "best_fixed", "--policy", "average", "--policy", "oracle")
    code, out, _ = ae_env("evaluate", *policies, *options, "--frames", "2", "--out", "out")
    assert (code, "best_fixed" in out) == (0, True)


# -- learners of `examples/learners.py`: each is judged from its file as it was --------------------


@pytest.mark.parametrize("name", learners.NAMES)
def test_a_learner_trains_and_its_file_is_judged_alike(name: str, tmp_path: Path) -> None:
    off_policy = name in ("dqn", "qrdqn", "sac", "drl_ae")
    changed = {"learning_starts": 64} if off_policy else {}
    moving = learners.load(name)[0]["task"] != learners.STILL
    exam = ("bundled:small", "test", 2 if moving else None)
    given = {"out": tmp_path, "scenes": "bundled:small", "exam": exam, **changed}
    if name == "a2c":  # a run of other settings is trained anew
        learners.train(name, 1, 1_024, **given, learning_rate=0.1)
    rows = learners.train(name, 1, 1_024, **given)
    assert learners.train(name, 1, 1_024, **given) == rows  # read: the seconds are the same
    assert rows[-1]["frames"] == 1_024
    assert rows[-1]["wall_seconds"] > 0.0
    test = {"scenes": "bundled:small", "split": "test", "observation": "statistics"}
    test |= {"grid": "video", "delay": learners.DELAY} if moving else {}
    context = PolicyContext.from_envs(envs_of(test, num_envs=1, frames=1))
    weights = tmp_path / f"{name}-1.safetensors"
    policy = make_policy(f"{learners.__file__}:Learnt?weights={weights}", context)
    if moving:  # without the tables of its light once more, which take longest
        again = learners.EXAMS[moving, *exam].score(policy)
    else:
        again = evaluate({"it": policy}, test).normalised("it")
    assert again == pytest.approx(rows[-1]["score"], abs=1e-6)


def test_actions_as_the_wrapper_has_them_and_changes_of_them() -> None:
    """A change of zero keeps the settings; of 4 stops of time, the nearest of the grid is."""
    envs = make_envs(num_envs=64)
    wrapper, grid = VectorContinuousActions(envs), envs.unwrapped.grid
    actions = np.random.default_rng(0).uniform(-1.2, 1.2, (64, 3)).astype(np.float32)
    envs.reset(seed=0)
    wanted = wrapper.actions(actions)
    np.testing.assert_array_equal(learners.ApexActions(grid, 64).states(actions), wanted)
    changes = learners.ApexActions(grid, 64, stops=4.0)
    changes.begin({"settings": encode_settings(grid.apex)})
    np.testing.assert_array_equal(changes.states(np.zeros((64, 3))), np.arange(64))
    states = changes.states(np.tile([0.0, 1.0, 0.0], (64, 1)))
    shorter = {1 / 2: 1 / 15, 1 / 15: 0.008, 0.008: 0.001, 0.001: 0.001}  # the nearest to 1/16
    for state, before in zip(states.tolist(), grid.states, strict=True):
        wanted = before.iso, shorter[before.exposure_time], before.f_number
        assert (grid[state].iso, grid[state].exposure_time, grid[state].f_number) == wanted


def test_missing_weights_are_named() -> None:
    context = PolicyContext.from_envs(make_envs(1))
    with pytest.raises(ValueError, match=r"`weights` \(=.none\.safetensors.\)"):
        make_policy(f"{learners.__file__}:Learnt?weights=none.safetensors", context)
