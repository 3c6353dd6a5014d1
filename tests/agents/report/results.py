"""A result put together by hand, for the tests of tables and reports."""

import numpy as np

from ae_env.grid import ExposureGrid
from agents import EvaluationResult
from agents.evaluation.result import Track

#: The design's columns of an evaluation, in their order.
COLUMNS = [
    *("policy", "condition", "source", "split", "num_groups", "seed", "mean_score"),
    *("normalised_score", "regret", "ci95", "ev_error_median", "ev_error_p95"),
    *("ev_within_third", "frames_to_converge", "overshoot", "reversals", "flicker", "jump"),
    *("clipped_high", "clipped_low", "captures_per_decision", "ms_per_decision"),
]


def made_result(groups: int = 20) -> EvaluationResult:
    """Two episodes of four frames of each source group; four policies, one of three seeds."""
    rng = np.random.default_rng(0)
    grid, frames, episodes = ExposureGrid.default(), 4, 2 * groups
    scores = np.repeat(rng.uniform(0.1, 0.9, (episodes, 1, 64)), frames, axis=1)
    best = scores[:, 0].argmax(-1)

    def track(states: np.ndarray, privileged: bool = False) -> Track:
        zeros = np.zeros(states.shape)
        return Track(states, zeros, zeros, zeros + 0.25, zeros, 0.5, 1.0, privileged)

    def choose(seeds: int) -> np.ndarray:
        return rng.integers(64, size=(seeds, episodes, frames))

    oracle = np.broadcast_to(best[None, :, None], (1, episodes, frames))
    return EvaluationResult(
        grid=grid,
        scene_ids=np.array([f"scene-{i // 2:02d}" for i in range(episodes)]),
        groups=np.array([f"group-{i // 2:02d}" for i in range(episodes)]),
        kinds=np.array(["snow" if i % 4 < 2 else "photograph" for i in range(episodes)]),
        hard=np.array([i % 4 < 2 for i in range(episodes)]),
        start_states=np.zeros(episodes, np.int64),
        scores=scores,
        allowed=np.ones(scores.shape, bool),
        tracks={
            "oracle": track(oracle, privileged=True),
            "ppo": track(choose(3)),
            "matrix:P": track(choose(1)),
            "spot:P": track(np.where(rng.random(oracle.shape) < 0.5, oracle, 0)),
        },
        seed=11,
    )
