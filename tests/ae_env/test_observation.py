"""The exposure grid, and the observation's encodings and their inverses."""

import json
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ae_env.grid import ExposureGrid
from ae_env.observation import (
    PEDESTAL,
    SENSOR_RANGES,
    decode_observation,
    decode_sensors,
    decode_settings,
    encode_observation,
    encode_sensors,
    encode_settings,
    frame_statistics,
)
from tests.ae_env.environments import make_envs
from tests.strategies import LIGHT, SEEDS, grids, lights, log_uniform


def test_codes_follow_the_formula() -> None:
    p = 1 / 1024
    for x in (-1.0, -p, -0.0005, 0.0, 1e-4, 0.119, 0.5, 1.0, 7.0):
        clipped = min(max(x, -p), 1.0)
        expected = round(255 * math.sqrt((clipped + p) / (1 + p)))
        assert int(encode_observation(torch.tensor([x]))[0]) == expected
    assert p == PEDESTAL


def test_settings_map_fixed_ranges() -> None:
    apex = np.array([[0.0, -5.0, 4.0], [10.0, 15.0, 17.0], [5.0, 5.0, 10.5], [-9.0, 99.0, 4.0]])
    encoded = encode_settings(apex)
    assert encoded.dtype == np.float32
    np.testing.assert_allclose(encoded, [[-1] * 3, [1] * 3, [0] * 3, [-1, 1, -1]], atol=1e-7)
    for got, expected in zip(decode_settings(encoded[:3]), apex[:3].T, strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-6)


@given(lights(LIGHT))
def test_observations_are_monotone_and_within_half_a_code(light: torch.Tensor) -> None:
    signal = light.flatten().sort().values
    codes = encode_observation(signal).numpy()
    assert bool((np.diff(codes.astype(int)) >= 0).all())

    def root(x: np.ndarray) -> np.ndarray:  # the scale on which codes are evenly spaced
        return 255 * np.sqrt((x.astype(np.float64) + PEDESTAL) / (1 + PEDESTAL))

    clipped = np.clip(signal.numpy(), -PEDESTAL, 1.0)
    assert np.abs(root(decode_observation(codes)) - root(clipped)).max() <= 0.5 + 1e-4
    every = np.arange(256, dtype=np.uint8)
    again = encode_observation(torch.from_numpy(decode_observation(every)))
    np.testing.assert_array_equal(again.numpy(), every)


@given(st.floats(0.0, 1e300), log_uniform(1e-3, 1e3), st.floats(-10, 10), st.floats(-10, 10))
def test_sensors_are_decoded_as_they_read(speed, defocus, first, second):
    noise = np.array([[first, second]])
    encoded = encode_sensors(np.array([speed]), np.array([defocus]), noise)
    assert np.abs(encoded).max() <= 1.0
    low, high = 2.0**SENSOR_RANGES.T
    for found, true, off, least, most in zip(
        decode_sensors(encoded[0]), (speed, defocus), (first, second), low, high, strict=True
    ):
        log2 = math.log2(true) if true else -math.inf
        reading = log2 + off * 0.15 / math.log(2)
        if reading <= math.log2(least):
            assert found in (0.0, least)
        else:
            assert found == pytest.approx(2.0 ** min(reading, math.log2(most)), rel=1e-5)


def test_statistics_are_means_and_shares_of_the_frame():
    """Against sums over the decoded frame; 36 rows are 12 zones of 3, 36 columns 16 of 2 or 3."""
    codes = np.random.default_rng(0).integers(0, 256, (2, 4, 36, 36), dtype=np.uint8)
    codes[0, :, :3, :2] = 255
    found = frame_statistics(codes)
    assert {k: (v.shape, v.dtype.name) for k, v in found.items()} == {
        "raw": ((2, 4, 12, 16), "uint8"),
        "histogram": ((2, 128), "float32"),
        "clipped": ((2, 2), "float32"),
    }
    assert (found["raw"][0, :, 0, 0] == 255).all()
    signal = decode_observation(codes)[1, 2, 3:6, 2:4].mean()  # the second zone of each
    assert abs(int(found["raw"][1, 2, 1, 1]) - 255 * ((signal + 2**-10) / (1 + 2**-10)) ** 0.5) < 1
    assert found["histogram"].sum(axis=1) == pytest.approx(1.0)
    assert found["histogram"][1, 5] == pytest.approx(np.isin(codes[1], (10, 11)).mean())
    np.testing.assert_allclose(found["clipped"][:, 0], (codes == 255).mean(axis=(1, 2, 3)))
    np.testing.assert_allclose(found["clipped"][:, 1], (codes == 0).mean(axis=(1, 2, 3)))


def test_environments_observe_the_statistics_of_their_frames() -> None:
    pictured = {"render_mode": "rgb_array"}
    envs, whole = make_envs(3, observation="statistics", **pictured), make_envs(3, **pictured)
    for found, frames in (
        (envs.reset(seed=4), whole.reset(seed=4)),
        (envs.step([1, 30, 60]), whole.step([1, 30, 60])),
    ):
        expected = frame_statistics(frames[0]["raw"])
        assert envs.observation_space.contains(found[0])
        for name, values in expected.items():
            np.testing.assert_array_equal(found[0][name], values)
        np.testing.assert_array_equal(found[0]["settings"], frames[0]["settings"])
    np.testing.assert_array_equal(envs.render(), whole.render())  # the picture is the whole frame
    numbers = sum(np.prod(space.shape) for space in envs.single_observation_space.values())
    assert numbers == 4 * 12 * 16 + 128 + 2 + 3 + 2


def test_exposure_values_by_hand() -> None:
    times = (1 / 1000, 1 / 125, 1 / 15, 1 / 2)
    grid = ExposureGrid((100, 400, 1600, 6400), times, (4, 5.6, 8, 11))
    assert ExposureGrid.default() == grid
    # f/4 at 1/1000 s, ISO 100: log2(16 * 1000); marked f/5.6 and f/11 stand for sqrt(32), sqrt(128)
    assert grid.ev100[0] == pytest.approx(np.log2(16 * 1000))
    assert grid.ev100[grid.index(0, 1, 1)] == pytest.approx(np.log2(32 * 125))
    assert grid.ev100[grid.index(3, 3, 3)] == pytest.approx(np.log2(128 * 2 / 64))
    third = ExposureGrid.third_stop()
    for values, ends in ((third.isos, (100, 6400)), (third.exposure_times, (2**-10, 1 / 2))):
        np.testing.assert_allclose(np.diff(np.log2(values)), 1 / 3)
        assert (values[0], values[-1]) == pytest.approx(ends)


def test_nearest_takes_the_lower_iso() -> None:
    grid = ExposureGrid.default()
    for target in (-5.0, 0.0, 7.2, 30.0):
        distance = np.abs(grid.ev100 - target)
        assert grid.nearest(target) == np.flatnonzero(distance < distance.min() + 1e-9)[0]
    with pytest.raises(ValueError, match="`ev100`"):
        grid.nearest(float("nan"))


def test_axes_are_any_numbers() -> None:
    lists = ([100, 200], [0.125, 0.25], [2.0, 4.0])
    wanted = ExposureGrid(*map(tuple, lists))
    for make in (torch.tensor, np.array, iter, dict.fromkeys):
        grid = ExposureGrid(*map(make, lists))
        assert grid == wanted
        assert {type(value) for value in grid.isos} == {float}


@given(grids(), SEEDS)
def test_grids_are_what_their_lists_say(grid: ExposureGrid, seed: int) -> None:
    lists = {n: getattr(grid, n) for n in ("isos", "exposure_times", "f_numbers")}
    assert ExposureGrid.from_spec(json.loads(json.dumps(lists))) == grid
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
