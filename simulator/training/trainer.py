"""From a configuration to weights: the stages in turn, each on its own pairs of captures.

Accelerate does the plumbing: devices, precision, several processes, logs.
"""

from __future__ import annotations

import functools
import logging
import math
import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
import torch
import torch.nn.functional as F
from pydantic import Field, model_validator
from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from simulator.camera import get_camera, list_cameras
from simulator.capture.statistics import BLOCK, Residual, ResidualStatistics, wiener_error
from simulator.networks.noise_module import NoiseModule, variance_map
from simulator.networks.weights import build_modules, load_modules, save_modules
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.reference.reference_camera import (
    DRAPED,
    MOSAIC,
    BodyError,
    ReferenceCamera,
    ReferenceScene,
)
from simulator.reference.sequences import Sequence as CaptureSequence
from simulator.reference.sequences import Stage
from simulator.training.crops import (
    Batch,
    DetailCrops,
    DetailPicture,
    NoiseBatch,
    Progress,
    ReferencePairs,
    draw_sequences,
    no_progress,
)
from simulator.training.losses import ApertureLoss, BaselineLoss, ExposureLoss, NoiseLoss
from simulator.training.scenes import (
    Split,
    detail_pictures,
    draped_scenes,
    mosaic_scenes,
    reference_scenes,
)
from simulator.utils.checkpoint import Checkpoint
from simulator.utils.checks import import_extra
from simulator.utils.compute import check_bfloat16
from simulator.utils.config_file import Configuration
from simulator.utils.files import DATA_VARIABLE, data_folder, result_meta, sibling

if TYPE_CHECKING:
    from accelerate import Accelerator

logger = logging.getLogger(__name__)

#: Procedural scenes that a training validates on.
_VALIDATION_SCENES = 24
#: Fixed batches that a trained stage is validated on.
_VALIDATION_STEPS, _VALIDATION_BATCH = 8, 8
#: Pairs that each stage is trained on, see `simulator.reference.sequences.select_pairs`.
_PAIRS: dict[str, Stage] = {"exposure": "exposure", "aperture": "aperture", "baseline": "all"}
#: Share of the budget in which the learning rate rises.
_RISE = 0.05
#: Largest norm of a gradient.
_GRADIENT_NORM = 1.0
#: Steps between two log entries, and the memory of the running means that are logged.
_LOG_EVERY, _SMOOTHING = 20, 0.98
#: Values of `wiener_error` at which errors are tabulated.
_KNOTS = np.array([0.0, 0.003, 0.006, 0.0125, 0.025, 0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0])
#: Crops that are measured, how large they are, and captures of each.
_CROPS, _SIDE, _CAPTURES = 192, 128, 4
#: Stages in the order of their training.
_STAGES = ("noise", "exposure", "aperture", "baseline")
#: Stages of the presets that are not whole simulators.
_STAGES_OF = {"nano": ("noise",), "large": ("noise",), "pc": ("baseline",), "dl": ("baseline",)}


class StageConfig(Configuration):
    """One stage of the training."""

    #: Optimiser steps: the whole budget, unless `minutes` is given.
    steps: int | None = Field(default=None, ge=1, le=10_000_000)
    #: Budget in time instead: processor minutes of the training process on a CPU, so that other
    #: work on the machine does not count; wall-clock minutes on a GPU.
    minutes: float | None = Field(default=None, gt=0, le=100_000)
    batch: int = Field(default=8, ge=1, le=4096)  # pairs per step and process
    crop: int = Field(default=64, ge=16, le=4096)  # height and width [packed pixel]
    #: Peak of a one-cycle schedule (rise over 5 %, cosine fall to 0).
    learning_rate: float = Field(default=1e-3, gt=0, le=1.0)
    #: Decay of the running average of the weights that is kept in the end; 0 keeps the last ones.
    average: float = Field(default=0.0, ge=0, lt=1)

    @model_validator(mode="after")
    def _one_budget(self) -> StageConfig:
        if (self.steps is None) == (self.minutes is None):
            raise ValueError("exactly one of `steps` and `minutes` must be given")
        return self


class SceneConfig(Configuration):
    """Scenes that the reference camera photographs."""

    procedural: int = Field(default=240, ge=1, le=100_000)  # in the training split
    size: int = Field(default=256, ge=32, le=4096)  # height and width [packed pixel]
    radiance: str | None = None  # folder of real files; null leaves them out


class SimulatorConfig(Configuration):
    """A training of the three modules, or of a baseline."""

    #: ``"compact"`` or ``"paper"``; ``"nano"`` and ``"large"`` are noise modules alone; ``"pc"``
    #: (parameter concatenation) and ``"dl"`` (decoupled learning) are the paper's baselines, one
    #: network trained in one stage.
    preset: Literal["nano", "compact", "large", "paper", "pc", "dl"]
    #: Built-in camera that records the sequences; the noise stage adds the noise of every one.
    camera: str = "nikon_z6"
    body: int = Field(default=1, ge=0)  # seed of the hidden error of its body
    seed: int = Field(default=0, ge=0)  # of everything that is random
    #: Weights of the same preset that the training goes on from: a name that comes with the package
    #: or a file; by default it begins with random ones.
    start: str | None = None
    #: Of the networks; weights, optimiser and losses stay float32.
    precision: Literal["float32", "bfloat16", "float16"] = "float32"
    scenes: SceneConfig = SceneConfig()
    exposure: StageConfig | None = None
    noise: StageConfig | None = None
    aperture: StageConfig | None = None
    baseline: StageConfig | None = None  # of "pc" and "dl"

    @model_validator(mode="after")
    def _check(self) -> SimulatorConfig:
        get_camera(self.camera)
        stages = _STAGES_OF.get(self.preset, ("exposure", "noise", "aperture"))
        for name in _STAGES:
            if (name in stages) != (getattr(self, name) is not None):
                rule = "must be given" if name in stages else "must be left out"
                raise ValueError(f"`{name}` {rule} for preset {self.preset!r}")
        for name, stage in self.stages().items():
            if name != "noise" and stage.crop > self.scenes.size:
                rule = f"must not exceed `scenes.size` (={self.scenes.size})"
                raise ValueError(f"`{name}.crop` (={stage.crop}) {rule}")
        return self

    def stages(self) -> dict[str, StageConfig]:
        """The stages by name, in order."""
        return {name: getattr(self, name) for name in _STAGES if getattr(self, name) is not None}

    def card(self, last_stage: str | None = None) -> dict[str, Any]:
        """JSON values that identify the training, without the stages after `last_stage`.

        The noise stage has pictures of its own: nothing but its budget and the seed changes it.
        """
        values = self.model_dump(mode="json", exclude_none=True)
        if last_stage == "noise":
            names = ("preset", "seed", "start", "precision", "noise")
            return {name: values[name] for name in names if name in values}
        stages = list(self.stages())
        later = [] if last_stage is None else stages[stages.index(last_stage) + 1 :]
        return {name: value for name, value in values.items() if name not in later}


# -- training -------------------------------------------------------------------------------------
#: Makes the scenes of a split, ``"train"`` or ``"validation"``, of a training.
SceneMaker = Callable[[SimulatorConfig, Split], Sequence[ReferenceScene]]
#: Makes the pictures of a split for its noise stage.
PictureMaker = Callable[[SimulatorConfig, Split], Sequence[DetailPicture]]
#: Called with the task, the share of it that is done, and the latest values.
TrainingProgress = Callable[[str, float, dict[str, float]], None]


class Batches(Protocol):
    """Pairs of captures as batches, by the number of the step."""

    pairs: Any  # a sequence of them

    def batch(self, step: int, size: int, crop: int, *, process: int = 0) -> Batch | NoiseBatch:
        """The pairs of one step."""


def scenes_of(config: SimulatorConfig, split: Split) -> list[ReferenceScene]:
    """The scenes of a split that a training's configuration names."""
    radiance, folder = config.scenes.radiance or "", data_folder()
    if folder is not None:
        radiance = radiance.replace(f"${DATA_VARIABLE}", str(folder))
    radiance = os.path.expandvars(radiance)
    if config.scenes.radiance and ("$" in radiance or not radiance):  # unset, or empty
        logger.warning("%s is not set: training without radiance maps", config.scenes.radiance)
        radiance = ""
    data, size = Path(radiance) if radiance else None, config.scenes.size
    camera = get_camera(config.camera)
    number = config.scenes.procedural if split == "train" else _VALIDATION_SCENES
    scenes = reference_scenes(split, camera, number=number, size=size, data=data, seed=config.seed)
    if data is not None:
        scenes += mosaic_scenes(split, data, size=size)
    return [*scenes, *draped_scenes(scenes, camera, seed=config.seed)]


def pictures_of(config: SimulatorConfig, split: Split) -> list[DetailPicture]:
    """The pictures of a split that the noise stage is trained on."""
    return detail_pictures(split, data=data_folder(), seed=config.seed)


def train_and_save(
    config: SimulatorConfig,
    path: Path,
    *,
    command: str,
    device: str = "cpu",
    tensorboard: bool = False,
    make_scenes: SceneMaker = scenes_of,
    make_pictures: PictureMaker = pictures_of,
    progress: TrainingProgress = no_progress,
) -> Path:
    """Trains the stages of `config`, and returns the file of the weights, a model card beside it.

    A stage that is done or half done resumes from its checkpoint. Checkpoints and logs (in
    ``tensorboard``) go into the folder of `path`; `command`, the command line that does it again,
    into the card. Several GPUs or processes run it through ``accelerate launch``.
    """
    folder = path.parent
    accelerator = make_accelerator(config, device, folder / "tensorboard" if tensorboard else None)
    modules, start = first_modules(config)
    train, validation = (
        _Source(config, make_scenes, make_pictures, split) for split in ("train", "validation")
    )
    if not accelerator.is_main_process:  # nobody looks at the bars of the other processes
        progress = no_progress
    stages: dict[str, dict[str, Any]] = {}
    for name, stage in config.stages().items():
        pairs = train.pairs(name, functools.partial(progress, f"{name}: rendering"))
        loss = stage_loss(name, modules)
        stages[name] = train_stage(
            name,
            loss,
            modules[name],
            pairs,
            stage,
            accelerator,
            checkpoint=folder / f"{name}.checkpoint",
            identity=config.card(last_stage=name),
            progress=functools.partial(progress, f"{name}: training"),
        )
        stages[name]["validation"] = validate(loss, validation.pairs(name), stage.crop, accelerator)
    is_main = accelerator.is_main_process
    accelerator.end_training()
    if is_main:
        residual = None
        if "noise" in modules:
            noise: Any = modules["noise"].cpu().eval()
            residual = calibrate(noise, validation.crops).to_card()
        done = {"start": start, "scenes": train.kinds, "stages": stages, "residual": residual}
        save_trained(path, modules, config, command, **done)
    return sibling(path, ".safetensors")


def first_modules(config: SimulatorConfig) -> tuple[nn.ModuleDict, dict[str, Any] | None]:
    """The modules that a training begins with, and what the card of its start says, if any."""
    with torch.random.fork_rng(devices=[]):  # layers draw their weights from the global generator
        torch.default_generator.manual_seed(config.seed)
        modules = build_modules(config.preset)
    if config.start is None:
        return modules, None
    try:
        started, card = load_modules(config.start)
    except ValueError as error:
        raise ValueError(f"`start` (={config.start!r}): {error}") from None
    if card["preset"] != config.preset:
        rule = f"must be weights of preset {config.preset!r}, got {card['preset']!r}"
        raise ValueError(f"`start` (={config.start!r}) {rule}")
    modules.load_state_dict(started.state_dict())
    return modules, {key: card.get(key) for key in ("sha256", "training", "stages", "start")}


def save_trained(
    path: Path, modules: nn.ModuleDict, config: SimulatorConfig, command: str, **entries: Any
) -> None:
    """Writes trained weights, and a card of the configuration, of `entries` and of their origin."""
    meta = result_meta(command, config.seed)
    origin = {k: meta[k] for k in ("command", "commit", "date", "machine", "versions")}
    card = {"training": config.card(), **entries, **origin}
    save_modules(path, modules.to("cpu").eval(), config.preset, card)


def make_accelerator(config: SimulatorConfig, device: str, logs: Path | None) -> Accelerator:
    """Accelerate's plumbing for this training; an `ImportError` without the extra ``train``."""
    Accelerator = import_extra("accelerate", "train", "training the simulator").Accelerator
    from accelerate.state import AcceleratorState

    # Device and precision are global there: those of an earlier training in this process would
    # stay in force, or be refused.
    AcceleratorState._reset_state(reset_partial_state=True)
    precision = {"float32": "no", "bfloat16": "bf16", "float16": "fp16"}[config.precision]
    to_logs: dict[str, Any] = {"log_with": "tensorboard", "project_dir": str(logs)}
    accelerator = Accelerator(
        cpu=device == "cpu", mixed_precision=precision, **(to_logs if logs else {})
    )
    if precision == "bf16":
        check_bfloat16(accelerator.device)
    if logs is not None:
        accelerator.init_trackers(config.preset)
    return accelerator


@dataclass
class _Source:
    """Scenes, pictures and pairs of one split, made when a stage asks for them."""

    config: SimulatorConfig
    make_scenes: SceneMaker
    make_pictures: PictureMaker
    split: Split
    blurred_light: dict[tuple[str, int], torch.Tensor] = field(default_factory=dict)
    kinds: Counter[str] = field(default_factory=Counter)

    @functools.cached_property
    def _sequences(self) -> tuple[ReferenceCamera, list[CaptureSequence]]:
        camera = get_camera(self.config.camera)
        body = ReferenceCamera(camera, body=BodyError.draw(camera, self.config.body))
        scenes = self.make_scenes(self.config, self.split)
        self.kinds.update(scene.kind for scene in scenes)
        return body, draw_sequences(scenes, camera, self.config.seed)

    @functools.cached_property
    def crops(self) -> DetailCrops:
        """Crops of the noise stage."""
        pictures = self.make_pictures(self.config, self.split)
        self.kinds.update(picture.kind for picture in pictures)
        cameras = [get_camera(name) for name in list_cameras()]
        return DetailCrops(pictures, cameras, self.config.seed)

    def pairs(self, stage: str, progress: Progress = no_progress) -> ReferencePairs | DetailCrops:
        """The pairs that `stage` is trained or validated on."""
        if stage == "noise":
            return self.crops
        camera, sequences = self._sequences
        if stage == "aperture":  # learnt of known depth, and in focus, where nothing may change
            useful = [s for s in sequences if s.scene.depth is not None or s.scene.in_focus]
        else:  # a draped scene shows a picture that was seen before, a mosaic has noise of its own
            useful = [s for s in sequences if s.scene.kind not in (DRAPED, MOSAIC)]
        return ReferencePairs(
            useful,
            camera,
            _PAIRS[stage],
            seed=self.config.seed,
            blurred_light=self.blurred_light,
            progress=progress,
        )


def stage_loss(stage: str, modules: nn.ModuleDict) -> nn.Module:
    """What a stage of the training minimises."""
    known: Any = modules
    if stage == "aperture":
        return ApertureLoss(**known)
    makers = {"exposure": ExposureLoss, "noise": NoiseLoss, "baseline": BaselineLoss}
    return makers[stage](known[stage])


def train_stage(
    name: str,
    loss: nn.Module,
    trained: nn.Module,
    pairs: Batches,
    stage: StageConfig,
    accelerator: Accelerator,
    *,
    checkpoint: Path,
    identity: Any,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Trains `trained`, which `loss` holds, for the stage's budget; what a model's card says of it.

    A stage that was interrupted resumes from its last `checkpoint`, at most 20 s back, if that is
    of the same `identity` (a JSON value). Batches are drawn by step, so where the budget is in
    steps it goes on as if it had not been interrupted. A `ValueError` if the loss is not finite.
    """
    from accelerate.utils import broadcast, send_to_device

    device, process = accelerator.device, accelerator.process_index
    loss.requires_grad_(False)
    loss.to(device=device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    trained.requires_grad_(True)
    optimizer = torch.optim.AdamW(trained.parameters(), lr=stage.learning_rate, weight_decay=1e-4)
    average = AveragedModel(trained, multi_avg_fn=get_ema_multi_avg_fn(stage.average))  # type: ignore[no-untyped-call]
    parts: dict[str, Any] = {"module": trained, "optimizer": optimizer, "average": average}
    if accelerator.scaler is not None:  # float16: the factor that the loss is multiplied by
        parts["scaler"] = accelerator.scaler
    now = time.process_time if device.type == "cpu" else time.monotonic
    clock, writes = Clock(stage, now), accelerator.is_main_process
    state = _resume(checkpoint, [name, identity], clock, parts, writes=writes)
    wrapped, stepper = accelerator.prepare(loss, optimizer)
    means: dict[str, float] = {}
    clock.start()
    with state:
        while clock.share < 1.0:
            optimizer.param_groups[0]["lr"] = learning_rate(clock.share, stage.learning_rate)
            batch = pairs.batch(clock.step, stage.batch, stage.crop, process=process)
            values = wrapped(send_to_device(batch, device))
            _update_means(means, values, name)
            accelerator.backward(values["loss"])
            accelerator.clip_grad_norm_(trained.parameters(), _GRADIENT_NORM)
            stepper.step()
            stepper.zero_grad()
            average.update_parameters(trained)
            clock.tick()
            if accelerator.num_processes > 1:  # each step waits for all: they must stop together
                seconds = torch.tensor(clock.seconds, dtype=torch.float32, device=device)
                clock.seconds = float(broadcast(seconds))
            if clock.step % _LOG_EVERY == 0 or clock.share >= 1.0:
                accelerator.log({f"{name}/{k}": v for k, v in means.items()}, step=clock.step)
                progress(clock.share, means)
            state.save_when_due()
    trained.load_state_dict(average.module.state_dict())
    return {"pairs": len(pairs.pairs), "steps": clock.step, "seconds": round(clock.seconds, 1)}


def _resume(
    path: Path, identity: Any, clock: Clock, parts: dict[str, Any], *, writes: bool
) -> Checkpoint:
    """The checkpoint of a stage, whose state is loaded into `clock` and `parts` if there is one."""

    def state() -> dict[str, Any]:
        states = {name: part.state_dict() for name, part in parts.items()}
        return {"step": clock.step, "seconds": clock.seconds, **states}

    checkpoint = Checkpoint(path, identity, state, writes=writes)
    past = checkpoint.load()
    if past is not None:
        clock.step, clock.seconds = int(past["step"]), float(past["seconds"])
        for name, part in parts.items():
            part.load_state_dict(past[name])
    return checkpoint


@dataclass
class Clock:
    """Steps and seconds that a stage has used of its budget.

    On a CPU, `now` tells the processor time of this process, else wall-clock time.
    """

    stage: StageConfig
    now: Callable[[], float]
    step: int = 0
    seconds: float = 0.0
    _started: float = 0.0

    def start(self) -> None:
        """Starts to count time, from the seconds so far."""
        self._started = self.now() - self.seconds

    def tick(self) -> None:
        """Counts a step."""
        self.step += 1
        self.seconds = self.now() - self._started

    @property
    def share(self) -> float:
        """Share of the budget that is used, in [0, 1]."""
        if self.stage.steps is not None:
            return min(self.step / self.stage.steps, 1.0)
        assert self.stage.minutes is not None
        return min(self.seconds / (60.0 * self.stage.minutes), 1.0)


def learning_rate(share: float, peak: float) -> float:
    """One cycle: rises linearly over the first 5 % of the budget, falls to 0 as a cosine.

    >>> learning_rate(0.05, 1.0), round(learning_rate(0.525, 1.0), 3), learning_rate(1.0, 1.0)
    (1.0, 0.5, 0.0)
    """
    if share < _RISE:
        return peak * max(share / _RISE, 1e-3)
    return peak * 0.5 * (1.0 + math.cos(math.pi * (share - _RISE) / (1.0 - _RISE)))


def _update_means(means: dict[str, float], values: dict[str, torch.Tensor], name: str) -> None:
    """Updates the running means by the values of a step; the loss must be finite."""
    for key, value in values.items():
        number = float(value.detach())
        if key == "loss" and not math.isfinite(number):
            rule = "must be finite; lower `learning_rate`"
            raise ValueError(f"stage {name!r}: the loss (={number}) {rule}")
        if math.isfinite(number):
            means[key] = _SMOOTHING * means.get(key, number) + (1.0 - _SMOOTHING) * number


@torch.no_grad()
def validate(
    loss: nn.Module, pairs: ReferencePairs | DetailCrops, crop: int, accelerator: Accelerator
) -> dict[str, float]:
    """Means of the values of `loss` on 64 fixed pairs."""
    from accelerate.utils import send_to_device

    means: dict[str, float] = {}
    loss.eval()
    for step in range(_VALIDATION_STEPS):
        batch = send_to_device(pairs.batch(step, _VALIDATION_BATCH, crop), accelerator.device)
        with accelerator.autocast():
            values = loss(batch)
        for key, value in values.items():
            means[key] = means.get(key, 0.0) + float(value) / _VALIDATION_STEPS
    loss.train()
    return {key: round(value, 5) for key, value in means.items() if math.isfinite(value)}


# -- calibration ----------------------------------------------------------------------------------


@torch.no_grad()
def calibrate(noise: NoiseModule, crops: DetailCrops) -> Residual:
    """The error that a noise module leaves on pictures that it was not trained on.

    Several captures of each crop tell what is systematic from what is noise. The first half of the
    crops fills the tables; the second half tells how far single crops are from them.
    """
    half = _CROPS // 2
    measured = [_measure(noise, crops, index) for index in range(_CROPS)]
    error, bias, left = (
        np.concatenate([values[i] for values, _ in measured[:half]]) for i in range(3)
    )
    bias, left = (np.maximum(_means_at_knots(error, v), 0.0) for v in (bias, left))
    first = Residual(_KNOTS, bias, left, 1.0)
    ratios = []
    for (_, own_bias, own_left), statistics in measured[half:]:
        predicted = statistics.error(first, 1.0, statistics.nlf, noise=False)
        found = max(float((own_bias + own_left).mean()), 0.0) ** 0.5
        ratios.append(found / max(predicted, 1e-6))
    return Residual(_KNOTS, bias, left, max(1.0, float(np.quantile(ratios, 0.9))))


def _measure(
    noise: NoiseModule, crops: DetailCrops, index: int
) -> tuple[list[np.ndarray], ResidualStatistics]:
    """Wiener error, squared bias and variance [noise's variance] in the blocks of one crop."""
    batch = crops.captures(index, _CAPTURES, min(_SIDE, crops.largest))
    error = noise(batch.noisy, batch.shot, batch.read).double() - batch.clean.double()
    scale = variance_map(batch.clean, batch.shot, batch.read).double()[0]
    variance = error.var(dim=0)
    bias = error.mean(dim=0).square() - variance / _CAPTURES
    shot, read = (v[0].tolist() for v in (batch.shot, batch.read))
    nlf = NoiseLevelFunction(tuple(shot), tuple(read))
    expected = wiener_error(batch.noisy[0], nlf).double().flatten().numpy()
    squares = [
        F.avg_pool2d((v / scale)[None], BLOCK)[0].mean(dim=0).flatten().numpy()
        for v in (bias, variance)
    ]
    return [expected, *squares], ResidualStatistics(batch.noisy[0], nlf)


def _means_at_knots(error: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Means of `values` around each knot, weights falling to 0 at the neighbouring ones."""
    place = np.interp(error, _KNOTS, np.arange(len(_KNOTS)))
    weights = np.maximum(1.0 - np.abs(place[None] - np.arange(len(_KNOTS))[:, None]), 0.0)
    total = weights.sum(axis=1)
    means = (weights @ values) / np.maximum(total, 1e-12)
    known = total > 1.0
    return np.interp(np.arange(len(_KNOTS)), np.flatnonzero(known), means[known])
