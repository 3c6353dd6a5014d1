import dataclasses
from itertools import combinations

import pytest

from agents import PolicyContext, evaluate, make_policy
from agents.evaluation.jobs import policy_content
from agents.policy_names import training_seeds
from agents.rollouts import make_envs

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


def test_agents_for_moving_light_come_with_their_forecasts():
    """They foresee with what ships, and refuse a grid that they were not trained on."""
    video = {**SCENES, "grid": "video", "delay": {"iso": 1, "exposure_time": 2, "f_number": 2}}
    video["lighting"] = {"kind": "moving", "kinds": "sines"}
    context = PolicyContext.from_envs(make_envs(video, num_envs=1, frames=1))
    names = ("regression:video", "regression:video?foresight=learnt", "ppo:video", "average:P")
    result = evaluate({n: make_policy(n, context) for n in names}, video, frames=32, batch=16)
    gains = {n: result.group_gains(n)[0].mean() for n in names}
    assert gains["regression:video?foresight=learnt"] > gains["regression:video"]
    assert gains["ppo:video"] > gains["average:P"]
    with pytest.raises(ValueError, match=r"`foresight` \(='runs/none'\) must be 'none', 'trend'"):
        make_policy("regression:video?foresight=runs/none", context)
    with pytest.raises(ValueError, match=r"`foresight` \(=None\) must be 'none', 'trend'"):
        make_policy("regression:video?foresight=", context)
    late = dataclasses.replace(context, delays=(4, 4, 4))
    with pytest.raises(ValueError, match="forecasts 4 frames, and a delay of 4 asks for 5"):
        make_policy("regression:video?foresight=learnt", late)
    # A stored evaluation is of these files: each other one decides another result.
    content = {n: policy_content(n) for n in ("regression", *names)}
    assert len(set(content.values())) == 5
    assert content["average:P"] == ""
    still = PolicyContext.from_envs(make_envs(SCENES, num_envs=1, frames=1))
    with pytest.raises(ValueError, match="was trained with exposure_times from"):
        make_policy("regression:video", still)


def test_a_pattern_names_the_training_seeds(tmp_path):
    for file in ("ppo-1.safetensors", "ppo-0.safetensors", "ppo-0.json", "other.safetensors"):
        (tmp_path / file).touch()
    expected = [f"ppo:{tmp_path}/ppo-{seed}" for seed in (0, 1)]
    assert training_seeds(f"ppo:{tmp_path}/ppo-*") == expected
    assert training_seeds(f"ppo:{tmp_path}/ppo-0") == [f"ppo:{tmp_path}/ppo-0"]
    with pytest.raises(ValueError, match=r"no \.safetensors file fits"):
        training_seeds(f"regression:{tmp_path}/regression-*")
