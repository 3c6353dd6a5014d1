"""What an evaluation runs: scenes, conditions, starts, frames, seeds, policies; from YAML."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field, field_validator, model_validator

from ae_env.utils.checks import did_you_mean
from simulator.utils.config_file import Configuration, load_yaml

if TYPE_CHECKING:
    from ae_env.options import EnvOptions

#: Where an episode may begin; see `agents.evaluation.plan_episodes.start_state`.
STARTS = ("dark", "middle", "bright", "random")
#: Names of parts of the static condition, which no condition may have.
_RESERVED = ("all", "hard", "rest")
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_+./-]*")
MAX_FRAMES, MAX_SEED, MAX_SCENES = 10_000, 2**32 - 1, 100_000
#: Entries that say how results are shown, or which policies run: another run of the same plan.
_NOT_OF_THE_PROTOCOL = ("policies", "other_scorers", "other_scorer_scenes", "hash")


class Condition(Configuration):
    """What differs from the base environment.

    Args:
        lighting: As the environment's argument: a name, or a mapping with ``kind``.
        delay: Frames from a decision to the first frame that has it.
    """

    lighting: str | dict[str, Any] = "static"
    delay: int = Field(default=0, ge=0, le=16)

    @property
    def at_rest(self) -> bool:
        """Whether neither light nor delay differ from the plainest case."""
        static = self.lighting in ("static", {"kind": "static"})
        return static and self.delay == 0


class EvaluationPlan(Configuration):
    """Everything that decides an evaluation but the policies' own content.

    Args:
        name: Shown in the report.
        environment: Arguments of ``ae_env/AutoExposure-v0`` that all conditions share; `lighting`
            and `delay` are those of the conditions.
        scene_ids: Scenes to use, in this order; empty for all of the split.
        max_scenes: Use at most so many scenes, source groups in turn; None for all.
        conditions: By name.
        delays: Each condition is run with each of these delays; beside the first it is called
            ``NAME/delayD``. Conditions with a delay of their own are run with that only.
        starts: Where episodes begin: ``"dark"``, ``"middle"``, ``"bright"`` or ``"random"``.
        frames: Actions per episode.
        seeds: Each gives every scene another motion, defocus, phase of the light and noise.
        policies: Names, as `agents.make_policy` takes them.
        other_scorers: Names of scorers that no policy was trained on; chosen states are also rated
            by these.
        other_scorer_scenes: Scenes that they rate, source groups in turn.
        hash: Of a benchmark: sha256 of the plan and of the scenes' light, which is checked.
    """

    name: str = "evaluation"
    environment: dict[str, Any] = Field(default_factory=dict)
    scene_ids: tuple[str, ...] = ()
    max_scenes: int | None = Field(default=None, ge=1, le=MAX_SCENES)
    conditions: dict[str, Condition] = Field(default_factory=lambda: {"static": Condition()})
    delays: tuple[int, ...] = (0,)
    starts: tuple[str, ...] = ("dark", "middle", "bright")
    frames: int = Field(default=24, ge=1, le=MAX_FRAMES)
    seeds: tuple[int, ...] = (0,)
    policies: tuple[str, ...] = ()
    other_scorers: tuple[str, ...] = ()
    other_scorer_scenes: int = Field(default=8, ge=1, le=MAX_SCENES)
    hash: str | None = None

    @field_validator("scene_ids", "delays", "starts", "seeds", "policies", "other_scorers")
    @classmethod
    def _no_repeats(cls, values: tuple[Any, ...]) -> tuple[Any, ...]:
        if len(set(values)) < len(values):
            raise ValueError(f"must not have an entry twice: {list(values)}")
        return values

    @model_validator(mode="after")
    def _check(self) -> EvaluationPlan:
        for rule, values in (("starts", self.starts), ("seeds", self.seeds)):
            if not values:
                raise ValueError(f"`{rule}` must have one entry or more")
        for start in self.starts:
            if start not in STARTS:
                hint = did_you_mean(start, STARTS)
                raise ValueError(f"`starts` (={start!r}) must be of {list(STARTS)}{hint}")
        if min(self.seeds) < 0 or max(self.seeds) > MAX_SEED:
            raise ValueError(f"`seeds` (={list(self.seeds)}) must be in [0, {MAX_SEED}]")
        if not self.conditions or not self.delays:
            raise ValueError("`conditions` and `delays` must have one entry or more")
        for name in self.conditions:
            if not _NAME.fullmatch(name) or name in _RESERVED:
                raise ValueError(
                    f"`conditions` (={name!r}): a name must be of letters, digits and _+./-, and "
                    f"none of {list(_RESERVED)}"
                )
        for name in ("lighting", "delay", "with_oracle", "max_episode_steps", "autoreset_mode"):
            if name in self.environment:
                raise ValueError(f"`environment` must not have `{name}`: give it as a condition's")
        for name, condition in self.all_conditions.items():
            self._check_options(name, condition)
        try:
            self.canonical()
        except TypeError as error:
            raise ValueError(f"every entry must be a JSON value: {error}") from error
        return self

    def _check_options(self, name: str, condition: Condition) -> None:
        try:
            options = self.options(condition)
            options.make_grid(), options.make_camera(), options.make_scorer()
            options.make_lighting()
        except ValueError as error:
            raise ValueError(f"condition {name!r}: {error}") from error

    @property
    def all_conditions(self) -> dict[str, Condition]:
        """`conditions` with every one of `delays`, by the names that the tables show."""
        found: dict[str, Condition] = {}
        for i, delay in enumerate(self.delays):
            for name, condition in self.conditions.items():
                if condition.delay and i == 0:
                    found[name] = condition
                elif not condition.delay:
                    label = f"{name}/delay{delay}" if i or delay else name
                    found[label] = condition.model_copy(update={"delay": delay})
        return found

    def arguments(self, condition: Condition) -> dict[str, Any]:
        """Arguments of the environment in `condition`."""
        base = {"split": "test", **self.environment}
        return {**base, "lighting": condition.lighting, "delay": condition.delay}

    def options(self, condition: Condition | None = None) -> EnvOptions:
        """The checked arguments of the environment in `condition`."""
        from ae_env.options import EnvOptions

        return EnvOptions.from_kwargs(self.arguments(condition or Condition()))

    def protocol(self) -> dict[str, Any]:
        """JSON values of all that decides the episodes and their scores."""
        content = self.model_dump(mode="json")
        return {key: content[key] for key in content if key not in _NOT_OF_THE_PROTOCOL}

    def canonical(self) -> str:
        """`protocol` as text, the same for the same plan however its YAML is written."""
        return json.dumps(self.protocol(), sort_keys=True, separators=(",", ":"), allow_nan=False)

    def changed(self, **entries: Any) -> EvaluationPlan:
        """The same plan with other entries, checked.

        Raises:
            ValueError: If an entry is out of range.
        """
        return EvaluationPlan.model_validate({**self.model_dump(), **entries})


def load_plan(name: str | Path) -> EvaluationPlan:
    """The plan of a preset of ``configs/evaluation``, or of a YAML file of one's own.

    Raises:
        ValueError: If there is none, or an entry is unknown or out of range; the message names the
            file and the entry.
    """
    from ae_env.utils.presets import find_preset

    return load_yaml(find_preset(str(name), "evaluation"), EvaluationPlan)


def digest(*parts: object) -> str:
    """sha256 of JSON values, as hexadecimal digits.

    >>> digest({"a": 1})[:8]
    'b713f6d2'
    """
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()
