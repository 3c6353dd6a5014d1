"""How the states that policies chose fare under scorers that they were not trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from agents.evaluation.plan_episodes import groups_in_turn
from agents.evaluation.result import EvaluationResult

if TYPE_CHECKING:
    from ae_env.scenes import Scene
    from ae_env.scorers import CompositeScorer
    from agents.evaluation.plan_run import PlanRun

Floats = NDArray[np.float64]
#: Noisy captures that a scorer of images is averaged over.
NOISE_SEEDS = 2
#: States rated at once.
_CHUNK = 16


def state_scores(
    scorer: CompositeScorer,
    run: PlanRun,
    scene: Scene,
    states: Sequence[int],
    *,
    speed: float = 0.0,
    defocus: float = 0.0,
) -> Floats:
    """Expected score of some states of a scene, ``(n,)``; image scorers over `NOISE_SEEDS`.

    Args:
        scorer: What rates them.
        run: Whose grid, camera and options.
        scene: What is photographed.
        states: Indices into the grid.
        speed: Image speed [frame heights per second].
        defocus: Blur diameter at f/4 [pixel of a 64-pixel frame].
    """
    from ae_env.scorers.captures import describe_captures
    from ae_env.scorers.score_table import prepare_scene

    options = run.plan.options()
    camera = options.make_camera()
    prepared = prepare_scene(scene, camera, speed=speed, defocus=defocus)
    prepared = replace(prepared, tolerance=options.tolerance)
    found = []
    for first in range(0, len(states), _CHUNK):
        settings = [run.grid[int(state)] for state in states[first : first + _CHUNK]]
        count = len(settings)
        captures = describe_captures(
            [scene] * count,
            settings,
            camera,
            speed=np.full(count, speed),
            defocus=np.full(count, defocus),
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


def other_scores(
    run: PlanRun, result: EvaluationResult, blur: tuple[Floats, Floats], scorers: Sequence[str]
) -> dict[str, dict[str, float]]:
    """Mean expected score of the states that each policy chose, under each of `scorers`.

    Some scenes of the first seed, all starts and frames; averaged over frames, then training
    seeds, episodes of a source group, and source groups.

    Args:
        run: The plan that was run.
        result: What was measured in unchanging light.
        blur: Image speed and defocus of the episodes (`PlanRun.blur`).
        scorers: Names, as `make_scorer` takes them.

    Returns:
        ``{scorer: {policy: mean}}``.
    """
    from ae_env.scorers import make_scorer

    chosen = groups_in_turn(run.scenes, run.plan.other_scorer_scenes)
    places = {scene.scene_id: j for j, scene in enumerate(run.scenes)}
    made = {name: make_scorer(name) for name in scorers}  # all are known before any work
    table: dict[str, dict[str, float]] = {}
    for name, scorer in made.items():
        means: dict[str, dict[str, list[float]]] = {policy: {} for policy in result.tracks}
        for scene in chosen:
            j = places[scene.scene_id]  # the first seed's episodes come first
            episodes = np.flatnonzero(run.episodes.table == j)
            visited = np.unique(
                np.concatenate([t.states[:, episodes].ravel() for t in result.tracks.values()])
            )
            scores = np.full(len(run.grid), np.nan)
            scores[visited] = state_scores(
                scorer,
                run,
                scene,
                visited.tolist(),
                speed=float(blur[0][j]),
                defocus=float(blur[1][j]),
            )
            for policy, track in result.tracks.items():
                mean = float(scores[track.states[:, episodes]].mean())
                means[policy].setdefault(scene.group, []).append(mean)
        table[name] = {
            policy: float(np.mean([np.mean(values) for values in groups.values()]))
            for policy, groups in means.items()
        }
    return table
