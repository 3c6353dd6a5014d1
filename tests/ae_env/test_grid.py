"""The exposure grid: order of the states, exposure values, errors."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import torch

from ae_env.grid import ExposureGrid


def test_default_grid_is_the_documented_one() -> None:
    grid = ExposureGrid.default()
    assert len(grid) == 64
    assert grid.isos == (100, 400, 1600, 6400)
    assert [Fraction(t).limit_denominator(2000) for t in grid.exposure_times] == [
        Fraction(1, 1000),
        Fraction(1, 125),
        Fraction(1, 15),
        Fraction(1, 2),
    ]
    assert grid.f_numbers == (4, 5.6, 8, 11)


def test_index_runs_over_aperture_then_time_then_iso() -> None:
    grid = ExposureGrid.default()
    for i, state in enumerate(grid):
        iso, time, aperture = i // 16, i // 4 % 4, i % 4
        assert grid.index(iso, time, aperture) == i
        assert grid.controls(i).tolist() == [iso, time, aperture]
        assert state == grid[i]
        assert state.iso == grid.isos[iso]
        assert state.exposure_time == grid.exposure_times[time]
        assert state.f_number == grid.f_numbers[aperture]


def test_exposure_values_by_hand() -> None:
    grid = ExposureGrid.default()
    # f/4 at 1/1000 s, ISO 100: log2(16 * 1000); marked f/5.6 and f/11 stand for sqrt(32), sqrt(128)
    assert grid.ev100[0] == pytest.approx(np.log2(16 * 1000))
    assert grid.ev100[grid.index(0, 1, 1)] == pytest.approx(np.log2(32 * 125))
    assert grid.ev100[grid.index(3, 3, 3)] == pytest.approx(np.log2(128 * 2 / 64))
    assert grid.ev100.dtype == np.float64
    assert round(float(grid.ev100.max())) == 17
    assert round(float(grid.ev100.min())) == -1


def test_every_whole_stop_is_there() -> None:
    values = np.unique(ExposureGrid.default().ev100.round().astype(int))
    assert values.tolist() == list(range(-1, 18))


def test_nearest_takes_the_lower_iso() -> None:
    grid = ExposureGrid.default()
    for target in (-5.0, 0.0, 7.2, 30.0):
        distance = np.abs(grid.ev100 - target)
        assert grid.nearest(target) == np.flatnonzero(distance < distance.min() + 1e-9)[0]
    with pytest.raises(ValueError, match="`ev100`"):
        grid.nearest(float("nan"))


def test_third_stop_grid() -> None:
    grid = ExposureGrid.third_stop()
    assert len(grid) == 19 * 28 * 4
    np.testing.assert_allclose(np.diff(np.log2(grid.isos)), 1 / 3)
    np.testing.assert_allclose(np.diff(np.log2(grid.exposure_times)), 1 / 3)
    assert (grid.isos[0], grid.isos[-1]) == pytest.approx((100, 6400))
    assert grid.exposure_times[-1] == pytest.approx(1 / 2)


def test_spec_forms_are_equal() -> None:
    lists = {"isos": [100, 200], "exposure_times": [0.01], "f_numbers": [2.8, 4]}
    grid = ExposureGrid.from_spec(lists)
    assert grid == ExposureGrid((100, 200), (0.01,), (2.8, 4)) == ExposureGrid.from_spec(grid)
    assert grid.shape == (2, 1, 2)
    assert ExposureGrid.from_spec("default") == ExposureGrid.default()


@pytest.mark.parametrize(
    "make",
    [torch.tensor, np.array, iter, tuple, dict.fromkeys, lambda own: dict.fromkeys(own).keys()],
)
def test_axes_are_any_numbers(make) -> None:
    lists = ([100, 200], [0.125, 0.25], [2.0, 4.0])
    grid = ExposureGrid(*map(make, lists))
    assert grid == ExposureGrid(*map(tuple, lists))
    assert {type(value) for value in grid.isos} == {float}


@pytest.mark.parametrize("spec", ["defalt", {"isos": [100]}, 5, None])
def test_bad_specs_are_refused(spec: object) -> None:
    with pytest.raises(ValueError, match="`grid`"):
        ExposureGrid.from_spec(spec)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("isos", "times", "f_numbers", "name"),
    [
        ((), (0.1,), (4,), "isos"),
        ((200, 100), (0.1,), (4,), "isos"),
        ((100,), (0.1, 0.1), (4,), "exposure_times"),
        ((100,), (0.1,), (0.0,), "f_number"),
        ((-1, 100), (0.1,), (4,), "iso"),
        (np.array(100), (0.1,), (4,), "isos"),
        (torch.tensor([[100, 200]]), (0.1,), (4,), "isos"),
    ],
)
def test_bad_lists_are_refused(isos: tuple, times: tuple, f_numbers: tuple, name: str) -> None:
    with pytest.raises(ValueError, match=name):
        ExposureGrid(isos, times, f_numbers)
