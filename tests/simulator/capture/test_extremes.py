"""Light and exposures far beyond any camera's: captures against exact float64 arithmetic."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from simulator import CameraSettings, NoiseLevelFunction, PreparedScene, get_camera

CAMERA = get_camera("nikon_z6")
CLEAN = replace(CAMERA, nlf_by_iso={100.0: NoiseLevelFunction.zero()}, segments=())
REFERENCE = CameraSettings(iso=100.0, exposure_time=1.0, f_number=4.0)
STOPS = (-30.0, -10.0, -1.0, 0.0, 1.0, 10.0, 30.0)
#: `STOPS` brighter than the reference, shared out to ISO and shutter.
STATES = [CameraSettings(100.0 * 2 ** (s / 2), 2 ** (s / 2), 4.0) for s in STOPS]
SHAPE = (4, 48, 48)


SIGNALS = {
    "zero": torch.zeros(SHAPE),
    "one digital number": torch.ones(SHAPE) / torch.tensor(CAMERA.span)[:, None, None],
    "as dark as black goes": -torch.tensor(CAMERA.pedestal)[:, None, None].expand(SHAPE),
    "white": torch.ones(SHAPE),
    "hot pixels": (torch.arange(48) == 24).float().expand(SHAPE) * 1e6,
    "checkerboard": (torch.arange(48)[:, None] + torch.arange(48)).remainder(2).expand(SHAPE),
    "30 stops": torch.from_numpy(2.0 ** np.random.default_rng(0).uniform(-30, 0, SHAPE)),
    "light of 1e6": torch.full(SHAPE, 1e6),
}


@pytest.mark.parametrize("name", SIGNALS)
def test_extreme_signals_are_recorded_to_half_a_digital_number(name: str) -> None:
    light = SIGNALS[name].float().contiguous()
    frames = PreparedScene(light, REFERENCE, CLEAN, NoiseLevelFunction.zero()).expose(STATES)
    span, black = (np.array(v)[:, None, None] for v in (CAMERA.span, CAMERA.black_level))
    for stops, frame in zip(STOPS, frames.double().numpy(), strict=True):
        exact = light.double().numpy() * 2.0**stops * span + black
        exact = exact.clip(0.0, CAMERA.white_level)
        # Rounding to whole numbers, and float32 products of numbers of 14 bits.
        assert np.abs(frame * span + black - exact).max() <= 0.5 + 4 * 2.0**-24 * 2**14
