"""Other ways to say which exposure state comes next, each for one environment and for many.

| wrapper | action | meaning |
|---|---|---|
| `ControlActions` | `MultiDiscrete([4, 4, 4])` | positions of ISO, time and aperture in the grid |
| `RelativeActions` | `MultiDiscrete([3, 3, 3])` | down, stay or up, for all controls at once |
| `ContinuousActions` | `Box(-1, 1, (3,))` | Av, Tv, Sv between the grid's extremes |

They take an `ae_env/AutoExposure-v0`, wrapped or not; a `ValueError` says that an environment has
no grid. The counterparts for vector environments are called `VectorControlActions` and so on.

`action_masks()` of the first two has one mask per control, one after the other, which is how
`MaskablePPO` takes a `MultiDiscrete`. A position is allowed where some allowed state has it: the
union over the other controls. So where a scene forbids states (`Scene.allowed`), a combination of
allowed positions may still be a forbidden state; the environment photographs it all the same.
"""

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector.utils import batch_space

from ae_env.episodes.core import check_actions
from ae_env.grid import ExposureGrid

#: Decimals to which distances in stops are compared, so that rounding decides no tie.
_DISTANCE_DECIMALS = 9


class _GridActions(RecordConstructorArgs):
    """What the wrappers of one and of many environments have in common; actions are (..., 3)."""

    _shape: tuple[int, ...] = (3,)
    _states_name: ClassVar[str] = "state"

    def _set_up(self, env: Any) -> None:
        RecordConstructorArgs.__init__(self)
        for name in ("grid", "action_masks"):
            if not hasattr(env.unwrapped, name):
                raise ValueError(
                    f"`env` (={env}) must be an ae_env/AutoExposure-v0 whose actions are grid "
                    f"states; it has no `{name}` (for many environments use gymnasium.make_vec)"
                )
        space = getattr(env, "single_action_space", env.action_space)
        if not isinstance(space, gym.spaces.Discrete):
            raise ValueError(f"`env` (={env}) must have Discrete actions: it is wrapped already")
        self._inner: Any = env.unwrapped
        self._grid: ExposureGrid = env.unwrapped.grid

    def _space(self) -> gym.Space[Any]:
        """Space of one environment's actions."""
        raise NotImplementedError

    def _states_of(self, actions: Any) -> np.ndarray:
        """States (...) int64 that `actions` choose."""
        raise NotImplementedError

    def _checked(self, actions: Any, sizes: tuple[int, ...]) -> np.ndarray:
        """`actions` as int64 with column i in [0, sizes[i])."""
        values = check_actions("action", actions, self._shape)
        if bool(((values < 0) | (values >= np.array(sizes))).any()):
            raise ValueError(
                f"`action` (={values.tolist()}) must be in [0, {list(sizes)}) by column"
            )
        return values.astype(np.int64)

    def _states_at(self, controls: np.ndarray) -> np.ndarray:
        states = np.ravel_multi_index(tuple(np.moveaxis(controls, -1, 0)), self._grid.shape)
        return np.asarray(states, np.int64)

    def _control_masks(self) -> list[np.ndarray]:
        """(..., I), (..., T), (..., N): positions of each control that some allowed state has."""
        allowed = self._inner.action_masks()
        cube = allowed.reshape(*allowed.shape[:-1], *self._grid.shape)
        return [cube.any(axis=axes) for axes in ((-2, -1), (-3, -1), (-3, -2))]


class _One(_GridActions, gym.ActionWrapper[Any, Any, Any]):
    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._set_up(env)  # first: its error is plainer than Gymnasium's
        gym.ActionWrapper.__init__(self, env)
        self.action_space = self._space()

    def action(self, action: Any) -> np.int64:
        """The state that `action` (3,) chooses."""
        return np.int64(self._states_of(action))


class _Many(_GridActions, gym.vector.VectorActionWrapper):
    _states_name = "states"

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any]) -> None:
        self._set_up(env)
        gym.vector.VectorActionWrapper.__init__(self, env)
        self._shape = (env.num_envs, 3)
        self.single_action_space = self._space()
        self.action_space = batch_space(self.single_action_space, env.num_envs)

    def actions(self, actions: Any) -> np.ndarray:
        """(N,) int64: states that `actions` (N, 3) choose."""
        return self._states_of(actions)


class _Controls(_GridActions):
    def _space(self) -> gym.Space[Any]:
        return gym.spaces.MultiDiscrete(list(self._grid.shape))

    def _states_of(self, actions: Any) -> np.ndarray:
        return self._states_at(self._checked(actions, self._grid.shape))

    def action_masks(self) -> np.ndarray:
        """(..., I + T + N) bool: positions of each control that some allowed state has."""
        return np.concatenate(self._control_masks(), axis=-1)


class _Steps(_GridActions):
    def _space(self) -> gym.Space[Any]:
        return gym.spaces.MultiDiscrete([3, 3, 3])

    def _states_of(self, actions: Any) -> np.ndarray:
        steps, last = self._checked(actions, (3, 3, 3)) - 1, np.array(self._grid.shape) - 1
        return self._states_at(np.clip(self._current() + steps, 0, last))

    def _current(self) -> np.ndarray:
        return self._grid.controls(getattr(self._inner, self._states_name))

    def action_masks(self) -> np.ndarray:
        """(..., 9) bool: steps of each control to a position that some allowed state has."""
        controls, masks = self._current(), []
        for i, mask in enumerate(self._control_masks()):
            targets = controls[..., i, None] + np.array([-1, 0, 1])
            targets = np.clip(targets, 0, self._grid.shape[i] - 1)
            masks.append(np.take_along_axis(mask, targets, axis=-1))
        return np.concatenate(masks, axis=-1)


class _Apex(_GridActions):
    def _space(self) -> gym.Space[Any]:
        return gym.spaces.Box(-1.0, 1.0, (3,), np.float32)

    def _states_of(self, actions: Any) -> np.ndarray:
        try:
            values = np.asarray(actions)
        except ValueError:  # rows of different lengths
            values = np.empty(0, object)
        numbers = values.shape == self._shape and values.dtype.kind in "iuf"
        if not numbers or not np.isfinite(values).all():
            raise ValueError(
                f"`action` (={actions!r}) must be finite numbers of shape {self._shape}"
            )
        apex = self._grid.apex
        low, high = apex.min(axis=0), apex.max(axis=0)
        wanted = low + 0.5 * (np.clip(values.astype(np.float64), -1.0, 1.0) + 1.0) * (high - low)
        distance = ((wanted[..., None, :] - apex) ** 2).sum(axis=-1).round(_DISTANCE_DECIMALS)
        distance = np.where(self._inner.action_masks(), distance, np.inf)
        return np.argmin(distance, axis=-1).astype(np.int64)


class ControlActions(_Controls, _One):
    """Actions of `env` as `MultiDiscrete([I, T, N])`: positions of ISO, exposure time, f-number.

    >>> import ae_env
    >>> env = ControlActions(gym.make("ae_env/AutoExposure-v0", scenes="bundled:small"))
    >>> env.action_space, str(env.unwrapped.grid[int(env.action(np.array([1, 2, 3])))])
    (MultiDiscrete([4 4 4]), 'ISO 400, 1/15 s, f/11')
    """


class RelativeActions(_Steps, _One):
    """Actions of `env` as `MultiDiscrete([3, 3, 3])`: 0 one step down, 1 stay, 2 one step up.

    For ISO, exposure time and f-number at once, because a single control cannot trade shutter for
    ISO without leaving the right exposure on the way. Steps count from the state of the latest
    capture; a step beyond the end of a list stays at the end.
    """


class ContinuousActions(_Apex, _One):
    """Actions of `env` as `Box(-1, 1, (3,))`: Av, Tv and Sv from the grid's least to greatest.

    The allowed state at the least distance in stops is taken; ties go to the lower ISO. Values
    beyond the box are clipped.
    """


class VectorControlActions(_Controls, _Many):
    """`ControlActions` for a vector `env` of `gymnasium.make_vec`; actions (N, 3)."""


class VectorRelativeActions(_Steps, _Many):
    """`RelativeActions` for a vector `env` of `gymnasium.make_vec`; actions (N, 3)."""


class VectorContinuousActions(_Apex, _Many):
    """`ContinuousActions` for a vector `env` of `gymnasium.make_vec`; actions (N, 3)."""
