"""Light that every episode draws anew: which change it is, how large and how fast."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ae_env.lighting.base import Lighting, RollingShutter
from ae_env.lighting.flicker import FlickerLighting
from ae_env.lighting.pans import PANS
from ae_env.utils.checks import check_word

#: Frames that are drawn; after the last one the light stays.
FRAMES = 1024
#: Episodes whose light is kept.
_KEPT = 4096

Generator = np.random.Generator


def ramps(rng: Generator) -> np.ndarray:
    """The light goes 2 to 6 stops up or down at 0.05 to 1 stop a frame, and back, with pauses."""
    speed, stops = _log_uniform(rng, 0.05, 1.0), rng.choice((-1, 1))
    stops = stops * rng.uniform(2.0, 6.0)
    length = int(np.ceil(abs(stops) / speed))
    there = np.linspace(0.0, stops, length + 1)
    parts = [np.zeros(rng.integers(4, 33))]
    while sum(map(len, parts)) < FRAMES:
        parts += [there, np.full(rng.integers(8, 49), stops)]
        parts += [there[::-1], np.zeros(rng.integers(8, 49))]
    return _cut(parts)


def sines(rng: Generator) -> np.ndarray:
    """The light swings by 0.5 to 3 stops with a period of 12 to 64 frames."""
    stops, period = rng.uniform(0.5, 3.0), _log_uniform(rng, 12.0, 64.0)
    turn = np.arange(FRAMES) / period + rng.random()
    wave: np.ndarray = stops * np.sin(2.0 * np.pi * turn)
    return wave


def tunnels(rng: Generator) -> np.ndarray:
    """Into a tunnel 3 to 7 stops darker within 1 to 8 frames, out of it after 12 to 48."""
    parts = [np.zeros(rng.integers(6, 41))]
    while sum(map(len, parts)) < FRAMES:
        stops, edge = -rng.uniform(3.0, 7.0), rng.integers(1, 9)
        down = np.linspace(0.0, stops, edge + 1)[1:]
        parts += [down, np.full(rng.integers(12, 49), stops), down[::-1]]
        parts.append(np.zeros(rng.integers(12, 49)))
    return _cut(parts)


def steps(rng: Generator) -> np.ndarray:
    """The light jumps to another level within +- 3 stops, 10 to 60 frames apart."""
    parts = [np.zeros(rng.integers(6, 33))]
    while sum(map(len, parts)) < FRAMES:
        parts.append(np.full(rng.integers(10, 61), rng.uniform(-3.0, 3.0)))
    return _cut(parts)


def drifts(rng: Generator) -> np.ndarray:
    """The light drifts: its rate is a random walk that tends to nothing, as does its level."""
    rate, level, found = 0.0, 0.0, np.empty(FRAMES)
    push = _log_uniform(rng, 0.01, 0.08)
    for frame, normal in enumerate(rng.standard_normal(FRAMES)):
        rate = 0.95 * rate + push * normal - 0.004 * level
        level += rate
        found[frame] = level
    return np.clip(found, -6.0, 6.0)


def shadows(rng: Generator) -> np.ndarray:
    """Passing shadows 1 to 4 stops deep, of trees or buildings beside the road, at any spacing."""
    depth, mean = -rng.uniform(1.0, 4.0), _log_uniform(rng, 3.0, 20.0)
    parts = [np.zeros(rng.integers(4, 25))]
    while sum(map(len, parts)) < FRAMES:
        own, edge = depth * rng.uniform(0.6, 1.0), rng.integers(1, 4)
        down = np.linspace(0.0, own, edge + 1)[1:]
        dark, lit = 1 + rng.poisson(mean, 2)
        parts += [down, np.full(dark, own), down[::-1], np.zeros(lit)]
    return _cut(parts)


def clouds(rng: Generator) -> np.ndarray:
    """Clouds before the sun: up to 4 stops darker, soft edges, thicker and thinner at any pace."""
    times = np.arange(FRAMES)[:, None]
    periods = np.array([_log_uniform(rng, 40.0, 240.0) for _ in range(6)])
    waves = np.sin(2.0 * np.pi * (times / periods + rng.random(6))) * rng.random(6)
    cover = 1.0 / (1.0 + np.exp(-2.0 * (waves.sum(axis=1) - rng.uniform(-1.0, 1.0))))
    light: np.ndarray = -rng.uniform(2.0, 4.0) * cover
    return light - light[0]


def pans(rng: Generator) -> np.ndarray:
    """A camera that turns in a real place, to and fro: the mean light of what it sees."""
    names = sorted(PANS)
    turn = np.array(PANS[names[rng.integers(len(names))]])
    speed = _log_uniform(rng, 0.1, 1.0) * rng.choice((-1, 1))
    swing = rng.uniform(20.0, 70.0)  # of 72 directions
    there = np.abs((np.arange(FRAMES) * speed / swing) % 2.0 - 1.0) * swing
    at = there + rng.uniform(0.0, len(turn))
    ev = np.interp(at, np.arange(len(turn)), turn, period=len(turn))
    return np.asarray(ev - ev[0])


def still(rng: Generator) -> np.ndarray:
    """The light stays."""
    return np.zeros(FRAMES)


#: What the light may do, by name; lamps flicker within the frames besides.
MOVES: dict[str, Callable[[Generator], np.ndarray]] = {
    "ramps": ramps,
    "sines": sines,
    "tunnels": tunnels,
    "steps": steps,
    "drifts": drifts,
    "lamps": still,
    "shadows": shadows,
    "clouds": clouds,
    "pans": pans,
}
#: Those to train on, and those that are kept for tests.
KIND_SETS = {
    "train": ("ramps", "sines", "tunnels", "steps", "drifts", "lamps"),
    "test": ("shadows", "clouds", "pans"),
}


@dataclass(frozen=True)
class MovingLighting(Lighting):
    """Light that moves as the episode's phase draws it: a kind of `MOVES`, its size, its pace.

    Args:
        kinds: ``"train"`` or ``"test"`` (`KIND_SETS`), ``"all"``, or names of `MOVES`.
        frame_rate: Frames per second, for lamps.

    >>> MovingLighting("test").kind(0.25) in KIND_SETS["test"]
    True
    """

    name: ClassVar[str] = "moving"
    within_frame: ClassVar[bool] = True
    kinds: str | Sequence[str] = "train"
    frame_rate: float = 29.97

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.kinds, str) and self.kinds not in MOVES:
            check_word("lighting['kinds']", self.kinds, (*KIND_SETS, "all", *MOVES))
        kinds = (self.kinds,) if isinstance(self.kinds, str) else tuple(self.kinds)
        if not kinds:
            raise ValueError(f"`lighting['kinds']` (={self.kinds!r}) must name one kind or more")
        for kind in kinds:
            check_word("lighting['kinds']", kind, (*KIND_SETS, "all", *MOVES))
        object.__setattr__(self, "kinds", kinds)
        FlickerLighting(frame_rate=self.frame_rate)  # checks it

    @functools.cached_property
    def drawn_from(self) -> tuple[str, ...]:
        """Names of `MOVES` that an episode's kind is drawn from."""
        sets: dict[str, tuple[str, ...]] = {**KIND_SETS, "all": tuple(MOVES)}
        names = [name for kind in self.kinds for name in sets.get(kind, (kind,))]
        return tuple(dict.fromkeys(names))

    def kind(self, phase: float) -> str:
        """Which kind of `MOVES` the episode with this phase has."""
        return _drawn(self.drawn_from, phase)[0]

    def stops(self, phase: float) -> np.ndarray:
        """(FRAMES,) light of each frame relative to the scene's [EV]; lamps left out."""
        return _drawn(self.drawn_from, phase)[1]

    def gain(self, frame: int, exposure_time: float, phase: float) -> float:
        """See `Lighting.gain`."""
        kind, stops, lamp = _drawn(self.drawn_from, phase)
        gain = float(2.0 ** stops[min(frame, FRAMES - 1)])
        if kind == "lamps":
            gain *= self._lamp(lamp).gain(frame, exposure_time, phase)
        return gain

    def rows(
        self, frame: int, exposure_time: float, phase: float, shutter: RollingShutter
    ) -> tuple[float, np.ndarray | None]:
        """See `Lighting.rows`."""
        kind, stops, lamp = _drawn(self.drawn_from, phase)
        if kind == "lamps":
            return self._lamp(lamp).rows(frame, exposure_time, phase, shutter)
        return float(2.0 ** stops[min(frame, FRAMES - 1)]), None

    def _lamp(self, lamp: tuple[float, float]) -> FlickerLighting:
        return FlickerLighting(lamp[0], lamp[1], frame_rate=self.frame_rate)


@functools.lru_cache(_KEPT)
def _drawn(kinds: tuple[str, ...], phase: float) -> tuple[str, np.ndarray, tuple[float, float]]:
    """Kind, stops of each frame, and frequency [Hz] and depth of lamps."""
    rng = np.random.default_rng(int(phase * 2.0**53))
    kind = kinds[rng.integers(len(kinds))]
    stops = MOVES[kind](rng)
    stops.flags.writeable = False
    return kind, stops, (float(rng.choice((100.0, 120.0))), float(rng.uniform(0.2, 0.8)))


def _log_uniform(rng: Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _cut(parts: list[Any]) -> np.ndarray:
    found: np.ndarray = np.concatenate(parts)[:FRAMES].astype(np.float64)
    return found
