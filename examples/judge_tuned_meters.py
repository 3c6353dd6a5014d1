"""Judges the tuned policies of this folder beside tuned meters and agents, on unseen scenes.

`python examples/judge_tuned_meters.py` writes ``docs/results/tuned_meters.json`` and the tables of
its page, in ten minutes. The searches are those of `tune_meter.py` in ``tuned_meters_runs.json``
there; CQL is judged where `offline_cql.py` has written its network.
"""

import json
import os
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from parametric_meter import Parameters, ParametricMeter
from tune_meter import load_frames

from agents.evaluation.evaluation_plan import load_plan
from agents.evaluation.intervals import difference_interval, score_interval
from agents.evaluation.jobs import run_plan
from agents.evaluation.result import Results, overall_gains
from agents.policy import Floats
from agents.report.evaluation import Cell
from benchmarks.harness import Report, Row, rounded, table, write_report
from simulator.utils.files import result_meta

ROOT, RESULTS, CQL = Path(__file__).parents[1], Path("docs/results"), Path("runs/cql.safetensors")
RUNS, SETS = RESULTS / "tuned_meters_runs.json", ("bundled", "polyhaven")
METER = "examples/parametric_meter.py:ParametricMeter"
AGAINST = {"average": "average:tuned", "centre": "centre_weighted:P"}
#: The search whose parameters are set back to their defaults, one at a time.
TAKEN_BACK = "cma-250"


def _searches() -> dict[str, dict[str, Any]]:
    """Runs of each search, ``"cma-250"`` and so on, by their names."""
    found: dict[str, dict[str, Any]] = {}
    for name, run in json.loads(RUNS.read_text())["runs"].items():
        found.setdefault(name.rpartition("-")[0], {})[name] = run
    return found


def judge(scenes: str) -> list[Row]:
    """A row for each policy, the best first; the runs of a search are one policy's seeds."""
    plan = load_plan(str(RESULTS / "tuned_meters.yaml"))
    named = {name: [name] for name in plan.policies}
    named |= {"defaults": [METER], "shin": ["examples/shin_nelder_mead.py:ShinNelderMead"]}
    if CQL.is_file():
        named["cql"] = [f"examples/offline_cql.py:OfflineCQL?weights={CQL}"]
    for search, own in _searches().items():
        named[search] = [f"{METER}?parameters={RUNS}&run={run}" for run in own]
    policies = [policy for own in named.values() for policy in own]
    plan = plan.changed(policies=policies, environment={**plan.environment, "scenes": scenes})
    with tempfile.TemporaryDirectory() as folder:
        results = run_plan(plan, folder)
    gains = {name: _gains(results, own) for name, own in named.items()}
    rows = list[Row]()
    for name, (gain, span) in gains.items():
        static, best = _gains({"static": results["static"]}, named[name])
        found, seeds = score_interval(gain, span), gain.sum(axis=1) / span.sum()
        row: Row = {"scenes": scenes, "policy": name, "score": found.value, "ci95": found.pair}
        row |= {"seeds": len(seeds), "worst_seed": seeds.min()}
        row |= {"worst_group": (gain.mean(axis=0) / span).min()}
        row |= {"static": static.mean(axis=0).sum() / best.sum()}
        for key, other in AGAINST.items():
            if name != other:
                less = difference_interval(gain, gains[other][0], span)
                row |= {key: less.value, f"{key}_ci95": less.pair}
        rows.append(rounded(row))
    return sorted(rows, key=lambda row: -row["score"])


def _gains(results: Results, policies: Sequence[str]) -> tuple[Floats, Floats]:
    """Gains of runs as of one policy's seeds (K, G), and the span (G,), over all conditions."""
    own = [overall_gains(results, policy) for policy in policies]
    return np.concatenate([gains for gains, _ in own]), own[0][1]


def parameters() -> dict[str, list[Row]]:
    """What each parameter adds on the scenes that validate, and the scores of the searches."""
    (train, held, context), runs, base = load_frames(), _searches(), Parameters()

    def score(frames: Any, parameters: Parameters) -> float:
        return float(frames.score(ParametricMeter(context, parameters)))

    searches: list[Row] = [
        {"search": "defaults", "train": [score(train, base)], "held": [score(held, base)]}
    ]
    for search, own in runs.items():
        row: Row = {"search": search, "evaluations": next(iter(own.values()))["evaluations"]}
        for key, name in (("train", "train_score"), ("held", "validation_score")):
            row[key] = [run[name] for run in own.values()]
        searches.append(row | {"minutes": [run["cpu_seconds"] / 60.0 for run in own.values()]})
    found = [Parameters(**run["parameters"]) for run in runs[TAKEN_BACK].values()]
    scores, lost = [score(held, own) for own in found], list[Row]()
    for name, default in vars(base).items():
        without = [score(held, replace(own, **{name: default})) for own in found]
        row = {"parameter": name, "default": default, "found": [getattr(p, name) for p in found]}
        lost.append(row | {"lost": np.subtract(scores, without).tolist()})
    return {"searches": searches, "parameters": lost}


_JUDGED = """policy = {policy} | seeds = {seeds} | score = {score:.3f} |
95 % interval = {ci95:.3f} | worst seed = {worst_seed:.3f} |
worst source group = {worst_group:.3f} | static = {static:.3f} |
minus `average:tuned` = {average:+.3f} ({average_ci95:+.3f}) |
minus `centre_weighted:P` = {centre:+.3f} ({centre_ci95:+.3f})"""
_SEARCHED: dict[str, Cell] = {
    "search": "{search}",
    "evaluations": "{evaluations}",
    "runs": lambda row: len(row["train"]),
    "training scenes": lambda row: _spread(row["train"], ".3f"),
    "validation scenes": lambda row: _spread(row["held"], ".3f"),
    "CPU minutes a run": lambda row: f"{np.mean(row['minutes']):.1f}" if "minutes" in row else "",
}
_LOST: dict[str, Cell] = {
    "parameter": "{parameter}",
    "default": "{default:g}",
    "found, three runs": lambda row: ", ".join(f"{value:.2f}" for value in row["found"]),
    "lost without it": lambda row: _spread(row["lost"], "+.3f"),
}


def _spread(values: Sequence[float], form: str) -> str:
    """Mean and range, or the value of a single run."""
    text = format(np.mean(values), form)
    return f"{text} ({min(values):{form}} to {max(values):{form}})" if len(values) > 1 else text


def main() -> None:
    """Judges, and writes what was found."""
    os.chdir(ROOT)
    judged = {name: judge(name) for name in SETS}
    more = parameters()
    tables = {name: table(own, _JUDGED) for name, own in judged.items()}
    for name, columns in (("searches", _SEARCHED), ("parameters", _LOST)):
        tables[name] = table(more[name], columns)
    rows = [row for own in (*judged.values(), *more.values()) for row in own]
    meta = result_meta("python examples/judge_tuned_meters.py", 0)
    write_report(Report(rows, tables), RESULTS, "tuned_meters", meta)


if __name__ == "__main__":
    main()
