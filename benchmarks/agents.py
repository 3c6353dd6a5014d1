"""The long training: both agents over several seeds, and every light meter, on unseen scenes.

Trained agents lie under ``runs/bench_agents``, so that a second run continues where the first was
stopped. It writes the report of an evaluation on each set of scenes to ``agents/`` under the output
folder. Real places are looked for in the folder of real files and in the cache. Trainings run side
by side and show their own progress, so this one is no `benchmarks.harness.benchmark`.
"""

from __future__ import annotations

import time
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

from agents.cli.console import print_files, progress_bars
from agents.evaluation.engine import evaluate, fit_policies
from agents.learning.training import AgentConfig, TrainingJob, load_config, train_in_parallel
from agents.policy import PolicyContext
from agents.policy_names import CLASSIC_METERS, PROGRAMS, make_policy
from agents.report.evaluation import write_report
from agents.rollouts import make_envs
from benchmarks.isolated import ROOT

CONFIGS = {name: ROOT / "configs" / f"{name}.yaml" for name in ("regression", "ppo")}
SEEDS = (0, 1, 2)
EPISODES = 8
#: Unseen scenes of the generators that agents learnt from, and unseen real places.
SETS = ("bundled", "polyhaven")
#: Scorers that no agent was trained on.
OTHER_SCORERS = ("fidelity", "shin", "defects")
QUICK = {"regression": {"frames": 2_000}, "ppo": {"total_timesteps": 2_048}}


def changed_config(
    config: AgentConfig, environment: dict[str, Any], training: dict[str, Any]
) -> AgentConfig:
    changed = {"environment": environment, "training": training}
    parts = {name: {**getattr(config, name), **own} for name, own in changed.items()}
    return AgentConfig.model_validate({**config.model_dump(), **parts})


def run(out: Path, *, seed: int = 0, quick: bool = False) -> None:
    """Trains, evaluates and writes ``agents/`` under `out`."""
    jobs: dict[str, list[TrainingJob]] = {}
    folder = ROOT / "runs" / ("bench_agents_quick" if quick else "bench_agents")
    for name, path in CONFIGS.items():
        config = changed_config(load_config(path), {}, QUICK[name] if quick else {})
        jobs[name] = [
            TrainingJob(f"{name}, seed {s}", config.with_seed(s), folder / f"{name}-{s}")
            for s in SEEDS
        ]
    began = time.perf_counter()
    _train(jobs)
    meta: dict[str, Any] = {"training_seeds": list(SEEDS)}
    meta["training"] = {name: own[0].config.card() for name, own in jobs.items()}
    meta["training_seconds_this_run"] = time.perf_counter() - began

    with closing(make_envs({"split": "test", "resolution": 64}, num_envs=1, frames=1)) as envs:
        context = PolicyContext.from_envs(envs)
    meters = [f"{meter}:{p}" for meter in CLASSIC_METERS for p in PROGRAMS if p != "M"]
    names = ["random", "best_fixed", *(meters[:1] if quick else meters)]
    policies: dict[str, Any] = {name: make_policy(name, context) for name in names}
    with progress_bars() as progress:
        with progress("light meters learn their programs") as task:  # on the agents' scenes
            environment = jobs["regression"][0].config.environment
            fit_policies(policies, environment, seed=seed, progress=task)
        for name, own in jobs.items():
            policies[name] = [make_policy(f"{name}:{job.out}", context) for job in own]
        policies["oracle"] = make_policy("oracle", context)
        for scenes in SETS[:1] if quick else SETS:
            given: dict[str, Any] = {"episodes_per_scene": 1 if quick else EPISODES, "seed": seed}
            test = {"scenes": scenes, "split": "test", "resolution": 64}
            with progress(f"evaluation on {scenes}") as task:
                given |= {"other_scorers": OTHER_SCORERS, "progress": task}
                result = evaluate(policies, test, **given)
            written: dict[str, Any] = {"source": scenes, "split": "test", "extra_meta": meta}
            command = "ae-env bench agents" + " --quick" * quick
            files = write_report(result, out / "agents" / scenes, command=command, **written)
            print_files(files)


def _train(jobs: dict[str, list[TrainingJob]]) -> None:
    everything = [job for own in zip(*jobs.values(), strict=True) for job in own]
    with progress_bars() as progress, ExitStack() as bars:
        tasks = {job.name: bars.enter_context(progress(job.name)) for job in everything}

        def report(name: str, done: int, total: int, values: dict[str, float]) -> None:
            tasks[name](done, total)

        train_in_parallel(everything, progress=report)
