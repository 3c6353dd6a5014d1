"""From a configuration to weights: the stages in turn, each on its own pairs."""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from simulator.camera import get_camera
from simulator.networks.weights import build_modules, save_modules
from simulator.reference.reference_camera import DRAPED, BodyError, ReferenceCamera, ReferenceScene
from simulator.reference.sequences import Stage
from simulator.training.config import SimulatorConfig
from simulator.training.data import ReferencePairs, draw_sequences
from simulator.training.loop import train_stage
from simulator.training.losses import ApertureLoss, BaselineLoss, ExposureLoss, NoiseLoss
from simulator.utils.files import sibling
from simulator.utils.results import result_meta

if TYPE_CHECKING:
    from accelerate import Accelerator

#: Makes the scenes of a split, ``"train"`` or ``"validation"``; `ae_env.scenes.reference_scenes` has them.
SceneMaker = Callable[[SimulatorConfig, str], Sequence[ReferenceScene]]
#: Called with the task, the share of it that is done, and the latest values.
TrainingProgress = Callable[[str, float, dict[str, float]], None]
#: Fixed batches that a trained stage is validated on.
_VALIDATION_STEPS, _VALIDATION_BATCH = 8, 8
_PAIRS: dict[str, Stage] = {
    "exposure": "exposure",
    "noise": "noise",
    "aperture": "aperture",
    "baseline": "all",
}


@dataclass
class Trained:
    """What a training made.

    Args:
        modules: By name: ``exposure``, ``noise``, ``aperture``, or ``baseline``.
        stages: Per stage: pairs, steps, seconds, and the loss on validation scenes.
        scenes: Scenes of the training split by kind.
        is_main: Whether this is the process that writes, of several.
    """

    modules: nn.ModuleDict
    stages: dict[str, dict[str, Any]] = field(default_factory=dict)
    scenes: dict[str, int] = field(default_factory=dict)
    is_main: bool = True


def make_accelerator(config: SimulatorConfig, device: str, logs: Path | None) -> Accelerator:
    """Accelerate's plumbing for this training.

    Raises:
        ImportError: If the extra ``train`` is not installed.
    """
    try:
        from accelerate import Accelerator
        from accelerate.state import AcceleratorState
    except ImportError as error:
        raise ImportError("training the simulator needs: pip install 'ae-env[train]'") from error
    # Device and precision are global there: those of an earlier training in this process would
    # stay in force, or be refused.
    AcceleratorState._reset_state(reset_partial_state=True)
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
        make_scenes: Gives the scenes of a split.
        folder: Where checkpoints and logs go.
        device: ``"cpu"`` or ``"cuda"``; several GPUs or processes through ``accelerate launch``.
        tensorboard: Whether to log there.
        progress: Called while scenes are rendered and every few steps.
    """
    logs = folder / "tensorboard" if tensorboard else None
    accelerator = make_accelerator(config, device, logs)
    torch.manual_seed(config.seed)
    trained = Trained(build_modules(config.preset))
    sources = {split: _Source(config, make_scenes, split) for split in ("train", "validation")}
    trained.scenes = dict(Counter(s.scene.kind for s in sources["train"].sequences))
    for name, stage in config.stages().items():
        # Nobody looks at the bars of the other processes.
        shown = progress if accelerator.is_main_process else None
        pairs = sources["train"].pairs(name, _titled(shown, f"{name}: rendering"))
        loss = _loss(name, trained.modules)
        clock = train_stage(
            name,
            loss,
            trained.modules[name],
            pairs,
            stage,
            accelerator,
            checkpoint=folder / f"{name}.checkpoint",
            identity=config.card(last_stage=name),
            progress=None if shown is None else functools.partial(shown, f"{name}: training"),
        )
        held_out = sources["validation"].pairs(name, None)
        trained.stages[name] = {
            "pairs": len(pairs.pairs),
            "steps": clock.step,
            "seconds": round(clock.seconds, 1),
            "validation": validate(loss, held_out, stage.crop, accelerator),
        }
    trained.is_main = accelerator.is_main_process
    accelerator.end_training()
    trained.modules.to("cpu").eval()
    return trained


class _Source:
    """The pairs of one split; what is rendered for a stage serves the next."""

    def __init__(self, config: SimulatorConfig, make_scenes: SceneMaker, split: str) -> None:
        camera = get_camera(config.camera)
        self.camera = ReferenceCamera(camera, body=BodyError.draw(camera, config.body))
        self.seed = config.seed
        self.sequences = draw_sequences(make_scenes(config, split), camera, config.seed)
        self._blurred_light: dict[tuple[str, int], torch.Tensor] = {}

    def pairs(self, stage: str, progress: Callable[[int, int], None] | None) -> ReferencePairs:
        """The pairs that `stage` is trained or validated on."""
        used = [s for s in self.sequences if _teaches(s.scene, stage)]
        return ReferencePairs(
            used,
            self.camera,
            _PAIRS[stage],
            seed=self.seed,
            blurred_light=self._blurred_light,
            progress=progress,
        )


def _teaches(scene: ReferenceScene, stage: str) -> bool:
    """Whether a stage is trained on `scene`.

    Only a scene of known depth tells what a wider aperture does to it. The other stages have seen
    the picture that a draped scene shows.
    """
    return scene.depth is not None if stage == "aperture" else scene.kind != DRAPED


def _titled(progress: TrainingProgress | None, title: str) -> Callable[[int, int], None] | None:
    if progress is None:
        return None
    return lambda done, total: progress(title, done / max(total, 1), {})


@torch.no_grad()
def validate(
    loss: nn.Module, pairs: ReferencePairs, crop: int, accelerator: Accelerator
) -> dict[str, float]:
    """Means of what `loss` gives on 64 fixed pairs."""
    means: dict[str, float] = {}
    loss.eval()
    for step in range(_VALIDATION_STEPS):
        batch = pairs.batch(step, _VALIDATION_BATCH, crop).to(accelerator.device)
        with accelerator.autocast():
            values = loss(batch)
        for key, value in values.items():
            means[key] = means.get(key, 0.0) + float(value) / _VALIDATION_STEPS
    loss.train()
    return {key: round(value, 5) for key, value in means.items() if math.isfinite(value)}


def train_and_save(
    config: SimulatorConfig,
    make_scenes: SceneMaker,
    path: Path,
    *,
    command: str,
    device: str = "cpu",
    tensorboard: bool = False,
    progress: TrainingProgress | None = None,
) -> Path:
    """Trains, and writes the weights with their model card beside the checkpoints.

    Args:
        config: The training.
        make_scenes: Gives the scenes of a split.
        path: File name of the weights; checkpoints and logs go into its folder.
        command: The command line that does it again, for the card.
        device: See `train_simulator`.
        tensorboard: See `train_simulator`.
        progress: See `train_simulator`.

    Returns:
        The file of the weights.
    """
    trained = train_simulator(
        config,
        make_scenes,
        path.parent,
        device=device,
        tensorboard=tensorboard,
        progress=progress,
    )
    meta = result_meta(command, config.seed)
    card = {
        "training": config.card(),
        "scenes": trained.scenes,
        "stages": trained.stages,
        **{k: meta[k] for k in ("command", "commit", "date", "machine", "versions")},
    }
    if trained.is_main:
        save_modules(path, trained.modules, config.preset, card)
    return sibling(path, ".safetensors")


def _loss(stage: str, modules: nn.ModuleDict) -> nn.Module:
    known: Any = modules
    if stage == "exposure":
        return ExposureLoss(known["exposure"])
    if stage == "noise":
        return NoiseLoss(known["exposure"], known["noise"])
    if stage == "aperture":
        return ApertureLoss(known["exposure"], known["noise"], known["aperture"])
    return BaselineLoss(known["baseline"])
