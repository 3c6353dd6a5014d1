import numpy as np
import pytest

from ae_env.scorers import make_scorer
from ae_env.scorers.score_table import ScoreTables
from agents.evaluation.evaluation_plan import EvaluationPlan
from agents.evaluation.other_scorers import other_scores, state_scores
from agents.evaluation.plan_run import run_plan

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
def result(tmp_path_factory):
    return run_plan(PLAN, tmp_path_factory.mktemp("parts"))["static"]


def test_some_states_score_as_they_do_in_a_whole_table(result):
    scorer, options, scene = make_scorer("balanced"), PLAN.options(), result.scenes[0]
    tables = ScoreTables(result.grid, options.make_camera(), scorer)
    whole = tables.table(scene, speed=0.3, defocus=1.5).mean
    states = [63, 0, 20, 41]
    found = state_scores(scorer, options, scene, states, speed=0.3, defocus=1.5)
    np.testing.assert_allclose(found, whole[states], atol=1e-6)


def test_scorers_of_images_see_noisy_captures(result):
    scene, states = result.scenes[0], list(range(0, 64, 3))
    found = state_scores(make_scorer(MeanSignal()), PLAN.options(), scene, states)
    expected = [result.scenes[0].prepared.expected(result.grid[s]) for s in states]
    signal = [light.clamp(0, 1).mean().item() for light in expected]
    # Noise clipped at black lifts a dark frame's mean by less than its own deviation.
    np.testing.assert_allclose(found, signal, atol=0.02)
    assert found.max() - found.min() > 0.3


def test_means_are_over_frames_then_groups(result):
    table = result.other_scores
    assert table == other_scores(result, PLAN)  # those of the run are these
    assert list(table) == ["brightness", "sharpness"]
    # By hand: two scenes of the three, each a group of its own.
    tables = ScoreTables(result.grid, PLAN.options().make_camera(), make_scorer("brightness"))
    for policy, track in result.tracks.items():
        means = [tables.table(result.scenes[j]).mean[track.states[0, j]].mean() for j in (0, 1)]
        assert table["brightness"][policy] == pytest.approx(np.mean(means), abs=1e-9)
