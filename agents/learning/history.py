"""What a training did so far, so that another process can go on exactly there."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray


class History:
    """The actions that were taken, and whatever else is marked between two steps.

    Environments are a function of their seed and of the actions: taken through the same actions
    again, they show the same frames. So a checkpoint needs no state of theirs; a resumed training
    spends the time of its past frames, without that of learning from them.

    Part of a `simulator.utils.checkpoint.Checkpoint`; what is written is the state at the latest mark, so
    that a checkpoint may be written in the middle of a step.

    Args:
        num_envs: Environments side by side, N.

    >>> history = History(2)
    >>> history.add(np.array([3, 4])), history.mark(drawn=7), history.add(np.array([5, 6]))
    (None, None, None)
    >>> state = history.state_dict()
    >>> state["actions"].tolist(), state["drawn"]
    ([[3, 4]], 7)
    """

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs
        self.actions: list[NDArray[np.int32]] = []
        self.marked: dict[str, Any] = {}
        self._count = 0

    def add(self, actions: NDArray[Any]) -> None:
        """Keeps the actions (N,) of a step."""
        self.actions.append(actions.astype(np.int32))

    def mark(self, **values: Any) -> None:
        """Makes the actions up to now, and `values`, what a checkpoint holds."""
        self._count, self.marked = len(self.actions), values

    def state_dict(self) -> dict[str, Any]:
        """The actions (T, N) and the values of the latest mark."""
        rows = np.array(self.actions[: self._count], np.int32).reshape(-1, self.num_envs)
        return {"actions": torch.from_numpy(rows), **self.marked}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Takes over what `state_dict` gave.

        Raises:
            ValueError: If it is of another number of environments.
        """
        values = dict(state)
        rows = values.pop("actions").numpy()
        if rows.ndim != 2 or rows.shape[1] != self.num_envs:
            raise ValueError(f"its actions {rows.shape} must be those of {self.num_envs} episodes")
        self.actions, self.marked, self._count = list(rows), values, len(rows)
