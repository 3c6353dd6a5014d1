"""From a YAML file to a trained agent: the one place where configurations become objects."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from agents.regression import RegressionTraining
from agents.weights import load_agent

#: Called with frames done, frames in all, and the latest losses.
Progress = Callable[[int, int, dict[str, float]], None]


class AgentConfig(BaseModel):
    """Everything that decides a training.

    Args:
        agent: ``"regression"`` or ``"ppo"``.
        environment: Arguments of ``ae_env/AutoExposure-v0``.
        num_envs: Episodes side by side.
        training: Hyperparameters, those of `RegressionTraining` or `PPOTraining`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    agent: Literal["regression", "ppo"]
    environment: dict[str, Any] = Field(default_factory=dict)
    num_envs: int = Field(default=64, ge=1, le=4096)
    training: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _check(self) -> AgentConfig:
        from ae_env.options import EnvOptions

        self.hyperparameters()
        EnvOptions.from_kwargs(self.environment)
        return self

    def hyperparameters(self) -> Any:
        """`training` as the dataclass of the agent."""
        if self.agent == "regression":
            kind: Any = RegressionTraining
        else:
            from agents.ppo import PPOTraining as kind
        return TypeAdapter(kind, config=ConfigDict(extra="forbid")).validate_python(self.training)

    def with_seed(self, seed: int) -> AgentConfig:
        """The same training with another seed."""
        return self.model_copy(update={"training": {**self.training, "seed": seed}})

    def card(self) -> dict[str, Any]:
        """JSON values that identify the training, every hyperparameter spelled out."""
        return {**self.model_dump(), "training": asdict(self.hyperparameters())}


def load_config(path: str | Path) -> AgentConfig:
    """The configuration in a YAML file.

    Raises:
        ValueError: If the file is missing or not YAML, or an entry is unknown or out of range; the
            message names the file and the entry.
    """
    file = Path(path).expanduser()
    if not file.is_file():
        raise ValueError(f"`config` (={str(path)!r}): there is no such file")
    try:
        return AgentConfig.model_validate(yaml.safe_load(file.read_text(encoding="utf-8")))
    except (yaml.YAMLError, ValidationError) as error:
        raise ValueError(f"`config` (={str(path)!r}) is not a training: {error}") from error


def is_trained(config: AgentConfig, out: Path) -> bool:
    """Whether `out` holds an agent that this very training made."""
    try:
        _, card = load_agent(out, config.agent)
    except (FileNotFoundError, ValueError):
        return False
    return card["training"] == config.card()


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
    arguments: dict[str, Any] = {"checkpoint": out.with_suffix(".checkpoint"), "device": device}
    callback = _logged(progress, tensorboard)
    network: Any
    if config.agent == "regression":
        from agents.regression import save_regression, train_regression

        network = train_regression(envs, config.hyperparameters(), progress=callback, **arguments)
        save_regression(out, network, PolicyContext.from_envs(envs), config.card())
    else:
        from agents.ppo import save_ppo, train_ppo

        network = train_ppo(envs, config.hyperparameters(), progress=callback, **arguments)
        save_ppo(out, network, PolicyContext.from_envs(envs), config.card())
    envs.close()
    return out


def _logged(progress: Progress | None, folder: Path | None) -> Progress | None:
    """`progress` that also writes each value to TensorBoard."""
    if folder is None:
        return progress
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

    return report
