"""The evaluation protocol: every policy sees exactly the same episodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ae_env.utils.checks import check_integer
from agents.episodes import EpisodeBatch, episode_batches, expected_scores, make_envs
from agents.evaluation.result import EvaluationResult, Track
from agents.evaluation.running import (
    check_captures,
    concatenate_parts,
    named,
    run_batch,
    stack_seeds,
)
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
            with named(name, "fit"):
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
        check_captures(name, policy)
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
                parts.append(recorder.run(name, policy, envs, b, frames))
                done += int(b.valid.sum()) * frames
                if progress is not None:
                    progress(done, total, name)
            tracks[name, k] = concatenate_parts(parts, policy)
            recorder.close()
        return recorder.result(base.scenes, stack_seeds(tracks), seed)
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

    def run(
        self, name: str, policy: Policy, envs: Any, batch: EpisodeBatch, frames: int
    ) -> dict[str, Any]:
        """Runs one policy over one batch of episodes; see `run_batch`."""
        self._begin(batch)
        if not self.first_run:
            return run_batch(name, policy, envs, batch, frames)
        scores: list[Floats] = []
        found = run_batch(
            name,
            policy,
            envs,
            batch,
            frames,
            after_frame=lambda: scores.append(expected_scores(envs)),
        )
        self._end(batch, np.stack(scores, axis=1))
        return found

    def _begin(self, batch: EpisodeBatch) -> None:
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

    def _end(self, batch: EpisodeBatch, scores: Floats) -> None:
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
