import csv
from dataclasses import replace

import numpy as np
import pytest
import torch

from agents.evaluation.evaluation_plan import EvaluationPlan, plan_scenes
from agents.evaluation.plan_run import run_plan
from agents.report import ae_bench
from agents.report.result_table import overall_ranking
from simulator.capture.layout import Layout

PLAN = EvaluationPlan(
    name="Bench",
    environment={"scenes": "bundled:small", "split": "test", "resolution": 36},
    max_scenes=16,
    frames=3,
    starts=("middle",),
    policies=("random", "matrix:P"),
)


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
    changed = [
        [replace(scenes[0], light=light), *scenes[1:]]
        for light in (scenes[0].light * 1.15, corner)  # 0.2 EV
    ]
    assert scenes[0].layout is not None
    changed.append([replace(scenes[0], layout=Layout(1.0 - scenes[0].layout.defocus)), *scenes[1:]])
    for other, own in ((plan.changed(frames=4), scenes), *((plan, own) for own in changed)):
        with pytest.raises(ValueError, match="has changed, so results would not"):
            ae_bench.check_hash(other, own)


def test_signature_of_known_light(scenes):
    scene = scenes[0]
    light = torch.full((4, 36, 36), 0.25)
    light[:, :9, :9] = 1.0  # the first of 4 x 4 blocks
    found = ae_bench.scene_signature(replace(scene, light=light))
    codes = np.array(found[-2])
    assert codes.shape == (4, 4, 4)
    assert (codes[:, 0, 0] - codes[:, 3, 3] == 20).all()  # two stops in tenths


def test_rows_are_added_and_replaced_and_the_page_written(plan, tmp_path, caplog):
    results = run_plan(plan, tmp_path / "parts")
    ranking = overall_ranking(results, resamples=200)
    table = tmp_path / "docs" / "ae-bench" / "v1.csv"
    files = ae_bench.append_results(table, plan, results, ranking, author="first")
    assert sorted(files) == ["ae-bench.md", "v1.csv"]
    again = [one for one in ranking if one.policy == "random"]
    assert "replaced" not in caplog.text
    ae_bench.append_results(table, plan, results, again, author="second")
    assert "replaced" not in caplog.text
    ae_bench.append_results(table, plan, results, again, author="first")
    assert "replaced the row of 'random' by 'first'" in caplog.text
    with table.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    found = sorted(f"{row['policy']} {row['author']}" for row in rows)
    assert found == ["matrix:P first", "random first", "random second"]
    assert tuple(rows[0]) == ae_bench.COLUMNS
    assert {row["hash"] for row in rows} == {plan.hash}
    assert float(rows[0]["normalised_score"]) == pytest.approx(ranking[0].score.value, abs=5e-5)
    page = (tmp_path / "docs" / "ae-bench.md").read_text()
    assert "| matrix:P |" in page
    assert page.index("matrix:P") < page.index("| random |")
    assert str(tmp_path) not in page
    with pytest.raises(ValueError, match="they do not compare"):
        ae_bench.append_results(table, plan.changed(hash="0"), results, ranking, author="x")
    table.write_text("policy,score\n")
    with pytest.raises(ValueError, match="its columns must be"):
        ae_bench.read_table(table)


def _table(file, plan, **entries):
    row = dict.fromkeys(ae_bench.COLUMNS, "") | {"hash": plan.hash} | entries
    file.write_text(",".join(row) + "\n" + ",".join(row.values()) + "\n")
    return file


def test_a_table_is_checked_before_the_run(plan, tmp_path):
    check = ae_bench.check_append
    check(tmp_path / "new.csv", plan, ["random"], author="")
    table = _table(tmp_path / "a.csv", plan, policy="my.py:Mine")
    check(table, plan, ["u/my.py:Mine"], author="me")
    check(table, plan, ["random"], author="")
    (broken := tmp_path / "broken.csv").write_bytes(b"\xff\xfe")
    other = _table(tmp_path / "b.csv", plan, hash="0")
    for file, policies, author, message in (
        (table, ["u/my.py:Mine"], " ", r"`author` .*row of 'my\.py:Mine' without an author"),
        (table, ["u/my.py:Mine", "v/my.py:Mine"], "me", r"the same row 'my\.py:Mine'"),
        (table, [], "me", "none of the policies gets a row"),
        (tmp_path / "a.md", ["random"], "me", "must be a CSV file"),
        (other, ["random"], "me", "they do not compare"),
        (broken, ["random"], "me", "cannot be read as a table"),
    ):
        with pytest.raises(ValueError, match=message):
            check(file, plan, policies, author=author)
