"""The trained networks that are measured; those that are not there yet are trained first."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import nn

from agents.cli.train_simulator import reference_scenes_of
from simulator import CameraSimulator
from simulator.networks.weights import list_pretrained, load_modules
from simulator.training.config import load_config
from simulator.training.train import train_and_save

#: Called with the task, the share of it that is done, and the latest values.
TrainingProgress = Callable[[str, float, dict[str, float]], None]
FOLDER = Path("runs/simulator")
CONFIGS = Path("configs/simulator")
PRESETS = ("compact", "paper")
BASELINES = ("pc", "dl")


@dataclass(frozen=True, eq=False)
class Models:
    """What is measured.

    Args:
        compact: The simulator that comes with the package.
        paper: The paper's networks; None where they were not trained.
        pc: Baseline of parameter concatenation; None where it was not trained.
        dl: Baseline of decoupled learning; None where it was not trained.
        cards: Model card of each, by name.
        compact_body: ``compact`` with the w and b that the exposure module learnt for the body it
            was trained on, as the paper uses them.
        paper_body: ``paper`` likewise.
    """

    compact: CameraSimulator
    paper: CameraSimulator | None
    pc: nn.Module | None
    dl: nn.Module | None
    cards: dict[str, dict[str, Any]]
    compact_body: CameraSimulator
    paper_body: CameraSimulator | None


def load_models(
    folder: Path = FOLDER, *, train: bool = True, progress: TrainingProgress | None = None
) -> Models:
    """The package's weights and, for what does not come with it, those under `folder`.

    Args:
        folder: Holds ``NAME/NAME.safetensors`` of ``paper``, ``pc``, ``dl``.
        train: Whether to train what is missing by its configuration in ``configs/simulator``.
        progress: Called while training.

    Raises:
        ValueError: If there are no weights of ``compact`` and `train` is False.
    """
    found = {
        name: weights
        for name in (*PRESETS, *BASELINES)
        if (weights := _weights(name, folder, train, progress)) is not None
    }
    if "compact" not in found:
        raise ValueError(f"`folder` (={str(folder)!r}) must hold compact/compact.safetensors")
    loaded = {name: load_modules(weights) for name, weights in found.items()}
    own = {
        corrected: {
            name: CameraSimulator.from_pretrained(
                found[name], device="cpu", body_correction=corrected, cache=None
            )
            for name in PRESETS
            if name in found
        }
        for corrected in (False, True)
    }
    baselines = {name: loaded[name][0]["baseline"] for name in BASELINES if name in loaded}
    return Models(
        compact=own[False]["compact"],
        paper=own[False].get("paper"),
        pc=baselines.get("pc"),
        dl=baselines.get("dl"),
        cards={name: card for name, (_, card) in loaded.items()},
        compact_body=own[True]["compact"],
        paper_body=own[True].get("paper"),
    )


def _weights(
    name: str, folder: Path, train: bool, progress: TrainingProgress | None
) -> str | Path | None:
    """What `load_modules` takes for the model `name`; None if there is nothing to load."""
    if name in list_pretrained():
        return name
    path = folder / name / f"{name}.safetensors"
    config = CONFIGS / f"{name}.yaml"
    if not path.is_file() and train and config.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        command = f"ae-env train-simulator {config.as_posix()}"
        train_and_save(
            load_config(config), reference_scenes_of, path, command=command, progress=progress
        )
    return path if path.is_file() else None
