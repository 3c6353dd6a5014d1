from __future__ import annotations

import numpy as np
import pytest

from ae_env.scorers import make_scorer
from ae_env.scorers.score_table import ScoreTables
from agents.evaluation.evaluation_plan import EvaluationPlan
from agents.evaluation.other_scorers import other_scores, state_scores
from agents.evaluation.plan_jobs import run_plan
from agents.evaluation.plan_run import PlanRun

PLAN = EvaluationPlan(
    environment={"scenes": "bundled:small", "split": "test", "resolution": 36},
    max_scenes=3,
    frames=3,
    starts=("dark",),
    policies=("matrix:P", "random"),
    other_scorers=("brightness", "sharpness"),
    other_scorer_scenes=2,
)


class MeanSignal:
    """A scorer of images: the mean of the clipped raw."""

    domain = "raw"

    def __call__(self, images, captures):
        return images.mean(dim=(1, 2, 3))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("parts")
    return PlanRun(PLAN, folder), run_plan(PLAN, folder)["static"]


def test_some_states_score_as_they_do_in_a_whole_table(run):
    plan, _ = run
    scorer, options = make_scorer("balanced"), PLAN.options()
    tables = ScoreTables(plan.grid, options.make_camera(), scorer, use_cache=False)
    whole = tables.table(plan.scenes[0], speed=0.3, defocus=1.5).mean
    states = [63, 0, 20, 41]
    found = state_scores(scorer, plan, plan.scenes[0], states, speed=0.3, defocus=1.5)
    np.testing.assert_allclose(found, whole[states], atol=1e-6)


def test_scorers_of_images_see_noisy_captures(run):
    plan, _ = run
    scene, states = plan.scenes[0], list(range(0, 64, 3))
    found = state_scores(make_scorer(MeanSignal()), plan, scene, states)
    signal = [scene.prepared.expected(plan.grid[s]).clamp(0, 1).mean().item() for s in states]
    # Noise clipped at black lifts a dark frame's mean by less than its own deviation.
    np.testing.assert_allclose(found, signal, atol=0.02)
    assert found.max() - found.min() > 0.3


def test_means_are_over_frames_then_groups(run):
    plan, result = run
    blur = plan.blur(PLAN.all_conditions["static"])
    table = other_scores(plan, result, blur, PLAN.other_scorers)
    assert list(table) == ["brightness", "sharpness"]
    # By hand: two scenes of the three, each a group of its own.
    tables = ScoreTables(
        plan.grid, PLAN.options().make_camera(), make_scorer("brightness"), use_cache=False
    )
    for policy, track in result.tracks.items():
        means = []
        for j in (0, 1):
            q = tables.table(plan.scenes[j]).mean
            means.append(q[track.states[0, j]].mean())
        assert table["brightness"][policy] == pytest.approx(np.mean(means), abs=1e-9)


def test_an_unknown_scorer_is_refused(run):
    plan, result = run
    blur = plan.blur(PLAN.all_conditions["static"])
    with pytest.raises(ValueError, match="`scorer`"):
        other_scores(plan, result, blur, ["nose"])
