"""The settings of a recorded sequence of raws, once more."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ae_env.scenes.folder import find_files
from agents.policy import Observations, Policy, PolicyContext, masked_argmax
from simulator.files import RAW_SUFFIXES
from simulator.raw_file import read_raw
from simulator.settings import CameraSettings


class Recorded(Policy):
    """What a real camera did: frame k of an episode takes the settings of the k-th raw of a folder.

    Beside the same folder as a scene (``scenes={"sequence": FOLDER}``) that replays the recording.
    Frame 0 is the one that `reset` returns, at a state that no policy chooses; a delay is allowed
    for. The raws count in the natural order of their names, from 0; after the last one its settings
    stay. Of the grid's states the nearest is taken: the squares of the differences in aperture,
    time, ISO and EV, in stops, add up.

    Args:
        context: The camera, the grid and the observation.
        path: Folder of raws, or a single raw.

    Raises:
        ValueError: If there is none, or one cannot be read or does not say its settings.
    """

    def __init__(self, context: PolicyContext, path: str | os.PathLike[str]) -> None:
        super().__init__(context)
        self.name = f"recorded:{os.fspath(path)}"
        self.files = _raw_files(path)
        self.settings = tuple(read_raw(file).settings for file in self.files)
        ours = _coordinates(context.grid.states)
        #: Cost of every state, per raw, ``(T, S)``.
        self._cost = ((_coordinates(self.settings)[:, None] - ours[None]) ** 2).sum(axis=2)
        self._frame = self._first = 1 + context.delay  # that the first decision exposes

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Begin the sequence anew."""
        super().reset(num_envs, seed)
        self._frame = self._first

    def act(
        self, observations: Observations, action_masks: NDArray[np.bool_] | None = None
    ) -> NDArray[np.int64]:
        """The state nearest to the next raw's settings, or the nearest allowed one."""
        self.check_reset(observations)
        cost = self._cost[min(self._frame, len(self._cost) - 1)].round(9)
        self._frame += 1
        return masked_argmax(
            np.broadcast_to(-cost, (len(observations["raw"]), len(cost))), action_masks
        )


def _raw_files(path: str | os.PathLike[str]) -> list[Path]:
    given = Path(path).expanduser()
    if not os.fspath(path) or not given.exists():
        raise ValueError(
            f"`path` (={os.fspath(path)!r}) must be a folder of raws: 'recorded:FOLDER'"
        )
    try:
        raws = [file for file in find_files(given)[1] if file.suffix.lower() in RAW_SUFFIXES]
    except ValueError:  # no file of any known kind
        raws = []
    if not raws:
        raise ValueError(f"`path` (={os.fspath(path)!r}) holds no raw file")
    return raws


def _coordinates(settings: tuple[CameraSettings, ...]) -> NDArray[np.float64]:
    """Aperture, time, ISO and EV of each, in stops, ``(n, 4)``."""
    return np.array(
        [(s.aperture_stop / 3.0, s.time_value, s.speed_value, s.log2_exposure) for s in settings]
    )
