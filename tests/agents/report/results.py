"""A result put together by hand, for the tests of tables and reports."""

import numpy as np

from ae_env.grid import ExposureGrid
from agents import EvaluationResult
from agents.evaluation.evaluation_plan import EvaluationPlan
from agents.evaluation.result import BRACKET_METRICS, Track


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

    oracle = np.broadcast_to(best[None, :, None], (1, episodes, frames))
    tracks = {
        "oracle": track(oracle, privileged=True),
        "ppo": track(rng.integers(64, size=(3, episodes, frames))),
        "matrix:P": track(rng.integers(64, size=(1, episodes, frames))),
        "spot:P": track(np.where(rng.random(oracle.shape) < 0.5, oracle, 0)),
    }
    pairs = np.arange(episodes) // 2
    hard = pairs % 2 == 0
    ids, groups = (np.array([f"{kind}-{i:02d}" for i in pairs]) for kind in ("scene", "group"))
    kinds, starts = np.where(hard, "snow", "photograph"), np.zeros(episodes, np.int64)
    named = {"scene_ids": ids, "groups": groups, "kinds": kinds, "hard": hard, "tracks": tracks}
    allowed = np.ones(scores.shape, bool)
    return EvaluationResult(
        grid, **named, start_states=starts, scores=scores, allowed=allowed, seed=11
    )


def made_brackets(groups: list[str] | None = None, **quality: np.ndarray) -> EvaluationResult:
    """One episode of brackets of each source group, by policy ``(K, G)``; other metrics are 0.5."""
    count = next(iter(quality.values())).shape[1]
    names = np.array(groups or [f"g{i:02d}" for i in range(count)])
    tracks = {}
    for name, own in quality.items():
        arrays = dict.fromkeys(BRACKET_METRICS, np.full(own.shape, 0.5)) | {"quality": own}
        tracks[name] = Track(arrays, 0.5, 1.0, privileged=False)
    empty = {"hard": np.zeros(count, bool), "start_states": np.zeros(count, np.int64)}
    empty |= {"scores": np.zeros((count, 0, 0)), "allowed": np.zeros((count, 0, 0), bool)}
    plan = EvaluationPlan(budgets=(0.1, 0.2), task="bracket", hash="h")
    named = {"scene_ids": names, "groups": names, "kinds": names, "tracks": tracks, "plan": plan}
    return EvaluationResult(grid=ExposureGrid.from_spec("bracket"), **named, **empty, seed=0)
