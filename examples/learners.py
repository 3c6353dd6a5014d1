"""Learners of Stable-Baselines3 as they are, on the statistics of an image processor.

`python examples/learners.py dqn sac` trains the learners of configs/learners, five seeds each, and
writes runs/learners/dqn-0.safetensors and a .json with the run and its learning curve, and so on.
A run that is finished is not trained again, one of other frames, scenes or settings is. Then:

    ae-env evaluate --observation statistics \\
        --policy "examples/learners.py:Learnt?weights=runs/learners/dqn-0.safetensors"

`python examples/learners.py meters` scores light meters on the same episodes.

`drl_ae` is written after DRL-AE (Lee et al., Learning to Control Camera Exposure via Reinforcement
Learning, CVPR 2024): SAC, changes of the exposure as actions, a history of mean intensities and
settings as state, a curriculum, and randomised domains. It is no reproduction. What differs:

- Camera: here simulated, with Av, Tv and Sv on a grid of 64 states and delays of 1 (ISO) and 2
  frames; there a real camera, whose exposure time and gain are set.
- Actions: here changes of the wanted Av, Tv and Sv by up to 4 stops, of which the grid's nearest
  state is taken; there changes of exposure time and gain.
- State: here what an average meter read of the whole frame, clipping and what was asked for, in 12
  frames, and the settings; there intensities of a patch of the frame, over the last frames.
- Reward: here the task's, the score of a frame minus its visible jump; there terms of intensity,
  flicker and attributes of the image.
- Curriculum: here a third of the frames each in still light, in drifts, lamps and sines, and in all
  kinds of the training split; there levels from fixed to changing light, in a dark room with lamps.
- Randomised domains: here what the training of every learner has, scenes of many places and their
  light, start, motion, defocus and noise; there patches, among others, of that dark room.
- Network, budget and hyperparameters: those of configs/learners/drl_ae.yaml; none is the paper's.
"""

import importlib
import itertools
import json
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
import yaml
from safetensors import safe_open
from safetensors.torch import load_model, save_model
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnvWrapper

import ae_env  # noqa: F401  (registers the environments)
from ae_env.observation import PEDESTAL, SETTINGS_RANGES, decode_settings
from agents import Policy, PolicyContext, make_policy
from agents.evaluation.engine import EvaluationRun, TrainedPolicy
from agents.evaluation.evaluation_plan import EvaluationPlan
from agents.learning.networks import MeterHistory, with_history
from agents.learning.sb3_adapter import SB3VectorAdapter, WithHistory
from simulator.utils.checks import check_word
from simulator.utils.files import data_folder

CONFIGS = Path(__file__).parents[1] / "configs" / "learners"
NAMES = ("ppo", "a2c", "dqn", "qrdqn", "sac", "ppo_video", "recurrent_ppo", "drl_ae")
FRAMES, SEEDS, CHECKPOINTS, EXAM = 98_304, range(5), 10, ("bundled", "test", 32)
STILL, MOVING = "ae_env/AutoExposure-v0", "ae_env/AutoExposureVideo-v0"
METERS = ("average:P", "matrix:P", "average:tuned", "matrix:tuned")
DELAY = {"iso": 1, "exposure_time": 2, "f_number": 2}


class Statistics(BaseFeaturesExtractor):
    """Two layers on log luminance of 6 x 8 zones, histogram, clipped shares, settings, sensors.

    And on the history, where there is one; with `frames` false on that and the settings alone.
    """

    def __init__(self, space, width=256, frames=True):
        super().__init__(space, width)
        self.names = [n for n in space if n != "raw" and (frames or n in ("history", "settings"))]
        numbers = sum(int(np.prod(space[name].shape)) for name in self.names)
        self.frames = frames
        layers = [torch.nn.Linear(numbers + 192 * frames, width), torch.nn.ReLU()]
        self.body = torch.nn.Sequential(*layers, torch.nn.Linear(width, width), torch.nn.ReLU())
        ranges = torch.tensor(SETTINGS_RANGES, dtype=torch.float32)
        self.register_buffer("ranges", ranges, persistent=False)

    def forward(self, observations):
        """Features (B, width); SB3 has divided the zones by 255."""
        parts = [observations[name] for name in self.names]
        if self.frames:
            signal = (1 + PEDESTAL) * observations["raw"].square() - PEDESTAL
            signal = torch.nn.functional.avg_pool2d(signal, 2).flatten(1)
            low, high = self.ranges.T
            av, tv, sv = (low + (observations["settings"] + 1) / 2 * (high - low)).T
            ev100 = (av + tv - sv + 5)[:, None]
            parts.append((signal.clamp(min=2**-12).log2() + ev100 - 3) / 8)
        return self.body(torch.cat(parts, dim=1))


class ApexActions:
    """States nearest to what actions (N, 3) in [-1, 1] ask for; Av, Tv and Sv are meant.

    They are on the scale of `ae_env.wrappers.ContinuousActions`, or changes by up to `stops` of
    what was asked for last.
    """

    def __init__(self, grid, num_envs, stops=None):
        self.apex, self.stops = grid.apex, stops
        self.low, self.high = self.apex.min(axis=0), self.apex.max(axis=0)
        self.asked = np.zeros((num_envs, 3))

    def begin(self, observations, rows=slice(None)):
        """Episodes begin in `rows` with the settings that are observed."""
        self.asked[rows] = np.stack(decode_settings(observations["settings"]), axis=-1)[rows]

    def states(self, actions):
        """(N,) int64."""
        actions = np.clip(actions, -1.0, 1.0)
        wanted = self.low + (actions + 1) / 2 * (self.high - self.low)
        if self.stops is not None:
            wanted = np.clip(self.asked + self.stops * actions, self.low, self.high)
        self.asked = wanted
        return ((wanted[:, None] - self.apex) ** 2).sum(axis=-1).round(9).argmin(axis=-1)


class ApexVecEnv(VecEnvWrapper):
    """Environments that take `ApexActions`."""

    def __init__(self, venv, grid, stops):
        super().__init__(venv, action_space=gym.spaces.Box(-1.0, 1.0, (3,), np.float32))
        self.mapping = ApexActions(grid, venv.num_envs, stops)

    def reset(self):
        """Begins an episode in every environment."""
        observations = self.venv.reset()
        self.mapping.begin(observations)
        return observations

    def step_async(self, actions):
        """Takes the step with the nearest states."""
        self.venv.step_async(self.mapping.states(actions))

    def step_wait(self):
        """Takes the step."""
        observations, rewards, dones, infos = self.venv.step_wait()
        self.mapping.begin(observations, dones)
        return observations, rewards, dones, infos


def load(name):
    """The configuration of a learner, and its class."""
    check_word("learner", name, NAMES)
    config = yaml.safe_load((CONFIGS / f"{name}.yaml").read_text())
    module, _, algorithm = config["algorithm"].rpartition(".")
    return config, getattr(importlib.import_module(module), algorithm)


def network_arguments(config):
    """The arguments of SB3's policies: one features extractor for all learners."""
    return {"features_extractor_class": Statistics, **config["settings"].get("policy_kwargs", {})}


class Learnt(Policy):
    """A trained learner, from its file `weights`, or from its `network` and its `config`."""

    def __init__(self, context, weights=None, network=None, config=None):
        super().__init__(context)
        if network is None:
            if weights is None or not Path(weights).is_file():
                rule = "must be a file that `python examples/learners.py` wrote"
                raise ValueError(f"`weights` (={weights!r}) {rule}")
            if "histogram" not in context.observation_space.spaces:
                raise ValueError('learners see statistics: give `observation="statistics"`')
            with safe_open(weights, "pt") as file:
                config, algorithm = load((file.metadata() or {}).get("learner"))
            space, continuous = context.observation_space, gym.spaces.Box(-1, 1, (3,))
            if config.get("history"):
                space = with_history(space, config["history"])
            states = gym.spaces.Discrete(len(context.grid))
            network = algorithm.policy_aliases[config["policy"]](
                space,
                continuous if "stops" in config else states,
                lambda _: 0.0,
                **network_arguments(config),
            )
            load_model(network, weights)
        self.network, self.config = network, config

    def reset(self, num_envs, seed=None):
        """Forgets the frames so far."""
        super().reset(num_envs, seed)
        frames = self.config.get("history")
        self.history = MeterHistory(self.context, num_envs, frames) if frames else None
        self.memory = self.mapping = None

    def act(self, observations, action_masks=None):
        """The best state by the network, of SAC that nearest to its mean; masks are not heeded."""
        shown, begins = dict(observations), np.full(self.num_envs, self.memory is None)
        if self.history:
            shown["history"] = self.history.observe(observations)
        states, self.memory = self.network.predict(shown, self.memory, begins, deterministic=True)
        if "stops" in self.config:
            if self.mapping is None:
                self.mapping = ApexActions(self.context.grid, self.num_envs, self.config["stops"])
                self.mapping.begin(observations)
            states = self.mapping.states(states)
        if self.history:
            self.history.record_action(states)
        return states.astype(np.int64)


class Exam:
    """Normalised score in unseen scenes, 0 of random states and 1 of an oracle."""

    def __init__(self, moving, scenes, split, most):
        grid, condition = "default", {}
        if moving:  # in light of the kinds of the split
            lighting = {"kind": "moving", "kinds": split}
            grid, condition = "video", {"lighting": lighting, "delay": DELAY}
        shown = {"split": split, "resolution": 64, "observation": "statistics"}
        plan = EvaluationPlan(
            environment={"scenes": scenes, "grid": grid, **shown},
            conditions={"test": condition},
            starts=("random",),
            frames=48 if moving else 8,
            max_scenes=most,
        )
        self.run, self.condition = EvaluationRun(plan), plan.conditions["test"]
        self.light = self.run.score_light(self.condition, lambda count: None)

    def score(self, policy):
        """The score of `policy`."""
        track = self.run.run_policy("it", policy, self.condition, self.light, lambda count: None)
        found = {TrainedPolicy("it", "it"): track}
        return self.run.result(self.condition, self.light, found).normalised("it")


class Checkpoints(BaseCallback):
    """Scores after every tenth of the frames; seconds of training, those of scoring excluded."""

    def __init__(self, exam, policy, frames):
        super().__init__()
        self.exam, self.policy, self.frames = exam, policy, frames
        self.rows, self.clocks = [], (time.process_time(), time.perf_counter())

    def _on_step(self):
        return True

    def _on_rollout_start(self):
        due = (len(self.rows) + 1) * self.frames / CHECKPOINTS
        if self.num_timesteps < due:
            return
        now = time.process_time(), time.perf_counter()
        cpu, wall = (b - a for a, b in zip(self.clocks, now, strict=True))
        score = self.exam.score(self.policy)
        row = {"frames": self.num_timesteps, "score": score, "cpu_seconds": cpu}
        self.rows.append({**row, "wall_seconds": wall})
        later = time.process_time(), time.perf_counter()
        self.clocks = tuple(a + e - b for a, b, e in zip(self.clocks, now, later, strict=True))

    _on_training_end = _on_rollout_start


EXAMS = {}


def train(name, seed, frames=FRAMES, out="runs/learners", scenes=None, exam=EXAM, **changed):
    """Trains a learner; writes weights and learning curve, and returns the curve's rows.

    The rows of a finished run are read instead if frames, seed, scenes, exam and configuration are
    the same. `exam` is the set that it is judged on, the split, and how many scenes at most;
    `changed` are settings to try.
    """
    scenes = scenes or ("mixed" if data_folder() else "bundled")
    config, algorithm = load(name)
    config["settings"] |= changed
    settings, moving = dict(config["settings"]), config["task"] != STILL
    run = {"seed": seed, "frames": frames, "scenes": scenes, "exam": [*exam], "config": config}
    run, path = json.loads(json.dumps(run)), Path(out) / f"{name}-{seed}.json"
    if path.is_file():
        found = json.loads(path.read_text())
        if "run" in found and found["run"] == run:  # files of before have a list of rows
            return found["rows"]

    def make(light):
        envs = gym.make_vec(
            config["task"],
            num_envs=64,
            scenes=scenes,
            split="train",
            observation="statistics",
            autoreset_mode="SAME_STEP",
            **config.get("environment", {}),
            **({"lighting": light} if light else {}),
        )
        context, venv = PolicyContext.from_envs(envs), SB3VectorAdapter(envs)
        if config.get("history"):
            venv = WithHistory(venv, context, config["history"])
        if "stops" in config:
            venv = ApexVecEnv(venv, context.grid, config["stops"])
        return context, venv

    torch.set_num_threads(1)
    stages = config.get("stages", [None])
    context, venv = make(stages[0])
    settings["policy_kwargs"] = network_arguments(config)
    model = algorithm(config["policy"], venv, seed=1000 * seed, device="cpu", **settings)
    if (moving, *exam) not in EXAMS:
        EXAMS[moving, *exam] = Exam(moving, *exam)
    policy = Learnt(context, network=model.policy, config=config)
    callback = Checkpoints(EXAMS[moving, *exam], policy, frames)
    for number, light in enumerate(stages):
        if number:
            model.env.close()
            model.set_env(make(light)[1])
        share = -(-frames * (number + 1) // len(stages)) - model.num_timesteps
        model.learn(share, callback, reset_num_timesteps=not number)
    model.env.close()
    path.parent.mkdir(parents=True, exist_ok=True)
    save_model(model.policy, str(path.with_suffix(".safetensors")), {"learner": name})
    path.write_text(json.dumps({"run": run, "rows": callback.rows}))
    return callback.rows


def score_meters():
    """Scores of light meters; what the tuned ones know, they learn in still training scenes."""
    scenes = "mixed" if data_folder() else "bundled"
    options = {"scenes": scenes, "split": "train", "observation": "statistics", "num_envs": 64}
    still = {"grid": "video", "lighting": "static", "delay": 0}
    for task, own in ((STILL, {}), (MOVING, still)):
        exam = Exam(task == MOVING, *EXAM)
        envs = gym.make_vec(task, autoreset_mode="DISABLED", **options, **own)
        for name in METERS:
            policy = make_policy(name, PolicyContext.from_envs(envs))
            if name.endswith("tuned"):
                policy.fit(envs)
            print("moving" if own else "still", name, f"{exam.score(policy):.3f}", flush=True)


if __name__ == "__main__":
    if sys.argv[1:] == ["meters"]:
        score_meters()
        sys.exit()
    for name in sys.argv[1:]:
        if name not in NAMES:
            sys.exit(f"usage: python examples/learners.py [LEARNER ...], of {', '.join(NAMES)}")
    for seed, name in itertools.product(SEEDS, sys.argv[1:] or NAMES):
        print(name, seed, train(name, seed)[-1], flush=True)
