"""Exposure grid, encodings of observations and their inverses, and the action wrappers."""

import json
import math
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from hypothesis import given
from hypothesis import strategies as st

from ae_env import observation as obs
from ae_env import wrappers
from ae_env.grid import ExposureGrid
from ae_env.wrappers import ContinuousActions, ControlActions, RelativeActions
from tests.ae_env.environments import assert_equal, make_env, make_envs
from tests.strategies import LIGHT, SEEDS, grids, lights, log_uniform


def test_settings_map_fixed_ranges() -> None:
    apex = np.array([[0.0, -5.0, 4.0], [10.0, 15.0, 17.0], [5.0, 5.0, 10.5], [-9.0, 99.0, 4.0]])
    encoded = obs.encode_settings(apex)
    assert encoded.dtype == np.float32
    np.testing.assert_allclose(encoded, [[-1] * 3, [1] * 3, [0] * 3, [-1, 1, -1]], atol=1e-7)
    for got, expected in zip(obs.decode_settings(encoded[:3]), apex[:3].T, strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-6)


@given(lights(LIGHT))
def test_observations_are_monotone_and_within_half_a_code(light: torch.Tensor) -> None:
    known = torch.tensor([-1.0, -1 / 1024, -0.0005, 0.0, 1e-4, 0.119, 0.5, 1.0, 7.0])
    signal = torch.cat([light.flatten(), known]).sort().values
    codes = obs.encode_observation(signal).numpy()
    assert bool((np.diff(codes.astype(int)) >= 0).all())

    def root(x: np.ndarray) -> np.ndarray:  # the scale on which codes are evenly spaced
        return 255 * np.sqrt((x.astype(np.float64) + 1 / 1024) / (1 + 1 / 1024))

    clipped = np.clip(signal.numpy(), -1 / 1024, 1.0)
    assert np.abs(root(obs.decode_observation(codes)) - root(clipped)).max() <= 0.5 + 1e-4
    every = np.arange(256, dtype=np.uint8)
    again = obs.encode_observation(torch.from_numpy(obs.decode_observation(every)))
    np.testing.assert_array_equal(again.numpy(), every)


@given(st.floats(0.0, 1e300), log_uniform(1e-3, 1e3), st.floats(-10, 10), st.floats(-10, 10))
def test_sensors_are_decoded_as_they_read(speed, defocus, first, second):
    noise = np.array([[first, second]])
    encoded = obs.encode_sensors(np.array([speed]), np.array([defocus]), noise)
    assert np.abs(encoded).max() <= 1.0
    low, high = 2.0**obs.SENSOR_RANGES.T
    for found, true, off, least, most in zip(
        obs.decode_sensors(encoded[0]), (speed, defocus), (first, second), low, high, strict=True
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
    codes[0, :, :3, :2], codes[0, 0, 5:] = 255, codes[0, 0, 5:] % 9  # most of these below black
    found = obs.frame_statistics(codes)
    for name, values in obs.tensor_statistics(torch.from_numpy(codes)).items():
        np.testing.assert_allclose(values, found[name], rtol=1e-6, err_msg=name)
    assert {k: (v.shape, v.dtype.name) for k, v in found.items()} == {
        "raw": ((2, 4, 12, 16), "uint8"),
        "histogram": ((2, 128), "float32"),
        "clipped": ((2, 2), "float32"),
    }
    assert (found["raw"][0, :, 0, 0] == 255).all()
    signal = obs.decode_observation(codes)[1, 2, 3:6, 2:4].mean()  # the second zone of each
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
        expected = obs.frame_statistics(frames[0]["raw"])
        assert envs.observation_space.contains(found[0])
        for name, values in expected.items():
            np.testing.assert_array_equal(found[0][name], values)
        np.testing.assert_array_equal(found[0]["settings"], frames[0]["settings"])
    np.testing.assert_array_equal(envs.render(), whole.render())  # the picture is the whole frame


def test_exposure_values_by_hand_and_the_nearest_state() -> None:
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
    # The nearest one is that of the lower ISO.
    for target in (-5.0, 0.0, 7.2, 30.0):
        distance = np.abs(grid.ev100 - target)
        assert grid.nearest(target) == np.flatnonzero(distance < distance.min() + 1e-9)[0]
    with pytest.raises(ValueError, match="`ev100`"):
        grid.nearest(float("nan"))
    # Axes are any numbers.
    lists = ([100, 200], [0.125, 0.25], [2.0, 4.0])
    wanted = ExposureGrid(*map(tuple, lists))
    for make in (torch.tensor, np.array, iter, dict.fromkeys):
        grid = ExposureGrid(*map(make, lists))
        assert grid == wanted
        assert {type(value) for value in grid.isos} == {float}


SINGLE = [ControlActions, RelativeActions, ContinuousActions]
PAIRS = [(single, getattr(wrappers, f"Vector{single.__name__}")) for single in SINGLE]


@pytest.mark.parametrize(("single", "vector"), PAIRS)
def test_vector_twin_does_the_same(single: type, vector: type) -> None:
    envs = vector(make_envs(autoreset_mode="DISABLED"))
    alone = [single(make_env()) for _ in range(3)]
    envs.reset(seed=5)
    for i, env in enumerate(alone):
        env.reset(seed=5 + i)
        assert env.action_space == envs.single_action_space
    for _ in range(4):
        actions = envs.action_space.sample()
        assert actions.shape == (3, 3)
        if hasattr(envs, "action_masks"):
            expected = np.stack([env.action_masks() for env in alone])
            np.testing.assert_array_equal(envs.action_masks(), expected)
        observation, reward, _, _, info = envs.step(actions)
        for i, env in enumerate(alone):
            one, score, _, _, single_info = env.step(actions[i])
            assert (single_info["state"], score) == (info["state"][i], reward[i])
            np.testing.assert_array_equal(one["raw"], observation["raw"][i])


@pytest.mark.parametrize("single", SINGLE)
def test_wrapped_spec_round_trips_through_json(single: type) -> None:
    env = single(make_env(sensors=False))
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.action_space == env.action_space
    assert again.observation_space == env.observation_space
    assert_equal(again.reset(seed=3), env.reset(seed=3))
    action = env.action_space.sample()
    assert_equal(again.step(action), env.step(action))


def test_masks_are_the_union_per_control() -> None:
    """Allowed: two states that differ in every control, whose mixtures are forbidden."""
    grid = {"isos": [100, 200], "exposure_times": [0.01, 0.02, 0.04], "f_numbers": [4, 8]}
    base = make_env(grid=grid)
    inner = base.unwrapped
    allowed = np.zeros(12, bool)
    allowed[[inner.grid.index(0, 0, 1), inner.grid.index(1, 2, 0)]] = True
    scenes = [replace(inner.scenes[0], allowed=allowed)]
    env = make_env(grid=grid, scenes=scenes, simulator=None)
    env.reset(seed=0, options={"state": inner.grid.index(1, 1, 0)})
    controls = [True, True, True, False, True, True, True]
    np.testing.assert_array_equal(ControlActions(env).action_masks(), controls)
    # From ISO 200, 0.02 s, f/4: any ISO, not the same time, any aperture; down stays at the end.
    steps = [True, True, True, True, False, True, True, True, True]
    np.testing.assert_array_equal(RelativeActions(env).action_masks(), steps)
    nearest = ContinuousActions(env).action(np.array([1.0, 1.0, 1.0]))  # f/8, 0.01 s, ISO 200
    assert nearest == inner.grid.index(0, 0, 1)
    envs = make_envs(2, grid=grid, scenes=scenes)
    envs.reset(seed=0, options={"state": [inner.grid.index(1, 1, 0), 0]})
    masks = wrappers.VectorControlActions(envs).action_masks()
    np.testing.assert_array_equal(masks, [controls] * 2)
    np.testing.assert_array_equal(wrappers.VectorRelativeActions(envs).action_masks()[0], steps)


@pytest.mark.parametrize(("single", "vector"), PAIRS)
def test_odd_actions_and_other_environments_are_refused(single: type, vector: type) -> None:
    one, many = single(make_env()), vector(make_envs())
    one.reset(seed=0)
    many.reset(seed=0)
    odd = [None, "x", 1, [1, 1], [1, 1, math.nan], [1, 1, "x"], [[1], [1, 1]], [True] * 3]
    odd += [[1, 1, 1j]] if single is ContinuousActions else [[0, 0, -1], [0, 0, 4], [0.0] * 3]
    for action in odd:
        with pytest.raises(ValueError, match="`action`"):
            one.action(action)
        with pytest.raises(ValueError, match="`action`"):
            many.actions([action] * 3)
    for make, message in (
        (lambda: single(gym.make("CartPole-v1")), "`env`"),
        (lambda: single(one), "wrapped already"),
        (lambda: vector(gym.make("CartPole-v1")), "`env`"),
        (lambda: vector(gym.make_vec("CartPole-v1", vectorization_mode="sync")), "make_vec"),
    ):
        with pytest.raises(ValueError, match=message):
            make()


@given(grids(), SEEDS)
def test_other_ways_to_act_reach_every_state(grid: ExposureGrid, seed: int) -> None:
    lists = {n: getattr(grid, n) for n in ("isos", "exposure_times", "f_numbers")}
    env = make_env(grid=json.loads(json.dumps(lists)))
    assert env.unwrapped.grid == grid
    rng = np.random.default_rng(seed)
    controls, steps, apex = (wrapper(env) for wrapper in SINGLE)
    values = np.array([[s.aperture_value, s.time_value, s.speed_value] for s in grid])
    low, span = values.min(axis=0), np.ptp(values, axis=0)
    for state in rng.permutation(len(grid))[:16].tolist():
        position = grid.controls(state)
        assert controls.action(position) == state
        unit = np.where(span > 0, 2 * (values[state] - low) / np.where(span > 0, span, 1) - 1, 0)
        np.testing.assert_allclose(values[apex.action(unit)], values[state], atol=1e-4)
        env.reset(seed=seed, options={"state": state})
        for move in (rng.integers(-1, 2, 3), np.zeros(3, int)):
            moved = np.clip(position + move, 0, np.array(grid.shape) - 1)
            np.testing.assert_array_equal(grid.controls(int(steps.action(move + 1))), moved)
    wanted = rng.uniform(-1, 1, 3)
    assert apex.action(9 * np.sign(wanted)) == apex.action(np.sign(wanted))  # clipped
    distance = np.square(low + (wanted + 1) / 2 * span - values).sum(axis=1)
    assert distance[apex.action(wanted)] <= distance.min() + 1e-8
    assert controls.action_masks().all()
    assert steps.action_masks().all()
