"""The paper's table on a folder in the layout of the paper's dataset.

    ae-env bench paper FOLDER

The paper's networks and its two baselines are trained on a part of the sequences (or weights are
given), and every method is measured on pairs of real captures of the others. Published numbers are
of another split of the authors' data.
"""

import time
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor, nn

from benchmarks.fidelity.models import CONFIGS, baseline, scores
from benchmarks.fidelity.pairs import PUBLISHED, needs_cleaning
from benchmarks.harness import RUNS, Part, Report, Row, benchmark, clipped, pivot, table
from simulator import CameraSimulator, RawImage
from simulator.networks.weights import load_modules
from simulator.reference.sequences import any_pairs
from simulator.training import paper_dataset
from simulator.training.paper_dataset import CapturedSequence, split_dataset, train_on_captures
from simulator.training.trainer import SimulatorConfig
from simulator.utils.config_file import load_yaml

#: What is trained: the paper's networks, parameter concatenation and decoupled learning.
TRAINED = ("paper", "pc", "dl")
#: Pairs that are measured, and largest height and width, of which the middle is taken [packed
#: pixel]. All published pictures fit into the first.
FULL, QUICK = (200, 1024), (6, 128)
#: Budget of each stage of a quick run.
QUICK_STAGE = {"steps": 2, "batch": 1, "crop": 16}
#: Folder of the trained networks.
WEIGHTS = RUNS.parent / "paper"


class Case(NamedTuple):
    """Two captures of one held-out sequence: the input, and what a method should predict."""

    sequence: str
    source: RawImage
    target: RawImage


def _opens(case: Case) -> int:
    """Thirds of stops that the aperture opens by."""
    return case.source.settings.aperture_stop - case.target.settings.aperture_stop


def _cleaner(case: Case) -> bool:
    """Whether the target has less noise than the source brings, averaged over the picture."""
    return needs_cleaning(case.source, case.target.settings, case.target.data)


#: Transitions, in the order of the report; the last four are a partition of all.
GROUPS: dict[str, Callable[[Case], bool]] = {
    "all": lambda case: True,
    "exposure and noise: cleaner target": lambda case: _opens(case) == 0 and _cleaner(case),
    "exposure and noise: noisier target": lambda case: _opens(case) == 0 and not _cleaner(case),
    "aperture opens": lambda case: _opens(case) > 0,
    "aperture closes": lambda case: _opens(case) < 0,
}


def parts(
    seed: int, quick: bool, folder: Path | None = None, weights: Path | None = None
) -> list[Part]:
    assert folder is not None
    split_dataset(folder, seed=seed)  # raises before any work
    names = list(TRAINED)
    if weights is not None:
        preset = load_modules(weights)[1]["preset"]
        if preset not in ("compact", "paper", "ncs"):
            wrong = f"`weights` (={str(weights)!r}) must be of all three modules"
            raise ValueError(f"{wrong}, not {preset!r}")
        names = [str(weights.resolve())]
    own = [{"name": n, "folder": str(folder.resolve())} for n in dict.fromkeys([*names, "compact"])]
    return [Part(given["name"], measure, given) for given in own]


def measure(name: str, folder: str, seed: int, quick: bool) -> list[Row]:
    """A row for each held-out pair and stage of one of `TRAINED`, ``"compact"`` or weights."""
    train, held_out = split_dataset(Path(folder), seed=seed)
    weights = trained(name, Path(folder), train, seed, quick) if name in TRAINED else name
    modules, card = load_modules(weights)
    estimate = _methods(modules, card["preset"], weights)
    head = {"preset": card["preset"], "sha256": card["sha256"], "trained_on": len(train)}
    rows: list[Row] = []
    for case in cases(held_out, seed, quick):
        begin = time.perf_counter()
        estimates = estimate(case)
        pair: Row = {"sequence": case.sequence, "source": str(case.source.settings)}
        pair |= {"target": str(case.target.settings)}
        pair["groups"] = [group for group, belongs in GROUPS.items() if belongs(case)]
        pair["ms"] = 1e3 * (time.perf_counter() - begin)  # of all stages together
        truth = clipped(case.target.data, case.target.camera)
        for method, image in estimates.items():
            own = scores(image, truth, case.target.camera)
            rows.append({**head, "method": method, **pair, **own})
    return rows


def trained(
    name: str, folder: Path, sequences: list[CapturedSequence], seed: int, quick: bool
) -> Path:
    config = load_yaml(CONFIGS / f"{name}.yaml", SimulatorConfig)
    changes: dict[str, Any] = {"seed": seed}
    if quick:
        changes |= dict.fromkeys(config.stages(), QUICK_STAGE)
    config = SimulatorConfig.model_validate({**config.card(), **changes})
    tables = [path.read_bytes() for path in sorted(folder.rglob(paper_dataset.PARAMETERS))]
    key = zlib.crc32(repr((config.card(), tables)).encode())
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
    if "baseline" in modules:
        network = modules["baseline"]
        return lambda case: {preset.upper(): baseline(network, case.source, case.target.settings)}
    # The w and b of our own weights are those of a body that did not take these pictures.
    simulator = CameraSimulator.from_pretrained(
        weights, device="auto", body_correction=preset != "compact", cache=None
    )

    @torch.no_grad()
    def estimate(case: Case) -> dict[str, Tensor]:
        stages = simulator.stages(case.source, case.target.settings)
        images = {"EXP": stages.exposed, "NS": stages.denoised, "Full": stages.opened}
        return {name: image.cpu() for name, image in images.items()}

    return estimate


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    rows = [row for own in results.values() for row in own]
    frame = pd.DataFrame(rows)
    times = frame.groupby(["preset", "sha256"], sort=False)["ms"].median().reset_index()
    times["sha"] = times["sha256"].str[:12]
    by_group = frame.explode("groups").rename(columns={"groups": "group"})
    groups = by_group.groupby(["group", "preset", "method"], sort=False)
    means = groups[["psnr_db", "ssim"]].mean().assign(pairs=groups.size()).reset_index()
    ours = ~means["preset"].isin(TRAINED[1:])
    means["label"] = means["method"].where(~ours, means["method"] + " `" + means["preset"] + "`")
    means["group"] = pd.Categorical(means["group"], list(GROUPS))
    means = means.sort_values("group", kind="stable")
    published = [{"camera": camera, "text": text} for camera, text in PUBLISHED.items()]
    line, values = "PSNR [dB] / SSIM = {label:md}", "{psnr_db:.2f} / {ssim:.3f}"
    networks = "network = `{preset}` | weights = `{sha}` | ms a pair (median) = {ms:.0f}"
    of_paper = "published, of the authors' own split = {camera} | PSNR [dB] / SSIM = {text}"
    tables = {
        "means": pivot(means.to_dict("records"), line, "{group} ({pairs})", values),
        "published": table(published, of_paper),
        "networks": table(times.to_dict("records"), networks),
    }
    return Report([*means.to_dict("records"), *rows], tables)


run = benchmark("paper", parts, report)
