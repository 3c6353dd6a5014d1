"""The action wrappers: what each action means, alike for one environment and for many."""

import json
import math
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from hypothesis import given

from ae_env import wrappers
from ae_env.grid import ExposureGrid
from ae_env.wrappers import ContinuousActions, ControlActions, RelativeActions
from simulator import CameraSettings
from tests.ae_env.environments import assert_equal, make_env, make_envs
from tests.strategies import SEEDS, grids

SINGLE = [ControlActions, RelativeActions, ContinuousActions]
PAIRS = [(single, getattr(wrappers, f"Vector{single.__name__}")) for single in SINGLE]


def test_continuous_actions_take_the_nearest_apex_values() -> None:
    """A third of the way from ISO 100 to 6400 is two of six stops: ISO 400; a third of the 2.92
    stops from f/4 to f/11 is nearest to f/5.6, and of the 8.97 stops of time to 1/15 s."""
    env = ContinuousActions(make_env())
    for action, wanted in (
        ((-1, -1, -1), (100, 1 / 2, 4)),
        ((1, -1, 1), (6400, 1 / 2, 11)),
        ((-1 / 3,) * 3, (400, 1 / 15, 5.6)),
        ((9, 9, 9), (6400, 1 / 1000, 11)),  # clipped
    ):
        settings = env.unwrapped.grid[int(env.action(np.array(action, np.float32)))]
        assert settings == CameraSettings(*wanted)


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
    np.testing.assert_array_equal(
        wrappers.VectorControlActions(envs).action_masks(), [controls] * 2
    )
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
        (lambda: vector(gym.make_vec("CartPole-v1", vectorization_mode="sync")), "make_vec"),
    ):
        with pytest.raises(ValueError, match=message):
            make()


@given(grids(), SEEDS)
def test_other_ways_to_act_reach_every_state(grid: ExposureGrid, seed: int) -> None:
    lists = {n: getattr(grid, n) for n in ("isos", "exposure_times", "f_numbers")}
    env = make_env(grid=json.loads(json.dumps(lists)))
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
    distance = np.square(low + (wanted + 1) / 2 * span - values).sum(axis=1)
    assert distance[apex.action(wanted)] <= distance.min() + 1e-8
    assert controls.action_masks().all()
    assert steps.action_masks().all()
