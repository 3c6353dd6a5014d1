"""Choices of simulated judges, their file, and what is told of them."""

import json

import numpy as np
import pandas as pd
import pytest
import torch

from ae_env.scenes import Scene
from agents.report import judging
from agents.report.judging import Judging, write_fit
from simulator import CameraSettings, get_camera

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
