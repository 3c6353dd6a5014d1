"""One policy at a time: fitted on training scenes, and run through a batch of episodes."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from agents.metering.reading import linear_signal, signal_codes
from agents.policy import Policy
from agents.rollouts import (
    EpisodeBatch,
    RolloutPlan,
    action_masks,
    checked_states,
    errors_of,
    make_envs,
)
from simulator.utils.checks import check_number

Ints = NDArray[np.int64]
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
    oracle: Ints | None = None,
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


def _told(base: Any, oracle: Ints, frame: int) -> dict[str, Ints]:
    """What `info` tells oracles in `frame`: the best states of it, and of what they decide on."""
    last = oracle.shape[1] - 1
    decided = (oracle[:, min(frame + 1 + delay, last)] for delay in base.delays)
    return {"oracle_state": oracle[:, frame], "clairvoyant_state": base.grid.mixed(*decided)}


def milliseconds_alone(
    name: str, policy: Policy, envs: VectorEnv, episodes: RolloutPlan, oracle: Ints | None = None
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
