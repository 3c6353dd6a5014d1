"""An evaluation of brackets, from YAML: scenes, budgets, seeds, policies; and its results."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from agents.evaluation.evaluation_plan import (
    MAX_SCENES,
    MAX_SEED,
    NOT_OF_THE_PROTOCOL,
    EvaluationPlan,
    load_plan,
    plan_scenes,
)
from agents.evaluation.intervals import Interval, difference_interval
from agents.evaluation.metrics import group_means
from agents.policy import Policy, PolicyContext
from agents.policy_names import make_policy, training_seeds
from simulator.utils.config_file import Configuration, load_yaml, read_yaml

if TYPE_CHECKING:
    import gymnasium as gym

    from ae_env.scenes import Scene

#: Id of the task.
ENV_ID = "ae_env/ExposureBracket-v0"
#: What a policy reaches in an episode, as `run_brackets` calls it.
MEASURES = ("quality", "log_error", "unseen", "frames", "seconds")
#: Arguments of the environment that the evaluation itself sets.
_OWN_ARGUMENTS = ("budget", "max_frames", "autoreset_mode", "num_envs", "render_mode")
#: Episodes at a time.
_BATCH = 32

Progress = Callable[[int, int, str], None]


class BracketPlan(Configuration):
    """Everything that decides an evaluation of brackets except the policies' own content.

    Args:
        name: Shown in the report.
        environment: Arguments of ``ae_env/ExposureBracket-v0``, such as ``scenes``.
        scene_ids: Scenes to use, in this order; empty for all of the split.
        max_scenes: Use at most so many scenes, source groups in turn; None for all.
        budgets: Times that all frames of an episode may take together [s]; each is run.
        max_frames: Frames of an episode at most.
        seeds: Each gives every scene another motion and noise.
        policies: Names, as `agents.make_policy` takes them.
        task: Of a plan that is a part of a benchmark: which of its tables has the results.
        suite: As of `EvaluationPlan`.
        hash: As of `EvaluationPlan`.
    """

    name: str = "bracket"
    environment: dict[str, Any] = Field(default_factory=dict)
    scene_ids: tuple[str, ...] = ()
    max_scenes: int | None = Field(default=None, ge=1, le=MAX_SCENES)
    budgets: tuple[float, ...] = Field(min_length=1)
    max_frames: int = Field(default=3, ge=1, le=4)
    seeds: tuple[int, ...] = Field(default=(0,), min_length=1)
    policies: tuple[str, ...] = ()
    task: str = ""
    suite: tuple[str, ...] = ()
    hash: str | None = None

    @field_validator("scene_ids", "budgets", "seeds", "policies")
    @classmethod
    def _no_repeats(cls, values: tuple[Any, ...]) -> tuple[Any, ...]:
        return EvaluationPlan._no_repeats(values)

    @model_validator(mode="after")
    def _check(self) -> BracketPlan:
        if min(self.seeds) < 0 or max(self.seeds) > MAX_SEED:
            raise ValueError(f"`seeds` (={list(self.seeds)}) must be in [0, {MAX_SEED}]")
        for budget in self.budgets:
            if not 1e-5 <= budget <= 3600.0:
                raise ValueError(f"`budgets` (={budget}) must be in [1e-05, 3600] seconds")
        for name in _OWN_ARGUMENTS:
            if name in self.environment:
                raise ValueError(f"`environment` must not have `{name}`")
        self.of_conditions()  # raises where an argument is none
        return self

    @property
    def observation(self) -> str:
        """What policies are shown."""
        return str(self.environment.get("observation", "uint8"))

    def of_conditions(self) -> EvaluationPlan:
        """A plan with the same scenes."""
        environment = {"grid": "bracket", "depth": "far", **self.environment}
        return EvaluationPlan(
            environment=environment, scene_ids=self.scene_ids, max_scenes=self.max_scenes
        )

    def protocol(self) -> dict[str, Any]:
        """JSON values of everything that decides the episodes and their results."""
        content = json.loads(self.model_dump_json())
        return {k: v for k, v in content.items() if k not in NOT_OF_THE_PROTOCOL}

    def changed(self, **entries: Any) -> BracketPlan:
        """The same plan with other entries, checked."""
        return BracketPlan.model_validate({**dict(self), **entries})

    def make_envs(
        self, budget: float, scenes: list[Scene] | None = None
    ) -> gym.vector.VectorEnv[Any, Any, Any]:
        """Environments with one of the budgets; by default on the training scenes."""
        import gymnasium as gym

        import ae_env  # noqa: F401  (registers the environment)

        environment = {**self.environment, "split": "train"}
        if scenes is not None:
            environment |= {"scenes": scenes, "split": "all"}
        return gym.make_vec(
            ENV_ID,
            num_envs=_BATCH,
            autoreset_mode="DISABLED",
            budget=budget,
            max_frames=self.max_frames,
            **environment,
        )


def load_bench_plan(name: str | Path) -> EvaluationPlan | BracketPlan:
    """The plan of a preset or of a YAML file, of either kind: one of brackets has ``budgets``.

    Raises:
        ValueError: As `load_plan`.
    """
    from ae_env.utils.presets import find_preset

    path = find_preset(str(name), "evaluation")
    content = read_yaml(path)
    if isinstance(content, Mapping) and "budgets" in content:
        return load_yaml(path, BracketPlan)
    return load_plan(name)


@dataclass(frozen=True)
class BracketResult:
    """What a policy reached: a row for each training seed, a column for each source group.

    Args:
        policy: Its name.
        groups: Source groups, ``(G,)``.
        values: ``(K, B, G)`` of each of `MEASURES`, by budget.
    """

    policy: str
    groups: NDArray[Any]
    values: Mapping[str, NDArray[np.float64]]

    def score(self, other: BracketResult | None = None, budget: int | None = None) -> Interval:
        """Mean quality with its interval, over all budgets or one; minus that of `other`."""
        kept = slice(None) if budget is None else slice(budget, budget + 1)
        own = self.values["quality"][:, kept].mean(axis=1)
        base = np.zeros_like(own[:1])
        if other is not None:
            base = other.values["quality"][:, kept].mean(axis=1)
        return difference_interval(own, base, np.ones(len(self.groups)))

    def mean(self, measure: str, chosen: NDArray[np.bool_] | None = None) -> float:
        """Mean over seeds, budgets and the groups `chosen`."""
        values = self.values[measure]
        return float((values if chosen is None else values[..., chosen]).mean())


def check_bracket_policies(plan: BracketPlan, scenes: list[Scene]) -> None:
    """Checks the policies of `plan` before any work.

    Raises:
        ValueError: If there is none, or one is unknown or does not fit the environment.
    """
    if not plan.policies:
        raise ValueError("`policies` (=[]) must hold at least one policy")
    with closing(plan.make_envs(plan.budgets[0], scenes[:1])) as envs:
        context = PolicyContext.from_envs(envs)
        for policy in plan.policies:
            for name in training_seeds(policy):
                make_policy(name, context)


def run_bracket_plan(
    plan: BracketPlan, scenes: list[Scene] | None = None, *, progress: Progress | None = None
) -> list[BracketResult]:
    """Runs every policy of `plan` in every budget; the best first.

    Args:
        plan: The plan, with its policies.
        scenes: Those of the plan where they are loaded already.
        progress: Called with work done, work in all, and what is being done.

    Raises:
        ValueError: If a policy is unknown or does not fit the environment; before any work.
    """
    from agents.bracketing.policies import run_brackets

    scenes = plan_scenes(plan.of_conditions()) if scenes is None else scenes
    check_bracket_policies(plan, scenes)
    found: dict[str, list[list[dict[str, NDArray[np.float64]]]]] = {}
    groups = np.unique([scene.group for scene in scenes])
    members = [(policy, name) for policy in plan.policies for name in training_seeds(policy)]
    for i, budget in enumerate(plan.budgets):
        with closing(plan.make_envs(budget, scenes)) as envs:
            context = PolicyContext.from_envs(envs)
            made = [(policy, name, make_policy(name, context)) for policy, name in members]
            for j, (policy, name, one) in enumerate(made):
                if progress is not None:
                    done = i * len(made) + j
                    progress(done, len(plan.budgets) * len(made), f"{name}, {budget:g} s")
                if type(one).fit is not Policy.fit:
                    with closing(plan.make_envs(budget)) as train:
                        one.fit(train, plan.seeds[0])
                runs = [run_brackets(one, envs, seed=seed << 20, name=name) for seed in plan.seeds]
                merged = {k: np.concatenate([r[k] for r in runs]) for k in (*MEASURES, "group")}
                means = {
                    k: group_means(merged[k].astype(np.float64), merged["group"])[0]
                    for k in MEASURES
                }
                found.setdefault(policy, [[] for _ in plan.budgets])[i].append(means)
    results = [
        BracketResult(
            policy,
            groups,
            {
                measure: np.array(
                    [[m[measure] for m in of_budget] for of_budget in by_budget]
                ).swapaxes(0, 1)
                for measure in MEASURES
            },
        )
        for policy, by_budget in found.items()
    ]
    return sorted(results, key=lambda result: -result.mean("quality"))
