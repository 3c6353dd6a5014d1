"""The evaluation engine: score tables once per light, every policy on the same episodes.

An evaluation is a plan with one or many conditions. `evaluate` runs a plan of one condition on
policies that the caller has made; `agents.evaluation.plan_run` makes the policies by their names,
keeps every finished part in a file, and shares the work between processes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from ae_env.scorers import make_scorer
from ae_env.scorers.score_table import TIE
from agents.evaluation.evaluation_plan import (
    CONDITION_ARGUMENTS,
    MAX_SEED,
    Condition,
    EvaluationPlan,
    light_name,
    plan_episodes,
    plan_scenes,
)
from agents.evaluation.other_scorers import other_scores
from agents.evaluation.result import EvaluationResult, Track
from agents.evaluation.running import (
    TIMED_FRAMES,
    Progress,
    VectorEnv,
    check_captures,
    fit_policies,
    milliseconds_alone,
    run_batch,
    training_envs,
)
from agents.policy import Policy, PolicyContext
from agents.policy_names import make_policy, training_seeds
from agents.rollouts import RolloutPlan, action_masks, expected_scores, fitting_arguments, make_envs
from simulator.utils.checks import check_integer

if TYPE_CHECKING:
    from ae_env.scenes import Scene

Ints = NDArray[np.int64]
Arrays = dict[str, NDArray[Any]]

#: Arrays of a `Track`.
TRACK_ARRAYS = ("states", "image_mean", "code_mean", "clipped_high", "clipped_low")
#: Episodes at a time, at most.
BATCH = 64
#: The scorer of the environments that policies see: it costs next to nothing, and is not used.
_CHEAP = "sharpness"


def evaluate(
    policies: Mapping[str, Policy | Sequence[Policy]],
    env_options: Mapping[str, Any],
    *,
    episodes_per_scene: int = 1,
    frames: int = 8,
    seed: int = 0,
    batch: int = BATCH,
    other_scorers: Sequence[str] = (),
    progress: Progress | None = None,
) -> EvaluationResult:
    """Run every policy over the same episodes, from starts that are drawn.

    The reset frame does not count; frames are counted after each action. Scores are always the
    expected scores q, whatever the environment's reward.

    Args:
        policies: By name in the tables; a list holds the same agent from several training seeds.
        env_options: Arguments of ``ae_env/AutoExposure-v0``, such as
            ``{"scenes": "bundled", "split": "test", "resolution": 64}``.
        episodes_per_scene: Episodes of each scene, each with its own start, motion and defocus:
            those of the seeds `seed`, `seed` + 1 and so on.
        frames: Actions per episode.
        seed: Decides the episodes.
        batch: Episodes at a time, at most.
        other_scorers: Names of scorers that no policy was trained on; states that were chosen in
            some of the scenes are also rated by these.
        progress: Called with frames done, frames in all, and the name of the policy.

    Raises:
        ValueError: If an argument is out of range.
        UserCodeError: If a policy raises (the cause is chained), or returns something else than
            allowed states.
    """
    check_integer("episodes_per_scene", episodes_per_scene, 1)
    check_integer("frames", frames, 1)
    check_integer("batch", batch, 1)
    check_integer("seed", seed, 0, MAX_SEED + 1 - episodes_per_scene)
    members = [
        (Member(name, name, k), policy)
        for name, entry in policies.items()
        for k, policy in enumerate(entry if isinstance(entry, Sequence) else [entry])
    ]
    if not members:
        raise ValueError(f"`policies` (={policies!r}) must hold at least one policy")
    for member, policy in members:
        check_captures(member.name, policy)
    for name in other_scorers:
        make_scorer(name)  # raises before any work
    plan = _plan_of(env_options, frames, range(seed, seed + episodes_per_scene))
    plan = plan.model_copy(update={"other_scorers": tuple(other_scorers)})
    run = EvaluationRun(plan, batch=batch)
    (condition,) = run.plan.all_conditions.values()
    total = run.plan.frames * (run.num_tables + len(members) * len(run.episodes))
    done = 0.0

    def reporter(name: str) -> Callable[[float], None]:
        def report(count: float) -> None:
            nonlocal done
            done += count
            if progress is not None:
                progress(int(done), total, name)

        return report

    with run:
        light = run.judge(condition, reporter("score tables"))
        tracks: dict[Member, Track] = {}
        start_states = np.zeros(0, np.int64)
        for member, policy in members:
            follow = run.follow(member.name, policy, condition, light, reporter(member.name))
            start_states, tracks[member] = follow
    result = run.result(condition, light, start_states, tracks)
    return replace(result, other_scores=other_scores(result, plan))


def _plan_of(env_options: Mapping[str, Any], frames: int, seeds: Sequence[int]) -> EvaluationPlan:
    from ae_env.options import EnvOptions

    given = {k: v for k, v in env_options.items() if k not in ("with_oracle", "autoreset_mode")}
    options = EnvOptions.from_kwargs(given)  # its errors name the argument
    delay = dict(options.delay) if isinstance(options.delay, Mapping) else options.delay
    condition = Condition(lighting=options.lighting, delay=delay)
    environment = {k: v for k, v in given.items() if k not in CONDITION_ARGUMENTS}
    scenes = options.scenes if isinstance(options.scenes, str) else "given scenes"
    return EvaluationPlan(
        name=f"{scenes}, {options.split} split",
        environment={**environment, "split": options.split},
        conditions={light_name(options.lighting): condition},
        starts=("random",),
        frames=frames,
        seeds=tuple(seeds),
    )


@dataclass(frozen=True)
class Member:
    """One policy of a plan, or one training seed of an agent.

    Args:
        policy: Name in the tables.
        name: Name for `agents.make_policy`.
        index: Number of the training seed.
    """

    policy: str
    name: str
    index: int = 0


class EvaluationRun:
    """A plan with its scenes and episodes; a context manager that closes its environments.

    Args:
        plan: The plan.
        scenes: Those of the plan; loaded by default.
        device: Torch device of a learnt agent's network.
        batch: Episodes at a time, at most.
    """

    def __init__(
        self,
        plan: EvaluationPlan,
        scenes: list[Scene] | None = None,
        *,
        device: str = "cpu",
        batch: int = BATCH,
    ) -> None:
        self.plan, self.device, self.batch = plan, device, batch
        self.scenes = plan_scenes(plan) if scenes is None else scenes
        self.grid = plan.options().make_grid()
        self.episodes = plan_episodes(plan, self.scenes, self.grid)
        self._envs: dict[tuple[Any, ...], VectorEnv] = {}
        self._training: VectorEnv | None = None
        self._open_for: Condition | None = None

    @property
    def num_tables(self) -> int:
        """Number of episodes that differ in more than their start."""
        return len(self.episodes) // len(self.plan.starts)

    @property
    def members(self) -> list[Member]:
        """Every training seed of every policy of the plan."""
        names = self.plan.policies
        return [Member(p, name, k) for p in names for k, name in enumerate(training_seeds(p))]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()
        if self._training is not None:
            self._training.close()
            self._training = None

    def _close(self) -> None:
        for envs in self._envs.values():
            envs.close()
        self._envs.clear()

    def _make_envs(
        self, condition: Condition, num_envs: int, frames: int, *, judged: bool = False
    ) -> VectorEnv:
        """Environments of a condition, which stay open until those of another are asked for.

        Args:
            condition: Light and delay.
            num_envs: Episodes at a time.
            frames: Actions that an episode must allow.
            judged: Whether they have the plan's scorer: policies see environments without.
        """
        if condition != self._open_for:
            self._close()
            self._open_for = condition
        key = num_envs, frames, judged
        if key not in self._envs:
            unused = ("costs",) if judged else ("costs", "reward")
            options = {k: v for k, v in self.plan.arguments(condition).items() if k not in unused}
            options |= {"delay": 0} if judged else {"scorer": _CHEAP}
            if not self.plan.options().in_sequences:  # those must know that they are sequences
                options["scenes"] = self.scenes
            self._envs[key] = make_envs(options, num_envs=num_envs, frames=frames)
        return self._envs[key]

    def judge(self, condition: Condition, report: Callable[[float], None]) -> Arrays:
        """q of every state in every frame of the light of `condition`, whatever the start.

        Returns:
            ``scores`` and ``allowed`` (J, T + 1, S), the reset frame first; ``speed`` and
            ``defocus`` (J,) and ``movement`` (J, 4) that the episodes drew.
        """
        count, frames, own = self.num_tables, self.plan.frames, self.episodes
        episodes = RolloutPlan(self.scenes, own.seeds[:count], own.scene[:count], [0] * count)
        envs = self._make_envs(condition, batch_size(count, self.batch), frames, judged=True)
        base: Any = envs.unwrapped
        scores, allowed, drawn = [], [], []
        for batch in episodes.batches(envs):
            tables, masks = [expected_scores(envs)], [batch.action_masks]
            for _ in range(frames):
                envs.step(np.zeros(envs.num_envs, np.int64))
                tables.append(expected_scores(envs))
                masks.append(action_masks(envs))
                report(float(batch.valid.sum()))
            scores.append(np.stack(tables, axis=1)[batch.valid])
            allowed.append(np.stack(masks, axis=1)[batch.valid])
            drawn += [base.episode(int(i)) for i in np.flatnonzero(batch.valid)]
        return {
            "scores": np.concatenate(scores),
            "allowed": np.concatenate(allowed),
            "speed": np.array([episode.speed for episode in drawn]),
            "defocus": np.array([episode.defocus for episode in drawn]),
            "movement": np.array([astuple(episode.movement) for episode in drawn]),
        }

    def make(self, member: Member, condition: Condition) -> Policy:
        """The policy of `member`, for the camera of `condition`; not fitted."""
        context = PolicyContext.from_envs(self._make_envs(condition, 1, TIMED_FRAMES))
        policy = make_policy(member.name, context, device=self.device)
        check_captures(member.name, policy)
        return policy

    def fitted(self, member: Member, condition: Condition) -> Policy:
        """The policy of `member`, fitted on training scenes in static light."""
        policy = self.make(member, condition)
        if getattr(type(policy), "fit", Policy.fit) is Policy.fit:
            return policy
        base = {k: v for k, v in self.plan.environment.items() if k != "costs"}
        base = fitting_arguments(base, self.plan.options().resolution)
        if self._training is None:
            self._training = training_envs(base)
        fit_policies({member.name: policy}, base, seed=self.plan.seeds[0], training=self._training)
        return policy

    def follow(
        self,
        name: str,
        policy: Policy,
        condition: Condition,
        light: Arrays | None,
        report: Callable[[float], None],
    ) -> tuple[Ints, Track]:
        """Runs `policy` through all episodes of `condition`.

        Args:
            name: The policy's name in errors.
            policy: The policy, fitted.
            condition: Light and delay.
            light: What `judge` returns; only a privileged policy needs it.
            report: Called with the frames done since the last call.

        Returns:
            The state of each episode's reset frame, ``(E,)``; and the track.
        """
        oracle: Ints | None = None
        if getattr(policy, "privileged", False):
            if light is None:
                raise ValueError(f"policy {name!r} is privileged: it needs the score tables")
            oracle = best_states(light["scores"], light["allowed"])
        frames, episodes = self.plan.frames, self.episodes
        envs = self._make_envs(condition, batch_size(len(episodes), self.batch), frames)
        parts = []
        for batch in episodes.batches(envs):
            best = None if oracle is None else oracle[batch.index % self.num_tables]
            parts.append(run_batch(name, policy, envs, batch, frames, oracle=best))
            report(float(batch.valid.sum()) * frames)
        alone = None
        if condition.at_rest:
            first = replace(episodes, seeds=[0], scene=episodes.scene[:1], starts=[None])
            single = self._make_envs(condition, 1, TIMED_FRAMES)
            best = None if oracle is None else oracle[:1]
            alone = milliseconds_alone(name, policy, single, first, best)
        arrays = {k: np.concatenate([part[k] for part in parts])[None] for k in TRACK_ARRAYS}
        seconds = sum(float(part["seconds"].sum()) for part in parts)
        track = Track(
            **arrays,
            ms_per_decision=1000.0 * seconds / (frames * len(episodes)),
            captures_per_decision=float(getattr(policy, "captures_per_decision", 1.0)),
            privileged=oracle is not None,
            ms_alone=alone,
        )
        return np.concatenate([part["start_states"] for part in parts]), track

    def result(
        self,
        condition: Condition,
        light: Arrays,
        start_states: Ints,
        tracks: Mapping[Member, Track],
    ) -> EvaluationResult:
        """Everything measured in `condition`, from what `judge` and `follow` return."""
        scenes = [self.scenes[i] for i in self.episodes.scene]
        table = np.arange(len(scenes)) % self.num_tables
        policies = dict.fromkeys(member.policy for member in tracks)
        return EvaluationResult(
            grid=self.grid,
            scene_ids=np.array([s.scene_id for s in scenes]),
            groups=np.array([s.group for s in scenes]),
            kinds=np.array([s.kind for s in scenes]),
            hard=np.array([bool(s.hard) for s in scenes]),
            start_states=start_states,
            scores=light["scores"][table, 1:],
            allowed=light["allowed"][table, 1:],
            tracks={
                name: Track.of_seeds([t for m, t in tracks.items() if m.policy == name])
                for name in policies
            },
            seed=self.plan.seeds[0],
            delays=self.plan.options(condition).delays,
            plan=self.plan,
            scenes=scenes,
            speed=light["speed"][table],
            defocus=light["defocus"][table],
            movement=light["movement"][table],
        )


def best_states(scores: NDArray[np.float64], allowed: NDArray[np.bool_]) -> Ints:
    """The oracle's states: the best allowed one, ties to the lower ISO, ````(...)````.

    >>> int(best_states(np.array([0.5, 0.9, 0.9]), np.array([True, False, True])))
    2
    """
    known = np.where(allowed, scores, -np.inf)
    best: Ints = np.argmax(known >= known.max(axis=-1, keepdims=True) - TIE, axis=-1)
    return best


def batch_size(count: int, most: int = BATCH) -> int:
    """Size of equal batches of at most `most`.

    >>> batch_size(60), batch_size(120), batch_size(130)
    (60, 60, 44)
    """
    batches = -(-count // most)
    return -(-count // batches)
