"""From a YAML file to a trained agent, or several at once: here configurations become objects."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import gymnasium as gym
import numpy as np
import pandas as pd
from pydantic import Field, ValidationError, model_validator

from ae_env.options import EnvOptions
from agents.learning.forecaster import ForecasterTraining, train_forecaster
from agents.learning.networks import Progress, Session
from agents.learning.policy_file import load_agent, save_agent
from agents.learning.regression import RegressionTraining, train_regression
from agents.learning.workers import run_in_parallel, send_progress
from agents.policy import PolicyContext
from simulator.utils.checks import check_word, import_extra
from simulator.utils.config_file import Configuration, load_yaml, one_line
from simulator.utils.files import sibling, write_atomically

if TYPE_CHECKING:
    from agents.learning.ppo import PPOTraining

    Hyperparameters = RegressionTraining | PPOTraining | ForecasterTraining

#: Rows of a whole training.
ROWS = 200


class AgentConfig(Configuration):
    """A training of an agent, in an environment of a task; a forecaster needs none."""

    agent: Literal["regression", "ppo", "forecaster"]
    task: Literal["ae_env/AutoExposure-v0", "ae_env/AutoExposureVideo-v0"] = (
        "ae_env/AutoExposure-v0"
    )
    environment: dict[str, Any] = Field(default_factory=dict)  # arguments of the environment
    #: Actions of an episode; by default those of the task.
    max_episode_steps: int | None = Field(default=None, ge=1, le=10**6)
    num_envs: int = Field(default=64, ge=1, le=4096)  # episodes side by side
    #: Hyperparameters: `RegressionTraining`, `PPOTraining` or `ForecasterTraining`.
    training: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _check(self) -> AgentConfig:
        hyperparameters: Any = self.hyperparameters()
        if self.agent == "forecaster":
            for name in sorted(self.model_fields_set - {"agent", "training"}):
                unused = type(self).model_fields[name].get_default(call_default_factory=True)
                if getattr(self, name) != unused:
                    raise ValueError(f"`{name}` is not used by a forecaster: it sees no pictures")
        try:
            options = EnvOptions.from_kwargs(self.environment)
            options.make_grid(), options.make_camera(), options.make_scorer()
            options.make_lighting()
            taken = ("uint8", "statistics") if self.agent == "ppo" else ("uint8",)
            check_word("observation", options.observation, taken)  # that its network takes
            if options.device is not None:
                raise ValueError(
                    f"`device` (={options.device!r}) must be None: it trains on arrays"
                )
        except ValueError as error:
            raise ValueError(f"environment: {error}") from error
        if self.agent == "ppo":
            hyperparameters.check_batch(self.num_envs)
        try:
            json.dumps(self.card())
        except TypeError as error:  # raises before the training, not when the agent is saved
            raise ValueError(f"every entry must be a JSON value: {error}") from error
        return self

    def hyperparameters(self) -> Hyperparameters:
        """`training` as the hyperparameters of the agent, defaults filled in."""
        kind: type[Hyperparameters] = RegressionTraining
        if self.agent == "ppo":
            from agents.learning.ppo import PPOTraining as kind
        elif self.agent == "forecaster":
            kind = ForecasterTraining
        try:
            return kind.model_validate(self.training)
        except ValidationError as error:
            raise ValueError(one_line(error, "training.", kind)) from error

    def with_seed(self, seed: int) -> AgentConfig:
        """The same training with another seed, which is checked."""
        changed = self.model_copy(update={"training": {**self.training, "seed": seed}})
        changed.hyperparameters()
        return changed

    def card(self) -> dict[str, Any]:
        """JSON values that identify the training, every hyperparameter spelled out."""
        return {**self.model_dump(), "training": self.hyperparameters().model_dump()}


def load_config(path: str | Path) -> AgentConfig:
    """The configuration in a YAML file; a `ValueError` names the file and the wrong entry."""
    return load_yaml(path, AgentConfig)


def is_trained(config: AgentConfig, out: Path) -> bool:
    """Whether `out` holds an agent that this very training made."""
    try:
        _, card = load_agent(out, config.agent)
    except (FileNotFoundError, ValueError):
        return False
    try:  # what an earlier version did not know has its default
        known = AgentConfig.model_validate(card["training"]).card()
    except ValueError:
        return False
    # Through JSON, as the card was: a tuple comes back as a list.
    return bool(known == json.loads(json.dumps(config.card())))


def train_agent(
    config: AgentConfig,
    out: Path,
    *,
    progress: Progress | None = None,
    tensorboard: Path | None = None,
    device: str = "cpu",
) -> Path:
    """Trains an agent and writes it to ``out.safetensors`` and ``out.json``.

    Beside them, ``out.csv`` is its learning curve (`LearningCurve`). A training that was
    interrupted goes on from ``out.checkpoint``; one that is complete is not repeated. `tensorboard`
    is a folder for a log. Returns `out`.
    """
    if is_trained(config, out):
        return out
    training, checkpoint = config.hyperparameters(), sibling(out, ".checkpoint")
    takers: list[Progress] = [LearningCurve(sibling(out, ".csv"))]
    takers += [] if progress is None else [progress]

    def report(done: int, total: int, values: dict[str, float]) -> None:
        for take in takers:
            take(done, total, values)

    with ExitStack() as stack:
        if tensorboard is not None:
            takers.insert(0, stack.enter_context(_tensorboard(tensorboard)))
        session, context = Session(checkpoint, report, device, config.card()), None
        if isinstance(training, ForecasterTraining):
            network: Any = train_forecaster(training, session)
        else:
            options = {**config.environment, "autoreset_mode": "SAME_STEP"}
            if config.max_episode_steps is not None:
                options["max_episode_steps"] = config.max_episode_steps
            made = gym.make_vec(f"ae_env:{config.task}", num_envs=config.num_envs, **options)
            envs = stack.enter_context(closing(made))
            context = PolicyContext.from_envs(envs)
            if isinstance(training, RegressionTraining):
                network = train_regression(envs, training, session)
            else:
                from agents.learning.ppo import train_ppo

                network = train_ppo(envs, training, session)
    save_agent(out, config.agent, network, network.width, context, config.card())
    checkpoint.unlink(missing_ok=True)
    return out


@contextmanager
def _tensorboard(folder: Path) -> Iterator[Progress]:
    """Takes each report for TensorBoard's log in `folder`."""
    import_extra("tensorboard", "tensorboard", "a TensorBoard log")
    from torch.utils.tensorboard import SummaryWriter

    def log(done: int, total: int, values: dict[str, float]) -> None:
        for name, value in values.items():
            writer.add_scalar(f"train/{name}", value, done)

    with SummaryWriter(str(folder)) as writer:
        yield log


class LearningCurve:
    """Writes the mean of each reported value over every 200th part of a training to a CSV file.

    A training that was interrupted goes on in its file. A `ValueError` if that is no such curve.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        old = load_curve(path) if path.is_file() else {}
        self._rows: list[Any] = pd.DataFrame(old).to_dict("records")
        self._recent: list[dict[str, float]] = []

    def __call__(self, done: int, total: int, values: dict[str, float]) -> None:
        """Take in what the training reports after `done` of `total` frames."""
        # What another training left here, or this one after its checkpoint.
        names = {"frames", *values}
        while self._rows and (self._rows[-1]["frames"] >= done or self._rows[-1].keys() != names):
            self._rows.pop()
        self._recent.append(values)
        last = self._rows[-1]["frames"] if self._rows else 0
        if done != total and done - last < total / ROWS:
            return
        means = {name: float(np.mean([v[name] for v in self._recent])) for name in values}
        self._rows.append({"frames": done, **means})
        self._recent = []
        frame = pd.DataFrame(self._rows, columns=["frames", *values]).astype({"frames": int})
        text = frame.to_csv(index=False, float_format="%.6g", na_rep="nan", lineterminator="\n")
        write_atomically(self.path, text)


def load_curve(path: Path) -> dict[str, list[float]]:
    """Columns of a file of `LearningCurve`, ``frames`` and values; a `ValueError` if it is none."""
    try:
        rows = list(csv.DictReader(path.read_text().splitlines()))
        return {name: [float(row[name]) for row in rows] for name in ("frames", *rows[0])}
    except (TypeError, ValueError, LookupError) as error:
        raise ValueError(f"{path} is not a learning curve of `ae-env train`") from error


class TrainingJob(NamedTuple):
    """One of several agents to train at once, see `train_agent`; `name` is shown to the user."""

    name: str
    config: AgentConfig
    out: Path
    device: str = "cpu"


def train_in_parallel(
    jobs: Sequence[TrainingJob],
    *,
    workers: int | None = None,
    progress: Callable[[str, int, int, dict[str, float]], None] | None = None,
) -> None:
    """Trains every job that is not trained yet, each in a process of its own (`run_in_parallel`).

    `progress` is called with the job's name, frames done, frames in all, and losses. After Ctrl-C
    the same call resumes from the checkpoints.
    """
    waiting = [job for job in jobs if not is_trained(job.config, job.out)]
    run_in_parallel(_train, waiting, workers=workers, progress=progress)


def _train(job: TrainingJob) -> None:
    last = 0

    def report(done: int, total: int, values: dict[str, float]) -> None:
        nonlocal last
        if done == total or done - last >= total // ROWS:
            last = done
            send_progress(job.name, done, total, values)

    train_agent(job.config, job.out, progress=report, device=job.device)
