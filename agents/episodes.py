"""Episodes for fitting and evaluation: the same for every policy, whatever the batch size."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from agents.policy import Observations

if TYPE_CHECKING:
    from ae_env.scenes import Scene

ENV_ID = "ae_env/AutoExposure-v0"

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def make_envs(
    env_options: Mapping[str, Any], *, num_envs: int, frames: int, with_oracle: bool = False
) -> gym.vector.VectorEnv:
    """Environments for `evaluate` and `fit_policies`: no autoreset, episodes of `frames` and more.

    Args:
        env_options: Arguments of the environment, such as ``{"split": "test"}``.
        num_envs: Episodes at a time.
        frames: Actions that an episode must allow.
        with_oracle: Whether `info` holds ``oracle_state``.
    """
    import ae_env  # noqa: F401  (registers the environment)

    options = {**env_options, "with_oracle": with_oracle, "autoreset_mode": "DISABLED"}
    # One frame more than is used: the episode must not end inside the evaluation.
    return gym.make_vec(ENV_ID, num_envs=num_envs, max_episode_steps=frames + 1, **options)


def scenes_of(envs: gym.vector.VectorEnv) -> list[Scene]:
    """The scenes that the episodes of `envs` draw from."""
    base: Any = envs.unwrapped
    return list(base.scenes)


def expected_scores(envs: gym.vector.VectorEnv) -> Floats:
    """q of every state in the current frame of each episode, ``(N, S)``."""
    base: Any = envs.unwrapped
    return np.array(base.expected_scores(), dtype=np.float64)


@dataclass(frozen=True)
class EpisodeBatch:
    """One batch of freshly reset episodes.

    Args:
        observations: Of the reset frame.
        info: Of the reset frame.
        scores: q of every state, ``(N, S)``.
        action_masks: Allowed states, ``(N, S)`` bool.
        scenes: Index of each episode's scene in ``envs.unwrapped.scenes``, ``(N,)``.
        groups: Its source group.
        valid: False for the copies that fill the last batch.
        seed: Seed of the batch's first episode.
    """

    observations: Observations
    info: Mapping[str, Any]
    scores: Floats
    action_masks: NDArray[np.bool_]
    scenes: Ints
    groups: NDArray[Any]
    valid: NDArray[np.bool_]
    seed: int


def episode_batches(
    envs: gym.vector.VectorEnv, *, episodes_per_scene: int, seed: int
) -> Iterator[EpisodeBatch]:
    """Run through all scenes of `envs`, `episodes_per_scene` times, batch by batch.

    Episode i begins with seed ``seed + i`` whatever the batch size, so its start state, motion,
    defocus and noise are those of every other run with that seed.
    """
    base: Any = envs.unwrapped
    scenes = scenes_of(envs)
    order = np.tile(np.arange(len(scenes)), episodes_per_scene)
    for begin in range(0, len(order), envs.num_envs):
        chosen = order[begin : begin + envs.num_envs]
        valid = np.arange(envs.num_envs) < len(chosen)
        chosen = np.concatenate([chosen, np.resize(chosen, envs.num_envs - len(chosen))])
        options = {"scene": [scenes[i].scene_id for i in chosen]}
        observations, info = envs.reset(seed=seed + begin, options=options)
        scores = expected_scores(envs)
        yield EpisodeBatch(
            observations=observations,
            info=info,
            scores=scores,
            action_masks=_action_masks(base, scores.shape),
            scenes=chosen,
            groups=np.array([scenes[i].group for i in chosen]),
            valid=valid,
            seed=seed + begin,
        )


def _action_masks(base: Any, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    masks = getattr(base, "action_masks", None)
    return np.ones(shape, bool) if masks is None else np.array(masks(), dtype=bool)
