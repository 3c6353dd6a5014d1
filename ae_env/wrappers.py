"""Other ways to say which exposure state comes next, each for one environment and for many.

| wrapper | action | meaning |
|---|---|---|
| `ControlActions` | `MultiDiscrete([4, 4, 4])` | positions of ISO, time and aperture in the grid |
| `RelativeActions` | `MultiDiscrete([3, 3, 3])` | down, stay or up, for all controls at once |
| `ContinuousActions` | `Box(-1, 1, (3,))` | Av, Tv, Sv between the grid's extremes |

The counterparts for vector environments are called `VectorControlActions` and so on.

`action_masks()` of the first two has one mask per control, one after the other, which is how
`MaskablePPO` takes a `MultiDiscrete`. A position is allowed where some allowed state has it: the
union over the other controls. So where a scene forbids states (`Scene.allowed`), a combination of
allowed positions may still be a forbidden state; the environment photographs it all the same.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector.utils import batch_space

from ae_env.episodes.core import check_actions
from ae_env.grid import ExposureGrid

__all__ = [
    "ContinuousActions",
    "ControlActions",
    "RelativeActions",
    "VectorContinuousActions",
    "VectorControlActions",
    "VectorRelativeActions",
]

#: Decimals to which distances in stops are compared, so that rounding decides no tie.
_DISTANCE_DECIMALS = 9


# -- from actions (..., 3) to states, and from allowed states to masks ----------------------------


def _check_steps(actions: Any, sizes: tuple[int, ...], shape: tuple[int, ...]) -> np.ndarray:
    """`actions` as int64 of `shape` with column i in [0, sizes[i])."""
    values = check_actions("action", actions, shape)
    if bool(((values < 0) | (values >= np.array(sizes))).any()):
        raise ValueError(f"`action` (={values.tolist()}) must be in [0, {list(sizes)}) by column")
    return values.astype(np.int64)


def _states_of_controls(grid: ExposureGrid, controls: np.ndarray) -> np.ndarray:
    """States at the positions `controls` in the grid's three lists."""
    states = np.ravel_multi_index(tuple(np.moveaxis(controls, -1, 0)), grid.shape)
    return np.asarray(states, np.int64)


def _states_of_steps(grid: ExposureGrid, states: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """States that `steps` (0 down, 1 stay, 2 up) lead to from `states`."""
    last = np.array(grid.shape) - 1
    return _states_of_controls(grid, np.clip(grid.controls(states) + steps - 1, 0, last))


def _check_apex(actions: Any, shape: tuple[int, ...]) -> np.ndarray:
    """`actions` as float64 of `shape`, clipped to [-1, 1]."""
    try:
        values = np.asarray(actions)
    except ValueError:  # rows of different lengths
        values = np.empty(0, object)
    numbers = values.shape == shape and values.dtype.kind in "iuf"
    values = values.astype(np.float64) if numbers else values
    if not numbers or not np.isfinite(values).all():
        raise ValueError(f"`action` (={actions!r}) must be finite numbers of shape {shape}")
    clipped: np.ndarray = np.clip(values, -1.0, 1.0)
    return clipped


def _apex_of(grid: ExposureGrid) -> np.ndarray:
    """(S, 3) Av, Tv, Sv of every state."""
    return np.array([[s.aperture_value, s.time_value, s.speed_value] for s in grid.states])


def _states_of_apex(apex: np.ndarray, actions: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """Nearest allowed state of each action, ties to the lower index; allowed (..., S)."""
    low, high = apex.min(axis=0), apex.max(axis=0)
    wanted = low + 0.5 * (actions + 1.0) * (high - low)
    distance = ((wanted[..., None, :] - apex) ** 2).sum(axis=-1).round(_DISTANCE_DECIMALS)
    nearest: np.ndarray = np.argmin(np.where(allowed, distance, np.inf), axis=-1)
    return nearest.astype(np.int64)


def _control_masks(grid: ExposureGrid, allowed: np.ndarray) -> np.ndarray:
    """(..., I + T + N): positions of each control that some allowed state (..., S) has."""
    cube = allowed.reshape(*allowed.shape[:-1], *grid.shape)
    return np.concatenate(
        [cube.any(axis=(-2, -1)), cube.any(axis=(-3, -1)), cube.any(axis=(-3, -2))], axis=-1
    )


def _step_masks(grid: ExposureGrid, states: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """(..., 9): steps of each control that lead to a position which some allowed state has."""
    by_value = np.split(_control_masks(grid, allowed), np.cumsum(grid.shape)[:-1], axis=-1)
    controls = grid.controls(states)
    masks = []
    for i, mask in enumerate(by_value):
        targets = np.clip(controls[..., i, None] + np.array([-1, 0, 1]), 0, grid.shape[i] - 1)
        masks.append(np.take_along_axis(mask, targets, axis=-1))
    return np.concatenate(masks, axis=-1)


def _checked_grid(env: Any) -> ExposureGrid:
    """The grid of an environment whose actions are its states; raises a `ValueError` for others."""
    for name in ("grid", "action_masks"):
        if not hasattr(env.unwrapped, name):
            raise ValueError(
                f"`env` (={env}) must be an ae_env/AutoExposure-v0 whose actions are grid states; "
                f"it has no `{name}` (for many environments use gymnasium.make_vec)"
            )
    if not isinstance(getattr(env, "single_action_space", env.action_space), gym.spaces.Discrete):
        raise ValueError(f"`env` (={env}) must have Discrete actions: it is wrapped already")
    grid: ExposureGrid = env.unwrapped.grid
    return grid


# -- one environment ------------------------------------------------------------------------------


class _GridActions(gym.ActionWrapper[Any, Any, Any], RecordConstructorArgs):
    def __init__(self, env: gym.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        gym.ActionWrapper.__init__(self, env)
        self._inner: Any = env.unwrapped
        self._grid = _checked_grid(env)


class ControlActions(_GridActions):
    """Actions `MultiDiscrete([I, T, N])`: positions of ISO, exposure time and f-number.

    Args:
        env: An `ae_env/AutoExposure-v0`, wrapped or not.

    Raises:
        ValueError: If `env` has no grid.

    >>> import ae_env
    >>> env = ControlActions(gym.make("ae_env/AutoExposure-v0", scenes="bundled:small"))
    >>> env.action_space, str(env.unwrapped.grid[int(env.action(np.array([1, 2, 3])))])
    (MultiDiscrete([4 4 4]), 'ISO 400, 1/15 s, f/11')
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.action_space = gym.spaces.MultiDiscrete(list(self._grid.shape))

    def action(self, action: Any) -> np.int64:
        """State of the three positions `action` (3,)."""
        controls = _check_steps(action, self._grid.shape, (3,))
        return np.int64(_states_of_controls(self._grid, controls))

    def action_masks(self) -> np.ndarray:
        """(I + T + N,) bool: positions of each control that some allowed state has."""
        return _control_masks(self._grid, self._inner.action_masks())


class RelativeActions(_GridActions):
    """Actions `MultiDiscrete([3, 3, 3])`: 0 one step down, 1 stay, 2 one step up.

    For ISO, exposure time and f-number at once, because a single control cannot trade shutter for
    ISO without leaving the right exposure on the way. Steps count from the state of the latest
    capture; a step beyond the end of a list stays at the end.

    Args:
        env: An `ae_env/AutoExposure-v0`, wrapped or not.

    Raises:
        ValueError: If `env` has no grid.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.action_space = gym.spaces.MultiDiscrete([3, 3, 3])

    def action(self, action: Any) -> np.int64:
        """State that the three steps `action` (3,) lead to."""
        steps = _check_steps(action, (3, 3, 3), (3,))
        return np.int64(_states_of_steps(self._grid, np.asarray(self._inner.state), steps))

    def action_masks(self) -> np.ndarray:
        """(9,) bool: steps of each control to a position that some allowed state has."""
        return _step_masks(self._grid, np.asarray(self._inner.state), self._inner.action_masks())


class ContinuousActions(_GridActions):
    """Actions `Box(-1, 1, (3,))`: Av, Tv and Sv from the grid's least to its greatest.

    The allowed state at the least distance in stops is taken; ties go to the lower ISO. Values
    beyond the box are clipped.

    Args:
        env: An `ae_env/AutoExposure-v0`, wrapped or not.

    Raises:
        ValueError: If `env` has no grid.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
        self._apex = _apex_of(self._grid)

    def action(self, action: Any) -> np.int64:
        """State nearest to the APEX values `action` (3,)."""
        allowed = self._inner.action_masks()
        return np.int64(_states_of_apex(self._apex, _check_apex(action, (3,)), allowed))


# -- many environments ----------------------------------------------------------------------------


class _VectorGridActions(gym.vector.VectorActionWrapper, RecordConstructorArgs):
    def __init__(
        self, env: gym.vector.VectorEnv[Any, Any, Any], single_action_space: gym.Space[Any]
    ) -> None:
        RecordConstructorArgs.__init__(self)
        gym.vector.VectorActionWrapper.__init__(self, env)
        self.single_action_space = single_action_space
        self.action_space = batch_space(single_action_space, env.num_envs)
        self._inner: Any = env.unwrapped
        self._grid = _checked_grid(env)


class VectorControlActions(_VectorGridActions):
    """`ControlActions` for a vector environment; actions (N, 3).

    Args:
        env: An `ae_env/AutoExposure-v0` from `gymnasium.make_vec`, wrapped or not.
    """

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any]) -> None:
        grid = _checked_grid(env)
        super().__init__(env, gym.spaces.MultiDiscrete(list(grid.shape)))

    def actions(self, actions: Any) -> np.ndarray:
        """(N,) int64: states of the positions `actions` (N, 3)."""
        controls = _check_steps(actions, self._grid.shape, (self.num_envs, 3))
        return _states_of_controls(self._grid, controls)

    def action_masks(self) -> np.ndarray:
        """(N, I + T + N) bool: positions of each control that some allowed state has."""
        return _control_masks(self._grid, self._inner.action_masks())


class VectorRelativeActions(_VectorGridActions):
    """`RelativeActions` for a vector environment; actions (N, 3).

    Args:
        env: An `ae_env/AutoExposure-v0` from `gymnasium.make_vec`, wrapped or not.
    """

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any]) -> None:
        _checked_grid(env)
        super().__init__(env, gym.spaces.MultiDiscrete([3, 3, 3]))

    def actions(self, actions: Any) -> np.ndarray:
        """(N,) int64: states that the steps `actions` (N, 3) lead to."""
        steps = _check_steps(actions, (3, 3, 3), (self.num_envs, 3))
        return _states_of_steps(self._grid, self._inner.states, steps)

    def action_masks(self) -> np.ndarray:
        """(N, 9) bool: steps of each control to a position that some allowed state has."""
        return _step_masks(self._grid, self._inner.states, self._inner.action_masks())


class VectorContinuousActions(_VectorGridActions):
    """`ContinuousActions` for a vector environment; actions (N, 3).

    Args:
        env: An `ae_env/AutoExposure-v0` from `gymnasium.make_vec`, wrapped or not.
    """

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any]) -> None:
        _checked_grid(env)
        super().__init__(env, gym.spaces.Box(-1.0, 1.0, (3,), np.float32))
        self._apex = _apex_of(self._grid)

    def actions(self, actions: Any) -> np.ndarray:
        """(N,) int64: states nearest to the APEX values `actions` (N, 3)."""
        allowed = self._inner.action_masks()
        return _states_of_apex(self._apex, _check_apex(actions, (self.num_envs, 3)), allowed)
