"""The trained networks that are measured, how they are asked, and held-out scenes."""

import functools
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from benchmarks.harness import Row, clipped, psnr, ssim
from benchmarks.isolated import ROOT
from benchmarks.paper_baselines import DecoupledNet, ParameterConcatenation
from simulator import CameraProfile, CameraSettings, CameraSimulator, RawImage, get_camera
from simulator.networks.noise_module import SIZES
from simulator.networks.weights import load_modules
from simulator.reference.reference_camera import ReferenceScene
from simulator.training.crops import settings_parameters
from simulator.training.scenes import reference_scenes
from simulator.utils.files import data_folder

#: Where trained networks lie that do not come with the package: ``NAME/NAME.safetensors``.
FOLDER, CONFIGS = ROOT / "runs" / "simulator", ROOT / "configs" / "simulator"
PRESETS, BASELINES = ("compact", "paper"), ("pc", "dl")


@dataclass(frozen=True, eq=False)
class Models:
    """Trained networks by name; those that were not trained are left out.

    `corrected` have the w and b that the exposure module learnt for the body it was trained on.
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


def train_missing(names: Sequence[str] = (*PRESETS, *BASELINES)) -> None:
    for name in names:
        if weights(name) is None:
            command = [sys.executable, "-m", "benchmarks.paper_baselines", "train-simulator"]
            subprocess.run([*command, str(CONFIGS / f"{name}.yaml")], cwd=ROOT, check=True)


@functools.cache
def load_models() -> Models:
    found = {n: w for n in (*PRESETS, *BASELINES) if (w := weights(n)) is not None}
    loaded = {name: load_modules(path) for name, path in found.items()}
    make = functools.partial(CameraSimulator.from_pretrained, device="cpu", cache=None)
    own, corrected = (
        {name: make(found[name], body_correction=body) for name in PRESETS if name in found}
        for body in (False, True)
    )
    baselines: Any = {n: loaded[n][0]["baseline"] for n in BASELINES if n in loaded}
    return Models(own, corrected, baselines, {name: card for name, (_, card) in loaded.items()})


@torch.no_grad()
def baseline(network: nn.Module, raw: RawImage, target: CameraSettings) -> Tensor:
    """What one of the paper's baselines makes of a raw, (4, H, W): it is told both settings."""
    stated = [v for settings in (raw.settings, target) for v in settings_parameters(settings)]
    image: Tensor = network(raw.data[None], torch.tensor([stated]))[0].float()
    return image


def scores(estimate: Tensor, truth: Tensor, camera: CameraProfile) -> Row:
    image, window = clipped(estimate, camera), min(7, *(n - 1 + n % 2 for n in truth.shape[1:]))
    similar = ssim(image.numpy(), truth.numpy(), win_size=window)
    return {"psnr_db": psnr(image, truth), "ssim": similar}


def equal_exposure(reference: CameraSettings, iso: float, f_number: float) -> CameraSettings:
    unit = CameraSettings(iso, 1.0, f_number)
    return CameraSettings(iso, 2.0 ** (reference.log2_exposure - unit.log2_exposure), f_number)


def radiance_views(camera: str, size: int) -> list[ReferenceScene]:
    """Views of held-out radiance maps, one of each."""
    scenes = reference_scenes("test", get_camera(camera), number=0, size=size, data=data_folder())
    groups = {s.group: s for s in reversed(scenes) if s.kind == "radiance" and s.pitch == 2}
    return list(groups.values())
