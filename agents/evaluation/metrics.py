"""The metrics of a policy: pure functions of scores, states and exposure values.

Axes: ``S`` states of the grid, ``T`` frames of an episode, ``E`` episodes; leading axes broadcast.
`scores` and `allowed`, the action masks, are ``(..., T, S)``; `states` ``(..., T)``; `ev100`
``(S,)``; `evs`, EV100 of the start state and after each action, ``(..., T + 1)``. All scores are
expected scores q, never those of one noisy capture.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.metering.programs import SAME_EV
from agents.policy import Bools, Floats, Ints

#: A state counts as right if its q is this near to the best.
NEAR_BEST = 0.01
#: A third of a stop, with room for the rounding of f-numbers.
THIRD_EV = 1.0 / 3.0 + 1e-6
#: Light that rests for fewer frames at the end of an episode is not waited for.
MIN_REST = 4


def score_of(scores: Floats, states: Ints) -> Floats:
    """q of the chosen states, ``(..., T)``; leading axes broadcast.

    >>> score_of(np.array([[0.1, 0.9], [0.3, 0.2]]), np.array([1, 0])).tolist()
    [0.9, 0.3]
    """
    shape = np.broadcast_shapes(scores.shape[:-1], states.shape)
    table = np.broadcast_to(scores, (*shape, scores.shape[-1]))
    return np.take_along_axis(table, np.broadcast_to(states, shape)[..., None], axis=-1)[..., 0]


def oracle_score(scores: Floats, allowed: Bools) -> Floats:
    """Best q among the allowed states, ``(..., T)``."""
    return np.where(allowed, scores, -np.inf).max(axis=-1)


def random_score(scores: Floats, allowed: Bools) -> Floats:
    """Exact mean q of a uniform draw from the allowed states, ``(..., T)``.

    >>> random_score(np.array([0.0, 1.0, 0.5]), np.array([True, False, True])).tolist()
    0.25
    """
    return np.where(allowed, scores, 0.0).sum(axis=-1) / allowed.sum(axis=-1)


def regret_given_ev(scores: Floats, states: Ints, ev100: Floats, allowed: Bools) -> Floats:
    """How much better the best split of the *chosen* EV would have scored, ``(..., T)``.

    Best q among the allowed states whose EV100 is that of the chosen one (within 1/6 EV), minus q
    of the chosen: what is lost between ISO, shutter and aperture, not through the brightness.
    """
    same = np.abs(ev100 - ev100[states][..., None]) < SAME_EV
    return oracle_score(scores, same & allowed) - score_of(scores, states)


def ev_error(scores: Floats, states: Ints, ev100: Floats, allowed: Bools) -> Floats:
    """Distance in EV to the nearest allowed state whose q is within 0.01 of the best, ``(..., T)``.

    Zero wherever the brightness is right, however it is split.
    """
    good = (scores >= oracle_score(scores, allowed)[..., None] - NEAR_BEST) & allowed
    return np.where(good, np.abs(ev100 - ev100[states][..., None]), np.inf).min(axis=-1)


def settling(scores: Floats) -> Ints:
    """Frame from which convergence counts: the first that a policy takes knowing the final light.

    Where the light changed and then rests to the end, that is the frame after the last change,
    which is the first that a policy has seen of the final light. 0 where the light never changes
    (the reset frame shows it), and where it rests for fewer than `MIN_REST` frames at the end.
    Scores ``(E, T, S)`` are equal while the light rests; the result is ``(E,)``.

    >>> settling(np.array([[[1.0], [1.0], [2.0], [2.0], [2.0], [2.0], [2.0]]])).tolist()
    [3]
    >>> settling(np.ones((1, 1, 64))).tolist()
    [0]
    """
    frames = scores.shape[1]
    before = np.concatenate([scores[:, :1], scores[:, :-1]], axis=1)
    changed = np.any(scores != before, axis=-1)  # (E, T)
    last = np.where(changed.any(-1), frames - 1 - np.argmax(changed[:, ::-1], axis=-1), -1)
    since = last + 1
    return np.where(frames - since >= MIN_REST, since, 0).astype(np.int64)


def frames_to_converge(
    errors: Floats, tolerance: float = THIRD_EV, since: Ints | int = 0
) -> tuple[Ints, Any]:
    """First frame from which errors (..., T) stay within `tolerance` [EV] to the episode's end.

    Frames count from `since`, such as that after a step of the light, as 1. Beside them is whether
    an episode converged; one that never does has all its frames, T - `since`.
    """
    outside = errors > tolerance
    frames = errors.shape[-1]
    last_outside = np.where(outside.any(-1), frames - np.argmax(outside[..., ::-1], axis=-1), 0)
    counted = np.maximum(last_outside - since, 0) + 1
    return np.minimum(counted, frames - np.asarray(since)), last_outside < frames


def frames_to_settle(evs: Floats, since: Ints | int = 0) -> Ints:
    """First frame from which the exposure stays within 1/3 EV of where it ends, right or wrong.

    It is counted from `since`, as by `frames_to_converge`.

    >>> frames_to_settle(np.array([[9.0, 9.0, 5.0, 6.0, 6.0, 6.0]])).tolist()
    [3]
    """
    return frames_to_converge(np.abs(evs[..., 1:] - evs[..., -1:]), since=since)[0]


def overshoot(evs: Floats, since: Ints | int = 0) -> Floats:
    """How far the exposure passes beyond where it ends, in the direction it came from [EV].

    The approach begins from the state of index `since` in `evs`. At least 0; where start and end
    are equal, the largest excursion to either side.

    >>> overshoot(np.array([[0.0, 5.0, 3.0], [0.0, 2.0, 3.0]])).tolist()
    [2.0, 0.0]
    """
    begin = np.broadcast_to(np.asarray(since), evs.shape[:-1])[..., None]
    first = np.take_along_axis(evs, begin, axis=-1)
    evs = np.where(np.arange(evs.shape[-1]) < begin, first, evs)
    final = evs[..., -1:]
    direction = np.sign(final - first)
    beyond = evs - final
    along = np.where(direction == 0, np.abs(beyond), beyond * direction)
    return np.maximum(along.max(axis=-1), 0.0)


def reversals(evs: Floats) -> Ints:
    """Changes of direction of the exposure: sign changes between successive EV steps.

    >>> reversals(np.array([0.0, 3.0, 3.0, 2.0, 4.0])).tolist()
    2
    """
    steps = np.diff(evs, axis=-1)
    steps = np.where(np.abs(steps) < SAME_EV, 0.0, np.sign(steps))
    # Frames without a step keep the heading: that of the last frame with one, the first at latest.
    moved = np.where(steps != 0, np.arange(steps.shape[-1]), 0)
    heading = np.take_along_axis(steps, np.maximum.accumulate(moved, axis=-1), axis=-1)
    return (heading[..., :-1] * steps[..., 1:] < 0).sum(axis=-1)


def flicker(image_means: Floats, static: Bools) -> Floats:
    """Mean absolute change of the mean linear signal, in [0, 1], (..., T), in the same light.

    `static` (..., T - 1) says whether the light is that of the frame before; if never, it is 0.
    """
    change = np.abs(np.diff(image_means, axis=-1))
    static = np.broadcast_to(static, change.shape)
    return (change * static).sum(axis=-1) / np.maximum(static.sum(axis=-1), 1)


def jump(code_means: Floats) -> Floats:
    """Mean visible jump: the change of the mean companded code, in [0, 1], between frames (..., T).

    >>> float(jump(np.array([0.5, 0.5, 0.75])))
    0.125
    """
    if code_means.shape[-1] < 2:
        return np.zeros(code_means.shape[:-1])
    return np.asarray(np.abs(np.diff(code_means, axis=-1)).mean(axis=-1))


def delayed_states(states: Ints, start_states: Ints, delay: int) -> Ints:
    """`states` (E, T) as they are in effect `delay` frames later; `start_states` (E,) before."""
    waiting = np.repeat(start_states[:, None], min(delay, states.shape[1]), axis=1)
    return np.concatenate([waiting, states], axis=1)[:, : states.shape[1]]


def group_means(values: NDArray[Any], groups: NDArray[Any]) -> Floats:
    """Means of `values` (..., E) over the episodes of each of `groups` (E,): (..., G), sorted."""
    names, index = np.unique(groups, return_inverse=True)
    member = (index[:, None] == np.arange(len(names))).astype(np.float64)
    return np.asarray(values, np.float64) @ (member / member.sum(axis=0))
