"""The main job on few frames: every file is there, and nothing is done twice."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from agents.cli import quickstart
from agents.cli.quickstart import BASELINES, next_commands, run_quickstart
from agents.learning.weights import load_agent
from simulator import RawImage, write_dng

FILES = {"results.json", "scenes.csv", "metrics.csv", "report.md", "report.html", "scores.png"}
FILES |= {"ev_error.png", "cost.png", "contact_sheet.webp", "contact_sheet_2.webp"}


class Bars:
    def __init__(self) -> None:
        self.last: dict[str, tuple[int, int]] = {}
        self.notes: list[str] = []

    @contextmanager
    def __call__(self, title: str) -> Iterator[Any]:
        def move(done: int, total: int, note: str = "") -> None:
            self.last[title] = (done, total)
            self.notes.append(note)

        yield move


def check_files(done: quickstart.QuickstartResult, out: Path) -> dict[str, Any]:
    assert done.files == {name: out / name for name in FILES}
    assert all(file.stat().st_size > 200 for file in done.files.values())
    with Image.open(out / "contact_sheet.webp") as picture:
        assert min(picture.size) > 300
    content = json.loads((out / "results.json").read_text())
    rows = [row for row in content["rows"] if row["condition"] == "all"]
    scores = {row["policy"]: row["normalised_score"] for row in rows}
    assert set(scores) == {*BASELINES, "regression", "ppo"}
    assert scores["oracle"] == max(scores.values()) == pytest.approx(1.0)
    return content


@pytest.mark.usefixtures("quick_spawn")
def test_bundled_scenes_then_raws_of_ones_own(raw: RawImage, tmp_path: Path, monkeypatch) -> None:
    for name, value in (("REGRESSION_FRAMES", 128), ("PPO_FRAMES", 1024), ("EPISODES", 1)):
        monkeypatch.setattr(quickstart, name, value)
    monkeypatch.setattr("agents.metering.metering_policy.FIT_PER_SCENE", 1)
    out, bars = tmp_path / "quickstart", Bars()
    done = run_quickstart("bundled:small", out, seed=1, progress=bars, command="ae-env quickstart")
    content = check_files(done, out)
    assert not done.zero_shot
    assert content["meta"]["command"] == "ae-env quickstart"
    assert {row["split"] for row in content["rows"]} == {"test"}
    assert len(bars.last) == 5
    assert all(done == total for done, total in bars.last.values()), bars.last
    assert {"mse", "reward"} <= {note.partition(" ")[0] for note in bars.notes}
    assert load_agent(done.agents["ppo"], "ppo")[1]["training"]["training"]["seed"] == 1
    report = (out / "report.md").read_text()
    assert all(line in report for line in next_commands("bundled:small", out, done.agents))

    # Few raws have no training split; the agents are there already.
    monkeypatch.setattr("agents.learning.workers.ProcessPoolExecutor", None)
    monkeypatch.setattr(
        "agents.rollouts.training_arguments", lambda _: ({"scenes": "bundled:small"}, True)
    )
    mine = tmp_path / "my raws"
    mine.mkdir()
    for i in range(3):
        other = raw.data.roll(9 * i, dims=2) ** (1 + i / 2)
        write_dng(mine / f"IMG_{i}.dng", RawImage(other, raw.settings, raw.camera))
    done = run_quickstart(str(mine), out, seed=1, progress=Bars(), command="ae-env quickstart")
    content = check_files(done, out)
    assert done.zero_shot
    assert content["meta"]["zero_shot"] is True
    assert content["meta"]["trained_on"] == "bundled:small"
    rows = [row for row in content["rows"] if row["condition"] == "all"]
    assert {(row["num_groups"], row["ci95"]) for row in rows} == {(1, None)}  # they look alike
    assert "Every source group" in (out / "report.md").read_text()


def test_a_seed_beyond_those_of_evaluations_is_refused_at_once(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"`seed` \(=4294967295\) must be"):
        run_quickstart("bundled:small", tmp_path, seed=2**32 - 1, progress=Bars(), command="")


def test_next_commands_are_quoted() -> None:
    agents = {"ppo": Path("my out/agents/ppo"), "regression": Path("my out/agents/regression")}
    lines = next_commands("my raws", Path("my out"), agents, "skip")
    assert lines[0] == (
        "ae-env evaluate --policy 'ppo:my out/agents/ppo' --policy matrix:tuned "
        "--scenes 'my raws' --on-error skip --out 'my out/meters'"
    )
