"""Running episodes: what was drawn for each of them, and where it is now."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np


@dataclass(frozen=True)
class Episode:
    """One scene being photographed, at one moment.

    Args:
        scene: Index of the scene.
        state: Current exposure state.
        speed: Image speed [frame heights per second].
        defocus: Blur diameter at f/4 [pixel of a 64-pixel frame].
        focus_drive: Blur at f/4 that the focus drive tells of [pixel of a 64-pixel frame].
        phase: Phase of a periodic lighting, in [0, 1).
        noise_seed: Seed of the noise, which differs from frame to frame.
        frame: Number of the current frame.
    """

    scene: int
    state: int
    speed: float
    defocus: float
    focus_drive: float
    phase: float
    noise_seed: int
    frame: int = 0


class Episodes:
    """The episodes at n places, as columns: a batch takes what it needs of them at once.

    Args:
        count: Number of places, n.
        delay: Frames between an action and the first capture that has it.

    Attributes:
        begun: (n,) bool, whether there is an episode.
        slot: (n,) int64, under which number what is worked out for its frames is looked up: that of
            its scene where all episodes that show it at rest share this, else one of its own.
        previous: (n,) int64, state in the frame before; -1 in the first.
        pending: (n, delay + 1) int64, the current state and those on their way to the camera.
        image_mean: (n,) float64, mean code of the latest frame / 255, where a cost needs it.

    The others, (n,) each, are those of `Episode`.
    """

    def __init__(self, count: int, delay: int) -> None:
        self.scene, self.state, self.noise_seed, self.frame = np.zeros((4, count), np.int64)
        self.speed, self.defocus, self.focus_drive, self.phase = np.zeros((4, count))
        self.begun = np.zeros(count, bool)
        self.slot, self.previous = np.zeros((2, count), np.int64)
        self.pending = np.zeros((count, delay + 1), np.int64)
        self.image_mean = np.full(count, np.nan)

    def begin(self, places: np.ndarray, drawn: Mapping[str, np.ndarray], slots: np.ndarray) -> None:
        """Puts the episodes `drawn`, columns of `Episode`, into `places`, with their `slots`."""
        for name in _FIELDS:
            getattr(self, name)[places] = drawn[name]
        self.slot[places] = slots
        self.previous[places] = -1
        self.pending[places] = self.state[places, None]
        self.image_mean[places] = np.nan
        self.begun[places] = True

    def act(self, places: np.ndarray, actions: np.ndarray) -> None:
        """Lets the episodes at `places` go on by one frame, each with its action."""
        self.previous[places] = self.state[places]
        self.pending[places, :-1] = self.pending[places, 1:]
        self.pending[places, -1] = actions
        self.state[places] = self.pending[places, 0]
        self.frame[places] += 1

    def __getitem__(self, place: int) -> Episode:
        return Episode(**{name: getattr(self, name).item(place) for name in _FIELDS})


_FIELDS = tuple(field.name for field in fields(Episode))
