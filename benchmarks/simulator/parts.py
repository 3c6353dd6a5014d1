"""The parts of a benchmark that measures trained networks: one by one, and kept when finished."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any

import torch

from agents.cli.console import progress_bars
from benchmarks.keeping import Kept
from benchmarks.simulator.models import FOLDER, Models, load_models

Row = dict[str, Any]


def measure_parts(
    name: str,
    parts: Mapping[str, ModuleType],
    *,
    seed: int,
    quick: bool,
    threads: int,
    code: Sequence[str],
) -> tuple[Models, list[Row]]:
    """Loads the networks, training what is missing, and measures every part.

    Args:
        name: Of the benchmark, under which finished parts are kept.
        parts: By name; each has a function ``measure`` that returns rows.
        seed: Of everything that is random.
        quick: Only networks that are there already, and less of everything.
        threads: Of torch.
        code: What is measured, see `Kept`.
    """
    with progress_bars() as progress:
        with progress("models") as task:

            def trained(stage: str, share: float, values: dict[str, float]) -> None:
                task(int(1000 * share), 1000, stage)

            models = load_models(FOLDER, train=not quick, progress=trained)
            task(1, 1)
        weights = [card["sha256"] for card in models.cards.values()]
        kept = Kept(FOLDER / "bench" / name, seed, quick, weights, code=code)
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            rows: list[Row] = []
            for part, module in parts.items():
                with progress(part) as task:

                    def said(what: str, share: float, task: Any = task) -> None:
                        task(int(1000 * share), 1000, what)

                    def measure(module: ModuleType = module, said: Any = said) -> list[Row]:
                        return module.measure(models, seed=seed, quick=quick, progress=said)

                    rows += kept(part, measure)
                    task(1, 1)
        finally:
            torch.set_num_threads(before)
    return models, rows
