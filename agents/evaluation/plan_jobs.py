"""Running a plan in one process or several, with what is left of the work.

Every finished piece is kept in a file (`EvaluationStore`), so that a run that was stopped goes on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from agents.evaluation.evaluation_plan import Condition, EvaluationPlan
from agents.evaluation.plan_run import Member, PlanRun
from agents.evaluation.result import EvaluationResult
from agents.learning.training import core_count, run_in_parallel, tell
from agents.policy import training_seeds

if TYPE_CHECKING:
    from ae_env.scenes import Scene

#: Called with work done, work in all, and what is being done.
Progress = Callable[[int, int, str], None]
#: What a scene in another light, a frame of a policy, and a policy with `fit` take about [ms]: only
#: the progress bar depends on it.
_LIGHT_MS, _FRAME_MS, _FIT_MS = 20, 0.3, 6000
#: Work that does not pay for a second process, which takes some seconds to begin [ms].
_SMALL_MS = 12_000


@dataclass(frozen=True)
class Job:
    """A piece of work for one process.

    Args:
        plan: The plan.
        folder: Where finished parts are.
        light: Name of the condition whose light is to be judged; or
        member: Whose episodes are to be run.
        device: Torch device of a learnt agent's network.
        code: Hash of the source when the run began.
    """

    plan: EvaluationPlan
    folder: Path
    light: str | None = None
    member: Member | None = None
    device: str = "cpu"
    code: str = ""

    @property
    def label(self) -> str:
        """For the progress bar."""
        return f"light: {self.light}" if self.member is None else self.member.name


def plan_members(policies: Sequence[str]) -> list[Member]:
    """Every training seed of every policy."""
    return [Member(p, name, k) for p in policies for k, name in enumerate(training_seeds(p))]


def run_plan(
    plan: EvaluationPlan,
    folder: Path,
    *,
    scenes: list[Scene] | None = None,
    workers: int | None = 1,
    device: str = "cpu",
    progress: Progress | None = None,
) -> dict[str, EvaluationResult]:
    """Runs a plan, or what is left of it.

    Args:
        plan: The plan, with its policies.
        folder: Where finished parts are kept.
        scenes: Those of the plan where they are loaded already.
        workers: Processes; None for one per core where the work is enough to pay for them.
        device: Torch device of a learnt agent's network.
        progress: Called with work done, work in all, and what is being done.

    Returns:
        What was measured, by condition.

    Raises:
        ValueError: If a policy or a scene is unknown, or a policy does not fit the environment;
            before any work is done.
        UserCodeError: If a policy raises, or returns something else than allowed states.
    """
    if not plan.policies:
        raise ValueError("`policies` (=[]) must hold at least one policy")
    run = PlanRun(plan, folder, scenes, device)
    members, conditions = plan_members(plan.policies), plan.all_conditions
    for scorer in plan.other_scorers:  # what is wrong is known before any work is done
        _check_scorer(scorer)
    privileged = _privileged(run, members)
    judging, following = _jobs(run, members, folder)
    total = max(sum(ms for _, ms in (*judging, *following)), 1.0)
    done: dict[str, float] = {}

    def report(label: str, amount: float) -> None:
        done[label] = done.get(label, 0.0) + amount
        if progress is not None:
            progress(int(min(sum(done.values()), total)), int(total), label)

    if workers is None:
        workers = core_count() if total > _SMALL_MS else 1
    # A privileged policy needs the score tables: it waits for all of them.
    last = [job for job, _ in following if job.member and privileged[job.member.name]]
    first = [job for job, _ in (*judging, *following) if job not in last]
    if workers > 1 and len(first) > 1:
        run_in_parallel(_work, first, workers=workers, progress=report)
        first = []
    for job in (*first, *last):
        _do(job, run, report)
    if progress is not None:
        progress(int(total), int(total), "")
    return {name: run.result(condition, members) for name, condition in conditions.items()}


def ranked_policies(run: PlanRun) -> list[str]:
    """Policies of a plan that a ranking has: all but privileged ones.

    Raises:
        ValueError: If a policy is unknown, or does not fit the environment.
    """
    members = plan_members(run.plan.policies)
    privileged = _privileged(run, members)
    return list(dict.fromkeys(m.policy for m in members if not privileged[m.name]))


def _privileged(run: PlanRun, members: Sequence[Member]) -> dict[str, bool]:
    """Whether each member is told the best states; makes every one once per delay."""
    found: dict[str, bool] = {}
    for member in members:
        for condition in {c.delay: c for c in run.plan.all_conditions.values()}.values():
            made = run.make(member, condition)
            found[member.name] = bool(getattr(made, "privileged", False))
    return found


def _check_scorer(name: str) -> None:
    from ae_env.scorers import make_scorer

    try:
        make_scorer(name)
    except ValueError as error:
        raise ValueError(f"`other_scorers` (={name!r}): {error}") from error


def _jobs(
    run: PlanRun, members: Sequence[Member], folder: Path
) -> tuple[list[tuple[Job, float]], list[tuple[Job, float]]]:
    """What is left to do and about how long it takes [ms]: score tables, then policies."""
    plan, conditions = run.plan, run.plan.all_conditions
    make = partial(Job, plan, folder, device=run.device, code=run.code)
    lights: dict[str, Job] = {}
    for name, condition in conditions.items():
        lights.setdefault(run.light_key(condition), make(light=name))
    judging = [
        (job, _light_ms(run, conditions[job.light or ""]))
        for key, job in lights.items()
        if not run.store.has(key)
    ]
    following = []
    for member in members:
        left = [c for c in conditions.values() if not run.store.has(run.policy_key(member, c))]
        if left:
            fits = len({c.delay for c in left}) * _FIT_MS * ("tuned" in member.name)
            job = make(member=member)
            frames = len(left) * len(run.episodes) * plan.frames
            following.append((job, fits + frames * _FRAME_MS))
    # Long ones first: two processes then end at about the same time.
    judging.sort(key=lambda item: -item[1])
    following.sort(key=lambda item: -item[1])
    return judging, following


def _light_ms(run: PlanRun, condition: Condition) -> float:
    frames = run.plan.frames * run.episodes.num_tables
    return frames * (0.2 if condition.lighting == "static" else _LIGHT_MS)


def _do(job: Job, run: PlanRun, report: Callable[[str, float], None]) -> None:
    conditions = run.plan.all_conditions
    if job.member is None:
        condition = conditions[job.light or ""]
        each = _light_ms(run, condition) / (run.plan.frames * run.episodes.num_tables)
        run.judge(condition, lambda frames: report(job.label, frames * each))
    else:
        run.follow(job.member, lambda frames: report(job.label, frames * _FRAME_MS))


#: In a worker: the run of the latest plan, so that its scenes are loaded once.
_runs: dict[str, PlanRun] = {}


def _work(job: Job) -> None:
    key = f"{job.plan.canonical()}\0{job.folder}\0{job.device}"
    if key not in _runs:
        _runs.clear()
        _runs[key] = PlanRun(job.plan, job.folder, device=job.device, code=job.code)
    _do(job, _runs[key], tell)
