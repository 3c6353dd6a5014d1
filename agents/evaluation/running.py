"""Running one policy through a batch of episodes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from ae_env.utils.checks import UserCodeError, check_number
from agents.episodes import EpisodeBatch
from agents.evaluation.result import Track
from agents.metering.meters import linear_signal
from agents.policy import Policy

Ints = NDArray[np.int64]
#: Frames in which the time of one camera's decision is measured, the first ones to warm up.
TIMED_FRAMES, _WARM_UP = 28, 4


def run_batch(
    name: str,
    policy: Policy,
    envs: gym.vector.VectorEnv,
    batch: EpisodeBatch,
    frames: int,
    *,
    oracle: Ints | None = None,
    after_frame: Callable[[], None] | None = None,
) -> dict[str, Any]:
    """Run one policy over one batch of episodes.

    Args:
        name: What errors call the policy.
        policy: It.
        envs: Freshly reset to `batch`.
        batch: What they show.
        frames: Actions.
        oracle: (N, frames + 1) best state of every frame, the reset frame first, which a privileged
            policy's ``info`` gets where the environment's has none.
        after_frame: Called after every step.

    Returns:
        ``states``, ``image_mean``, ``clipped_high`` and ``clipped_low`` (n, frames) of the valid
        episodes, ``seconds`` in `act` and the number of ``decisions``.

    Raises:
        UserCodeError: If the policy raises, or returns something else than allowed states.
    """
    base: Any = envs.unwrapped
    with named(name, "reset"):
        policy.reset(envs.num_envs, seed=batch.seed)
    observations, info = batch.observations, batch.info
    states, means, high, low = [], [], [], []
    seconds = 0.0
    for frame in range(frames):
        extra: dict[str, Any] = {}
        if getattr(policy, "privileged", False):
            extra = {"info": info if oracle is None else {**info, "oracle_state": oracle[:, frame]}}
        begin = time.perf_counter()
        with named(name, "act"):
            actions = policy.act(observations, batch.action_masks, **extra)
        seconds += time.perf_counter() - begin
        actions = _checked(name, actions, batch.action_masks)
        observations, _, _, _, info = envs.step(actions)
        states.append(np.array(info["state"], dtype=np.int64))  # with a delay, an older choice
        means.append(linear_signal(observations["raw"], base.camera).mean(axis=(1, 2, 3)))
        high.append(np.array(info["clipped_high"], dtype=np.float64))
        low.append(np.array(info["clipped_low"], dtype=np.float64))
        if after_frame is not None:
            after_frame()
    keep = batch.valid
    return {
        "states": np.stack(states, axis=1)[keep],
        "image_mean": np.stack(means, axis=1)[keep],
        "clipped_high": np.stack(high, axis=1)[keep],
        "clipped_low": np.stack(low, axis=1)[keep],
        "seconds": seconds,
        "decisions": frames * len(keep),
    }


def milliseconds_alone(
    name: str, policy: Policy, envs: gym.vector.VectorEnv, oracle: Ints | None = None
) -> float:
    """Median time in `act` for one camera alone [ms].

    Args:
        name: What errors call the policy.
        policy: It.
        envs: One environment, of `TIMED_FRAMES` or more.
        oracle: (T,) best state of every frame, for a privileged policy.
    """
    observations, info = envs.reset(seed=0)
    base: Any = envs.unwrapped
    masks = np.array(base.action_masks(), dtype=np.bool_)
    times = []
    with named(name, "reset"):
        policy.reset(1, seed=0)
    for frame in range(TIMED_FRAMES):
        extra: dict[str, Any] = {}
        if getattr(policy, "privileged", False):
            best = 0 if oracle is None else oracle[min(frame, len(oracle) - 1)]
            extra = {"info": {**info, "oracle_state": np.array([best])}}
        begin = time.perf_counter()
        with named(name, "act"):
            actions = policy.act(observations, masks, **extra)
        times.append(time.perf_counter() - begin)
        observations, _, _, _, info = envs.step(_checked(name, actions, masks))
    return 1000.0 * float(np.median(times[_WARM_UP:]))


@contextmanager
def named(policy: str, method: str) -> Iterator[None]:
    """What a policy raises then names the policy, which may be the user's own."""
    try:
        yield
    except Exception as error:
        text = f"policy {policy!r}: `{method}` raised {type(error).__name__}: {error}"
        raise UserCodeError(text) from error


def check_captures(name: str, policy: Policy) -> float:
    """`captures_per_decision` of a policy.

    Raises:
        ValueError: Unless it is a number.
    """
    captures = getattr(policy, "captures_per_decision", 1.0)
    return check_number(f"captures_per_decision` of policy `{name}", captures, 0.0, 1e9)


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


def concatenate_parts(parts: list[dict[str, Any]], policy: Policy) -> Track:
    """What one policy did in all batches, from what `run_batch` returns."""
    arrays: dict[str, Any] = {
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


def stack_seeds(tracks: dict[tuple[str, int], Track]) -> dict[str, Track]:
    """Join the training seeds of each policy."""
    result = {}
    for name in dict.fromkeys(name for name, _ in tracks):
        own = [track for (other, _), track in tracks.items() if other == name]
        alone = [t.ms_alone for t in own if t.ms_alone is not None]
        result[name] = Track(
            states=np.concatenate([t.states for t in own]),
            image_mean=np.concatenate([t.image_mean for t in own]),
            clipped_high=np.concatenate([t.clipped_high for t in own]),
            clipped_low=np.concatenate([t.clipped_low for t in own]),
            ms_per_decision=float(np.mean([t.ms_per_decision for t in own])),
            captures_per_decision=own[0].captures_per_decision,
            privileged=own[0].privileged,
            ms_alone=float(np.mean(alone)) if alone else None,
        )
    return result
