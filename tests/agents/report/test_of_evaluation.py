from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from ae_env.grid import ExposureGrid
from agents import write_report
from agents.evaluation.result import EvaluationResult, Track
from agents.evaluation.result_table import (
    best_meter,
    oracle_histogram,
    result_rows,
    weighted_quantile,
)
from agents.report.of_evaluation import training_seed_rows

COLUMNS = [
    *("policy", "condition", "source", "split", "num_groups", "seed", "mean_score"),
    *("normalised_score", "regret", "ci95", "ev_error_median", "ev_error_p95"),
    *("ev_within_third", "frames_to_converge", "overshoot", "reversals", "flicker"),
    *("clipped_high", "clipped_low", "captures_per_decision", "ms_per_decision"),
]


def _result(groups: int = 20) -> EvaluationResult:
    rng = np.random.default_rng(0)
    grid, frames, episodes = ExposureGrid.default(), 4, 2 * groups
    scores = np.repeat(rng.uniform(0.1, 0.9, (episodes, 1, 64)), frames, axis=1)
    best = scores[:, 0].argmax(-1)

    def track(states: np.ndarray) -> Track:
        zeros = np.zeros(states.shape)
        return Track(states, zeros, zeros + 0.25, zeros, 0.5, 1.0, False)

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
        allowed=np.ones((episodes, 64), bool),
        tracks={
            "oracle": track(oracle),
            "ppo": track(choose(3)),
            "matrix:P": track(choose(1)),
            "spot:P": track(np.where(rng.random(oracle.shape) < 0.5, oracle, 0)),
        },
        seed=11,
    )


def test_rows_have_the_contracts_columns_and_values():
    result = _result()
    rows = result_rows(result, source="bundled", split="test", resamples=500)
    assert [list(row) for row in rows] == [COLUMNS] * 12
    by = {(r["policy"], r["condition"]): r for r in rows}
    assert by["oracle", "all"]["normalised_score"] == pytest.approx(1.0)
    assert by["oracle", "all"]["regret"] == pytest.approx(0.0)
    assert by["oracle", "all"]["num_groups"] == 20
    assert by["oracle", "hard"]["num_groups"] == 10
    assert by["oracle", "hard"]["ci95"] is None
    assert by["ppo", "all"]["clipped_high"] == 0.25
    # Equal groups: the mean over everything is the mean over groups.
    chosen = np.take_along_axis(result.scores, result.tracks["spot:P"].states[0][..., None], -1)
    assert by["spot:P", "all"]["mean_score"] == pytest.approx(chosen.mean())
    random, oracle = result.scores.mean(), result.scores.max(-1).mean()
    expected = (chosen.mean() - random) / (oracle - random)
    assert by["spot:P", "all"]["normalised_score"] == pytest.approx(expected)
    low, high = by["spot:P", "all"]["ci95"]
    assert low < expected < high


def test_best_meter_and_histogram():
    result = _result()
    assert best_meter(result) == "spot:P"
    histogram = oracle_histogram(result)
    assert [len(v) for v in histogram.values()] == [4, 4, 4]
    assert sum(histogram["f_number"].values()) == pytest.approx(1.0)
    share = np.mean([result.grid[s].iso == 400 for s in result.oracle_states])
    assert histogram["iso"]["400"] == pytest.approx(share)


def test_weighted_quantile_of_equal_weights_is_a_plain_one():
    values = np.random.default_rng(0).normal(size=101)
    weights = np.full(101, 1 / 101)
    for q in (0.05, 0.5, 0.95):
        expected = np.quantile(values, q, method="inverted_cdf")
        assert weighted_quantile(values, weights, q) == pytest.approx(expected)


def test_files_of_a_report(tmp_path):
    files = write_report(
        _result(),
        tmp_path / "out",
        command="ae-env evaluate --seed 11",
        source="bundled",
        split="test",
        next_commands=["ae-env quickstart --scenes my_raws"],
    )
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == sorted(files)
    results = json.loads(files["results.json"].read_text())
    assert set(results) == {"meta", "rows"}
    assert results["meta"]["command"] == "ae-env evaluate --seed 11"
    assert results["meta"]["best_meter"] == "spot:P"
    ppo = [d for d in results["meta"]["differences_to_best_meter"] if d["policy"] == "ppo"]
    assert [d["condition"] for d in ppo] == ["all", "hard", "rest"]
    assert {d["num_training_seeds"] for d in ppo} == {3}
    with files["scenes.csv"].open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 4 * 20
    assert {line["episodes"] for line in lines} == {"2"}
    text = files["report.md"].read_text()
    assert "ae-env quickstart --scenes my_raws" in text
    assert "Difference to the best meter, `spot:P`" in text
    assert "ISO 6400" in text
    assert "1/125 s" in text
    assert files["scores.png"].read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_few_groups_print_every_value_and_no_interval(tmp_path):
    files = write_report(_result(4), tmp_path, command="x", source="mine", split="all")
    results = json.loads(files["results.json"].read_text())
    assert {row["ci95"] for row in results["rows"]} == {None}
    text = files["report.md"].read_text()
    assert "no intervals, but every value" in text
    assert all(f"| group-{i:02d} |" in text for i in range(4))


def test_one_condition_only_and_no_meter(tmp_path):
    result = _result()
    result = replace(result, hard=np.zeros_like(result.hard), tracks={"ppo": result.tracks["ppo"]})
    files = write_report(result, tmp_path, command="x", source="mine", split="all")
    results = json.loads(files["results.json"].read_text())
    assert {row["condition"] for row in results["rows"]} == {"all"}
    assert results["meta"]["best_meter"] is None


def test_training_seed_rows_average_to_the_policys_score():
    result = _result()
    rows = [r for r in training_seed_rows(result) if r["condition"] == "all"]
    assert [r["training_run"] for r in rows] == [0, 1, 2]
    ppo = next(
        r
        for r in result_rows(result, source="s", split="test", resamples=10)
        if r["policy"] == "ppo"
    )
    mean = np.mean([r["normalised_score"] for r in rows])
    assert mean == pytest.approx(ppo["normalised_score"])
