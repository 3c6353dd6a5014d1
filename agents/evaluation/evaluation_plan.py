"""An evaluation's plan, from YAML: scenes, conditions, starts, frames, seeds, policies."""

import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import pandas as pd
from pydantic import AfterValidator, Field, field_validator, model_validator

from ae_env.grid import ExposureGrid
from ae_env.options import EnvOptions, checked_delay
from ae_env.scenes import Scene
from ae_env.scenes.folder import sequence_bounds
from ae_env.utils.user_files import find_preset
from agents.rollouts import RolloutPlan
from simulator.utils.checks import check_integer, check_word, did_you_mean
from simulator.utils.config_file import Configuration, load_yaml

#: Where an episode may begin; see `start_state`.
STARTS = ("dark", "middle", "bright", "random")
#: Parts of the static condition, whose names no condition may have.
PARTS = ("all", "hard", "rest")
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_+./-]*")
MAX_SEED, MAX_SCENES = 2**32 - 1, 100_000
#: Seeds of two entries of a plan's `seeds` are this far apart: more than any plan has scenes.
SEED_STRIDE = 2**20
#: Arguments of the environment that a condition has, and those that the evaluation itself sets.
CONDITION_ARGUMENTS = ("lighting", "delay")
_SET_BY_EVALUATION = (
    *("with_oracle", "max_episode_steps", "autoreset_mode"),
    *("budget", "max_frames", "num_envs", "render_mode"),
)
#: Entries that say how results are shown, or which policies run: another run of the same plan.
NOT_OF_THE_PROTOCOL = ("policies", "other_scorers", "other_scorer_scenes", "suite", "hash")
#: Entries of plans of one measure only.
_ONLY_OF = {
    "score": ("conditions", "delays", "starts", "frames", "other_scorers", "other_scorer_scenes"),
    "quality": ("budgets", "max_frames"),
}


class Condition(Configuration):
    """Light and delay of some of the episodes, or the time of a bracket."""

    lighting: Any = "static"  # as the environment's argument: a name, or a mapping with ``kind``
    #: Frames from a decision to the first frame that has it, of all controls or by control; as the
    #: environment's argument.
    delay: Annotated[Any, AfterValidator(checked_delay)] = 0
    budget: float | None = None  # time of all frames of a bracket [s]; the plan's `budgets` set it

    @property
    def at_rest(self) -> bool:
        """Whether the light is static and nothing delayed."""
        return self.lighting in ("static", {"kind": "static"}) and self.delay == 0


class EvaluationPlan(Configuration):
    """Everything that decides an evaluation, except the policies' own content.

    A plan with `budgets` is of ``ae_env/ExposureBracket-v0``: its measure is the quality of the
    merged picture, its conditions are the budgets, and it has no entries about frames.
    """

    name: str = "evaluation"  #: shown in the report
    #: Arguments of the environment that all conditions share; `lighting` and `delay` are those of
    #: the conditions.
    environment: dict[str, Any] = Field(default_factory=dict)
    scene_ids: tuple[str, ...] = ()  #: scenes to use, in this order; empty for all of the split
    #: Use at most so many scenes, source groups in turn; None for all.
    max_scenes: int | None = Field(default=None, ge=1, le=MAX_SCENES)
    conditions: dict[str, Condition] = Field(
        default_factory=lambda: {"static": Condition()}, min_length=1
    )  #: light and delay of each condition, by name
    #: Each condition is run with each of these delays; except for the first, it is called
    #: ``NAME/delayD`` then. Conditions with a delay of their own are run with that only.
    delays: tuple[int, ...] = Field(default=(0,), min_length=1)
    #: Where episodes begin: ``"dark"``, ``"middle"``, ``"bright"`` or ``"random"``.
    starts: tuple[str, ...] = Field(default=("dark", "middle", "bright"), min_length=1)
    frames: int = Field(default=24, ge=1, le=10_000)  #: actions per episode
    #: Of brackets: times that all frames of an episode may take together [s].
    budgets: tuple[Annotated[float, Field(ge=1e-5, le=3600.0)], ...] | None = Field(
        default=None, min_length=1
    )
    max_frames: int = Field(default=3, ge=1, le=4)  #: of brackets: frames of an episode at most
    #: Each gives every scene another motion, defocus, phase of the light and noise.
    seeds: tuple[int, ...] = Field(default=(0,), min_length=1)
    policies: tuple[str, ...] = ()  #: names, as `agents.make_policy` takes them
    #: Names of scorers that no policy was trained on; chosen states are also rated by these.
    other_scorers: tuple[str, ...] = ()
    #: Scenes that they rate, source groups in turn.
    other_scorer_scenes: int = Field(default=8, ge=1, le=MAX_SCENES)
    task: str = ""  #: of a plan that is a part of a benchmark: which of its tables has the results
    suite: tuple[str, ...] = ()  #: presets of all plans of that benchmark, which have one hash
    #: Of a benchmark: sha256 of the plan, or of all of its suite, and of the scenes' light, which
    #: is checked.
    hash: str | None = None

    @field_validator(
        *("scene_ids", "delays", "starts", "budgets", "seeds", "policies", "other_scorers")
    )
    @classmethod
    def _no_repeats(cls, values: tuple[Any, ...] | None) -> tuple[Any, ...] | None:
        if values is not None and len(set(values)) < len(values):
            raise ValueError(f"must not have an entry twice: {list(values)}")
        return values

    @model_validator(mode="after")
    def _check(self) -> Self:
        for entry in self._unused:
            field = type(self).model_fields[entry]
            if getattr(self, entry) != field.get_default(call_default_factory=True):
                also = "no `budgets`" if entry == "max_frames" else "`budgets`"
                raise ValueError(f"`{entry}` must not be given in a plan that has {also}")
        for start in self.starts:
            check_word("starts", start, STARTS)
        for seed in self.seeds:
            check_integer("seeds", seed, 0, MAX_SEED)
        for name, condition in self.conditions.items():
            if not _NAME.fullmatch(name) or name in PARTS or condition.budget is not None:
                raise ValueError(
                    f"`conditions` (={name!r}): a name must be of letters, digits and _+./-, and "
                    f"none of {list(PARTS)}; and none has a `budget`"
                )
        for name in (*CONDITION_ARGUMENTS, *_SET_BY_EVALUATION):
            if name in self.environment:
                known = name in CONDITION_ARGUMENTS
                rule = "give it as a condition's" if known else "the evaluation sets it"
                raise ValueError(f"`environment` must not have `{name}`: {rule}")
        if self.environment.get("device") is not None:
            raise ValueError("`environment` must not have `device`: policies take arrays")
        for name, condition in self.all_conditions.items():
            try:
                options = self.options(condition)
                options.make_grid(), options.make_camera()
                options.make_scorer(), options.make_lighting()
                check_integer(
                    "delay", max(options.delays), 0, self.frames - 1, more=": below `frames`"
                )
            except ValueError as error:
                raise ValueError(f"condition {name!r}: {error}") from error
        return self

    @property
    def measure(self) -> Literal["score", "quality"]:
        """Measure that the policies are compared by."""
        return "quality" if self.budgets else "score"

    @property
    def _unused(self) -> tuple[str, ...]:
        """Entries that plans of the other measure have."""
        return _ONLY_OF["score" if self.budgets else "quality"]

    @property
    def env_id(self) -> str:
        """Id of the environment."""
        return f"ae_env/{'ExposureBracket' if self.budgets else 'AutoExposure'}-v0"

    @property
    def observation(self) -> str:
        """Name of the observation that policies are shown."""
        return str(self.environment.get("observation", "uint8"))

    @property
    def all_conditions(self) -> dict[str, Condition]:
        """`conditions` with every one of `delays`, or `budgets`, by the names in the tables."""
        if self.budgets:
            return {f"{budget:g} s": Condition(budget=budget) for budget in self.budgets}
        found: dict[str, Condition] = {}
        for i, delay in enumerate(self.delays):
            for name, condition in self.conditions.items():
                if condition.delay and i == 0:
                    found[name] = condition
                elif not condition.delay:
                    label = f"{name}/delay{delay}" if i or delay else name
                    found[label] = condition.model_copy(update={"delay": delay})
        return found

    @property
    def static_condition(self) -> str:
        """The condition of unchanging light without delay; the first one where there is none."""
        conditions = self.all_conditions
        return next((n for n, c in conditions.items() if c.at_rest), next(iter(conditions)))

    def options(self, condition: Condition | None = None) -> EnvOptions:
        """The checked arguments of the environment in `condition`."""
        # A bracket's environment sets these itself.
        own = {"grid": "bracket", "depth": "far"} if self.budgets else {}
        return EnvOptions.from_kwargs(own | self.arguments(condition or Condition()))

    def arguments(self, condition: Condition) -> dict[str, Any]:
        """Arguments of the environment's observations and light in `condition`."""
        own = {"lighting": condition.lighting, "delay": condition.delay}
        return {"split": "test", **self.environment, **own}

    def describe(self, other: Callable[[Any], Any] = repr) -> dict[str, Any]:
        """Every entry as JSON values; objects of a caller's own by the function `other`."""
        entries = {k: v for k, v in dict(self).items() if k not in self._unused}
        if "conditions" in entries:
            entries["conditions"] = {
                name: {"lighting": one.lighting, "delay": one.delay}
                for name, one in self.conditions.items()
            }
        return dict(json.loads(json.dumps(entries, default=other, allow_nan=False)))

    def protocol(self) -> dict[str, Any]:
        """JSON values of all that decides the episodes and scores; a `ValueError` of others."""

        def refuse(value: Any) -> Any:
            raise ValueError(f"every entry of a plan must be a JSON value, not {value!r}")

        found = {k: v for k, v in self.describe(refuse).items() if k not in NOT_OF_THE_PROTOCOL}
        if not self.task and not self.budgets:  # plans of before there were tasks keep their digest
            del found["task"]
        return found

    def changed(self, **entries: Any) -> Self:
        """The same plan with other `entries`, checked."""
        given = {name: getattr(self, name) for name in self.model_fields_set}
        return self.model_validate(given | entries)


def load_plan(name: str | Path) -> EvaluationPlan:
    """The plan `name`: a preset of ``configs/evaluation``, or the path of a YAML file.

    A `ValueError` if there is none, or an entry is unknown, out of range or no JSON value.
    """
    plan = load_yaml(find_preset(str(name), "evaluation"), EvaluationPlan)
    plan.protocol()
    return plan


def light_name(lighting: Any) -> str:
    """Name of a condition: the kind of its light.

    >>> light_name("sine"), light_name({"kind": "step", "stops": 4})
    ('sine', 'step')
    """
    kind = lighting.get("kind") if isinstance(lighting, Mapping) else lighting
    return kind if isinstance(kind, str) and _NAME.fullmatch(kind) else "light"


def digest(*parts: object) -> str:
    """sha256 of JSON values, as hexadecimal digits.

    >>> digest({"a": 1})[:8]
    'b713f6d2'
    """
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


# -- scenes and episodes --------------------------------------------------------------------------


def plan_scenes(plan: EvaluationPlan) -> list[Scene]:
    """The scenes of `plan`, in its order; of a sequence, its first frame."""
    options = plan.options()
    scenes = options.load_scenes()
    if options.in_sequences:
        scenes = [scenes[i] for i in np.unique(sequence_bounds(scenes)[0])]
    if plan.scene_ids:
        known = {scene.scene_id: scene for scene in scenes}
        for name in set(plan.scene_ids) - set(known):
            source = plan.environment.get("scenes", "bundled")
            text = f"`scene_ids` (={name!r}) must name scenes of the {len(known)} of {source!r}"
            raise ValueError(text + did_you_mean(name, known))
        scenes = [known[name] for name in plan.scene_ids]
    return groups_in_turn(scenes, plan.max_scenes)


def groups_in_turn(scenes: Sequence[Scene], count: int | None) -> list[Scene]:
    """At most `count` of `scenes`: kinds in turn, and within a kind source groups in turn."""
    if count is None or count >= len(scenes):
        return list(scenes)
    names = pd.DataFrame({"kind": [s.kind for s in scenes], "group": [s.group for s in scenes]})
    repeat = names.groupby("group").cumcount()
    rank = names.groupby("kind").group.transform(lambda own: pd.factorize(own)[0])
    chosen = np.lexsort((rank, repeat))[:count]  # equal ones stay in order
    return [scenes[i] for i in np.sort(chosen)]


def plan_episodes(plan: EvaluationPlan, scenes: Sequence[Scene], grid: ExposureGrid) -> RolloutPlan:
    """The episodes of a condition of `plan`: starts change slowest, then seeds, scenes fastest.

    Episodes that differ in their start only have the same seed: the same motion, defocus, light and
    noise. Of brackets, which begin with a metered frame, no start is given.
    """
    starts = ("random",) if plan.budgets else plan.starts
    own = [(seed * SEED_STRIDE + j, j) for seed in plan.seeds for j in range(len(scenes))]
    return RolloutPlan(
        scenes=scenes,
        seeds=[seed for seed, _ in own] * len(starts),
        scene=np.array([j for _, j in own] * len(starts)),
        starts=[start_state(start, scenes[j], grid) for start in starts for _, j in own],
    )


def start_state(start: str, scene: Scene, grid: ExposureGrid) -> int | None:
    """State in which an episode begins, among those that the scene allows; ties to the lower ISO.

    ``"dark"``: the least exposure of the grid, its highest EV100; ``"middle"``: the state whose
    EV100 is nearest to that of the scene's right exposure; ``"bright"``: the most exposure;
    ``"random"``: None, the seed draws it.
    """
    if start == "random":
        return None
    ends = {"dark": float(grid.ev100.max()), "bright": float(grid.ev100.min())}
    distance = np.abs(grid.ev100 - ends.get(start, scene.ev100)).round(9)
    if scene.allowed is not None:
        distance = np.where(scene.allowed, distance, np.inf)
    return int(np.argmin(distance))
