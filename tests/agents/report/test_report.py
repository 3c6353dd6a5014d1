"""Rows and reports: files, Markdown and HTML, the terminal, films, AE-Bench; what judges choose."""

import base64
import csv
import json
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch
from markdown_it import MarkdownIt
from matplotlib.text import Text
from PIL import Image
from scipy.stats import bootstrap

from ae_env.grid import ExposureGrid
from ae_env.rendering import PATH_COLOURS
from ae_env.scenes import Scene
from agents import EvaluationResult, PolicyContext, make_policy, result_rows, write_report
from agents.evaluation import result as made
from agents.evaluation.evaluation_plan import EvaluationPlan, load_plan, plan_scenes
from agents.evaluation.jobs import run_plan
from agents.evaluation.result import BRACKET_METRICS, Track, overall_ranking
from agents.report import ae_bench, judging, plots
from agents.report.evaluation import code, code_block, escape, summary, to_markdown
from agents.report.film import CHART, GAP, PICTURE, TITLE, record, write_film
from agents.report.judging import Judging, write_fit
from simulator import CameraSettings, get_camera
from simulator.capture.blurred_frames import Layout
from tests.ae_env.environments import make_envs


def made_result(groups: int = 20) -> EvaluationResult:
    """Two episodes of four frames of each source group; four policies, one of three seeds."""
    rng = np.random.default_rng(0)
    grid, frames, episodes = ExposureGrid.default(), 4, 2 * groups
    scores = np.repeat(rng.uniform(0.1, 0.9, (episodes, 1, 64)), frames, axis=1)
    best = scores[:, 0].argmax(-1)

    def track(states: np.ndarray, privileged: bool = False) -> Track:
        names = ("image_mean", "code_mean", "clipped_high", "clipped_low")
        arrays = {name: np.full(states.shape, 0.25 * (name == "clipped_high")) for name in names}
        return Track({"states": states, **arrays}, 0.5, 1.0, privileged)

    oracle = np.broadcast_to(best[None, :, None], (1, episodes, frames))
    tracks = {
        "oracle": track(oracle, privileged=True),
        "ppo": track(rng.integers(64, size=(3, episodes, frames))),
        "matrix:P": track(rng.integers(64, size=(1, episodes, frames))),
        "spot:P": track(np.where(rng.random(oracle.shape) < 0.5, oracle, 0)),
    }
    pairs = np.arange(episodes) // 2
    hard = pairs % 2 == 0
    ids, groups = (np.array([f"{kind}-{i:02d}" for i in pairs]) for kind in ("scene", "group"))
    kinds, starts = np.where(hard, "snow", "photograph"), np.zeros(episodes, np.int64)
    named = {"scene_ids": ids, "groups": groups, "kinds": kinds, "hard": hard, "tracks": tracks}
    named |= {"scores": scores, "allowed": np.ones(scores.shape, bool)}
    plan = EvaluationPlan(name="made", starts=("random",), seeds=(11,))
    return EvaluationResult(grid, **named, start_states=starts, plan=plan)


def made_brackets(groups: list[str] | None = None, **quality: np.ndarray) -> EvaluationResult:
    """One episode of brackets of each source group, by policy ``(K, G)``; other metrics are 0.5."""
    count = next(iter(quality.values())).shape[1]
    names = np.array(groups or [f"g{i:02d}" for i in range(count)])
    tracks = {}
    for name, own in quality.items():
        arrays = dict.fromkeys(BRACKET_METRICS, np.full(own.shape, 0.5)) | {"quality": own}
        tracks[name] = Track(arrays, 0.5, 1.0, privileged=False)
    empty = {"hard": np.zeros(count, bool), "start_states": np.zeros(count, np.int64)}
    empty |= {"scores": np.zeros((count, 0, 0)), "allowed": np.zeros((count, 0, 0), bool)}
    plan = EvaluationPlan(budgets=(0.1, 0.2), task="bracket", hash="h")
    named = {"scene_ids": names, "groups": names, "kinds": names, "tracks": tracks, "plan": plan}
    return EvaluationResult(grid=ExposureGrid.from_spec("bracket"), **named, **empty)


def test_rows_have_the_values_of_their_episodes():
    result = made_result()
    rows = result_rows(result, source="bundled", split="test", resamples=500)
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
    assert (ranking.to_best[1]["other"], ranking.to_next[2]) == ("spot:P", None)
    assert ranking.to_best[1]["difference"] < 0


def test_scenes_have_means_of_their_episodes():
    result = made_result()
    rows = made.scene_rows(result)
    row = rows.set_index(["policy", "scene_id"]).loc["matrix:P", "scene-03"]
    states = result.tracks["matrix:P"].states[0, 6:8]
    q = [[result.scores[6 + e, t, states[e, t]] for t in range(4)] for e in range(2)]
    assert row.score == pytest.approx(np.mean(q))
    assert row.oracle == pytest.approx(result.scores[6:8].max(-1).mean())
    assert (row.episodes, row.hard, row.kind) == (2, 0, "photograph")
    assert row.final_state == states[0, -1]
    assert row.oracle_state == result.scores[6, -1].argmax()
    assert made.group_rows(result).loc["group-03", "matrix:P"] == pytest.approx(np.mean(q))


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
    seeds = made.training_seed_rows(result).query("condition == 'all'")
    assert seeds.training_run.tolist() == [0, 1, 2]
    assert seeds.normalised_score.mean() == pytest.approx(scores["ppo"])
    histogram = made.oracle_histogram(result)
    assert [len(v) for v in histogram.values()] == [4, 4, 4]
    share = np.mean([result.grid[s].iso == 400 for s in result.oracle_states])
    assert histogram["iso"]["400"] == pytest.approx(share)
    kinds = made.scores_by_kind(result)
    assert {kind: own["groups"] for kind, own in kinds.items()} == {"snow": 10, "photograph": 10}
    assert kinds["snow"]["oracle"] == pytest.approx(1.0)


def test_brackets_by_hand(tmp_path):
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
    # The report has a table for each budget.
    files = write_report(results, tmp_path, command="ae-env x")
    assert set(files) == {p.name for p in tmp_path.iterdir()} == {"results.json", "report.md"}
    text = files["report.md"].read_text()
    assert "-0.050 (-0.050 to -0.050)" in text
    assert "0.000" not in text  # the best is not compared with itself
    content = json.loads(files["results.json"].read_text())
    assert content["meta"]["plan"]["budgets"] == [0.1, 0.2]
    shown = {(r["budget"], r["policy"]): r["quality"] for r in content["rows"]}
    assert (shown[0.1, "low"], shown[0.2, "low"]) == pytest.approx((0.65, 0.75))
    few = dict.fromkeys(results, made_brackets(low=quality[:, :2], high=quality[:, :2] + 0.05))
    files, ranking = write_report(few, tmp_path, command="x"), made.overall_ranking(few)
    assert files["report.md"].read_text().count(" -0.050 |") == 2  # too few for an interval
    own = ae_bench.bench_rows(few, ranking)
    ae_bench.append_rows(tmp_path / "mine.csv", few["0.1 s"].plan, own, author="me")
    page = (tmp_path / "mine.md").read_text().replace(" ", "")
    assert "|low|0.5100|-|" in page
    assert page.count("|500.00|") == 2  # milliseconds of 0.5 s


def test_files_of_a_report(tmp_path):
    names = {"command": "ae-env evaluate --seed 11", "source": "bundled", "split": "test"}
    following = ["ae-env quickstart --scenes my_raws"]
    files = write_report(made_result(), tmp_path / "out", **names, next_commands=following)
    tables, pages = {"results.json", "scenes.csv", "metrics.csv"}, {"report.md", "report.html"}
    assert set(files) == tables | pages | {"scores.png", "ev_error.png"}
    meta = json.loads(files["results.json"].read_text())["meta"]
    assert (meta["command"], meta["best_meter"]) == (names["command"], "spot:P")
    assert [row["policy"] for row in meta["ranking"]] == ["spot:P", "matrix:P", "ppo"]
    assert following[0] in files["report.md"].read_text()
    assert "**spot:P scores best: " in files["report.md"].read_text()
    assert re.search('<a href="#s1">Ranking.*<details open', files["report.html"].read_text(), re.S)
    result = made_result()  # several conditions, no meter, one part
    result = replace(result, hard=np.zeros_like(result.hard), tracks={"ppo": result.tracks["ppo"]})
    files = write_report({"static": result, "sine": result}, tmp_path, command="x")
    results = json.loads(files["results.json"].read_text())
    assert {row["condition"] for row in results["rows"]} == {"all", "sine"}
    assert results["meta"]["best_meter"] is None


def test_labels_are_nearest_to_their_own_points_and_legends_are_whole(monkeypatch):
    figures = []
    monkeypatch.setattr(plots, "write_figure", lambda _, figure: figures.append(figure))
    rng, names = np.random.default_rng(0), [f"centre_weighted:tuned_{i}" for i in range(9)]
    costs = dict(zip(names, 10 ** rng.uniform(-0.5, 0.5, 9), strict=True))
    plots.plot_cost("", costs, dict(zip(names, rng.uniform(0.8, 0.95, 9), strict=True)), names)
    track = made_result().tracks["spot:P"]
    plots.plot_convergence(
        "", {"a": replace(made_result(), tracks=dict.fromkeys(names, track))}, names
    )
    for figure in figures:
        figure.draw_without_rendering()
        legend = figure.legends[0].get_window_extent()
        assert min(*legend.min, *(figure.bbox.size - legend.max)) >= 0
    (axes,) = figures[0].axes
    boxes = np.array([Text.get_window_extent(label).extents for label in axes.texts])[:, None]
    marks = axes.transData.transform(axes.collections[0].get_offsets())
    away = np.maximum(np.maximum(boxes[..., :2] - marks, marks - boxes[..., 2:]), 0)
    assert np.hypot(*away.T).argmin(axis=0).tolist() == [*range(9)]
    apart = (boxes[..., :2] >= boxes[:, 0, 2:]) | (boxes[..., 2:] <= boxes[:, 0, :2])
    assert apart.any(axis=-1).sum() == 9 * 8
    shown = [(label.get_text(), label.get_color()) for label in axes.texts]
    assert shown == [*zip(names, PATH_COLOURS, strict=False)]


def test_a_sheet_is_of_a_photograph_in_steady_light_where_policies_differ(monkeypatch, tmp_path):
    blank, shown = Image.new("RGB", (9, 9)), []
    sheet = lambda scene, path, **_: shown.append((scene, path)) or blank  # noqa: E731
    monkeypatch.setattr("ae_env.rendering.contact_sheet", sheet)
    steady = replace(made_result(4), scenes=range(8))
    moving = {"a": replace(steady, scores=steady.scores * np.linspace(0.5, 1.0, 4)[:, None])}
    apart = np.isin(range(8), [1, 6])[None, :, None] * (np.arange(4) == 3)  # 1 is no photograph
    for k, track in enumerate((tracks := steady.tracks).values()):
        track.arrays["states"] = k * apart
    assert plots.path_sheets(tmp_path, moving, [*tracks]) == {}
    files = plots.path_sheets(tmp_path, moving | {"b": steady}, [*tracks])
    assert [*files] == ["contact_sheet.webp"]
    assert shown == [(6, {name: [0, 0, 0, 0, k] for k, name in enumerate(tracks)})]


def test_names_from_outside_show_no_file(tmp_path):
    """Scenes, policies and folders may be called anything, a picture in Markdown included."""
    hostile = "![x](secret.png)<b>|`$x^$"
    (tmp_path / "secret.png").write_bytes(b"\x89PNG secret")
    result = made_result(4)
    tracks = {hostile: result.tracks["ppo"], "spot:P": result.tracks["spot:P"]}
    groups = np.array([hostile + group for group in result.groups])
    result = replace(result, groups=groups, tracks=tracks)
    names = {"command": hostile, "source": hostile, "next_commands": [hostile]}
    files = write_report(result, tmp_path, **names, split="all")
    page = files["report.html"].read_text()
    assert base64.b64encode(b"\x89PNG secret").decode() not in page
    assert page.count("<img") == page.count('<img src="data:') == 2
    assert not re.search("<b>|<script|http", page)  # it needs no other file
    assert page.count("![x](secret.png)&lt;b&gt;|`$x^$") >= 8
    assert all(f"group-{i:02d}<" in page for i in range(4))  # too few for intervals


def test_the_terminal_shows_scores_or_every_group():
    ((_, frame),) = summary({"static": made_result(), "sine": made_result()})
    assert frame.policy.tolist() == ["spot:P", "matrix:P", "ppo"]
    (_, frame), *groups = summary(made_result(6))
    assert frame["95 % interval (all)"].tolist() == ["too few groups"] * 4
    assert [len(own.columns) for _, own in groups] == [5, 3]  # four of the six groups, then two
    ((_, frame),) = summary({"0.1 s": made_brackets(a=np.full((1, 16), 0.5))})
    assert frame.to_numpy().tolist() == [["a", "0.5000", "0.5000 to 0.5000", "0.5000"]]
    told = {"oracle": replace(made_result().tracks["ppo"], privileged=True)}
    told = replace(made_result(), tracks=told)
    ((_, frame),) = summary({"static": told, "sine": told})
    assert [*frame] == ["tier", "policy", "all conditions", "95 % interval", "static"]


#: Names that mean something to Markdown or HTML.
HOSTILE = [
    *("![x](secret.png)", "[x](http://example.org)", "<script>alert(1)</script>", "a | b"),
    *("**bold** _it_ ~~no~~", "`code` &lt; \\", "line\n\n# heading", "<http://example.org>"),
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


def test_cells_of_a_table_and_a_block_of_code():
    rows = pd.DataFrame({"a": ["x", "y"], "b": [[0.5, 0.25], None], "c": [{"d": 2}, {}], "n": 1e-3})
    columns = {"a": "{a}", "pair": "{b:+.1f}", "d": "{c[d]:.1f} %", "f": lambda r: r["n"] * 2}
    lines = to_markdown(rows, columns).splitlines()
    cells = [[text.strip() for text in line.strip("|").split("|")] for line in lines]
    assert cells[0] == list(columns)
    assert cells[2:] == [["x", "+0.5 to +0.2", "2.0 %", "0.002"], ["y", "-", "-", "0.002"]]
    assert "none" not in to_markdown(rows, {"a": "{a}", "none": "{b[3]}"}, missing="")
    assert to_markdown([], {"a": "{a}", "b": "{b}"}).count("\n") == 1
    page = _rendered(code_block("ae-env --scenes '```'", "<b>\nmore"))
    assert page == "<pre><code>ae-env --scenes '```'\n&lt;b&gt; more\n</code></pre>\n"


def test_a_film_shows_the_episode_of_each_policy(tmp_path):
    options = {"render_mode": "rgb_array", "with_oracle": True, "max_episode_steps": 9}
    envs = make_envs(1, "ae_env/AutoExposureVideo-v0", **options)
    context = PolicyContext.from_envs(envs)
    found = record("oracle", make_policy("oracle", context), envs, 5, 3)
    envs.reset(seed=3)
    assert found.best[0] == envs.unwrapped.grid.ev100[envs.unwrapped.score_table(0).oracle]
    assert [len(v) for v in (found.pictures, found.ev100, found.best, found.scores)] == [6] * 4
    # Settings are in effect two frames after the next: frame 3 has what was best for frame 0.
    assert found.ev100[3] == found.best[0]
    done = []
    meter = make_policy("average:P", context)
    other = record("average:P", SimpleNamespace(reset=meter.reset, act=meter.act), envs, 5, 3)
    assert other.best == found.best  # the same episode
    path = tmp_path / "film.gif"
    write_film(path, [other, found], lambda n, total: done.append((n, total)))
    with Image.open(path) as image:
        assert (image.format, image.n_frames) == ("GIF", 6)
        assert image.size == (2 * PICTURE + GAP, TITLE + PICTURE + CHART)
    assert done == [(n, 6) for n in range(1, 7)]


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
    assert (codes[:, 0, 0] - codes[:, 3, 3] == 20).all()  # two stops in tenths


def test_plans_of_a_suite_have_one_hash_whatever_a_policy_sees(scenes, tmp_path):
    files = [str(tmp_path / f"{task}.yaml") for task in ("still", "bracket")]
    text = "environment: {{scenes: 'bundled:small', split: test, resolution: 36}}\nsuite: {0}\n{1}"
    (tmp_path / "still.yaml").write_text(text.format(files, "frames: 3\n"))
    (tmp_path / "bracket.yaml").write_text(text.format(files, "budgets: [0.1]\n"))
    still, bracket = (load_plan(file) for file in files)
    assert (still.measure, bracket.measure) == ("score", "quality")
    found = ae_bench.bench_hash(still, scenes)
    statistics = still.changed(environment={**still.environment, "observation": "statistics"})
    for other in (bracket, statistics):
        assert found == ae_bench.bench_hash(other, scenes)
    (tmp_path / "bracket.yaml").write_text(text.format(files, "budgets: [0.2]\n"))
    assert found != ae_bench.bench_hash(still, scenes)
    # The published ones are one.
    plans = [load_plan(name) for name in load_plan("ae_bench_v3_still").suite]
    assert {plan.task for plan in plans} == set(ae_bench._TASKS)
    assert len({(plan.suite, plan.max_scenes, plan.hash) for plan in plans}) == 1
    table = Path("docs/ae-bench/v3.csv")
    rows = ae_bench.read_rows(table)
    assert set(rows.hash) == {plans[0].hash}
    assert rows.to_csv(index=False) == table.read_text()
    assert rows[rows.policy == "ppo"].frames_seen.tolist() == 2 * ["500000"]


def test_rows_are_added_and_replaced_and_the_page_written(plan, tmp_path, caplog):
    results = run_plan(plan, tmp_path / "parts")
    ranking = overall_ranking(results, resamples=200)
    found = ae_bench.bench_rows(results, ranking)
    table = tmp_path / "docs" / "ae-bench" / "v3.csv"
    ae_bench.append_rows(table, plan, found, author="first")
    again = found[found.policy == "random"]
    statistics = plan.changed(environment={**plan.environment, "observation": "statistics"})
    ae_bench.append_rows(table, plan, again, author="second")
    ae_bench.append_rows(table, statistics, again, author="first")
    assert "replaced" not in caplog.text
    ae_bench.append_rows(table, plan, again, author="first")
    assert "replaced the row of 'random' by 'first'" in caplog.text
    rows = list(csv.DictReader(table.read_text().splitlines()))
    shown = sorted(f"{row['policy']} {row['observation']} {row['author']}" for row in rows)
    named = ("random statistics first", "random uint8 first", "random uint8 second")
    assert shown == ["matrix:P uint8 first", *named]
    assert tuple(rows[0]) == ae_bench.COLUMNS
    assert float(rows[0]["score"]) == pytest.approx(ranking.normalised_score[0], abs=5e-5)
    assert rows[0]["unseen"] == rows[0]["frames_seen"] == ""  # no brackets, nothing learnt
    page = table.with_suffix(".md").read_text()
    assert page.index("| matrix:P ") < page.index("| random ")
    assert str(tmp_path) not in page
    with pytest.raises(ValueError, match="under the hash"):
        ae_bench.append_rows(table, plan.changed(hash="0"), found, author="x")
    authors = [f"author {i}" for i in range(12)]
    add = lambda author: ae_bench.append_rows(table, plan, again, author=author)  # noqa: E731
    with ThreadPoolExecutor(6) as pool:  # each reads, adds and renames
        list(pool.map(add, authors))
    assert set(authors) < set(ae_bench.read_rows(table).author)
    add("")
    with pytest.raises(ValueError, match="`author`"):  # of who began before that was there
        add("")


def test_columns_have_the_interval_of_their_mean_over_places():
    results = {"static": (result := made_result())}
    row = ae_bench.bench_rows(results, overall_ranking(results)).set_index("policy").loc["spot:P"]
    own = np.take_along_axis(result.scores, result.tracks["spot:P"].states[0][..., None], -1)
    places = (result.scores.max(-1) - own[..., 0]).mean(-1).reshape(20, 2).mean(-1)
    ends = bootstrap((places,), np.mean, method="percentile", rng=1).confidence_interval
    assert row.regret == pytest.approx(places.mean())
    assert (row.regret_low, row.regret_high) == pytest.approx(tuple(ends), abs=0.004)
    assert row[["hard_low", "rest_high"]].isna().all()  # of ten places each


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
    (tmp_path / "notes.md").write_text("mine")
    with pytest.raises(ValueError, match="`append`"):
        check(tmp_path / "new.csv", plan.changed(task=""), ["random"], author="me")
    for file, policies, author, message in (
        (table, ["u/my.py:Mine"], " ", r"`author` .*'my\.py:Mine'"),
        (table, ["u/my.py:Mine", "v/my.py:Mine"], "me", r"`policy` .*'my\.py:Mine'"),
        (table, [], "me", "`append`"),
        *((tmp_path / f"a.{end}", ["random"], "me", "`append` .*CSV") for end in ("md", "txt")),
        (tmp_path / "notes.csv", ["random"], "me", r"`append` .*notes\.md"),
        (_table(tmp_path / "b.csv", plan, hash="0"), ["random"], "me", r"b\.csv .*hash"),
        (_table(tmp_path / "d.csv", plan, score="x"), ["random"], "me", r"d\.csv, line 2: `score`"),
        (broken, ["random"], "me", "broken.csv"),
        (Path("docs/ae-bench/v1.csv"), ["random"], "me", "AE-Bench v1, which"),
        (Path("docs/ae-bench/v2.csv"), ["random"], "me", "AE-Bench v2, which"),
    ):
        with pytest.raises(ValueError, match=message):
            check(file, plan, policies, author=author)


# -- choices of simulated judges, their file, and what is told of them -----------------------------

SOURCE = {"scenes": f"{__name__}:library", "split": "test", "resolution": 36}


def library() -> list[Scene]:
    """Four scenes of two subjects in the same light."""
    drawn = torch.rand(4, 4, 36, 36, generator=torch.Generator().manual_seed(0)) ** 2
    named = [{"scene_id": f"s{i}", "group": f"g{i % 2}", "illuminance": 2560.0} for i in range(4)]
    light = drawn * torch.tensor([0.6, 0.12, 0.02, 0.2])[:, None, None, None]
    of = (CameraSettings(100, 1 / 64, 4), get_camera("nikon_z6"))
    return [Scene.from_array(light[i], *of, **named[i]) for i in range(4)]


@pytest.fixture(scope="module")
def found():
    return judging.judged_scenes(**SOURCE)


@pytest.fixture(scope="module")
def pairs(found):
    return judging.draw_pairs(found, 12, 3, lambda *_: None, **SOURCE)


def test_pairs_are_near_a_best_state_and_contested(pairs):
    ramp = np.arange(9.0)
    found = judging.contested_pairs(np.stack([-abs(ramp - 3), -abs(ramp - 4.2)]))
    assert found == [(2, 5), (3, 4), (3, 5)]  # a stop from 3 and 4, the middle between them
    assert judging.contested_pairs(-ramp[None]) == [(0, 1)]
    assert {*SOURCE, "camera", "seed", "left settings", "balanced:left"} <= {*pairs}
    assert pairs.group.value_counts().tolist() == [6, 6]


def test_judges_of_known_strengths_give_them_back(monkeypatch):
    monkeypatch.setattr(judging, "RESAMPLES", 200)
    truth, covered = np.array([-1.5, -0.2, 0.9, 0.8, 0.0]), []  # of -2 to +2 EV
    ladder = np.array([(8 - stop == judging.STOPS).argmax() for stop in range(-2, 3)])
    for rng in map(np.random.default_rng, range(10)):
        shown = np.array([rng.choice(5, 2, replace=False) for _ in range(600)])
        won = rng.random(600) < 1 / (1 + np.exp(truth[shown[:, 1]] - truth[shown[:, 0]]))
        choices = pd.DataFrame(ladder[shown], columns=["left", "right"]).assign(ev100="8.3")
        choices = choices.assign(choice=np.where(won, "left", "right"), group=np.arange(600) % 40)
        found = pd.DataFrame(judging.exposure_rows(choices))
        assert found.name.tolist() == ["-2 EV", "-1 EV", "+0 EV", "+1 EV", "+2 EV"]
        low, high = np.stack(found.ci95).T
        covered.append((low < truth) & (truth < high) & (high - low < 1.0))
    assert np.mean(covered) > 0.84  # 3.4 sigma below 0.95
    ties = judging.exposure_rows(choices.assign(choice="equal"))
    assert max(abs(row["value"]) for row in ties) < 1e-6  # half a win of each


def test_a_judge_who_follows_a_scorer_agrees_with_it_and_less_with_others(pairs, found, tmp_path):
    scores = pairs.filter(like=":").astype(float)
    gains = {n: scores[f"{n}:left"] - scores[f"{n}:right"] for n in ("balanced", "mid_grey")}
    path = tmp_path / "ann.csv"
    ann = Judging(path, "ann", found, lambda: pairs)
    for i, gain in enumerate(gains["balanced"]):
        ann.choose(i, "equal" if i == 4 else "left" if gain > 0 else "right", 3.0)
    results, tables = write_fit([path], tmp_path, "x")
    told = {row["name"]: row for row in json.loads(results.read_text())["rows"]}
    share = (gains["balanced"] * gains["mid_grey"] > 0).drop(4).mean()
    values = [told[name]["value"] for name in ("balanced", "mid_grey", "sharpness")]
    assert values == pytest.approx([1.0, share, 0.5])  # at rest all states are sharp
    assert 0.0 < share < 1.0
    assert (told["balanced"]["ci95"], told["balanced"]["num_groups"]) == (None, 2)
    assert "12 choices by ann, 1 of them equal" in tables.read_text()


def test_choices_are_undone_and_gone_on_with_and_wrong_files_refused(pairs, found, tmp_path):
    path = tmp_path / "ann.csv"
    ann = Judging(path, "ann", found, lambda: pairs)
    for number, choice in ((0, "left"), (0, "right"), (1, "right"), (2, "equal")):
        ann.choose(number, choice, 1.234)  # one key was pressed twice
    ann.undo()
    again = Judging(path, "ann", found, lambda: pytest.fail("drawn again"))
    pd.testing.assert_frame_equal(again.pairs, ann.pairs)
    pd.testing.assert_frame_equal(again.pairs[[*pairs]], pairs)
    assert again.pairs.choice[:3].tolist() == ["left", "right", ""]
    assert (again.done, again.pairs.seconds[1]) == (2, "1.23")
    other = {**found, "s0": found["s1"], "s1": found["s0"]}
    for judge, scenes in (("bob", found), ("ann", other)):
        with pytest.raises(ValueError, match=r"`out` .* must have pairs of these scenes by"):
            Judging(path, judge, scenes, lambda: pairs)
    with pytest.raises(ValueError, match="each judge's pair once"):
        write_fit([path, path], tmp_path, "")
    text = path.read_text()
    cells = {"left": ("64", ann.pairs.right[2]), "ev100": ("inf",), "balanced:left": ("",)}
    for column, cell in ((name, own) for name, wrong in cells.items() for own in wrong):
        ann.pairs.assign(**{column: ann.pairs[column].where(ann.pairs.index != 2, cell)}).to_csv(
            path
        )
        with pytest.raises(ValueError, match=f"row 4, '{column}' has"):
            write_fit([path], tmp_path, "")
    fewer = ann.pairs.drop(columns=["shin:left", "shin:right"]).assign(judge="bob")
    fewer.to_csv(tmp_path / "bob.csv", index=False)
    path.write_text(text)
    assert "shin:left" in write_fit([path, tmp_path / "bob.csv"], tmp_path, "")[1].read_text()
    for damaged in ("", text.replace("right,1", "up,1"), text.replace("seconds", "s")):
        path.write_text(damaged)
        with pytest.raises(ValueError, match=r"`choices` .*ann\.csv.* must be a whole file of"):
            Judging(path, "ann", found, lambda: pairs)
