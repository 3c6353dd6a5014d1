import numpy as np
import pytest

from agents import result_rows
from agents.evaluation import result as made
from tests.agents.report.results import COLUMNS, made_brackets, made_result


def test_rows_have_the_contracts_columns_and_values():
    result = made_result()
    rows = result_rows(result, source="bundled", split="test", resamples=500)
    assert list(rows.columns)[: len(COLUMNS)] == COLUMNS
    assert len(rows) == 12
    by = {(r["policy"], r["condition"]): r for _, r in rows.iterrows()}
    oracle, hard = by["oracle", "all"], by["oracle", "hard"]
    assert (oracle["normalised_score"], oracle["regret"]) == pytest.approx((1.0, 0.0))
    assert (oracle["num_groups"], hard["num_groups"], hard["ci95"]) == (20, 10, None)
    assert by["ppo", "all"]["clipped_high"] == 0.25
    # Equal groups: the mean over everything is the mean over groups.
    chosen = np.take_along_axis(result.scores, result.tracks["spot:P"].states[0][..., None], -1)
    assert by["spot:P", "all"]["mean_score"] == pytest.approx(chosen.mean())
    random, oracle = result.scores.mean(), result.scores.max(-1).mean()
    expected = (chosen.mean() - random) / (oracle - random)
    assert by["spot:P", "all"]["normalised_score"] == pytest.approx(expected)
    low, high = by["spot:P", "all"]["ci95"]
    assert low < expected < high


def test_other_conditions_have_one_row_of_their_own_name():
    results = {"static": made_result(), "sine": made_result()}
    rows = result_rows(results, resamples=10)
    own = rows[rows.policy == "ppo"]
    assert own.condition.tolist() == ["all", "hard", "rest", "sine"]
    assert own.regret_given_ev.iloc[0] == own.regret_given_ev.iloc[3]
    ranking = made.overall_ranking(results, resamples=100)
    assert ranking.policy.tolist() == ["spot:P", "matrix:P", "ppo"]  # oracle is told
    assert ranking.place.tolist() == [1, 2, 3]
    assert (ranking.to_best[1]["other"], ranking.to_next[2]) == ("spot:P", None)
    assert ranking.to_best[1]["difference"] < 0


def test_scenes_have_means_of_their_episodes():
    result = made_result()
    rows = made.scene_rows(result)
    assert tuple(rows.columns) == made.SCENE_COLUMNS
    assert len(rows) == 4 * 20
    row = rows.set_index(["policy", "scene_id"]).loc["matrix:P", "scene-03"]
    states = result.tracks["matrix:P"].states[0, 6:8]
    q = [[result.scores[6 + e, t, states[e, t]] for t in range(4)] for e in range(2)]
    assert row.score == pytest.approx(np.mean(q))
    assert row.oracle == pytest.approx(result.scores[6:8].max(-1).mean())
    assert (row.episodes, row.hard, row.kind) == (2, 0, "photograph")
    assert row.final_state == states[0, -1]
    assert row.oracle_state == result.scores[6, -1].argmax()
    groups = made.group_rows(result)
    assert groups.loc["group-03", "matrix:P"] == pytest.approx(np.mean(q))


def test_best_meter_differences_and_histogram():
    result = made_result()
    assert made.best_meter(result) == "spot:P"
    rows = made.difference_rows(result, "spot:P", resamples=100)
    ppo = rows[rows.policy == "ppo"]
    assert ppo.condition.tolist() == ["all", "hard", "rest"]
    assert set(ppo.num_training_seeds) == {3}
    scores = result_rows(result, resamples=10).query("condition == 'all'").set_index("policy")
    scores = scores.normalised_score
    assert ppo.difference.iloc[0] == pytest.approx(scores["ppo"] - scores["spot:P"])
    seeds = [r for r in made.training_seed_rows(result) if r["condition"] == "all"]
    assert [r["training_run"] for r in seeds] == [0, 1, 2]
    assert np.mean([r["normalised_score"] for r in seeds]) == pytest.approx(scores["ppo"])
    histogram = made.oracle_histogram(result)
    assert [len(v) for v in histogram.values()] == [4, 4, 4]
    assert sum(histogram["f_number"].values()) == pytest.approx(1.0)
    share = np.mean([result.grid[s].iso == 400 for s in result.oracle_states])
    assert histogram["iso"]["400"] == pytest.approx(share)
    kinds = made.scores_by_kind(result)
    assert {kind: own["groups"] for kind, own in kinds.items()} == {"snow": 10, "photograph": 10}
    assert kinds["snow"]["oracle"] == pytest.approx(1.0)


def test_brackets_by_hand():
    """16 groups, two budgets: the same differences in each group, so intervals without width."""
    quality = np.linspace(0.5, 0.8, 16)[None]
    results = {
        f"{budget:g} s": made_brackets(low=quality + 0.1 * k, high=quality + 0.1 * k + 0.05)
        for k, budget in enumerate((0.1, 0.2))
    }
    ranking = made.overall_ranking(results)
    assert (ranking.policy.tolist(), ranking.tier.tolist()) == (["high", "low"], [1, 2])
    assert ranking.normalised_score[1] == pytest.approx(0.7)
    rows = made.bracket_rows(results, ranking).set_index(["budget", "policy"])
    low = rows.loc[0.2, "low"]
    assert (low.quality, low.unseen, low.num_groups) == (pytest.approx(0.75), 0.5, 16)
    assert low.to_best == pytest.approx(-0.05)
    np.testing.assert_allclose(low.to_best_ci95, [-0.05, -0.05])
    assert rows.loc[0.1, "high"].to_best == 0.0
