"""The program as a whole: help, errors, exit statuses, and the two commands about itself."""

import importlib
import os
import pkgutil
import re
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher
from PIL import Image

import ae_env
import simulator
from ae_env.scorers import list_scorers
from agents.cli import console
from agents.cli import main as cli
from agents.viewer.viewed_scene import find_scenes
from simulator import RawImage, write_dng
from simulator.capture.decision import DEFAULT_TOLERANCE

COMMANDS = (
    *("bench", "cache", "evaluate", "export", "film", "hdr"),
    *("quickstart", "record", "refocus", "scenes", "score-tables", "scorers", "simulate", "sweep"),
    *("train", "train-simulator", "view", "warm-up"),
)
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
OPEN = ("refocus", "IMG_1.dng", "--aperture", "1.4")
SMALL, FITS = (("--depth", name, "--focal-length", "3") for name in ("small.png", "fits.npy"))
V1 = ("--preset", "ae_bench_v1")
FILES = {
    "text.dng": "not a raw\n",
    "bad.py": "def (:\n",
    "own.py": OWN,
    "script.py": "import sys\nsys.exit(0)\n",
    "agent.yaml": "agent: ppo\n",
}


def test_help_and_usage_errors_load_nothing_heavy() -> None:
    """One fresh interpreter answers them all and says what it has loaded."""
    asked = [["--help"], ["--version"], *([name, "--help"] for name in COMMANDS)]
    wrong = [["nonsense"], ["simulate", "a.dng"], ["sweep", "a.dng", "--nonsense"]]
    wrong += [["evaluate", "--frames", "0"], ["bench", "throughput", "--seed", str(2**63)]]
    code = f"""
import importlib.metadata, sys
importlib.metadata.version = None  # a source tree need not be installed
from agents.cli.main import main
for arguments in {asked + wrong}:
    sys.argv = ["ae-env", *arguments]
    try:
        main()
    except SystemExit as stop:
        print("status", stop.code or 0)
print("loaded", *sys.modules)
"""
    env = os.environ | {"COLUMNS": "200"}
    command = [sys.executable, "-c", code]
    run = subprocess.run(command, env=env, capture_output=True, text=True, check=True)
    statuses = re.findall(r"^status (\d)$", run.stdout, re.MULTILINE)
    assert statuses == ["0"] * len(asked) + ["2"] * len(wrong)
    assert run.stderr.count("Usage: ae-env") == len(wrong)
    listed, _, *helps = run.stdout.split("status 0\n")
    assert sorted(re.findall(r"^. ([a-z][a-z-]*) ", listed, re.MULTILINE)) == list(COMMANDS)
    assert f"ae-env {simulator.__version__}\n" in run.stdout
    for name, text in zip(COMMANDS, helps, strict=False):
        assert re.search(rf"Example: \W?ae-env {name} ", text)
        assert ("--out" in text) == (name not in NO_OUT)
        assert ("--seed" in text) == (name not in NO_SEED)
    loaded = run.stdout.rpartition("\nloaded ")[2].split()
    heavy = {"torch", "numba", "gymnasium", "numpy", "pandas", "matplotlib", "scipy", "nicegui"}
    assert not heavy & set(loaded)
    assert console.TOLERANCE == DEFAULT_TOLERANCE  # which help cannot import


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("simulate", "none.dng", *SIMULATE), "`path` (='none.dng') does not exist"),
        (("simulate", "IMG_1.dng", *SIMULATE, "--shutter", "1/0"), "`shutter` (='1/0')"),
        (("simulate", "IMG_1.dng", *SIMULATE, "-o", "a.tif"), "must end in .dng"),
        (("simulate", "IMG_1.dng", *SIMULATE, "--png", "/proc/x.png"), "`png` (='/proc/x.png')"),
        (("simulate", "IMG_1.dng", *SIMULATE, "-o", f"{'x' * 300}.dng"), "File name too long"),
        (("simulate", "IMG_1.dng", *SIMULATE, "--device", "tpu"), "`device` (='tpu') must be auto"),
        ((*PLAIN, "--depth", "unknown"), "`depth` (='unknown') needs networks"),
        ((*PLAIN, "--depth", "near"), "`depth` (='near') must be one of"),
        (("sweep", "IMG_1.dng", "--out", "text.dng"), "text.dng is a file"),
        (("evaluate", "--policy", "bad.py:Mine"), "(bad.py, line 1)"),
        (("evaluate", "--policy", "own.py:Unmade"), "Unmade cannot be made: KeyError: 'x'"),
        (("evaluate", "--policy", "script.py:Mine"), "script.py cannot be loaded: SystemExit: 0"),
        (("train", "agent.yaml", "--seed", 2**40), "seed (=1099511627776): Input should be"),
        (("train", "agent.yaml", "--out", "/proc/a"), "`out` (='/proc/a.json') cannot be written"),
        (("train-simulator", "agent.yaml"), "agent (='ppo'): unknown"),
        (("bench", "thruput"), "did you mean 'throughput'?"),
        (("bench", "throughput", "--part", "agents"), "`part` (='agents') is for transfer only"),
        (("bench", "transfer", "--part", "table"), "`part` (='table')"),
        (("bench", "throughput", "--against", "."), "`against` (='.') must be a checkout"),
        (("film", "--scene", "nowhere", "--scenes", "bundled:small"), "`scene` (='nowhere')"),
        (("quickstart", "--seed", 2**32 - 1), "`seed` (=4294967295) must be"),
        (("evaluate", "--preset", "standrad"), "did you mean 'standard'"),
        (("evaluate", *V1, "--frames", 3), "is a fixed benchmark: it does not take --frames"),
        (("evaluate", "--preset", "quick", "--append", "x.csv"), "`append` (='x.csv')"),
        (("evaluate", "--policy", "random", "--author", "me"), "give --append too"),
        (("evaluate", *V1, "--append", "none/x.csv"), "there is no folder none"),
        (("evaluate", *V1, "--on-error", "skip"), "give that, too"),
        (("evaluate", "--scenes", "recorded:a", "--on-error", "skip"), "must be 'stop'"),
        (("evaluate", "--scenes", "polyhaven", "--on-error", "skip"), "files of a folder"),
        (("evaluate", *V1, "--append", "."), "must be a file, but it is a folder"),
        (("refocus", "IMG_1.dng", "--aperture", "8"), "`aperture` (=8)"),
        ((*OPEN, "--depth", "small.png", "--png", "small.png"), "`png`"),
        ((*OPEN, "--depth-kind", "disparity"), "`depth-kind`"),
        ((*OPEN, *SMALL, "--focal-length", "-3"), "`focal-length` (=-3"),
        ((*OPEN, *SMALL[:2]), "`focal-length` (=None)"),
        ((*OPEN, *FITS, "--focus", "0.001"), "`focus` (=0.001)"),
        ((*OPEN, *SMALL, "--focus", "far"), "`focus` (='far') must be metres"),
        ((*OPEN, "--focus", "2"), "`focus` (=2) is an option of a known `--depth`"),
        (("refocus", "nameless.dng", *OPEN[2:], *FITS), "`--pixel-pitch`"),
    ],
    ids=lambda value: " ".join(map(str, value)) if isinstance(value, tuple) else "",
)
def test_errors_are_one_line(ae_env, raw: RawImage, dng: Path, arguments, message) -> None:
    folder = dng.parent
    for name, text in FILES.items():
        (folder / name).write_text(text)
    Image.new("L", (8, 8), 9).save(folder / "small.png")
    np.save(folder / "fits.npy", np.ones((100, 120)))
    nameless = replace(raw, camera=replace(raw.camera, make="X", model="Y", pixel_pitch_um=None))
    write_dng(folder / "nameless.dng", nameless)
    if arguments[0] == "evaluate" and not {"--scenes", "--preset"} & {*arguments}:
        arguments = (*arguments, "--scenes", "bundled:small")
    before = {path.name for path in folder.iterdir()}
    code, _, error = ae_env(*arguments)
    assert (code, error[:6], error.strip().count("\n")) == (2, "error ", 0)
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


def test_the_working_folder_does_not_matter(ae_env, tmp_path: Path, monkeypatch) -> None:
    code = """
import sys
from pathlib import Path
from agents.cli import main
main.CHECKOUT = Path("../checkout").resolve()
sys.argv = ["ae-env", "bench", "ptc", "--quick", "--seed", "3", "--out", "here"]
main.main()
"""
    command = [sys.executable, "-c", code]
    ours = "def run(out, *, seed, quick): print('ours', out, seed, quick)"
    for folder, code in (("checkout", ours), ("mine", "raise RuntimeError('not ours')")):
        (tmp_path / folder / "benchmarks").mkdir(parents=True)
        (tmp_path / folder / "benchmarks" / "__init__.py").write_text("")
        (tmp_path / folder / "benchmarks" / "ptc.py").write_text(code)
    env = os.environ | {"PYTHONPATH": str(Path(cli.__file__).parents[2])}
    printed = subprocess.check_output(command, cwd=tmp_path / "mine", env=env, text=True)
    assert printed == "ours here 3 True\n"
    monkeypatch.setattr(cli, "CHECKOUT", tmp_path / "site-packages")  # without them
    code, _, error = ae_env("bench", "throughput")
    assert (code, "pip install -e ." in error) == (2, True)


def test_all_scorers_are_listed(ae_env) -> None:
    code, out, _ = ae_env("scorers")
    assert code == 0
    assert {*list_scorers()} <= {line.split()[0] for line in out.splitlines() if line.strip()}
    assert "Needs extra cv" in out
    assert "AE_ENV_NIMA_AESTHETIC" in out


def test_cache_is_shown_and_cleared(ae_env, tmp_path: Path, monkeypatch) -> None:
    folder = tmp_path / "kept [1]"
    monkeypatch.setenv("AE_ENV_CACHE", str(folder))
    sizes = {f"scenes/bundled-train-64-{i:024d}": 1000 for i in range(2)}
    for name, size in {**sizes, f"denoised/{5:024d}": 123, "denoised/mine": 1}.items():
        path = folder / f"{name}.safetensors"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x" * size)
    for arguments in ((), ("--clear",)):
        _, out, _ = ae_env("cache", *arguments)
        for kind, numbers in {"scenes": ["2", "2,000"], "denoised": ["1", "123"]}.items():
            (line,) = (text for text in out.splitlines() if f" {kind} " in text)
            assert re.findall(r"[\d,]+", line) == numbers
        assert str(folder) in out.replace("\n", "")
    assert [p.name for p in folder.rglob("*.safetensors")] == ["mine.safetensors"]


def test_a_second_ctrl_c_while_workers_end_is_silent() -> None:
    code = "import atexit, os, signal, sys; from agents.cli import main as cli\n"
    code += "cli.app = lambda **_: sys.exit(130)\n"
    code += "atexit.register(os.kill, os.getpid(), signal.SIGINT); cli.main()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "\nstopped\n")


def _warm_up_and_use(folder: Path) -> list[str]:
    """Kernels that commands do not find ready on disk after the warm-up."""
    modules = [
        importlib.import_module(found.name)
        for package in (ae_env, simulator)
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
    ]
    kernels = {k for module in modules for k in vars(module).values() if isinstance(k, Dispatcher)}

    def used(kernel: Dispatcher) -> set[Dispatcher]:
        code, names = kernel.py_func, kernel.py_func.__code__.co_names
        called = (code.__globals__.get(name) for name in names)
        return {kernel}.union(*(used(each) for each in called if isinstance(each, Dispatcher)))

    make_vec, small = gym.make_vec, {"scenes": "bundled:small", "resolution": 36}
    gym.make_vec = lambda name, **arguments: make_vec(name, **{**arguments, **small})
    os.chdir(folder)
    os.environ["AE_ENV_CACHE"] = "cache"
    cli.app(["warm-up"], standalone_mode=False)
    types = {kernel: kernel.signatures for kernel in kernels}
    warm = set().union(*(used(kernel) for kernel, own in types.items() if own))
    for words in (
        "simulate IMG_1.dng --iso 800 --shutter 1/30 --aperture 2.8 --depth unknown -o out.dng",
        "refocus out.dng --aperture 1.4 -o open.dng --weights compact",
        "sweep IMG_1.dng --out sweep",
    ):
        cli.app(words.split(), standalone_mode=False)
    ready = {k for k in warm if k.stats.cache_path and k.signatures == types[k]}
    return [kernel.py_func.__name__ for kernel in kernels - ready]


def _draw(folder: Path) -> None:
    os.environ["AE_ENV_CACHE"] = str(folder / "cache")
    find_scenes("bundled:small")


@pytest.mark.slow
def test_nothing_is_compiled_or_drawn_afterwards(dng: Path, forkserver: Any) -> None:
    """Commands use the kernels of the warm-up, at its types, all of which are kept on disk.

    So the kernels may come from the cache of all tests: none has to be compiled for this."""
    drawn = []
    for run in (_warm_up_and_use, _draw):
        with ProcessPoolExecutor(1, mp_context=forkserver) as pool:
            assert not pool.submit(run, dng.parent).result()
        drawn.append({path: path.stat().st_ino for path in dng.parent.glob("cache/scenes/*")})
    assert drawn[0] == drawn[1] != {}
