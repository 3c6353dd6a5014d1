"""The long training: both agents over several seeds, against every light meter, on unseen scenes.

Run ``ae-env bench agents`` in a clone of the repository. Trained agents are kept under
``runs/bench_agents``, so that a second run goes on where the first was stopped; what it writes to
``agents/`` under the output folder is the table that the documentation quotes.
"""

from __future__ import annotations

import time
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from agents.episodes import make_envs
from agents.evaluation.engine import evaluate
from agents.evaluation.running import cache_score_tables, fit_policies
from agents.learning.training import TrainingJob, load_config, train_in_parallel
from agents.policy import CLASSIC_METERS, PROGRAMS, PolicyContext, make_policy
from agents.report.evaluation_report import write_report

CONFIGS = {"regression": Path("configs/regression.yaml"), "ppo": Path("configs/ppo.yaml")}
SEEDS = (0, 1, 2)
EPISODES = 8
QUICK = {"regression": {"frames": 2_000}, "ppo": {"total_timesteps": 2_048}}


def run(out: Path, *, seed: int = 0, quick: bool = False) -> None:
    """Trains, evaluates and writes ``agents/`` under `out`.

    Args:
        out: Folder of results.
        seed: Of the evaluation; the training seeds are 0, 1 and 2.
        quick: A few frames of training, to see that everything runs.
    """
    jobs: dict[str, list[TrainingJob]] = {}
    folder = Path("runs/bench_agents_quick" if quick else "runs/bench_agents")
    for name, path in CONFIGS.items():
        config = load_config(path)
        if quick:
            config = config.model_copy(update={"training": {**config.training, **QUICK[name]}})
        jobs[name] = [
            TrainingJob(f"{name}, seed {s}", config.with_seed(s), folder / f"{name}-{s}")
            for s in SEEDS
        ]
    began = time.perf_counter()
    _train(jobs)
    seconds = time.perf_counter() - began

    test = {"scenes": "bundled", "split": "test", "resolution": 64}
    envs = make_envs(test, num_envs=1, frames=1)
    context = PolicyContext.from_envs(envs)
    programs = [program for program in PROGRAMS if program != "M"]
    meters = [f"{meter}:{program}" for meter in CLASSIC_METERS for program in programs]
    names = ["random", "best_fixed", *(meters if not quick else meters[:1])]
    policies = {name: make_policy(name, context) for name in names}
    with Progress() as display:
        task = display.add_task("light meters learn their programs")
        fit_policies(  # on the same scenes as the agents
            policies,
            jobs["regression"][0].config.environment,
            seed=seed,
            progress=lambda done, total, _: display.update(task, completed=done, total=total),
        )
        learnt = {
            name: [make_policy(f"{name}:{job.out}", context) for job in own]
            for name, own in jobs.items()
        }
        oracle = {"oracle": make_policy("oracle", context)}
        task = display.add_task("evaluation")
        result = evaluate(
            {**policies, **learnt, **oracle},
            test,
            episodes_per_scene=1 if quick else EPISODES,
            seed=seed,
            progress=lambda done, total, _: display.update(task, completed=done, total=total),
        )
    files = write_report(
        result,
        out / "agents",
        command="ae-env bench agents" + (" --quick" if quick else ""),
        source="bundled",
        split="test",
        extra_meta={
            "training_seeds": list(SEEDS),
            "training": {name: own[0].config.card() for name, own in jobs.items()},
            "training_seconds_this_run": seconds,
        },
    )
    for path in files.values():
        Console().print(f"wrote {path}")


def _train(jobs: dict[str, list[TrainingJob]]) -> None:
    first = next(iter(jobs.values()))[0].config
    with Progress() as display:
        task = display.add_task("score tables")
        cache_score_tables(
            first.environment,
            lambda done, total, note="": display.update(task, completed=done, total=total),
        )
        everything = [job for own in zip(*jobs.values(), strict=True) for job in own]
        tasks = {job.name: display.add_task(job.name, total=None) for job in everything}

        def report(name: str, done: int, total: int, values: dict[str, float]) -> None:
            display.update(tasks[name], completed=done, total=total)

        train_in_parallel(everything, progress=report)
