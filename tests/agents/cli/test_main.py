import importlib.metadata
import re
import runpy
from pathlib import Path

import pytest
from PIL import Image
from typer.testing import CliRunner

from agents.cli import main as cli

COMMANDS = [
    "bench",
    "cache",
    "evaluate",
    "export",
    "film",
    "quickstart",
    "record",
    "scenes",
    "scorers",
    "simulate",
    "sweep",
    "train",
]
COMMANDS += ["hdr", "refocus", "train-simulator", "score-tables", "view"]
COMMANDS += ["warm-up"]
#: Those that write no folder of results, and those that draw nothing at random.
NO_OUT = ("cache", "scenes", "scorers", "view", "warm-up")
NO_SEED = (*NO_OUT, "export", "hdr")
#: Policies that fail when they are made, when it is their turn, and before.
OWN = """\
from agents import Policy
class Raises(Policy):
    def act(self, observations, action_masks=None):
        raise KeyError("lost")
class Counts(Raises):
    captures_per_decision = "two"
class Unmade(Raises):
    def __init__(self, context):
        raise KeyError("x")
"""
SIMULATE = ("--iso", "800", "--shutter", "1/60", "--aperture", "4")
PLAIN = ("simulate", "IMG_1.dng", *SIMULATE, "--weights", "none")
FILES = {
    "text.dng": "not a raw\n",
    "bad.py": "def (:\n",
    "own.py": OWN,
    "script.py": "import sys\nsys.exit(0)\n",
    "wrong.yaml": "agent: regression\ntraining: {frame: 3}\n",
    "agent.yaml": "agent: ppo\n",
}


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_an_example_and_out(command: str) -> None:
    result = CliRunner().invoke(cli.app, [command, "--help"], terminal_width=200)
    assert result.exit_code == 0
    text = re.sub(r"\x1b\[[0-9;]*m", "", result.output)
    assert re.search(rf"Example: \W?ae-env {command} ", text)
    assert ("--out" in text) == (command not in NO_OUT)
    assert ("--seed" in text) == (command not in NO_SEED)


def test_the_version_is_that_of_the_distribution(ae_env) -> None:
    code, out, _ = ae_env("--version")
    assert (code, out.strip()) == (0, f"ae-env {importlib.metadata.version('ae-env')}")


def test_the_package_runs_as_the_program(ae_env, capsys, monkeypatch) -> None:
    code, out, _ = ae_env("--help")
    assert code == 0
    assert sorted(re.findall(r"^. ([a-z][a-z-]*) ", out, re.MULTILINE)) == sorted(COMMANDS)
    monkeypatch.setattr("sys.argv", ["agents.cli", "--help"])
    with pytest.raises(SystemExit):
        runpy.run_module("agents.cli", run_name="__main__")
    assert capsys.readouterr().out == out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("simulate", "none.dng", *SIMULATE), "`path` (='none.dng') does not exist"),
        (("simulate", "picture.png", *SIMULATE), "must be a camera raw"),
        (("simulate", "IMG_1.dng", *SIMULATE, "--iso", "-3"), "`iso` (=-3.0) must be"),
        (("simulate", "IMG_1.dng", *SIMULATE, "--shutter", "1/0"), "`shutter` (='1/0')"),
        (("simulate", "IMG_1.dng", *SIMULATE, "-o", "a.tif"), "must end in .dng"),
        (("simulate", "IMG_1.dng", *SIMULATE, "-o", "text.dng/a.dng"), "text.dng is a file"),
        (("simulate", "IMG_1.dng", *SIMULATE, "--png", "/proc/x.png"), "`png` (='/proc/x.png')"),
        (("simulate", "IMG_1.dng", *SIMULATE, "-o", "empty.dng"), "a file, but it is a folder"),
        (("simulate", "IMG_1.dng", *SIMULATE, "-o", f"{'x' * 300}.dng"), "File name too long"),
        (("simulate", "IMG_1.dng", *SIMULATE, "--device", "tpu"), "`device` (='tpu') must be auto"),
        (("simulate", "IMG_1.dng", *SIMULATE, "--weights", "none.safetensors"), "no none.json"),
        ((*PLAIN, "--depth", "unknown"), "`depth` (='unknown') needs an aperture"),
        ((*PLAIN, "--depth", "near"), "`depth` (='near') must be one of"),
        (("sweep", "IMG_1.dng", "--out", "text.dng"), "text.dng is a file"),
        (("evaluate", "--policy", "randm"), "did you mean 'random'?"),
        (("evaluate", "--policy", "bad.py:Mine"), "(bad.py, line 1)"),
        (("evaluate", "--policy", "own.py:Unmade"), "Unmade cannot be made: KeyError: 'x'"),
        (("evaluate", "--policy", "script.py:Mine"), "script.py cannot be loaded: SystemExit: 0"),
        (("evaluate", "--policy", "ppo:none"), "there is no none.safetensors"),
        (("evaluate", "--policy", "random", "--scenes", "empty.dng"), "must hold raws"),
        (("evaluate", "--policy", "random", "--split", "tset"), "did you mean 'test'?"),
        (("evaluate", "--policy", "random", "--lighting", "disco"), "`lighting` (='disco')"),
        (("quickstart", "--scenes", "empty.dng"), "must hold raws"),
        (("train", "none.yaml"), "there is no such file"),
        (("train", "wrong.yaml"), "training.frame (=3): unknown, the entries"),
        (("train", "agent.yaml", "--seed", 2**40), "seed (=1099511627776): Input should be"),
        (("train", "agent.yaml", "--out", "/proc/a"), "`out` (='/proc/a.json') cannot be written"),
        (("train-simulator", "agent.yaml"), "agent (='ppo'): unknown"),
        (("bench", "thruput"), "did you mean 'throughput'?"),
    ],
    ids=lambda value: " ".join(map(str, value)) if isinstance(value, tuple) else "",
)
def test_errors_are_one_line(ae_env, dng: Path, arguments, message) -> None:
    folder = dng.parent
    for name, text in FILES.items():
        (folder / name).write_text(text)
    Image.new("RGB", (8, 8)).save(folder / "picture.png")
    (folder / "empty.dng").mkdir()
    if arguments[0] == "evaluate" and "--scenes" not in arguments:
        arguments = (*arguments, "--scenes", "bundled:small")
    before = {path.name for path in folder.iterdir()}
    code, _, error = ae_env(*arguments)
    assert code == 2
    assert error.strip().count("\n") == 0
    assert error.startswith("error ")
    assert message in error
    left = {path.name for path in folder.iterdir()} - before
    assert left <= {"quickstart", "runs", "evaluation", "sweep"}  # at most an empty folder


def test_policies_that_fail(ae_env, tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(OWN)
    small = ["--scenes", "bundled:small", "--resolution", "36", "--frames", "1", "--episodes", "1"]
    for name, status, message in (
        ("Raises", 1, r"own\.py:.*`act` raised KeyError: 'lost'"),
        ("Counts", 2, r"`captures_per_decision` of policy `own\.py:Counts` \(='two'\)"),
    ):
        code, _, error = ae_env("evaluate", "--policy", f"own.py:{name}", *small)
        assert (code, error.count("\n")) == (status, 1)
        assert re.search(message, error)


@pytest.mark.parametrize(
    ("raised", "status", "message"),
    [
        (OSError(28, "No space left on device"), 1, "error [Errno 28] No space left on device\n"),
        (RuntimeError("out of\nmemory"), 1, "error RuntimeError: out of memory; `ae-env --debug`"),
        (FileNotFoundError(2, "No such file", "a.dng"), 2, "No such file: 'a.dng'\n"),
        (KeyboardInterrupt(), 130, "stopped\n"),  # a simulation restarts
    ],
)
def test_failures_while_running(ae_env, dng, monkeypatch, raised, status, message) -> None:
    def fail(*args: object, **kwargs: object) -> None:
        raise raised

    monkeypatch.setattr("simulator.write_dng", fail)
    code, _, error = ae_env("simulate", dng, *SIMULATE, "--weights", "none")
    assert (code, error.strip().count("\n")) == (status, 0)
    assert message in error


def test_usage_errors(ae_env) -> None:
    for arguments in (
        ("simulate", "a.dng"),
        ("simulate", "a.dng", *SIMULATE, "--seed", 2**63),
        ("evaluate", "--policy", "random", "--frames", 0),
        ("nonsense",),
    ):
        code, _, error = ae_env(*arguments)
        assert code == 2
        assert "Usage: ae-env" in error
