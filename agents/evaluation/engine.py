"""The evaluation engine: score tables once per light, every policy on the same episodes.

An evaluation is a plan with one or many conditions. `evaluate` runs a plan of one condition on
policies that the caller has made; `agents.evaluation.jobs` makes the policies by their names,
keeps every finished part in a file, and shares the work between processes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from typing import TYPE_CHECKING, Any, Self

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from ae_env.scorers import make_scorer
from ae_env.scorers.score_table import TIE, ScoreTables
from agents.episodes import (
    EpisodeBatch,
    Episodes,
    action_masks,
    checked_states,
    errors_of,
    expected_scores,
    fitting_arguments,
    make_envs,
)
from agents.evaluation.plan import (
    CONDITION_ARGUMENTS,
    MAX_SEED,
    Condition,
    EvaluationPlan,
    groups_in_turn,
    light_name,
    plan_episodes,
    plan_scenes,
)
from agents.evaluation.result import EvaluationResult, Track
from agents.metering.reading import linear_signal, signal_codes
from agents.policy import Policy, PolicyContext, make_policy, training_seeds
from simulator.utils.checks import check_integer, check_number

if TYPE_CHECKING:
    from ae_env.scenes import Scene

VectorEnv = gym.vector.VectorEnv[Any, Any, Any]
#: Called with work done, work in all, and what is being done.
Progress = Callable[[int, int, str], None]
#: Frames in which the time of one camera's decision is measured, the first ones to warm up.
TIMED_FRAMES, _WARM_UP = 28, 4


def fit_policies(
    policies: Mapping[str, Policy],
    env_options: Mapping[str, Any],
    *,
    seed: int = 0,
    batch: int = 64,
    progress: Progress | None = None,
    training: VectorEnv | None = None,
) -> None:
    """Call `fit` of every policy that has one, on the training split.

    Args:
        policies: By name; changed in place.
        env_options: Arguments of the environment; `split` is set to ``"train"``.
        seed: Decides the training episodes.
        batch: Episodes at a time.
        progress: Called before and after each fit.
        training: Environments to use, see `training_envs`, which stay open; by default new ones.
    """
    learners = {n: p for n, p in policies.items() if getattr(type(p), "fit", None)}
    learners = {n: p for n, p in learners.items() if type(p).fit is not Policy.fit}
    if not learners:
        return
    envs = training_envs(env_options, batch) if training is None else training
    try:
        for i, (name, policy) in enumerate(learners.items()):
            if progress is not None:
                progress(i, len(learners), name)
            with errors_of(name, "fit"):
                policy.fit(envs, seed)
        if progress is not None:
            progress(len(learners), len(learners), "")
    finally:
        if training is None:
            envs.close()


def training_envs(env_options: Mapping[str, Any], batch: int = 64) -> VectorEnv:
    """Environments to fit policies on; fits that follow each other share their score tables.

    Args:
        env_options: As of `fit_policies`.
        batch: As of `fit_policies`.
    """
    return make_envs({**env_options, "split": "train"}, num_envs=batch, frames=16)


def run_batch(
    name: str,
    policy: Policy,
    envs: VectorEnv,
    batch: EpisodeBatch,
    frames: int,
    *,
    oracle: NDArray[np.int64] | None = None,
) -> dict[str, NDArray[Any]]:
    """Run one policy over one batch of episodes.

    Args:
        name: The policy's name in errors.
        policy: The policy.
        envs: Freshly reset to `batch`.
        batch: The episodes.
        frames: Actions.
        oracle: (N, frames + 1) best state of every frame, the reset frame first, which a privileged
            policy's ``info`` gets.

    Returns:
        Of the valid episodes ``states`` and the other entries of `TRACK_ARRAYS`
        (n, frames) after each action, and their ``start_states`` (n,); ``seconds`` (frames,) that
        `act` took for the batch.

    Raises:
        UserCodeError: If the policy raises, or returns something else than allowed states.
    """
    base: Any = envs.unwrapped
    with errors_of(name, "reset"):
        policy.reset(envs.num_envs, seed=batch.seed)
    observations, info, masks = batch.observations, batch.info, batch.action_masks
    start = np.array(info["state"], dtype=np.int64)
    states, means, codes, high, low, seconds = [], [], [], [], [], []
    for frame in range(frames):
        extra: dict[str, Any] = {}
        if getattr(policy, "privileged", False):
            extra = {"info": info if oracle is None else {**info, **_told(base, oracle, frame)}}
        begin = time.perf_counter()
        with errors_of(name, "act"):
            actions = policy.act(observations, masks, **extra)
        seconds.append(time.perf_counter() - begin)
        observations, _, _, _, info = envs.step(checked_states(name, actions, masks))
        masks = action_masks(envs)  # the next frame of a sequence is another scene
        states.append(np.array(info["state"], dtype=np.int64))  # with a delay, an older choice
        means.append(linear_signal(observations["raw"], base.camera).mean(axis=(1, 2, 3)))
        companded = signal_codes(observations["raw"], base.camera)
        codes.append(companded.mean(axis=(1, 2, 3), dtype=np.float64) / 255.0)
        high.append(np.array(info["clipped_high"], dtype=np.float64))
        low.append(np.array(info["clipped_low"], dtype=np.float64))
    return {
        "states": np.stack(states, axis=1)[batch.valid],
        "image_mean": np.stack(means, axis=1)[batch.valid],
        "code_mean": np.stack(codes, axis=1)[batch.valid],
        "clipped_high": np.stack(high, axis=1)[batch.valid],
        "clipped_low": np.stack(low, axis=1)[batch.valid],
        "start_states": start[batch.valid],
        "seconds": np.array(seconds),
    }


def _told(base: Any, oracle: NDArray[np.int64], frame: int) -> dict[str, NDArray[np.int64]]:
    """What `info` tells oracles in `frame`: the best states of it, and of what they decide on."""
    last = oracle.shape[1] - 1
    decided = (oracle[:, min(frame + 1 + delay, last)] for delay in base.delays)
    return {"oracle_state": oracle[:, frame], "clairvoyant_state": base.grid.mixed(*decided)}


def milliseconds_alone(
    name: str,
    policy: Policy,
    envs: VectorEnv,
    episodes: Episodes,
    oracle: NDArray[np.int64] | None = None,
) -> float:
    """Median time in `act` for one camera alone [ms].

    Args:
        name: The policy's name in errors.
        policy: The policy.
        envs: One environment, of `TIMED_FRAMES` or more.
        episodes: The episode.
        oracle: (1, T) best state of every frame, for a privileged policy; the last one stays.
    """
    if oracle is not None:
        last = np.repeat(oracle[:, -1:], TIMED_FRAMES, axis=1)
        oracle = np.concatenate([oracle, last], axis=1)
    batch = next(episodes.batches(envs))
    found = run_batch(name, policy, envs, batch, TIMED_FRAMES, oracle=oracle)
    return 1000.0 * float(np.median(found["seconds"][_WARM_UP:]))


def check_captures(name: str, policy: Policy) -> float:
    """`captures_per_decision` of a policy.

    Raises:
        ValueError: Unless it is a number.
    """
    captures = getattr(policy, "captures_per_decision", 1.0)
    return check_number(f"captures_per_decision` of policy `{name}", captures, 0.0, 1e9)


def other_scores(result: EvaluationResult, plan: EvaluationPlan) -> dict[str, dict[str, float]]:
    """Mean expected score of the states that each policy chose, by scorer and policy.

    Of some scenes of the first seed, all starts and frames; averaged over frames, then training
    seeds, episodes of a source group, and source groups.

    Args:
        result: The results in unchanging light.
        plan: The plan, with the names of the scorers.
    """
    pairs = len(result.scene_ids) // len(plan.starts)  # of scenes and seeds
    count = pairs // len(plan.seeds)
    scenes = list(result.scenes[:count])  # scenes change fastest, the first seed comes first
    chosen = groups_in_turn(scenes, plan.other_scorer_scenes)
    options = plan.options()
    found: dict[str, dict[str, float]] = {}
    for name in plan.other_scorers:
        tables = ScoreTables(
            options.make_grid(),
            options.make_camera(),
            make_scorer(name),
            noise=bool(options.noise),
            tolerance=options.tolerance,
        )
        means: dict[str, dict[str, list[float]]] = {policy: {} for policy in result.tracks}
        for scene in chosen:
            j = scenes.index(scene)
            episodes = np.flatnonzero(np.arange(len(result.scene_ids)) % pairs == j)
            scores = tables.table(scene, **result.moves(j)).mean
            for policy, track in result.tracks.items():
                mean = float(scores[track.states[:, episodes]].mean())
                means[policy].setdefault(scene.group, []).append(mean)
        found[name] = {
            policy: float(np.mean([np.mean(values) for values in groups.values()]))
            for policy, groups in means.items()
        }
    return found


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
        episodes = Episodes(self.scenes, own.seeds[:count], own.scene[:count], [0] * count)
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
