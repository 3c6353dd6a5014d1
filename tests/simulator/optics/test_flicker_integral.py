"""Light integrated in closed form against SciPy's adaptive quadrature and exact fractions."""

import math
from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from simulator.optics.flicker_integral import Flash, Lamp, MainsLamp, PulsedLamp
from tests.strategies import log_uniform

TIMES = (1 / 8000, 1 / 1000, 1 / 120, 0.01, 1 / 60, 0.35)
STARTS = (0.0, 0.0013, 0.00499999, 3.7)
#: An hour and a day on: the phase must be known as well as in the first second.
LATER = (3600.123, 86_400.7, -1e6 / 3)


def integral(light: Callable[[float], float], begin: float, end: float) -> float:
    return quad(light, begin, end, epsabs=0, epsrel=1e-12, limit=500)[0]


@pytest.mark.parametrize("time", TIMES)
@pytest.mark.parametrize("frequency", [100.0, 120.0])
@pytest.mark.parametrize("depth", [0.3, 1.0])
def test_mains_light_is_its_integral(time, frequency, depth):
    def light(t: float) -> float:
        return 1.0 + depth * math.cos(2 * math.pi * (frequency * t + 0.2))

    lamp = MainsLamp(frequency, depth, phase=0.2)
    for start in STARTS:
        expected = integral(light, start, start + time) / time
        assert lamp.mean_light(start, time) == pytest.approx(expected, rel=1e-9)


def _pulses(start: Fraction, time: Fraction, frequency: Fraction, duty: Fraction) -> Fraction:
    """Exact mean of a pulsed lamp: what each pulse and the exposure share, pulse by pulse."""
    on, stop = Fraction(0), start + time
    for pulse in range(math.floor(start * frequency) - 1, math.ceil(stop * frequency) + 2):
        begin = pulse / frequency
        on += max(Fraction(0), min(stop, begin + duty / frequency) - max(start, begin))
    return on / (time * duty)


@pytest.mark.parametrize("frequency", [1000, 7919, 20_000])
@pytest.mark.parametrize("duty", [0.01, 0.5, 0.99])
@pytest.mark.parametrize("time", [1 / 8000, 1 / 1000, 1 / 60])
def test_pulsed_light_is_the_exact_overlap(frequency, duty, time):
    lamp = PulsedLamp(frequency, duty)
    for start in (*STARTS, *LATER):
        exact = float(_pulses(*map(Fraction, (start, time, frequency, duty))))
        assert lamp.mean_light(start, time) == pytest.approx(exact, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("time", [1 / 8000, 1 / 60, 4.0])
@pytest.mark.parametrize("decay", [1e-6, 50e-6, 1e-3])
def test_a_flash_is_its_integral(time, decay):
    def light(t: float) -> float:
        return 0.02 / decay * math.exp(-(t - 0.01) / decay)

    lamp = Flash(at=0.01, decay=decay, energy=0.02)
    for start in (0.0, 0.009_99, 0.01, 0.01 + decay, 0.02):
        begin = max(start, 0.01)
        end = max(begin, min(start + time, begin + 60 * decay))  # then there is nothing left
        expected = 1.0 + integral(light, begin, end) / time
        assert lamp.mean_light(start, time) == pytest.approx(expected, rel=1e-9)


def test_rows_are_exposed_one_after_the_other():
    lamp, time, row_time = MainsLamp(100.0, 0.8), 1 / 1000, 20e-6
    rows = lamp.row_light(0.5, time, 64, row_time, sensor_rows=4)
    starts = 0.5 + row_time * np.arange(64 * 4).reshape(64, 4)
    wanted = np.vectorize(lamp.mean_light)(starts, time).mean(1)
    np.testing.assert_allclose(rows, wanted, rtol=1e-12)
    # Bands of one period: 10 ms are 500 sensor rows of 20 us, 125 rows of four.
    repeated = lamp.row_light(0.5, time, 250, row_time, sensor_rows=4)
    np.testing.assert_allclose(repeated[:125], repeated[125:], rtol=1e-9)


@pytest.mark.parametrize("time", [1e-9, 1e-3, 1e6])
def test_extremes_stay_finite_and_in_range(time):
    for lamp, most in (
        (MainsLamp(1e9), 2.0),
        (MainsLamp(1e-9), 2.0),
        (PulsedLamp(1e9, 1e-9), 1e9),
        (PulsedLamp(1e-9, 1.0), 1.0),
        (Flash(0.0, 1e-12, 1e3), 1.0 + 1e3 / time),
    ):
        found = lamp.mean_light(np.array([-1e6, 0.0, 1e-12, 1e6]), time)
        assert np.isfinite(found).all()
        assert ((found >= -1e-12) & (found <= most * (1 + 1e-9))).all()


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: MainsLamp(0.0), "frequency"),
        (lambda: MainsLamp(depth=1.5), "depth"),
        (lambda: MainsLamp(phase=math.nan), "phase"),
        (lambda: PulsedLamp(duty=0.0), "duty"),
        (lambda: PulsedLamp("100"), "frequency"),
        (lambda: Flash(decay=0.0), "decay"),
        (lambda: Flash(energy=-1.0), "energy"),
        (lambda: Lamp().mean_light(0.0, 0.0), "exposure_time"),
        (lambda: Lamp().row_light(0.0, 1.0, 0, 1e-5), "rows"),
        (lambda: Lamp().row_light(0.0, 1.0, 4, -1e-5), "row_time"),
        (lambda: Lamp().mean_light(math.inf, 1.0), "start"),
    ],
)
def test_bad_values_are_refused(make, name):
    with pytest.raises(ValueError, match=f"`{name}`"):
        make()


PHASES = st.floats(0.0, 1.0)
LAMPS = st.one_of(
    st.builds(Lamp),
    st.builds(MainsLamp, log_uniform(1, 1e5), st.floats(0, 1), PHASES),
    st.builds(PulsedLamp, log_uniform(1, 1e5), log_uniform(1e-6, 1), PHASES),
    st.builds(Flash, st.floats(-1, 1), log_uniform(1e-6, 1), log_uniform(1e-6, 10)),
)


@given(LAMPS, st.floats(-10, 10), log_uniform(1e-6, 10), log_uniform(1e-6, 10))
def test_lamps_add_up_over_time(lamp, start, first, second):
    def light(begin: float, time: float) -> float:
        mean = float(lamp.mean_light(begin, time))
        assert 0.0 <= mean < math.inf
        return mean * time

    parts = light(start, first) + light(start + first, second)
    brightest = 1.0 / lamp.duty if isinstance(lamp, PulsedLamp) else 2.0
    if isinstance(lamp, Flash):
        brightest = 1.0 + lamp.energy / lamp.decay
    # A moment is known to an ulp of 16 s: so the light at both ends of a part, at its brightest.
    bound = 8 * 2.0**-48 * brightest
    assert parts == pytest.approx(light(start, first + second), rel=1e-12, abs=bound)


@given(LAMPS, st.floats(-10, 10))
def test_long_exposures_see_the_mean(lamp, start):
    bound = 2e-6 * max(1.0, getattr(lamp, "energy", 0.0))
    assert float(lamp.mean_light(start, 1e6)) == pytest.approx(1.0, abs=bound)
