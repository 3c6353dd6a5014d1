"""Do agents that were trained on the simulator do as well in the truth?

    ae-env bench transfer                  # both halves
    ae-env bench transfer --part agents    # trains in every world, judges in the truth
    ae-env bench transfer --part tables    # score tables predicted from one raw

Trained agents lie under ``runs/bench_transfer``, and are known by their configuration: remove the
folder after a change of the code that they depend on.
"""

from dataclasses import asdict
from typing import Any

from benchmarks.harness import Part, Report, benchmark
from benchmarks.transfer import agents, tables


def parts(seed: int, quick: bool, part: str | None = None) -> list[Part]:
    found = [Part("agents", agents.measure)] if part != "tables" else []
    for number, own in enumerate(agents.plan_of(quick).tables if part != "agents" else ()):
        for crop, iso in ((crop, iso) for crop in own.crops for iso in own.isos):
            arguments = {"number": number, "crop": crop, "iso": iso}
            found.append(Part(f"{own.scorer} {crop} ISO {iso}", tables.measure, arguments))
    return found


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    plan, judged = agents.plan_of(meta["quick"]), results.pop("agents", [])
    predicted = [row for own in results.values() for row in own]
    found = {"agents": agents.shown(judged), "tables": tables.shown(predicted)}
    used = [*plan.worlds, *(name for one in plan.tables for name in one.simulators)]
    more = {"plan": asdict(plan), "training_set": agents.training_set(plan)}
    more["left_out"] = [name for name in dict.fromkeys(used) if not agents.has_weights(name)]
    return Report([*judged, *predicted], found, meta=more)


run = benchmark("transfer", parts, report)
