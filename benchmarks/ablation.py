"""What PPO needs in moving light: discount, memory, pixels, sensors, each left out in turn.

Every variant is trained alike on `AutoExposureVideo-v0`, on training scenes and kinds of light, and
judged on unseen scenes in kinds of light that no training had.
"""

from __future__ import annotations

import runpy
import tempfile
import time
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from agents.evaluation.evaluation_plan import load_plan
from agents.evaluation.jobs import run_plan
from agents.evaluation.result import overall_ranking
from agents.learning.training import (
    AgentConfig,
    LearningCurve,
    load_config,
    load_curve,
    train_agent,
)
from agents.report.plots import learning_figure
from benchmarks.harness import RUNS, Part, Report, Row, benchmark, table
from benchmarks.isolated import ROOT
from simulator.utils.files import sibling

#: The training that all variants start from.
CONFIG = ROOT / "configs" / "video" / "ppo.yaml"
#: What each changes: of its hyperparameters, and of its environment.
VARIANTS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "as shipped: gamma 0.8, 12 readings": ({}, {}),
    "gamma 0": ({"gamma": 0.0}, {}),
    "gamma 0.9": ({"gamma": 0.9}, {}),
    "no memory": ({"history": 0}, {}),
    "statistics in place of pixels": ({}, {"observation": "statistics"}),
    "no sensors": ({}, {"sensors": False}),
}
#: A memory that is learnt, in place of the readings: the program that trains and runs it.
RECURRENT, PROGRAM = "RecurrentPPO (LSTM)", ROOT / "examples" / "recurrent_ppo.py"
#: Frames of each training, and of a quick one.
FRAMES, QUICK_FRAMES = 100_000, 4_096
#: Kinds of light and scenes of the judgement.
LIGHTS, SCENES = ("shadows", "clouds", "pans"), 40


def measure(variant: str, frames: int, seed: int, scenes: int) -> Row:
    training, environment = VARIANTS.get(variant, ({}, {}))
    name = "".join(c if c.isalnum() else "-" for c in variant)
    out = RUNS.parent / "bench_ablation" / f"{name}-{frames}-{seed}"
    out.parent.mkdir(parents=True, exist_ok=True)
    begun = time.perf_counter()
    if variant == RECURRENT:
        policy = _train_recurrent(out, frames, seed)
    else:
        changed = {"total_timesteps": frames, "seed": seed, **training}
        train_agent(changed_config(load_config(CONFIG), environment, changed), out)
        policy = f"ppo:{out}"
    seconds = time.perf_counter() - begun
    plan = load_plan("video")
    plan = plan.changed(
        environment={**plan.environment, **environment},
        conditions={light: plan.conditions[light] for light in LIGHTS},
        max_scenes=scenes,
        policies=(policy,),
    )
    with tempfile.TemporaryDirectory() as folder:
        results = run_plan(plan, folder)
    rank = overall_ranking(results).iloc[0]
    row: Row = {"variant": variant, "score": rank.normalised_score, "ci95": rank.ci95}
    row["by_light"] = {light: results[light].normalised(rank.policy) for light in LIGHTS}
    return row | {"training_s": seconds, "curve": load_curve(sibling(out, ".csv"))}


def changed_config(
    config: AgentConfig, environment: dict[str, Any], training: dict[str, Any]
) -> AgentConfig:
    changed = {"environment": environment, "training": training}
    parts = {name: {**getattr(config, name), **own} for name, own in changed.items()}
    return AgentConfig.model_validate({**config.model_dump(), **parts})


def _train_recurrent(out: Path, frames: int, seed: int) -> str:
    curve = LearningCurve(sibling(out, ".csv"))
    recent: deque[float] = deque(maxlen=50)  # as PPO reports it

    def callback(variables: dict[str, Any], _: Any) -> bool:
        recent.append(float(np.mean(variables["rewards"])))
        curve(variables["self"].num_timesteps, frames, {"reward": float(np.mean(recent))})
        return True

    weights = sibling(out, ".safetensors")
    runpy.run_path(str(PROGRAM))["train"](weights, frames, seed, callback)
    return f"{PROGRAM}:RecurrentAgent?weights={weights}"


def parts(seed: int, quick: bool) -> list[Part]:
    frames, scenes = (QUICK_FRAMES, 16) if quick else (FRAMES, SCENES)
    given = {"frames": frames, "seed": seed, "scenes": scenes}
    variants = (*VARIANTS, RECURRENT)
    return [Part(name, measure, {"variant": name, **given}, threads=1) for name in variants]


def report(results: dict[str, Any], meta: dict[str, Any]) -> Report:
    rows: list[Row] = [row | {"minutes": row["training_s"] / 60} for row in results.values()]
    columns = {"variant": "{variant}", "score": "{score:.3f}", "95 % interval": "{ci95:.3f}"}
    columns |= {light: f"{{by_light[{light}]:.3f}}" for light in LIGHTS}
    tables = {"variants": table(rows, columns | {"minutes to train": "{minutes:.0f}"})}
    picture = learning_figure({row["variant"]: row.pop("curve") for row in rows})
    frames = QUICK_FRAMES if meta["quick"] else FRAMES
    return Report(rows, tables, meta={"frames": frames}, figures={"ablation.png": picture})


run = benchmark("ablation", parts, report)
