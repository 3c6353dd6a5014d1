from __future__ import annotations

import numpy as np
import pytest

from agents.policy import make_policy

FRAMES = {"raw": np.zeros((500, 4, 8, 8), np.uint8)}


def test_random_is_seeded_uniform_and_masked(context):
    policy = make_policy("random", context)
    masks = np.zeros((500, 64), bool)
    masks[:, 10:14] = True
    policy.reset(500, seed=3)
    first, second = policy.act(FRAMES, masks), policy.act(FRAMES, masks)
    assert set(first) == {10, 11, 12, 13}
    assert np.bincount(first)[10:].min() > 90  # 125 expected, standard deviation 9.7
    assert not np.array_equal(first, second)
    policy.reset(500, seed=3)
    np.testing.assert_array_equal(policy.act(FRAMES, masks), first)


def test_best_fixed_takes_the_best_mean_or_the_best_allowed(context):
    policy = make_policy("best_fixed", context)
    with pytest.raises(ValueError, match="call fit"):
        policy.act(FRAMES)
    policy.mean_scores = np.linspace(0, 1, 64)
    assert set(policy.act(FRAMES)) == {63}
    masks = np.ones((500, 64), bool)
    masks[:, 60:] = False
    assert set(policy.act(FRAMES, masks)) == {59}


def test_oracle_reads_info_and_nothing_else(context):
    policy = make_policy("oracle", context)
    assert policy.act({}, None, info={"oracle_state": np.array([4, 5])}).tolist() == [4, 5]
    with pytest.raises(ValueError, match="with_oracle=True"):
        policy.act({})
