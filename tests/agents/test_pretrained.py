"""The agents that come with the package."""

from __future__ import annotations

import pytest

from agents import PolicyContext, evaluate, make_policy
from agents.episodes import make_envs

SCENES = {"scenes": "bundled:small", "split": "test", "resolution": 64}


@pytest.mark.parametrize("name", ["regression", "ppo"])
def test_shipped_agent_beats_a_plain_meter_on_unseen_scenes(name):
    """Catches weights that no longer fit the features, the grid or the observation."""
    context = PolicyContext.from_envs(make_envs(SCENES, num_envs=1, frames=1))
    policies = {n: make_policy(n, context) for n in (name, "centre_weighted:P")}
    result = evaluate(policies, SCENES, frames=4, batch=16)
    gains = {n: result.group_gains(n)[0].mean() for n in policies}
    assert gains[name] > gains["centre_weighted:P"]


def test_another_resolution_is_refused_by_name():
    context = PolicyContext.from_envs(make_envs({**SCENES, "resolution": 48}, num_envs=1, frames=1))
    with pytest.raises(ValueError, match="resolution"):
        make_policy("ppo", context)
