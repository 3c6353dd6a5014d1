"""Evaluations of brackets: plans, results, and the command."""

import json
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from agents.cli.evaluate import evaluate
from agents.evaluation.plan import BracketPlan, BracketResult, run_bracket_plan

SMALL = {"scenes": "bundled:small", "resolution": 36}


def test_the_same_episodes_for_all_policies_and_means_by_group() -> None:
    """A schedule of one frame, run twice under two names, has the same results; seeds count."""
    plan = BracketPlan(
        environment=SMALL,
        max_scenes=6,
        budgets=(0.05, 0.3),
        policies=("bracket:fixed?step=0", "bracket:fixed?step=0.0", "bracket:fixed?step=4"),
    )
    first, again, other = sorted(run_bracket_plan(plan), key=lambda result: result.policy)[:3]
    for name, values in first.values.items():
        assert values.shape == (1, 2, len(first.groups))
        if name != "seconds":
            np.testing.assert_array_equal(values, again.values[name])
    assert (first.values["frames"] == 1).all()
    assert (other.values["frames"] == 3).all()
    more = run_bracket_plan(plan.changed(seeds=(0, 1), policies=plan.policies[:1]))[0]
    alone = run_bracket_plan(plan.changed(seeds=(1,), policies=plan.policies[:1]))[0]
    mean = 0.5 * (first.values["quality"] + alone.values["quality"])
    np.testing.assert_allclose(more.values["quality"], mean)


def test_a_policy_for_single_frames_is_refused_as_it_was_written(ae_env, tmp_path: Path) -> None:
    """The name, no path of the package; and no empty folder stays."""
    small = ("--preset", "bracket", "--scenes", "bundled:small", "--resolution", 36)
    for policy in ("regression", "ppo", "matrix"):
        code, _, error = ae_env("evaluate", *small, "--policy", policy)
        assert (code, error.count("\n")) == (2, 1)
        assert f"`policy` (='{policy}') is not for ae_env/ExposureBracket-v0" in error
    assert not (tmp_path / "evaluation").exists()


def test_scores_and_differences_by_hand() -> None:
    groups = np.array([f"g{i}" for i in range(16)])
    quality = np.linspace(0.5, 0.8, 16)
    low = BracketResult("low", groups, {"quality": np.stack([quality, quality + 0.1])[None]})
    high = BracketResult("high", groups, {"quality": low.values["quality"] + 0.05})
    assert low.score().value == pytest.approx(0.7)
    assert low.score(budget=1).value == pytest.approx(0.75)
    apart = high.score(low)
    assert apart.value == pytest.approx(0.05)
    np.testing.assert_allclose(apart.pair, [0.05, 0.05])  # the same in each group


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"budgets": []}, "budgets"),
        ({"budgets": [0.1, 0.1]}, "twice"),
        ({"budgets": [0.0]}, "must be in"),
        ({"budgets": [0.1], "environment": {"budget": 1}}, "must not have `budget`"),
        ({"budgets": [0.1], "environment": {"scene": "bundled"}}, "scene"),
        ({"budgets": [0.1], "frames": 3}, "frames"),
    ],
)
def test_wrong_entries_are_named(entries: dict, message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        BracketPlan.model_validate(entries)


def test_the_command_writes_a_report_and_refuses_what_is_not_of_brackets(tmp_path: Path) -> None:
    plan = tmp_path / "mine.yaml"
    plan.write_text(
        "environment: {scenes: 'bundled:small', resolution: 36}\nmax_scenes: 4\nbudgets: [0.1]\n"
    )
    names = ["bracket:fixed?step=0", "bracket", "random"]
    evaluate(policy=names, preset=str(plan), out=tmp_path / "out")
    found = json.loads((tmp_path / "out" / "results.json").read_text())
    assert {row["policy"] for row in found["rows"]} == set(names)
    assert found["meta"]["plan"]["budgets"] == [0.1]
    assert "bracket:fixed?step=0" in (tmp_path / "out" / "report.md").read_text()
    for arguments, message in (
        ({"grid": "video"}, "does not take --grid"),
        ({"lighting": "step"}, "does not take --lighting"),
        ({"append": tmp_path / "t.csv"}, "of a benchmark only"),
    ):
        with pytest.raises(ValueError, match=message):
            evaluate(policy=names, preset=str(plan), out=tmp_path / "x", **arguments)
    for name in ("average:P", "regression"):
        with pytest.raises(ValueError, match=rf"`policy` \(='{name}.*is not for .*take random"):
            evaluate(policy=[name], preset=str(plan), out=tmp_path / "x")
    with pytest.raises(ValueError, match="nobody"):
        evaluate(policy=["nobody"], preset=str(plan), out=tmp_path / "x")
