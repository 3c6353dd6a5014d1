"""Light that every episode draws anew: which change it is, how large and how fast."""

import csv
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, ClassVar

import numpy as np

from ae_env.lighting.base import FlickerLighting, Lighting, RollingShutter
from simulator.radiance.procedural import log_uniform
from simulator.utils.checks import check_word

#: Frames that are drawn; after the last one the light stays.
FRAMES = 1024
#: Episodes whose light is kept.
_KEPT = 4096

Generator = np.random.Generator


def ramps(rng: Generator) -> np.ndarray:
    """The light goes 3 to 6 stops up or down at 0.3 to 1.5 stops a frame, rests, and comes back."""
    speed, stops = log_uniform(rng, 0.3, 1.5), rng.choice((-1, 1)) * rng.uniform(3.0, 6.0)
    there = np.linspace(0.0, stops, int(np.ceil(abs(stops) / speed)) + 1)
    return _repeated(rng, lambda: (there, _rest(rng, 12, stops), there[::-1], _rest(rng, 12)))


def sines(rng: Generator) -> np.ndarray:
    """The light swings by 1.5 to 3.5 stops with a period of 7 to 18 frames."""
    stops, period = rng.uniform(1.5, 3.5), log_uniform(rng, 7.0, 18.0)
    return stops * np.sin(2.0 * np.pi * (np.arange(FRAMES) / period + rng.random()))


def tunnels(rng: Generator) -> np.ndarray:
    """Into a tunnel 4 to 7 stops darker within 3 to 8 frames, and out of it after up to 16."""

    def tunnel() -> tuple[np.ndarray, ...]:
        stops = -rng.uniform(4.0, 7.0)
        down: np.ndarray = np.linspace(0.0, stops, rng.integers(3, 9) + 1)[1:]
        return down, _rest(rng, 16, stops), down[::-1], _rest(rng, 16)

    return _repeated(rng, tunnel)


def steps(rng: Generator) -> np.ndarray:
    """The light jumps to another level within +- 3 stops, 10 to 60 frames apart."""

    def step() -> tuple[np.ndarray, ...]:
        level = rng.uniform(-3.0, 3.0)
        return np.full(10, level), _rest(rng, 50, level)

    return _repeated(rng, step)


def drifts(rng: Generator) -> np.ndarray:
    """The light drifts: its rate is a random walk that tends to nothing, as does its level."""
    rate, level, found = 0.0, 0.0, np.empty(FRAMES)
    push = log_uniform(rng, 0.08, 0.3)
    for frame, normal in enumerate(rng.standard_normal(FRAMES)):
        rate = np.clip(0.95 * rate + push * normal - 0.02 * level, -1.5, 1.5)
        level = np.clip(level + rate, -6.0, 6.0)
        found[frame] = level
    return found


def shadows(rng: Generator) -> np.ndarray:
    """Passing shadows 3 to 5 stops deep, as of trees along a road: about evenly spaced, soft."""
    depth, period = -rng.uniform(3.0, 5.0), log_uniform(rng, 7.0, 16.0)
    width, edge = rng.uniform(0.3, 0.6), rng.uniform(0.2, 0.4)
    spacing = period * rng.uniform(0.85, 1.15, int(2 * FRAMES / period) + 2)
    turn = np.interp(np.arange(FRAMES), np.cumsum(spacing), np.arange(len(spacing)))
    from_middle = np.abs((turn + rng.random()) % 1.0 - 0.5)
    shade = np.clip((width / 2.0 + edge / 2.0 - from_middle) / edge, 0.0, 1.0)
    return np.asarray(depth * shade * shade * (3.0 - 2.0 * shade))


def clouds(rng: Generator) -> np.ndarray:
    """Broken clouds, filmed quickly: up to 5 stops darker, thicker and thinner at any pace."""
    times = np.arange(FRAMES)[:, None]
    periods = np.array([log_uniform(rng, 7.0, 30.0) for _ in range(6)])
    waves = np.sin(2.0 * np.pi * (times / periods + rng.random(6))) * rng.random(6)
    cover = 1.0 / (1.0 + np.exp(-2.0 * (waves.sum(axis=1) - rng.uniform(-1.0, 1.0))))
    light: np.ndarray = -rng.uniform(3.0, 5.0) * cover
    return light - light[0]


@functools.cache
def read_pans() -> dict[str, tuple[float, ...]]:
    """Mean light that a camera sees as it turns in a place [EV], in 72 directions 5 degrees apart.

    Of each public panorama (CC0) of the test split of `ae_env.scenes.polyhaven`: its luminance in a
    view of 60 degrees, clipped at 6 times the geometric mean of all, relative to the first view's.
    """
    text = (files("ae_env.lighting") / "pans.csv").read_text(encoding="utf-8")
    return {line[0]: tuple(map(float, line[1:])) for line in csv.reader(text.splitlines())}


def pans(rng: Generator) -> np.ndarray:
    """A camera that turns quickly in a real place, to and fro: the mean light of what it sees."""
    places = read_pans()
    turn = np.array(places[sorted(places)[rng.integers(len(places))]])
    speed = log_uniform(rng, 2.0, 6.0)
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

    >>> MovingLighting("test").kind(0.25) in KIND_SETS["test"]
    True
    """

    name: ClassVar[str] = "moving"  #: by which `make_lighting` knows it
    within_frame: ClassVar[bool] = True  #: see `Lighting`
    #: ``"train"`` or ``"test"`` (`KIND_SETS`), ``"all"``, or names of `MOVES`.
    kinds: str | Sequence[str] = "train"
    frame_rate: float = 29.97  #: frames per second, for lamps

    def __post_init__(self) -> None:
        super().__post_init__()
        kinds = (self.kinds,) if isinstance(self.kinds, str) else self.kinds
        if not isinstance(kinds, Sequence) or not len(kinds):
            raise ValueError(f"`lighting['kinds']` (={self.kinds!r}) must name one kind or more")
        for kind in kinds:
            check_word("lighting['kinds']", kind, (*KIND_SETS, "all", *MOVES))
        object.__setattr__(self, "kinds", tuple(kinds))

    @functools.cached_property
    def drawn_from(self) -> tuple[str, ...]:
        """Names of `MOVES` that an episode's kind is drawn from."""
        sets: dict[str, tuple[str, ...]] = {**KIND_SETS, "all": tuple(MOVES)}
        names = [name for kind in self.kinds for name in sets.get(kind, (kind,))]
        return tuple(dict.fromkeys(names))

    def kind(self, phase: float) -> str:
        """Which kind of `MOVES` the episode with this `phase` in [0, 1) has."""
        return _drawn(self.drawn_from, phase)[0]

    def stops(self, phase: float) -> np.ndarray:
        """(FRAMES,) light of each frame at `phase`, relative to the scene's [EV]; without lamps."""
        return _drawn(self.drawn_from, phase)[1]

    def gain(self, frame: int, exposure_time: float, phase: float) -> float:
        """See `Lighting.gain`: `frame`, `exposure_time`, `phase`."""
        kind, stops, lamp = _drawn(self.drawn_from, phase)
        gain = float(2.0 ** stops[min(frame, FRAMES - 1)])
        if kind == "lamps":
            gain *= self._lamp(lamp).gain(frame, exposure_time, phase)
        return gain

    def rows(
        self, frame: int, exposure_time: float, phase: float, shutter: RollingShutter
    ) -> tuple[float, np.ndarray | None]:
        """See `Lighting.rows`: `frame`, `exposure_time`, `phase`, `shutter`."""
        kind, stops, lamp = _drawn(self.drawn_from, phase)
        if kind == "lamps":
            return self._lamp(lamp).rows(frame, exposure_time, phase, shutter)
        return float(2.0 ** stops[min(frame, FRAMES - 1)]), None

    def _lamp(self, lamp: tuple[float, float]) -> FlickerLighting:
        return FlickerLighting(*lamp, frame_rate=self.frame_rate)


@functools.lru_cache(_KEPT)
def _drawn(kinds: tuple[str, ...], phase: float) -> tuple[str, np.ndarray, tuple[float, float]]:
    """Kind, stops of each frame, and frequency [Hz] and depth of lamps."""
    rng = np.random.default_rng(int(phase * 2.0**53))
    kind = kinds[rng.integers(len(kinds))]
    stops = MOVES[kind](rng)
    stops.flags.writeable = False
    return kind, stops, (float(rng.choice((100.0, 120.0))), float(rng.uniform(0.2, 0.8)))


def _rest(rng: Generator, most: int, stops: float = 0.0) -> np.ndarray:
    """Light of `stops` for up to `most` frames."""
    return np.full(rng.integers(0, most + 1), stops)


def _repeated(rng: Generator, part: Callable[[], Sequence[Any]]) -> np.ndarray:
    """(FRAMES,): up to 24 frames of the scene's own light, then `part` again and again."""
    parts: list[Any] = [_rest(rng, 24)]
    while sum(map(len, parts)) < FRAMES:
        parts += part()
    return np.concatenate(parts)[:FRAMES].astype(np.float64)
