import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from agents.evaluation.evaluation_plan import EvaluationPlan, load_plan, plan_scenes
from agents.evaluation.jobs import run_plan
from agents.evaluation.result import overall_ranking
from agents.report import ae_bench
from simulator.capture.prepared_scene import Layout
from tests.agents.report.results import made_brackets

ENVIRONMENT = {"scenes": "bundled:small", "split": "test", "resolution": 36}
PLAN = EvaluationPlan(name="Bench", task="still", environment=ENVIRONMENT, max_scenes=4)
PLAN = PLAN.changed(frames=3, starts=("middle",), policies=("random", "matrix:P"))


@pytest.fixture(scope="module")
def scenes():
    return plan_scenes(PLAN)


@pytest.fixture(scope="module")
def plan(scenes) -> EvaluationPlan:
    return PLAN.changed(hash=ae_bench.bench_hash(PLAN, scenes))


def test_hash_notices_the_plan_and_the_light(plan, scenes):
    ae_bench.check_hash(plan, scenes)
    ae_bench.check_hash(PLAN, scenes[:1])  # no benchmark, nothing to check
    ae_bench.check_hash(plan.changed(policies=("spot:P",)), scenes)  # who runs is no matter
    corner = scenes[0].light.clone()
    corner[:, :9, :9] *= 2.0
    changed = [{"light": light} for light in (scenes[0].light * 1.15, corner)]  # 0.2 EV
    changed.append({"layout": Layout(1.0 - scenes[0].layout.defocus)})
    others = [(plan, [replace(scenes[0], **own), *scenes[1:]]) for own in changed]
    for other, own in ((plan.changed(frames=4), scenes), *others):
        with pytest.raises(ValueError, match="`hash`"):
            ae_bench.check_hash(other, own)
    light = torch.full((4, 36, 36), 0.25)
    light[:, :9, :9] = 1.0  # the first of 4 x 4 blocks
    codes = np.array(ae_bench.scene_signature(replace(scenes[0], light=light))[-2])
    assert codes.shape == (4, 4, 4)
    assert (codes[:, 0, 0] - codes[:, 3, 3] == 20).all()  # two stops in tenths


def test_plans_of_a_suite_have_one_hash_whatever_a_policy_sees(scenes, tmp_path):
    files = [str(tmp_path / f"{task}.yaml") for task in ("still", "bracket")]
    text = "environment: {{scenes: 'bundled:small', split: test, resolution: 36}}\nsuite: {0}\n{1}"
    (tmp_path / "still.yaml").write_text(text.format(files, "frames: 3\n"))
    (tmp_path / "bracket.yaml").write_text(text.format(files, "budgets: [0.1]\n"))
    still, bracket = (load_plan(file) for file in files)
    assert (still.measure, bracket.measure) == ("score", "quality")
    found = ae_bench.bench_hash(still, scenes)
    assert found == ae_bench.bench_hash(bracket, scenes)
    statistics = still.changed(environment={**still.environment, "observation": "statistics"})
    assert found == ae_bench.bench_hash(statistics, scenes)
    (tmp_path / "bracket.yaml").write_text(text.format(files, "budgets: [0.2]\n"))
    assert found != ae_bench.bench_hash(still, scenes)
    # The published ones are one.
    plans = [load_plan(f"ae_bench_v2_{task}") for task in ("still", "video", "bracket")]
    assert {plan.task for plan in plans} == {"still", "video", "bracket"}
    assert len({(plan.suite, plan.scene_ids, plan.hash) for plan in plans}) == 1
    assert {"bundled", "mixed"} >= {plan.environment["scenes"] for plan in plans}
    rows = ae_bench.read_table(Path("docs/ae-bench/v2.csv"))
    assert set(rows.hash) == {plans[0].hash}
    assert rows.to_csv(index=False) == Path("docs/ae-bench/v2.csv").read_text()


def test_rows_are_added_and_replaced_and_the_page_written(plan, tmp_path, caplog):
    results = run_plan(plan, tmp_path / "parts")
    ranking = overall_ranking(results, resamples=200)
    found = ae_bench.bench_rows(results, ranking)
    table = tmp_path / "docs" / "ae-bench" / "v2.csv"
    files = ae_bench.append_rows(table, plan, found, author="first")
    assert sorted(files) == ["ae-bench.md", "v2.csv"]
    again = found[found.policy == "random"]
    statistics = plan.changed(environment={**plan.environment, "observation": "statistics"})
    assert "replaced" not in caplog.text
    ae_bench.append_rows(table, plan, again, author="second")
    ae_bench.append_rows(table, statistics, again, author="first")
    assert "replaced" not in caplog.text
    ae_bench.append_rows(table, plan, again, author="first")
    assert "replaced the row of 'random' by 'first'" in caplog.text
    with table.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    shown = sorted(f"{row['policy']} {row['observation']} {row['author']}" for row in rows)
    named = ("random statistics first", "random uint8 first", "random uint8 second")
    assert shown == ["matrix:P uint8 first", *named]
    assert tuple(rows[0]) == ae_bench.COLUMNS
    assert float(rows[0]["score"]) == pytest.approx(ranking.normalised_score[0], abs=5e-5)
    assert rows[0]["real"] == rows[0]["unseen"] == ""  # no real places, no brackets
    assert float(rows[0]["procedural"]) == pytest.approx(float(rows[0]["score"]), abs=2e-4)
    page = (tmp_path / "docs" / "ae-bench.md").read_text()
    assert "## Still" in page
    assert "## Bracket" not in page
    assert page.index("| matrix:P ") < page.index("| random ")
    assert str(tmp_path) not in page
    with pytest.raises(ValueError, match="under the hash"):
        ae_bench.append_rows(table, plan.changed(hash="0"), found, author="x")


def test_rows_of_brackets_by_hand(tmp_path):
    """Two groups, one of a real place; two budgets; one seed."""
    groups = [ae_bench.list_assets()[0].place, "zz"]
    quality = {"0.1 s": [[0.9, 0.7]], "0.2 s": [[1.0, 0.8]]}
    results = {name: made_brackets(groups, p=np.array(own)) for name, own in quality.items()}
    rows = ae_bench.bench_rows(results, overall_ranking(results))
    row = rows.iloc[0]
    assert row.score == pytest.approx(0.85)
    assert (row.real, row.procedural) == (pytest.approx(0.95), pytest.approx(0.75))
    assert row.ms_alone == pytest.approx(500.0)
    plan = results["0.1 s"].plan
    ae_bench.append_rows(tmp_path / "mine.csv", plan, rows, author="me")
    page = (tmp_path / "mine.md").read_text().replace(" ", "")
    assert "|p|uint8|0.8500|-|0.7500|0.9500|" in page


def _table(file, plan, **entries):
    known = {"hash": plan.hash, "task": "still", "observation": "uint8", "score": "0.5"}
    row = dict.fromkeys(ae_bench.COLUMNS, "") | known | entries
    file.write_text(",".join(row) + "\n" + ",".join(row.values()) + "\n")
    return file


def test_a_table_is_checked_before_the_run(plan, tmp_path):
    check = ae_bench.check_append
    check(tmp_path / "new.csv", plan, ["random"], author="")
    table = _table(tmp_path / "a.csv", plan, policy="my.py:Mine")
    check(table, plan, ["u/my.py:Mine"], author="me")
    check(table, plan, ["random"], author="")
    (broken := tmp_path / "broken.csv").write_bytes(b"\xff\xfe")
    (columns := tmp_path / "columns.csv").write_text("policy,score\n")
    (tmp_path / "notes.md").write_text("mine")
    with pytest.raises(ValueError, match="`append`"):
        check(tmp_path / "new.csv", plan.changed(task=""), ["random"], author="me")
    for file, policies, author, message in (
        (table, ["u/my.py:Mine"], " ", r"`author` .*'my\.py:Mine'"),
        (table, ["u/my.py:Mine", "v/my.py:Mine"], "me", r"`policy` .*'my\.py:Mine'"),
        (table, [], "me", "`append`"),
        (tmp_path / "a.md", ["random"], "me", "`append`"),
        (tmp_path / "notes.csv", ["random"], "me", r"`append` .*notes\.md"),
        (_table(tmp_path / "b.csv", plan, hash="0"), ["random"], "me", r"b\.csv .*hash"),
        (_table(tmp_path / "d.csv", plan, score="x"), ["random"], "me", r"d\.csv, line 2: `score`"),
        (broken, ["random"], "me", "broken.csv"),
        (columns, ["random"], "me", "columns.csv: its columns"),
    ):
        with pytest.raises(ValueError, match=message):
            check(file, plan, policies, author=author)
