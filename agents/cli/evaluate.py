"""``ae-env evaluate`` compares policies on the same episodes; ``ae-env stability`` judges loops."""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from agents.cli import console

if TYPE_CHECKING:
    import pandas as pd

    from agents.evaluation.evaluation_plan import EvaluationPlan
    from agents.evaluation.result import EvaluationResult

logger = logging.getLogger(__name__)

#: Options that are arguments of the environment, those of the condition, and of the episodes; the
#: only one that a benchmark takes; and those that an evaluation of brackets takes.
_ENVIRONMENT = ("scenes", "split", "grid", "observation", "sensors", "resolution", "scorer")
_CONDITION, _EPISODES = ("lighting", "delay"), ("episodes", "frames", "seed")
_OF_BENCHMARKS: tuple[str, ...] = ("observation",)
_OF_BRACKETS = (*_ENVIRONMENT[:2], *_ENVIRONMENT[3:6], "episodes", "seed")

Preset = Annotated[
    str | None,
    Option(
        help="quick, standard, video, convergence, ablation, bracket, ae_bench_v3_video (_still, "
        "_unknown, _bracket), or a .yaml file of one's own."
    ),
]
Scenes = Annotated[
    str | None,
    Option(
        help="'bundled', 'polyhaven', 'mixed', a folder or file of raws or radiance maps, or "
        "'recorded:FOLDER' (with what its files do not say: 'recorded:FOLDER?iso=100')."
    ),
]


@console.takes_source
def evaluate(
    context: typer.Context,
    policy: console.Policies = None,
    preset: Preset = None,
    env: Annotated[str | None, Option(help="A preset of configs/env, or a .yaml file.")] = None,
    scenes: Scenes = None,
    on_error: console.OnError = "stop",
    source: Any = None,
    split: Annotated[str | None, Option(help="train, validation, test (default) or all.")] = None,
    grid: Annotated[str | None, Option(help="default, third_stop, video or bracket.")] = None,
    scorer: Annotated[str | None, Option(help="The scorer of the states: balanced...")] = None,
    lighting: Annotated[str | None, Option(help="static (default), step, ramp, sine...")] = None,
    delay: Annotated[
        int | None, Option(help="Frames from a decision to its frame; 0 by default.", min=0)
    ] = None,
    observation: Annotated[str | None, Option(help="uint8 (default), statistics...")] = None,
    sensors: Annotated[bool | None, Option(help="Observe speed and defocus (yes).")] = None,
    resolution: Annotated[int | None, Option(help="Packed pixels a side; 64 by default.")] = None,
    episodes: Annotated[int | None, Option(help="Seeds per scene and start.", min=1)] = None,
    frames: Annotated[int | None, Option(help="Frames per episode.", min=1)] = None,
    out: console.Folder = Path("evaluation"),
    append: Annotated[Path | None, Option(help="Benchmark table (CSV) to add rows to.")] = None,
    author: Annotated[str, Option(help="For --append: who made the policy.")] = "",
    trained_on: Annotated[str, Option(help="For --append: scenes that it learnt from.")] = "",
    frames_seen: Annotated[int | None, Option(help="Likewise: frames that it saw.", min=1)] = None,
    seed: Annotated[int | None, Option(help="Seed of everything random.", min=0)] = None,
    workers: Annotated[
        int | None, Option(help="Processes; by default one per core if it pays.", min=1)
    ] = None,
    device: console.Device = "cpu",
    trust: console.Trust = False,
) -> None:
    """Compare policies on the same episodes; a second run resumes the first.

    Without `--preset`, one condition: 2 episodes per scene of 8 frames, from random states.

    Example: `ae-env evaluate --preset quick --policy matrix:tuned --policy average`
    """
    options = (*_ENVIRONMENT, *_CONDITION, *_EPISODES)
    given = {name: context.params[name] for name in options if context.params[name] is not None}
    found = console.scene_files(scenes, on_error, source)
    given |= {} if found is None else {"scenes": found}
    console.trust_configuration(trust)
    device = console.torch_device(device)
    plan = make_plan(preset, env, policy or [], given)
    if append is not None:
        if plan.hash is None:
            rule = "takes results of a benchmark only: give --preset ae_bench_v3_video, _still, "
            raise ValueError(f"`append` (={str(append)!r}) {rule}_unknown or _bracket")
        console.make_folder(append.parent, name="append", file=append, make=False)
    elif author or trained_on or frames_seen:
        raise ValueError(f"`author` (={author!r}) is of a row in a table: give --append too")
    row = {"author": author, "trained_on": trained_on, "frames_seen": frames_seen}
    _run(plan, out, append, row, workers, device)


def stability(
    policy: Annotated[
        list[str],
        Argument(
            metavar="POLICY...",
            callback=console.each_once,
            help="Any policy that sees frames, or a law proportional:K, such as "
            "'proportional:0.5?dead_zone=0.1&slew=1', with anchored=true as libcamera counts.",
        ),
    ],
    frames: Annotated[int, Option(help="Frames after the step.", min=40, max=10_000)] = 160,
    seed: console.Seed = 0,
    out: console.Folder = Path("stability"),
) -> None:
    """Does a controller come to rest? Over delay, loop gain, step of the light and faults.

    Example: `ae-env stability proportional:0.5 centre_weighted:P my_policy.py:Mine`
    """
    from agents.evaluation.stability import check_controller, judge_stability
    from agents.report.evaluation import write_stability

    for name in policy:
        check_controller(name)
    console.make_folder(out)
    with console.progress_bars() as progress:
        found = []
        for name in policy:
            with progress(name) as task:
                found.append(judge_stability(name, seed, frames, task))
    files = write_stability(found, out, command=console.command_line(), seed=seed)
    console.print_line(files["report.md"].read_text(encoding="utf-8"))
    for one in found:
        console.print_line(f"{one.name}: {one.speed:,.0f} loop frames a second")
    console.print_files(files)


def _run(
    plan: "EvaluationPlan",
    out: Path,
    append: Path | None,
    row: Mapping[str, Any],
    workers: int | None,
    device: str,
) -> None:
    from agents.evaluation.engine import check_policies
    from agents.evaluation.evaluation_plan import plan_scenes
    from agents.evaluation.jobs import Jobs
    from agents.evaluation.result import overall_ranking
    from agents.report.ae_bench import append_rows, bench_rows, check_append, check_hash
    from agents.report.evaluation import write_report

    check_policies(plan, device)  # reading scenes may take minutes
    scenes = plan_scenes(plan)
    check_hash(plan, scenes)
    with Jobs(plan, out / "parts", scenes, device=device) as run:
        ranked = run.ranked_policies  # raises before any work where a policy is unknown
        if append is not None and plan.policies:
            check_append(append, plan, ranked, author=row["author"])
            for name in (p for p in plan.policies if p not in ranked):
                logger.warning("%s gets no row in %s: it is told the best states", name, append)
        console.make_folder(out)
        if (out / "results.json").is_file():
            logger.warning("%s has the results of another run, which this one replaces", out)
        with console.progress_bars() as progress, progress("evaluation") as task:
            results = run.run(workers=workers, progress=task)
    files = write_report(results, out, command=console.command_line())
    ranking = overall_ranking(results)
    if append is not None:
        files |= append_rows(append, plan, bench_rows(results, ranking), **row)
    print_scores(results, ranking)
    console.print_files(files)


def make_plan(
    preset: str | None, env: str | None, policies: Sequence[str], given: Mapping[str, Any]
) -> "EvaluationPlan":
    """The plan that the options describe; `given` are those about episodes, by name."""
    from pydantic import ValidationError

    from ae_env import ExposureGrid, make_lighting, make_scorer
    from ae_env.options import EnvOptions
    from agents.evaluation.evaluation_plan import EvaluationPlan, light_name, load_plan
    from agents.policy_names import check_policy
    from simulator.utils.config_file import one_line

    if preset is not None:
        base = load_plan(preset)
        _check_changes(base, [*given, *(["env"] if env is not None else [])])
    elif policies:
        plain: dict[str, Any] = {"scenes": "bundled", "resolution": 64}
        base = EvaluationPlan(environment=plain, starts=("random",), frames=8, seeds=(0, 1))
    else:
        raise typer.BadParameter("give it once or more, or a --preset", param_hint="--policy")
    environment, condition = _arguments(env)
    environment = {**base.environment, **environment}
    environment |= {k: given[k] for k in _ENVIRONMENT if k in given}
    condition |= {k: given[k] for k in _CONDITION if k in given}
    entries: dict[str, Any] = {"environment": environment}
    with console.all_mistakes() as check:
        for policy in policies or base.policies:  # before scenes are read, which may take minutes
            check(check_policy, policy)
        named = {"scorer": make_scorer, "grid": ExposureGrid.from_spec, "lighting": make_lighting}
        for key in (key for key in (*_ENVIRONMENT, *_CONDITION) if key in given):
            check(EnvOptions.from_kwargs, {key: given[key]})
            check(named.get(key, str), given[key])
    if preset is None:
        scenes = environment["scenes"]
        name = scenes.get("path", scenes) if isinstance(scenes, Mapping) else scenes
        entries["name"] = f"{name}, {environment.get('split', 'test')} split"
    elif env is not None or "scenes" in given or "split" in given:
        entries["scene_ids"] = []  # those are of the preset's own scenes
    if policies:
        entries["policies"] = policies
    if "frames" in given:
        entries["frames"] = given["frames"]
    if condition:  # in place of the base's
        light = light_name(condition.get("lighting", "static"))
        entries |= {"conditions": {light: condition}, "delays": [0]}
    if "seed" in given or "episodes" in given:
        first = given.get("seed", base.seeds[0])
        entries["seeds"] = [first + i for i in range(given.get("episodes", len(base.seeds)))]
    try:
        plan = base.changed(**entries)
    except ValidationError as error:
        raise ValueError(one_line(error)) from None
    plan.protocol()  # raises where an entry is no JSON value
    return plan


def _arguments(env: str | None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Arguments of a preset of the environment, and those of them that are of a condition."""
    if env is None:
        return {}, {}
    from ae_env.options import EnvOptions
    from ae_env.utils.user_files import load_preset

    arguments = load_preset(env)
    arguments.pop("max_episode_steps", None)
    try:
        EnvOptions.from_kwargs(arguments)
    except ValueError as error:
        raise ValueError(f"`env` (={env!r}): {error}") from error
    return arguments, {k: arguments.pop(k) for k in _CONDITION if k in arguments}


def _check_changes(base: "EvaluationPlan", changed: list[str]) -> None:
    if base.hash is not None:
        allowed, what = _OF_BENCHMARKS, "is a fixed benchmark"
    elif base.budgets:
        allowed, what = _OF_BRACKETS, "is of ExposureBracket-v0"
    else:
        return
    refused = [f"--{name}" for name in changed if name not in allowed]
    if refused:
        raise ValueError(f"`preset` (={base.name!r}) {what}: it does not take {', '.join(refused)}")


def print_scores(
    results: "EvaluationResult | Mapping[str, EvaluationResult]",
    ranking: "pd.DataFrame | None" = None,
) -> None:
    """Prints the scores of an evaluation, and every source group's where there are few."""
    from agents.report.evaluation import summary

    for title, frame in summary(results, ranking):
        console.print_table(title, frame.to_numpy().tolist(), *frame.columns, numbers=True)
