"""A small local feature trained under five augmentations, judged across exposure gaps."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import torch

from benchmarks.features import judging, training
from benchmarks.features.report import SEEDS, report
from benchmarks.harness import Benchmark, Part, Row
from benchmarks.isolated import median_seconds

#: Photographs, maps, gaps and ISOs of a quick run.
QUICK_SOURCES, QUICK_GAPS, QUICK_ISOS = 4, (0.0, 4.0), (12800.0,)
#: Sides of the pictures whose augmentation is timed [pixel].
TIMED = (80, 512)


def measure(seed: int, body: int, quick: bool) -> list[dict[str, Any]]:
    """Trains under every augmentation, and judges all on the same validation and test scenes.

    Args:
        seed: Of the training.
        body: Seed of the test pairs and of the body that takes them.
        quick: Whether to do so with a few pictures and steps.
    """
    torch.set_num_threads(1)
    limit = QUICK_SOURCES if quick else None
    steps = training.QUICK_STEPS if quick else training.STEPS
    trained = {arm: training.train(arm, seed, steps, limit) for arm in training.AUGMENTATIONS}
    detects = {arm: model.detect for arm, (model, _) in trained.items()}
    rows = {
        split: judging.judge(
            detects, judging.held_out_pairs(split, _conditions(quick, split), body, limit)
        )
        for split in ("validation", "test")
    }
    return [
        {"arm": arm, "seed": seed, "steps": steps, "seconds": seconds}
        | {split: found[arm] for split, found in rows.items()}
        for arm, (_, seconds) in trained.items()
    ]


def _conditions(quick: bool, split: str) -> list[judging.Condition]:
    if quick:
        return judging.conditions(QUICK_GAPS, QUICK_ISOS)
    return judging.conditions() if split == "test" else judging.conditions((0.0, 4.0), (1600.0,))


def measure_aliked(weights: str, body: int, quick: bool) -> list[dict[str, Any]]:
    """Judges ALIKED with given weights on the same pairs."""
    torch.set_num_threads(1)
    limit = QUICK_SOURCES if quick else None
    pairs = judging.held_out_pairs("test", _conditions(quick, "test"), body, limit)
    rows = judging.judge({"aliked": judging.aliked(Path(weights))}, pairs)["aliked"]
    return [{"arm": "aliked", "seed": 0, "steps": None, "seconds": None, "test": rows}]


def measure_time(seed: int) -> list[Row]:
    """Milliseconds for each picture, of every augmentation, on one thread."""
    torch.set_num_threads(1)
    rows = []
    for arm, augmentation in training.AUGMENTATIONS.items():
        row: Row = {"arm": arm}
        for side in TIMED:
            count = max(1, 2 * TIMED[0] // side) * 4
            generator = torch.Generator().manual_seed(seed)
            pictures = torch.rand(count, 3, side, side, generator=generator)
            seeds = list(range(count))
            if augmentation is training.unchanged:
                continue
            augmentation(pictures, seeds)  # compiles
            seconds = median_seconds(lambda: augmentation(pictures, seeds), least=0.3)  # noqa: B023
            row[f"ms_{side}"] = 1e3 * seconds / count
        rows.append(row)
    return rows


def parts(seed: int, quick: bool, weights: Path | None = None) -> list[Part]:
    """A part for each seed of the training; what it has trained is kept if it is stopped."""
    if weights is not None and not weights.is_file():
        raise ValueError(f"`weights` (={str(weights)!r}) must be an existing file")
    found = [Part("time", measure_time, {"seed": seed}, threads=1)]
    if weights is not None:
        judging.aliked(weights)  # raises before any work
        arguments = {"weights": str(weights.resolve()), "body": seed, "quick": quick}
        depends = {"weights": zlib.crc32(weights.read_bytes())}
        found.append(Part("aliked", measure_aliked, arguments, threads=1, depends=depends))
    for number in range(1 if quick else SEEDS):
        arguments = {"seed": seed + number, "body": seed, "quick": quick}
        found.append(Part(f"seed {seed + number}", measure, arguments, threads=1))
    return found


BENCHMARK = Benchmark(
    name="features",
    title="Local features under augmentation, across exposure gaps",
    parts=parts,
    report=report,
    code=("simulator/augment", "benchmarks/features"),
)
run = BENCHMARK.run
