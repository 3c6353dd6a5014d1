"""A small local feature trained under five augmentations, judged across exposure gaps."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import torch

from benchmarks.features import judging, training
from benchmarks.features.report import SEEDS, report
from benchmarks.harness import Part, Row, benchmark
from benchmarks.isolated import median_seconds

#: Photographs, maps, gaps and ISOs of a quick run.
QUICK_SOURCES, QUICK_GAPS, QUICK_ISOS = 4, (0.0, 4.0), (12800.0,)
#: Sides of the pictures whose augmentation is timed [pixel].
TIMED = (80, 512)


def measure(seed: int, body: int, quick: bool) -> list[dict[str, Any]]:
    """Trains under every augmentation, and judges all on the same validation and test scenes.

    `seed` is that of the training, `body` that of the test pairs and of the body that takes them.
    """
    torch.set_num_threads(1)
    limit, steps = (QUICK_SOURCES, training.QUICK_STEPS) if quick else (None, training.STEPS)
    trained = {arm: training.train(arm, seed, steps, limit) for arm in training.AUGMENTATIONS}
    detects = {arm: model.detect for arm, (model, _) in trained.items()}
    rows = {split: _judged(detects, split, body, quick) for split in ("validation", "test")}
    return [
        {"arm": arm, "seed": seed, "steps": steps, "seconds": seconds}
        | {split: found[arm] for split, found in rows.items()}
        for arm, (_, seconds) in trained.items()
    ]


def _judged(
    detects: dict[str, judging.Detect], split: Any, body: int, quick: bool
) -> dict[str, list[Row]]:
    given: Any = () if split == "test" else ((0.0, 4.0), (1600.0,))
    taken = judging.conditions(*((QUICK_GAPS, QUICK_ISOS) if quick else given))
    limit = QUICK_SOURCES if quick else None
    return judging.judge(detects, judging.held_out_pairs(split, taken, body, limit))


def measure_aliked(weights: str, body: int, quick: bool) -> list[dict[str, Any]]:
    torch.set_num_threads(1)
    rows = _judged({"aliked": judging.aliked(Path(weights))}, "test", body, quick)["aliked"]
    return [{"arm": "aliked", "seed": 0, "steps": None, "seconds": None, "test": rows}]


def measure_time(seed: int) -> list[Row]:
    torch.set_num_threads(1)
    rows = []
    for arm, augmentation in training.AUGMENTATIONS.items():
        row: Row = {"arm": arm}
        for side in TIMED if arm != "none" else ():
            count = max(1, 2 * TIMED[0] // side) * 4
            generator = torch.Generator().manual_seed(seed)
            pictures = torch.rand(count, 3, side, side, generator=generator)
            call = partial(augmentation, pictures, list(range(count)))
            call()  # compiles
            row[f"ms_{side}"] = 1e3 * median_seconds(call, least=0.3) / count
        rows.append(row)
    return rows


def parts(seed: int, quick: bool, weights: Path | None = None) -> list[Part]:
    found, given = [Part("time", measure_time, {"seed": seed}, 1)], {"body": seed, "quick": quick}
    if weights is not None:
        if not weights.is_file():
            raise ValueError(f"`weights` (={str(weights)!r}) must be an existing file")
        judging.aliked(weights)  # raises before any work
        arguments = {"weights": str(weights.resolve()), **given}
        found.append(Part("aliked", measure_aliked, arguments, 1))
    for number in range(seed, seed + (1 if quick else SEEDS)):
        found.append(Part(f"seed {number}", measure, {"seed": number, **given}, 1))
    return found


run = benchmark("features", parts, report)
