import csv
import io

import numpy as np
import pytest

from agents import result_rows
from agents.evaluation import result as result_table
from tests.agents.report.results import COLUMNS, made_result


def test_rows_have_the_contracts_columns_and_values():
    result = made_result()
    rows = result_rows(result, source="bundled", split="test", resamples=500)
    assert [list(row) for row in rows] == [COLUMNS] * 12
    by = {(r["policy"], r["condition"]): r for r in rows}
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
    names = [row["condition"] for row in rows if row["policy"] == "ppo"]
    assert names == ["all", "hard", "rest", "sine"]
    lines = list(csv.DictReader(io.StringIO(result_table.metrics_csv(results, rows))))
    assert len(lines) == len(rows)
    assert {"regret_given_ev", "regret_delayed", "converged", "ms_alone"} <= set(lines[0])
    both = [line for line in lines if line["policy"] == "ppo"]
    assert both[0]["regret_given_ev"] == both[3]["regret_given_ev"]
    ranking = result_table.ranking_rows(result_table.overall_ranking(results, resamples=100))
    assert [row["policy"] for row in ranking] == ["spot:P", "matrix:P", "ppo"]  # oracle is told
    assert [row["place"] for row in ranking] == [1, 2, 3]
    assert (ranking[1]["to_best"]["other"], ranking[2]["to_next"]) == ("spot:P", None)
    assert ranking[1]["to_best"]["difference"] < 0


def test_scenes_have_means_of_their_episodes():
    result = made_result()
    lines = list(csv.DictReader(io.StringIO(result_table.scenes_csv(result))))
    assert tuple(lines[0]) == result_table.SCENE_COLUMNS
    assert len(lines) == 4 * 20
    line = next(x for x in lines if (x["policy"], x["scene_id"]) == ("matrix:P", "scene-03"))
    states = result.tracks["matrix:P"].states[0, 6:8]
    q = [[result.scores[6 + e, t, states[e, t]] for t in range(4)] for e in range(2)]
    assert float(line["score"]) == pytest.approx(np.mean(q), abs=1e-6)
    assert float(line["oracle"]) == pytest.approx(result.scores[6:8].max(-1).mean(), abs=1e-6)
    assert (line["episodes"], line["hard"], line["kind"]) == ("2", "0", "photograph")
    assert int(line["final_state"]) == states[0, -1]
    assert int(line["oracle_state"]) == result.scores[6, -1].argmax()


def test_best_meter_differences_and_histogram():
    result = made_result()
    assert result_table.best_meter(result) == "spot:P"
    rows = result_table.difference_rows(result, "spot:P", resamples=100)
    ppo = [row for row in rows if row["policy"] == "ppo"]
    assert [row["condition"] for row in ppo] == ["all", "hard", "rest"]
    assert {row["num_training_seeds"] for row in ppo} == {3}
    scores = {r["policy"]: r for r in result_rows(result, resamples=10) if r["condition"] == "all"}
    change = scores["ppo"]["normalised_score"] - scores["spot:P"]["normalised_score"]
    assert ppo[0]["difference"] == pytest.approx(change)
    seeds = [r for r in result_table.training_seed_rows(result) if r["condition"] == "all"]
    assert [r["training_run"] for r in seeds] == [0, 1, 2]
    mean = np.mean([r["normalised_score"] for r in seeds])
    assert mean == pytest.approx(scores["ppo"]["normalised_score"])
    histogram = result_table.oracle_histogram(result)
    assert [len(v) for v in histogram.values()] == [4, 4, 4]
    assert sum(histogram["f_number"].values()) == pytest.approx(1.0)
    share = np.mean([result.grid[s].iso == 400 for s in result.oracle_states])
    assert histogram["iso"]["400"] == pytest.approx(share)
