"""Policies of `examples` that were tuned with a stated budget, beside tuned meters and agents.

The searches are those of `examples/tune_meter.py` in ``docs/results/tuned_meters_runs.json``; CQL
is judged where `examples/offline_cql.py` has written its network.
"""

from __future__ import annotations

import importlib
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from agents.evaluation.evaluation_plan import load_plan
from agents.evaluation.intervals import difference_interval, score_interval
from agents.evaluation.jobs import run_plan
from agents.evaluation.result import Results, overall_gains
from agents.policy import Floats
from agents.report.evaluation import Cell
from benchmarks.harness import Part, Report, Row, benchmark, rounded, table
from benchmarks.isolated import ROOT

RESULTS, CQL = Path("docs/results"), Path("runs/cql.safetensors")
RUNS, SETS = RESULTS / "tuned_meters_runs.json", ("bundled", "polyhaven")
METER = "examples/parametric_meter.py:ParametricMeter"
AGAINST = {"average": "average:tuned", "centre": "centre_weighted:P"}
#: The search whose parameters are set back to their defaults, one at a time.
TAKEN_BACK = "cma-250"


def _searches() -> dict[str, dict[str, Any]]:
    """Runs of each search, ``"cma-250"`` and so on, by their names."""
    found: dict[str, dict[str, Any]] = {}
    for name, run in json.loads((ROOT / RUNS).read_text())["runs"].items():
        found.setdefault(name.rpartition("-")[0], {})[name] = run
    return found


def judge(scenes: str, quick: bool) -> list[Row]:
    plan = load_plan(str(ROOT / RESULTS / "tuned_meters.yaml"))
    named = {name: [name] for name in plan.policies}
    named |= {"defaults": [METER], "shin": ["examples/shin_nelder_mead.py:ShinNelderMead"]}
    if (ROOT / CQL).is_file():
        named["cql"] = [f"examples/offline_cql.py:OfflineCQL?weights={CQL}"]
    for search, own in _searches().items():
        named[search] = [f"{METER}?parameters={RUNS}&run={run}" for run in own]
    changed: dict[str, Any] = {"environment": {**plan.environment, "scenes": scenes}}
    changed |= {"max_scenes": 3} if quick else {}
    plan = plan.changed(policies=[policy for own in named.values() for policy in own], **changed)
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


def parameters(quick: bool) -> dict[str, list[Row]]:
    """What each parameter adds on the scenes that validate, and the scores of the searches."""
    sys.path.insert(0, str(ROOT / "examples"))
    tune: Any = importlib.import_module("tune_meter")
    runs = _searches()
    tune.SCENES = 3 if quick else tune.SCENES
    train, held, context = tune.load_frames()

    def score(frames: Any, parameters: Any) -> float:
        return float(frames.score(tune.ParametricMeter(context, parameters)))

    base = tune.Parameters()
    searches: list[Row] = [
        {"search": "defaults", "train": [score(train, base)], "held": [score(held, base)]}
    ]
    for search, own in runs.items():
        row: Row = {"search": search, "evaluations": next(iter(own.values()))["evaluations"]}
        for key, name in (("train", "train_score"), ("held", "validation_score")):
            row[key] = [run[name] for run in own.values()]
        searches.append(row | {"minutes": [run["cpu_seconds"] / 60.0 for run in own.values()]})
    found = [tune.Parameters(**run["parameters"]) for run in runs[TAKEN_BACK].values()]
    scores, lost = [score(held, own) for own in found], list[Row]()
    for name, default in vars(base).items():
        without = [score(held, replace(own, **{name: default})) for own in found]
        row = {"parameter": name, "default": default, "found": [getattr(p, name) for p in found]}
        lost.append(row | {"lost": np.subtract(scores, without).tolist()})
    return {"searches": searches, "parameters": lost}


def parts(seed: int, quick: bool) -> list[Part]:
    judged = [Part(name, judge, {"scenes": name}, 1) for name in SETS]
    return [*judged, Part("parameters", parameters, threads=1)]


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


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    tables = {name: table(results[name], _JUDGED) for name in SETS}
    for name, columns in (("searches", _SEARCHED), ("parameters", _LOST)):
        tables[name] = table(results["parameters"][name], columns)
    rows = [row for name in SETS for row in results[name]]
    return Report(sum(results["parameters"].values(), rows), tables)


run = benchmark("tuned_meters", parts, report)
