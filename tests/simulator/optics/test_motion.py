"""Paths: their length, the moments of their taps, and blur against shifted images."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.ndimage import correlate

from simulator.optics.motion import (
    Movement,
    Path,
    Taps,
    motion_blur,
    path_blur,
    path_blur_apart,
    path_taps,
)

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
    return (
        path.extent * math.cos(angle) + path.drift_x,
        path.extent * math.sin(angle) + path.drift_y,
    )


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
    assert weights.sum() == pytest.approx(1.0, abs=1e-6)
    assert (weights >= 0.0).all()
    for places, wanted in zip((taps.columns, taps.rows), _moments(path), strict=True):
        assert (weights * places).sum() == pytest.approx(0.0, abs=1e-4)
        assert (weights * places**2).sum() == pytest.approx(wanted, rel=2e-3, abs=1e-6)


@pytest.mark.parametrize("path", PATHS)
def test_length_is_that_of_the_path(path: Path) -> None:
    wanted = quad(lambda u: math.hypot(*_velocity(path, u)), 0.0, 1.0)[0]
    assert path.length == pytest.approx(wanted, rel=2e-3)


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


def test_long_paths_cost_no_more_than_the_frame() -> None:
    assert len(path_taps(Path(1e5, 0.3, 2.0), 64, 64).weights) < 1000


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
