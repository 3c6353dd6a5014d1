"""`ExposureGrid`: the exposure states that an agent can choose from."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, product
from typing import Any

import numpy as np

from simulator.settings import CameraSettings
from simulator.utils.checks import as_float, did_you_mean

#: Most states of a grid, each an object.
_MOST_STATES = 2**16


def plain(value: Any) -> Any:
    """`value` as numbers and lists where it is a scalar or an array of NumPy or torch."""
    return value.tolist() if hasattr(value, "tolist") else value


def plain_list(value: Any) -> list[Any] | None:
    """The entries of any iterable but a text, each as `plain` gives it; None for anything else.

    >>> plain_list(np.array([1, 2])), plain_list(iter((3, np.int64(4)))), plain_list(np.array(5))
    ([1, 2], [3, 4], None)
    """
    value = plain(value)
    if isinstance(value, str | bytes) or not isinstance(value, Iterable):
        return None
    return [plain(entry) for entry in value]


@dataclass(frozen=True)
class ExposureGrid:
    """Every combination of some ISO speeds, exposure times and f-numbers.

    The index of a state is ``(iso_index * T + time_index) * N + aperture_index``.

    >>> grid = ExposureGrid.default()
    >>> len(grid), str(grid[0]), str(grid[63])
    (64, 'ISO 100, 1/1000 s, f/4', 'ISO 6400, 1/2 s, f/11')
    """

    isos: tuple[float, ...]  #: ISO speeds, ascending
    exposure_times: tuple[float, ...]  #: exposure times [s], ascending (shortest first)
    f_numbers: tuple[float, ...]  #: F-numbers, ascending

    def __post_init__(self) -> None:
        for name in ("isos", "exposure_times", "f_numbers"):
            given = getattr(self, name)
            values = tuple(map(as_float, plain_list(given) or ()))
            # `CameraSettings` checks the ranges below.
            fit = bool(values) and all(map(math.isfinite, values))
            if not (fit and all(a < b for a, b in pairwise(values))):
                rule = "must be a strictly ascending list of numbers"
                raise ValueError(f"`{name}` (={reprlib.repr(given)}) {rule}")
            object.__setattr__(self, name, values)
        if math.prod(self.shape) > _MOST_STATES:
            raise ValueError(f"a grid must have at most {_MOST_STATES} states, not {self.shape}")
        assert self.states  # makes, and so checks, every CameraSettings

    @classmethod
    def default(cls) -> ExposureGrid:
        """64 states over 18 stops, EV100 -1 (1 lux) to 17 (full sun, the top for highlights)."""
        return cls((100, 400, 1600, 6400), (1 / 1000, 1 / 125, 1 / 15, 1 / 2), (4, 5.6, 8, 11))

    @classmethod
    def third_stop(cls) -> ExposureGrid:
        """The same ranges in third stops of ISO and time, full stops of aperture: 2128 states."""
        isos = tuple(100.0 * 2 ** (i / 3) for i in range(19))
        return cls(isos, tuple(2.0 ** (-i / 3) for i in range(30, 2, -1)), (4, 5.6, 8, 11))

    @classmethod
    def video(cls) -> ExposureGrid:
        """64 states whose exposures fit into a frame at 30 Hz, EV100 2 to 17, in whole stops."""
        return cls((100, 400, 1600, 6400), (1 / 2000, 1 / 500, 1 / 125, 1 / 30), (2.8, 4, 5.6, 8))

    @classmethod
    def bracket(cls) -> ExposureGrid:
        """24 states at f/4, EV100 0 to 16, in steps of two stops of ISO and time."""
        times = (1 / 4000, 1 / 1000, 1 / 250, 1 / 60, 1 / 15, 1 / 4)
        return cls((100, 400, 1600, 6400), times, (4,))

    @classmethod
    def from_spec(cls, spec: ExposureGrid | str | Mapping[str, Iterable[float]]) -> ExposureGrid:
        """A grid from `spec`: a name such as ``"default"`` or ``"video"``, or lists by name."""
        if isinstance(spec, ExposureGrid):
            return spec
        named = ("bracket", "default", "third_stop", "video")
        if isinstance(spec, str) and spec in named:
            return getattr(cls, spec)()
        names = ("isos", "exposure_times", "f_numbers")
        if isinstance(spec, Mapping) and set(spec) == set(names):
            try:
                return cls(**dict(spec))  # type: ignore[arg-type]
            except ValueError as error:
                raise ValueError(f"`grid`: {error}") from None
        hint = did_you_mean(spec, named) if isinstance(spec, str) else ""
        if isinstance(spec, Mapping):
            hint = "".join(did_you_mean(key, names) for key in spec if key not in names)
        raise ValueError(
            f"`grid` (={spec!r}) must be one of {list(named)}, an ExposureGrid, or a mapping "
            f"with exactly the keys {list(names)}{hint}"
        )

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of ISO speeds, exposure times and f-numbers."""
        return len(self.isos), len(self.exposure_times), len(self.f_numbers)

    @cached_property
    def states(self) -> tuple[CameraSettings, ...]:
        """Settings of every state, by index."""
        triples = product(self.isos, self.exposure_times, self.f_numbers)
        return tuple(CameraSettings(*triple) for triple in triples)

    @cached_property
    def ev100(self) -> np.ndarray:
        """(S,) float64, EV100 of each state with the effective f-number (see `CameraSettings`)."""
        return np.array([-s.log2_exposure for s in self.states])

    @cached_property
    def apex(self) -> np.ndarray:
        """(S, 3) float64, Av, Tv and Sv of each state."""
        return np.array([[s.aperture_value, s.time_value, s.speed_value] for s in self.states])

    def index(self, iso_index: int, time_index: int, aperture_index: int) -> int:
        """State at the positions `iso_index`, `time_index` and `aperture_index` of the lists."""
        return int(np.ravel_multi_index((iso_index, time_index, aperture_index), self.shape))

    def controls(self, states: np.ndarray | int) -> np.ndarray:
        """(..., 3) int64: positions of `states` in the three lists, ISO, time, aperture."""
        return np.stack(np.unravel_index(np.asarray(states), self.shape), axis=-1).astype(np.int64)

    def mixed(self, iso: np.ndarray, time: np.ndarray, aperture: np.ndarray) -> np.ndarray:
        """(...) int64: states with the ISO of `iso`, exposure time of `time`, f/ of `aperture`."""
        sources = np.broadcast_arrays(iso, time, aperture)
        controls = [self.controls(states)[..., i] for i, states in enumerate(sources)]
        return np.ravel_multi_index(tuple(controls), self.shape).astype(np.int64)

    def nearest(self, ev100: float) -> int:
        """Index of the state nearest to `ev100`; ties to the lower ISO."""
        if not math.isfinite(ev100):
            raise ValueError(f"`ev100` (={ev100!r}) must be finite")
        return int(np.argmin(np.abs(self.ev100 - ev100).round(9)))

    def __len__(self) -> int:
        return len(self.states)

    def __getitem__(self, state: int) -> CameraSettings:
        return self.states[state]

    def __iter__(self) -> Iterator[CameraSettings]:
        return iter(self.states)
