"""Agents trained in each world, and judged on held-out scenes in the truth."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from ae_env.scenes.scene import Crop
from agents.cli.console import progress_bars
from agents.evaluation.engine import evaluate
from agents.evaluation.intervals import Interval, difference_interval, score_interval
from agents.evaluation.result import EvaluationResult
from agents.learning.training import (
    AgentConfig,
    TrainingJob,
    is_trained,
    load_config,
    train_agent,
)
from agents.learning.workers import run_in_parallel, send_progress
from agents.policy import PolicyContext
from agents.policy_names import make_policy
from agents.rollouts import make_envs
from benchmarks.harness import Row
from benchmarks.isolated import ROOT
from benchmarks.transfer.worlds import (
    EXP,
    RESOLUTION,
    TRUTH,
    WORLDS,
    TransferPlan,
    World,
    has_weights,
    held_out,
    training_set,
)

#: Name of the hyperparameter that counts frames, by agent.
_FRAMES = {"regression": "frames", "ppo": "total_timesteps"}
#: Of the scenes that agents are trained and judged on: pixels are averaged to frames.
CROP: Crop = "box"
#: What the agents together are called.
TOGETHER = "agents together"
#: The trainings of each agent and world, one for each seed.
Jobs = dict[tuple[str, str], list[TrainingJob]]


def agent_rows(plan: TransferPlan, folder: Path, *, seed: int = 0) -> list[Row]:
    """Trains what `folder` does not have, judges all agents; a row for each agent and world.

    `seed` is that of the evaluation; the training seeds are the plan's.
    """
    jobs = training_jobs(plan, folder)
    train(jobs)
    result = judged(plan, jobs, seed=seed)
    minutes = {key: [training_seconds(job.out) / 60.0 for job in own] for key, own in jobs.items()}
    return result_rows(result, minutes, plan)


# -- training -------------------------------------------------------------------------------------


def training_jobs(plan: TransferPlan, folder: Path) -> Jobs:
    """The trainings by agent and world: they differ in the environment's options only.

    Seeds change slowest, so that a run that is stopped has some of every world. Worlds whose
    networks are not there are left out.
    """
    worlds = [name for name in plan.worlds if has_weights(name)]
    jobs: Jobs = {(agent, world): [] for agent in plan.agents for world in worlds}
    for seed in plan.seeds:
        for (agent, world), own in jobs.items():
            config = _config(plan, agent, world).with_seed(seed)
            name = f"{agent}, {world}, seed {seed}"
            own.append(TrainingJob(name, config, folder / f"{agent}-{world}-{seed}"))
    return jobs


def _config(plan: TransferPlan, agent: str, world: str) -> AgentConfig:
    config = load_config(ROOT / "configs" / f"{agent}.yaml")
    options = WORLDS[world].options(training_set(plan)) | common_options(plan)
    return AgentConfig.model_validate(
        {
            **config.model_dump(),
            "environment": {**config.environment, **options},
            "training": {**config.training, _FRAMES[agent]: plan.frames},
        }
    )


def common_options(plan: TransferPlan) -> dict[str, Any]:
    """Arguments of the environment that are the same in training and judging."""
    return {"resolution": RESOLUTION, "crop": CROP, "scorer": plan.scorer}


def train(jobs: Jobs) -> None:
    """Trains every job that is not trained yet, as many at a time as there are cores."""
    everything = [job for own in zip(*jobs.values(), strict=True) for job in own]
    waiting = [job for job in everything if not is_trained(job.config, job.out)]
    with progress_bars() as progress, ExitStack() as bars:
        whole = bars.enter_context(progress(f"{len(waiting)} trainings"))
        shares = dict.fromkeys((job.name for job in waiting), 0.0)

        def report(name: str, done: int, total: int) -> None:
            shares[name] = done / total
            whole(int(1000 * sum(shares.values())), 1000 * len(shares), name)

        run_in_parallel(_train, waiting, progress=report)


def _train(job: TrainingJob) -> None:
    """In a worker: trains one agent, and adds the time that it takes to what it took before."""
    last, began = 0, time.perf_counter()
    resumes = Path(f"{job.out}.checkpoint").is_file()
    before = training_seconds(job.out) if resumes else 0.0
    job.out.parent.mkdir(parents=True, exist_ok=True)

    def report(done: int, total: int, _: Mapping[str, float]) -> None:
        nonlocal last
        if done == total or done - last >= total // 100:
            last = done
            seconds = before + time.perf_counter() - began
            _seconds_file(job.out).write_text(f"{seconds:.1f}\n", encoding="ascii")
            send_progress(job.name, done, total)

    train_agent(job.config, job.out, progress=report)


def training_seconds(out: Path) -> float:
    """How long a training has taken, its scenes and their networks included; 0 if unknown."""
    file = _seconds_file(out)
    return float(file.read_text(encoding="ascii")) if file.is_file() else 0.0


def _seconds_file(out: Path) -> Path:
    return Path(f"{out}.seconds")


# -- judging --------------------------------------------------------------------------------------


def judged(plan: TransferPlan, jobs: Jobs, *, seed: int = 0) -> EvaluationResult:
    """Every agent on the same episodes on held-out scenes, in the truth."""
    scenes = held_out(plan, plan.judged_scenes, CROP)
    options = {"scenes": scenes, "split": "test", **common_options(plan)}
    envs = make_envs(options, num_envs=1, frames=1)
    context = PolicyContext.from_envs(envs)
    envs.close()
    policies = {
        policy_name(agent, world): [make_policy(f"{agent}:{job.out}", context) for job in own]
        for (agent, world), own in jobs.items()
    }
    with progress_bars() as progress, progress("evaluation") as task:
        return evaluate(
            policies, options, episodes_per_scene=plan.episodes, seed=seed, progress=task
        )


def policy_name(agent: str, world: str) -> str:
    """Name of an agent in the evaluation."""
    return f"{agent} in {world}"


def result_rows(
    result: EvaluationResult, minutes: Mapping[tuple[str, str], list[float]], plan: TransferPlan
) -> list[Row]:
    """A row for each agent and world, and for all agents of a world together.

    `minutes` is what each seed took to train, by agent and world.
    """
    gains = {}
    for agent, world in minutes:  # the span is the same for all
        gains[agent, world], span = result.group_gains(policy_name(agent, world))
    rows = []
    for (agent, world), taken in minutes.items():
        errors = result.episode_metrics(policy_name(agent, world))
        row: Row = {"agent": agent, "world": world, "high_iso": WORLDS[world].high_iso}
        row |= {"simulator": WORLDS[world].simulator, "frames": plan.frames}
        row |= {"crop": CROP, "scorer": plan.scorer}
        row |= comparison(gains, span, agent, world)
        row |= {"num_scenes": len(set(result.scene_ids.tolist()))}
        row |= {"regret": float(errors["regret"].mean())}
        row |= {"ev_within_third": float(errors["ev_within_third"].mean())}
        rows.append(row | {"minutes": float(np.median(taken)), "minutes_by_seed": taken})
    return rows + _together(rows, gains, span)


def _together(
    rows: list[Row], gains: Mapping[tuple[str, str], np.ndarray], span: np.ndarray
) -> list[Row]:
    """A row for each world of the agents together, as so many training seeds."""
    agents = tuple(dict.fromkeys(row["agent"] for row in rows))
    worlds = tuple(dict.fromkeys(row["world"] for row in rows))
    if len(agents) < 2:
        return []
    joint = {
        (TOGETHER, world): np.concatenate([gains[agent, world] for agent in agents])
        for world in worlds
    }
    means = ("minutes", "regret", "ev_within_third")
    found = []
    for world in worlds:
        own = [row for row in rows if row["world"] == world]
        row = own[0] | {"agent": TOGETHER} | {n: np.mean([r[n] for r in own]) for n in means}
        row |= comparison(joint, span, TOGETHER, world)
        found.append(row | {"minutes_by_seed": [m for r in own for m in r["minutes_by_seed"]]})
    return found


def comparison(
    gains: Mapping[tuple[str, str], np.ndarray], span: np.ndarray, agent: str, world: str
) -> Row:
    """Normalised score of an agent, its drop against the truth, and by how much it beats EXP's.

    Args:
        gains: ``q - q_random`` by agent and world, (K, G) per training seed and source group.
        span: ``q_oracle - q_random`` per source group, (G,).
        agent: Which agent.
        world: Where it was trained. EXP's is the world of the same sources.
    """
    own, truth = gains[agent, world], gains[agent, TRUTH]
    row = {"num_seeds": len(own), "num_groups": len(span)}
    row |= _named("normalised_score", score_interval(own, span))
    row["by_seed"] = (own.sum(axis=1) / span.sum()).tolist()
    if world == TRUTH:
        return row
    row |= _named("drop", difference_interval(truth, own, span))
    exp = World(EXP, high_iso=WORLDS[world].high_iso).name
    if world != exp and (agent, exp) in gains:
        row |= _named("more_than_exp", difference_interval(own, gains[agent, exp], span))
    return row


def _named(name: str, interval: Interval) -> Row:
    ends = "ci95" if name == "normalised_score" else f"{name}_ci95"
    return {name: interval.value, ends: interval.pair}
