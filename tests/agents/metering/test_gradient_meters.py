import numpy as np
import pytest

from agents.metering.meters import make_meter
from agents.policy_names import make_policy


@pytest.mark.parametrize("name", ["shim", "zhang"])
def test_steps_go_on_from_the_estimate_and_not_from_the_state(context, photograph, name):
    """The same frame, a controller that is further on: the step is taken from there."""
    meter = make_meter(name, context.camera)
    light = np.kron(np.random.default_rng(0).uniform(0.3, 1.7, (16, 16)), np.ones((4, 4)))
    over = meter(photograph(light, 9.0, context.grid.nearest(4.0))).ev100[0]
    assert 0.5 < over - context.grid.ev100[context.grid.nearest(4.0)] < 4.1  # less light
    frame = photograph(light, 9.0, context.grid.nearest(12.0))
    path = [12.0]
    for _ in range(40):
        path.append(meter(frame, np.array([path[-1]])).ev100[0])
    steps = np.abs(np.diff(path))
    assert abs(path[-1] - path[-2]) < 0.02  # comes to rest though the frame stays
    assert path[-1] < 10.5
    assert steps[0] > 0.3


@pytest.mark.parametrize("name", ["shim", "zhang", "entropy"])
def test_the_dark_is_left(context, photograph, name):
    """8 EV under at the start, and again after a flash of EV 35: within 2 EV of the light."""
    rng = np.random.default_rng(0)
    light = 1.0 + 0.1 * np.kron(rng.uniform(-1, 1, (16, 16)), np.ones((4, 4)))
    policy = make_policy(f"{name}:P", context)
    policy.reset(1)
    state = np.array([context.grid.nearest(17.0)])
    for frame in range(26):
        if frame == 12:
            assert context.grid.ev100[state[0]] < 9.0 + 1.6
        state = policy.act(photograph(light, 35.0 if frame in (13, 14) else 9.0, state))
    assert context.grid.ev100[state[0]] < 9.0 + 1.6
