"""The camera simulator against the reference camera: error and time of every module.

    ae-env bench simulator

Needs trained weights: ``compact`` comes with the package; ``paper`` and the baselines ``pc`` and
``dl`` are trained by their configurations, once, where ``runs/simulator`` does not hold them. The
real files that ``AE_ENV_DATA`` names are used where they are. One thread: what the networks are
compared with runs on one.
"""

from __future__ import annotations

from typing import Any

from benchmarks.fidelity import defocus, in_focus, pairs, pictures
from benchmarks.fidelity.models import load_models, train_missing
from benchmarks.harness import Part, Report, benchmark, data_root, table

#: By the part of their rows, in the order of the report.
MODULES: dict[str, Any] = {
    "pairs": pairs,
    "defocus": defocus,
    "in focus": in_focus,
    "pictures": pictures,
}
_CARDS = """model = `{name}` | parameters = {parameters:,} | stage: steps in CPU time = {steps} |
weights (SHA-256) = `{sha}`"""


def parts(seed: int, quick: bool) -> list[Part]:
    if not quick:
        train_missing()
    given, found = {"seed": seed, "quick": quick}, []
    for camera in pairs.CAMERAS:
        for mix in pairs.PAIRS:
            arguments = {"camera": camera, "mix": mix, **given}
            found.append(Part(f"pairs {camera} {mix}", pairs.measure, arguments, threads=1))
    for name in list(MODULES)[1:]:
        found.append(Part(name, MODULES[name].measure, given, threads=1))
    return found


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    rows = [row for own in results.values() for row in own]
    cards, shown = load_models().cards, []
    for name, card in cards.items():
        stages = card.get("stages", {}).items()
        steps = (f"{s}: {own['steps']:,} in {own['seconds'] / 60:.1f} min" for s, own in stages)
        shown.append({"name": name, **card, "steps": "; ".join(steps), "sha": card["sha256"][:12]})
    tables = {"models": table(shown, _CARDS)}
    for name, module in MODULES.items():
        tables |= module.tables([row for row in rows if row["part"] == name])
    return Report(rows, tables, meta={"models": cards, "real_files": data_root() is not None})


run = benchmark("simulator", parts, report)
