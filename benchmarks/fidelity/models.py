"""The trained networks that are measured, and the held-out scenes that they are measured on."""

from __future__ import annotations

import functools
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.harness import data_root
from benchmarks.isolated import ROOT
from benchmarks.paper_baselines import DecoupledNet, ParameterConcatenation
from simulator import CameraSimulator, get_camera
from simulator.networks.noise_module import SIZES, NoiseModule
from simulator.networks.weights import load_modules
from simulator.reference.camera import ReferenceScene
from simulator.training.scenes import reference_scenes

#: Where trained networks lie that do not come with the package: ``NAME/NAME.safetensors``.
FOLDER, CONFIGS = ROOT / "runs" / "simulator", ROOT / "configs" / "simulator"
PRESETS, BASELINES = ("compact", "paper"), ("pc", "dl")
#: Procedural groups of the test split, largest size of its scenes and of crops of them [packed
#: pixel]; views into panoramas are 128 x 128.
FULL, QUICK = (64, 256, 128), (6, 128, 64)


@dataclass(frozen=True, eq=False)
class Models:
    """Trained networks; None for what was not trained.

    Args:
        simulators: By preset.
        corrected: The same with the w and b that the exposure module learnt for the body that was
            trained on, as the paper uses them.
        baselines: The paper's, by name: parameter concatenation, decoupled learning.
        cards: Model card of each, by name.
    """

    simulators: dict[str, CameraSimulator]
    corrected: dict[str, CameraSimulator]
    baselines: dict[str, ParameterConcatenation | DecoupledNet]
    cards: dict[str, dict[str, Any]]


def weights(name: str) -> str | Path | None:
    """Name or path of a model for `load_modules`; None if it was not trained."""
    if name in SIZES:  # comes with the package
        return name
    path = FOLDER / name / f"{name}.safetensors"
    return path if path.is_file() else None


def train_missing() -> None:
    """Trains what is not there by its configuration; a training that was stopped continues."""
    for name in (*PRESETS, *BASELINES):
        if weights(name) is None:
            command = [sys.executable, "-m", "benchmarks.paper_baselines", "train-simulator"]
            subprocess.run([*command, str(CONFIGS / f"{name}.yaml")], cwd=ROOT, check=True)


def checksums(*names: str) -> dict[str, str]:
    """Checksum of the weights of each of `names`, or of all models, that is there."""
    names = names or tuple(dict.fromkeys((*SIZES, *PRESETS, *BASELINES)))
    return {n: load_modules(w)[1]["sha256"] for n in names if (w := weights(n)) is not None}


@functools.cache
def load_models() -> Models:
    """All models that are there."""
    found = {n: w for n in (*PRESETS, *BASELINES) if (w := weights(n)) is not None}
    loaded = {name: load_modules(path) for name, path in found.items()}
    own, corrected = (
        {
            name: CameraSimulator.from_pretrained(
                found[name], device="cpu", body_correction=correct, cache=None
            )
            for name in PRESETS
            if name in found
        }
        for correct in (False, True)
    )
    baselines: Any = {n: loaded[n][0]["baseline"] for n in BASELINES if n in loaded}
    return Models(own, corrected, baselines, {name: card for name, (_, card) in loaded.items()})


def trained_noise_modules() -> dict[str, NoiseModule]:
    """The noise modules that come with the package, and the paper's where it was trained."""
    names = {n: n for n in SIZES} | ({"paper": w} if (w := weights("paper")) else {})
    return {n: load_modules(w)[0]["noise"] for n, w in names.items()}  # type: ignore[misc]


@functools.cache
def held_out_scenes(camera: str, quick: bool) -> tuple[ReferenceScene, ...]:
    """The test split: procedural groups, photographs and, where present, radiance maps."""
    number, size, _ = QUICK if quick else FULL
    profile, folder = get_camera(camera), data_root()
    return tuple(reference_scenes("test", profile, number=number, size=size, data=folder))
