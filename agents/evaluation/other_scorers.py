"""Scores of the chosen states under scorers that no policy was trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ae_env.scorers import CompositeScorer, make_scorer
from ae_env.scorers.captures import describe_captures
from ae_env.scorers.score_table import prepare_scene
from agents.evaluation.evaluation_plan import EvaluationPlan, groups_in_turn
from agents.evaluation.result import EvaluationResult
from simulator.optics.motion_path import ALONG_ROWS, Movement

if TYPE_CHECKING:
    from ae_env.options import EnvOptions
    from ae_env.scenes import Scene

Floats = NDArray[np.float64]
#: Noisy captures that a scorer of images is averaged over.
NOISE_SEEDS = 2
#: States rated at once.
_CHUNK = 16


def other_scores(result: EvaluationResult, plan: EvaluationPlan) -> dict[str, dict[str, float]]:
    """Mean expected score of the states that each policy chose, by scorer and policy.

    Of some scenes of the first seed, all starts and frames; averaged over frames, then training
    seeds, episodes of a source group, and source groups.

    Args:
        result: The results in unchanging light.
        plan: The plan, with the names of the scorers.
    """
    tables = len(result.scene_ids) // len(plan.starts)
    count = tables // len(plan.seeds)
    scenes = list(result.scenes[:count])  # scenes change fastest, the first seed comes first
    chosen = groups_in_turn(scenes, plan.other_scorer_scenes)
    options = plan.options()
    made = {name: make_scorer(name) for name in plan.other_scorers}  # raises before any work
    found: dict[str, dict[str, float]] = {}
    for name, scorer in made.items():
        means: dict[str, dict[str, list[float]]] = {policy: {} for policy in result.tracks}
        for scene in chosen:
            j = scenes.index(scene)
            episodes = np.flatnonzero(np.arange(len(result.scene_ids)) % tables == j)
            visited = np.unique(
                np.concatenate([t.states[:, episodes].ravel() for t in result.tracks.values()])
            )
            scores = np.full(len(result.grid), np.nan)
            scores[visited] = state_scores(
                scorer, options, scene, visited.tolist(), **result.moves(j)
            )
            for policy, track in result.tracks.items():
                mean = float(scores[track.states[:, episodes]].mean())
                means[policy].setdefault(scene.group, []).append(mean)
        found[name] = {
            policy: float(np.mean([np.mean(values) for values in groups.values()]))
            for policy, groups in means.items()
        }
    return found


def state_scores(
    scorer: CompositeScorer,
    options: EnvOptions,
    scene: Scene,
    states: Sequence[int],
    *,
    speed: float = 0.0,
    defocus: float = 0.0,
    movement: Movement = ALONG_ROWS,
) -> Floats:
    """Expected score of some states of a scene, ``(n,)``; image scorers over `NOISE_SEEDS`.

    Args:
        scorer: The scorer.
        options: The environment's arguments: grid, camera, tolerance.
        scene: The scene.
        states: Indices into the grid.
        speed: Image speed [frame heights per second].
        defocus: Blur diameter at f/4 [pixel of a 64-pixel frame], of what is least in focus.
        movement: Directions of the image's motion, and the subject's own.
    """
    camera, grid = options.make_camera(), options.make_grid()
    prepared = prepare_scene(scene, camera, speed=speed, defocus=defocus, movement=movement)
    prepared = replace(prepared, tolerance=options.tolerance)
    found = []
    for first in range(0, len(states), _CHUNK):
        settings = [grid[int(state)] for state in states[first : first + _CHUNK]]
        count = len(settings)
        captures = describe_captures(
            [scene] * count,
            settings,
            camera,
            speed=np.full(count, speed),
            defocus=np.full(count, defocus),
            movements=[movement] * count,
            gain=np.ones(count),
        )
        parts = scorer.score_parts(None, captures, ("light", "blur"))
        sums = {name: values.numpy() for name, values in parts.items()}
        totals = []
        for seed in range(1 if scorer.closed_form else NOISE_SEEDS):
            if not scorer.closed_form:
                images = prepared.expose(settings, seed=seed).clamp_(0.0, 1.0)
                drawn = scorer.score_parts(images, captures, ("image",))
                sums |= {name: values.numpy() for name, values in drawn.items()}
            totals.append(scorer.totals(sums))
        found.append(np.mean(totals, axis=0))
    return np.concatenate(found)
