"""The scale that a scene's light is on, and the settings that it belongs to."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from simulator.settings import LUX_AT_EV0, SATURATION_CONSTANT, CameraSettings

#: Signal of a perfectly white diffuse surface at the incident-light exposure, ``x = 0.663 * R``.
#: Luminance R E / pi in ISO 12232's ``x = 100 L t / (120 N^2)`` with ``E = 2.5 * 2**EV100``.
WHITE_SIGNAL = 100.0 * LUX_AT_EV0 / (SATURATION_CONSTANT * math.pi)
#: Mean of green, clipped at white, that a scene of unknown light is anchored to.
MEAN_SIGNAL = 0.12
#: f-number and ISO of the reference settings made here; the exposure time carries the EV.
_REFERENCE_ISO, _REFERENCE_F_NUMBER = 100.0, 4.0


def reference_settings(ev100: float) -> CameraSettings:
    """ISO 100, f/4 and the exposure time at which ``-log2_exposure`` is `ev100`.

    >>> reference_settings(10.0)
    CameraSettings(iso=100.0, exposure_time=0.015625, f_number=4.0)
    """
    unit = CameraSettings(_REFERENCE_ISO, 1.0, _REFERENCE_F_NUMBER)
    return replace(unit, exposure_time=2.0 ** (-unit.log2_exposure - ev100))


def mean_anchor(green: torch.Tensor) -> float:
    """Factor at which the mean of `green` (any shape), clipped at 1, is `MEAN_SIGNAL`.

    Clipping keeps a sun of 10,000 times white from deciding the exposure of everything else.
    """
    values = green.double().clamp(min=0.0).flatten()
    if float((values > 0).double().mean()) <= MEAN_SIGNAL:
        raise ValueError(
            f"`light` is 0 in all but {float((values > 0).double().mean()):.1%} of its pixels: no "
            f"exposure brings its mean to {MEAN_SIGNAL}; give `illuminance`"
        )
    low, high = -40.0, 40.0  # log2 of the factor
    for _ in range(60):
        middle = 0.5 * (low + high)
        if float((values * 2.0**middle).clamp_(max=1.0).mean()) < MEAN_SIGNAL:
            low = middle
        else:
            high = middle
    return 2.0 ** (0.5 * (low + high))
