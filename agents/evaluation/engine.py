"""The evaluation engine: score tables once per light, every policy on the same episodes.

`evaluate` runs policies that the caller has made; `agents.evaluation.jobs` makes the policies of a
plan by their names, stores every finished part, and shares the work between processes.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import astuple, dataclass, replace
from functools import partial
from typing import Any, Self

import gymnasium as gym
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ae_env.observation import linear_signal
from ae_env.options import EnvOptions
from ae_env.scenes import Scene
from ae_env.scorers import make_scorer
from ae_env.scorers.score_table import TIE, ScoreTables
from agents import rollouts
from agents.bracketing.policies import run_brackets
from agents.evaluation.evaluation_plan import (
    CONDITION_ARGUMENTS,
    MAX_SEED,
    SEED_STRIDE,
    Condition,
    EvaluationPlan,
    groups_in_turn,
    light_name,
    plan_episodes,
    plan_scenes,
)
from agents.evaluation.result import BRACKET_METRICS, EvaluationResult, Track
from agents.metering.metering_policy import MeteringPolicy
from agents.metering.reading import signal_codes
from agents.policy import Ints, Policy, PolicyContext, VectorEnv
from agents.policy_names import make_policy, training_seeds
from simulator.settings import CameraSettings
from simulator.utils.checks import check_integer, check_number

Arrays = dict[str, NDArray[Any]]
#: Called with work done, work in all, and what is being done.
Progress = Callable[[int, int, str], None]
#: Called with frames done since the last call.
Report = Callable[[float], None]

#: Episodes at a time, at most; of brackets.
BATCH, BRACKET_BATCH = 64, 32
#: Frames in which the time of one camera's decision is measured, the first ones to warm up.
TIMED_FRAMES, _WARM_UP = 28, 4
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

    Scores are always the expected scores q, whatever the environment's reward. A `UserCodeError` if
    a policy raises (the cause is chained), or returns no allowed states.

    Args:
        policies: By name in the tables; a list holds the same agent from several training seeds.
        env_options: Arguments of ``ae_env/AutoExposure-v0``, such as
            ``{"scenes": "bundled", "split": "test", "resolution": 64}``.
        episodes_per_scene: Episodes of each scene, each with its own start, motion and defocus:
            those of the seeds `seed`, `seed` + 1 and so on.
        frames: Actions per episode; a frame is counted after each.
        batch: Episodes at a time, at most.
        other_scorers: Names of scorers that no policy was trained on; states that were chosen in
            some of the scenes are also rated by these.
        progress: Called with frames done, frames in all, and the name of the policy.
    """
    check_integer("episodes_per_scene", episodes_per_scene, 1)
    check_integer("frames", frames, 1)
    check_integer("batch", batch, 1)
    check_integer("seed", seed, 0, MAX_SEED + 1 - episodes_per_scene)
    trained = [
        (TrainedPolicy(name, name, k), policy)
        for name, entry in policies.items()
        for k, policy in enumerate(entry if isinstance(entry, Sequence) else [entry])
    ]
    if not trained:
        raise ValueError(f"`policies` (={policies!r}) must hold at least one policy")
    for one, policy in trained:
        check_captures(one.name, policy)
    check_scorers(other_scorers)
    plan = _plan_of(env_options, frames, range(seed, seed + episodes_per_scene), other_scorers)
    run = EvaluationRun(plan, batch=batch)
    (condition,) = plan.all_conditions.values()
    total = frames * (run.num_tables + len(trained) * len(run.episodes))
    done = 0.0

    def report(name: str, count: float) -> None:
        nonlocal done
        done += count
        if progress is not None:
            progress(int(done), total, name)

    with run:
        light = run.score_light(condition, partial(report, "score tables"))
        tracks = {
            one: run.run_policy(one.name, policy, condition, light, partial(report, one.name))
            for one, policy in trained
        }
    result = run.result(condition, light, tracks)
    return replace(result, other_scores=other_scores(result))


def check_scorers(names: Sequence[str]) -> None:
    """Raises a `ValueError` where one of the scorers is unknown."""
    for name in names:
        try:
            make_scorer(name)
        except ValueError as error:
            raise ValueError(f"`other_scorers` (={name!r}): {error}") from error


def _plan_of(
    env_options: Mapping[str, Any], frames: int, seeds: Sequence[int], scorers: Sequence[str]
) -> EvaluationPlan:
    given = {k: v for k, v in env_options.items() if k not in ("with_oracle", "autoreset_mode")}
    options = EnvOptions.from_kwargs(given)  # its errors name the argument
    delay = dict(options.delay) if isinstance(options.delay, Mapping) else options.delay
    environment = {k: v for k, v in given.items() if k not in CONDITION_ARGUMENTS}
    scenes = options.scenes if isinstance(options.scenes, str) else "given scenes"
    condition = Condition(lighting=options.lighting, delay=delay)
    return EvaluationPlan(
        name=f"{scenes}, {options.split} split",
        environment={**environment, "split": options.split},
        conditions={light_name(options.lighting): condition},
        starts=("random",),
        frames=frames,
        seeds=tuple(seeds),
        other_scorers=tuple(scorers),
    )


@dataclass(frozen=True)
class TrainedPolicy:
    """One training seed of a policy: its name in the tables, and that for `agents.make_policy`."""

    policy: str
    name: str
    index: int = 0


class EvaluationRun:
    """A plan with its scenes, loaded by default, and episodes; closes its environments at the end.

    `device` is that of a learnt agent's network, `batch` the most episodes of frames at a time.
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

    @property
    def num_tables(self) -> int:
        """Number of episodes that differ in more than their start; 0 where none are scored."""
        return 0 if self.plan.budgets else len(self.episodes) // len(self.plan.starts)

    @property
    def trained(self) -> list[TrainedPolicy]:
        """Every training seed of every policy of the plan."""
        return [
            TrainedPolicy(policy, name, k)
            for policy in self.plan.policies
            for k, name in enumerate(training_seeds(policy))
        ]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for envs in self._envs.values():
            envs.close()
        self._envs.clear()

    def _open(self, make: Callable[..., VectorEnv], *key: Any, **arguments: Any) -> VectorEnv:
        """Environments that `make` makes with `arguments`, or those that are open under `key`.

        A key begins with the condition, whose environments stay open until those of another are
        needed, or with None for those that stay to the end.
        """
        for other in list(self._envs):
            if key[0] is not None and other[0] not in (None, key[0]):
                self._envs.pop(other).close()
        if key not in self._envs:
            self._envs[key] = make(**arguments)
        return self._envs[key]

    def _make_envs(
        self, condition: Condition, num_envs: int, frames: int, *, scored: bool = False
    ) -> VectorEnv:
        """Environments of a condition of frames; policies see those without the plan's scorer."""
        unused = ("costs",) if scored else ("costs", "reward")
        options = {k: v for k, v in self.plan.arguments(condition).items() if k not in unused}
        options |= {"delay": 0} if scored else {"scorer": _CHEAP}
        if not self.plan.options().in_sequences:  # those must know that they are sequences
            options["scenes"] = self.scenes
        key = repr(condition), num_envs, frames, scored
        return self._open(
            rollouts.make_envs, *key, env_options=options, num_envs=num_envs, frames=frames
        )

    def _make_brackets(self, condition: Condition, *, fit: bool = False) -> VectorEnv:
        """Environments of a budget; with `fit` of its training scenes."""
        options = {"split": "train"} if fit else {"split": "all", "scenes": self.scenes}
        limits = {"budget": condition.budget, "max_frames": self.plan.max_frames}
        arguments = {**self.plan.environment, **options, **limits, "autoreset_mode": "DISABLED"}
        make, key = partial(gym.make_vec, self.plan.env_id), (repr(condition), options["split"])
        return self._open(make, *key, num_envs=BRACKET_BATCH, **arguments)

    def score_light(self, condition: Condition, report: Report) -> Arrays:
        """q of every state in every frame of the light of `condition`, whatever the start.

        ``scores`` and ``allowed`` (J, T + 1, S) have the reset frame first; ``speed`` and
        ``defocus`` (J,) and ``movement`` (J, 4) are those that the episodes drew.
        """
        count, frames, own = self.num_tables, self.plan.frames, self.episodes
        episodes = rollouts.RolloutPlan(
            self.scenes, own.seeds[:count], own.scene[:count], [0] * count
        )
        envs = self._make_envs(condition, batch_size(count, self.batch), frames, scored=True)
        base: Any = envs.unwrapped
        scores, allowed, drawn = [], [], []
        for batch in episodes.batches(envs):
            tables, masks = [rollouts.expected_scores(envs)], [batch.action_masks]
            for _ in range(frames):
                envs.step(np.zeros(envs.num_envs, np.int64))
                tables.append(rollouts.expected_scores(envs))
                masks.append(rollouts.action_masks(envs))
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

    def make(self, trained: TrainedPolicy, condition: Condition) -> Policy:
        """The policy `trained`, for the camera of `condition`; not fitted."""
        if condition.budget is not None:
            envs = self._make_brackets(condition)
        else:
            envs = self._make_envs(condition, 1, TIMED_FRAMES)
        policy = make_policy(trained.name, PolicyContext.from_envs(envs), device=self.device)
        check_captures(trained.name, policy)
        return policy

    def fitted(self, trained: TrainedPolicy, condition: Condition) -> Policy:
        """The policy `trained`, fitted on training scenes: in static light, or to the budget."""
        policy = self.make(trained, condition)
        if not _learns(policy):
            return policy
        if condition.budget is not None:
            envs = self._make_brackets(condition, fit=True)
        else:  # the same in all conditions, which share score tables
            base = {k: v for k, v in self.plan.environment.items() if k != "costs"}
            base = rollouts.fitting_arguments(base, self.plan.options().resolution)
            envs = self._open(_training_envs, None, env_options=base)
        with rollouts.errors_of(trained.name, "fit"):
            policy.fit(envs, self.plan.seeds[0])
        return policy

    def run_policy(
        self, name: str, policy: Policy, condition: Condition, light: Arrays, report: Report
    ) -> Track:
        """The track of `policy`, which is fitted, through all episodes of `condition`.

        Its arrays have ``start_states`` (1, E), the states of the reset frames, besides. `name` is
        the policy's in errors; only a privileged one needs `light`, which `score_light` returns.
        """
        if condition.budget is not None:
            return self._run_brackets(name, policy, condition, report)
        oracle: Ints | None = None
        if getattr(policy, "privileged", False):
            oracle = best_states(light["scores"], light["allowed"])
        frames, episodes = self.plan.frames, self.episodes
        envs = self._make_envs(condition, batch_size(len(episodes), self.batch), frames)
        parts = []
        for batch in episodes.batches(envs):
            best = None if oracle is None else oracle[batch.episodes % self.num_tables]
            parts.append(run_batch(name, policy, envs, batch, frames, oracle=best))
            report(float(batch.valid.sum()) * frames)
        alone = None
        if condition.at_rest:
            first = replace(episodes, seeds=[0], scene=episodes.scene[:1], starts=[None])
            single = self._make_envs(condition, 1, TIMED_FRAMES)
            best = None if oracle is None else oracle[:1]
            alone = _milliseconds_alone(name, policy, single, first, best)
        seconds = sum(float(part.pop("seconds").sum()) for part in parts)
        return Track(
            {key: np.concatenate([part[key] for part in parts])[None] for key in parts[0]},
            ms_per_decision=1000.0 * seconds / (frames * len(episodes)),
            captures_per_decision=check_captures(name, policy),
            privileged=oracle is not None,
            ms_alone=alone,
        )

    def _run_brackets(
        self, name: str, policy: Policy, condition: Condition, report: Report
    ) -> Track:
        envs, runs = self._make_brackets(condition), []
        for seed in self.plan.seeds:
            runs.append(run_brackets(policy, envs, seed=seed * SEED_STRIDE, name=name))
            report(float(len(self.scenes) * self.plan.max_frames))
        arrays = {key: np.concatenate([run[key] for run in runs])[None] for key in BRACKET_METRICS}
        return Track(
            arrays | {"start_states": np.zeros(arrays["frames"].shape, np.int64)},
            ms_per_decision=1000.0 * float(arrays["seconds"].mean()),
            captures_per_decision=1.0,
            privileged=False,
        )

    def result(
        self, condition: Condition, light: Arrays, tracks: Mapping[TrainedPolicy, Track]
    ) -> EvaluationResult:
        """The results of `score_light` (nothing for brackets) and `run_policy` in `condition`."""
        scenes = [self.scenes[i] for i in self.episodes.scene]
        table = np.arange(len(scenes)) % max(self.num_tables, 1)
        known: dict[str, Any] = {name: values[table] for name, values in light.items()}
        if light:  # the reset frame does not count
            known |= {name: known[name][:, 1:] for name in ("scores", "allowed")}
        else:
            empty = np.zeros((len(scenes), 0, 0))
            known |= {"scores": empty, "allowed": empty.astype(bool)}
        of_policy: dict[str, list[Track]] = {}
        for trained, track in tracks.items():
            of_policy.setdefault(trained.policy, []).append(track)
        return EvaluationResult(
            grid=self.grid,
            scene_ids=np.array([s.scene_id for s in scenes]),
            groups=np.array([s.group for s in scenes]),
            kinds=np.array([s.kind for s in scenes]),
            hard=np.array([bool(s.hard) for s in scenes]),
            start_states=next(iter(tracks.values())).arrays["start_states"][0],
            tracks={name: Track.of_seeds(own) for name, own in of_policy.items()},
            delays=self.plan.options(condition).delays,
            plan=self.plan,
            scenes=scenes,
            **known,
        )


# -- one policy ----------------------------------------------------------------------------------


def check_policies(plan: EvaluationPlan, device: str) -> None:
    """Raises where a policy of `plan` cannot be made, before scenes that need no files are read."""
    options, reference = plan.options(), CameraSettings(100.0, 1 / 64, 8.0)
    if options.recorded is not None or options.in_sequences:  # files have the grid or the frames
        return
    light = np.full((4, options.resolution, options.resolution), 0.1, np.float32)
    grey = Scene.from_array(light, reference, options.make_camera(), scene_id="grey")
    with EvaluationRun(plan, [grey], device=device) as run:
        for trained in run.trained:
            run.make(trained, next(iter(plan.all_conditions.values())))


def fit_policies(
    policies: Mapping[str, Policy],
    env_options: Mapping[str, Any],
    *,
    seed: int = 0,
    batch: int = BATCH,
    progress: Progress | None = None,
    watch: Callable[[str], None] | None = None,
    keep: bool = False,
) -> None:
    """Call `fit` of all `policies` that have one, on the training split of an environment.

    `env_options` are its arguments, `seed` decides the episodes, of which `batch` run at a time;
    `progress` is called before and after each fit, `watch` with the policy's name before each step
    of one. With `keep`, fits of light meters are kept in the user's cache: the scenes must be named
    ones, which are always the same.
    """
    learners = [(name, policy) for name, policy in policies.items() if _learns(policy)]
    if not learners:
        return
    report = progress or (lambda *_: None)
    with closing(_training_envs(env_options, batch)) as envs:
        for i, (name, policy) in enumerate(learners):
            report(i, len(learners), name)
            watched = envs if watch is None else rollouts.WatchedEnvs(envs, partial(watch, name))
            with rollouts.errors_of(name, "fit"):
                if keep and isinstance(policy, MeteringPolicy):
                    policy.fit_once(watched, seed, env_options)
                    continue
                policy.fit(watched, seed)
    report(len(learners), len(learners), "")


def _learns(policy: Policy) -> bool:
    """Whether a policy has a `fit` of its own, and that something to learn."""
    own = getattr(type(policy), "fit", Policy.fit) is not Policy.fit
    return own and getattr(policy, "learns", True)


def _training_envs(env_options: Mapping[str, Any], batch: int = BATCH) -> VectorEnv:
    return rollouts.make_envs({**env_options, "split": "train"}, num_envs=batch, frames=16)


def run_batch(
    name: str,
    policy: Policy,
    envs: VectorEnv,
    batch: rollouts.EpisodeBatch,
    frames: int,
    *,
    oracle: Ints | None = None,
) -> Arrays:
    """Run one policy over one batch of episodes, which `envs` are freshly reset to.

    A privileged policy's ``info`` gets `oracle`, (N, frames + 1), the best state of every frame,
    the reset frame first. Returned are the arrays of a `Track` without their leading axis, of the
    valid episodes, their ``start_states`` (n,), and ``seconds`` (frames,) that `act` took.
    """
    base: Any = envs.unwrapped
    with rollouts.errors_of(name, "reset"):
        policy.reset(envs.num_envs, seed=batch.seed)
    observations, info, masks = batch.observations, batch.info, batch.action_masks
    start = np.array(info["state"], dtype=np.int64)[batch.valid]
    seen: list[Arrays] = []
    seconds = []
    for frame in range(frames):
        told = info if oracle is None else {**info, **_oracle_info(base, oracle, frame)}
        begin = time.perf_counter()
        actions = rollouts.choose(name, policy, observations, masks, told)
        seconds.append(time.perf_counter() - begin)
        observations, _, _, _, info = envs.step(rollouts.checked_states(name, actions, masks))
        masks = rollouts.action_masks(envs)  # the next frame of a sequence is another scene
        codes = signal_codes(observations["raw"], base.camera)
        shown = {
            "states": np.array(info["state"], dtype=np.int64),  # with a delay, an older choice
            "image_mean": linear_signal(observations["raw"], base.camera).mean(axis=(1, 2, 3)),
            "code_mean": codes.mean(axis=(1, 2, 3), dtype=np.float64) / 255.0,
            "clipped_high": np.array(info["clipped_high"], dtype=np.float64),
            "clipped_low": np.array(info["clipped_low"], dtype=np.float64),
        }
        seen.append({key: values[batch.valid] for key, values in shown.items()})
    return {
        **{key: np.stack([frame[key] for frame in seen], axis=1) for key in seen[0]},
        "start_states": start,
        "seconds": np.array(seconds),
    }


def _oracle_info(base: Any, oracle: Ints, frame: int) -> dict[str, Ints]:
    """Entries of `info` for oracles: best states of `frame`, and of the one they decide on."""
    last = oracle.shape[1] - 1
    decided = (oracle[:, min(frame + 1 + delay, last)] for delay in base.delays)
    return {"oracle_state": oracle[:, frame], "clairvoyant_state": base.grid.mixed(*decided)}


def _milliseconds_alone(
    name: str, policy: Policy, envs: VectorEnv, episodes: rollouts.RolloutPlan, oracle: Ints | None
) -> float:
    """Median time in `act` for one camera alone [ms]; the last (1, T) state of `oracle` stays."""
    if oracle is not None:
        last = np.repeat(oracle[:, -1:], TIMED_FRAMES, axis=1)
        oracle = np.concatenate([oracle, last], axis=1)
    found = run_batch(name, policy, envs, next(episodes.batches(envs)), TIMED_FRAMES, oracle=oracle)
    return 1000.0 * float(np.median(found["seconds"][_WARM_UP:]))


def check_captures(name: str, policy: Policy) -> float:
    """`captures_per_decision` of a policy; a `ValueError` unless it is a number."""
    captures = getattr(policy, "captures_per_decision", 1.0)
    return check_number(f"captures_per_decision` of policy `{name}", captures, 0.0, 1e9)


def other_scores(result: EvaluationResult) -> dict[str, dict[str, float]]:
    """Mean expected score of the states that each policy chose, by scorer and policy.

    Of some scenes of the first seed of `result`, in unchanging light, all starts and frames;
    averaged over frames, then training seeds, episodes of a source group, and source groups.
    """
    plan = result.plan
    pairs = len(result.scene_ids) // len(plan.starts)  # of scenes and seeds
    count = pairs // len(plan.seeds)
    scenes = list(result.scenes[:count])  # scenes change fastest, the first seed comes first
    options = plan.options()
    known = options.make_grid(), options.make_camera()
    more: dict[str, Any] = {"noise": bool(options.noise), "tolerance": options.tolerance}
    rows = []
    for name in plan.other_scorers:
        tables = ScoreTables(*known, make_scorer(name), **more)
        for scene in groups_in_turn(scenes, plan.other_scorer_scenes):
            j = scenes.index(scene)
            scores = tables.table(scene, **result.moves(j)).mean
            for policy, track in result.tracks.items():
                rows.append((name, policy, scene.group, scores[track.states[:, j::pairs]].mean()))
    frame = pd.DataFrame(rows, columns=["scorer", "policy", "group", "score"])
    groups = frame.groupby(["scorer", "policy", "group"], sort=False).score.mean()
    means = groups.groupby(["scorer", "policy"], sort=False).mean()
    return {name: means[name].to_dict() for name in plan.other_scorers}


def best_states(scores: NDArray[np.float64], allowed: NDArray[np.bool_]) -> Ints:
    """The oracle's states: the best allowed one, ties to the lower ISO, ``(...)``.

    >>> int(best_states(np.array([0.5, 0.9, 0.9]), np.array([True, False, True])))
    2
    """
    known = np.where(allowed, scores, -np.inf)
    return np.argmax(known >= known.max(axis=-1, keepdims=True) - TIE, axis=-1)


def batch_size(count: int, most: int = BATCH) -> int:
    """Size of equal batches of at most `most`.

    >>> batch_size(60), batch_size(120), batch_size(130)
    (60, 60, 44)
    """
    batches = -(-count // most)
    return -(-count // batches)
