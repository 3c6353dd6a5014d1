"""The action wrappers: what each action means, alike for one environment and for many."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

import ae_env  # noqa: F401  (registers the environment)
from ae_env import wrappers
from ae_env.wrappers import (
    ContinuousActions,
    ControlActions,
    RelativeActions,
    VectorContinuousActions,
    VectorControlActions,
    VectorRelativeActions,
)

ID = "ae_env/AutoExposure-v0"
ARGUMENTS = {"scenes": "bundled:small", "resolution": 36}
PAIRS = [
    (ControlActions, VectorControlActions),
    (RelativeActions, VectorRelativeActions),
    (ContinuousActions, VectorContinuousActions),
]


def _make(**arguments: object) -> gym.Env:
    return gym.make(ID, **ARGUMENTS, **arguments)


def test_control_actions_are_positions_in_the_lists() -> None:
    env = ControlActions(_make())
    assert env.action_space == gym.spaces.MultiDiscrete([4, 4, 4])
    env.reset(seed=0)
    _, _, _, _, info = env.step(np.array([2, 1, 3]))
    assert (info["iso"], info["f_number"]) == (1600.0, 11.0)
    assert info["exposure_time"] == pytest.approx(1 / 125)
    assert env.action_masks().shape == (12,)
    assert env.action_masks().all()


@pytest.mark.parametrize(
    ("start", "steps", "expected"),
    [
        ((1, 1, 1), (2, 0, 1), (2, 0, 1)),
        ((0, 3, 2), (0, 2, 2), (0, 3, 3)),  # the first two stay at the ends of their lists
        ((3, 0, 0), (1, 1, 1), (3, 0, 0)),
    ],
)
def test_relative_actions_step_every_control_and_stop_at_the_ends(
    start: tuple[int, ...], steps: tuple[int, ...], expected: tuple[int, ...]
) -> None:
    env = RelativeActions(_make())
    grid = env.unwrapped.grid
    env.reset(seed=0, options={"state": grid.index(*start)})
    _, _, _, _, info = env.step(np.array(steps))
    assert info["state"] == grid.index(*expected)


def test_continuous_actions_take_the_nearest_apex_values() -> None:
    env = ContinuousActions(_make())
    grid = env.unwrapped.grid
    env.reset(seed=0)
    corners = {
        (-1, -1, -1): (100, 1 / 2, 4),
        (1, 1, 1): (6400, 1 / 1000, 11),
        (1, -1, 1): (6400, 1 / 2, 11),
    }
    for action, (iso, time, f_number) in corners.items():
        settings = grid[int(env.action(np.array(action, np.float32)))]
        assert (settings.iso, settings.exposure_time, settings.f_number) == (iso, time, f_number)
    # A third of the way from ISO 100 to 6400 is two of six stops: ISO 400; f/4 to f/11 likewise:
    # a third of the 2.92 stops is nearest to f/5.6, and of the 8.97 stops of time to 1/15 s.
    settings = grid[int(env.action(np.full(3, -1 / 3, np.float32)))]
    assert (settings.iso, settings.f_number) == (400, 5.6)
    assert settings.exposure_time == pytest.approx(1 / 15)
    assert env.action(np.full(3, 9.0)) == env.action(np.ones(3))  # clipped


def test_continuous_ties_go_to_the_lower_iso() -> None:
    grid = {"isos": [100, 400], "exposure_times": [0.01], "f_numbers": [4]}
    env = ContinuousActions(_make(grid=grid))
    assert env.action(np.zeros(3)) == 0
    assert env.action(np.array([0.3, -0.7, 0.01])) == 1  # one value of time and aperture: ignored


def test_every_state_is_reached_by_its_own_apex_values() -> None:
    env = ContinuousActions(_make())
    apex = np.array(
        [
            [2 * np.log2(s.f_number), -np.log2(s.exposure_time), np.log2(s.iso)]
            for s in env.unwrapped.grid
        ]
    )
    actions = 2 * (apex - apex.min(0)) / (apex.max(0) - apex.min(0)) - 1
    assert [env.action(action) for action in actions] == list(range(64))


def test_masked_states_are_avoided(monkeypatch: pytest.MonkeyPatch) -> None:
    base = _make()
    grid = base.unwrapped.grid
    allowed = np.array([s.f_number > 4 for s in grid])  # as for a scene whose depth is known
    monkeypatch.setattr(base.unwrapped, "action_masks", lambda: allowed)
    wide_open = np.array([-1.0, -1.0, -1.0])
    assert grid[int(ContinuousActions(base).action(wide_open))].f_number == 5.6
    np.testing.assert_array_equal(
        ControlActions(base).action_masks(), [True] * 8 + [False, True, True, True]
    )
    base.reset(seed=0, options={"state": grid.index(0, 3, 1)})
    np.testing.assert_array_equal(
        RelativeActions(base).action_masks(), [True] * 6 + [False, True, True]
    )


@pytest.mark.parametrize(("single", "vector"), PAIRS)
def test_vector_twin_does_the_same(single: type, vector: type) -> None:
    envs = vector(gym.make_vec(ID, num_envs=3, autoreset_mode="DISABLED", **ARGUMENTS))
    alone = [single(_make()) for _ in range(3)]
    envs.reset(seed=5)
    for i, env in enumerate(alone):
        env.reset(seed=5 + i)
        assert env.action_space == envs.single_action_space
    envs.action_space.seed(1)
    for _ in range(4):
        actions = envs.action_space.sample()
        assert envs.action_space.contains(actions)
        assert actions.shape == (3, 3)
        if hasattr(envs, "action_masks"):
            expected = np.stack([env.action_masks() for env in alone])
            np.testing.assert_array_equal(envs.action_masks(), expected)
        observation, reward, _, _, info = envs.step(actions)
        for i, env in enumerate(alone):
            one, score, _, _, single_info = env.step(actions[i])
            assert single_info["state"] == info["state"][i]
            assert score == reward[i]
            np.testing.assert_array_equal(one["raw"], observation["raw"][i])


@pytest.mark.parametrize("single", [pair[0] for pair in PAIRS])
def test_wrapped_spec_round_trips_through_json(single: type) -> None:
    env = single(_make(sensors=False))
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.action_space == env.action_space
    assert again.observation_space == env.observation_space
    first, _ = env.reset(seed=3)
    second, _ = again.reset(seed=3)
    np.testing.assert_array_equal(first["raw"], second["raw"])
    env.action_space.seed(0)
    action = env.action_space.sample()
    assert env.step(action)[1] == again.step(action)[1]


@pytest.mark.parametrize(("single", "vector"), PAIRS)
def test_bad_actions_and_environments_are_refused(single: type, vector: type) -> None:
    env = single(_make())
    env.reset(seed=0)
    for action in (np.array([0, 1]), np.array([np.nan, 0.0, 0.0]), 3):
        with pytest.raises(ValueError, match="`action`"):
            env.action(action)
    with pytest.raises(ValueError, match="`env`"):
        single(gym.make("CartPole-v1"))
    with pytest.raises(ValueError, match="wrapped already"):
        single(single(_make()))
    with pytest.raises(ValueError, match="make_vec"):
        vector(gym.make_vec("CartPole-v1", num_envs=1, vectorization_mode="sync"))


def test_out_of_range_positions_are_refused() -> None:
    env = ControlActions(_make())
    with pytest.raises(ValueError, match=r"\[0, \[4, 4, 4\]\)"):
        env.action(np.array([0, 4, 0]))


def test_wrappers_follow_gymnasium() -> None:
    for single, vector in PAIRS:
        assert issubclass(single, gym.ActionWrapper)
        assert issubclass(vector, gym.vector.VectorActionWrapper)
        for wrapper in (single, vector):
            assert issubclass(wrapper, gym.utils.RecordConstructorArgs)
            assert wrapper.__doc__
            assert getattr(wrappers, wrapper.__name__) is wrapper
