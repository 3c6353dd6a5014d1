"""The right exposure where the light is known, bounded, or only likely."""

import math

import numpy as np
import pytest
import scipy.integrate
import scipy.stats
import torch

from simulator import CameraSettings, sensor_signal
from simulator.radiance.incident_light import (
    IncidentLight,
    IncidentPosterior,
    bounded,
    features,
    picture_illuminance,
)


def test_the_signal_is_openusds_exposure_scale_at_a_responsivity_of_5_6():
    # UsdGeomCamera: responsivity * time * (iso / 100) * 2**exposure / fStop**2, in 1 / nit
    scale = 5.0 / 6.0 * (1 / 64) * (400 / 100.0) / 16.0**2
    assert sensor_signal(30.0, CameraSettings(400, 1 / 64, 16.0)) == pytest.approx(30.0 * scale)


def test_known_light_is_moved_to_within_1_5_ev_of_the_average_meter():
    assert [bounded(ev, 5.0) for ev in (2.0, 4.0, 6.4, 9.0)] == [3.5, 4.0, 6.4, 6.5]
    assert bounded(9.0, None) == 9.0  # a black frame has no reading
    assert IncidentLight(9.0, 0.0, 5.0).right_ev100.tolist() == [6.5]


def test_a_dome_at_a_picture_reads_three_halves_of_the_front_and_some_of_the_back():
    """Even half spheres: a dome has 1.5 pi L of the one it faces, 0.5 pi L of the other; and an
    average meter reads 100 lux of even light on white, 100 / pi cd/m^2, as ISO 12232 has it."""
    luminance = 100.0 / math.pi
    metered = math.log2(luminance / (1.2 * 0.12))  # x = L / (1.2 * 2^EV100) = 0.12
    same = picture_illuminance(100.0, metered)
    assert same == pytest.approx(2.0 * math.pi * luminance * 250.0 / 340.0, rel=1e-12)
    black = picture_illuminance(100.0, -1000.0)
    assert black == pytest.approx(150.0 * 250.0 / 340.0, rel=1e-12)


@pytest.mark.parametrize(("ev100", "spread"), [(4.8, 0.4), (6.0, 1.2), (2.0, 2.5)])
def test_sixteen_likely_values_stand_for_the_bounded_normal_distribution(ev100, spread):
    """The expected brightness term of any state, against an integral."""
    right = IncidentLight(ev100, spread, 5.0).right_ev100
    assert len(right) == 16
    assert (abs(right - 5.0) <= 1.5).all()
    for state in (2.0, 4.0, 5.5, 8.0):

        def brightness(ev, state=state):
            error = np.clip(ev, 3.5, 6.5) - state
            return np.exp(1.0 - np.sqrt(1.0 + error**2))

        density = scipy.stats.norm(ev100, spread).pdf
        grid = np.linspace(ev100 - 9 * spread, ev100 + 9 * spread, 20_001)
        expected = scipy.integrate.simpson(brightness(grid) * density(grid), x=grid)
        assert brightness(right).mean() == pytest.approx(expected, abs=5e-3)


def test_the_posterior_knows_where_the_light_is_but_not_left_from_right():
    rows = torch.linspace(-4.0, 1.0, 64)[:, None].expand(64, 64)
    tilted = torch.exp2(rows + torch.linspace(-1.0, 1.0, 64))
    found = features(tilted, 7.5)
    assert found == pytest.approx(features(tilted.flip(1), 7.5), abs=1e-6)
    middle = -4.0 + 5.0 * np.array([1, 3, 5, 7]) / 8.0  # of the rows of zones
    assert found[:8].reshape(4, 2).mean(axis=1) == pytest.approx(middle, abs=0.05)
    assert found[8:] == pytest.approx([float((tilted > 1.0).double().mean()), 7.5], abs=0.02)
    own = IncidentPosterior(weights=(0.0,) * 9 + (0.5,), offset=-4.0, spread=0.7)
    light = own.infer(tilted, 7.0)
    assert (light.ev100, light.spread, light.reflected_ev100) == (6.5, 0.7, 7.0)
