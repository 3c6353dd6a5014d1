"""Choices of simulated judges, their file, and what is told of them."""

import json

import numpy as np
import pandas as pd
import pytest
import torch

from ae_env.scenes import Scene
from ae_env.scorers import make_scorer
from ae_env.scorers.score_table import ScoreTables
from agents.report import judging
from agents.report.judging import COLUMNS, GRID, STOPS, Judging, draw_pairs, write_fit
from simulator import CameraSettings, get_camera

CAMERA = get_camera("nikon_z6")
SOURCE = {"scenes": f"{__name__}:library", "split": "test", "resolution": 36}


def library() -> list[Scene]:
    """Four scenes of two subjects: bright, grey and dark tiles, whose light is known."""
    scenes = []
    for i, level in enumerate((0.6, 0.12, 0.02, 0.2)):
        tiles = torch.rand(1, 6, 6, generator=torch.Generator().manual_seed(i))
        light = (level * tiles**2).repeat_interleave(6, 1).repeat_interleave(6, 2).expand(4, -1, -1)
        settings, named = (
            CameraSettings(100, 1 / 64, 4),
            {"scene_id": f"s{i}", "group": f"g{i % 2}"},
        )
        scenes.append(Scene.from_array(light, settings, CAMERA, illuminance=2560.0, **named))
    return scenes


def nothing(*_: object) -> None:
    pass


@pytest.fixture(scope="module")
def pairs():
    return draw_pairs(judging.judged_scenes(**SOURCE), 12, 3, nothing, **SOURCE)


def states(pair):
    return [pair["left"], pair["right"]]


def test_pairs_are_near_a_best_state_and_contested():
    ramp = np.arange(9.0)
    scores = np.stack([-abs(ramp - 3), -abs(ramp - 4.2)])  # best at 3 and at 4
    expected = [(2, 3), (2, 4), (2, 5), (3, 4), (3, 5), (4, 5)]
    # their orders differ where the middle of a pair lies between 3 and 4.2
    contested = [pair for pair in expected if 3 < sum(pair) / 2 < 4.2]
    assert judging.contested_pairs(scores) == contested
    assert judging.contested_pairs(scores[:1]) == [(2, 3), (2, 4), (3, 4)]
    assert judging.contested_pairs(-ramp[None]) == [(0, 1)]


def test_a_judge_of_known_strengths_gives_them_back():
    rng, truth = np.random.default_rng(5), np.array([-1.5, -0.2, 0.9, 0.8, 0.0])  # -2 to +2 EV
    ladder = [int(np.flatnonzero(STOPS == 8 - stop)[0]) for stop in range(-2, 3)]
    rows = []
    for i in range(600):
        a, b = rng.choice(5, 2, replace=False)
        won = rng.random() < 1 / (1 + np.exp(truth[b] - truth[a]))
        choice = "equal" if i % 10 == 0 else "left" if won else "right"
        rows.append(
            {"left": ladder[a], "right": ladder[b], "choice": choice, "group": f"g{i % 40}"}
        )
    choices = pd.DataFrame(rows)
    found = judging.exposure_rows(choices[choices.choice != "equal"], np.full(540, 8.3))
    assert [row["name"] for row in found] == ["-2 EV", "-1 EV", "+0 EV", "+1 EV", "+2 EV"]
    assert sum(row["choices"] for row in found) == 2 * 540
    for row, strength in zip(found, truth, strict=True):
        assert row["ci95"][0] < strength < row["ci95"][1]
        assert row["ci95"][1] - row["ci95"][0] < 1.0
    # A tie is half a win: nothing but ties tells no exposure from another.
    ties = judging.exposure_rows(choices.assign(choice="equal"), np.full(600, 8.3))
    assert max(abs(row["value"]) for row in ties) < 1e-6


def test_a_judge_who_follows_a_scorer_agrees_with_it_and_less_with_others(pairs, tmp_path):
    scenes = {scene.scene_id: scene for scene in library()}
    scores = {}
    for name in ("balanced", "mid_grey"):
        tables = ScoreTables(GRID, CAMERA, make_scorer(name))
        means = {key: tables.table(scene).mean for key, scene in scenes.items()}
        scores[name] = np.array([means[p["scene_id"]][states(p)] for p in pairs])
    ann = Judging(pairs, tmp_path / "ann.csv", "ann")
    better = np.where(scores["balanced"][:, 0] > scores["balanced"][:, 1], "left", "right")
    better[4] = "equal"
    for choice in better:
        ann.choose(ann.next_pair(), choice, 3.0)
    judging_json, tables = write_fit([tmp_path / "ann.csv"], tmp_path, "ae-env judge", nothing)
    told = json.loads(judging_json.read_text())
    found = {row["name"]: row for row in told["rows"]}
    same = np.sign(np.diff(scores["balanced"])) == np.sign(np.diff(scores["mid_grey"]))
    assert 0.0 < (share := np.delete(same, 4).mean()) < 1.0
    assert (found["balanced"]["value"], found["mid_grey"]["value"]) == (1.0, pytest.approx(share))
    assert found["sharpness"]["value"] == 0.5  # all states at rest are alike to it
    assert (found["balanced"]["ci95"], found["balanced"]["num_groups"]) == (None, 2)
    assert (told["meta"]["judges"], told["meta"]["equal"]) == (["ann"], 1)
    assert "12 choices by ann, 1 of them equal" in tables.read_text()
    text = (tmp_path / "ann.csv").read_text()
    (tmp_path / "ann.csv").write_text(text.replace(pairs[0]["content"], "another"))
    with pytest.raises(ValueError, match="scene 's.' of `choices` .* as it was judged"):
        write_fit([tmp_path / "ann.csv"], tmp_path, "ae-env judge", nothing)


def test_choices_are_undone_and_gone_on_with_and_wrong_files_refused(pairs, tmp_path):
    path = tmp_path / "ann.csv"
    ann = Judging(pairs, path, "ann")
    first = ann.next_pair()
    for _ in range(2):  # a key pressed twice
        ann.choose(first, "left", 1.234)
    ann.choose(ann.next_pair(), "right", 2.0)
    ann.choose(ann.next_pair(), "equal", 2.0)
    ann.undo()
    again = Judging(pairs, path, "ann")
    assert [(c["pair"], c["choice"], c["seconds"]) for c in again.choices] == [
        *((0, "left", 1.23), (1, "right", 2.0)),
    ]
    assert again.next_pair() == ann.next_pair()
    assert pd.read_csv(path).columns.tolist() == list(COLUMNS)
    for wrong, judge in ((pairs, "bob"), (pairs[::-1], "ann"), (pairs[:1], "ann")):
        with pytest.raises(ValueError, match="`out` .* must have choices of these pairs by"):
            Judging(wrong, path, judge)
    with pytest.raises(ValueError, match="each of them once"):
        write_fit([path, path], tmp_path, "", nothing)
    text = path.read_text()
    for damaged in (
        "",
        text[:-30],
        text.replace("right,2.0", "up,2.0"),
        text.replace("seconds", "s"),
    ):
        path.write_text(damaged)
        with pytest.raises(ValueError, match=r"`choices` .*ann\.csv.* must be a whole file of"):
            Judging(pairs, path, "ann")
