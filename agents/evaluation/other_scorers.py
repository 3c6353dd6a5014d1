"""Scores of the chosen states under scorers that no policy was trained on."""

from __future__ import annotations

import numpy as np

from ae_env.scorers import make_scorer
from ae_env.scorers.score_table import ScoreTables
from agents.evaluation.evaluation_plan import EvaluationPlan, groups_in_turn
from agents.evaluation.result import EvaluationResult


def other_scores(result: EvaluationResult, plan: EvaluationPlan) -> dict[str, dict[str, float]]:
    """Mean expected score of the states that each policy chose, by scorer and policy.

    Of some scenes of the first seed, all starts and frames; averaged over frames, then training
    seeds, episodes of a source group, and source groups.

    Args:
        result: The results in unchanging light.
        plan: The plan, with the names of the scorers.
    """
    pairs = len(result.scene_ids) // len(plan.starts)  # of scenes and seeds
    count = pairs // len(plan.seeds)
    scenes = list(result.scenes[:count])  # scenes change fastest, the first seed comes first
    chosen = groups_in_turn(scenes, plan.other_scorer_scenes)
    options = plan.options()
    found: dict[str, dict[str, float]] = {}
    for name in plan.other_scorers:
        tables = ScoreTables(
            options.make_grid(),
            options.make_camera(),
            make_scorer(name),
            noise=bool(options.noise),
            tolerance=options.tolerance,
        )
        means: dict[str, dict[str, list[float]]] = {policy: {} for policy in result.tracks}
        for scene in chosen:
            j = scenes.index(scene)
            episodes = np.flatnonzero(np.arange(len(result.scene_ids)) % pairs == j)
            scores = tables.table(scene, **result.moves(j)).mean
            for policy, track in result.tracks.items():
                mean = float(scores[track.states[:, episodes]].mean())
                means[policy].setdefault(scene.group, []).append(mean)
        found[name] = {
            policy: float(np.mean([np.mean(values) for values in groups.values()]))
            for policy, groups in means.items()
        }
    return found
