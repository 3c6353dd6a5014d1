"""Trainings from YAML files, comparisons of policies, and the main job, on few frames."""

import json
import re
import shlex
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from agents.cli import quickstart
from agents.cli.evaluate import make_plan
from agents.learning.policy_file import load_agent
from simulator import CameraSimulator, RawImage, write_dng
from simulator.networks.weights import load_modules
from simulator.training import scenes as pictures
from simulator.training import trainer
from simulator.training.crops import ReferencePairs
from simulator.utils.files import sibling

BASE = """\
name: mine
environment: {scenes: "bundled:small", split: test, resolution: 36}
max_scenes: 4
conditions:
  static: {}
  step+4: {lighting: {kind: step, stops: 4, at: 2}}
delays: [0, 1]
starts: [dark, bright]
frames: 7
policies: ["matrix:P", random, oracle]
other_scorers: [brightness]
other_scorer_scenes: 2
"""


@pytest.fixture
def preset(tmp_path: Path) -> str:
    (tmp_path / "mine.yaml").write_text(BASE)
    return str(tmp_path / "mine.yaml")


def test_the_plan_of_options_of_a_preset_and_of_an_environment(preset, tmp_path):
    """Plain options mean one condition; others replace what a preset or an environment says."""
    options = {"lighting": "sine", "delay": 2, "episodes": 3, "seed": 5}
    plan = make_plan(None, None, ["random"], options)
    ((name, condition),) = plan.all_conditions.items()
    assert (name, condition.lighting, condition.delay) == ("sine", "sine", 2)
    assert (plan.starts, plan.frames, plan.seeds) == (("random",), 8, (5, 6, 7))
    assert plan.environment == {"scenes": "bundled", "resolution": 64}
    plan = make_plan(preset, None, [], {})
    assert list(plan.all_conditions) == ["static", "step+4", "static/delay1", "step+4/delay1"]
    assert plan.policies == ("matrix:P", "random", "oracle")
    options = {"scorer": "noise", "frames": 3, "lighting": "ramp"}
    changed = make_plan(preset, None, ["random"], options)
    assert changed.environment["scorer"] == "noise"
    assert changed.environment["scenes"] == "bundled:small"
    assert (changed.policies, changed.frames) == (("random",), 3)
    assert list(changed.all_conditions) == ["ramp"]
    (tmp_path / "env.yaml").write_text(
        "scenes: 'bundled:small'\nresolution: 40\nlighting: {kind: tunnel}\ndelay: 1\n"
        "max_episode_steps: 30\n"
    )
    plan = make_plan(None, str(tmp_path / "env.yaml"), ["random"], {"delay": 0})
    assert plan.environment == {"scenes": "bundled:small", "resolution": 40}
    assert {n: c.delay for n, c in plan.all_conditions.items()} == {"tunnel": 0}


def test_broken_files_of_a_folder_are_skipped_when_asked(ae_env, dng, tmp_path, caplog):
    (tmp_path / "env.yaml").write_text("{simulator: null, resolution: 36}")
    (tmp_path / "IMG_2.dng").write_bytes(b"\xff\xd8\xff")
    command = ("evaluate", "--env", tmp_path / "env.yaml", "--scenes", dng.parent)
    command += ("--policy", "random", "--frames", 2, "--workers", 1)
    code, _, error = ae_env(*command)
    assert (code, "damaged; --on-error skip" in error) == (2, True)
    code, _, error = ae_env(*command, "--on-error", "skip")
    assert code == 0, error
    assert "1 of 2 scene files skipped (IMG_2.dng: " in caplog.text


def test_a_preset_end_to_end_and_again(ae_env, tmp_path, preset):
    code, text, _ = ae_env("evaluate", "--preset", preset, "--out", "first")
    assert (code, "over 4 conditions" in text) == (0, True)
    assert text.startswith("evaluation ...\n")  # a line where no bar can be drawn
    folder = tmp_path / "first"
    content = json.loads((folder / "results.json").read_text())
    rows, meta = content["rows"], content["meta"]
    conditions = {row["condition"] for row in rows}
    assert conditions == {"all", "hard", "rest", "step+4", "static/delay1", "step+4/delay1"}
    assert [one["policy"] for one in meta["ranking"]] == ["matrix:P", "random"]
    assert set(meta["other_scorers"]["brightness"]) == {"matrix:P", "random", "oracle"}
    assert meta["plan"]["starts"] == ["dark", "bright"]
    assert len(pd.read_csv(folder / "metrics.csv")) == len(rows)
    text = (folder / "report.md").read_text()
    for title in ("Ranking", "Conditions", "Score against time", "Clipping", "Under other scorers"):
        assert f"## {title}" in text
    page = (folder / "report.html").read_text()
    assert page.count("data:image/") == text.count("![")
    assert ae_env("evaluate", "--preset", preset, "--out", "first")[0] == 0
    # Even times are the same: nothing was run again.
    assert json.loads((folder / "results.json").read_text())["rows"] == rows


def check_files(out: Path) -> dict[str, Any]:
    names = {"scenes.csv", "metrics.csv", "report.md", "report.html", "scores.png", "ev_error.png"}
    names |= {"cost.png", "contact_sheet.webp", "contact_sheet_2.webp"}
    assert {path.name for path in out.iterdir() if path.stat().st_size > 200} >= names
    content = json.loads((out / "results.json").read_text())
    rows = [row for row in content["rows"] if row["condition"] == "all"]
    scores = {row["policy"]: row["normalised_score"] for row in rows}
    assert set(scores) == {*quickstart.BASELINES, "regression", "ppo"}
    assert scores["oracle"] == max(scores.values()) == pytest.approx(1.0)
    return content


@pytest.mark.usefixtures("quick_spawn")
def test_quickstart_on_bundled_scenes_then_on_ones_own(ae_env, raw, tmp_path, monkeypatch):
    few = {"REGRESSION_FRAMES": 128, "PPO_FRAMES": 1024, "EPISODES": 1}
    few |= {"BASELINES": ("random", "best_fixed", "average:P", "matrix:tuned", "oracle")}
    for name, value in few.items():
        monkeypatch.setattr(quickstart, name, value)
    monkeypatch.setattr("agents.metering.metering_policy.FIT_PER_SCENE", 1)
    out = tmp_path / "my out"
    code, text, error = ae_env("quickstart", "--scenes", "bundled:small", "--out", out, "--seed", 1)
    assert (code, error) == (0, "")
    assert check_files(out)["meta"]["zero_shot"] is False
    assert load_agent(out / "agents" / "ppo", "ppo")[1]["training"]["training"]["seed"] == 1
    following = (
        f"ae-env evaluate --policy 'ppo:{out}/agents/ppo' --policy matrix:tuned "
        f"--scenes bundled:small --out '{out}/meters'"
    )
    assert following in text
    assert following in (out / "report.md").read_text()

    # Few raws have no training split; the agents are there already.
    monkeypatch.setattr("agents.learning.workers.ProcessPoolExecutor", None)
    monkeypatch.setattr(
        "agents.rollouts.training_arguments", lambda _: ({"scenes": "bundled:small"}, True)
    )
    mine = tmp_path / "my raws"
    mine.mkdir()
    for i in range(2):
        write_dng(mine / f"IMG_{i}.dng", RawImage(raw.data ** (1 + i), raw.settings, raw.camera))
    options = ("--on-error", "skip", "--seed", 1)
    code, text, _ = ae_env("quickstart", "--scenes", mine, "--out", out, *options)
    assert (code, f"--scenes '{mine}' --on-error skip --out" in text) == (0, True)
    assert f"fewer than 15 source groups in {mine}: agents trained on bundled scenes" in text
    meta = check_files(out)["meta"]
    assert (meta["zero_shot"], meta["trained_on"]) == (True, "bundled:small")
    assert "Every source group" in (out / "report.md").read_text()


TINY = """\
preset: compact
scenes: {procedural: 4, size: 32}
exposure: {steps: 2, batch: 2, crop: 16}
noise: {steps: 2, batch: 2, crop: 16}
aperture: {steps: 2, batch: 2, crop: 16}
"""


def test_train_stop_and_go_on(ae_env, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C in the second stage; the same command finishes, and simulate takes the result.

    Without real files, on a few drawn pictures."""
    (tmp_path / "data").mkdir()
    monkeypatch.setenv("AE_ENV_DATA", str(tmp_path / "data"))
    monkeypatch.setattr(pictures, "_DRAWN", {"train": 2, "validation": 1})
    monkeypatch.setattr(trainer, "_VALIDATION_SCENES", 2)
    monkeypatch.setattr(trainer, "_CROPS", 8)
    (tmp_path / "tiny.yaml").write_text(TINY)
    real, stops = ReferencePairs.batch, iter([True])

    def batch(self, *arguments, **options):
        if next(stops, False):
            raise KeyboardInterrupt
        return real(self, *arguments, **options)

    monkeypatch.setattr(ReferencePairs, "batch", batch)
    arguments = ("train-simulator", "tiny.yaml", "--device", "cpu")
    code, _, error = ae_env(*arguments)
    assert (code, error) == (130, "\nstopped; run the same command again to continue\n")
    code, text, error = ae_env(*arguments)
    assert (code, error) == (0, "")
    weights = Path("runs/simulator/tiny/compact.safetensors")
    assert f"wrote model card: {weights.with_suffix('.json')}" in text
    assert f"next: ae-env simulate RAW --weights {weights} ..." in text
    assert list(weights.parent.glob("tensorboard/**/events.out*"))
    _, card = load_modules(weights)
    assert card["command"] == "ae-env train-simulator tiny.yaml --device cpu"
    steps = {name: stage["steps"] for name, stage in card["stages"].items()}
    assert steps == {"noise": 2, "exposure": 2, "aperture": 2}
    assert {"leaves": 2, "chart": 2, "smooth": 2, "depth": 3}.items() <= card["scenes"].items()
    assert isinstance(CameraSimulator.from_pretrained(weights), CameraSimulator)


def test_train_then_evaluate(ae_env, tmp_path: Path) -> None:
    (tmp_path / "tiny.yaml").write_text(
        "agent: regression\nnum_envs: 4\nenvironment: {scenes: 'bundled:small', resolution: 36}\n"
        "training: {frames: 24, width: 8}\n"
    )
    out = Path("runs/a-0.5")
    code, text, _ = ae_env("train", "tiny.yaml", "--out", out, "--seed", 2)
    assert code == 0
    (following,) = re.findall("next: ae-env (.*)", text)
    card = json.loads(sibling(tmp_path / out, ".json").read_text())
    assert card["training"]["training"]["seed"] == 2
    few = ("--scenes", "bundled:small", "--frames", 2, "--episodes", 1)
    code, text, _ = ae_env(*shlex.split(following), *few)
    assert code == 0
    assert f"regression:{out}" in text
    # A forecaster is evaluated on video.
    (tmp_path / "tiny.yaml").write_text(
        "agent: forecaster\ntraining: {steps: 2, width: 4, batch_size: 2, traces: 5}\n"
    )
    _, text, _ = ae_env("train", "tiny.yaml", "--out", "a")
    assert "next: ae-env evaluate --preset video --policy 'regression:video?foresight=a'" in text
