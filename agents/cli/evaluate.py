"""The command that compares policies."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from agents.cli.console import (
    MAX_SEED,
    Device,
    command_line,
    console,
    make_folder,
    print_files,
    progress_bars,
    torch_device,
)

if TYPE_CHECKING:
    from agents.evaluation.evaluation_plan import EvaluationPlan
    from agents.evaluation.plan_run import PlanRun
    from agents.evaluation.ranking import Rank
    from agents.evaluation.result import EvaluationResult

logger = logging.getLogger(__name__)

#: Source groups in one table on the terminal.
_GROUPS_ABREAST = 4
#: Options that are arguments of the environment, and those of the plan, by their own names.
_ENVIRONMENT = ("scenes", "split", "grid", "sensors", "resolution", "scorer")
_CONDITION = ("lighting", "delay")

Policies = Annotated[
    list[str] | None, typer.Option(help="A policy; give the option several times.")
]
Preset = Annotated[
    str | None, typer.Option(help="quick, standard, ae_bench_v1, or a .yaml file of one's own.")
]


def evaluate(
    policy: Policies = None,
    preset: Preset = None,
    env: Annotated[
        str | None, typer.Option(help="Environment: a preset of configs/env, or a .yaml file.")
    ] = None,
    scenes: Annotated[
        str | None, typer.Option(help="'bundled', or a folder or file of raws or radiance maps.")
    ] = None,
    split: Annotated[str | None, typer.Option(help="train, test (default) or all.")] = None,
    grid: Annotated[str | None, typer.Option(help="default or third_stop.")] = None,
    scorer: Annotated[str | None, typer.Option(help="What rates the states: balanced...")] = None,
    lighting: Annotated[
        str | None, typer.Option(help="static (default), step, ramp, sine, tunnel...")
    ] = None,
    delay: Annotated[
        int | None, typer.Option(help="Frames from a decision to its frame; 0 by default.", min=0)
    ] = None,
    sensors: Annotated[
        bool | None, typer.Option(help="Whether speed and defocus are observed (yes).")
    ] = None,
    resolution: Annotated[
        int | None, typer.Option(help="Packed pixels a side; 64 by default.")
    ] = None,
    episodes: Annotated[
        int | None, typer.Option(help="Episodes per scene and start: so many seeds.", min=1)
    ] = None,
    frames: Annotated[int | None, typer.Option(help="Frames per episode.", min=1)] = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("evaluation"),
    append: Annotated[
        Path | None, typer.Option(help="Benchmark table (CSV) to add the results to.")
    ] = None,
    author: Annotated[str, typer.Option(help="For --append: who made the policy.")] = "",
    seed: Annotated[
        int | None, typer.Option(help="Seed of everything random.", min=0, max=MAX_SEED)
    ] = None,
    workers: Annotated[
        int | None, typer.Option(help="Processes; by default one per core if it pays.", min=1)
    ] = None,
    device: Device = "cpu",
) -> None:
    """Compare policies on the same episodes; a second run goes on where the first stopped.

    Without `--preset`, one condition: 2 episodes per scene of 8 frames, from states drawn at
    random.

    Example: `ae-env evaluate --preset quick --policy matrix:tuned --policy my_policy.py:MyPolicy`
    """
    from agents.evaluation.ae_bench import append_results, check_hash
    from agents.evaluation.plan_episodes import plan_scenes
    from agents.evaluation.plan_jobs import run_plan
    from agents.evaluation.plan_run import PlanRun
    from agents.report.of_plan import write_plan_report
    from agents.report.tables import overall_ranking, static_condition

    given = {
        "scenes": scenes,
        "split": split,
        "grid": grid,
        "scorer": scorer,
        "sensors": sensors,
        "resolution": resolution,
        "lighting": lighting,
        "delay": delay,
        "episodes": episodes,
        "frames": frames,
        "seed": seed,
    }
    given = {name: value for name, value in given.items() if value is not None}
    device = torch_device(device)
    plan = _plan(preset, env, list(policy or ()), given)
    if append is not None and plan.hash is None:
        raise ValueError(
            f"`append` (={str(append)!r}) takes the results of a benchmark only: give "
            "--preset ae_bench_v1"
        )
    if append is None and author:
        raise ValueError(f"`author` (={author!r}) is of a row in a table: give --append too")
    if append is not None:
        make_folder(append.parent, name="append", file=append)
    loaded = plan_scenes(plan)
    check_hash(plan, loaded)
    make_folder(out)
    run = PlanRun(plan, out / "parts", loaded, device)
    if append is not None and plan.policies:
        _check_append(append, run, author)
    with progress_bars() as progress, progress("evaluation") as task:
        results = run_plan(
            plan, out / "parts", scenes=loaded, workers=workers, device=device, progress=task
        )
    files = write_plan_report(run, results, out, command=command_line())
    ranking = overall_ranking(results)
    if append is not None:
        files |= append_results(append, plan, results, ranking, author=author)
    _print_ranking(ranking, results, static_condition(plan))
    print_files(files)


def _check_append(table: Path, run: PlanRun, author: str) -> None:
    """Checks a benchmark's table before the run, and says which policies get no row."""
    from agents.evaluation.ae_bench import check_append
    from agents.evaluation.plan_jobs import ranked_policies

    ranked = ranked_policies(run)
    check_append(table, run.plan, ranked, author=author)
    for name in (p for p in run.plan.policies if p not in ranked):
        logger.warning("%s gets no row in %s: it is told the best states", name, table)


def _plan(
    preset: str | None, env: str | None, policies: list[str], given: Mapping[str, Any]
) -> EvaluationPlan:
    """The plan of the options that were given."""
    from agents.evaluation.ae_bench import refuse_changes
    from agents.evaluation.evaluation_plan import EvaluationPlan, load_plan

    base = None if preset is None else load_plan(preset)
    if base is not None and base.hash is not None:
        changed = [*given, *(["env"] if env is not None else [])]
        refuse_changes(base, changed)
    environment: dict[str, Any] = {} if base is None else dict(base.environment)
    condition: dict[str, Any] = {}
    if env is not None:
        from ae_env.utils.presets import load_preset

        arguments = load_preset(env)
        arguments.pop("max_episode_steps", None)
        condition = {k: arguments.pop(k) for k in _CONDITION if k in arguments}
        environment |= arguments
    environment |= {k: given[k] for k in _ENVIRONMENT if k in given}
    condition |= {k: given[k] for k in _CONDITION if k in given}
    entries: dict[str, Any] = {"environment": environment}
    if policies:
        entries["policies"] = list(dict.fromkeys(policies))
    if "frames" in given:
        entries["frames"] = given["frames"]
    if base is None:
        if not policies:
            raise typer.BadParameter("give it once or more, or a --preset", param_hint="--policy")
        return _checked(EvaluationPlan().changed, entries | _plain(environment, condition, given))
    if condition:  # in place of the preset's
        entries |= {"conditions": {_label(condition): condition}, "delays": [0]}
    if "seed" in given or "episodes" in given:
        first = given.get("seed", base.seeds[0])
        count = given.get("episodes", len(base.seeds))
        entries["seeds"] = [first + i for i in range(count)]
    if env is not None or "scenes" in given or "split" in given:
        entries["scene_ids"] = []  # those are of the preset's own scenes
    return _checked(base.changed, entries)


def _plain(
    environment: dict[str, Any], condition: dict[str, Any], given: Mapping[str, Any]
) -> dict[str, Any]:
    """Entries of a plan without a preset: one condition, starts drawn at random."""
    environment.setdefault("scenes", "bundled")
    environment.setdefault("resolution", 64)
    first = given.get("seed", 0)
    return {
        "name": f"{environment['scenes']}, {environment.get('split', 'test')} split",
        "conditions": {_label(condition): condition},
        "starts": ["random"],
        "frames": given.get("frames", 8),
        "seeds": [first + i for i in range(given.get("episodes", 2))],
    }


def _checked(make: Any, entries: Mapping[str, Any]) -> EvaluationPlan:
    """The plan of `entries`; a mistake in them is told in one line."""
    from pydantic import ValidationError

    from simulator.utils.config_file import one_line

    try:
        plan: EvaluationPlan = make(**entries)
    except ValidationError as error:
        raise ValueError(one_line(error)) from None
    return plan


def _label(condition: Mapping[str, Any]) -> str:
    kind = condition.get("lighting", "static")
    return kind if isinstance(kind, str) else str(kind.get("kind", "light"))


def print_scores(result: EvaluationResult) -> None:
    """Scores of one condition as a table; every source group's where they are few."""
    from rich.table import Table

    from agents.evaluation.result_table import result_rows

    rows = result_rows(result, source="", split="", resamples=2000)
    conditions = result.conditions
    table = Table(title="normalised score: 0 is random, 1 the best state of every frame")
    table.add_column("policy", overflow="fold")
    for condition in conditions:
        table.add_column(condition, justify="right")
    table.add_column("95 % interval (all)", justify="right")
    by_policy: dict[str, dict[str, Any]] = {}
    for row in rows:
        by_policy.setdefault(row["policy"], {})[row["condition"]] = row
    for policy, own in by_policy.items():
        pair = own["all"]["ci95"]
        interval = f"{pair[0]:.3f} to {pair[1]:.3f}" if pair else "too few groups"
        scores = [f"{own[c]['normalised_score']:.3f}" for c in conditions]
        table.add_row(policy, *scores, interval)
    console.print(table)
    _print_groups(result, rows[0]["num_groups"])


def _print_ranking(
    ranking: list[Rank], results: Mapping[str, EvaluationResult], static: str
) -> None:
    from rich.table import Table

    if len(results) == 1:
        print_scores(results[static])
        return
    table = Table(title=f"normalised score over {len(results)} conditions, and in {static!r}")
    for name in ("tier", "policy", "all conditions", "95 % interval", static):
        justify: Any = "left" if name == "policy" else "right"
        table.add_column(name, justify=justify, overflow="fold")
    for one in ranking:
        gains, span = results[static].group_gains(one.policy)
        pair = one.score.pair
        table.add_row(
            "-" if one.tier is None else str(one.tier),
            one.policy,
            f"{one.score.value:.3f}",
            f"{pair[0]:.3f} to {pair[1]:.3f}" if pair else "too few groups",
            f"{gains.mean(axis=0).sum() / span.sum():.3f}",
        )
    console.print(table)
    _print_groups(results[static], ranking[0].score.num_groups if ranking else 0)


def _print_groups(result: EvaluationResult, groups: int) -> None:
    from rich.table import Table

    from agents.evaluation.statistics import MIN_GROUPS
    from agents.report.of_evaluation import group_values

    if groups >= MIN_GROUPS:
        return
    head, body = group_values(result)
    for first in range(0, len(body), _GROUPS_ABREAST):
        own_groups = body[first : first + _GROUPS_ABREAST]
        values = Table(title="mean score of every source group")
        for i, column in enumerate(zip(head, *own_groups, strict=True)):
            if i == 0:
                for name in column:
                    justify: Any = "left" if name == head[0] else "right"
                    values.add_column(name, justify=justify, overflow="fold")
            else:
                values.add_row(*column)
        console.print(values)
