"""Flickering light: mains, dimmed LEDs and screens, and the bands that a rolling shutter makes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ae_env.lighting.base import MAX_STOPS, Lighting, RollingShutter
from simulator.optics.flicker_integral import Lamp, MainsLamp, PulsedLamp
from simulator.utils.checks import check_number

#: Depth of a lamp on the mains, where none is given.
MAINS_DEPTH = 0.8
#: Precision of the light of a row, relative to the lamp's long-term mean: smaller differences are
#: rounding errors of float64.
_RESOLUTION = 1e-12
#: Least light of a row: its logarithm must be finite.
_DARKEST = 2.0**-MAX_STOPS
#: The lamp's clock restarts after this time [s]: beyond it, float64 does not resolve a period.
_CLOCK = 1e8
#: Least and greatest value of each option.
_RANGES = {
    "frequency": (1e-3, 1e6),
    "depth": (0.0, 1.0),
    "duty": (1e-6, 1.0),
    "frame_rate": (1e-3, 1e6),
}


@dataclass(frozen=True)
class FlickerLighting(Lighting):
    """Light that flickers much faster than frames follow each other, around the scene's own.

    It is integrated in closed form over the exposure time of each row
    (`simulator.optics.flicker_integral`). Rows begin one after the other, so unless the
    exposure lasts whole periods, the frame has bands.

    Args:
        frequency: Of the light [Hz]: twice that of the mains, or of the pulses. 0.001 to 1e6.
        depth: Share of the light that flickers, 0 to 1; the rest is steady. `MAINS_DEPTH` by
            default, 1 where `duty` is given.
        duty: Share of a period that a pulsed lamp is on, 1e-6 to 1; None for a lamp on the mains,
            ``1 + depth cos(2 pi (frequency t + phase))``.
        frame_rate: Frames per second, 0.001 to 1e6: frame n begins at n / frame_rate, at the
            episode's own phase of the lamp.

    >>> FlickerLighting(frequency=100.0).gain(3, 1 / 50, 0.3)
    1.0
    """

    name: ClassVar[str] = "flicker"
    within_frame: ClassVar[bool] = True
    frequency: float = 100.0
    depth: float | None = None
    duty: float | None = None
    frame_rate: float = 30.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if value is None and name in ("depth", "duty"):
                continue
            value = check_number(f"lighting[{name!r}]", value, low, high)
            object.__setattr__(self, name, value)

    def lamp(self, phase: float) -> Lamp:
        """The part of the light that flickers, with `phase` as of `gain`."""
        if self.duty is None:
            return MainsLamp(frequency=self.frequency, phase=phase)
        return PulsedLamp(frequency=self.frequency, duty=self.duty, phase=phase)

    def gain(self, frame: int, exposure_time: float, phase: float) -> float:
        """Mean relative light of an exposure that begins with the frame; see `Lighting.gain`."""
        light = self.lamp(phase).mean_light(self._start(frame), exposure_time)
        return float(self._with_steady_light(light))

    def rows(
        self, frame: int, exposure_time: float, phase: float, shutter: RollingShutter
    ) -> tuple[float, np.ndarray | None]:
        """See `Lighting.rows`."""
        light = self.lamp(phase).row_light(
            self._start(frame), exposure_time, shutter.rows, shutter.row_time, shutter.sensor_rows
        )
        light = self._with_steady_light(light)
        mean = float(light.mean())
        if np.ptp(light) <= 8.0 * _RESOLUTION:
            return float(light[0]), None
        return mean, light / mean

    def _start(self, frame: int) -> float:
        return math.fmod(frame / self.frame_rate, _CLOCK)

    def _with_steady_light(self, light: np.ndarray) -> np.ndarray:
        depth = self.depth
        if depth is None:
            depth = MAINS_DEPTH if self.duty is None else 1.0
        light = (1.0 - depth) + depth * light
        return np.maximum(np.round(light / _RESOLUTION) * _RESOLUTION, _DARKEST)
