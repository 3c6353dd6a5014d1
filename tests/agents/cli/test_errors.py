"""The command line when the user errs, or something fails: one line, and an exit status."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
from PIL import Image

from agents.cli import main as cli

UNMADE = """\
from agents import Policy
class Unmade(Policy):
    def __init__(self, context):
        raise KeyError("x")
    def act(self, observations, action_masks=None): ...
"""
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
        (
            ("simulate", "IMG_1.dng", *SIMULATE, "-o", "/proc/x.dng"),
            "`out` (='/proc/x.dng') cannot",
        ),
        (("simulate", "IMG_1.dng", *SIMULATE, "--png", "/proc/x.png"), "`png` (='/proc/x.png')"),
        (
            ("simulate", "IMG_1.dng", *SIMULATE, "-o", "dir.dng"),
            "must be a file, but it is a folder",
        ),
        (("simulate", "IMG_1.dng", *SIMULATE, "-o", f"{'x' * 300}.dng"), "File name too long"),
        (("simulate", "IMG_1.dng", *SIMULATE, "--device", "tpu"), "`device` (='tpu') must be auto"),
        (("sweep", "IMG_1.dng", "--out", "text.dng"), "text.dng is a file"),
        (("sweep", "none.dng"), "does not exist"),
        (("evaluate", "--policy", "randm"), "did you mean 'random'?"),
        (("evaluate", "--policy", "bad.py:Mine"), "(bad.py, line 1)"),
        (("evaluate", "--policy", "none.py:Mine"), "there is no file 'none.py'"),
        (("evaluate", "--policy", "own.py:Mine"), "no class 'Mine' there; found Unmade"),
        (("evaluate", "--policy", "own.py:Unmade"), "Unmade cannot be made: KeyError: 'x'"),
        (
            ("evaluate", "--policy", "imports.py:Mine"),
            "imports.py cannot be loaded: ModuleNotFound",
        ),
        (("evaluate", "--policy", "script.py:Mine"), "script.py cannot be loaded: SystemExit: 0"),
        (("evaluate", "--policy", "empty.py:Mine"), "found no class at all"),
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
        (("train", "empty"), "`config` (='empty'): is a folder"),
        (("train", "blank.yaml"), "`config` (='blank.yaml') is empty"),
        (("train", "twice.yaml"), "the entry 'agent' is given twice, again in line 2"),
        (("train", "agent.yaml", "--seed", 2**40), "`seed` (=1099511627776) must be in"),
        (("train", "agent.yaml", "--out", "/proc/a"), "`out` (='/proc/a.json') cannot be written"),
        (("train-simulator", "blank.yaml"), "`config` (='blank.yaml') is empty"),
        (("train-simulator", "agent.yaml"), "agent (='ppo'): unknown"),
        (("bench", "thruput"), "did you mean 'throughput'?"),
    ],
    ids=lambda value: " ".join(map(str, value)) if isinstance(value, tuple) else "",
)
def test_errors_are_one_line(ae_env, dng: Path, arguments, message, monkeypatch) -> None:
    folder = dng.parent
    (folder / "text.dng").write_text("not a raw\n")
    (folder / "bad.py").write_text("def (:\n")
    (folder / "empty").mkdir()
    (folder / "wrong.yaml").write_text("agent: regression\ntraining: {frame: 3}\n")
    Image.new("RGB", (8, 8)).save(folder / "picture.png")
    (folder / "dir.dng").mkdir()
    (folder / "own.py").write_text(UNMADE)
    (folder / "imports.py").write_text("import a_module_that_is_not_there\n")
    (folder / "script.py").write_text("import sys\nsys.exit(0)\n")
    (folder / "empty.py").write_text("")
    (folder / "blank.yaml").write_text("")
    (folder / "agent.yaml").write_text("agent: ppo\n")
    (folder / "twice.yaml").write_text("agent: ppo\nagent: ppo\n")
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


#: Policies that load, and what they do when it is their turn.
OWN = """\
from agents import Policy
class Raises(Policy):
    def act(self, observations, action_masks=None):
        raise KeyError("lost")
class Rows(Policy):
    def act(self, observations, action_masks=None):
        return [[1], [2, 3]]
class Outside(Policy):
    def act(self, observations, action_masks=None):
        return [64] * len(observations["raw"])
class Unfit(Policy):
    def fit(self, envs, seed=0):
        raise RuntimeError("nothing learnt")
    def act(self, observations, action_masks=None):
        return [0] * len(observations["raw"])
class Resets(Unfit):
    fit = Policy.fit
    def reset(self, num_envs, seed=None):
        raise OSError(28, "No space left on device")
class Counts(Unfit):
    fit = Policy.fit
    captures_per_decision = "two"
"""


@pytest.mark.parametrize(
    ("name", "status", "message"),
    [
        ("Raises", 1, "`act` raised KeyError: 'lost'"),
        ("Rows", 1, "integers, one per camera, not list"),
        ("Outside", 1, "state 64 is not in [0, 64)"),
        ("Unfit", 1, "`fit` raised RuntimeError: nothing learnt"),
        ("Resets", 1, "`reset` raised OSError: [Errno 28]"),
        ("Counts", 2, "`captures_per_decision` of policy `own.py:Counts` (='two')"),
    ],
)
def test_policies_that_fail(ae_env, tmp_path: Path, name: str, status: int, message: str) -> None:
    (tmp_path / "own.py").write_text(OWN)
    arguments = ("--scenes", "bundled:small", "--resolution", 36, "--frames", 1, "--episodes", 1)
    code, _, error = ae_env("evaluate", "--policy", f"own.py:{name}", *arguments)
    assert code == status
    assert error.count("\n") == 1
    assert message in error
    assert "own.py:" in error


def test_a_scorer_that_fails_in_a_training(ae_env, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "failing_scorer.py").write_text(
        "class Mine:\n    domain = 'raw'\n    def __call__(self, *_):\n        return 1 / 0\n"
    )
    (tmp_path / "a.yaml").write_text(
        "agent: regression\nnum_envs: 2\ntraining: {frames: 4}\nenvironment: "
        "{scenes: 'bundled:small', resolution: 36, scorer: 'failing_scorer:Mine'}\n"
    )
    code, _, error = ae_env("train", "a.yaml")
    assert code == 1
    assert error == "error scorer 'Mine' raised ZeroDivisionError: division by zero\n"


@pytest.mark.parametrize(
    ("raised", "status", "message"),
    [
        (OSError(28, "No space left on device"), 1, "error [Errno 28] No space left on device"),
        (RuntimeError("out of\nmemory"), 1, "error RuntimeError: out of memory; `ae-env --debug`"),
        (ImportError("needs: pip install x"), 1, "error needs: pip install x"),
        (FileNotFoundError(2, "No such file", "a.dng"), 2, "No such file: 'a.dng'"),
    ],
)
def test_failures_while_running(ae_env, dng, monkeypatch, raised, status, message) -> None:
    def fail(*args: object, **kwargs: object) -> None:
        raise raised

    monkeypatch.setattr("simulator.write_dng", fail)
    code, _, error = ae_env("simulate", dng, *SIMULATE, "--weights", "none")
    assert code == status
    assert error.count("\n") == 1
    assert message in error


def test_unwritable_folder(ae_env, dng: Path, tmp_path: Path, monkeypatch) -> None:
    def refuse(*args: object, **kwargs: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)  # root may write anywhere
    code, _, error = ae_env("sweep", dng, "--out", "locked")
    assert code == 2
    assert "`out` (='locked') cannot be written: Permission denied" in error


@pytest.mark.parametrize(
    "arguments",
    [
        ("simulate", "a.dng"),
        ("simulate", "a.dng", *SIMULATE, "--iso", "many"),
        ("simulate", "a.dng", *SIMULATE, "--seed", 2**63),
        ("sweep", "a.dng", "--seed", -1),
        ("evaluate",),
        ("evaluate", "--policy", "random", "--frames", 0),
        ("train",),
        ("train-simulator", "a.yaml", "--seed", "x"),
        ("bench",),
        ("cache", "x"),
        ("quickstart", "--sceens", "x"),
        ("nonsense",),
        ("--nope",),
    ],
)
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
