"""A plan with its scenes and episodes: score tables once per light, every policy, the results."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ae_env.scorers.score_table import TIE
from agents.evaluation.evaluation_plan import Condition, EvaluationPlan
from agents.evaluation.plan_episodes import (
    PlanEpisodes,
    batch_size,
    judged_envs,
    plan_scenes,
    seen_envs,
)
from agents.evaluation.protocol import fit_policies
from agents.evaluation.result import EvaluationResult, Track
from agents.evaluation.running import (
    TIMED_FRAMES,
    check_captures,
    concatenate_parts,
    milliseconds_alone,
    run_batch,
    stack_seeds,
)
from agents.evaluation.store import EvaluationStore, code_digest, part_key, policy_content
from agents.policy import Policy, PolicyContext, make_policy

if TYPE_CHECKING:
    from ae_env.grid import ExposureGrid
    from ae_env.scenes import Scene

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
_ARRAYS = ("states", "image_mean", "clipped_high", "clipped_low")


@dataclass(frozen=True)
class Member:
    """One policy of a plan, or one training seed of an agent.

    Args:
        policy: Name in the tables.
        name: What makes it, for `agents.make_policy`.
        index: Number of the training seed.
    """

    policy: str
    name: str
    index: int = 0


def _names(spec: Any) -> list[str]:
    """What `spec` may name: a scorer, a mapping of scorers, or the file of a lighting."""
    if isinstance(spec, Mapping):
        return [*map(str, spec), *(value for value in spec.values() if isinstance(value, str))]
    return [spec] if isinstance(spec, str) else []


class PlanRun:
    """A plan with its scenes and episodes, and where its parts are kept.

    Args:
        plan: The plan.
        folder: Where finished parts are.
        scenes: Those of the plan; loaded by default.
        device: Torch device of a learnt agent's network.
        code: Hash of the source, `code_digest()` by default: parts of other code are others.
    """

    def __init__(
        self,
        plan: EvaluationPlan,
        folder: Path,
        scenes: list[Scene] | None = None,
        device: str = "cpu",
        code: str | None = None,
    ) -> None:
        self.plan, self.store, self.device = plan, EvaluationStore(folder), device
        self.code = code or code_digest()
        self.scenes = plan_scenes(plan) if scenes is None else scenes
        self.grid: ExposureGrid = plan.options().make_grid()
        self.episodes = PlanEpisodes.of(plan, self.scenes, self.grid)

    @cached_property
    def _content(self) -> list[Any]:
        """JSON values of what the scenes are."""
        return [
            [
                *(
                    s.scene_id,
                    s.group,
                    s.kind,
                    s.hard,
                    s.content,
                    round(s.ev100, 5),
                    s.median_speed,
                ),
                # Rounded: made anew, they may differ in the last bit from those of the cache.
                *([round(gain, 5) for gain in s.white_balance], s.box_factor),
                round(s.reference.log2_exposure, 5),
            ]
            for s in self.scenes
        ]

    def light_key(self, condition: Condition) -> str:
        """Name of the part with the score tables of the light of `condition`."""
        return part_key("light", *self._shared(condition), self.plan.frames, self.plan.seeds)

    def _shared(self, condition: Condition) -> tuple[Any, ...]:
        base = {k: v for k, v in self.plan.environment.items() if k != "costs"}
        named = [*_names(base.get("scorer")), *_names(condition.lighting)]
        files = [policy_content(name) for name in named]
        return self.code, base, condition.lighting, files, self._content

    def policy_key(self, member: Member, condition: Condition) -> str:
        """Name of the part with what `member` did in `condition`."""
        return part_key(
            "policy",
            *self._shared(condition),
            condition.delay,
            self.plan.frames,
            self.plan.seeds,
            self.plan.starts,
            member.name,
            policy_content(member.name),
            self.device,
        )

    def scorers_key(self, condition: Condition, result: EvaluationResult) -> str:
        """Name of the part with what other scorers say of the states chosen in `condition`."""
        states = {
            n: hashlib.sha256(t.states.tobytes()).hexdigest() for n, t in result.tracks.items()
        }
        plan, scorers = self.plan, list(self.plan.other_scorers)
        files = [policy_content(name) for name in scorers]
        shown = (plan.seeds, plan.starts, scorers, files, plan.other_scorer_scenes)
        return part_key("scorers", *self._shared(condition), *shown, states)

    # -- score tables -------------------------------------------------------------------------

    def judge(self, condition: Condition, report: Callable[[float], None]) -> None:
        """Works out q of every state in every frame of the light of `condition`; keeps them."""
        key, episodes = self.light_key(condition), self.episodes
        if self.store.has(key):
            return
        count = episodes.num_tables
        one_start = replace(
            episodes,
            seeds=episodes.seeds[:count],
            scene=episodes.scene[:count],
            table=episodes.table[:count],
            starts=[0] * count,
        )
        envs = judged_envs(self.plan, condition, self.scenes, batch_size(count))
        base: Any = envs.unwrapped
        parts, drawn = [], []
        try:
            for _, batch in one_start.batches(envs):
                tables = [base.expected_scores()]
                for _ in range(self.plan.frames):
                    envs.step(np.zeros(envs.num_envs, np.int64))
                    tables.append(base.expected_scores())
                    report(float(batch.valid.sum()))
                parts.append(np.stack(tables, axis=1)[batch.valid])
                drawn += [base.episode(i) for i in np.flatnonzero(batch.valid)]
        finally:
            envs.close()
        arrays = {
            "scores": np.concatenate(parts),
            "speed": np.array([e.speed for e in drawn]),
            "defocus": np.array([e.defocus for e in drawn]),
        }
        self.store.save(key, arrays, {})

    def tables(self, condition: Condition) -> Floats:
        """q of every state, the reset frame first, ``(J, T + 1, S)``."""
        return self._light(condition)["scores"]

    def blur(self, condition: Condition) -> tuple[Floats, Floats]:
        """Image speed and defocus of the episodes that have a score table, ``(J,)`` each."""
        found = self._light(condition)
        return found["speed"], found["defocus"]

    def _light(self, condition: Condition) -> dict[str, np.ndarray]:
        found = self.store.load(self.light_key(condition))
        if found is None:
            raise ValueError("the score tables are not there: call `judge` first")
        return found[0]

    # -- policies -----------------------------------------------------------------------------

    def follow(self, member: Member, report: Callable[[float], None]) -> None:
        """Runs `member` in all conditions that it was not run in yet, and keeps what it did."""
        fitted: dict[int, Policy] = {}
        for condition in self.plan.all_conditions.values():
            key = self.policy_key(member, condition)
            if self.store.has(key):
                continue
            if condition.delay not in fitted:
                fitted[condition.delay] = self._fitted(member, condition)
            arrays, meta = self._episodes_of(member, fitted[condition.delay], condition, report)
            self.store.save(key, arrays, meta)

    def _fitted(self, member: Member, condition: Condition) -> Policy:
        from agents.cli.quickstart import training_scenes

        policy = self.make(member, condition)
        base = {k: v for k, v in self.plan.environment.items() if k != "costs"}
        source = base.get("scenes", "bundled")
        if isinstance(source, str):
            base["scenes"] = training_scenes(source)[0]
        fit_policies({member.name: policy}, base, seed=self.plan.seeds[0])
        return policy

    def make(self, member: Member, condition: Condition) -> Policy:
        """The policy of `member`, for the camera of `condition`; not fitted."""
        envs = seen_envs(self.plan, condition, self.scenes[:1], 1)
        try:
            context = PolicyContext.from_envs(envs)
        finally:
            envs.close()
        policy = make_policy(member.name, context, device=self.device)
        check_captures(member.name, policy)
        return policy

    def _episodes_of(
        self,
        member: Member,
        policy: Policy,
        condition: Condition,
        report: Callable[[float], None],
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        episodes, frames = self.episodes, self.plan.frames
        oracle: Ints | None = None
        if getattr(policy, "privileged", False):
            tables = self.tables(condition)
            oracle = np.argmax(tables >= tables.max(-1, keepdims=True) - TIE, axis=-1)
        envs = seen_envs(self.plan, condition, self.scenes, episodes.batch)
        parts, starts = [], []
        try:
            for index, batch in episodes.batches(envs):
                best = None if oracle is None else oracle[episodes.table[index]]
                starts.append(np.array(batch.info["state"], np.int64)[batch.valid])
                parts.append(run_batch(member.name, policy, envs, batch, frames, oracle=best))
                report(float(batch.valid.sum()) * frames)
        finally:
            envs.close()
        track = concatenate_parts(parts, policy)
        alone = None
        if condition.at_rest:
            single = seen_envs(self.plan, condition, self.scenes[:1], 1, TIMED_FRAMES)
            best = None if oracle is None else oracle[0]
            alone = milliseconds_alone(member.name, policy, single, best)
            single.close()
        arrays = {name: getattr(track, name)[0] for name in _ARRAYS}
        meta = {
            "ms_per_decision": track.ms_per_decision,
            "captures_per_decision": track.captures_per_decision,
            "privileged": track.privileged,
            "ms_alone": alone,
        }
        return {**arrays, "start_states": np.concatenate(starts)}, meta

    # -- results ------------------------------------------------------------------------------

    def result(self, condition: Condition, members: Sequence[Member]) -> EvaluationResult:
        """Everything measured in `condition`, from the finished parts."""
        tracks: dict[tuple[str, int], Track] = {}
        start_states = np.zeros(0, np.int64)
        for member in members:
            found = self.store.load(self.policy_key(member, condition))
            if found is None:
                raise ValueError(f"policy {member.name!r} has not been run: call `follow` first")
            arrays, meta = found
            start_states = arrays["start_states"]
            own: dict[str, Any] = {name: arrays[name][None] for name in _ARRAYS}
            tracks[member.policy, member.index] = Track(**own, **meta)
        scenes = [self.scenes[i] for i in self.episodes.scene]
        scores = self.tables(condition)[:, 1:][self.episodes.table]
        return EvaluationResult(
            grid=self.grid,
            scene_ids=np.array([s.scene_id for s in scenes]),
            groups=np.array([s.group for s in scenes]),
            kinds=np.array([s.kind for s in scenes]),
            hard=np.array([bool(s.hard) for s in scenes]),
            start_states=start_states,
            scores=scores,
            allowed=np.ones((len(scenes), len(self.grid)), bool),
            tracks=stack_seeds(tracks),
            seed=self.plan.seeds[0],
            delay=condition.delay,
        )
