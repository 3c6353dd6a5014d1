"""The paper's dataset in the form that its authors released, and training on it.

A table ``camera_params.csv`` has one row per capture, and for each capture there is a file
``SEQUENCE/NAME.npy``: float32 (4, H, W), planes **R, G1, B, G2**, black-subtracted, 1.0 at white,
not clipped. Rows name the developed picture beside it, ``.../SEQUENCE/NAME.jpg``.

The stages of the training, their order and their losses are the paper's: exposure, then noise and
aperture on the output of the stages before. The target is the capture itself, with its noise.
"""

import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor, nn

from simulator.camera import CameraProfile, get_camera
from simulator.networks.exposure_module import OVER_EXPOSED
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.raw.image import RawImage
from simulator.reference.sequences import LOW_ISO, Pair, any_pairs, is_cleaner, opening_pairs
from simulator.settings import CameraSettings, exposure_ratio
from simulator.training import trainer
from simulator.training.crops import Batch, stacked, stated_fields
from simulator.training.losses import expose
from simulator.utils.cache import LruCache
from simulator.utils.checks import check_word, parse_number
from simulator.utils.files import read_table, refuse_bomb, sibling

logger = logging.getLogger(__name__)

#: The table, and the one beside it with what developing the raws needs.
PARAMETERS, DEVELOPING = "camera_params.csv", "camera_isp_params.csv"
#: Columns that the table must have. ``wb`` and ``noiseprofile`` are optional.
COLUMNS = ("path", "time", "iso", "aperture")
#: Black and white level that the authors' preprocessing takes, per camera.
LEVELS = {"nikon_z6": (1008.0, 15520.0), "canon_70d": (2048.0, 15000.0)}
#: Stages in the order of the paper.
STAGES = ("exposure", "noise", "aperture", "baseline")
#: Share of the sequences that is held out (paper, section 4.2).
TEST_SHARE = 0.1
#: Signal of a grey card in the light that a camera meters.
_GREY = 0.119
#: Most bytes of captures in memory; one of 4 x 512 x 768 takes 6 million.
_CACHED = 2**31

Balance = tuple[float, float, float]


# -- reading --------------------------------------------------------------------------------------


def packed_camera(name: str) -> CameraProfile:
    """The built-in camera ``"nikon_z6"`` or ``"canon_70d"`` with the levels of the dataset."""
    check_word("camera", name, tuple(LEVELS))
    camera = get_camera(name)
    black, white = LEVELS[name]
    return camera.with_levels((black,) * 4, white, camera.bit_depth)


@dataclass(frozen=True)
class PackedCapture:
    """One capture: a row of the table."""

    file: Path
    camera: CameraProfile
    settings: CameraSettings
    white_balance: Balance | None  # gains, green 1; None where the row does not state them
    nlf: NoiseLevelFunction | None  # likewise

    @property
    def noise(self) -> NoiseLevelFunction:
        """Noise as the row states it, or the camera's calibration."""
        return self.nlf or self.camera.nlf(self.settings.iso)

    def read(self) -> RawImage:
        """Read the capture from its file; nothing pickled is loaded.

        A `ValueError` unless it is a finite (4, H, W) array of floating-point numbers.
        """
        try:
            red, green_1, blue, green_2 = np.load(self.file, mmap_mode="r", allow_pickle=False)
            height, width = red.shape
            if claim := refuse_bomb(height, width, red.nbytes):
                raise ValueError(claim)
            planes = torch.from_numpy(np.stack([red, green_1, green_2, blue]))
        except (ValueError, TypeError, EOFError) as error:
            rule = "must be a whole .npy file of numbers, (4, H, W): R, G1, B, G2"
            raise ValueError(f"`{self.file}` {rule}: {error}") from None
        camera = self.camera
        metadata = {
            "path": self.file.name,
            "make": camera.make,
            "model": camera.model,
            "nlf_source": PARAMETERS if self.nlf else f"camera calibration ({camera.name})",
            "white_balance_source": "camera" if self.white_balance else "none",
        }
        balance = self.white_balance or (1.0, 1.0, 1.0)
        return RawImage(planes, self.settings, camera, self.nlf, balance, metadata=metadata)


@dataclass(frozen=True)
class CapturedSequence:
    """Captures of one static scene with different settings, in the order of the table."""

    name: str
    captures: tuple[PackedCapture, ...]

    @property
    def settings(self) -> tuple[CameraSettings, ...]:
        """The settings of each capture."""
        return tuple(capture.settings for capture in self.captures)


def read_dataset(
    root: str | os.PathLike[str], *, camera: CameraProfile | str | None = None
) -> list[CapturedSequence]:
    """Every sequence that a ``camera_params.csv`` in `root` or below lists, sorted by name.

    Rows whose ``.npy`` file is not there are left out, with a warning in the log: a copy of the
    dataset may be partial. Of the paths in a table only the last two parts count, and the last
    alone if the files lie beside the table: they begin where the preprocessing ran.

    `camera` is a profile, or a name that `packed_camera` knows; without it a table with a column
    ``wb`` is the Nikon Z6's and one without the Canon 70D's, as the authors' scripts write them. A
    `ValueError` if there is no table, no file, no such column, or a cell is no number.
    """
    found = (s for table in _tables("root", root) for s in _read_table(table, camera))
    return sorted(found, key=lambda sequence: sequence.name)


def _tables(name: str, folder: str | os.PathLike[str]) -> list[Path]:
    path = Path(folder).expanduser()
    if not path.is_dir():
        raise FileNotFoundError(f"`{name}` (={str(path)!r}) must be an existing folder")
    tables = sorted(path.rglob(PARAMETERS))
    if not tables:
        raise ValueError(f"`{name}` (={str(path)!r}) must hold a {PARAMETERS}, in it or below")
    return tables


def _read_table(table: Path, camera: CameraProfile | str | None = None) -> list[CapturedSequence]:
    rows = read_table(table)
    if not set(COLUMNS) <= set(rows.columns):
        found, needed = (", ".join(names) for names in (rows.columns, COLUMNS))
        raise ValueError(f"`{table}` (columns: {found}) must have the columns {needed}")
    if camera is None:
        camera = "nikon_z6" if "wb" in rows.columns else "canon_70d"
    profile = packed_camera(camera) if isinstance(camera, str) else camera
    balances = _white_balances(table.with_name(DEVELOPING))
    captures: dict[str, list[PackedCapture]] = {}
    lost = []
    for number, row in enumerate(rows.to_dict("records"), start=2):
        path = _path(row["path"])
        try:
            capture = _capture(table, path, row, profile, balances.get(path))
        except ValueError as error:
            raise ValueError(f"`{table}`, row {number}: {error}") from None
        if capture.file.is_file():
            name = path.parts[-2] if len(path.parts) > 1 else table.parent.name
            captures.setdefault(name, []).append(capture)
        else:
            lost.append(path)
    if lost:
        logger.warning("%s: %d of %d files are not there, %s", table, len(lost), len(rows), lost[0])
    if not captures:
        raise ValueError(f"`{table}` ({len(rows)} rows) must list .npy files that are there")
    return [CapturedSequence(name, tuple(own)) for name, own in captures.items()]


def _path(text: str) -> PurePosixPath:
    return PurePosixPath(text.strip().replace("\\", "/"))


def _capture(
    table: Path,
    path: PurePosixPath,
    row: Mapping[Any, str],
    camera: CameraProfile,
    developing: Balance | None,
) -> PackedCapture:
    values = [parse_number(row[name], name) for name in ("iso", "time", "aperture")]
    settings = CameraSettings.from_exif(*values)
    gains, noise = _numbers(row.get("wb", "")), _numbers(row.get("noiseprofile", ""))
    balance = (gains[0] / gains[1], 1.0, gains[2] / gains[1]) if _positive(gains) else developing
    stem = f"{path.stem}.npy"
    nested = table.parent.joinpath(*path.parts[-2:-1], stem)
    file = nested if nested.is_file() else table.with_name(stem)
    return PackedCapture(file, camera, settings, balance, _noise_profile(noise) if noise else None)


def _numbers(text: str) -> tuple[float, ...]:
    """Numbers separated by blanks, or a list as Python prints it."""
    return tuple(float(v) for v in text.strip(" []()\r\n").replace(",", " ").split())


def _positive(values: tuple[float, ...]) -> bool:
    return len(values) >= 3 and min(values[:3]) > 0


def _noise_profile(numbers: tuple[float, ...]) -> NoiseLevelFunction:
    """Pairs (shot, read) of a DNG NoiseProfile: one for all colours, or one each for R, G, B."""
    if len(numbers) not in (2, 6):
        raise ValueError(f"`noiseprofile` (={numbers}) must be 2 or 6 numbers")
    pairs = [numbers[i : i + 2] for i in range(0, len(numbers), 2)] * (6 // len(numbers))
    shot, read = zip(*(pairs[colour] for colour in (0, 1, 1, 2)), strict=True)
    return NoiseLevelFunction(shot, read, source=f"DNG NoiseProfile, from {PARAMETERS}")


def _white_balances(table: Path) -> dict[PurePosixPath, Balance]:
    """Gains by path, from AsShotNeutral, if there is such a table."""
    rows = read_table(table) if table.is_file() else pd.DataFrame()
    if not {"path", "AsShotNeutral"} <= set(rows.columns):
        return {}
    values = {_path(row["path"]): _numbers(row["AsShotNeutral"]) for row in rows.to_dict("records")}
    return {p: (v[1] / v[0], 1.0, v[1] / v[2]) for p, v in values.items() if _positive(v)}


# -- training -------------------------------------------------------------------------------------


def split_dataset(
    folder: Path, *, seed: int = 0
) -> tuple[list[CapturedSequence], list[CapturedSequence]]:
    """The sequences below `folder` to train on, and those held out.

    Where some of several tables lie in a folder with "test" in its name, as in the authors' data,
    theirs are held out; otherwise a tenth of all sequences, drawn by `seed`, as in the paper. A
    `ValueError` if there are fewer than two sequences of two captures or more.
    """
    named: dict[bool, list[CapturedSequence]] = {False: [], True: []}
    for table in _tables("folder", folder):
        is_test = any("test" in part.lower() for part in table.relative_to(folder).parts[:-1])
        named[is_test] += [s for s in _read_table(table) if len(s.captures) > 1]
    if all(named.values()):
        return named[False], named[True]
    every = sorted(named[False] + named[True], key=lambda sequence: sequence.name)
    if len(every) < 2:
        rule = f"must hold two sequences of two captures or more; it holds {len(every)}"
        raise ValueError(f"`folder` (={str(folder)!r}) {rule}")
    count = max(1, round(TEST_SHARE * len(every)))
    held_out = set(np.random.default_rng(seed).permutation(len(every))[:count].tolist())
    train = [sequence for index, sequence in enumerate(every) if index not in held_out]
    return train, [every[index] for index in sorted(held_out)]


def captured_pairs(sequences: Sequence[CapturedSequence], stage: str) -> list[Pair]:
    """The pairs that a stage is trained on (paper, section 4.2).

    ``"exposure"`` and ``"baseline"``: any two captures of a sequence. ``"noise"``: the same
    f-number, a target at ISO 400 or less with at most a quarter of the source's noise variance at
    mid grey. ``"aperture"``: a target that is more open, and for a tenth of the pairs one that is
    as open. A `ValueError` if there is no such pair.
    """
    pairs = opening_pairs(sequences) if stage == "aperture" else any_pairs(sequences)
    if stage == "noise":
        pairs = [pair for pair in pairs if _is_cleaner(sequences[pair.sequence], pair)]
    if not pairs:
        raise ValueError(f"`sequences` ({len(sequences)}) must hold a pair for stage {stage!r}")
    return pairs


def _is_cleaner(sequence: CapturedSequence, pair: Pair) -> bool:
    source, target = sequence.captures[pair.source], sequence.captures[pair.target]
    if source.settings.aperture_stop != target.settings.aperture_stop:
        return False
    exposed = source.noise.exposed(exposure_ratio(source.settings, target.settings))
    return target.settings.iso <= LOW_ISO and is_cleaner(target.noise, exposed, _GREY)


class CapturedPairs:
    """Pairs of one stage of `captured_pairs`; the same step gives the same batch."""

    def __init__(self, sequences: Sequence[CapturedSequence], stage: str, *, seed: int = 0) -> None:
        self.sequences, self.stage, self.seed = sequences, stage, seed
        self.pairs = captured_pairs(sequences, stage)
        self._data: LruCache[Tensor] = LruCache(_CACHED)

    def batch(self, step: int, size: int, crop: int, *, process: int = 0) -> Batch:
        """As `ReferencePairs.batch`; pictures smaller than `crop` are taken whole."""
        rng = np.random.default_rng([self.seed, STAGES.index(self.stage), step, process])
        chosen = rng.integers(len(self.pairs), size=size)
        items = [self._pair(self.pairs[i], crop, rng) for i in chosen]
        smallest = [min(item["source"].shape[i] for item in items) for i in (1, 2)]
        for item in items:  # pictures of several sizes: what they have in common
            for name in ("source", "target", "sample", "defocus"):
                item[name] = item[name][..., : smallest[0], : smallest[1]]
        return stacked(items)

    def _pair(self, pair: Pair, crop: int, rng: np.random.Generator) -> dict[str, Tensor]:
        captures = self.sequences[pair.sequence].captures
        source, target = captures[pair.source], captures[pair.target]
        light, sample = self._read(source), self._read(target)
        top, left = (int(rng.integers(max(n - crop, 0) + 1)) for n in light.shape[1:])
        light, sample = (
            t[:, top : top + crop, left : left + crop].clamp(max=1.0) for t in (light, sample)
        )
        if light.shape != sample.shape:
            raise ValueError(f"`{target.file}` must be as large as the others of its sequence")
        return {
            "source": light,
            "target": sample,
            "sample": sample,
            "defocus": torch.zeros(light.shape[1:]),  # not known, and not used
            **stated_fields(source.settings, target.settings, source.noise),
        }

    def _read(self, capture: PackedCapture) -> Tensor:
        data = self._data.get(capture.file)
        if data is None:
            data = capture.read().data
            self._data.put(capture.file, data, data.nbytes)
        return data


class CapturedNoiseLoss(nn.Module):
    """L1 of the exposed and denoised source against the target; pixels above 0.99 do not count."""

    def __init__(self, modules: Any) -> None:
        super().__init__()
        self.exposure, self.noise = modules["exposure"], modules["noise"]

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
    config: trainer.SimulatorConfig,
    sequences: Sequence[CapturedSequence],
    path: Path,
    *,
    command: str,
    device: str = "cpu",
) -> Path:
    """Trains the stages of `config` on real captures, as `train_and_save` does on simulated ones.

    The preset is ``"paper"``, ``"pc"`` or ``"dl"``: captures do not tell what the others need.
    Camera, body and scenes of `config` do not matter.
    """
    check_word("preset", config.preset, ("paper", "pc", "dl"))
    accelerator = trainer.make_accelerator(config, device, None)
    modules, start = trainer.first_modules(config)
    names = [name for name in STAGES if name in config.stages()]
    stages: dict[str, dict[str, Any]] = {}
    values, known = config.card(), [sequence.name for sequence in sequences]
    for number, name in enumerate(names, start=1):
        pairs = CapturedPairs(sequences, name, seed=config.seed)
        entries = ("preset", "seed", "precision", *names[:number])
        stages[name] = trainer.train_stage(
            name,
            CapturedNoiseLoss(modules) if name == "noise" else trainer.stage_loss(name, modules),
            modules[name],
            pairs,
            config.stages()[name],
            accelerator,
            checkpoint=path.parent / f"{name}.checkpoint",
            identity=[{entry: values[entry] for entry in entries}, start, known],
        )
    done = {"start": start, "sequences": len(sequences), "stages": stages}
    trainer.save_trained(path, modules, config, command, **done)
    return sibling(path, ".safetensors")
