"""The camera simulator against the reference camera: error and time of every module.

    ae-env bench simulator

Needs trained weights: ``compact`` comes with the package; ``paper`` and the baselines ``pc`` and
``dl`` are trained by their configurations, once, where ``runs/simulator`` does not hold them. The
real files that ``AE_ENV_DATA`` names are used where they are. One thread: what the networks are
compared with runs on one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from benchmarks.fidelity import defocus, in_focus, pairs, pictures
from benchmarks.fidelity.models import checksums, load_models, train_missing
from benchmarks.harness import Benchmark, Part, Report, Row, data_root, table

#: By the part of their rows, in the order of the report.
MODULES: dict[str, Any] = {
    "pairs": pairs,
    "defocus": defocus,
    "in focus": in_focus,
    "pictures": pictures,
}


def parts(seed: int, quick: bool) -> list[Part]:
    """Parts to measure; a full run first trains the networks that are missing."""
    if not quick:
        train_missing()
    arguments = {"seed": seed, "quick": quick}
    found = [
        Part(f"pairs {camera} {mix}", pairs.measure, {"camera": camera, "mix": mix, **arguments})
        for camera in pairs.CAMERAS
        for mix in pairs.PAIRS
    ]
    found += [Part(name, module.measure, arguments) for name, module in list(MODULES.items())[1:]]
    weights = checksums()
    return [replace(part, threads=1, depends=weights) for part in found]


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    """The report, of the results by name of the part."""
    rows = [row for own in results.values() for row in own]
    cards = load_models().cards
    tables = {"models": table([{"name": name, **card} for name, card in cards.items()], _CARDS)}
    for name, module in MODULES.items():
        tables |= module.tables([r for r in rows if r["part"] == name])
    return Report(rows, tables, meta={"models": cards, "real_files": data_root() is not None})


def _stages(card: Row) -> str:
    return "; ".join(
        f"{stage}: {own['steps']:,} in {own['seconds'] / 60:.1f} min"
        for stage, own in card.get("stages", {}).items()
    )


_CARDS: dict[str, Any] = {
    "model": "`{name}`",
    "parameters": "{parameters:,}",
    "stage: steps in CPU time": _stages,
    "weights (SHA-256)": lambda card: f"`{card['sha256'][:12]}`",
}

BENCHMARK = Benchmark(
    name="simulator",
    title="The camera simulator, measured",
    parts=parts,
    report=report,
    code=("simulator", "ae_env/scenes", "benchmarks/fidelity", "benchmarks/harness"),
)
run = BENCHMARK.run
