"""The paper's table on a folder in the layout of the paper's dataset.

    ae-env bench paper FOLDER

Sequences are split, the paper's networks and its two baselines are trained on the captures of one
part (or weights are given), and every method is measured on pairs of real captures of the other. A
training that was stopped continues. Published numbers are of another split of the authors' data.
"""

from __future__ import annotations

import hashlib
import time
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from skimage.metrics import structural_similarity
from torch import Tensor, nn

from benchmarks.fidelity.models import CONFIGS
from benchmarks.fidelity.pairs import PUBLISHED
from benchmarks.harness import RUNS, Benchmark, Part, Report, Row, clipped, pivot, psnr, table
from simulator import CameraSimulator, RawImage, exposure_ratio
from simulator.networks.weights import load_modules
from simulator.noise.noise_level_function import noise_variance
from simulator.reference.sequences import any_pairs
from simulator.training.data import settings_parameters
from simulator.training.paper_dataset import (
    PARAMETERS,
    CapturedSequence,
    split_dataset,
    train_on_captures,
)
from simulator.training.train import SimulatorConfig, load_config

#: What is trained: the paper's networks, parameter concatenation and decoupled learning.
TRAINED = ("paper", "pc", "dl")
#: Pairs that are measured, and largest height and width, of which the middle is taken [packed
#: pixel]. All published pictures fit into the first.
FULL, QUICK = (200, 1024), (6, 128)
#: Budget of each stage of a quick run.
QUICK_STAGE = {"steps": 2, "batch": 1, "crop": 16}
#: Folder of the trained networks.
WEIGHTS = RUNS.parent / "paper"
#: Longest training [s]: the paper's took two days on two GPUs.
LONGEST = 14 * 86400.0


@dataclass(frozen=True, eq=False)
class Case:
    """Two captures of one held-out sequence.

    Args:
        sequence: Name of the sequence.
        source: The input.
        target: The capture that a method should predict.
    """

    sequence: str
    source: RawImage
    target: RawImage

    @property
    def stops(self) -> int:
        """Thirds of stops that the aperture opens by."""
        return self.source.settings.aperture_stop - self.target.settings.aperture_stop

    @property
    def cleaner(self) -> bool:
        """Whether the target has less noise than the source brings, averaged over the picture."""
        ratio = exposure_ratio(self.source.settings, self.target.settings)
        brought, data = self.source.noise.exposed(ratio), self.target.data
        wanted = noise_variance(data, self.target.noise).mean()
        return bool(wanted < noise_variance(data, brought).mean())


#: Transitions, in the order of the report; the last four are a partition of all.
GROUPS: dict[str, Callable[[Case], bool]] = {
    "all": lambda case: True,
    "exposure and noise: cleaner target": lambda case: case.stops == 0 and case.cleaner,
    "exposure and noise: noisier target": lambda case: case.stops == 0 and not case.cleaner,
    "aperture opens": lambda case: case.stops > 0,
    "aperture closes": lambda case: case.stops < 0,
}


# -- measuring ------------------------------------------------------------------------------------


def parts(
    seed: int, quick: bool, folder: Path | None = None, weights: Path | None = None
) -> list[Part]:
    """One part for each network: what is trained, or the weights that are given; and ours."""
    if folder is None:
        raise ValueError("`folder` (=None) must be given: ae-env bench paper FOLDER")
    split_dataset(folder, seed=seed)  # raises before any work
    arguments = {"folder": str(folder.resolve()), "seed": seed, "quick": quick}
    depends = {"data": _digest(folder)}
    if weights is None:
        names = dict.fromkeys(TRAINED)
    else:
        card = load_modules(weights)[1]
        if card["preset"] not in ("compact", "paper", "ncs"):
            wrong = f"`weights` (={str(weights)!r}) must be of all three modules"
            raise ValueError(f"{wrong}, not {card['preset']!r}")
        names, depends = {str(weights.resolve()): None}, depends | {"weights": card["sha256"]}
    longer = {"depends": depends, "timeout": LONGEST}
    return [
        Part(name, measure, {"name": name, **arguments}, **longer)  # type: ignore[arg-type]
        for name in (*names, "compact")
    ]


def _digest(folder: Path) -> str:
    """Digest of the tables."""
    tables = (path.read_bytes() for path in sorted(folder.rglob(PARAMETERS)))
    return hashlib.sha256(b"".join(tables)).hexdigest()


def measure(name: str, folder: str, seed: int, quick: bool) -> list[Row]:
    """One row for each held-out pair and stage of a network.

    Args:
        name: One of `TRAINED`, which is trained where it is not yet; ``"compact"``; or weights.
        folder: Data in the paper's layout.
        seed: Of the split, the training and the choice of pairs.
        quick: A short version.
    """
    train, held_out = split_dataset(Path(folder), seed=seed)
    weights = trained(name, Path(folder), train, seed, quick) if name in TRAINED else name
    modules, card = load_modules(weights)
    estimate = _methods(modules, card["preset"], weights)
    head = {"preset": card["preset"], "sha256": card["sha256"], "trained_on": len(train)}
    rows: list[Row] = []
    for case in cases(held_out, seed, quick):
        groups = [group for group, belongs in GROUPS.items() if belongs(case)]
        begin = time.perf_counter()
        estimates = estimate(case)
        seconds = time.perf_counter() - begin
        pair = {
            "sequence": case.sequence,
            "source": str(case.source.settings),
            "target": str(case.target.settings),
            "groups": groups,
            "ms": 1e3 * seconds,  # of all stages together
        }
        for method, image in estimates.items():
            rows.append({**head, "method": method, **pair, **_scores(image, case)})
    return rows


def trained(
    name: str, folder: Path, sequences: list[CapturedSequence], seed: int, quick: bool
) -> Path:
    """The weights of a network trained on `sequences`, trained now unless it was before."""
    config = load_config(CONFIGS / f"{name}.yaml")
    changes: dict[str, Any] = {"seed": seed}
    if quick:
        changes |= dict.fromkeys(config.stages(), QUICK_STAGE)
    config = SimulatorConfig.model_validate({**config.card(), **changes})
    key = zlib.crc32(repr((config.card(), _digest(folder))).encode())
    path = WEIGHTS / f"{name}-{key:08x}" / name
    if path.with_suffix(".safetensors").is_file():
        return path.with_suffix(".safetensors")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    command = "ae-env bench paper" + " --quick" * quick
    return train_on_captures(config, sequences, path, command=command, device=device)


def cases(held_out: list[CapturedSequence], seed: int, quick: bool) -> Iterator[Case]:
    """Held-out pairs, of every sequence and group as evenly as chance has it."""
    count, size = QUICK if quick else FULL
    pairs = any_pairs(held_out)
    if count < len(pairs):
        rng = np.random.default_rng([seed, 0])
        pairs = [pairs[i] for i in sorted(rng.choice(len(pairs), count, replace=False))]
    for pair in pairs:
        sequence = held_out[pair.sequence]
        middles = []
        for raw in (sequence.captures[i].read() for i in (pair.source, pair.target)):
            top, left = (max(n - size, 0) // 2 for n in raw.data.shape[1:])
            middle = raw.data[:, top : top + size, left : left + size]
            middles.append(replace(raw, data=middle))
        yield Case(sequence.name, *middles)


def _methods(
    modules: nn.ModuleDict, preset: str, weights: str | Path
) -> Callable[[Case], dict[str, Tensor]]:
    """Maps a case to the estimate of each stage."""
    # The w and b of our own weights are those of a body that did not take these pictures.
    simulator = None
    if "baseline" not in modules:
        simulator = CameraSimulator.from_pretrained(
            weights, device="auto", body_correction=preset != "compact", cache=None
        )

    @torch.no_grad()
    def estimate(case: Case) -> dict[str, Tensor]:
        if simulator is None:
            settings = case.source.settings, case.target.settings
            parameters = torch.tensor([[v for s in settings for v in settings_parameters(s)]])
            return {preset.upper(): modules["baseline"](case.source.data[None], parameters)[0]}
        stages = simulator.stages(case.source, case.target.settings)
        images = {"EXP": stages.exposed, "NS": stages.denoised, "Full": stages.opened}
        return {name: image.cpu() for name, image in images.items()}

    return estimate


def _scores(estimate: Tensor, case: Case) -> Row:
    """PSNR [dB] and SSIM against the capture, before the output's noise is added."""
    image = clipped(estimate, case.target.camera)
    truth = clipped(case.target.data, case.target.camera)
    window = min(7, *(n - 1 + n % 2 for n in truth.shape[1:]))  # odd
    ssim = structural_similarity(
        image.numpy(), truth.numpy(), channel_axis=0, data_range=1.0, win_size=window
    )
    return {"psnr_db": psnr(image, truth), "ssim": float(ssim)}


# -- report ---------------------------------------------------------------------------------------


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    """Means over the pairs of each group, beside what the paper publishes."""
    rows = [row for own in results.values() for row in own]
    frame = pd.DataFrame(rows)
    times = frame.groupby(["preset", "sha256"], sort=False)["ms"].median().reset_index()
    by_group, means = frame.explode("groups"), []
    for group in GROUPS:
        own = by_group[by_group["groups"] == group].groupby(["preset", "method"], sort=False)
        for (preset, method), scores in own:
            head: Row = {"group": group, "preset": preset, "method": method, "pairs": len(scores)}
            means.append(head | dict(scores[["psnr_db", "ssim"]].mean()))
    columns: dict[str, Any] = {
        "network": "`{preset}`",
        "weights": lambda row: f"`{row['sha256'][:12]}`",
        "ms a pair (median)": "{ms:.0f}",
    }
    tables = {
        "means": pivot(
            means,
            line=("PSNR [dB] / SSIM", _label),
            columns="{group} ({pairs})",
            contents={"": "{psnr_db:.2f} / {ssim:.3f}"},
        ),
        "published": table(
            [{"camera": camera, "text": text} for camera, text in PUBLISHED.items()],
            {"published, of the authors' own split": "{camera}", "PSNR [dB] / SSIM": "{text}"},
        ),
        "networks": table(times.to_dict("records"), columns),
    }
    return Report([*means, *rows], tables, figures={"paper.png": _picture(means)})


def _label(row: Mapping[str, Any]) -> str:
    return row["method"] if row["preset"] in ("pc", "dl") else f"{row['method']} `{row['preset']}`"


def _picture(means: list[Row]) -> Figure:
    """A bar for each method, by group."""
    labels = list(dict.fromkeys(map(_label, means)))
    groups = [group for group in GROUPS if any(row["group"] == group for row in means)]
    figure = Figure(figsize=(9.0, 4.0), dpi=100, layout="constrained")
    axes = figure.subplots()
    width = 0.8 / len(labels)
    for number, label in enumerate(labels):
        own = {row["group"]: row["psnr_db"] for row in means if _label(row) == label}
        places = [groups.index(group) + number * width for group in own]
        axes.bar(places, list(own.values()), width, label=label.replace("`", ""))
    axes.set_xticks(
        [n + 0.4 - width / 2 for n in range(len(groups))],
        [group.replace(": ", "\n") for group in groups],
        fontsize=8,
    )
    axes.set_ylabel("PSNR [dB]")
    axes.legend(fontsize=8, ncols=3)
    return figure


BENCHMARK = Benchmark(
    name="paper",
    title="The paper's table on real captures",
    parts=parts,
    report=report,
    code=("simulator", "benchmarks/paper", "benchmarks/harness"),
)
run = BENCHMARK.run
