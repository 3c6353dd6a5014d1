"""Runs a plan by the names of its policies: finished parts in files, work in several processes.

A part's name is a hash of everything that decides its content: the version of this package, the
plan's entries, the scenes' light, and the files of policies, scorers and lightings of a user's own.
"""

import hashlib
import itertools
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from ae_env.scenes import Scene
from ae_env.scorers.registry import scorer_fingerprint
from agents import policy_names
from agents.evaluation import engine
from agents.evaluation.evaluation_plan import Condition, EvaluationPlan
from agents.evaluation.result import EvaluationResult, Track
from agents.learning.workers import core_count, run_in_parallel, send_progress
from simulator.utils.cache import Store, cache_key
from simulator.utils.files import printable, sibling

#: About the time of a frame's score table in static and in changing light, of a frame of a policy,
#: and of a policy's `fit` [ms]: only the order of the work and the progress bar depend on it.
_STATIC_MS, _LIGHT_MS, _FRAME_MS, _FIT_MS = 0.2, 20.0, 0.3, 6000.0
#: Work that does not pay for a second process, which takes some seconds to begin [ms].
_SMALL_MS = 12_000
#: Python files beside one's own that count as parts of it.
_MAX_NEIGHBOURS = 200


@dataclass(frozen=True)
class Job:
    """Work for one process, of about `cost` ms.

    The light of one condition is scored, or a policy is run in all of one delay or budget.
    """

    conditions: tuple[str, ...]
    trained: engine.TrainedPolicy | None
    cost: float


class Jobs(engine.EvaluationRun):
    """A run of a plan, of JSON values, in jobs; finished parts are stored in `folder`."""

    def __init__(
        self, plan: EvaluationPlan, folder: Path, scenes: list[Scene] | None = None, *, device: str
    ) -> None:
        plan.protocol()  # raises where an entry cannot be a part of a key
        super().__init__(plan, scenes, device=device)
        self.store = Store(folder)
        options = plan.options()
        shown = options.load_scenes() if options.in_sequences else self.scenes
        scorer = plan.environment.get("scorer")
        judge = (scorer_fingerprint(options.make_scorer()), file_content(scorer))
        base = {k: v for k, v in plan.environment.items() if k != "costs"}
        task = (plan.env_id, plan.frames, plan.max_frames, plan.seeds)
        self._shared = (base, judge, scene_content(shown), task)

    def light_key(self, condition: Condition) -> str:
        """Key of the part with the score tables of the light of `condition`."""
        lighting = condition.lighting
        return cache_key("light", [*self._shared, lighting, file_content(lighting)])

    def policy_key(self, trained: engine.TrainedPolicy, condition: Condition) -> str:
        """Key of the part with the track of `trained` in `condition`."""
        # Not the full name: the same weights in another folder do the same.
        own = (trained.policy, trained.index, named_content(trained.name), self.device)
        shown = (condition.delay, condition.budget, self.plan.starts)
        return cache_key("policy", [self.light_key(condition), *shown, *own])

    @cached_property
    def _cameras(self) -> list[list[str]]:
        """Names of the conditions of each delay and budget: a policy is fitted once for each."""
        found: dict[str, list[str]] = {}
        for name, condition in self.plan.all_conditions.items():
            found.setdefault(f"{condition.delay}, {condition.budget}", []).append(name)
        return list(found.values())

    @cached_property
    def privileged(self) -> dict[engine.TrainedPolicy, bool]:
        """Whether each policy is told the best states; raises where one cannot be made."""
        conditions = self.plan.all_conditions
        return {
            trained: bool(getattr(self.make(trained, conditions[names[0]]), "privileged", False))
            for names in self._cameras
            for trained in self.trained
        }

    @property
    def ranked_policies(self) -> list[str]:
        """Policies that a ranking has: all but privileged ones."""
        return list(dict.fromkeys(one.policy for one, told in self.privileged.items() if not told))

    def run(
        self, *, workers: int | None = 1, progress: engine.Progress | None = None
    ) -> dict[str, EvaluationResult]:
        """Does the work that is left; see `run_plan`."""
        if not self.plan.policies:
            raise ValueError("`policies` (=[]) must hold at least one policy")
        engine.check_scorers(self.plan.other_scorers)
        privileged = self.privileged
        jobs, shown = self._left(), progress or (lambda *_: None)
        total = max(sum(job.cost for job in jobs), 1.0)
        done = 0.0

        def report(job: Job, cost: float) -> None:
            nonlocal done
            done += cost
            label = f"light: {job.conditions[0]}" if job.trained is None else job.trained.name
            shown(int(min(done, total)), int(total), label)

        if workers is None:
            workers = core_count() if total > _SMALL_MS else 1
        # A privileged policy needs the score tables: it waits for all of them.
        last = [job for job in jobs if job.trained is not None and privileged[job.trained]]
        first = [job for job in jobs if job not in last]
        if workers > 1 and len(first) > 1:
            tasks = [(self.plan, self.store.folder, self.device, job) for job in first]
            run_in_parallel(_work, tasks, workers=workers, progress=report)
            first = []
        for job in (*first, *last):
            self.do(job, partial(report, job))
        shown(int(total), int(total), "")
        conditions, static = self.plan.all_conditions, self.plan.static_condition
        results = {name: self._finished(condition) for name, condition in conditions.items()}
        if self.plan.other_scorers:
            results[static] = self._rated(results[static], conditions[static])
        return results

    def _left(self) -> list[Job]:
        """Jobs that are left: light first; of each the longest first, so that all end together."""
        plan, conditions = self.plan, self.plan.all_conditions
        frames = plan.max_frames if plan.budgets else plan.frames
        lights: dict[str, str] = {}
        for name, condition in conditions.items() if self.num_tables else ():
            lights.setdefault(self.light_key(condition), name)
        found = []
        for name in (name for key, name in lights.items() if self.store.get(key) is None):
            ms = _STATIC_MS if conditions[name].lighting == "static" else _LIGHT_MS
            found.append(Job((name,), None, ms * frames * self.num_tables))
        for trained, names in itertools.product(self.trained, self._cameras):
            keys = {name: self.policy_key(trained, conditions[name]) for name in names}
            left = tuple(name for name, key in keys.items() if self.store.get(key) is None)
            if left:
                fit = _FIT_MS * ("tuned" in trained.name)
                cost = fit + len(left) * len(self.episodes) * frames * _FRAME_MS
                found.append(Job(left, trained, cost))
        return sorted(found, key=lambda job: (job.trained is not None, -job.cost))

    def do(self, job: Job, report: engine.Report) -> None:
        """Does a job and stores its parts; `report` gets its costs as they are done [ms]."""
        conditions = [self.plan.all_conditions[name] for name in job.conditions]
        if job.trained is None:
            each = job.cost / (self.plan.frames * self.num_tables)
            light = self.score_light(conditions[0], lambda frames: report(frames * each))
            self.store.put(self.light_key(conditions[0]), light)
            return
        policy = self.fitted(job.trained, conditions[0])
        for condition in conditions:
            light = self.light(condition) if getattr(policy, "privileged", False) else {}
            given = (job.trained.name, policy, condition, light)
            track = self.run_policy(*given, report=lambda frames: report(frames * _FRAME_MS))
            others = {key: value for key, value in vars(track).items() if key != "arrays"}
            self.store.put(self.policy_key(job.trained, condition), {**track.arrays, **others})

    def light(self, condition: Condition) -> engine.Arrays:
        """The finished score tables of `condition`, see `score_light`; nothing for brackets."""
        return self._stored(self.light_key(condition)) if self.num_tables else {}

    def _stored(self, key: str) -> dict[str, Any]:
        found = self.store.get(key)
        if found is None:
            raise FileNotFoundError(f"{self.store.path(key)} was removed while the evaluation ran")
        return found

    def _finished(self, condition: Condition) -> EvaluationResult:
        tracks = {}
        for trained in self.trained:
            stored = self._stored(self.policy_key(trained, condition))
            arrays = {k: v for k, v in stored.items() if isinstance(v, np.ndarray)}
            tracks[trained] = Track(arrays, **{k: v for k, v in stored.items() if k not in arrays})
        return self.result(condition, self.light(condition), tracks)

    def _rated(self, result: EvaluationResult, condition: Condition) -> EvaluationResult:
        """`result` with other scorers' means, which are a part too: image scorers take a while."""
        plan, tracks = self.plan, result.tracks.items()
        states = {n: hashlib.sha256(t.states.tobytes()).hexdigest() for n, t in tracks}
        names = list(plan.other_scorers)
        own = (names, file_content(dict.fromkeys(names)), plan.other_scorer_scenes, states)
        key = cache_key("scorers", [self.light_key(condition), plan.starts, *own])
        scores = self.store.get(key)
        if scores is None:
            scores = engine.other_scores(result)
            self.store.put(key, scores)
        return replace(result, other_scores=scores)


def run_plan(
    plan: EvaluationPlan,
    folder: str | os.PathLike[str],
    *,
    scenes: list[Scene] | None = None,
    workers: int | None = 1,
    device: str = "cpu",
    progress: engine.Progress | None = None,
) -> dict[str, EvaluationResult]:
    """Runs `plan`, or the part of it that `folder` does not hold yet; the results by condition.

    Args:
        scenes: Those of the plan where they are loaded already.
        workers: Processes; None for one per core where the work is enough to pay for them.
        device: Torch device of a learnt agent's network.
        progress: Called with work done, work in all, and what is being done.

    Raises:
        ValueError: If a policy, a scorer or a scene is unknown, or a policy does not fit the
            environment; before any work is done.
        UserCodeError: If a policy raises, or returns something else than allowed states.
    """
    with Jobs(plan, Path(folder), scenes, device=device) as run:
        return run.run(workers=workers, progress=progress)


#: In a worker, which serves one run: the run, made by its first job.
_worker_jobs: Jobs | None = None


def _work(task: tuple[EvaluationPlan, Path, str, Job]) -> None:
    global _worker_jobs
    plan, folder, device, job = task
    if _worker_jobs is None:
        _worker_jobs = Jobs(plan, folder, device=device)
    _worker_jobs.do(job, partial(send_progress, job))


# -- what a part depends on -----------------------------------------------------------------------


def scene_content(scenes: Sequence[Scene]) -> list[Any]:
    """JSON values that change with the scenes."""
    return [
        [
            *(s.scene_id, s.group, s.kind, s.hard, s.content, s.median_speed, s.box_factor),
            # Computed again, these may differ in the last bit from those of the cache.
            *(round(value, 5) for value in (s.ev100, s.reference.log2_exposure, *s.white_balance)),
            None if s.allowed is None else np.flatnonzero(~s.allowed).tolist(),
        ]
        for s in scenes
    ]


def file_content(spec: Any) -> list[str]:
    """Hashes of the files that a scorer's or a lighting's specification, name or mapping, names."""
    names = [*spec, *spec.values()] if isinstance(spec, Mapping) else [spec]
    return [named_content(name) for name in names if isinstance(name, str)]


def named_content(name: str) -> str:
    """Hash of the files that the name of a policy, a scorer or a file means; "" without any.

    They are its module, weights and folders. With a Python file, all others of its folder count,
    since it may import them; data that it reads is not known.
    """
    base, options = policy_names.split_options(name)
    is_word = Path(base).expanduser().is_dir()  # such as the light `train`, beside its data
    files = _own_files(base) or ([] if is_word else _named_files(base))
    for value in options.values():
        files += _named_files(str(value))
        if value == policy_names.LEARNT:
            files += [
                Path(f"{file}.safetensors")
                for file in policy_names.weight_files(policy_names.FORECASTERS)
            ]
    found = hashlib.sha256()
    for file in filter(Path.is_file, files):
        with file.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            found.update(f"{printable(file.name)}\0{size}\0".encode())
            hashlib.file_digest(stream, lambda: found)
    return found.hexdigest() if files else ""


def _own_files(base: str) -> list[Path]:
    """Files of a name's own kind; of a module, the first `_MAX_NEIGHBOURS` beside it, too."""
    head, tail = policy_names.split_class(base)
    if head in policy_names.LEARNT_AGENTS:
        names = policy_names.training_seeds(base)
        return [file for name in names for file in _named_files(name.partition(":")[2])]
    if head == "recorded":
        return _named_files(tail)
    file = Path(head).expanduser() if head.endswith(".py") else None
    if file is None and tail and "." in head:
        with suppress(ImportError, ValueError):
            found = find_spec(head)
            file = Path(found.origin) if found is not None and found.origin else None
    if file is None:
        return []
    others = sorted(other for other in file.parent.glob("*.py") if other.name != file.name)
    return [file, *others[:_MAX_NEIGHBOURS]]


def _named_files(text: str) -> list[Path]:
    """The file of this name, the two of an agent, or all in a folder; none where there is none."""
    path = Path(text).expanduser()
    if path.is_dir():
        return sorted(file for file in path.rglob("*") if file.is_file())
    pair = [sibling(path, end) for end in (".safetensors", ".json")] if path.name else []
    return [file for file in (path, *pair) if file.is_file()]
