"""Running episodes: what was drawn for each of them, and where it is now."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ae_env.grid import ExposureGrid
from simulator.optics.motion_path import Movement


@dataclass(frozen=True)
class Episode:
    """One scene being photographed, at one moment.

    Args:
        scene: Index of the scene.
        state: Current exposure state.
        speed: Image speed [frame heights per second].
        direction: Of the image's motion when a shutter opens [rad], 0 along the rows.
        turn: Rate at which it turns [rad/s].
        subject_speed: Own speed of the scene's subject [frame heights per second].
        subject_direction: Its direction [rad].
        defocus: Blur diameter at f/4 [pixel of a 64-pixel frame], of what is least in focus.
        focus_drive: Blur at f/4 that the focus drive reports [pixel of a 64-pixel frame].
        phase: Phase of a periodic lighting, in [0, 1).
        noise_seed: Seed of the noise, which differs from frame to frame.
        frame: Number of the current frame.
    """

    scene: int
    state: int
    speed: float
    direction: float
    turn: float
    subject_speed: float
    subject_direction: float
    defocus: float
    focus_drive: float
    phase: float
    noise_seed: int
    frame: int = 0

    @property
    def movement(self) -> Movement:
        """Directions of the image's motion, and the subject's own."""
        return Movement(self.direction, self.turn, self.subject_speed, self.subject_direction)

    @property
    def moves(self) -> dict[str, Any]:
        """What blur depends on, as arguments of `ae_env.scorers.score_table.prepare_scene`."""
        return {"speed": self.speed, "defocus": self.defocus, "movement": self.movement}


class Episodes:
    """The episodes of n environments, as columns: a batch takes what it needs of them at once.

    Args:
        count: Number of environments, n.
        grid: The states.
        delays: Frames between an action and the first capture that has its ISO, its exposure time
            and its aperture.

    Attributes:
        begun: (n,) bool, whether there is an episode.
        light_index: (n,) int64, under which what is worked out for its frames is looked up: the
            index of its scene where all episodes that show it at rest share that, else one of its
            own, behind those of the scenes.
        previous: (n,) int64, state in the frame before; -1 in the first.
        pending: (n, longest delay + 1) int64, actions that are not wholly in effect yet and the
            last that is, the oldest first.
        image_mean: (n,) float64, mean code of the latest frame / 255, where a cost needs it.

    The others, (n,) each, are those of `Episode`.
    """

    def __init__(self, count: int, grid: ExposureGrid, delays: tuple[int, int, int]) -> None:
        # With one delay of all controls a state needs not be put together.
        self._grid, self._delays = grid, delays if len(set(delays)) > 1 else delays[:1]
        self.scene, self.state, self.noise_seed, self.frame = np.zeros((4, count), np.int64)
        self.speed, self.defocus, self.focus_drive, self.phase = np.zeros((4, count))
        self.direction, self.turn, self.subject_speed, self.subject_direction = np.zeros((4, count))
        self.begun = np.zeros(count, bool)
        self.light_index, self.previous = np.zeros((2, count), np.int64)
        self.pending = np.zeros((count, max(delays) + 1), np.int64)
        self.image_mean = np.full(count, np.nan)

    def begin(self, env_indices: np.ndarray, drawn: Mapping[str, np.ndarray]) -> None:
        """Puts the episodes `drawn`, columns of `Episode`, into `env_indices`."""
        for name in _FIELDS:
            getattr(self, name)[env_indices] = drawn[name]
        self.previous[env_indices] = -1
        self.pending[env_indices] = self.state[env_indices, None]
        self.image_mean[env_indices] = np.nan
        self.begun[env_indices] = True

    def act(self, env_indices: np.ndarray, actions: np.ndarray) -> None:
        """Advances the episodes of `env_indices` by one frame, each with its action."""
        self.previous[env_indices] = self.state[env_indices]
        self.pending[env_indices, :-1] = self.pending[env_indices, 1:]
        self.pending[env_indices, -1] = actions
        in_effect = [self.pending[env_indices, -1 - delay] for delay in self._delays]
        self.state[env_indices] = (
            in_effect[0] if len(in_effect) == 1 else self._grid.mixed(*in_effect)
        )
        self.frame[env_indices] += 1

    def columns(self) -> dict[str, np.ndarray]:
        """All arrays by name; what the episodes are, and where."""
        return {name: v for name, v in vars(self).items() if isinstance(v, np.ndarray)}

    def __getitem__(self, env_index: int) -> Episode:
        return Episode(**{name: getattr(self, name).item(env_index) for name in _FIELDS})


_FIELDS = tuple(field.name for field in fields(Episode))
