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

#: In the order of the report: module and heading.
SECTIONS: dict[str, tuple[Any, str]] = {
    "pairs": (pairs, "The paper's table"),
    "defocus": (defocus, "Defocus: f/11 to f/4"),
    "in focus": (in_focus, "Pictures in focus"),
    "pictures": (pictures, "Pictures"),
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
    found.append(Part("defocus", defocus.measure, arguments))
    found.append(Part("in focus", in_focus.measure, arguments))
    found.append(Part("pictures", pictures.measure, arguments))
    weights = checksums()
    return [replace(part, threads=1, depends=weights) for part in found]


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    """The report, of the results by name of the part."""
    rows = [row for own in results.values() for row in own]
    cards = load_models().cards
    page = [
        "One thread, float32. Ground truth is the reference camera "
        "(`simulator/reference/camera.py`); every scene is from the test split, whose "
        "source groups no training saw. A millisecond is that of one 4 x 128 x 128 raw unless "
        "stated otherwise.",
        table([{"name": name, **card} for name, card in cards.items()], _CARD_COLUMNS),
    ]
    if data_root() is None:
        page.append("Without the real files (`AE_ENV_DATA`): what needs them is left out.")
    for name, (module, heading) in SECTIONS.items():
        page += [f"## {heading}", *module.section([r for r in rows if r["part"] == name])]
    return Report(rows, page, {"models": cards, "real_files": data_root() is not None})


def _stages(card: Row) -> str:
    return "; ".join(
        f"{stage}: {own['steps']:,} in {own['seconds'] / 60:.1f} min"
        for stage, own in card.get("stages", {}).items()
    )


_CARD_COLUMNS: dict[str, Any] = {
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
    code=("simulator", "ae_env/scenes", "benchmarks/fidelity", "benchmarks/captures"),
)
run = BENCHMARK.run
