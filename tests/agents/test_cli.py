"""The program: help, errors and exit statuses, raws, trainings, comparisons, and the main job."""

import importlib
import json
import os
import pkgutil
import re
import shlex
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch
from numba.core.dispatcher import Dispatcher
from PIL import Image, ImageOps

import simulator
from ae_env.scorers import list_scorers
from agents.cli import console, quickstart
from agents.cli import main as cli
from agents.cli.evaluate import make_plan
from agents.learning.policy_file import load_agent
from agents.viewer.viewed_scene import find_scenes
from simulator import CameraSettings, CameraSimulator, RawImage, get_camera, read_raw, write_dng
from simulator.capture.limits import DEFAULT_TOLERANCE
from simulator.networks.weights import build_modules, load_modules, save_modules
from simulator.raw.develop import upright_picture
from simulator.training import scenes as pictures
from simulator.training import trainer
from simulator.training.crops import ReferencePairs
from simulator.utils.files import sibling

COMMANDS = (
    *("bench", "cache", "cameras", "evaluate", "export", "film", "hdr", "judge", "latitude"),
    *("lightings", "policies", "quickstart", "record", "refocus", "scenes", "score-tables"),
    *("scorers", "simulate", "stability", "sweep", "train", "train-simulator", "view", "warm-up"),
)
#: Those that write no folder of results, and those that draw nothing at random.
NO_OUT = ("cache", "cameras", "lightings", "policies", "scenes", "scorers", "view", "warm-up")
NO_SEED = (*NO_OUT, "export", "hdr", "latitude")
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
FIXED = ("--preset", "ae_bench_v3_still")
UNKNOWN = ("--policy", "matrx:P", "--scenes", "text.dng")
FILES = {"text.dng": "not a raw\n", "own.py": OWN, "agent.yaml": "agent: ppo\n"}
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


def test_help_and_usage_errors_load_nothing_heavy() -> None:
    """One fresh interpreter answers them all and says what it has loaded."""
    asked = [["--help"], ["--version"], *([name, "--help"] for name in COMMANDS)]
    wrong = [["nonsense"], ["simulate"], ["sweep", "a.dng", "--nonsense"]]
    wrong += [["evaluate", "--frames", "0"], ["bench", "throughput", "--seed", str(2**63)]]
    wrong += [["hdr", "a.dng", "--step", "half"]]
    code = f"""
import importlib.metadata, os, sys
importlib.metadata.version = None  # a source tree need not be installed
from agents.cli.main import main
for arguments in {[*asked, *wrong, []]}:
    if not arguments:
        os.environ.update(_AE_ENV_COMPLETE="complete_bash", COMP_WORDS="ae-env ev", COMP_CWORD="1")
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
    assert statuses == ["0"] * len(asked) + ["2"] * len(wrong) + ["0"]
    assert "\nevaluate\nstatus 0\nloaded " in run.stdout  # completed
    assert run.stderr.count("Usage: ae-env") == len(wrong)
    for said in ("--frames.* '?0", f"--seed.*{2**63}", "--step.*'half'"):
        assert re.search(said, run.stderr)
    listed, _, *helps = run.stdout.split("status 0\n")
    assert sorted(re.findall(r"^. ([a-z][a-z-]*) ", listed, re.MULTILINE)) == list(COMMANDS)
    assert re.search("Start.* view .*Raw files.* hdr .*Scenes.*Maintenance", listed, re.DOTALL)
    assert f"ae-env {simulator.__version__}\n" in run.stdout
    for name, text in zip(COMMANDS, helps, strict=False):
        assert re.search(rf"Example: \W?ae-env {name} ", text)
        assert ("--out" in text) == (name not in NO_OUT)
        assert ("--seed" in text) == (name not in NO_SEED)
    loaded = run.stdout.rpartition("\nloaded ")[2].split()
    for one in ["--help"], ["hdr", "--nonsense"], []:  # alone, these check no values
        alone = code.replace(str([*asked, *wrong, []]), str([one]))
        run = subprocess.run([*command[:2], alone], capture_output=True, text=True, check=True)
        assert "pydantic" not in run.stdout.rpartition("loaded ")[2].split()
    heavy = {"torch", "numba", "gymnasium", "numpy", "pandas", "matplotlib", "scipy", "nicegui"}
    assert not heavy & set(loaded)
    assert console.TOLERANCE == DEFAULT_TOLERANCE  # which help cannot import


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("simulate", "IMG_1.dng", *SIMULATE, "--shutter", "1/0"), "(='1/0') must be a number, s"),
        (("simulate", "IMG_1.dng", *SIMULATE, "--source-aperture", "-2"), "`--source-aperture`"),
        ((*PLAIN, "--depth", "unknown"), "`--depth` (='unknown') needs networks"),
        (("view", "IMG_2.dng"), "r IMG_2.dng: no such file or folder; did you mean 'IMG_1.dng'?"),
        (("score-tables", "x/a.nef"), "error x/a.nef: no such file or folder in "),
        (("latitude", "codes", ":star:"), "error :star:: no such file or folder in "),
        (("film", "--scenes", "x"), "error `--scenes` x: no such file or folder in "),
        (("hdr", "IMG_1.dn"), "error IMG_1.dn: no such file or folder; did you mean"),
        (("evaluate", *UNKNOWN), "Unknown policy 'matrx:P'. Did you mean 'matrix:P'? It must"),
        (("export", "ppo:video"), "error ppo:video must be without a history"),
        (("evaluate", "--policy", "spot:A?f_number=16", *UNKNOWN[2:]), "in the grid's 4 to 11"),
        (("evaluate", "--policy", "own.py:Unmade"), "Unmade cannot be made: KeyError: 'x'"),
        (("evaluate", "--policy", "own.py:Counts"), "`own.py:Counts` (='two')"),
        (("train", "agent.yaml", "--seed", 2**40), "seed (=1099511627776): Input should be"),
        (("train", "agent.yaml", "--out", "/proc/a"), "`--out` (='/proc/a.json') cannot be"),
        (("score-tables", "IMG_1.dng", "--on", "cluster"), "`--on` (='cluster')"),
        (("bench", "thruput"), "Did you mean 'throughput'?"),
        (("stability", "average:tuned"), "average:tuned"),
        (("stability", "proportional:1?dead=1"), "did you mean 'dead_zone'?"),
        (("evaluate", *FIXED, "--frames", 3), "is a fixed benchmark: it does not take --frames"),
        (("evaluate", "--policy", "random", "--author", "me"), "give --append too"),
        (("refocus", "IMG_1.dng", "--aperture", "8"), "`--aperture` (=8)"),
        ((*OPEN, "--depth", "small.png", "--png", "small.png"), "`--png`"),
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


def test_all_mistakes_are_shown_at_once(ae_env, dng: Path) -> None:
    many = "--iso -3 --shutter x --noise bnak --weights bar -o out.jpg"
    code, _, error = ae_env("simulate", "IMG_1.dng", *many.split())
    assert (code, error.count("error `-"), error.count("\n")) == (2, 4, 5)
    assert "error Unknown noise 'bnak'. Did you mean 'bank'?" in error
    code, _, error = ae_env("evaluate", *UNKNOWN, "--lighting", "stpe", "--grid", "vdeo")
    assert (code, error.count("error "), error.count("Did you mean")) == (2, 3, 3)
    code, _, error = ae_env("evaluate", "--delay", -1, "--frames=0", "--seed", "x")
    assert (code, error.count("Invalid value")) == (2, 3)
    for words in ("stability", "spot"), *((c, "--policy", "spot") for c in ("evaluate", "film")):
        code, _, error = ae_env(*words, *words[1:])
        assert (code, "'spot' is given twice" in error) == (2, True)


def test_code_of_the_user_that_fails(ae_env, tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(OWN)
    small = ["--scenes", "bundled:small", "--resolution", "36", "--frames", "1", "--episodes", "1"]
    code, _, error = ae_env("evaluate", "--policy", "own.py:Raises", *small)
    assert (code, error.count("\n")) == (1, 1)
    assert re.search(r"own\.py:.*`act` raised KeyError: 'lost'", error)


@pytest.mark.parametrize(
    ("raised", "status", "message"),
    [
        (OSError(28, "No space left on device"), 1, "error No space left on device\n"),
        (RuntimeError("out of\nmemory"), 1, "error RuntimeError: out of memory; `ae-env --debug`"),
        (KeyboardInterrupt(), 130, "stopped\n"),  # a simulation restarts
    ],
)
def test_failures_while_running(ae_env, dng, monkeypatch, raised, status, message) -> None:
    monkeypatch.setattr("simulator.write_dng", Mock(side_effect=raised))
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


def test_all_scorers_and_other_names_are_listed(ae_env) -> None:
    for command, known in (("policies", "damping"), ("cameras", "nikon_z6"), ("lightings", "ramp")):
        assert known in ae_env(command)[1].replace("=", " ").split()
    code, out, _ = ae_env("scorers")
    assert {*list_scorers()} <= {line.split()[0] for line in out.splitlines() if line.strip()}
    assert (code, "Needs extra cv" in out) == (0, True)


def test_cache_is_shown_and_cleared(ae_env, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("AE_ENV_CACHE", str(folder := tmp_path / "kept [1]"))
    kept = folder / "denoised" / f"{5:024d}.safetensors"
    kept.parent.mkdir(parents=True)
    kept.write_bytes(b"x" * 1230)
    for arguments in ((), ("--clear",)):
        _, out, _ = ae_env("cache", *arguments)
        (line,) = (text for text in out.splitlines() if " denoised " in text)
        assert re.findall(r"[\d,]+", line) == ["1", "1,230"]
        assert str(folder) in out.replace("\n", "")
    assert not kept.exists()


def test_a_second_ctrl_c_while_workers_end_is_silent() -> None:
    code = "import atexit, os, signal, sys; from agents.cli import main as cli\n"
    code += "cli.app = lambda **_: sys.exit(130)\n"
    code += "atexit.register(os.kill, os.getpid(), signal.SIGINT); cli.main()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "\nstopped\n")


def _warm_up_and_use(folder: Path) -> list[str]:
    """Kernels that commands do not find ready on disk after the warm-up."""
    folders = {name: importlib.import_module(name).__path__ for name in ("ae_env", "simulator")}
    found = (pkgutil.walk_packages(path, f"{name}.") for name, path in folders.items())
    modules = [importlib.import_module(one.name) for each in found for one in each]
    kernels = {k for module in modules for k in vars(module).values() if isinstance(k, Dispatcher)}

    def used(kernel: Dispatcher) -> set[Dispatcher]:
        code, names = kernel.py_func, kernel.py_func.__code__.co_names
        called = [code.__globals__.get(name) for name in names]
        called += [getattr(one, name, None) for one in called for name in names]  # of modules
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


def test_nothing_is_compiled_or_drawn_afterwards(dng, forkserver):
    """Commands use the kernels of the warm-up, at its types, all of which are kept on disk.

    So the kernels may come from the cache of all tests: none has to be compiled for this."""
    drawn = []
    for run in (_warm_up_and_use, _draw):
        with ProcessPoolExecutor(1, mp_context=forkserver) as pool:
            assert not pool.submit(run, dng.parent).result()
        drawn.append({path: path.stat().st_ino for path in dng.parent.glob("cache/scenes/*")})
    assert drawn[0] == drawn[1] != {}


def test_a_raw_at_other_settings(ae_env, raw: RawImage, dng: Path, tmp_path: Path) -> None:
    out = tmp_path / "new folder" / "out [1].dng"
    arguments = ("--iso", 1600, "--shutter", "1/250", "--aperture", 8, "--seed", 3)
    code, text, _ = ae_env("simulate", dng, *arguments, "-o", out, "--png", tmp_path / "a.png")
    assert (code, "nikon_z6" in text) == (0, True)
    assert f"wrote DNG: {out}" in text
    back = read_raw(out)
    assert back.settings == CameraSettings(1600, 1 / 250, 8)
    assert back.data.shape == raw.data.shape
    # Light goes with ISO * time / N^2 (marked f-numbers are rounded: 5.6 stands for 4 sqrt 2).
    ratio = (1600 / 400) * (64 / 250) * (32 / 64)
    means = back.data.mean(dim=(1, 2)) / raw.data.mean(dim=(1, 2))
    np.testing.assert_allclose(means.numpy(), ratio, rtol=0.01)
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.size == (240, 200)
    ae_env("simulate", dng, *arguments, "-o", out)
    assert read_raw(out).data.equal(back.data)
    ae_env("simulate", dng, *arguments[:-1], 4, "-o", out)
    assert not read_raw(out).data.equal(back.data)
    before = dng.read_bytes()
    code, _, error = ae_env("simulate", dng, *arguments, "-o", dng)
    assert (code, "`-o`" in error, dng.read_bytes()) == (2, True, before)


@pytest.mark.parametrize(
    ("flip", "orientation"),
    [(1, 2), (2, 4), (3, 3), (4, 5), (5, 8), (6, 6), (7, 7)],  # LibRaw's code and that of EXIF
)
def test_a_picture_is_turned_as_exif_says_and_its_pixels_are_square(flip, orientation) -> None:
    metadata = {"flip": flip, "pixel_aspect": 2.0}
    settings, camera = CameraSettings(100, 1 / 64, 8), get_camera("nikon_z6")
    raw = RawImage(np.zeros((4, 20, 30), np.float32), settings, camera, metadata=metadata)
    bright = np.repeat([255, 0], 20).astype(np.uint8)[:, None]  # the upper half
    wanted = Image.fromarray(bright.repeat(120, axis=1))
    wanted.getexif()[0x0112] = orientation
    found = upright_picture(raw, torch.from_numpy(bright.repeat(60, axis=1)).expand(3, -1, -1))
    assert np.array_equal(np.asarray(found)[..., 0], np.asarray(ImageOps.exif_transpose(wanted)))


def test_settings_of_a_source_that_has_none(ae_env, tmp_path: Path) -> None:
    settings, metadata = CameraSettings(100, 1 / 64, 8), {"flip": 6, "pixel_aspect": 2.0}
    data = np.full((4, 20, 30), 0.25, np.float32)
    raw = RawImage(data, settings, get_camera("nikon_z6"), metadata=metadata)
    write_dng(tmp_path / "a.dng", raw)
    command = ("simulate", tmp_path / "a.dng", "--weights", "none", "--png", "a.png")
    command += ("--iso", 100, "--shutter", "1/64", "--aperture")
    given = ("--source-iso", 400, "--source-shutter", "1/64")
    code, text, _ = ae_env(*command, "f/8", *given, "--source-aperture", 8)
    assert (code, "source ISO 400, 1/64 s, f/8" in text) == (0, True)
    assert read_raw("out.dng").data.mean() == pytest.approx(0.25 / 4, rel=0.02)  # at ISO 400 it was
    with Image.open("a.png") as picture:
        assert picture.size == (40, 120)
    code, text, _ = ae_env(*command[:4], "--source-aperture", "f/4", "--ev", "+1")
    assert (code, "source ISO 100, 1/64 s, f/4" in text) == (0, True)
    assert read_raw("out.dng").settings == CameraSettings(100, 1 / 32, 4)


def test_what_a_raw_hides_is_printed(ae_env, tmp_path: Path) -> None:
    data = np.zeros((4, 40, 40), np.float32)
    data[:, :10] = 1.0
    write_dng(tmp_path / "a.dng", RawImage(data, CameraSettings(100, 1, 8), get_camera("nikon_z6")))
    command = ("simulate", tmp_path / "a.dng", "--weights", "none", "--aperture", 8, "--iso")
    code, text, _ = ae_env(*command, 25600, "--shutter", "1/1024", "-o", tmp_path / "out.dng")
    assert (code, "% of the samples at black, 0.00% at white" in text) == (0, True)
    assert "noise: ISO 25600 is 2.0 stops above the calibration of nikon_z6" in text
    assert "highlights: 25.00% of the source is saturated" in text
    _, text, _ = ae_env(*command, 100, "--shutter", 1, "-o", tmp_path / "out.dng")
    assert "recorded: 75.00% of the samples at black, 25.00% at white\nwrote" in text


def test_all_states_of_a_raw(ae_env, dng: Path, tmp_path: Path) -> None:
    code, text, _ = ae_env("sweep", dng, "--out", tmp_path / "sweep", "--dngs")
    assert (code, "contact sheet" in text) == (0, True)
    with Image.open(tmp_path / "sweep" / "contact_sheet.png") as sheet:
        assert min(sheet.size) > 300
    files = sorted((tmp_path / "sweep").glob("*.dng"))
    assert [path.name for path in files] == [f"IMG_1-{i:02d}.dng" for i in range(64)]
    assert read_raw(files[0]).settings == CameraSettings(100, 1 / 1000, 4)
    assert read_raw(files[63]).settings == CameraSettings(6400, 1 / 2, 11)


def test_networks_run_once_for_a_raw(ae_env, raw, tmp_path, monkeypatch):
    write_dng(dng := tmp_path / "IMG_1.dng", replace(raw, data=raw.data[:, :40, :44]))
    modules = build_modules("compact").requires_grad_(False)
    torch.nn.init.normal_(modules["noise"].network.tail.weight, std=0.02)
    modules["aperture"].network.tail.bias.fill_(1.5)
    save_modules(networks := tmp_path / "net.safetensors", modules, "compact", {})
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path / "kept"))
    options = ("--weights", networks, "--depth", "unknown", "--device", "cpu")
    simulate = ("simulate", dng, "--iso", 100, "--shutter", "1", "--aperture", 8, *options)
    assert ae_env(*simulate, "--no-cache")[0] == 0
    assert not {path.name for path in tmp_path.glob("kept/*")} & {"denoised", "defocus_maps"}
    _, text, _ = ae_env(*simulate, "-o", "first.dng")
    assert "exposure -> noise_reduction (compact) -> noise" in text
    for network in ("denoise", "estimate_defocus"):
        monkeypatch.setattr(CameraSimulator, network, lambda *_: pytest.fail("it ran again"))
    assert ae_env(*simulate, "-o", "second.dng")[0] == 0
    assert Path("first.dng").read_bytes() == Path("second.dng").read_bytes()
    with pytest.raises(pytest.fail.Exception):
        ae_env(*simulate, "--no-cache")


def test_refocus_with_a_depth_map(ae_env, raw: RawImage, dng: Path) -> None:
    depth = np.full(raw.data.shape[-2:], 9.0, np.float32)
    depth[:, :60] = 2.0

    def refocused(source: str | Path, depth: np.ndarray, focus: object, *more: str) -> RawImage:
        np.save("depth.npy", depth)
        given = ("--depth", "depth.npy", "--focal-length", 50, "--focus", focus, *more)
        given = ("--aperture", 1.4, *given, "--weights", "none", "-o", "new/out.dng")
        code, text, error = ae_env("refocus", source, *given)
        assert (code, "depth given" in text) == (0, True), error
        return read_raw("new/out.dng")

    back = refocused(dng, depth, 2.0, "--png", "out.png")
    assert back.settings.f_number == 1.4
    assert not back.data[..., 60:].equal(read_raw(dng).data[..., 60:])
    with Image.open("out.png") as picture:
        assert picture.size == (240, 200)
    assert refocused(dng, depth, "5,5").data.equal(back.data)  # the pixel lies at 2 m
    # The map is upright as the picture.
    depth[40:, :60] = 9.0
    turned = replace(raw, metadata={"flip": 6}), np.rot90(depth, -1)  # a quarter, clockwise
    backs = []
    for held, shown in ((raw, depth), turned):
        write_dng("held.dng", held)
        row, column = np.argwhere(shown == 2.0)[-1]
        backs.append(refocused("held.dng", shown, f"{column},{row}").data)
    assert backs[0].equal(backs[1])


def test_hdr(ae_env, dng: Path, tmp_path: Path) -> None:
    openexr = pytest.importorskip("OpenEXR")
    out, png = tmp_path / "out.exr", tmp_path / "out.png"
    code, text, _ = ae_env("hdr", dng, "-o", out, "--png", png, "--stops", 2, "--weights", "none")
    assert (code, "fused 9 simulated pictures, -2 to +2 EV" in text) == (0, True)
    with openexr.File(str(out)) as file:
        assert file.channels()["RGB"].pixels.shape == (100, 120, 3)
    with Image.open(png) as picture:
        assert picture.size == (240, 200)


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
    assert {"scorer": "noise", "scenes": "bundled:small"}.items() <= changed.environment.items()
    assert (changed.policies, changed.frames) == (("random",), 3)
    assert list(changed.all_conditions) == ["ramp"]
    text = "scenes: 'bundled:small', resolution: 40, lighting: {kind: tunnel}, delay: 1"
    (tmp_path / "env.yaml").write_text(f"{{{text}, max_episode_steps: 30}}")
    plan = make_plan(None, str(tmp_path / "env.yaml"), ["random"], {"delay": 0})
    assert plan.environment == {"scenes": "bundled:small", "resolution": 40}
    assert {n: c.delay for n, c in plan.all_conditions.items()} == {"tunnel": 0}


def test_broken_files_of_a_folder_are_skipped_when_asked(ae_env, dng, tmp_path, caplog):
    (tmp_path / "env.yaml").write_text("{simulator: null, resolution: 36}")
    (tmp_path / "IMG_2.dng").write_bytes(b"\xff\xd8\xff")
    dng.rename(dng.with_stem(os.fsdecode(b"\xff")))
    command = ("evaluate", "--env", tmp_path / "env.yaml", "--scenes", dng.parent)
    command += ("--policy", "random", "--frames", 2, "--workers", 1)
    code, _, error = ae_env(*command)
    assert (code, "is a JPEG, not a raw; --on-error skip" in error) == (2, True)
    code, _, error = ae_env(*command, "--on-error", "skip", "--source-iso", 100)
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


def check_files(out):
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
    few |= {"BASELINES": ("random", "best_fixed", "matrix:tuned", "oracle")}
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
    bundled = ({"scenes": "bundled:small"}, True)
    monkeypatch.setattr("agents.rollouts.training_arguments", lambda _: bundled)
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
    assert (code, f"regression:{out}" in text) == (0, True)
    # A forecaster is evaluated on video.
    text = "agent: forecaster\ntraining: {steps: 2, width: 4, batch_size: 2, traces: 5}\n"
    (tmp_path / "tiny.yaml").write_text(text)
    _, text, _ = ae_env("train", "tiny.yaml", "--out", "a")
    assert "next: ae-env evaluate --preset video --policy 'regression:video?foresight=a'" in text
