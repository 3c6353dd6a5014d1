"""From a YAML file to a trained agent: the one place where configurations become objects."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, ValidationError, model_validator

from agents.learning.agent_weights import describe_agent, load_agent, save_agent
from agents.learning.regression_training import RegressionTraining, train_regression
from agents.parallel import check_stop, run_in_parallel, tell
from agents.policy import PolicyContext
from simulator.utils.config_file import Configuration, load_yaml, one_line
from simulator.utils.files import sibling

if TYPE_CHECKING:
    from agents.learning.ppo import PPOTraining

#: Called with frames done, frames in all, and the latest losses.
Progress = Callable[[int, int, dict[str, float]], None]


class AgentConfig(Configuration):
    """A training of an agent.

    Args:
        agent: ``"regression"`` or ``"ppo"``.
        environment: Arguments of ``ae_env/AutoExposure-v0``.
        num_envs: Episodes side by side.
        training: Hyperparameters, those of `RegressionTraining` or `PPOTraining`.
    """

    agent: Literal["regression", "ppo"]
    environment: dict[str, Any] = Field(default_factory=dict)
    num_envs: int = Field(default=64, ge=1, le=4096)
    training: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _check(self) -> AgentConfig:
        from ae_env.options import EnvOptions

        hyperparameters = self.hyperparameters()
        try:
            options = EnvOptions.from_kwargs(self.environment)
            options.make_grid(), options.make_camera(), options.make_scorer()
            options.make_lighting()
        except ValueError as error:
            raise ValueError(f"environment: {error}") from error
        if options.observation != "uint8":
            raise ValueError(
                f"environment: `observation` (={options.observation!r}) must be 'uint8', which is "
                "what the agents' networks take"
            )
        if not isinstance(hyperparameters, RegressionTraining):
            hyperparameters.check_batch(self.num_envs)
        try:
            json.dumps(self.card())
        except TypeError as error:  # raises before the training, not when the agent is saved
            raise ValueError(f"every entry must be a JSON value: {error}") from error
        return self

    def hyperparameters(self) -> RegressionTraining | PPOTraining:
        """`training` as the hyperparameters of the agent, defaults filled in."""
        kind: type[RegressionTraining | PPOTraining] = RegressionTraining
        if self.agent == "ppo":
            from agents.learning.ppo import PPOTraining as kind
        try:
            return kind.model_validate(self.training)
        except ValidationError as error:
            raise ValueError(one_line(error, "training.", kind)) from error

    def with_seed(self, seed: int) -> AgentConfig:
        """The same training with another seed.

        Raises:
            ValueError: If the seed is out of range.
        """
        changed = self.model_copy(update={"training": {**self.training, "seed": seed}})
        changed.hyperparameters()
        return changed

    def card(self) -> dict[str, Any]:
        """JSON values that identify the training, every hyperparameter spelled out."""
        return {**self.model_dump(), "training": self.hyperparameters().model_dump()}


def load_config(path: str | Path) -> AgentConfig:
    """The configuration in a YAML file.

    Raises:
        ValueError: If the file is missing or not YAML, or an entry is unknown or out of range; the
            message names the file and the entry.
    """
    return load_yaml(path, AgentConfig)


def is_trained(config: AgentConfig, out: Path) -> bool:
    """Whether `out` holds an agent that this very training made."""
    try:
        _, card = load_agent(out, config.agent)
    except (FileNotFoundError, ValueError):
        return False
    # Through JSON, as the card was: a tuple comes back as a list.
    return bool(card["training"] == json.loads(json.dumps(config.card())))


def train_agent(
    config: AgentConfig,
    out: Path,
    *,
    progress: Progress | None = None,
    tensorboard: Path | None = None,
    device: str = "cpu",
) -> Path:
    """Trains an agent and writes it to ``out.safetensors`` and ``out.json``.

    A training that was interrupted goes on from its checkpoint, ``out.checkpoint``; one that is
    complete is not repeated.

    Args:
        config: The training.
        out: File name without suffix.
        progress: Called now and then.
        tensorboard: Folder for a TensorBoard log.
        device: Torch device of the network.

    Returns:
        `out`.
    """
    if is_trained(config, out):
        return out
    import gymnasium as gym

    import ae_env  # noqa: F401  (registers the environment)

    envs = gym.make_vec(
        "ae_env/AutoExposure-v0",
        num_envs=config.num_envs,
        autoreset_mode="SAME_STEP",
        **config.environment,
    )
    training, checkpoint = config.hyperparameters(), sibling(out, ".checkpoint")
    with closing(envs), _logged(progress, tensorboard) as report:
        common: dict[str, Any] = {
            "checkpoint": checkpoint,
            "progress": report,
            "device": device,
            "identity": config.card(),
        }
        if isinstance(training, RegressionTraining):
            network: Any = train_regression(envs, training, **common)
        else:
            from agents.learning.ppo import train_ppo

            network = train_ppo(envs, training, **common)
        context = PolicyContext.from_envs(envs)
    save_agent(out, config.agent, network, describe_agent(network.width, context, config.card()))
    checkpoint.unlink(missing_ok=True)
    return out


@contextmanager
def _logged(progress: Progress | None, folder: Path | None) -> Iterator[Progress | None]:
    """`progress` that also writes each value to TensorBoard."""
    if folder is None:
        yield progress
        return
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise ImportError("a TensorBoard log needs: pip install 'ae-env[tensorboard]'") from error

    def report(done: int, total: int, values: dict[str, float]) -> None:
        for name, value in values.items():
            writer.add_scalar(f"train/{name}", value, done)
        if progress is not None:
            progress(done, total, values)

    with SummaryWriter(str(folder)) as writer:
        yield report


@dataclass(frozen=True)
class TrainingJob:
    """One of several agents to train at once.

    Args:
        name: Shown to the user.
        config: The training.
        out: File name of the agent, without suffix.
        device: Torch device of the network.
    """

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
    """Trains every job that is not trained yet, each in a process of its own.

    Args:
        jobs: Agents to train.
        workers: Processes at a time, each with its share of the cores; by default one per core.
        progress: Called with the job's name, frames done, frames in all, and losses.

    Raises:
        KeyboardInterrupt: After Ctrl-C; every job has its checkpoint, the same call resumes.
    """
    waiting = [job for job in jobs if not is_trained(job.config, job.out)]
    run_in_parallel(_train, waiting, workers=workers, progress=progress)


def _train(job: TrainingJob) -> None:
    last = 0

    def report(done: int, total: int, values: dict[str, float]) -> None:
        nonlocal last
        check_stop()
        if done == total or done - last >= total // 200:
            last = done
            tell(job.name, done, total, values)

    train_agent(job.config, job.out, progress=report, device=job.device)
