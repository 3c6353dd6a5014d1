from itertools import combinations

import pytest

from agents import PolicyContext, evaluate, make_policy
from agents.episodes import make_envs
from agents.policy import training_seeds

SCENES = {"scenes": "bundled:small", "split": "test", "resolution": 64}


@pytest.mark.parametrize("name", ["regression", "ppo"])
def test_shipped_agents_beat_a_plain_meter_and_differ_by_their_seed(name):
    context = PolicyContext.from_envs(make_envs(SCENES, num_envs=1, frames=1))
    policies = {n: make_policy(n, context) for n in (name, "centre_weighted:P")}
    result = evaluate(policies, SCENES, frames=4, batch=16)
    gains = {n: result.group_gains(n)[0].mean() for n in policies}
    assert gains[name] > gains["centre_weighted:P"]
    seeds = [make_policy(own, context) for own in training_seeds(name)]
    weights = [next(iter(p.network.parameters())) for p in seeds]
    assert len(seeds) == 3
    assert not any((a == b).all() for a, b in combinations(weights, 2))


def test_a_pattern_names_the_training_seeds(tmp_path):
    for file in ("ppo-1.safetensors", "ppo-0.safetensors", "ppo-0.json", "other.safetensors"):
        (tmp_path / file).touch()
    expected = [f"ppo:{tmp_path}/ppo-{seed}" for seed in (0, 1)]
    assert training_seeds(f"ppo:{tmp_path}/ppo-*") == expected
    assert training_seeds(f"ppo:{tmp_path}/ppo-0") == [f"ppo:{tmp_path}/ppo-0"]
    with pytest.raises(ValueError, match=r"no \.safetensors file fits"):
        training_seeds(f"regression:{tmp_path}/regression-*")
