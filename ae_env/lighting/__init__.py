"""The change of a scene's light during an episode.

A lighting gives, for each frame, the factor by which the scene's light differs from its own; where
it changes within a frame (`FlickerLighting`), one for each row.
"""

from ae_env.lighting.base import (
    KINDS,
    MAX_STOPS,
    FlickerLighting,
    LensCapLighting,
    Lighting,
    RampLighting,
    RollingShutter,
    ScheduleLighting,
    SineLighting,
    StepLighting,
    TunnelLighting,
    make_lighting,
)
from ae_env.lighting.moving import MovingLighting

__all__ = [
    "KINDS",
    "MAX_STOPS",
    "FlickerLighting",
    "LensCapLighting",
    "Lighting",
    "MovingLighting",
    "RampLighting",
    "RollingShutter",
    "ScheduleLighting",
    "SineLighting",
    "StepLighting",
    "TunnelLighting",
    "make_lighting",
]
