"""From a configuration to weights: the stages in turn, each on its own pairs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from simulator.camera import get_camera
from simulator.modules.aperture import ApertureModule
from simulator.modules.baselines import DecoupledNet, ParameterConcatenation
from simulator.modules.exposure import ExposureModule
from simulator.modules.noise import NoiseModule
from simulator.reference import BodyError, ReferenceCamera, ReferenceScene
from simulator.training.config import SimulatorConfig
from simulator.training.data import ReferencePairs, draw_sequences
from simulator.training.loop import train_stage
from simulator.training.losses import ApertureLoss, BaselineLoss, ExposureLoss, NoiseLoss

if TYPE_CHECKING:
    from accelerate import Accelerator

#: Makes the scenes of a split; `ae_env.scenes.reference` has them.
SceneMaker = Callable[[SimulatorConfig], Sequence[ReferenceScene]]
#: Called with the task, the share of it that is done, and the latest values.
TrainingProgress = Callable[[str, float, dict[str, float]], None]
_PAIRS = {"exposure": "exposure", "noise": "noise", "aperture": "aperture", "baseline": "all"}


@dataclass
class Trained:
    """What a training made.

    Args:
        modules: By name: ``exposure``, ``noise``, ``aperture``, or ``baseline``.
        stages: Per stage: pairs, steps, seconds, last values.
    """

    modules: nn.ModuleDict
    stages: dict[str, dict[str, Any]] = field(default_factory=dict)


def build_modules(preset: str) -> nn.ModuleDict:
    """The untrained modules of a preset, by stage."""
    if preset == "pc":
        return nn.ModuleDict({"baseline": ParameterConcatenation()})
    if preset == "dl":
        return nn.ModuleDict({"baseline": DecoupledNet()})
    return nn.ModuleDict(
        {
            "exposure": ExposureModule(),
            "noise": NoiseModule(preset),  # type: ignore[arg-type]
            "aperture": ApertureModule(preset),  # type: ignore[arg-type]
        }
    )


def make_accelerator(config: SimulatorConfig, device: str, logs: Path | None) -> Accelerator:
    """Accelerate's plumbing for this training.

    Raises:
        ImportError: If the extra ``train`` is not installed.
    """
    try:
        from accelerate import Accelerator
    except ImportError as error:
        raise ImportError("training the simulator needs: pip install 'ae-env[train]'") from error
    precision = {"float32": "no", "bfloat16": "bf16", "float16": "fp16"}[config.precision]
    accelerator = Accelerator(
        cpu=device == "cpu",
        mixed_precision=precision,
        log_with=None if logs is None else "tensorboard",
        project_dir=None if logs is None else str(logs),
    )
    if logs is not None:
        accelerator.init_trackers(config.preset)
    return accelerator


def train_simulator(
    config: SimulatorConfig,
    make_scenes: SceneMaker,
    folder: Path,
    *,
    device: str = "cpu",
    tensorboard: bool = False,
    progress: TrainingProgress | None = None,
) -> Trained:
    """Trains the stages of `config`; one that is done or half done is taken up where it was.

    Args:
        config: The training.
        make_scenes: Gives the training scenes.
        folder: Where checkpoints and logs go.
        device: ``"cpu"`` or ``"cuda"``; several GPUs or processes through ``accelerate launch``.
        tensorboard: Whether to log there.
        progress: Called while scenes are rendered and every few steps.
    """
    accelerator = make_accelerator(config, device, folder / "tensorboard" if tensorboard else None)
    torch.manual_seed(config.seed)
    trained = Trained(build_modules(config.preset))
    camera_profile = get_camera(config.camera)
    camera = ReferenceCamera(camera_profile, body=BodyError.draw(camera_profile, config.body))
    sequences = draw_sequences(make_scenes(config), camera_profile, config.seed)
    optics: dict[tuple[str, int], torch.Tensor] = {}
    for name, stage in config.stages().items():

        def rendering(done: int, total: int, name: str = name) -> None:
            if progress is not None:
                progress(f"{name}: light behind every aperture", done / max(total, 1), {})

        # Only a scene of known depth tells what a wider aperture does to it.
        known = [s for s in sequences if name != "aperture" or s.scene.depth is not None]
        pairs = ReferencePairs(
            known,
            camera,
            _PAIRS[name],  # type: ignore[arg-type]
            seed=config.seed,
            optics=optics,
            progress=rendering,
        )
        values: dict[str, float] = {}

        def report(
            share: float, means: dict[str, float], name: str = name, last: dict = values
        ) -> None:
            last.update(means)
            if progress is not None:
                progress(f"{name}: training", share, means)

        clock = train_stage(
            name,
            _loss(name, trained.modules),
            trained.modules[name],
            pairs,
            stage,
            accelerator,
            checkpoint=folder / f"{name}.checkpoint",
            identity=config.card(last_stage=name),
            progress=report,
        )
        trained.stages[name] = {
            "pairs": len(pairs.pairs),
            "steps": clock.step,
            "seconds": round(clock.seconds, 1),
            **{k: round(v, 5) for k, v in values.items() if math.isfinite(v)},
        }
    accelerator.end_training()
    trained.modules.to("cpu").eval()
    return trained


def _loss(stage: str, modules: nn.ModuleDict) -> nn.Module:
    known: Any = modules
    if stage == "exposure":
        return ExposureLoss(known["exposure"])
    if stage == "noise":
        return NoiseLoss(known["exposure"], known["noise"])
    if stage == "aperture":
        return ApertureLoss(known["exposure"], known["noise"], known["aperture"])
    return BaselineLoss(known["baseline"])
