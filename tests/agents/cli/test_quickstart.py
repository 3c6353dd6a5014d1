"""The main job on few frames: every file is there, and nothing is done twice."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from agents.cli import quickstart
from agents.cli.quickstart import BASELINES, next_commands, run_quickstart
from agents.learning.agent_weights import load_agent
from simulator import CameraSettings, RawImage, get_camera, write_dng

FILES = {"results.json", "scenes.csv", "metrics.csv", "report.md", "report.html", "scores.png"}
FILES |= {"ev_error.png", "cost.png", "contact_sheet.png", "contact_sheet_2.png"}


class Bars:
    """Progress bars that remember how far they were moved."""

    def __init__(self) -> None:
        self.last: dict[str, tuple[int, int]] = {}
        self.notes: list[str] = []

    @contextmanager
    def __call__(self, title: str) -> Iterator[Any]:
        def move(done: int, total: int, note: str = "") -> None:
            self.last[title] = (done, total)
            self.notes.append(note)

        yield move


@pytest.fixture
def few_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quickstart, "REGRESSION_FRAMES", 256)
    monkeypatch.setattr(quickstart, "PPO_FRAMES", 1024)


def check_files(done: quickstart.QuickstartResult, out: Path) -> dict[str, Any]:
    assert set(done.files) == FILES
    for name in FILES:
        assert done.files[name] == out / name
        assert (out / name).stat().st_size > 200
    with Image.open(out / "contact_sheet.png") as picture:
        assert min(picture.size) > 300
    content = json.loads((out / "results.json").read_text())
    policies = {row["policy"] for row in content["rows"]}
    assert policies == {*BASELINES, "regression", "ppo"}
    scores = {
        r["policy"]: r["normalised_score"] for r in content["rows"] if r["condition"] == "all"
    }
    assert scores["oracle"] == pytest.approx(1.0)
    assert all(score <= 1.0 for score in scores.values())
    return content


@pytest.fixture
def dngs(tmp_path: Path) -> Path:
    """Three raws of different patterns, as a user's folder."""
    folder = tmp_path / "my raws"
    folder.mkdir()
    camera = get_camera("nikon_z6")
    rows, columns = np.mgrid[0:96, 0:112]
    for i, period in enumerate((7, 16, 29)):
        light = 0.05 + 0.1 * i + 0.2 * ((rows // period + columns // (period + 3)) % 2)
        noise = 0.004 * np.random.default_rng(i).standard_normal((4, *light.shape))
        data = (light + noise).astype(np.float32)
        settings = CameraSettings(iso=100 * 4**i, exposure_time=1 / 2 ** (4 + i), f_number=5.6)
        raw = RawImage(data, settings, camera, white_balance=(2.0, 1.0, 1.5))
        write_dng(folder / f"IMG_{i}.dng", raw)
    return folder


@pytest.mark.slow
def test_bundled_scenes_then_raws_of_ones_own(
    few_frames: None, dngs: Path, tmp_path: Path, monkeypatch
) -> None:
    out = tmp_path / "quickstart"
    bars = Bars()
    done = run_quickstart("bundled:small", out, seed=1, progress=bars, command="ae-env quickstart")
    content = check_files(done, out)
    assert not done.zero_shot
    assert content["meta"]["command"] == "ae-env quickstart"
    assert {row["split"] for row in content["rows"]} == {"test"}
    assert len(bars.last) == 5
    assert all(done == total for done, total in bars.last.values()), bars.last
    assert any(note.startswith("mse") for note in bars.notes)
    assert any(note.startswith("reward") for note in bars.notes)
    assert load_agent(done.agents["ppo"], "ppo")[1]["training"]["training"]["seed"] == 1
    report = (out / "report.md").read_text()
    for line in next_commands("bundled:small", out, done.agents):
        assert line in report

    # Few raws have no training split; the agents are there already.
    def trained_again(*args: object) -> None:
        raise AssertionError("trained again")

    monkeypatch.setattr("agents.learning.training.train_agent", trained_again)
    monkeypatch.setattr("agents.learning.training.ProcessPoolExecutor", trained_again)
    monkeypatch.setattr("agents.episodes.training_scenes", lambda _: ("bundled:small", True))
    done = run_quickstart(str(dngs), out, seed=1, progress=Bars(), command="ae-env quickstart")
    content = check_files(done, out)
    assert done.zero_shot
    assert content["meta"]["zero_shot"] is True
    assert content["meta"]["trained_on"] == "bundled:small"
    rows = [row for row in content["rows"] if row["condition"] == "all"]
    assert {row["num_groups"] for row in rows} <= {1, 2, 3}
    assert all(row["ci95"] is None for row in rows)  # too few groups for an interval
    assert "Every source group" in (out / "report.md").read_text()


def test_a_seed_beyond_those_of_evaluations_is_refused_at_once(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"`seed` \(=4294967295\) must be"):
        run_quickstart("bundled:small", tmp_path, seed=2**32 - 1, progress=Bars(), command="")


def test_next_commands_are_quoted() -> None:
    agents = {"ppo": Path("my out/agents/ppo"), "regression": Path("my out/agents/regression")}
    lines = next_commands("my raws", Path("my out"), agents)
    assert lines[0] == (
        "ae-env evaluate --policy 'ppo:my out/agents/ppo' --policy matrix:tuned "
        "--scenes 'my raws' --out 'my out/meters'"
    )
