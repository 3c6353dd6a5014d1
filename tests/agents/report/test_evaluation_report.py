import base64
import json
from dataclasses import replace

import numpy as np

from agents import write_report
from tests.agents.report.results import made_result

NAMES = {"results.json", "scenes.csv", "metrics.csv", "report.md", "report.html"}
NAMES |= {"scores.png", "ev_error.png"}


def test_files_of_a_report(tmp_path):
    files = write_report(
        made_result(),
        tmp_path / "out",
        command="ae-env evaluate --seed 11",
        source="bundled",
        split="test",
        next_commands=["ae-env quickstart --scenes my_raws"],
    )
    assert {p.name for p in (tmp_path / "out").iterdir()} == set(files) == NAMES
    results = json.loads(files["results.json"].read_text())
    assert set(results) == {"meta", "rows"}
    assert results["meta"]["command"] == "ae-env evaluate --seed 11"
    assert results["meta"]["best_meter"] == "spot:P"
    assert [row["policy"] for row in results["meta"]["ranking"]] == ["spot:P", "matrix:P", "ppo"]
    text = files["report.md"].read_text()
    assert "ae-env quickstart --scenes my_raws" in text
    assert "Difference to the best meter, `spot:P`" in text
    assert "ISO 6400" in text
    assert "1/125 s" in text
    for name in ("scores.png", "ev_error.png"):
        assert files[name].read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
        data = base64.b64encode(files[name].read_bytes()).decode()
        assert data in files["report.html"].read_text()


def test_several_conditions_no_meter_and_one_part(tmp_path):
    result = made_result()
    result = replace(result, hard=np.zeros_like(result.hard), tracks={"ppo": result.tracks["ppo"]})
    files = write_report({"static": result, "sine": result}, tmp_path, command="x")
    results = json.loads(files["results.json"].read_text())
    assert {row["condition"] for row in results["rows"]} == {"all", "sine"}
    assert results["meta"]["best_meter"] is None
    assert "## Conditions" in files["report.md"].read_text()


def test_names_from_outside_show_no_file_and_few_groups_every_value(tmp_path):
    """Scenes, policies and folders may be called anything, a picture in Markdown included."""
    hostile = "![x](secret.png)<b>|`$x^$"
    (tmp_path / "secret.png").write_bytes(b"\x89PNG secret")
    result = made_result(4)
    result = replace(
        result,
        groups=np.array([hostile + group for group in result.groups]),
        tracks={hostile: result.tracks["ppo"], "spot:P": result.tracks["spot:P"]},
    )
    names = {"command": hostile, "source": hostile, "next_commands": [hostile]}
    files = write_report(result, tmp_path, **names, split="all")
    page = files["report.html"].read_text()
    assert base64.b64encode(b"\x89PNG secret").decode() not in page
    assert page.count("<img") == page.count('<img src="data:') == 2
    assert "<b>" not in page
    assert page.count("![x](secret.png)&lt;b&gt;|`$x^$") >= 8
    # Four groups are too few for intervals: every value is printed.
    results = json.loads(files["results.json"].read_text())
    assert {row["ci95"] for row in results["rows"]} == {None}
    assert "no intervals, but every value" in page
    assert all(f"group-{i:02d}<" in page for i in range(4))
