"""How the light of a scene changes during an episode.

A lighting gives, for each frame, the factor by which the scene's light differs from its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from numbers import Integral, Real
from typing import Any, ClassVar

from ae_env.checks import check_integer, check_number, did_you_mean

#: Most stops that the light may change by: float32 holds it at any settings of a grid.
MAX_STOPS = 64


def _check_frame(name: str, value: Any, low: int, high: int) -> int:
    """`value` as an int; a whole float, as some write JSON, is one too."""
    number = isinstance(value, Real) and not isinstance(value, Integral)
    if number and low <= value <= high and value % 1 == 0:
        value = int(value)
    return check_integer(name, value, low, high)


#: Least and greatest value of each option, and what checks it.
_FRAME = (-(2**31), 2**31, _check_frame)
_RANGES: dict[str, tuple[Any, Any, Callable[..., Any]]] = {
    "stops": (-MAX_STOPS, MAX_STOPS, check_number),
    "stops_per_frame": (-MAX_STOPS, MAX_STOPS, check_number),
    "period": (1e-3, 2**31, check_number),
    **dict.fromkeys(("at", "enter", "leave", "edge", "on", "off"), _FRAME),
}


@dataclass(frozen=True)
class Lighting:
    """Light that does not change; base of the others.

    The gain of an exposure is the mean light while the shutter is open, relative to the scene's.
    """

    name: ClassVar[str] = "static"

    def __post_init__(self) -> None:
        for option in fields(self):
            if option.name in _RANGES:
                low, high, check = _RANGES[option.name]
                value = check(f"lighting[{option.name!r}]", getattr(self, option.name), low, high)
                object.__setattr__(self, option.name, value)

    def gain(self, frame: int, exposure_time: float, phase: float) -> float:
        """Mean relative light of an exposure.

        Args:
            frame: Frame of the episode; 0 is the one that `reset` returns.
            exposure_time: Time the shutter is open [s].
            phase: The episode's own phase, in [0, 1).
        """
        return 1.0


@dataclass(frozen=True)
class StepLighting(Lighting):
    """The light changes by `stops` at frame `at` and stays."""

    name: ClassVar[str] = "step"
    stops: float = -4.0
    at: int = 4

    def gain(self, frame: int, exposure_time: float, phase: float) -> float:
        """See `Lighting.gain`."""
        return 2.0**self.stops if frame >= self.at else 1.0


@dataclass(frozen=True)
class RampLighting(Lighting):
    """The light changes by `stops_per_frame` each frame, up to `stops` in all."""

    name: ClassVar[str] = "ramp"
    stops: float = -4.0
    stops_per_frame: float = 0.5

    def gain(self, frame: int, exposure_time: float, phase: float) -> float:
        """See `Lighting.gain`."""
        change = min(abs(self.stops), abs(self.stops_per_frame) * frame)
        return 2.0 ** math.copysign(change, self.stops)


@dataclass(frozen=True)
class SineLighting(Lighting):
    """The light swings by +- `stops` with a period of `period` frames, at the episode's phase."""

    name: ClassVar[str] = "sine"
    stops: float = 2.0
    period: float = 16.0

    def gain(self, frame: int, exposure_time: float, phase: float) -> float:
        """See `Lighting.gain`."""
        return 2.0 ** (self.stops * math.sin(2.0 * math.pi * (frame / self.period + phase)))


@dataclass(frozen=True)
class TunnelLighting(Lighting):
    """Into a tunnel `stops` darker at frame `enter`, over `edge` frames, and out at `leave`."""

    name: ClassVar[str] = "tunnel"
    stops: float = -6.0
    enter: int = 3
    leave: int = 10
    edge: int = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_order(self, "enter", "leave")

    def gain(self, frame: int, exposure_time: float, phase: float) -> float:
        """See `Lighting.gain`."""
        edge = max(self.edge, 1)
        inside = min(max((frame - self.enter) / edge, 0.0), 1.0)
        outside = min(max((frame - self.leave) / edge, 0.0), 1.0)
        return 2.0 ** (self.stops * (inside - outside))


@dataclass(frozen=True)
class LensCapLighting(Lighting):
    """The lens is covered (`stops` darker) from frame `on` to before frame `off`."""

    name: ClassVar[str] = "lens_cap"
    stops: float = -20.0
    on: int = 2
    off: int = 5

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_order(self, "on", "off")

    def gain(self, frame: int, exposure_time: float, phase: float) -> float:
        """See `Lighting.gain`."""
        return 2.0**self.stops if self.on <= frame < self.off else 1.0


KINDS: dict[str, type[Lighting]] = {
    kind.name: kind
    for kind in (
        Lighting,
        StepLighting,
        RampLighting,
        SineLighting,
        TunnelLighting,
        LensCapLighting,
    )
}


def make_lighting(spec: str | Mapping[str, Any] | Lighting) -> Lighting:
    """A lighting from a name or from a mapping such as ``{"kind": "step", "stops": 3}``.

    Raises:
        ValueError: If the kind or one of its options is unknown, or an option is out of range.

    >>> make_lighting({"kind": "step", "stops": 3, "at": 2}).gain(2, 0.01, 0.0)
    8.0
    """
    if isinstance(spec, Lighting):
        return spec
    if not isinstance(spec, str | Mapping):
        raise ValueError(
            f"`lighting` (={spec!r}) must be one of {sorted(KINDS)}, a mapping with a 'kind' of "
            "them, or a Lighting"
        )
    options = {"kind": spec} if isinstance(spec, str) else dict(spec)
    name = options.pop("kind", None)
    if not isinstance(name, str) or name not in KINDS:
        hint = did_you_mean(name, KINDS)
        raise ValueError(f"`lighting` (={spec!r}) must be one of {sorted(KINDS)}{hint}")
    known = [f.name for f in fields(KINDS[name])]
    for option in options:
        if option not in known:
            hint = did_you_mean(option, known)
            raise ValueError(
                f"`lighting` (={spec!r}): {name!r} takes {known}, not {option!r}{hint}"
            )
    return KINDS[name](**options)


def _check_order(lighting: Lighting, first: str, last: str) -> None:
    begin, end = getattr(lighting, first), getattr(lighting, last)
    if end < begin:
        raise ValueError(
            f"`lighting[{last!r}]` (={end!r}) must not be before `lighting[{first!r}]` (={begin!r})"
        )
