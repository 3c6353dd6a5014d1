"""Reports: files, Markdown and HTML, the terminal, films of an episode."""

import base64
import json
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from markdown_it import MarkdownIt
from PIL import Image

from agents import PolicyContext, make_policy, write_report
from agents.report.evaluation import code, code_block, escape, html_report, summary, to_markdown
from agents.report.plots import CHART, GAP, PICTURE, TITLE, Recording, record, write_film
from tests.agents.conftest import TINY
from tests.agents.report.results import made_brackets, made_result

NAMES = {
    *("results.json", "scenes.csv", "metrics.csv", "report.md", "report.html"),
    *("scores.png", "ev_error.png"),
}


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
    for shown in ("ae-env quickstart --scenes my_raws", "best meter, `spot:P`", "ISO 6400"):
        assert shown in text
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


def test_brackets_have_a_table_for_each_budget(tmp_path):
    quality = np.linspace(0.5, 0.8, 16)[None]
    results = {"0.1 s": made_brackets(a=quality), "0.2 s": made_brackets(a=quality + 0.1)}
    files = write_report(results, tmp_path, command="ae-env x")
    assert set(files) == {p.name for p in tmp_path.iterdir()} == {"results.json", "report.md"}
    text = files["report.md"].read_text()
    assert "```\nae-env x\n```" in text
    places = [text.index(shown) for shown in ("## 0.1 s", "0.6500", "## 0.2 s", "0.7500")]
    assert places == sorted(places)
    content = json.loads(files["results.json"].read_text())
    assert content["meta"]["plan"]["budgets"] == [0.1, 0.2]
    assert [row["quality"] for row in content["rows"]] == [pytest.approx(0.65), pytest.approx(0.75)]


def test_the_terminal_shows_scores_or_every_group(tmp_path):
    ((title, frame),) = summary({"static": made_result(), "sine": made_result()})
    assert "over 2 conditions" in title
    assert frame.policy.tolist() == ["spot:P", "matrix:P", "ppo"]
    (_, frame), *groups = summary(made_result(6))
    assert frame["95 % interval (all)"].tolist() == ["too few groups"] * 4
    assert [len(own.columns) for _, own in groups] == [5, 3]  # four of the six groups, then two
    ((_, frame),) = summary({"0.1 s": made_brackets(a=np.full((1, 16), 0.5))})
    assert frame.to_numpy().tolist() == [["a", "0.5000", "0.5000 to 0.5000", "0.5000"]]


PNG = b"\x89PNG\r\n\x1a\n1234"
#: Names that mean something to Markdown or HTML.
HOSTILE = [
    "![x](secret.png)",
    "[x](http://example.org)",
    "<script>alert(1)</script>",
    "a | b",
    "**bold** _it_ ~~no~~",
    "`code` &lt; \\",
    "line\n\n# heading",
    "<http://example.org>",
]


def _rendered(text: str) -> str:
    return MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"]).render(text)


@pytest.mark.parametrize("name", HOSTILE)
def test_names_are_shown_as_they_are(name):
    shown = " ".join(name.split()).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    assert _rendered(f"a {escape(name)} b") == f"<p>a {shown} b</p>\n"
    table = _rendered(to_markdown([{"name": name, "x": 1}], {"name": "{name}", "x": "{x}"}))
    assert f">{shown}</td>" in table
    assert table.count("<td") == 2
    assert _rendered(f"a {code(name)} b") == f"<p>a <code>{shown}</code> b</p>\n"
    plain = "my_file.py:MyPolicy?gain=1/2"
    assert escape(plain) == plain  # stays readable


def test_cells_of_a_table():
    rows = pd.DataFrame({"a": ["x", "y"], "b": [[0.5, 0.25], None], "c": [{"d": 2}, {}], "n": 1e-3})
    columns = {"a": "{a}", "pair": "{b:+.1f}", "d": "{c[d]:.1f} %", "f": lambda r: r["n"] * 2}
    found = [line.strip("|").split("|") for line in to_markdown(rows, columns).splitlines()]
    cells = [[text.strip() for text in line] for line in found]
    assert cells[0] == list(columns)
    assert cells[2:] == [["x", "+0.5 to +0.2", "2.0 %", "0.002"], ["y", "-", "-", "0.002"]]
    gaps = to_markdown(rows, {"a": "{a}", "none": "{b[3]}", "pair": "{b:.1f}"}, missing="")
    assert "none" not in gaps
    assert "-:|" in gaps  # numbers to the right
    assert to_markdown([], {"a": "{a}", "b": "{b}"}).count("\n") == 1


def test_a_block_of_code_ends_where_it_should():
    page = _rendered(code_block("ae-env --scenes '```'", "<b>\nmore"))
    assert page == "<pre><code>ae-env --scenes '```'\n&lt;b&gt; more\n</code></pre>\n"


def test_a_page_has_the_reports_pictures_and_no_others(tmp_path):
    for name in ("plot.png", "secret.png"):
        (tmp_path / name).write_bytes(PNG)
    text = "![A & plot](plot.png) ![a secret](secret.png) ![gone](none.png)\n\n<script>x</script>"
    page = html_report(text, {"plot.png": tmp_path / "plot.png"}, "A & B")
    data = base64.b64encode(PNG).decode()
    assert f'<img src="data:image/png;base64,{data}" alt="A &amp; plot"> a secret gone' in page
    assert page.count(data) == 1
    assert "<title>A &amp; B</title>" in page
    assert "<script>" not in page
    assert "http" not in page  # it needs no other file


@pytest.fixture
def envs():
    options = {**TINY, "render_mode": "rgb_array", "with_oracle": True, "max_episode_steps": 9}
    return gym.make_vec("ae_env/AutoExposureVideo-v0", num_envs=1, **options)


def test_it_shows_the_episode_of_each_policy(envs, tmp_path):
    context = PolicyContext.from_envs(envs)
    found = record("oracle", make_policy("oracle", context), envs, 5, 3)
    envs.reset(seed=3)
    best = [envs.unwrapped.grid.ev100[envs.unwrapped.score_table(0).oracle]]
    assert found.best[:1] == best
    assert [len(v) for v in (found.pictures, found.ev100, found.best, found.scores)] == [6] * 4
    # Settings are in effect two frames after the next: frame 3 has what was best for frame 0.
    assert found.ev100[3] == found.best[0]
    done = []
    other = record("average:P", make_policy("average:P", context), envs, 5, 3)
    assert other.best == found.best  # the same episode
    path = tmp_path / "film.gif"
    write_film(path, [other, found], lambda n, total: done.append((n, total)))
    with Image.open(path) as image:
        assert (image.format, image.n_frames) == ("GIF", 6)
        assert image.size == (2 * PICTURE + GAP, TITLE + PICTURE + CHART)
    assert done == [(n, 6) for n in range(1, 7)]


def test_the_chart_draws_the_policy_up_to_now(tmp_path):
    picture = np.full((16, 16, 3), 200, np.uint8)
    flat = Recording("flat", [picture] * 3, [5.0] * 3, [9.0] * 3, [0.5] * 3)
    with Image.open(write_film(tmp_path / "f.gif", [flat])) as image:
        red = []
        for frame in range(3):
            image.seek(frame)
            pixels = np.asarray(image.convert("RGB")).astype(int)
            reddish = (pixels[..., 0] - pixels[..., 1] > 80).any(axis=0)
            red.append(int(reddish.sum()))
    assert red[0] == 0
    assert 0.4 * PICTURE < red[1] < 0.6 * PICTURE < red[2]
