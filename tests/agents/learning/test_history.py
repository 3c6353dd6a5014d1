"""A history of readings beside the frames: newest first, and nothing of an earlier episode."""

import numpy as np

from ae_env.observation import encode_settings
from agents.learning.networks import NUMBERS, MeterHistory, WithHistory, with_history
from agents.learning.sb3_adapter import SB3VectorAdapter
from agents.policy import PolicyContext


def test_it_holds_readings_exposures_and_what_was_asked_for(context, photograph):
    history = MeterHistory(context, 1, 3)
    grey, grid = np.ones((64, 64)), context.grid
    state = grid.nearest(9.0)
    first = history.observe(photograph(grey, 9.0, state)).reshape(3, NUMBERS)
    shown = photograph(grey, 9.0, state)["settings"][0]
    exposed = (9.0 - grid.ev100[state]) / 4.0
    for row in first:  # before the first frame there was the same
        np.testing.assert_allclose(row, [0.0, exposed / 4.0, 0.0, *shown], atol=0.02)
    history.asked(np.array([40]))
    second = history.observe(photograph(grey, 8.0, state)).reshape(3, NUMBERS)
    s = grid[40]
    asked = encode_settings(np.array([s.aperture_value, s.time_value, s.speed_value]))
    np.testing.assert_allclose(second[0, 3:], asked)
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
        alone.asked(np.full(3, action))
        observations, _, dones, infos = seen.step(np.full(3, action))
        assert dones.all() == (step == 1)
        if dones.all():
            last = {
                k: np.stack([i["terminal_observation"][k] for i in infos]) for k in observations
            }
            np.testing.assert_array_equal(last.pop("history"), alone.observe(last))
            alone.forget(dones)
        np.testing.assert_array_equal(observations["history"], alone.observe(observations))
