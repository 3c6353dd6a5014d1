import numpy as np
import pytest

from ae_env.scorers import make_scorer
from ae_env.scorers.score_table import ScoreTables
from agents.evaluation.engine import other_scores
from agents.evaluation.jobs import run_plan
from agents.evaluation.plan import EvaluationPlan

PLAN = EvaluationPlan(
    environment={"scenes": "bundled:small", "split": "test", "resolution": 36},
    max_scenes=3,
    frames=3,
    starts=("dark",),
    policies=("matrix:P", "random"),
    other_scorers=("brightness", "sharpness"),
    other_scorer_scenes=2,
)


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    return run_plan(PLAN, tmp_path_factory.mktemp("parts"))["static"]


def test_means_are_over_frames_then_groups(result):
    table = result.other_scores
    assert table == other_scores(result)  # those of the run are these
    assert list(table) == ["brightness", "sharpness"]
    # By hand: two scenes of the three, each a group of its own.
    tables = ScoreTables(result.grid, PLAN.options().make_camera(), make_scorer("brightness"))
    for policy, track in result.tracks.items():
        means = [tables.table(result.scenes[j]).mean[track.states[0, j]].mean() for j in (0, 1)]
        assert table["brightness"][policy] == pytest.approx(np.mean(means), abs=1e-9)
