"""Runs a plan by the names of its policies: finished parts in files, work in several processes."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ae_env.scorers import make_scorer
from ae_env.scorers.registry import scorer_fingerprint
from agents.evaluation.engine import TRACK_ARRAYS, Arrays, EvaluationRun, Member
from agents.evaluation.evaluation_plan import Condition, EvaluationPlan
from agents.evaluation.other_scorers import other_scores
from agents.evaluation.result import EvaluationResult, Track
from agents.evaluation.running import Progress
from agents.evaluation.store import (
    EvaluationStore,
    file_content,
    part_key,
    policy_content,
    scene_content,
)
from agents.learning.workers import core_count, run_in_parallel, send_progress

if TYPE_CHECKING:
    from ae_env.scenes import Scene

#: About the time of a frame's score table in static and in changing light, of a frame of a policy,
#: and of a policy's `fit` [ms]: only the order of the work and the progress bar depend on it.
_STATIC_MS, _LIGHT_MS, _FRAME_MS, _FIT_MS = 0.2, 20.0, 0.3, 6000.0
#: Work that does not pay for a second process, which takes some seconds to begin [ms].
_SMALL_MS = 12_000


@dataclass(frozen=True)
class Job:
    """A piece of work for one process.

    Args:
        conditions: Names of the condition whose light is judged, or of those of one delay in which
            a policy is run.
        member: The policy; None for the light.
        cost: About the time that it takes [ms].
    """

    conditions: tuple[str, ...]
    member: Member | None
    cost: float

    @property
    def label(self) -> str:
        """For the progress bar."""
        return f"light: {self.conditions[0]}" if self.member is None else self.member.name


class StoredRun(EvaluationRun):
    """A run whose finished parts are files.

    Args:
        plan: The plan, of JSON values.
        folder: Folder of the finished parts.
        scenes: Those of the plan; loaded by default.
        device: Torch device of a learnt agent's network.
    """

    def __init__(
        self,
        plan: EvaluationPlan,
        folder: Path,
        scenes: list[Scene] | None = None,
        *,
        device: str = "cpu",
    ) -> None:
        plan.protocol()  # raises where an entry cannot be a part of a key
        super().__init__(plan, scenes, device=device)
        self.store = EvaluationStore(folder)
        options = plan.options()
        shown = options.load_scenes() if options.in_sequences else self.scenes
        scorer = plan.environment.get("scorer")
        judged = (scorer_fingerprint(options.make_scorer()), file_content(scorer))
        base = {k: v for k, v in plan.environment.items() if k != "costs"}
        self._shared = (base, judged, scene_content(shown), plan.frames, plan.seeds)

    def light_key(self, condition: Condition) -> str:
        """Name of the part with the score tables of the light of `condition`."""
        lighting = condition.lighting
        return part_key("light", *self._shared, lighting, file_content(lighting))

    def policy_key(self, member: Member, condition: Condition) -> str:
        """Name of the part with the track of `member` in `condition`."""
        own = (member.name, policy_content(member.name), self.device)
        shown = (condition.delay, self.plan.starts)
        return part_key("policy", self.light_key(condition), *shown, *own)

    @cached_property
    def privileged(self) -> dict[Member, bool]:
        """Whether each member is told the best states.

        Raises:
            ValueError: If a policy is unknown, or does not fit the environment of some delay.
        """
        found = {}
        for condition in {str(c.delay): c for c in self.plan.all_conditions.values()}.values():
            for member in self.members:
                found[member] = bool(getattr(self.make(member, condition), "privileged", False))
        return found

    @property
    def ranked_policies(self) -> list[str]:
        """Policies that a ranking has: all but privileged ones."""
        return list(dict.fromkeys(m.policy for m, told in self.privileged.items() if not told))

    def run(
        self, *, workers: int | None = 1, progress: Progress | None = None
    ) -> dict[str, EvaluationResult]:
        """Does the work that is left; see `run_plan`."""
        if not self.plan.policies:
            raise ValueError("`policies` (=[]) must hold at least one policy")
        for scorer in self.plan.other_scorers:
            _check_scorer(scorer)
        privileged = self.privileged
        jobs = self._jobs()
        total = max(sum(job.cost for job in jobs), 1.0)
        done = 0.0

        def report(job: Job, cost: float) -> None:
            nonlocal done
            done += cost
            if progress is not None:
                progress(int(min(done, total)), int(total), job.label)

        if workers is None:
            workers = core_count() if total > _SMALL_MS else 1
        # A privileged policy needs the score tables: it waits for all of them.
        last = [job for job in jobs if job.member is not None and privileged[job.member]]
        first = [job for job in jobs if job not in last]
        if workers > 1 and len(first) > 1:
            tasks = [(self.plan, self.store.folder, self.device, job) for job in first]
            run_in_parallel(_work, tasks, workers=workers, progress=report)
            first = []
        for job in (*first, *last):
            self.do(job, partial(report, job))
        if progress is not None:
            progress(int(total), int(total), "")
        return self._finished()

    def _jobs(self) -> list[Job]:
        """The work that is left: light first, and the longest first of each, so that processes end
        at about the same time.
        """
        conditions, frames = self.plan.all_conditions, self.plan.frames
        lights: dict[str, str] = {}
        for name, condition in conditions.items():
            lights.setdefault(self.light_key(condition), name)
        found = []
        for key, name in lights.items():
            if not self.store.has(key):
                ms = _STATIC_MS if conditions[name].lighting == "static" else _LIGHT_MS
                found.append(Job((name,), None, ms * frames * self.num_tables))
        for member in self.members:
            for delay in {str(c.delay): c.delay for c in conditions.values()}.values():
                left = tuple(
                    name
                    for name, c in conditions.items()
                    if c.delay == delay and not self.store.has(self.policy_key(member, c))
                )
                if left:
                    fit = _FIT_MS * ("tuned" in member.name)
                    cost = fit + len(left) * len(self.episodes) * frames * _FRAME_MS
                    found.append(Job(left, member, cost))
        return sorted(found, key=lambda job: (job.member is not None, -job.cost))

    def do(self, job: Job, report: Callable[[float], None]) -> None:
        """Does a job and saves its parts; `report` gets its costs as they are done [ms]."""
        conditions = [self.plan.all_conditions[name] for name in job.conditions]
        if job.member is None:
            each = job.cost / (self.plan.frames * self.num_tables)
            light = self.judge(conditions[0], lambda frames: report(frames * each))
            self.store.save(self.light_key(conditions[0]), light)
            return
        name = job.member.name
        policy = self.fitted(job.member, conditions[0])
        for condition in conditions:
            told = getattr(policy, "privileged", False)
            start_states, track = self.follow(
                name,
                policy,
                condition,
                self.light(condition) if told else None,
                lambda frames: report(frames * _FRAME_MS),
            )
            content = dict(vars(track))
            arrays = {key: content.pop(key)[0] for key in TRACK_ARRAYS}
            key = self.policy_key(job.member, condition)
            self.store.save(key, {**arrays, "start_states": start_states}, content)

    def light(self, condition: Condition) -> Arrays:
        """The finished score tables of `condition`; see `judge`."""
        return self._loaded(self.light_key(condition))[0]

    def _loaded(self, key: str) -> tuple[Arrays, dict[str, Any]]:
        found = self.store.load(key)
        if found is None:
            raise FileNotFoundError(f"{self.store.path(key)} was removed while the evaluation ran")
        return found

    def _finished(self) -> dict[str, EvaluationResult]:
        """The results of all conditions, from the finished parts."""
        results = {}
        for name, condition in self.plan.all_conditions.items():
            tracks: dict[Member, Track] = {}
            start_states = np.zeros(0, np.int64)
            for member in self.members:
                arrays, meta = self._loaded(self.policy_key(member, condition))
                start_states = arrays.pop("start_states")
                content: dict[str, Any] = {key: value[None] for key, value in arrays.items()}
                tracks[member] = Track(**content, **meta)
            light = self.light(condition)
            results[name] = self.result(condition, light, start_states, tracks)
        static = self.plan.static_condition
        if self.plan.other_scorers:
            results[static] = self._rated(results[static], self.plan.all_conditions[static])
        return results

    def _rated(self, result: EvaluationResult, condition: Condition) -> EvaluationResult:
        """`result` with other scorers' means, which are a part too: image scorers take a while."""
        plan, tracks = self.plan, result.tracks.items()
        states = {n: hashlib.sha256(t.states.tobytes()).hexdigest() for n, t in tracks}
        names = list(plan.other_scorers)
        own = (names, file_content(dict.fromkeys(names)), plan.other_scorer_scenes, states)
        key = part_key("scorers", self.light_key(condition), plan.starts, *own)
        known = self.store.load(key)
        scores = other_scores(result, plan) if known is None else known[1]
        if known is None:
            self.store.save(key, {}, scores)
        return replace(result, other_scores=scores)


def run_plan(
    plan: EvaluationPlan,
    folder: str | os.PathLike[str],
    *,
    scenes: list[Scene] | None = None,
    workers: int | None = 1,
    device: str = "cpu",
    progress: Progress | None = None,
) -> dict[str, EvaluationResult]:
    """Runs a plan, or the part of it that is left.

    Args:
        plan: The plan, with its policies.
        folder: Folder of finished parts.
        scenes: Those of the plan where they are loaded already.
        workers: Processes; None for one per core where the work is enough to pay for them.
        device: Torch device of a learnt agent's network.
        progress: Called with work done, work in all, and what is being done.

    Returns:
        The results by condition.

    Raises:
        ValueError: If a policy, a scorer or a scene is unknown, or a policy does not fit the
            environment; before any work is done.
        UserCodeError: If a policy raises, or returns something else than allowed states.
    """
    with StoredRun(plan, Path(folder), scenes, device=device) as run:
        return run.run(workers=workers, progress=progress)


def _check_scorer(name: str) -> None:
    try:
        make_scorer(name)
    except ValueError as error:
        raise ValueError(f"`other_scorers` (={name!r}): {error}") from error


#: In a worker, which serves one run: the run, made by its first job.
_worker_run: StoredRun | None = None


def _work(task: tuple[EvaluationPlan, Path, str, Job]) -> None:
    global _worker_run
    plan, folder, device, job = task
    if _worker_run is None:
        _worker_run = StoredRun(plan, folder, device=device)
    _worker_run.do(job, partial(send_progress, job))
