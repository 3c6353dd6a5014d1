"""Light that changes from frame to frame, by a rule."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from ae_env.lighting.base import Lighting


@dataclass(frozen=True)
class StepLighting(Lighting):
    """The light changes by `stops` at frame `at` and stays."""

    name: ClassVar[str] = "step"
    stops: float = -4.0
    at: int = 4

    def gain(self, frame: int, exposure_time: float, phase: float) -> float:
        """See `Lighting.gain`."""
        return float(2.0**self.stops) if frame >= self.at else 1.0


@dataclass(frozen=True)
class RampLighting(Lighting):
    """The light changes by `stops_per_frame` (>= 0) each frame, up to `stops` (of either sign)."""

    name: ClassVar[str] = "ramp"
    stops: float = -4.0
    stops_per_frame: float = 0.5

    def gain(self, frame: int, exposure_time: float, phase: float) -> float:
        """See `Lighting.gain`."""
        change = min(abs(self.stops), self.stops_per_frame * frame)
        return float(2.0 ** math.copysign(change, self.stops))


@dataclass(frozen=True)
class SineLighting(Lighting):
    """The light swings by +- `stops` with a period of `period` frames, at the episode's phase."""

    name: ClassVar[str] = "sine"
    stops: float = 2.0
    period: float = 16.0

    def gain(self, frame: int, exposure_time: float, phase: float) -> float:
        """See `Lighting.gain`."""
        turn = frame / self.period + phase
        return float(2.0 ** (self.stops * math.sin(2.0 * math.pi * turn)))


@dataclass(frozen=True)
class TunnelLighting(Lighting):
    """Into a tunnel `stops` darker from frame `enter` on, over `edge` frames, and out at `leave`.

    Frame ``enter`` is the last one with the light outside; frame ``enter + k`` has k / `edge` of
    the change. With `edge` 0 frame ``enter`` has all of it. `leave` works likewise.
    """

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
        inside, outside = self._share(frame - self.enter), self._share(frame - self.leave)
        return float(2.0 ** (self.stops * (inside - outside)))

    def _share(self, frames: int) -> float:
        """Share of a change that has happened `frames` after its start."""
        if self.edge == 0:
            return 1.0 if frames >= 0 else 0.0
        return min(max(frames / self.edge, 0.0), 1.0)


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


def _check_order(lighting: Lighting, first: str, last: str) -> None:
    begin, end = getattr(lighting, first), getattr(lighting, last)
    if end < begin:
        raise ValueError(
            f"`lighting[{last!r}]` (={end!r}) must not be before `lighting[{first!r}]` (={begin!r})"
        )
