"""From a YAML file to a trained agent: the one place where configurations become objects."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, TypeAdapter, ValidationError, model_validator

from ae_env.utils.checks import did_you_mean
from agents.learning.agent_weights import load_agent, sibling
from agents.learning.regression import RegressionTraining
from simulator.utils.config_file import Configuration, load_yaml, one_line

#: Called with frames done, frames in all, and the latest losses.
Progress = Callable[[int, int, dict[str, float]], None]


class AgentConfig(Configuration):
    """Everything that decides a training.

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
        if self.agent == "ppo":
            hyperparameters.check_batch(self.num_envs)
        try:
            json.dumps(self.card())
        except TypeError as error:  # found out before the training, not when it is saved
            raise ValueError(f"every entry must be a JSON value: {error}") from error
        return self

    def hyperparameters(self) -> Any:
        """`training` as the dataclass of the agent."""
        if self.agent == "regression":
            kind: Any = RegressionTraining
        else:
            from agents.learning.ppo import PPOTraining as kind
        known = [field.name for field in fields(kind)]
        for name, value in self.training.items():
            if isinstance(value, bool):
                raise ValueError(f"training.{name} (={value!r}) should not be true or false")
            if name not in known:
                hint = did_you_mean(name, known)
                raise ValueError(f"training.{name} is unknown: the entries are {known}{hint}")
        try:
            return TypeAdapter(kind).validate_python(self.training)
        except ValidationError as error:
            raise ValueError(one_line(error, "training.")) from error

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
        return {**self.model_dump(), "training": asdict(self.hyperparameters())}


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

    A training that was interrupted goes on at its checkpoint, beside `out`; one that is complete is
    not repeated.

    Args:
        config: What to train.
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
    from agents.policy import PolicyContext

    envs = gym.make_vec(
        "ae_env/AutoExposure-v0",
        num_envs=config.num_envs,
        autoreset_mode="SAME_STEP",
        **config.environment,
    )
    arguments: dict[str, Any] = {"checkpoint": sibling(out, ".checkpoint"), "device": device}
    network: Any
    with closing(envs), _logged(progress, tensorboard) as callback:
        arguments |= {"progress": callback, "identity": config.card()}
        context = PolicyContext.from_envs(envs)
        if config.agent == "regression":
            from agents.learning.regression import save_regression, train_regression

            network = train_regression(envs, config.hyperparameters(), **arguments)
            save_regression(out, network, context, config.card())
        else:
            from agents.learning.ppo import save_ppo, train_ppo

            network = train_ppo(envs, config.hyperparameters(), **arguments)
            save_ppo(out, network, context, config.card())
    sibling(out, ".checkpoint").unlink(missing_ok=True)
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
    writer = SummaryWriter(str(folder))

    def report(done: int, total: int, values: dict[str, float]) -> None:
        for name, value in values.items():
            writer.add_scalar(f"train/{name}", value, done)
        if progress is not None:
            progress(done, total, values)

    with writer:
        yield report
