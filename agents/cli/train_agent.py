"""``ae-env train``: an agent from a YAML file."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from agents.cli.console import (
    Device,
    OwnSeed,
    make_folder,
    print_files,
    print_line,
    progress_bars,
    torch_device,
)


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
    from agents.learning.training import load_config, train_agent
    from simulator.utils.files import sibling

    device = torch_device(device)
    agent = load_config(config)
    file = sibling(out, ".json")
    make_folder(file.parent, file=file)
    if seed is not None:
        agent = agent.with_seed(seed)
    with progress_bars() as progress, progress(f"training {agent.agent}") as task:

        def report(done: int, total: int, values: dict[str, float]) -> None:
            task(done, total, ", ".join(f"{k} {v:.3f}" for k, v in values.items()))

        train_agent(agent, out, progress=report, device=device, tensorboard=tensorboard)
    print_files({"weights": sibling(out, ".safetensors"), "description": file})
    print_line("next: " + shlex.join(["ae-env", "evaluate", "--policy", f"{agent.agent}:{out}"]))
