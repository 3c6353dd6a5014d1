"""The command line: what it writes, and what it says when the user errs."""

from __future__ import annotations

import csv
import json
import logging
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from ae_env import cli
from agents.weights import sibling
from simulator import CameraSettings, RawImage, get_camera, read_raw, write_dng

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


@pytest.fixture
def ae_env(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path):
    """Runs the command line as the console script does, in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(logging, "basicConfig", lambda **_: None)  # pytest has its own handlers

    def run(*arguments: object) -> tuple[int, str, str]:
        argv = ["ae-env", *map(str, arguments)]
        monkeypatch.setattr("sys.argv", argv)
        with pytest.raises(SystemExit) as caught:
            cli.main()
        output = capsys.readouterr()
        return int(caught.value.code or 0), output.out, output.err

    return run


@pytest.fixture(scope="module")
def raw() -> RawImage:
    rows, columns = np.mgrid[0:100, 0:120]
    light = 0.04 + 0.2 * (rows / 100) + 0.1 * ((rows // 20 + columns // 20) % 2)
    data = np.tile(light.astype(np.float32), (4, 1, 1))
    settings = CameraSettings(iso=400, exposure_time=1 / 64, f_number=5.6)
    return RawImage(data, settings, get_camera("nikon_z6"), white_balance=(2.0, 1.0, 1.5))


@pytest.fixture
def dng(raw: RawImage, tmp_path: Path) -> Path:
    write_dng(tmp_path / "IMG_1.dng", raw)
    return tmp_path / "IMG_1.dng"


def test_every_command_is_there() -> None:
    assert COMMANDS == [
        "bench",
        "cache",
        "evaluate",
        "quickstart",
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
    if command != "cache":
        assert "--out" in text
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
    names = {"results.json", "scenes.csv", "report.md", "scores.png"}
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


SIMULATE = ("--iso", "800", "--shutter", "1/60", "--aperture", "4")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("simulate", "none.dng", *SIMULATE), "`path` (='none.dng') does not exist"),
        (("simulate", "text.dng", *SIMULATE), "must be a whole raw file"),
        (("simulate", "empty", *SIMULATE), "`path` (='empty') is a folder"),
        (("simulate", "picture.png", *SIMULATE), "PNG"),
        (("simulate", "IMG_1.dng", *SIMULATE, "--iso", "-3"), "`iso` (=-3.0) must be"),
        (("simulate", "IMG_1.dng", *SIMULATE, "--shutter", "fast"), "`shutter` (='fast')"),
        (("simulate", "IMG_1.dng", *SIMULATE, "--shutter", "1/0"), "`shutter` (='1/0')"),
        (("simulate", "IMG_1.dng", *SIMULATE, "--shutter=-1"), "`exposure_time` (=-1.0)"),
        (("simulate", "IMG_1.dng", *SIMULATE, "-o", "a.tif"), "must end in .dng"),
        (("simulate", "IMG_1.dng", *SIMULATE, "-o", "text.dng/a.dng"), "text.dng is a file"),
        (("simulate", "IMG_1.dng", *SIMULATE, "--device", "tpu"), "`device` (='tpu') must be auto"),
        (("sweep", "IMG_1.dng", "--out", "text.dng"), "text.dng is a file"),
        (("sweep", "none.dng"), "does not exist"),
        (("evaluate", "--policy", "randm"), "did you mean 'random'?"),
        (("evaluate", "--policy", "bad.py:Mine"), "(bad.py, line 1)"),
        (("evaluate", "--policy", "none.py:Mine"), "there is no file 'none.py'"),
        (("evaluate", "--policy", "ppo:none"), "there is no none.safetensors"),
        (("evaluate", "--policy", "random", "--scenes", "none"), "must name an existing file"),
        (("evaluate", "--policy", "random", "--scenes", "empty"), "must hold raws"),
        (("evaluate", "--policy", "random", "--split", "tset"), "did you mean 'test'?"),
        (("evaluate", "--policy", "random", "--lighting", "disco"), "`lighting` (='disco')"),
        (("evaluate", "--policy", "random", "--out", "text.dng"), "text.dng is a file"),
        (("quickstart", "--out", "text.dng"), "text.dng is a file"),
        (("quickstart", "--scenes", "empty"), "must hold raws"),
        (("train", "none.yaml"), "there is no such file"),
        (("train", "bad.py"), "`config` (='bad.py')"),
        (("train", "wrong.yaml"), "training.frame is unknown"),
        (("bench", "thruput"), "did you mean 'throughput'?"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_errors_are_one_line(ae_env, dng: Path, arguments, message, monkeypatch) -> None:
    folder = dng.parent
    (folder / "text.dng").write_text("not a raw\n")
    (folder / "bad.py").write_text("def (:\n")
    (folder / "empty").mkdir()
    (folder / "wrong.yaml").write_text("agent: regression\ntraining: {frame: 3}\n")
    Image.new("RGB", (8, 8)).save(folder / "picture.png")
    if arguments[0] == "evaluate" and "--scenes" not in arguments:
        arguments = (*arguments, "--scenes", "bundled:small")
    before = {path.name for path in folder.iterdir()}
    code, _, error = ae_env(*arguments)
    assert code == 2
    lines = error.strip().splitlines()
    assert len(lines) == 1, error
    assert lines[0].startswith("error ")
    assert message in lines[0]
    left = {path.name for path in folder.iterdir()} - before
    assert left <= {"quickstart", "runs", "evaluation", "sweep"}  # at most an empty folder


def test_unwritable_folder(ae_env, dng: Path, tmp_path: Path, monkeypatch) -> None:
    def refuse(*args: object, **kwargs: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)  # root may write anywhere
    code, _, error = ae_env("sweep", dng, "--out", "locked")
    assert code == 2
    assert "`out` (='locked') cannot be written: Permission denied" in error


@pytest.mark.parametrize("arguments", [("simulate", "a.dng"), ("evaluate",), ("nonsense",)])
def test_usage_errors(ae_env, arguments: tuple[str, ...]) -> None:
    code, _, error = ae_env(*arguments)
    assert code == 2
    assert "Usage: ae-env" in error


def test_debug_shows_the_traceback(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(logging, "basicConfig", lambda **_: None)
    monkeypatch.setattr("sys.argv", ["ae-env", "--debug", "sweep", "none.dng"])
    with pytest.raises((ValueError, FileNotFoundError)):
        cli.main()


def test_ctrl_c(ae_env, dng: Path, monkeypatch) -> None:
    def interrupted(*args: object, **kwargs: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("simulator.read_raw", interrupted)
    code, _, error = ae_env("sweep", dng)
    assert code == 130
    assert error == "\nstopped\n"  # a sweep begins anew
