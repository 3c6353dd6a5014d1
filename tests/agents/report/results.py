"""A result put together by hand, for the tests of tables and reports."""

import numpy as np

from ae_env.grid import ExposureGrid
from agents import EvaluationResult
from agents.evaluation.plan import EvaluationPlan
from agents.evaluation.result import BRACKET_METRICS, Track

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
        names = ("image_mean", "code_mean", "clipped_high", "clipped_low")
        arrays = {name: np.full(states.shape, 0.25 * (name == "clipped_high")) for name in names}
        return Track({"states": states, **arrays}, 0.5, 1.0, privileged)

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


def made_brackets(groups: list[str] | None = None, **quality: np.ndarray) -> EvaluationResult:
    """One episode of brackets of each source group, by policy ``(K, G)``; other metrics are 0.5."""
    count = next(iter(quality.values())).shape[1]
    names = np.array(groups or [f"g{i:02d}" for i in range(count)])
    arrays = {
        name: {**dict.fromkeys(BRACKET_METRICS, np.full(own.shape, 0.5)), "quality": own}
        for name, own in quality.items()
    }
    return EvaluationResult(
        grid=ExposureGrid.from_spec("bracket"),
        scene_ids=names,
        groups=names,
        kinds=names,
        hard=np.zeros(count, bool),
        start_states=np.zeros(count, np.int64),
        scores=np.zeros((count, 0, 0)),
        allowed=np.zeros((count, 0, 0), bool),
        tracks={name: Track(own, 0.5, 1.0, privileged=False) for name, own in arrays.items()},
        seed=0,
        plan=EvaluationPlan(budgets=(0.1, 0.2), task="bracket", hash="h"),
    )
