"""The evaluation protocol: every policy sees exactly the same episodes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from ae_env.checks import UserCodeError, check_integer, check_number
from agents.episodes import EpisodeBatch, episode_batches, expected_scores, make_envs
from agents.evaluation_result import EvaluationResult, Track
from agents.metering import linear_signal
from agents.policy import Policy

if TYPE_CHECKING:
    from ae_env.grid import ExposureGrid

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
#: Called with frames done, frames in all, and what is being done.
Progress = Callable[[int, int, str], None]


def fit_policies(
    policies: Mapping[str, Policy],
    env_options: Mapping[str, Any],
    *,
    seed: int = 0,
    batch: int = 64,
    progress: Progress | None = None,
) -> None:
    """Call `fit` of every policy that has one, on the training split.

    Args:
        policies: By name; changed in place.
        env_options: Arguments of the environment; `split` is set to ``"train"``.
        seed: Decides the training episodes.
        batch: Episodes at a time.
        progress: Called before and after each fit.
    """
    learners = {n: p for n, p in policies.items() if getattr(type(p), "fit", None)}
    learners = {n: p for n, p in learners.items() if type(p).fit is not Policy.fit}
    if not learners:
        return
    envs = make_envs({**env_options, "split": "train"}, num_envs=batch, frames=16)
    try:
        for i, (name, policy) in enumerate(learners.items()):
            if progress is not None:
                progress(i, len(learners), name)
            with _named(name, "fit"):
                policy.fit(envs, seed)
        if progress is not None:
            progress(len(learners), len(learners), "")
    finally:
        envs.close()


def evaluate(
    policies: Mapping[str, Policy | Sequence[Policy]],
    env_options: Mapping[str, Any],
    *,
    episodes_per_scene: int = 1,
    frames: int = 8,
    seed: int = 0,
    batch: int = 64,
    progress: Progress | None = None,
) -> EvaluationResult:
    """Run every policy over the same episodes and record what it did.

    The reset frame does not count; frames are counted after each action. Scores are always the
    expected scores q, whatever the environment's reward.

    Args:
        policies: By name in the tables; a list holds the same agent from several training seeds.
        env_options: Arguments of ``ae_env/AutoExposure-v0``, such as
            ``{"scenes": "bundled", "split": "test", "resolution": 64}``.
        episodes_per_scene: Episodes of each scene, each with its own start, motion and defocus.
        frames: Actions per episode.
        seed: Seed of the first episode.
        batch: Episodes at a time.
        progress: Called with frames done and frames in all.

    Raises:
        ValueError: If an argument is out of range.
        UserCodeError: If a policy raises (the cause is chained), or returns something else than
            allowed states.
    """
    check_integer("episodes_per_scene", episodes_per_scene, 1)
    check_integer("frames", frames, 1)
    check_integer("batch", batch, 1)
    check_integer("seed", seed, 0)
    runs = [
        (name, k, policy)
        for name, entry in policies.items()
        for k, policy in enumerate(entry if isinstance(entry, Sequence) else [entry])
    ]
    if not runs:
        raise ValueError(f"`policies` (={policies!r}) must hold at least one policy")
    for name, _, policy in runs:
        captures = getattr(policy, "captures_per_decision", 1.0)
        check_number(f"captures_per_decision` of policy `{name}", captures, 0.0, 1e9)
    privileged = any(getattr(policy, "privileged", False) for _, _, policy in runs)
    envs = make_envs(env_options, num_envs=batch, frames=frames, with_oracle=privileged)
    try:
        base: Any = envs.unwrapped
        total = len(runs) * len(base.scenes) * episodes_per_scene * frames
        done, tracks = 0, {}
        recorder = _Recorder(base.grid, int(env_options.get("delay", 0)))
        for name, k, policy in runs:
            parts = []
            for b in episode_batches(envs, episodes_per_scene=episodes_per_scene, seed=seed):
                parts.append(_run_batch(name, policy, envs, b, frames, recorder))
                done += int(b.valid.sum()) * frames
                if progress is not None:
                    progress(done, total, name)
            tracks[name, k] = _concatenate(parts, policy)
            recorder.close()
        return recorder.result(base.scenes, _stack(tracks), seed)
    finally:
        envs.close()


class _Recorder:
    """Collects what belongs to the episodes; checks that every policy gets the same ones."""

    def __init__(self, grid: ExposureGrid, delay: int) -> None:
        self.grid, self.delay = grid, delay
        self.first_run = True
        self.batches: dict[int, tuple[EpisodeBatch, Ints, Floats]] = {}

    def close(self) -> None:
        """Ends the first policy's run: from here on the episodes are known."""
        self.first_run = False

    def begin(self, batch: EpisodeBatch) -> None:
        """Checks that the episodes of `batch` are those of the first policy."""
        if self.first_run:
            return
        known, start, _ = self.batches[batch.seed]
        same = np.array_equal(known.scores, batch.scores)
        if not same or not np.array_equal(start, batch.info["state"]):
            raise RuntimeError(
                f"the episodes of seed {batch.seed} differ between two resets: the environment "
                "must be a function of its seed"
            )

    def end(self, batch: EpisodeBatch, scores: Floats) -> None:
        """Keeps the episodes of `batch` with their scores in every frame."""
        start = np.array(batch.info["state"], dtype=np.int64)
        self.batches[batch.seed] = (batch, start, scores)

    def result(self, scenes: Any, tracks: dict[str, Track], seed: int) -> EvaluationResult:
        """Everything recorded, with what the policies did."""
        parts = list(self.batches.values())
        valid = np.concatenate([b.valid for b, _, _ in parts])
        index = np.concatenate([b.scenes for b, _, _ in parts])[valid]
        return EvaluationResult(
            grid=self.grid,
            scene_ids=np.array([scenes[i].scene_id for i in index]),
            groups=np.array([scenes[i].group for i in index]),
            kinds=np.array([scenes[i].kind for i in index]),
            hard=np.array([bool(scenes[i].hard) for i in index]),
            start_states=np.concatenate([s for _, s, _ in parts])[valid],
            scores=np.concatenate([q for _, _, q in parts])[valid],
            allowed=np.concatenate([b.action_masks for b, _, _ in parts])[valid],
            tracks=tracks,
            seed=seed,
            delay=self.delay,
        )


def _run_batch(
    name: str,
    policy: Policy,
    envs: gym.vector.VectorEnv,
    batch: EpisodeBatch,
    frames: int,
    recorder: _Recorder,
) -> dict[str, Any]:
    """Run one policy over one batch of episodes."""
    recorder.begin(batch)
    base: Any = envs.unwrapped
    with _named(name, "reset"):
        policy.reset(envs.num_envs, seed=batch.seed)
    observations, info = batch.observations, batch.info
    states, means, high, low, scores = [], [], [], [], []
    seconds = 0.0
    for _ in range(frames):
        extra: dict[str, Any] = {"info": info} if getattr(policy, "privileged", False) else {}
        begin = time.perf_counter()
        with _named(name, "act"):
            actions = policy.act(observations, batch.action_masks, **extra)
        seconds += time.perf_counter() - begin
        actions = _checked(name, actions, batch.action_masks)
        observations, _, _, _, info = envs.step(actions)
        states.append(np.array(info["state"], dtype=np.int64))  # with a delay, an older choice
        means.append(linear_signal(observations["raw"], base.camera).mean(axis=(1, 2, 3)))
        high.append(np.array(info["clipped_high"], dtype=np.float64))
        low.append(np.array(info["clipped_low"], dtype=np.float64))
        if recorder.first_run:
            scores.append(expected_scores(envs))
    if recorder.first_run:
        recorder.end(batch, np.stack(scores, axis=1))
    keep = batch.valid
    return {
        "states": np.stack(states, axis=1)[keep],
        "image_mean": np.stack(means, axis=1)[keep],
        "clipped_high": np.stack(high, axis=1)[keep],
        "clipped_low": np.stack(low, axis=1)[keep],
        "seconds": seconds,
        "decisions": frames * len(keep),
    }


@contextmanager
def _named(policy: str, method: str) -> Iterator[None]:
    """What a policy raises then names the policy, which may be the user's own."""
    try:
        yield
    except Exception as error:
        text = f"policy {policy!r}: `{method}` raised {type(error).__name__}: {error}"
        raise UserCodeError(text) from error


def _checked(name: str, actions: Any, masks: NDArray[np.bool_]) -> Ints:
    """The policy's actions as int64, or an error that says what is wrong with them."""
    try:
        array = np.asarray(actions)
    except Exception:  # rows of different lengths, a tensor of a GPU
        array = np.empty(0, object)
    if array.shape != masks.shape[:1] or not np.issubdtype(array.dtype, np.integer):
        raise UserCodeError(
            f"policy {name!r}: `act` must return {masks.shape[0]} integers, one per camera, not "
            f"{type(actions).__name__} of shape {array.shape} and dtype {array.dtype}"
        )
    outside = (array < 0) | (array >= masks.shape[1])
    if outside.any():
        raise UserCodeError(
            f"policy {name!r}: state {array[outside][0]} is not in [0, {masks.shape[1]})"
        )
    forbidden = ~np.take_along_axis(masks, array[:, None], axis=1)[:, 0]
    if forbidden.any():
        raise UserCodeError(f"policy {name!r}: state {array[forbidden][0]} is masked in this scene")
    return array.astype(np.int64)


def _concatenate(parts: list[dict[str, Any]], policy: Policy) -> Track:
    arrays = {
        key: np.concatenate([p[key] for p in parts])[None]
        for key in ("states", "image_mean", "clipped_high", "clipped_low")
    }
    seconds, decisions = (sum(p[key] for p in parts) for key in ("seconds", "decisions"))
    return Track(
        **arrays,
        ms_per_decision=1000.0 * seconds / decisions,
        captures_per_decision=float(getattr(policy, "captures_per_decision", 1.0)),
        privileged=bool(getattr(policy, "privileged", False)),
    )


def _stack(tracks: dict[tuple[str, int], Track]) -> dict[str, Track]:
    """Join the training seeds of each policy."""
    result = {}
    for name in dict.fromkeys(name for name, _ in tracks):
        own = [track for (other, _), track in tracks.items() if other == name]
        result[name] = Track(
            states=np.concatenate([t.states for t in own]),
            image_mean=np.concatenate([t.image_mean for t in own]),
            clipped_high=np.concatenate([t.clipped_high for t in own]),
            clipped_low=np.concatenate([t.clipped_low for t in own]),
            ms_per_decision=float(np.mean([t.ms_per_decision for t in own])),
            captures_per_decision=own[0].captures_per_decision,
            privileged=own[0].privileged,
        )
    return result
