"""`Lighting`, `make_lighting`, which finds one, and the changes that follow a rule or a list."""

import csv
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from simulator.optics.flicker_integral import Lamp, MainsLamp, PulsedLamp
from simulator.utils.checks import check_integer, check_key, check_number, check_type, check_word
from simulator.utils.files import read_bounded

#: Most stops that the light may change by: float32 holds it at any settings of a grid.
MAX_STOPS = 64
#: Most frames of a schedule.
MAX_FRAMES = 2**20
#: Depth of a lamp on the mains, where none is given.
MAINS_DEPTH = 0.8
#: Precision of the light of a row, relative to the lamp's long-term mean: smaller differences are
#: rounding errors of float64. The least light, whose logarithm must be finite.
_RESOLUTION, _DARKEST = 1e-12, 2.0**-MAX_STOPS
#: The lamp's clock restarts after this time [s]: beyond it, float64 does not resolve a period.
_CLOCK = 1e8


def _check_frame(name: str, value: Any, low: int, high: int) -> int:
    """`value` as an int; a whole float, as some JSON writers give it, is one too."""
    whole = isinstance(value, float | np.floating) and float(value).is_integer()
    return check_integer(name, int(value) if whole else value, low, high)


#: Least and greatest value of each option, and what checks it.
_FRAME = (-(2**31), 2**31, _check_frame)
_RANGES: dict[str, tuple[Any, Any, Callable[..., Any]]] = {
    "stops": (-MAX_STOPS, MAX_STOPS, check_number),
    "stops_per_frame": (0, MAX_STOPS, check_number),
    "period": (1e-3, 2**31, check_number),
    "edge": (0, 2**31, _check_frame),
    "frequency": (1e-3, 1e6, check_number),
    "depth": (0.0, 1.0, check_number),
    "duty": (1e-6, 1.0, check_number),
    "frame_rate": (1e-3, 1e6, check_number),
    **dict.fromkeys(("at", "enter", "leave", "on", "off"), _FRAME),
}


class RollingShutter(NamedTuple):
    """Readout of a frame, one sensor row after the other."""

    rows: int  # of the packed frame
    row_time: float  # from the start of one sensor row to the start of the next [s]
    sensor_rows: int  # that are averaged into one row of the frame


#: Lightings by name: every subclass of `Lighting` with a `name` of its own.
KINDS: "dict[str, type[Lighting]]" = {}


@dataclass(frozen=True)
class Lighting:
    """Light that does not change; base of the others.

    The gain of an exposure is the mean light while the shutter is open, relative to the scene's.
    A subclass gives `name`, by which `make_lighting` knows it, and `gain`.
    """

    name: ClassVar[str] = "static"  #: by which `make_lighting` knows it
    #: Whether light also changes within a frame, so that it depends on the exposure time.
    within_frame: ClassVar[bool] = False
    #: Options that are frames, the second not before the first.
    ordered: ClassVar[tuple[str, str] | None] = None

    def __init_subclass__(cls) -> None:
        KINDS.setdefault(cls.name, cls)
        if "rows" in vars(cls) and "batch" not in vars(cls):
            cls.batch = Lighting.batch  # type: ignore[method-assign]  # which calls these rows

    def __post_init__(self) -> None:
        for option in fields(self):
            value = getattr(self, option.name)
            if option.name in _RANGES and (value is not None or option.default is not None):
                low, high, check = _RANGES[option.name]
                value = check(f"lighting[{option.name!r}]", value, low, high)
                object.__setattr__(self, option.name, value)
        if self.ordered is not None:
            first, last = self.ordered
            begin, end = getattr(self, first), getattr(self, last)
            if end < begin:
                raise ValueError(
                    f"`lighting[{last!r}]` (={end!r}) must not be before `lighting[{first!r}]` "
                    f"(={begin!r})"
                )

    def gain(self, frame: int, exposure_time: float, phase: float) -> float:
        """Mean relative light of an exposure of `exposure_time` [s] in `frame`.

        Frame 0 is the one that `reset` returns; `phase` is the episode's own, in [0, 1).
        """
        return float(2.0 ** self._stops(frame, phase))

    def _stops(self, frame: int, phase: float) -> float:
        """Change of a frame's light from the scene's [EV]."""
        return 0.0

    def rows(
        self, frame: int, exposure_time: float, phase: float, shutter: RollingShutter
    ) -> tuple[float, np.ndarray | None]:
        """Light of a `frame` row by row, as `shutter` reads; `exposure_time`, `phase` as of `gain`.

        The mean of the frame, and (rows,) float64 that of each row relative to this mean; None
        where all rows have the same.
        """
        return self.gain(frame, exposure_time, phase), None

    def batch(
        self,
        frames: np.ndarray,
        exposure_times: np.ndarray,
        phases: np.ndarray,
        shutter: RollingShutter,
    ) -> tuple[np.ndarray, np.ndarray]:
        """`rows` of B frames: (B,), and (B, rows), where 1 stands for None.

        A `ValueError` if `rows` are not as many as those of `shutter`.
        """
        frame, time, phase = (values.tolist() for values in (frames, exposure_times, phases))
        each = zip(frame, time, phase, strict=True)
        found = [self.rows(n, exposed, own, shutter) for n, exposed, own in each]
        gains, lights = np.array([gain for gain, _ in found]), np.ones((len(found), shutter.rows))
        for light, (_, rows) in zip(lights, found, strict=True):
            if rows is not None and np.shape(rows) != light.shape:
                rule = f"(shape {np.shape(rows)}) must be of shape ({shutter.rows},), or None"
                raise ValueError(f"`rows` of lighting {self.name!r} {rule}")
            light[:] = 1.0 if rows is None else rows
        return gains, lights


KINDS[Lighting.name] = Lighting


def make_lighting(spec: str | Mapping[str, Any] | Lighting) -> Lighting:
    """A lighting from `spec`: its name, or a mapping such as ``{"kind": "step", "stops": 3}``.

    A `ValueError` if the kind or an option is unknown, or an option out of range.

    >>> make_lighting({"kind": "step", "stops": 3, "at": 2}).gain(2, 0.01, 0.0)
    8.0
    """
    if isinstance(spec, Lighting):
        return spec
    options: dict[str, Any] = {"kind": spec} if isinstance(spec, str) else {}
    if isinstance(spec, Mapping):
        options = dict(spec)
    if "kind" not in options:
        raise ValueError(
            f"`lighting` (={spec!r}) must be one of {sorted(KINDS)}, a mapping with a 'kind' of "
            "them, or a Lighting"
        )
    name = options.pop("kind")
    check_word("lighting", name, tuple(sorted(KINDS)))
    kind = KINDS[name]
    for option in options:
        check_key("lighting", option, tuple(f.name for f in fields(kind)))
    return kind(**options)


@dataclass(frozen=True)
class StepLighting(Lighting):
    """The light changes by `stops` at frame `at` and stays."""

    name: ClassVar[str] = "step"  #: by which `make_lighting` knows it
    stops: float = -4.0  #: change of the light [EV], in [-64, 64]
    at: int = 4  #: frame from which the light has changed

    def _stops(self, frame: int, phase: float) -> float:
        return self.stops if frame >= self.at else 0.0


@dataclass(frozen=True)
class RampLighting(Lighting):
    """The light changes by `stops_per_frame` (>= 0) each frame, up to `stops` (of either sign)."""

    name: ClassVar[str] = "ramp"  #: by which `make_lighting` knows it
    stops: float = -4.0  #: change of the light [EV], in [-64, 64]
    stops_per_frame: float = 0.5  #: change per frame [EV], in [0, 64]

    def _stops(self, frame: int, phase: float) -> float:
        return math.copysign(min(abs(self.stops), self.stops_per_frame * frame), self.stops)


@dataclass(frozen=True)
class SineLighting(Lighting):
    """The light swings by +- `stops` with a period of `period` frames, at the episode's phase."""

    name: ClassVar[str] = "sine"  #: by which `make_lighting` knows it
    stops: float = 2.0  #: change of the light [EV], in [-64, 64]
    period: float = 16.0  #: length of a swing [frame], at least 0.001

    def _stops(self, frame: int, phase: float) -> float:
        return self.stops * math.sin(2.0 * math.pi * (frame / self.period + phase))


@dataclass(frozen=True)
class TunnelLighting(Lighting):
    """Into a tunnel `stops` darker from frame `enter` on, over `edge` frames, and out at `leave`.

    Frame ``enter`` is the last one with the light outside; frame ``enter + k`` has k / `edge` of
    the change. With `edge` 0 frame ``enter`` has all of it. `leave` works likewise.
    """

    name: ClassVar[str] = "tunnel"  #: by which `make_lighting` knows it
    ordered: ClassVar[tuple[str, str] | None] = ("enter", "leave")  #: see `Lighting`
    stops: float = -6.0  #: change of the light [EV], in [-64, 64]
    enter: int = 3  #: last frame with the light outside, an integer
    leave: int = 10  #: last frame inside, not before `enter`
    edge: int = 2  #: frames that each change takes, >= 0

    def _stops(self, frame: int, phase: float) -> float:
        inside, outside = self._share(frame - self.enter), self._share(frame - self.leave)
        return self.stops * (inside - outside)

    def _share(self, frames: int) -> float:
        """Share of a change that has happened `frames` after its start."""
        if self.edge == 0:
            return 1.0 if frames >= 0 else 0.0
        return min(max(frames / self.edge, 0.0), 1.0)


@dataclass(frozen=True)
class LensCapLighting(Lighting):
    """The lens is covered (`stops` darker) from frame `on` to before frame `off`."""

    name: ClassVar[str] = "lens_cap"  #: by which `make_lighting` knows it
    ordered: ClassVar[tuple[str, str] | None] = ("on", "off")  #: see `Lighting`
    stops: float = -20.0  #: change of the light [EV], in [-64, 64]
    on: int = 2  #: first dark frame
    off: int = 5  #: first frame with light again, not before `on`

    def _stops(self, frame: int, phase: float) -> float:
        return self.stops if self.on <= frame < self.off else 0.0


@dataclass(frozen=True)
class ScheduleLighting(Lighting):
    """The light changes by `ev[n]` stops in frame n, relative to the scene's; the last one holds.

    >>> ScheduleLighting(ev=[0, -1, 2]).gain(7, 0.01, 0.0)
    4.0
    """

    name: ClassVar[str] = "schedule"  #: by which `make_lighting` knows it
    #: One number per frame, within +- `MAX_STOPS`: a list, tuple or one-dimensional array.
    ev: Sequence[float] | np.ndarray | None = None
    #: In place of `ev`, a text file with one number per line, or a CSV with a column ``ev``.
    file: str | Path | None = None

    def __post_init__(self) -> None:
        if (self.ev is None) == (self.file is None):
            raise ValueError(
                f"`lighting['ev']` (={self.ev!r}) or `lighting['file']` (={self.file!r}) must be "
                "given, and only one of them"
            )
        values = _numbers(self.ev) if self.file is None else _read(self.file)
        if not 1 <= len(values) <= MAX_FRAMES:
            raise ValueError(
                f"`lighting['ev']` (length {len(values)}) must have 1 to {MAX_FRAMES} numbers"
            )
        checked = tuple(
            check_number(f"lighting['ev'][{i}]", value, -MAX_STOPS, MAX_STOPS)
            for i, value in enumerate(values)
        )
        object.__setattr__(self, "ev", checked)

    def _stops(self, frame: int, phase: float) -> float:
        assert self.ev is not None
        return float(self.ev[min(frame, len(self.ev) - 1)])


def _numbers(ev: Any) -> list[Any]:
    is_list = isinstance(ev, Sequence) and not isinstance(ev, str | bytes)
    if is_list or (isinstance(ev, np.ndarray) and ev.ndim == 1):
        return list(ev)
    raise ValueError(f"`lighting['ev']` (={ev!r}) must be a list of numbers, one per frame")


def _read(file: Any) -> list[float]:
    rule = f"`lighting['file']` (={str(file)!r})"
    check_type("lighting['file']", file, str, Path)
    try:
        text = read_bounded(Path(file).expanduser()).decode("utf-8-sig")
        rows = [row for row in csv.reader(text.splitlines()) if any(cell.strip() for cell in row)]
    except (OSError, UnicodeError, csv.Error, RuntimeError) as error:
        raise ValueError(f"{rule} cannot be read: {error}") from error
    header = [cell.strip() for cell in rows[0]] if rows else []
    column, first = 0, 0
    if "ev" in header:
        column, first = header.index("ev"), 1
    elif len(header) > 1:
        raise ValueError(f"{rule} (columns {header}) must have one column, or a column `ev`")
    values = []
    for number, row in enumerate(rows[first:], start=first + 1):
        cell = row[column].strip() if column < len(row) else ""
        try:
            values.append(float(cell))
        except ValueError:
            values.append(math.nan)
        if not math.isfinite(values[-1]):
            raise ValueError(f"{rule}, row {number} (={cell!r}), must be a number of stops")
    return values


@dataclass(frozen=True)
class FlickerLighting(Lighting):
    """Light that flickers much faster than frames follow each other, around the scene's own.

    It is integrated in closed form over the exposure time of each row
    (`simulator.optics.flicker_integral`). Rows begin one after the other, so unless the
    exposure lasts whole periods, the frame has bands.

    >>> FlickerLighting(frequency=100.0).gain(3, 1 / 50, 0.3)
    1.0
    """

    name: ClassVar[str] = "flicker"  #: by which `make_lighting` knows it
    within_frame: ClassVar[bool] = True  #: see `Lighting`
    #: Of the light [Hz]: twice that of the mains, or of the pulses. 0.001 to 1e6.
    frequency: float = 100.0
    #: Share of the light that flickers, 0 to 1; the rest is steady. `MAINS_DEPTH` by default, 1
    #: where `duty` is given.
    depth: float | None = None
    #: Share of a period that a pulsed lamp is on, 1e-6 to 1; None for a lamp on the mains,
    #: ``1 + depth cos(2 pi (frequency t + phase))``.
    duty: float | None = None
    #: Frames per second, 0.001 to 1e6: frame n begins at n / frame_rate, at the episode's own phase
    #: of the lamp.
    frame_rate: float = 30.0

    @functools.cached_property
    def _lamp(self) -> Lamp:
        """The part of the light that flickers, of an episode with the phase 0."""
        if self.duty is None:
            return MainsLamp(frequency=self.frequency)
        return PulsedLamp(frequency=self.frequency, duty=self.duty)

    def gain(self, frame: int, exposure_time: float, phase: float) -> float:
        """See `Lighting.gain`: `exposure_time` begins with `frame`; `phase` shifts the lamp."""
        light = self._lamp.mean_light(self._start(frame), exposure_time, phase)
        return float(self._with_steady_light(light))

    def rows(
        self, frame: int, exposure_time: float, phase: float, shutter: RollingShutter
    ) -> tuple[float, np.ndarray | None]:
        """See `Lighting.rows`: `frame`, `exposure_time`, `phase`, `shutter`."""
        frames, times, phases = np.array([[frame], [exposure_time], [phase]])
        (gain,), (rows,) = FlickerLighting.batch(self, frames, times, phases, shutter)
        return float(gain), rows if np.ptp(rows) else None

    def batch(
        self,
        frames: np.ndarray,
        exposure_times: np.ndarray,
        phases: np.ndarray,
        shutter: RollingShutter,
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `Lighting.batch`."""
        given = self._start(frames), exposure_times, *shutter, phases
        light = self._with_steady_light(self._lamp.row_light(*given))
        alike = np.ptp(light, axis=1) <= 8.0 * _RESOLUTION
        gains = np.where(alike, light[:, 0], light.mean(axis=1))
        return gains, np.where(alike[:, None], 1.0, light / gains[:, None])

    def _start(self, frames: Any) -> Any:
        return np.fmod(frames / self.frame_rate, _CLOCK)

    def _with_steady_light(self, light: np.ndarray) -> np.ndarray:
        depth = self.depth
        if depth is None:
            depth = MAINS_DEPTH if self.duty is None else 1.0
        light = (1.0 - depth) + depth * light
        return np.maximum(np.round(light / _RESOLUTION) * _RESOLUTION, _DARKEST)
