"""``ae-env train-simulator``: the networks of the simulator from a YAML file."""

from __future__ import annotations

import contextlib
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ae_env.utils.presets import find_config
from agents.cli.console import (
    Device,
    OwnSeed,
    command_line,
    make_folder,
    print_files,
    print_line,
    progress_bars,
    torch_device,
)

if TYPE_CHECKING:
    pass


def train_simulator(
    config: Annotated[Path, typer.Argument(help="YAML such as configs/simulator/compact.yaml.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder; by default runs/simulator/NAME-OF-THE-CONFIG.")
    ] = None,
    seed: OwnSeed = None,
    device: Device = "auto",
    tensorboard: Annotated[bool, typer.Option(help="Log to OUT/tensorboard.")] = True,
) -> None:
    """Train the simulator's modules stage by stage; a second run resumes the first.

    Example: `ae-env train-simulator configs/simulator/compact.yaml`

    Several processes or GPUs: `accelerate launch -m agents.cli train-simulator CONFIG`.
    """
    from simulator.networks.weights import build_modules
    from simulator.training.train import load_config, load_start, train_and_save

    training = load_config(find_config(config))
    if seed is not None:
        training = training.model_copy(update={"seed": seed})
    if training.start is not None:
        load_start(training, build_modules(training.preset))
    folder = Path("runs/simulator") / config.stem if out is None else out
    make_folder(folder)
    device = torch_device(device)
    with progress_bars() as progress:
        tasks: dict[str, Any] = {}
        with contextlib.ExitStack() as stack:

            def report(name: str, share: float, values: dict[str, float]) -> None:
                if name not in tasks:
                    tasks[name] = stack.enter_context(progress(name))
                tasks[name](share, 1.0, ", ".join(f"{k} {v:.3f}" for k, v in values.items()))

            weights = train_and_save(
                training,
                folder / training.preset,
                command=command_line(),
                device=device,
                tensorboard=tensorboard,
                progress=report,
            )
    print_files({"weights": weights, "model card": weights.with_suffix(".json")})
    if training.preset in ("compact", "paper"):
        command = shlex.join(["ae-env", "simulate", "RAW", "--weights", str(weights)])
        print_line(f"next: {command} ...")
