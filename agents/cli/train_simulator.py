"""``ae-env train-simulator``: the networks of the simulator from a YAML file."""

from __future__ import annotations

import contextlib
import os
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ae_env.utils.user_files import find_config
from agents.cli.console import (
    Device,
    OwnSeed,
    command_line,
    console,
    make_folder,
    print_files,
    print_line,
    progress_bars,
    torch_device,
)

if TYPE_CHECKING:
    from simulator.reference.reference_camera import ReferenceScene
    from simulator.training.config import SimulatorConfig
    from simulator.training.crops import DetailPicture

#: Procedural scenes that a training validates on.
_VALIDATION_SCENES = 24


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
    from simulator.training.config import load_config
    from simulator.training.train import load_start, train_and_save

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
                reference_scenes_of,
                detail_pictures_of,
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


def reference_scenes_of(config: SimulatorConfig, split: str) -> Sequence[ReferenceScene]:
    """The scenes of a split that a training's configuration names."""
    from ae_env.scenes.reference_scenes import draped_scenes, mosaic_scenes, reference_scenes
    from simulator import get_camera
    from simulator.utils.files import DATA_VARIABLE, data_folder

    radiance, folder = config.scenes.radiance or "", data_folder()
    if folder is not None:
        radiance = radiance.replace(f"${DATA_VARIABLE}", str(folder))
    radiance = os.path.expandvars(radiance)
    if config.scenes.radiance and ("$" in radiance or not radiance):  # unset, or empty
        console.print(f"{config.scenes.radiance} is not set: training without radiance maps")
        radiance = ""
    data = Path(radiance) if radiance else None
    camera = get_camera(config.camera)
    scenes = reference_scenes(
        split,  # type: ignore[arg-type]
        camera,
        number=config.scenes.procedural if split == "train" else _VALIDATION_SCENES,
        size=config.scenes.size,
        data=data,
        seed=config.seed,
    )
    if data is not None:
        scenes += mosaic_scenes(split, camera, data, size=config.scenes.size)  # type: ignore[arg-type]
    return [*scenes, *draped_scenes(scenes, camera, seed=config.seed)]


def detail_pictures_of(config: SimulatorConfig, split: str) -> Sequence[DetailPicture]:
    """The pictures of a split that the noise stage is trained on."""
    from ae_env.scenes.pictures import detail_pictures
    from simulator.utils.files import data_folder

    return detail_pictures(split, data=data_folder(), seed=config.seed)  # type: ignore[arg-type]
