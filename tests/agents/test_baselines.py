from contextlib import closing

import numpy as np
import pytest
import torch

from agents import evaluate
from agents.policy import PolicyContext
from agents.policy_names import make_policy
from agents.rollouts import make_envs
from simulator import CameraSettings, RawImage, get_camera, write_dng

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


SETTINGS = (
    (100, 1 / 1000, 4.0),
    (400, 1 / 125, 5.6),
    (3200, 1 / 16, 11.0),  # ISO 1600 and 6400 are as near; the EV decides with 1/15
)


@pytest.mark.parametrize("delay", [0, 1])
def test_a_recording_is_replayed_on_its_own_raws(tmp_path, delay):
    """Every frame of the sequence is shot at the settings that its raw was recorded at."""
    for i, settings in enumerate(SETTINGS):
        light = torch.full((4, 40, 40), 0.1)
        raw = RawImage(light, CameraSettings(*settings), get_camera("nikon_z6"))
        write_dng(tmp_path / f"frame_{i:02d}.dng", raw)
    (tmp_path / "notes.txt").write_text("not a raw")
    options = {"scenes": {"sequence": str(tmp_path)}, "split": "test", "resolution": 36}
    options |= {"delay": delay, "depth": "far"}
    with closing(make_envs(options, num_envs=1, frames=1)) as envs:
        policy = make_policy(f"recorded:{tmp_path}", PolicyContext.from_envs(envs))
    result = evaluate({"recorded": policy}, options, frames=4)
    assert result.scores.shape == (1, 4, 64)
    states = result.tracks["recorded"].states[0, 0]
    for frame in range(delay, 4):
        _, time, f_number = SETTINGS[min(frame + 1, 2)]
        assert result.grid[states[frame]].f_number == f_number
        assert result.grid[states[frame]].exposure_time == pytest.approx(time, rel=0.07)
    # The raws show light of 10, 6 and 1.1 EV, and the last one stays.
    assert len(np.unique(result.scores[0], axis=0)) == 2
    np.testing.assert_array_equal(result.scores[0, 1], result.scores[0, 3])


def test_a_folder_without_raws_is_refused(context, tmp_path):
    (tmp_path / "notes.txt").write_text("not a raw")
    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(ValueError, match="`path`"):
            make_policy(f"recorded:{folder}", context)
