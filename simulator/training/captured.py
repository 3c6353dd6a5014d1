"""Training on real captures, in the packed layout of the paper's dataset.

The stages, their order and their losses are the paper's: exposure, then noise and aperture on what
the stages before made of the source. The target is the capture itself, with its noise.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from simulator.networks.exposure_module import OVER_EXPOSED, ExposureModule
from simulator.networks.noise_module import NoiseModule
from simulator.networks.weights import build_modules, save_modules
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.raw.dataset import PARAMETERS, PackedCapture, read_table
from simulator.reference.sequences import Pair, any_pairs, opening_pairs
from simulator.settings import CameraSettings, exposure_ratio
from simulator.training.data import Batch, settings_parameters
from simulator.training.losses import ApertureLoss, BaselineLoss, ExposureLoss, expose
from simulator.training.train import (
    SimulatorConfig,
    TrainingProgress,
    load_start,
    make_accelerator,
    train_stage,
)
from simulator.utils.cache import LruCache
from simulator.utils.files import result_meta, sibling

#: Stages in the order of the paper.
STAGES = ("exposure", "noise", "aperture", "baseline")
#: Share of the sequences that is held out (paper, section 4.2).
TEST_SHARE = 0.1
#: Highest ISO of a target of the noise stage (section 4.2: 100, 200 and 400), and its noise
#: variance at mid grey relative to the source's at the same exposure, at most.
_LOW_ISO, _LOW_NOISE, _GREY = 400.0, 0.25, 0.119
#: Most bytes of captures in memory; one of 4 x 512 x 768 takes 6 million.
_CACHED = 2**31


@dataclass(frozen=True)
class CapturedSequence:
    """Real captures of one scene.

    Args:
        name: Folder of the sequence.
        captures: The captures, read when they are asked for.
    """

    name: str
    captures: tuple[PackedCapture, ...]

    @property
    def settings(self) -> tuple[CameraSettings, ...]:
        """The settings of each capture."""
        return tuple(capture.settings for capture in self.captures)


def split_dataset(
    folder: Path, *, seed: int = 0
) -> tuple[list[CapturedSequence], list[CapturedSequence]]:
    """The sequences below `folder` to train on, and those held out.

    Where some of several tables lie in a folder with "test" in its name, as in the authors' data,
    theirs are held out; otherwise a tenth of all sequences, drawn by `seed`, as in the paper.

    Raises:
        FileNotFoundError: If there is no such folder.
        ValueError: If there is no table, or fewer than two sequences of two captures or more.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"`folder` (={str(folder)!r}) must be an existing folder")
    tables = sorted(folder.rglob(PARAMETERS))
    if not tables:
        raise ValueError(f"`folder` (={str(folder)!r}) must hold a {PARAMETERS}, in it or below")
    found = [(_is_test(folder, table), _sequences(table)) for table in tables]
    named = [[s for test, own in found if test == wanted for s in own] for wanted in (False, True)]
    if all(named):
        return named[0], named[1]
    every = sorted(named[0] + named[1], key=lambda sequence: sequence.name)
    if len(every) < 2:
        raise ValueError(
            f"`folder` (={str(folder)!r}) must hold two sequences or more, of two captures or "
            f"more each, to train on one and measure on another; it holds {len(every)}"
        )
    count = max(1, round(TEST_SHARE * len(every)))
    held_out = set(np.random.default_rng(seed).permutation(len(every))[:count].tolist())
    train = [sequence for index, sequence in enumerate(every) if index not in held_out]
    return train, [every[index] for index in sorted(held_out)]


def _is_test(folder: Path, table: Path) -> bool:
    return any("test" in part.lower() for part in table.relative_to(folder).parts[:-1])


def _sequences(table: Path) -> list[CapturedSequence]:
    return [
        CapturedSequence(name, tuple(captures))
        for name, captures in read_table(table).items()
        if len(captures) > 1
    ]


def noise_of(capture: PackedCapture) -> NoiseLevelFunction:
    """Noise of a capture: as its row states it, or its camera's calibration."""
    return capture.nlf or capture.camera.nlf(capture.settings.iso)


def captured_pairs(sequences: Sequence[CapturedSequence], stage: str) -> list[Pair]:
    """The pairs that a stage is trained on (paper, section 4.2).

    Args:
        sequences: The sequences to choose from.
        stage: ``"exposure"`` or ``"baseline"``: any two captures of a sequence. ``"noise"``: the
            same f-number, a target at ISO 400 or less with at most a quarter of the source's noise
            variance at mid grey. ``"aperture"``: a target that is more open, and for a tenth of
            the pairs one that is as open.

    Raises:
        ValueError: If there is no such pair.
    """
    pairs = opening_pairs(sequences) if stage == "aperture" else any_pairs(sequences)
    if stage == "noise":
        pairs = [p for p in pairs if _is_cleaner(*_captures(sequences, p))]
    if not pairs:
        raise ValueError(f"`sequences` ({len(sequences)}) must hold a pair for stage {stage!r}")
    return pairs


def _captures(
    sequences: Sequence[CapturedSequence], pair: Pair
) -> tuple[PackedCapture, PackedCapture]:
    captures = sequences[pair.sequence].captures
    return captures[pair.source], captures[pair.target]


def _is_cleaner(source: PackedCapture, target: PackedCapture) -> bool:
    if source.settings.aperture_stop != target.settings.aperture_stop:
        return False
    exposed = noise_of(source).exposed(exposure_ratio(source.settings, target.settings))
    wanted, brought = (
        sum(read + shot * _GREY for shot, read in zip(nlf.shot, nlf.read, strict=True))
        for nlf in (noise_of(target), exposed)
    )
    return target.settings.iso <= _LOW_ISO and wanted <= _LOW_NOISE * brought


class CapturedPairs:
    """Pairs of one stage; the same step gives the same batch.

    Args:
        sequences: Real captures.
        stage: See `captured_pairs`.
        seed: Seed of pairs and crops.
    """

    def __init__(self, sequences: Sequence[CapturedSequence], stage: str, *, seed: int = 0) -> None:
        self.sequences, self.stage, self.seed = sequences, stage, seed
        self.pairs = captured_pairs(sequences, stage)
        self._data: LruCache[Tensor] = LruCache(_CACHED)

    def batch(self, step: int, size: int, crop: int, *, process: int = 0) -> Batch:
        """The pairs of one step; see `simulator.training.data.ReferencePairs.batch`.

        Pictures smaller than `crop` are taken whole.
        """
        rng = np.random.default_rng([self.seed, STAGES.index(self.stage), step, process])
        chosen = rng.integers(len(self.pairs), size=size)
        items = [self._pair(self.pairs[i], crop, rng) for i in chosen]
        smallest = [min(item["source"].shape[i] for item in items) for i in (1, 2)]
        for item in items:  # pictures of several sizes: what they have in common
            for name in ("source", "target", "sample", "defocus"):
                item[name] = item[name][..., : smallest[0], : smallest[1]]
        return Batch(*(torch.stack([item[name] for item in items]) for name in Batch._fields))

    def _pair(self, pair: Pair, crop: int, rng: np.random.Generator) -> dict[str, Tensor]:
        source, target = _captures(self.sequences, pair)
        light, sample = self._read(source), self._read(target)
        top, left = (int(rng.integers(max(n - crop, 0) + 1)) for n in light.shape[1:])
        light, sample = (
            t[:, top : top + crop, left : left + crop].clamp(max=1.0) for t in (light, sample)
        )
        if light.shape != sample.shape:
            raise ValueError(
                f"`{target.file}` must be as large as the other captures of its sequence"
            )
        settings, nlf = (source.settings, target.settings), noise_of(source)
        return {
            "source": light,
            "target": sample,
            "sample": sample,
            "ratio": torch.tensor(exposure_ratio(*settings), dtype=torch.float32),
            "shot": torch.tensor(nlf.shot),
            "read": torch.tensor(nlf.read),
            "f_source": torch.tensor(settings[0].effective_f_number),
            "f_target": torch.tensor(settings[1].effective_f_number),
            "parameters": torch.tensor([v for s in settings for v in settings_parameters(s)]),
            "defocus": torch.zeros(light.shape[1:]),  # not known, and not used
        }

    def _read(self, capture: PackedCapture) -> Tensor:
        data = self._data.get(capture.file)
        if data is None:
            data = capture.read().data
            self._data.put(capture.file, data, data.nbytes)
        return data


class CapturedNoiseLoss(nn.Module):
    """L1 of the exposed and denoised source against the target, as in the paper.

    Source pixels above 0.99 are left out.
    """

    def __init__(self, exposure: ExposureModule, noise: NoiseModule) -> None:
        super().__init__()
        self.exposure, self.noise = exposure, noise

    def forward(self, batch: Batch) -> Mapping[str, Tensor]:
        """The loss on `batch`, and the error relative to not denoising."""
        exposed, shot, read = expose(self.exposure, batch)
        exposed = exposed.clamp(0.0, 1.0)
        used = batch.source <= OVER_EXPOSED
        error = (self.noise(exposed, shot, read) - batch.sample).abs() * used
        before = ((exposed - batch.sample).abs() * used).sum()
        relative = error.detach().sum() / before.clamp(min=1e-9)
        return {"loss": error.sum() / used.sum().clamp(min=1), "relative": relative}


def train_on_captures(
    config: SimulatorConfig,
    sequences: Sequence[CapturedSequence],
    path: Path,
    *,
    command: str,
    device: str = "cpu",
    progress: TrainingProgress | None = None,
) -> Path:
    """Trains the stages of `config` on real captures and writes the weights with their card.

    A stage that is done or half done resumes from its checkpoint.

    Args:
        config: A training of preset ``"paper"``, ``"pc"`` or ``"dl"``; its camera, body and scenes
            do not matter.
        sequences: To train on.
        path: File name of the weights; checkpoints go into its folder.
        command: The command line that does it again, for the card.
        device: ``"cpu"`` or ``"cuda"``.
        progress: Called every few steps.

    Returns:
        The file of the weights.

    Raises:
        ValueError: If the preset needs what captures do not tell, or a stage has no pairs.
    """
    if config.preset not in ("paper", "pc", "dl"):
        raise ValueError(f"`preset` (={config.preset!r}) must be 'paper', 'pc' or 'dl'")
    accelerator = make_accelerator(config, device, None)
    with torch.random.fork_rng(devices=[]):  # layers draw their weights from the global generator
        torch.default_generator.manual_seed(config.seed)
        modules: Any = build_modules(config.preset)
    start = None if config.start is None else load_start(config, modules)
    losses: dict[str, Callable[[], nn.Module]] = {
        "exposure": lambda: ExposureLoss(modules["exposure"]),
        "noise": lambda: CapturedNoiseLoss(modules["exposure"], modules["noise"]),
        "aperture": lambda: ApertureLoss(*(modules[name] for name in STAGES[:3])),
        "baseline": lambda: BaselineLoss(modules["baseline"]),
    }
    names = [name for name in STAGES if name in config.stages()]
    stages: dict[str, dict[str, Any]] = {}
    for number, name in enumerate(names, start=1):
        pairs = CapturedPairs(sequences, name, seed=config.seed)
        values = config.card()
        clock = train_stage(
            name,
            losses[name](),
            modules[name],
            pairs,
            config.stages()[name],
            accelerator,
            checkpoint=path.parent / f"{name}.checkpoint",
            identity=[
                {key: values[key] for key in ("preset", "seed", "precision", *names[:number])},
                start,
                [sequence.name for sequence in sequences],
            ],
            progress=None if progress is None else functools.partial(progress, name),
        )
        seconds = round(clock.seconds, 1)
        stages[name] = {"pairs": len(pairs.pairs), "steps": clock.step, "seconds": seconds}
    modules.to("cpu").eval()
    meta = result_meta(command, config.seed)
    origin = {k: meta[k] for k in ("command", "commit", "date", "machine", "versions")}
    done = {"start": start, "sequences": len(sequences), "stages": stages}
    save_modules(path, modules, config.preset, {"training": config.card(), **done, **origin})
    return sibling(path, ".safetensors")
