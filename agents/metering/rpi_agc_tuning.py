"""The numbers of the Raspberry Pi's AGC: libcamera's tuning of the imx477, and its defaults."""

from __future__ import annotations

from dataclasses import dataclass

#: Weights of the 15 zones (see `agents.metering.rpi_agc.zone_map`) in each metering mode.
ZONE_WEIGHTS = {
    "centre_weighted": (3, 3, 3, 2, 2, 2, 2, 1, 1, 1, 1, 0, 0, 0, 0),
    "spot": (2, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0),
    "matrix": (1,) * 15,
}


@dataclass(frozen=True)
class Ladder:
    """How an exposure mode splits an exposure: the shutter up to a rung, then the gain, and so on.

    Args:
        shutter: Rungs of the exposure time [s].
        gain: Rungs of the gain, 1 at ISO 100.
    """

    shutter: tuple[float, ...]
    gain: tuple[float, ...]


LADDERS = {
    "normal": Ladder((100e-6, 10e-3, 30e-3, 60e-3, 66.666e-3), (1.0, 2.0, 4.0, 6.0, 16.0)),
    "short": Ladder((100e-6, 5e-3, 10e-3, 20e-3, 66.666e-3), (1.0, 2.0, 4.0, 6.0, 16.0)),
    "long": Ladder((100e-6, 10e-3, 30e-3, 60e-3, 120e-3), (1.0, 2.0, 4.0, 6.0, 16.0)),
}


@dataclass(frozen=True)
class Constraint:
    """The mean of the pixels between two quantiles must not be below, or above, a target.

    Args:
        lower: Whether the target is a lower bound.
        quantiles: Between which the pixels are averaged.
        target: Signal, white is 1.
    """

    lower: bool
    quantiles: tuple[float, float]
    target: float


_TOP = Constraint(True, (0.98, 1.0), 0.3)
CONSTRAINTS = {
    "normal": (_TOP,),
    "highlight": (_TOP, Constraint(False, (0.98, 1.0), 0.8)),
    "shadows": (Constraint(True, (0.0, 0.5), 0.17),),
}

#: Illuminance [lux] and the mean signal aimed at; linear between, constant outside.
TARGET_LUX, TARGET_SIGNALS = (0.0, 1000.0, 10000.0), (0.16, 0.165, 0.17)
#: No target is above this, whatever the compensation: close to white a mean says nothing.
TARGET_LIMIT = 0.9
#: Share of the distance to the target that the filter goes per frame.
SPEED = 0.2
#: Within this of the target the filter goes with the square root of its speed.
NEAR = 0.2
#: Within this of the target it stays.
STABLE = 0.02
#: Frames of the start, in which it goes all of the way.
STARTUP_FRAMES = 10
#: A target above this that the picture exceeds is approached from below, at this part of the
#: exposure.
FAST_REDUCE = 0.4
#: Passes in which the gain is found (zones saturate), the most that one may add, and when to stop.
GAIN_PASSES, GAIN_LIMIT, GAIN_DONE = 8, 10.0, 1.01
