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
from agents.report.judging import GRID, STOPS, Judging, draw_pairs, write_fit
from simulator import CameraSettings, get_camera

CAMERA, SETTINGS = get_camera("nikon_z6"), CameraSettings(100, 1 / 64, 4)
SOURCE = {"scenes": f"{__name__}:library", "split": "test", "resolution": 36}


def library() -> list[Scene]:
    """Four scenes of two subjects: tiles of four levels in the same light."""
    scenes = []
    for i, level in enumerate((0.6, 0.12, 0.02, 0.2)):
        tiles = torch.rand(1, 6, 6, generator=torch.Generator().manual_seed(i))
        light = (level * tiles**2).repeat_interleave(6, 1).repeat_interleave(6, 2).expand(4, -1, -1)
        named = {"scene_id": f"s{i}", "group": f"g{i % 2}", "illuminance": 2560.0}
        scenes.append(Scene.from_array(light, SETTINGS, CAMERA, **named))
    return scenes


@pytest.fixture(scope="module")
def pairs():
    return draw_pairs(judging.judged_scenes(**SOURCE), 12, 3, lambda *_: None, **SOURCE)


def test_pairs_are_near_a_best_state_and_contested():
    ramp = np.arange(9.0)
    near = [(i, j) for i in range(2, 6) for j in range(i + 1, 6)]  # of the best, at 3 and at 4
    found = judging.contested_pairs(np.stack([-abs(ramp - 3), -abs(ramp - 4.2)]))
    assert found == [pair for pair in near if 3 < sum(pair) / 2 < 4.2]
    assert judging.contested_pairs(-ramp[None]) == [(0, 1)]


def test_a_judge_of_known_strengths_gives_them_back():
    rng, truth = np.random.default_rng(5), np.array([-1.5, -0.2, 0.9, 0.8, 0.0])  # -2 to +2 EV
    ladder, rows = [int((8 - stop == STOPS).argmax()) for stop in range(-2, 3)], []
    for i in range(600):
        a, b = rng.choice(5, 2, replace=False)
        choice = "left" if rng.random() < 1 / (1 + np.exp(truth[b] - truth[a])) else "right"
        rows.append((ladder[a], ladder[b], choice, f"g{i % 40}"))
    choices = pd.DataFrame(rows, columns=["left", "right", "choice", "group"])
    found = judging.exposure_rows(choices, np.full(600, 8.3))
    assert [row["name"] for row in found] == ["-2 EV", "-1 EV", "+0 EV", "+1 EV", "+2 EV"]
    for row, strength in zip(found, truth, strict=True):
        assert row["ci95"][0] < strength < row["ci95"][1] < row["ci95"][0] + 1.0
    ties = judging.exposure_rows(choices.assign(choice="equal"), np.full(600, 8.3))
    assert max(abs(row["value"]) for row in ties) < 1e-6  # half a win of each


def test_a_judge_who_follows_a_scorer_agrees_with_it_and_less_with_others(pairs, tmp_path):
    gains = {}
    for name in ("balanced", "mid_grey"):
        tables = ScoreTables(GRID, CAMERA, make_scorer(name))
        means = {scene.scene_id: tables.table(scene).mean for scene in library()}
        of_pairs = [means[p["scene_id"]][[p["left"], p["right"]]] for p in pairs]
        gains[name] = -np.diff(of_pairs)[:, 0]
    ann = Judging(pairs, tmp_path / "ann.csv", "ann")
    for i, gain in enumerate(gains["balanced"]):
        ann.choose(ann.next_pair(), "equal" if i == 4 else "left" if gain > 0 else "right", 3.0)
    results, tables = write_fit([tmp_path / "ann.csv"], tmp_path, "x", lambda *_: None)
    told = json.loads(results.read_text())
    found = {row["name"]: row for row in told["rows"]}
    share = np.delete(gains["balanced"] * gains["mid_grey"] > 0, 4).mean()
    assert 0.0 < share < 1.0
    assert (found["balanced"]["value"], found["mid_grey"]["value"]) == (1.0, pytest.approx(share))
    assert found["sharpness"]["value"] == 0.5  # all states at rest are alike to it
    assert (found["balanced"]["ci95"], found["balanced"]["num_groups"]) == (None, 2)
    assert "12 choices by ann, 1 of them equal" in tables.read_text()
    text = (tmp_path / "ann.csv").read_text()
    (tmp_path / "ann.csv").write_text(text.replace(pairs[0]["content"], "another"))
    with pytest.raises(ValueError, match=r"scene 's.' of `choices` .* as it was judged"):
        write_fit([tmp_path / "ann.csv"], tmp_path, "x", lambda *_: None)


def test_choices_are_undone_and_gone_on_with_and_wrong_files_refused(pairs, tmp_path):
    path = tmp_path / "ann.csv"
    ann = Judging(pairs, path, "ann")
    first = ann.next_pair()
    for _ in range(2):  # a key pressed twice
        ann.choose(first, "left", 1.234)
    for choice in ("right", "equal"):
        ann.choose(ann.next_pair(), choice, 2.0)
    ann.undo()
    again = Judging(pairs, path, "ann")
    assert [(c["choice"], c["seconds"]) for c in again.choices] == [("left", 1.23), ("right", 2.0)]
    assert again.next_pair() == ann.next_pair() != first
    for wrong, judge in ((pairs, "bob"), (pairs[::-1], "ann"), (pairs[:1], "ann")):
        with pytest.raises(ValueError, match=r"`out` .* must have choices of these pairs by"):
            Judging(wrong, path, judge)
    with pytest.raises(ValueError, match="each of them once"):
        write_fit([path, path], tmp_path, "", lambda *_: None)
    text = path.read_text()
    for damaged in ("", text[:-30], text.replace("right,2", "up,2"), text.replace("seconds", "s")):
        path.write_text(damaged)
        with pytest.raises(ValueError, match=r"`choices` .*ann\.csv.* must be a whole file of"):
            Judging(pairs, path, "ann")
