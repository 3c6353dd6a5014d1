"""The command line: what it writes."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from agents.cli import main as cli
from agents.learning.agent_weights import sibling
from simulator import CameraSettings, RawImage, read_raw

COMMANDS = sorted(c.callback.__name__.replace("_", "-") for c in cli.app.registered_commands)
#: The design's columns of an evaluation, in their order.
COLUMNS = [
    "policy",
    "condition",
    "source",
    "split",
    "num_groups",
    "seed",
    "mean_score",
    "normalised_score",
    "regret",
    "ci95",
    "ev_error_median",
    "ev_error_p95",
    "ev_within_third",
    "frames_to_converge",
    "overshoot",
    "reversals",
    "flicker",
    "clipped_high",
    "clipped_low",
    "captures_per_decision",
    "ms_per_decision",
]


def test_every_command_is_there() -> None:
    assert COMMANDS == [
        "bench",
        "cache",
        "convert-nima",
        "evaluate",
        "quickstart",
        "scorers",
        "simulate",
        "sweep",
        "train",
        "train-simulator",
    ]


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_an_example_and_out(command: str) -> None:
    result = CliRunner().invoke(cli.app, [command, "--help"], terminal_width=200)
    assert result.exit_code == 0
    text = re.sub(r"\x1b\[[0-9;]*m", "", result.output)
    assert re.search(rf"Example: \W?ae-env {command} ", text)
    if command not in ("cache", "scorers"):
        assert "--out" in text
    if command not in ("cache", "scorers", "convert-nima"):
        assert "--seed" in text


def test_help_of_the_program(ae_env) -> None:
    code, out, _ = ae_env("--help")
    assert code == 0
    assert all(command in out for command in COMMANDS)


def test_simulate(ae_env, raw: RawImage, dng: Path, tmp_path: Path) -> None:
    out = tmp_path / "new folder" / "out [1].dng"
    arguments = ("--iso", 1600, "--shutter", "1/250", "--aperture", 8, "--seed", 3)
    code, text, _ = ae_env("simulate", dng, *arguments, "-o", out, "--png", tmp_path / "a.png")
    assert code == 0
    assert f"wrote DNG: {out}" in text
    assert "nikon_z6" in text
    back = read_raw(out)
    assert back.settings == CameraSettings(1600, 1 / 250, 8)
    assert back.data.shape == raw.data.shape
    # Light goes with ISO * time / N^2 (marked f-numbers are rounded: 5.6 stands for 4 sqrt 2).
    ratio = (1600 / 400) * (64 / 250) * (32 / 64)
    means = back.data.mean(dim=(1, 2)) / raw.data.mean(dim=(1, 2))
    np.testing.assert_allclose(means.numpy(), ratio, rtol=0.01)
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.size == (240, 200)
    first = out.read_bytes()
    ae_env("simulate", dng, *arguments, "-o", out)
    assert read_raw(out).data.equal(back.data)
    assert len(first) == len(out.read_bytes())
    ae_env("simulate", dng, *arguments[:-1], 4, "-o", out)
    assert not read_raw(out).data.equal(back.data)


def test_sweep(ae_env, dng: Path, tmp_path: Path) -> None:
    code, text, _ = ae_env("sweep", dng, "--out", tmp_path / "sweep", "--dngs")
    assert code == 0
    assert "contact sheet" in text
    with Image.open(tmp_path / "sweep" / "contact_sheet.png") as sheet:
        assert min(sheet.size) > 300
    files = sorted((tmp_path / "sweep").glob("*.dng"))
    assert [path.name for path in files] == [f"IMG_1-{i:02d}.dng" for i in range(64)]
    assert read_raw(files[0]).settings == CameraSettings(100, 1 / 1000, 4)
    assert read_raw(files[63]).settings == CameraSettings(6400, 1 / 2, 11)


def test_cache_is_shown_and_cleared(ae_env, tmp_path: Path, monkeypatch) -> None:
    folder = tmp_path / "kept [1]"
    monkeypatch.setenv("AE_ENV_CACHE", str(folder))
    (folder / "scenes").mkdir(parents=True)
    for i in range(2):
        (folder / "scenes" / f"bundled-train-64-{i:024d}.safetensors").write_bytes(b"x" * 1000)
    (folder / "denoised").mkdir()
    (folder / "denoised" / f"{5:024d}.safetensors").write_bytes(b"x" * 123)
    (folder / "denoised" / "mine.safetensors").write_bytes(b"x")
    expected = {"scenes": ["2", "2,000"], "denoised": ["1", "123"], "score tables": ["0", "0"]}
    for arguments in ((), ("--clear",)):
        code, out, _ = ae_env("cache", *arguments)
        assert code == 0
        for kind, numbers in expected.items():
            (line,) = (text for text in out.splitlines() if f" {kind} " in text)
            assert re.findall(r"[\d,]+", line) == numbers
        assert str(folder) in out.replace("\n", "")
    assert [p.name for p in folder.rglob("*.safetensors")] == ["mine.safetensors"]
    code, out, _ = ae_env("cache")
    assert "1 " not in out.replace("kept [1]", "")


def test_evaluate(ae_env, tmp_path: Path) -> None:
    code, text, _ = ae_env(
        *("evaluate", "--policy", "random", "--policy", "centre_weighted:P"),
        *("--scenes", "bundled:small", "--resolution", 36, "--frames", 4, "--out", "result"),
    )
    assert code == 0
    assert "centre_weighted:P" in text
    folder = tmp_path / "result"
    names = {"results.json", "scenes.csv", "metrics.csv", "report.md", "report.html"}
    names |= {"scores.png", "ev_error.png", "cost.png", "contact_sheet.png", "parts"}
    assert {path.name for path in folder.iterdir()} == names
    content = json.loads((folder / "results.json").read_text())
    assert set(content) == {"meta", "rows"}
    assert content["meta"]["command"].startswith("ae-env evaluate --policy random")
    assert {"commit", "seed", "date", "machine", "versions"} <= set(content["meta"])
    for row in content["rows"]:
        assert list(row) == COLUMNS
        assert (row["source"], row["split"]) == ("bundled:small", "test")
    scores = {
        row["policy"]: row["normalised_score"]
        for row in content["rows"]
        if row["condition"] == "all"
    }
    assert scores["random"] < 0.2 < scores["centre_weighted:P"] < 1.0
    with (folder / "scenes.csv").open() as stream:
        assert len(list(csv.reader(stream))) > 10
    assert "centre_weighted:P" in (folder / "report.md").read_text()
    with Image.open(folder / "scores.png") as picture:
        assert min(picture.size) > 100


def test_train_then_evaluate(ae_env, tmp_path: Path) -> None:
    (tmp_path / "tiny.yaml").write_text(
        "agent: regression\nnum_envs: 4\nenvironment: {scenes: 'bundled:small', resolution: 36}\n"
        "training: {frames: 24, width: 8}\n"
    )
    out = Path("runs/a-0.5")
    code, text, _ = ae_env("train", "tiny.yaml", "--out", out, "--seed", 2)
    assert code == 0
    assert f"next: ae-env evaluate --policy regression:{out}" in text
    card = json.loads(sibling(tmp_path / out, ".json").read_text())
    assert card["training"]["training"]["seed"] == 2
    code, _, _ = ae_env(
        *("evaluate", "--policy", f"regression:{out}", "--scenes", "bundled:small"),
        *("--resolution", 36, "--frames", 2, "--episodes", 1),
    )
    assert code == 0
    code, _, error = ae_env(
        "evaluate", "--policy", f"regression:{out}", "--scenes", "bundled:small", "--sensors"
    )
    assert code == 2
    assert "resolution = [4, 36, 36], the environment has [4, 64, 64]" in error
