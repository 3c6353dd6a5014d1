"""The camera simulator against the reference camera: error and time of every module.

``compact`` comes with the package; ``paper`` and the baselines ``pc`` and ``dl`` are trained, once,
where ``runs/simulator`` does not hold them. One thread: what the networks are compared with runs on
one.
"""

from typing import Any

from benchmarks.fidelity import defocus, pairs, pictures
from benchmarks.fidelity.models import load_models, train_missing
from benchmarks.harness import Part, Report, benchmark, table
from simulator.utils.files import data_folder

_CARDS = """model = `{name}` | parameters = {parameters:,} | stage: steps in CPU time = {steps} |
weights (SHA-256) = `{sha}`"""


def parts(seed: int, quick: bool) -> list[Part]:
    if not quick:
        train_missing()
    found = [Part(f"pairs {c}", pairs.measure, {"camera": c}, threads=1) for c in pairs.CAMERAS]
    for task in (defocus.measure, defocus.measure_in_focus, pictures.measure):
        found.append(Part(f"{task.__module__} {task.__name__}", task, threads=1))
    return found


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    rows = [row for own in results.values() for row in own]
    cards, shown = load_models().cards, []
    for name, card in cards.items():
        stages = card.get("stages", {}).items()
        steps = (f"{s}: {own['steps']:,} in {own['seconds'] / 60:.1f} min" for s, own in stages)
        shown.append({"name": name, **card, "steps": "; ".join(steps), "sha": card["sha256"][:12]})
    tables = {"models": table(shown, _CARDS)}
    tables |= pairs.tables([row for row in rows if row["part"] == "pairs"])
    tables |= defocus.tables(rows)
    tables |= pictures.tables([row for row in rows if row["part"] == "pictures"])
    return Report(rows, tables, meta={"models": cards, "real_files": data_folder() is not None})


run = benchmark("simulator", parts, report)
