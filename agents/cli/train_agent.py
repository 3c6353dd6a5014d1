"""``ae-env train``: an agent from a YAML file."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ae_env.utils.presets import find_config
from agents.cli.console import (
    Device,
    OwnSeed,
    make_folder,
    print_files,
    print_line,
    progress_bars,
    torch_device,
)

if TYPE_CHECKING:
    from agents.learning.training import AgentConfig

#: Evaluations of the tasks; that of still light is the command's own default.
_PRESETS = {"ae_env/AutoExposureVideo-v0": "video", "ae_env/ExposureBracket-v0": "bracket"}


def train(
    config: Annotated[Path, typer.Argument(help="YAML such as configs/regression.yaml.")],
    out: Annotated[Path, typer.Option(help="File name of the agent, without suffix.")] = Path(
        "runs/agent"
    ),
    seed: OwnSeed = None,
    device: Device = "cpu",
    tensorboard: Annotated[Path | None, typer.Option(help="Folder for a TensorBoard log.")] = None,
) -> None:
    """Train an agent; a second run resumes the first.

    Example: `ae-env train configs/ppo.yaml --out runs/ppo`
    """
    from agents.learning.training import load_config, load_curve, train_agent
    from agents.report.plots import plot_learning
    from simulator.utils.files import sibling

    device = torch_device(device)
    agent = load_config(find_config(config))
    file = sibling(out, ".json")
    make_folder(file.parent, file=file)
    if seed is not None:
        agent = agent.with_seed(seed)
    with progress_bars() as progress, progress(f"training {agent.agent}") as task:

        def report(done: int, total: int, values: dict[str, float]) -> None:
            task(done, total, ", ".join(f"{k} {v:.3f}" for k, v in values.items()))

        train_agent(agent, out, progress=report, device=device, tensorboard=tensorboard)
    files = {"weights": sibling(out, ".safetensors"), "description": file}
    curve = sibling(out, ".csv")
    if curve.is_file():
        picture = plot_learning(sibling(out, ".png"), {agent.agent: load_curve(curve)})
        files |= {"learning curve": curve, "its picture": picture}
    print_files(files)
    print_line("next: " + shlex.join(["ae-env", "evaluate", *_evaluation(agent, out)]))


def _evaluation(agent: AgentConfig, out: Path) -> list[str]:
    """Options that evaluate the agent on what it was trained for."""
    if agent.agent == "forecaster":
        return ["--preset", "video", "--policy", f"regression:video?foresight={out}"]
    words = ["--policy", f"{agent.agent}:{out}"]
    preset = _PRESETS.get(agent.task)
    if preset is not None:
        words = ["--preset", preset, *words]
    if preset is None and isinstance(agent.environment.get("grid"), str):
        words += ["--grid", agent.environment["grid"]]
    for name in ("observation", "resolution"):
        if name in agent.environment:
            words += [f"--{name}", str(agent.environment[name])]
    return words if agent.environment.get("sensors", True) else [*words, "--no-sensors"]
