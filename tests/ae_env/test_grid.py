"""The exposure grid: order of the states, exposure values, errors."""

import json

import numpy as np
import pytest
import torch
from hypothesis import given

from ae_env.grid import ExposureGrid
from tests.strategies import SEEDS, grids


def test_default_grid_is_the_documented_one() -> None:
    times = (1 / 1000, 1 / 125, 1 / 15, 1 / 2)
    grid = ExposureGrid((100, 400, 1600, 6400), times, (4, 5.6, 8, 11))
    assert ExposureGrid.default() == grid
    assert len(grid) == 64


def test_exposure_values_by_hand() -> None:
    grid = ExposureGrid.default()
    # f/4 at 1/1000 s, ISO 100: log2(16 * 1000); marked f/5.6 and f/11 stand for sqrt(32), sqrt(128)
    assert grid.ev100[0] == pytest.approx(np.log2(16 * 1000))
    assert grid.ev100[grid.index(0, 1, 1)] == pytest.approx(np.log2(32 * 125))
    assert grid.ev100[grid.index(3, 3, 3)] == pytest.approx(np.log2(128 * 2 / 64))
    assert grid.ev100.dtype == np.float64
    assert round(float(grid.ev100.max())) == 17
    assert round(float(grid.ev100.min())) == -1


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


@pytest.mark.parametrize(
    "make",
    [torch.tensor, np.array, iter, tuple, dict.fromkeys, lambda own: dict.fromkeys(own).keys()],
)
def test_axes_are_any_numbers(make) -> None:
    lists = ([100, 200], [0.125, 0.25], [2.0, 4.0])
    grid = ExposureGrid(*map(make, lists))
    assert grid == ExposureGrid(*map(tuple, lists))
    assert {type(value) for value in grid.isos} == {float}


def _spec(grid: ExposureGrid) -> dict[str, list[float]]:
    """The grid as an environment's argument, by way of JSON."""
    lists = {n: getattr(grid, n) for n in ("isos", "exposure_times", "f_numbers")}
    return json.loads(json.dumps(lists))


@given(grids(), SEEDS)
def test_grids_are_what_their_lists_say(grid: ExposureGrid, seed: int) -> None:
    assert ExposureGrid.from_spec(_spec(grid)) == grid
    states = np.arange(len(grid))
    controls = grid.controls(states)
    assert [grid.index(*row) for row in controls.tolist()] == states.tolist()
    for state, (i, t, n) in zip(grid, controls.tolist(), strict=True):
        wanted = (grid.isos[i], grid.exposure_times[t], grid.f_numbers[n])
        assert (state.iso, state.exposure_time, state.f_number) == wanted
    for state in np.random.default_rng(seed).choice(states, 3):
        nearest = grid.nearest(grid.ev100[state])
        assert nearest <= state
        assert grid.ev100[nearest] == pytest.approx(grid.ev100[state], abs=1e-9)
