"""The native vector environment in SB3's shape, and what wraps it in training."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from agents.learning.networks import NUMBERS, MeterHistory, with_history
from agents.learning.sb3_adapter import SB3VectorAdapter, ShiftedFrames, WithHistory
from agents.policy import PolicyContext
from tests.ae_env.environments import assert_equal, make_env

STEPS = 3  # of an episode


def single() -> gym.Env:
    return make_env(max_episode_steps=STEPS)


def assert_same_rollout(ours: VecEnv, theirs: VecEnv, steps: int) -> None:
    rng = np.random.default_rng(1)
    assert_equal(dict(ours.reset()), dict(theirs.reset()), "reset")
    assert_equal(ours.reset_infos[1], theirs.reset_infos[1], "reset info")
    for step in range(steps):
        actions = rng.integers(64, size=ours.num_envs)
        mine, other = ours.step(actions), theirs.step(actions)
        assert_equal(dict(mine[0]), dict(other[0]), f"{step}: observation")
        assert mine[1].dtype == other[1].dtype == np.float32
        np.testing.assert_array_equal(mine[1], other[1])
        np.testing.assert_array_equal(mine[2], other[2])
        for i in range(ours.num_envs):
            assert_equal(mine[3][i], other[3][i], f"{step}: info {i}")
            ended = bool(other[2][i])
            assert ("terminal_observation" in mine[3][i]) == ended
            assert mine[3][i]["TimeLimit.truncated"] == ended
            assert_equal(ours.reset_infos[i], theirs.reset_infos[i], f"{step}: reset info {i}")


def test_rollouts_equal_those_of_single_environments(make_tiny_envs) -> None:
    ours = SB3VectorAdapter(make_tiny_envs(num_envs=3, max_episode_steps=STEPS))
    theirs = DummyVecEnv([single] * 3)
    for envs in (ours, theirs):
        envs.seed(11)
    assert_same_rollout(ours, theirs, 7)
    for envs in (ours, theirs):  # once seeded, a reset goes on with the same generators
        envs.set_options([{"scene": 0, "state": 5}, {"state": 6}, {}])
    assert_same_rollout(ours, theirs, 4)
    assert_same_rollout(ours, theirs, 1)  # the options were for one reset


class Forbids(gym.vector.VectorWrapper):
    def action_masks(self) -> np.ndarray:
        masks = self.env.unwrapped.action_masks()
        masks[:, 3] = False
        return masks


def test_attributes_methods_and_pictures_of_a_wrapped_batch(make_tiny_envs) -> None:
    inner = make_tiny_envs(num_envs=3, render_mode="rgb_array")
    envs = SB3VectorAdapter(gym.vector.VectorWrapper(Forbids(inner)))
    envs.seed(0)
    envs.reset()
    assert [id(grid) for grid in envs.get_attr("grid", [0, 2])] == [id(inner.unwrapped.grid)] * 2
    assert envs.has_attr("action_masks")  # as MaskablePPO asks
    assert [bool(mask[3]) for mask in envs.env_method("action_masks")] == [False] * 3
    scores = inner.unwrapped.expected_scores()
    for indices in ([1], 1, np.int64(1), np.array([1])):
        (row,) = envs.env_method("expected_scores", indices=indices)
        np.testing.assert_array_equal(row, scores[1])
    assert envs.env_is_wrapped(gym.Wrapper) == [False] * 3
    with pytest.raises(AttributeError, match="`grid`"):
        envs.set_attr("grid", None)
    shown = [(picture.dtype, picture.shape[2]) for picture in envs.get_images()]
    assert shown == [(np.uint8, 3)] * 3
    assert envs.render("rgb_array").ndim == 3  # SB3 tiles them
    assert list(SB3VectorAdapter(make_tiny_envs(num_envs=2)).get_images()) == [None, None]
    for mode in ("NEXT_STEP", "DISABLED"):
        with pytest.raises(ValueError, match="autoreset_mode"):
            SB3VectorAdapter(make_tiny_envs(mode=mode))


def test_shifted_frames_differ_in_the_raw_alone(make_tiny_envs) -> None:
    plain = SB3VectorAdapter(make_tiny_envs(num_envs=2))
    shifted = ShiftedFrames(SB3VectorAdapter(make_tiny_envs(num_envs=2)), np.random.default_rng(0))
    for envs in (plain, shifted):
        envs.seed(3)
    pairs = [(plain.reset(), shifted.reset())]
    for action in (5, 17):
        one, other = (envs.step(np.full(2, action)) for envs in (plain, shifted))
        np.testing.assert_array_equal(one[1], other[1])
        pairs.append((one[0], other[0]))
    for seen, moved in pairs:
        assert not np.array_equal(seen["raw"], moved["raw"])
        assert seen["raw"].mean() == pytest.approx(moved["raw"].mean(), rel=0.2)
        for name in ("settings", "sensors"):
            np.testing.assert_array_equal(seen[name], moved[name])


def test_it_holds_readings_exposures_and_what_was_asked_for(context, photograph):
    history, grey, grid = MeterHistory(context, 1, 3), np.ones((64, 64)), context.grid
    state = grid.nearest(9.0)
    frame = photograph(grey, 9.0, state)
    first = history.observe(frame).reshape(3, NUMBERS)
    # Before the first frame there was the same.
    row = [0.0, (9.0 - grid.ev100[state]) / 4.0, 0.0, *frame["settings"][0]]
    np.testing.assert_allclose(first, [row] * 3, atol=0.02)
    history.record_action(np.array([40]))
    second = history.observe(photograph(grey, 8.0, state)).reshape(3, NUMBERS)
    np.testing.assert_allclose(second[0, 3:], photograph(grey, 8.0, 40)["settings"][0])
    np.testing.assert_allclose(second[:, 0], [0.0, 0.5, 0.5], atol=0.02)  # one stop brighter before
    history.forget(np.array([True]))
    assert history.observe(photograph(grey, 5.0, state))[0, 0] == 0.0


def test_wrapped_episodes_end_with_their_own_history(make_tiny_envs):
    envs = make_tiny_envs(num_envs=3, max_episode_steps=2)
    context = PolicyContext.from_envs(envs)
    seen = WithHistory(SB3VectorAdapter(envs), context, 4)
    assert seen.observation_space == with_history(envs.single_observation_space, 4)
    seen.seed(3)
    observations = seen.reset()
    alone = MeterHistory(context, 3, 4)
    np.testing.assert_array_equal(observations["history"], alone.observe(observations))
    for step, action in enumerate((5, 30, 41)):
        alone.record_action(np.full(3, action))
        observations, _, dones, infos = seen.step(np.full(3, action))
        assert dones.all() == (step == 1)
        if dones.all():
            last = {
                k: np.stack([i["terminal_observation"][k] for i in infos]) for k in observations
            }
            np.testing.assert_array_equal(last.pop("history"), alone.observe(last))
            alone.forget(dones)
        np.testing.assert_array_equal(observations["history"], alone.observe(observations))
