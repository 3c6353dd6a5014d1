"""Photographic arithmetic against APEX, ISO 12232 and the tables printed on cameras."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given

from simulator.settings import (
    CameraSettings,
    exposure_ratio,
    format_exposure_time,
    incident_ev100,
    sensor_signal,
    snap_exposure_time,
)
from tests.strategies import settings_within


@pytest.mark.parametrize(
    ("iso", "exposure_time", "f_number", "ev100"),
    [
        (100, 1.0, 1.0, 0.0),  # the definition
        (100, 1 / 128, 16.0, 15.0),  # the sunny-16 rule
        (3200, 1 / 32, 2.0, 2.0),
        (400, 1 / 125, 5.6, 9.93664),  # log2(5.6^2 * 125) - 2, with the marked f-number
    ],
)
def test_ev100(iso: float, exposure_time: float, f_number: float, ev100: float) -> None:
    assert CameraSettings(iso, exposure_time, f_number).ev100 == pytest.approx(ev100, abs=1e-4)


def test_apex_values_add_up() -> None:
    settings = CameraSettings(iso=800, exposure_time=1 / 250, f_number=4.0)
    assert settings.aperture_value == 4.0
    assert settings.time_value == pytest.approx(7.965784, abs=1e-6)
    assert settings.speed_value == 8.0  # APEX: Sv 5 is ISO 100
    # APEX: Ev = Av + Tv, and Ev at ISO 100 is that minus the gain
    assert settings.ev100 == pytest.approx(4.0 + 7.965784 - 3.0, abs=1e-6)
    assert CameraSettings(100, 1.0, 1.0).speed_value == 5.0


@pytest.mark.parametrize(
    ("marked", "exact"),
    [
        *[(1.4, 2**0.5), (2.0, 2.0), (2.8, 2**1.5), (4.0, 4.0), (5.6, 2**2.5), (8.0, 8.0)],
        *[(11.0, 2**3.5), (16.0, 16.0), (22.0, 2**4.5), (1.8, 2 ** (5 / 6)), (3.5, 2 ** (11 / 6))],
    ],
)
def test_marked_f_numbers_stand_for_powers_of_the_sixth_root_of_two(marked, exact):
    assert CameraSettings(100, 1.0, marked).effective_f_number == pytest.approx(exact, rel=1e-12)


# The shutter speeds engraved on cameras, retyped: consecutive third stops, 3 s beside 3.2 s.
ENGRAVED = """8000 6400 5000 4000 3200 2500 2000 1600 1250 1000 800 640 500 400 320 250 200 160 125
100 80 60 50 40 30 25 20 15 13 10 8 6 5 4"""
LONG = "0.3 0.4 0.5 0.6 0.8 1 1.3 1.6 2 2.5 3.2 4 5 6 8 10 13 15 20 25 30"
SPEEDS = [1 / int(n) for n in ENGRAVED.split()] + [float(n) for n in LONG.split()]


def test_engraved_speeds_are_consecutive_third_stops() -> None:
    thirds = [3 * math.log2(snap_exposure_time(speed)) for speed in SPEEDS]
    np.testing.assert_allclose(thirds, np.arange(-39, 16), atol=1e-9)
    assert snap_exposure_time(3.0) == snap_exposure_time(3.2)


@pytest.mark.parametrize("speed", [*SPEEDS, 3.0])
def test_speeds_snap_within_3_percent(speed: float) -> None:
    for edge in (1.03, 0.97):
        inside, outside = (speed * (1 + (edge - 1) * share) for share in (0.9999, 1.0001))
        assert snap_exposure_time(inside) == snap_exposure_time(speed)
        assert snap_exposure_time(outside) == outside


@pytest.mark.parametrize("exposure_time", [1 / 90, 1 / 45, 1 / 55, 0.0002 / 3, 45.0, 120.0])
def test_speeds_far_from_a_nominal_stop_are_kept(exposure_time: float) -> None:
    assert CameraSettings.from_exif(100, exposure_time, 4).exposure_time == exposure_time
    for recorded, exact in ((1 / 60, 1 / 64), (0.01667, 1 / 64), (6.0, 6.35)):
        assert CameraSettings(100, recorded, 4).exposure_time == recorded  # given ones stay
        snapped = CameraSettings.from_exif(100, recorded, 4)
        assert snapped.exposure_time == pytest.approx(exact, rel=1e-4)


@pytest.mark.parametrize(
    ("source", "target", "ratio"),
    [
        ((100, 1 / 64, 4), (100, 1 / 64, 4), 1.0),
        ((100, 1 / 64, 4), (100, 1 / 32, 4), 2.0),
        ((100, 1 / 64, 4), (1600, 1 / 64, 4), 16.0),
        ((100, 1 / 64, 4), (100, 1 / 64, 5.6), 0.5),  # not (4 / 5.6)^2 = 0.5102
        ((100, 1 / 64, 2.8), (100, 1 / 64, 11), 2.0**-4),
        ((100, 1 / 1000, 11), (6400, 1 / 2, 4), 500 * 64 * 8),
        # 1e11 of gain, 1e14 of time, 2048^2 of aperture: a finite float32
        ((1e-3, 1e-9, 1024), (1e8, 1e5, 0.5), 1e25 * 2.0**22),
        ((320, 1 / 50, 3.5), (250, 1 / 30, 6.3), (5 / 3) * (25 / 32) * 2.0 ** ((11 - 16) / 3)),
    ],
)
def test_exposure_ratio_closed_form(source, target, ratio):
    first, second = CameraSettings(*source), CameraSettings(*target)
    assert exposure_ratio(first, second) == pytest.approx(ratio, rel=1e-12)
    assert exposure_ratio(second, first) == pytest.approx(1 / ratio, rel=1e-9)


def test_incident_meter() -> None:
    assert incident_ev100(2.5) == 0.0
    assert incident_ev100(1.0) == pytest.approx(-1.3219, abs=1e-4)
    assert incident_ev100(2.5 * 2**15) == 15.0  # full sun
    for illuminance in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="`illuminance`"):
            incident_ev100(illuminance)


@pytest.mark.parametrize("illuminance", [1.0, 320.0, 100_000.0])
def test_a_grey_card_under_incident_metering_is_at_0119_of_white(illuminance: float) -> None:
    ev = math.log2(illuminance / 2.5)
    settings = CameraSettings(iso=100, exposure_time=2.0 ** (6 - ev), f_number=8.0)
    luminance = 0.18 * illuminance / math.pi  # a Lambertian card
    # ISO 12232: 0.65 L t / N^2 over 78 / ISO
    expected = 0.65 * luminance * settings.exposure_time / 64 * 100 / 78
    assert sensor_signal(luminance, settings) == pytest.approx(expected, rel=1e-9)
    assert sensor_signal(luminance, settings) == pytest.approx(0.1194, abs=5e-5)


@pytest.mark.parametrize("name", ["iso", "exposure_time", "f_number"])
@pytest.mark.parametrize(
    "value",
    [0, -1, -0.0, math.nan, math.inf, -math.inf, "fast", "100", b"1", None, [], 1e99, 1e-99],
)
def test_bad_values_are_named(name: str, value: object) -> None:
    arguments = {"iso": 100, "exposure_time": 0.01, "f_number": 4.0, name: value}
    with pytest.raises(ValueError, match=rf"^`{name}` \(={'.*'}\) must be a number in \["):
        CameraSettings(**arguments)


@pytest.mark.parametrize(
    ("exposure_time", "text"),
    [(1 / 1000, "1/1000 s"), (1 / 64, "1/64 s"), (0.5, "1/2 s"), (1.3, "1.3 s"), (30.0, "30 s")],
)
def test_format(exposure_time: float, text: str) -> None:
    assert format_exposure_time(exposure_time) == text
    assert str(CameraSettings(400, exposure_time, 5.6)) == f"ISO 400, {text}, f/5.6"


SETTINGS = settings_within()


# -- for any input --------------------------------------------------------------------


@given(SETTINGS, SETTINGS, SETTINGS)
def test_exposure_ratios_form_a_group(a, b, c):
    # A stop is below 2**7, so each of three differences of stops is rounded by up to 2**-47; what
    # that moves a power of 2 by is below it, as ln 2 is below 1, even with the power's own ulp.
    bound = 3 * 2.0**-47
    assert exposure_ratio(a, a) == 1.0
    assert exposure_ratio(a, b) * exposure_ratio(b, a) == pytest.approx(1.0, rel=bound)
    chained = exposure_ratio(a, b) * exposure_ratio(b, c)
    assert chained == pytest.approx(exposure_ratio(a, c), rel=bound)


@given(SETTINGS)
def test_exact_stops_stand_for_themselves(settings: CameraSettings) -> None:
    recorded = CameraSettings.from_exif(settings.iso, settings.exposure_time, settings.f_number)
    thirds = -3 * recorded.time_value
    assert recorded == settings or thirds == pytest.approx(round(thirds), abs=1e-12)
    assert abs(thirds + 3 * settings.time_value) < 0.5  # never to the next one
    again = CameraSettings.from_exif(recorded.iso, recorded.exposure_time, recorded.f_number)
    assert again == recorded
    exact = replace(settings, f_number=min(max(settings.effective_f_number, 0.5), 1024.0))
    assert exposure_ratio(settings, exact) == 1.0
