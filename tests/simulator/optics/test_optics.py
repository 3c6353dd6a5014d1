"""Lenses against geometry, paths against shifted images, lamps against quadrature.

Nothing here uses the layers that thin lenses work with: expected pictures are sums over points
of the aperture, each of which sees two planes through its own pinhole.
"""

import math
from collections.abc import Callable, Sequence
from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.ndimage import correlate

from simulator.optics.flicker_integral import Lamp, MainsLamp, PulsedLamp
from simulator.optics.motion import (
    Movement,
    Path,
    Taps,
    motion_blur,
    path_blur,
    path_blur_apart,
    path_taps,
)
from simulator.optics.thin_lens import Lens, defocus
from tests.strategies import log_uniform


@pytest.mark.parametrize("focus", [0.5, 2.0, 30.0])
@pytest.mark.parametrize("depth", [0.3, 1.0, 2.0, 500.0])
def test_circle_of_confusion_follows_from_similar_triangles(focus, depth):
    # The cone from the aperture (diameter f / N) converges at v, the sensor stands at v_focus.
    v, v_focus = (1.0 / (1.0 / 0.05 - 1.0 / distance) for distance in (depth, focus))
    expected = (0.05 / 2.8) * (v_focus - v) / v
    found = Lens(0.05, focus).circle_of_confusion(depth, 2.8)
    assert found == pytest.approx(expected, rel=1e-12, abs=1e-18)


@pytest.mark.parametrize(
    ("values", "name"),
    [((bad, math.inf), "focal_length") for bad in (0.0, math.inf, math.nan)]
    + [((0.05, bad), "focus_distance") for bad in (0.05, -1.0, math.nan)],
)
def test_lens_refuses(values, name):
    with pytest.raises(ValueError, match=f"`{name}`.*must be"):
        Lens(*values)


def test_blur_too_small_to_see_leaves_every_bit():
    light = torch.rand(4, 9, 13, generator=torch.Generator().manual_seed(0))
    ripple = 0.1 * torch.rand(9, 13, generator=torch.Generator().manual_seed(1))
    assert torch.equal(defocus(light, ripple - 0.05), light)


@pytest.mark.parametrize("case", ["step", "ramp", "through_focus", "stairs", "noise", "islands"])
def test_equal_light_shows_no_seam(case):
    rng = np.random.default_rng(3)
    rows, columns = np.mgrid[:48, :40]
    diameter = {
        "step": np.where(columns < 20, -7.0, 5.0),
        "ramp": 1.0 + columns * 0.2,
        "through_focus": (columns - 20) * 0.3,
        "stairs": (columns // 8) * 3.0 - 6.0,
        "noise": rng.uniform(-8.0, 8.0, (48, 40)),
        "islands": np.where((rows // 6 + columns // 6) % 2 == 0, 0.0, 9.0),
    }[case]
    level = torch.tensor([0.2, 3.0])[:, None, None].expand(2, 48, 40)
    found = defocus(level, torch.from_numpy(diameter))
    torch.testing.assert_close(found, level.contiguous(), rtol=2e-6, atol=0.0)


@pytest.mark.parametrize("row", range(20, 44, 3))
def test_lamp_on_a_receding_floor_keeps_its_energy(row):
    # The floor rises through many layers of blur; none of them stands in the way of its neighbour.
    diameter = torch.linspace(10, 2, 64, dtype=torch.float64)[:, None].expand(64, 48)
    floor = torch.full((1, 64, 48), 0.2, dtype=torch.float64)
    lit = floor.clone()
    lit[0, row, 24] += 100.0
    gained = float((defocus(lit, diameter) - defocus(floor, diameter)).sum())
    assert gained == pytest.approx(100.0, rel=0.05)


def test_sharp_foreground_is_untouched_by_a_bright_blurred_background():
    near = np.broadcast_to(np.arange(60) < 30, (40, 60))
    low, high = np.where(near, 0.01, 50.0), np.where(near, 0.1, 900.0)
    drawn = np.random.default_rng(0).uniform(low, high, (4, 40, 60))
    light = torch.from_numpy(drawn.astype(np.float32))
    found = defocus(light, torch.from_numpy(np.where(near, 0.0, 13.0)))
    assert torch.equal(found[:, :, :30], light[:, :, :30])
    assert float(found[:, :, 30:].min()) > 50.0  # nor does the dark foreground spill over


Texture = Callable[[np.ndarray, np.ndarray], np.ndarray]


def light_of_planes(hides: np.ndarray, near: Sequence, far: Sequence) -> np.ndarray:
    """Each plane's texture at its own rows and columns."""
    nearer = 0.5 + 0.3 * np.sin(near[0] * 0.9) * np.cos(near[1] * 0.7)
    farther = 3.0 + 1.5 * np.sin(far[0] * 0.25 + 1.0) + 0.5 * np.cos(far[1] * 0.25)
    return np.where(hides, nearer, farther)


def through_an_aperture(shape: Texture, near_blur: float, far_blur: float) -> np.ndarray:
    """What the sensor gets of two planes: a mean over aperture points and points of a pixel."""
    grid = (np.arange(20) + 0.5) / 10 - 1
    aperture = [(a, b) for a in grid for b in grid if a * a + b * b < 1]
    rows, columns = np.mgrid[:56, :72].astype(float)
    total = np.zeros(rows.shape)
    for number, (a, b) in enumerate(aperture):
        y, x = rows + (number * 0.618) % 1 - 0.5, columns + (number * 0.755) % 1 - 0.5
        near, far = ((y - blur / 2 * a, x - blur / 2 * b) for blur in (near_blur, far_blur))
        hides = shape(np.rint(near[0]), np.rint(near[1]))  # the edge of a mask of whole pixels
        total += light_of_planes(hides, near, far)
    return total / len(aperture)


SHAPES: dict[str, Texture] = {
    "half": lambda rows, columns: columns < 36,
    "pole": lambda rows, columns: abs(columns - 36) < 3,
    "disc": lambda rows, columns: (columns - 36) ** 2 + (rows - 28) ** 2 < 13**2,
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("blurs", [(0, 8), (-8, 0), (4, 10), (-10, -4), (-8, 8), (-8, 4)])
def test_two_planes_against_rays(shape, blurs):
    # What is hidden is not in the picture: it can be right only as far as the texture is smooth.
    rows, columns = np.mgrid[:56, :72]
    mask = SHAPES[shape](rows, columns)
    picture = light_of_planes(mask, (rows, columns), (rows, columns))
    diameter = torch.from_numpy(np.where(mask, *map(float, blurs)))
    found = defocus(torch.from_numpy(picture)[None], diameter)[0].numpy()
    expected = through_an_aperture(SHAPES[shape], *blurs)
    errors = ((image - expected)[10:-10, 10:-10] for image in (found, picture))
    error, change = map(np.linalg.norm, errors)
    assert error < 0.15 * change


# -- paths -----------------------------------------------------------------------------------------

PATHS = [
    Path(0.3, 0.4),
    Path(2.0, math.pi / 2),
    Path(7.3, 0.7, 1.2),
    Path(20.0, -2.0, -5.0),
    Path(9.0, 1.0, 0.5, drift_x=-6.0, drift_y=4.0),
    Path(0.0, drift_x=3.0, drift_y=-5.0),
]


def _velocity(path: Path, u: float) -> tuple[float, float]:
    angle = path.direction + path.turn * u
    x, y = path.extent * math.cos(angle), path.extent * math.sin(angle)
    return x + path.drift_x, y + path.drift_y


def _moments(path: Path) -> list[float]:
    """Variances of x and y over the exposure, from its velocities."""
    u = (np.arange(2000) + 0.5) / 2000
    angle = path.direction + path.turn * u
    x = np.cumsum(path.extent * np.cos(angle) + path.drift_x) / len(u)
    y = np.cumsum(path.extent * np.sin(angle) + path.drift_y) / len(u)
    return [float(x.var()), float(y.var())]


def _dense(taps: Taps) -> np.ndarray:
    """The taps as an odd kernel that `scipy.ndimage.correlate` takes."""
    reach = int(max(np.abs(taps.rows).max(), np.abs(taps.columns).max()))
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    np.add.at(kernel, (taps.rows + reach, taps.columns + reach), taps.weights.astype(float))
    return kernel


@pytest.mark.parametrize("path", PATHS)
def test_taps_have_the_moments_of_the_path(path: Path) -> None:
    taps = path_taps(path, 200, 200)
    weights = taps.weights.astype(float)
    length = quad(lambda u: math.hypot(*_velocity(path, u)), 0.0, 1.0)[0]
    assert path.length == pytest.approx(length, rel=2e-3)
    assert weights.sum() == pytest.approx(1.0, abs=1e-6)
    assert (weights >= 0.0).all()
    for places, wanted in zip((taps.columns, taps.rows), _moments(path), strict=True):
        assert (weights * places).sum() == pytest.approx(0.0, abs=1e-4)
        assert (weights * places**2).sum() == pytest.approx(wanted, rel=2e-3, abs=1e-6)


def test_a_movement_makes_paths_in_pixels() -> None:
    movement = Movement(0.5, 2.0, subject_speed=0.3, subject_direction=math.pi / 2)
    assert movement.path(0.2, 0.5, 64) == Path(6.4, 0.5, 1.0)
    own = movement.subject_path(0.2, 0.5, 64)
    assert own == pytest.approx((6.4, 0.5, 1.0, 0.0, 9.6))
    lengths = movement.subject_extent(0.2, np.array([0.5, 0.1])) * 64
    assert lengths[0] == pytest.approx(own.length)
    with pytest.raises(ValueError, match="subject_speed"):
        Movement(subject_speed=-1.0)
    with pytest.raises(ValueError, match="finite"):
        Movement(turn=math.inf)


@pytest.mark.parametrize("extent", [0.0, 0.4, 3.0, 17.7, 300.0])
def test_a_straight_path_along_the_rows_is_the_streak(extent: float) -> None:
    light = torch.rand(4, 24, 40, generator=torch.Generator().manual_seed(0))
    taps = path_taps(Path(extent), 24, 40)
    wanted = motion_blur(light.double(), extent)
    torch.testing.assert_close(path_blur(light, taps).double(), wanted, atol=2e-6, rtol=0.0)


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("size", [(30, 26), (5, 9)])
def test_blur_is_a_sum_of_shifts(path: Path, size: tuple[int, int]) -> None:
    """By SciPy, whose ``nearest`` replicates the border; shifts may leave the frame."""
    light = torch.rand(3, *size, generator=torch.Generator().manual_seed(1))
    blurred = path_blur(light, path_taps(path, *size))
    kernel = _dense(path_taps(path, 100, 100))
    for plane, found in zip(light.double().numpy(), blurred, strict=True):
        wanted = correlate(plane, kernel, mode="nearest")
        np.testing.assert_allclose(found, wanted, atol=1e-5)


def test_light_is_limited_before_it_is_blurred() -> None:
    light = torch.zeros(1, 9, 9)
    light[0, 4, 4] = 1e12
    blurred = path_blur(light, path_taps(Path(3.0, 0.8), 9, 9), limit=1e3)
    assert float(blurred.sum()) == pytest.approx(1e3, rel=1e-5)


def _apart(light: torch.Tensor, mask: np.ndarray, path: Path, own: Path) -> torch.Tensor:
    height, width = mask.shape
    behind = np.arange(height * width).reshape(height, width)
    behind[mask] = behind[~mask][0]
    return path_blur_apart(
        light,
        torch.from_numpy(mask)[None].float(),
        torch.from_numpy(behind),
        path_taps(path, height, width),
        path_taps(own, height, width),
    )


def test_a_moving_subject_keeps_its_light_and_has_no_dark_fringe() -> None:
    mask = np.zeros((40, 40), bool)
    mask[15:22, 15:22] = True
    path, own = Path(6.0, 1.0), Path(6.0, 1.0, drift_x=9.0)
    even = _apart(torch.full((1, 40, 40), 0.3), mask, path, own)
    torch.testing.assert_close(even, torch.full((1, 40, 40), 0.3))
    lamp = torch.from_numpy(np.where(mask, 5.0, 0.0).astype(np.float32))[None]
    assert float(_apart(lamp, mask, path, own).sum()) == pytest.approx(5.0 * mask.sum(), rel=1e-5)
    white = _apart(torch.ones(1, 40, 40) - lamp / 5.0, mask, path, own)  # a black subject
    assert 0.0 <= float(white.min()) < float(white.max()) == pytest.approx(1.0)


# -- lamps: light in closed form, by adaptive quadrature and exact fractions -----------------------

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


def test_rows_are_exposed_one_after_the_other():
    lamp, time, row_time = MainsLamp(100.0, 0.8), 1 / 1000, 20e-6
    rows = lamp.row_light(0.5, time, 64, row_time, sensor_rows=4)
    starts = 0.5 + row_time * np.arange(64 * 4).reshape(64, 4)
    wanted = np.vectorize(lamp.mean_light)(starts, time).mean(1)
    np.testing.assert_allclose(rows, wanted, rtol=1e-12)
    # Bands of one period: 10 ms are 500 sensor rows of 20 us, 125 rows of four.
    repeated = lamp.row_light(0.5, time, 250, row_time, sensor_rows=4)
    np.testing.assert_allclose(repeated[:125], repeated[125:], rtol=1e-9)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: MainsLamp(0.0), "frequency"),
        (lambda: MainsLamp(depth=1.5), "depth"),
        (lambda: MainsLamp(phase=math.nan), "phase"),
        (lambda: PulsedLamp(duty=0.0), "duty"),
        (lambda: PulsedLamp("100"), "frequency"),
        (lambda: Lamp().mean_light(0.0, 0.0), "exposure_time"),
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
)


@given(LAMPS, st.floats(-10, 10), log_uniform(1e-6, 10), log_uniform(1e-6, 10))
def test_lamps_add_up_over_time(lamp, start, first, second):
    def light(begin: float, time: float) -> float:
        mean = float(lamp.mean_light(begin, time))
        assert 0.0 <= mean < math.inf
        return mean * time

    parts = light(start, first) + light(start + first, second)
    brightest = 1.0 / lamp.duty if isinstance(lamp, PulsedLamp) else 2.0
    # A moment is known to an ulp of 16 s: so the light at both ends of a part, at its brightest.
    bound = 8 * 2.0**-48 * brightest
    assert parts == pytest.approx(light(start, first + second), rel=1e-12, abs=bound)


@given(LAMPS, st.floats(-10, 10))
def test_long_exposures_see_the_mean(lamp, start):
    assert float(lamp.mean_light(start, 1e6)) == pytest.approx(1.0, abs=2e-6)
