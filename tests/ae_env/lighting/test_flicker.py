"""Flickering light, against sums over finely divided exposures."""

import numpy as np
import pytest

from ae_env.lighting import RollingShutter, make_lighting

SHUTTER = RollingShutter(rows=40, row_time=2e-5, sensor_rows=8)


def _sampled(light, start: float, time: float, steps: int = 40_001) -> float:
    """Mean of `light` over an exposure by the midpoint rule."""
    moments = start + time * (np.arange(steps) + 0.5) / steps
    return float(light(moments).mean())


def _mains(t: np.ndarray) -> np.ndarray:
    return 1.0 + 0.8 * np.cos(2.0 * np.pi * (100.0 * t + 0.3))


def _pulsed(t: np.ndarray) -> np.ndarray:
    """400 Hz, on for a quarter of the period, half of the light steady."""
    return 0.5 + 0.5 * 4.0 * ((400.0 * t + 0.3) % 1.0 < 0.25)


@pytest.mark.parametrize(
    ("spec", "light"), [({}, _mains), ({"frequency": 400, "duty": 0.25, "depth": 0.5}, _pulsed)]
)
@pytest.mark.parametrize("time", [1 / 1000, 1 / 320, 1 / 30])
def test_rows_are_integrated_over_their_own_exposures(spec, light, time: float) -> None:
    lighting = make_lighting({"kind": "flicker", "frame_rate": 24, **spec})
    gain, rows = lighting.rows(7, time, 0.3, SHUTTER)
    starts = 7 / 24 + 2e-5 * np.arange(320)
    wanted = np.array([_sampled(light, start, time) for start in starts[:160]])
    wanted = wanted.reshape(20, 8).mean(axis=1)
    np.testing.assert_allclose((gain * rows)[:20], wanted, atol=2e-4)
    assert rows.mean() == pytest.approx(1.0, abs=1e-12)
    assert rows.shape == (40,)
    assert lighting.gain(7, time, 0.3) == pytest.approx(_sampled(light, 7 / 24, time), abs=2e-4)


@pytest.mark.parametrize(
    ("frequency", "times"), [(100, (1 / 100, 1 / 50, 1 / 25, 1 / 2)), (120, (1 / 120, 1 / 60))]
)
@pytest.mark.parametrize("duty", [None, 0.1])
def test_whole_periods_have_no_bands(frequency: float, times, duty: float | None) -> None:
    lighting = make_lighting({"kind": "flicker", "frequency": frequency, "duty": duty})
    for time in times:
        for frame, phase in ((0, 0.0), (3, 0.37), (100_000, 0.9)):
            assert lighting.rows(frame, time, phase, SHUTTER) == (1.0, None)
    assert lighting.rows(0, 1 / 90, 0.0, SHUTTER)[1] is not None
