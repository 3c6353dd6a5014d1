"""train-simulator, and simulate and sweep with its networks."""

from __future__ import annotations

import json
import logging
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch

from agents.cli import main as cli
from agents.cli import simulator_commands
from agents.cli.simulator_commands import training_scenes
from simulator import CameraSettings, CameraSimulator, RawImage, get_camera, read_raw, write_dng
from simulator.networks.weights import build_modules, load_modules, save_modules
from simulator.training.config import SimulatorConfig, StageConfig
from simulator.training.data import ReferencePairs

TINY = """\
preset: compact
scenes: {procedural: 4, size: 32}
exposure: {steps: 2, batch: 2, crop: 16}
noise: {steps: 2, batch: 2, crop: 16}
aperture: {steps: 2, batch: 2, crop: 16}
"""


@pytest.fixture
def ae_env(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path):
    """Runs the command line as the console script does, in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(logging, "basicConfig", lambda **_: None)  # pytest has its own handlers
    monkeypatch.setattr(simulator_commands, "_VALIDATION_SCENES", 2)
    (tmp_path / "tiny.yaml").write_text(TINY)

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["ae-env", *map(str, arguments)])
        with pytest.raises(SystemExit) as caught:
            cli.main()
        output = capsys.readouterr()
        return int(caught.value.code or 0), output.out, output.err

    return run


@pytest.fixture
def dng(tmp_path: Path) -> Path:
    light = np.random.default_rng(0).uniform(0.05, 0.4, (4, 40, 44)).astype(np.float32)
    raw = RawImage(light, CameraSettings(6400, 1 / 64, 8), get_camera("nikon_z6"))
    write_dng(tmp_path / "IMG_1.dng", raw)
    return tmp_path / "IMG_1.dng"


@pytest.fixture(scope="module")
def networks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random weights that do something."""
    torch.manual_seed(0)
    modules = build_modules("compact").requires_grad_(False)
    modules["noise"].network.tail.weight.mul_(5)
    modules["aperture"].network.tail.bias.fill_(1.5)
    path = tmp_path_factory.mktemp("networks") / "net.safetensors"
    save_modules(path, modules, "compact", {})
    return path


# Training


def test_train_stop_and_go_on(ae_env, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C in the second stage; the same command finishes, and simulate takes the result."""
    real, steps = ReferencePairs.batch, []

    def batch(self, step, *arguments, **options):
        steps.append((self.stage, step))
        if steps.count(("noise", 1)) == 1 and steps[-1] == ("noise", 1):
            raise KeyboardInterrupt
        return real(self, step, *arguments, **options)

    monkeypatch.setattr(ReferencePairs, "batch", batch)
    arguments = ("train-simulator", "tiny.yaml", "--device", "cpu")
    code, _, error = ae_env(*arguments)
    assert code == 130
    assert error == "\nstopped; the same command goes on where it was\n"
    before = len(steps)
    code, text, error = ae_env(*arguments)
    assert (code, error) == (0, "")
    trained = [s for s in steps[before:] if s[1] < 2]
    assert trained[:2] == [("exposure", 0), ("exposure", 1)]  # its validation, not its training
    folder = tmp_path / "runs" / "simulator" / "tiny"
    weights = folder / "compact.safetensors"
    relative = weights.relative_to(tmp_path)
    assert f"wrote weights: {relative}" in text
    assert f"wrote model card: {relative.with_suffix('.json')}" in text
    assert f"next: ae-env simulate RAW --weights {relative} ..." in text
    assert list(folder.glob("tensorboard/**/events.out*"))
    _, card = load_modules(weights)
    assert card["command"] == "ae-env train-simulator tiny.yaml --device cpu"
    assert [stage["steps"] for stage in card["stages"].values()] == [2, 2, 2]
    assert isinstance(CameraSimulator.from_pretrained(weights), CameraSimulator)


def test_options_of_a_training(ae_env, tmp_path: Path) -> None:
    (tmp_path / "pc.yaml").write_text(
        "preset: pc\nscenes: {procedural: 2, size: 32}\nbaseline: {steps: 1, batch: 2, crop: 16}\n"
    )
    arguments = ("pc.yaml", "--out", "here", "--seed", 5, "--no-tensorboard", "--device", "cpu")
    code, text, _ = ae_env("train-simulator", *arguments)
    assert code == 0
    assert "next:" not in text  # a baseline simulates nothing
    names = {p.name for p in (tmp_path / "here").iterdir()}
    assert names == {"baseline.checkpoint", "pc.json", "pc.safetensors"}
    assert json.loads((tmp_path / "here" / "pc.json").read_text())["training"]["seed"] == 5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("none.yaml",), "`config` (='none.yaml'): there is no such file"),
        (("bad.yaml",), "noize"),
        (("tiny.yaml", "--device", "tpu"), "`device` (='tpu')"),
        (("tiny.yaml", "--out", "bad.yaml"), "bad.yaml is a file"),
    ],
)
def test_errors_of_a_training(ae_env, tmp_path: Path, arguments, message: str) -> None:
    (tmp_path / "bad.yaml").write_text(TINY + "noize: {steps: 1}\n")
    code, _, error = ae_env("train-simulator", *arguments)
    assert code == 2
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "runs").exists() or not list((tmp_path / "runs").rglob("*.*"))


def config(**scenes: object) -> SimulatorConfig:
    stage = StageConfig(steps=1, crop=16)
    return SimulatorConfig.model_validate(
        {"preset": "pc", "scenes": {"size": 32, **scenes}, "baseline": stage}
    )


def test_scenes_of_a_training(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulator_commands, "_VALIDATION_SCENES", 2)
    splits = {s: training_scenes(config(procedural=4), s) for s in ("train", "validation")}
    groups = {split: {scene.group for scene in scenes} for split, scenes in splits.items()}
    assert not groups["train"] & groups["validation"]
    # Three of four procedural scenes have depth; the fourth is draped over two depths.
    deep = {
        split: Counter(s.kind for s in scenes if s.depth is not None)
        for split, scenes in splits.items()
    }
    assert deep == {"train": {"depth": 3, "draped": 2}, "validation": {"depth": 2}}
    for scenes in splits.values():
        sizes = {s.kind == "draped": s.light.shape for s in scenes}
        assert sizes[False] == (4, 32, 32)
        assert sizes.get(True, (4, 16, 16)) == (4, 16, 16)
        assert all(s.illuminance is not None for s in scenes)


def test_an_unset_folder_of_radiance_maps_is_left_out_and_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.delenv("AE_ENV_DATA", raising=False)
    made = training_scenes(config(procedural=1, radiance="$AE_ENV_DATA"), "train")
    assert "$AE_ENV_DATA is not set: training without radiance maps" in capsys.readouterr().out
    plain = training_scenes(config(procedural=1), "train")
    assert [s.scene_id for s in made] == [s.scene_id for s in plain]


# Simulating with networks


def simulate(ae_env, dng: Path, *options: object, iso: int = 100, aperture: int = 8):
    state = ("--iso", iso, "--shutter", "1", "--aperture", aperture)
    return ae_env("simulate", dng, *state, "-o", "out.dng", "--device", "cpu", *options)


def test_simulate_with_networks(ae_env, dng: Path, networks: Path, tmp_path: Path) -> None:
    code, text, _ = simulate(ae_env, dng, "--weights", networks)
    assert code == 0
    assert re.search(r"runs +exposure -> noise_reduction -> noise", text)
    written = read_raw(tmp_path / "out.dng").data
    simulator = CameraSimulator.from_pretrained(networks, device="cpu")
    expected = simulator.simulate(read_raw(dng), CameraSettings(100, 1, 8), seed=0).data
    torch.testing.assert_close(written, expected, atol=1e-6, rtol=0)


def test_networks_run_once_for_a_raw(
    ae_env, dng: Path, networks: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AE_ENV_CACHE", str(tmp_path / "kept"))
    target = ("--iso", 100, "--shutter", "1/8", "--aperture", 8, "--weights", networks)
    simulate = ("simulate", dng, *target, "--depth", "unknown")
    sweep = ("sweep", dng, "--weights", networks, "--depth", "unknown")
    for command in (simulate, sweep):
        assert ae_env(*command, "--no-cache")[0] == 0
    assert not (tmp_path / "kept" / "denoised").exists()
    assert not (tmp_path / "kept" / "defocus_maps").exists()
    assert ae_env(*simulate, "-o", "first.dng")[0] == 0
    assert ae_env(*sweep, "--out", "first")[0] == 0

    def refuse(*_: object) -> None:
        raise AssertionError("a network ran again")

    monkeypatch.setattr(CameraSimulator, "denoise", refuse)
    monkeypatch.setattr(CameraSimulator, "estimate_defocus", refuse)
    assert ae_env(*simulate, "-o", "second.dng")[0] == 0
    assert ae_env(*sweep, "--out", "second")[0] == 0
    assert Path("first.dng").read_bytes() == Path("second.dng").read_bytes()
    first, second = (Path(f, "contact_sheet.png").read_bytes() for f in ("first", "second"))
    assert first == second


def test_simulate_within_a_tolerance(ae_env, dng: Path, networks: Path, tmp_path: Path) -> None:
    """A target as noisy as the source: denoised only where nothing is to be left in."""
    written = {}
    for tolerance in (0, 0.1):
        options = ("--weights", networks, "--tolerance", tolerance, "--shutter", "1/100")
        code, text, _ = simulate(ae_env, dng, *options, iso=6400)
        assert code == 0
        assert f"(tolerance {tolerance})" in text
        assert ("runs      exposure -> noise_reduction" in text) == (tolerance == 0)
        simulator = CameraSimulator.from_pretrained(networks, device="cpu")
        settings = CameraSettings(6400, 1 / 100, 8)
        expected = simulator.simulate(read_raw(dng), settings, tolerance=tolerance).data
        written[tolerance] = read_raw(tmp_path / "out.dng").data
        torch.testing.assert_close(written[tolerance], expected, atol=1e-6, rtol=0)
    assert not torch.equal(written[0], written[0.1])


@pytest.mark.parametrize("command", ["simulate", "sweep"])
def test_bad_tolerances(ae_env, dng: Path, command: str) -> None:
    target = ("--iso", 100, "--shutter", 1, "--aperture", 8) if command == "simulate" else ()
    code, _, error = ae_env(command, dng, *target, "--tolerance", -1)
    assert code == 2
    assert "`tolerance` (=-1.0) must be a finite number >= 0" in error


def test_simulate_without_networks(ae_env, dng: Path) -> None:
    code, text, _ = simulate(ae_env, dng, "--weights", "none")
    assert code == 0
    assert "left out  noise_reduction: the simulator has no noise module" in text


def test_simulate_with_unknown_depth(ae_env, dng: Path, networks: Path, tmp_path: Path) -> None:
    code, text, _ = simulate(ae_env, dng, "--weights", networks, "--depth", "unknown", aperture=4)
    assert code == 0
    assert re.search(r"runs .*noise_reduction -> aperture", text)
    blurred = read_raw(tmp_path / "out.dng").data
    simulate(ae_env, dng, "--weights", networks, aperture=4)
    sharp = read_raw(tmp_path / "out.dng").data
    assert blurred.diff(dim=-1).abs().mean() < 0.9 * sharp.diff(dim=-1).abs().mean()


def test_sweep_with_networks(ae_env, dng: Path, networks: Path, tmp_path: Path) -> None:
    options = ("--dngs", "--weights", networks, "--depth", "unknown", "--device", "cpu")
    code, _, error = ae_env("sweep", dng, "--out", "sweep", *options)
    assert (code, error) == (0, "")
    assert len(list((tmp_path / "sweep").glob("*.dng"))) == 64


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--weights", "none.safetensors"), "there is no none.json"),
        (("--weights", "none", "--depth", "unknown"), "`depth` (='unknown') needs an aperture"),
        (("--depth", "near", "--weights", "none"), "`depth` (='near') must be one of"),
    ],
)
def test_errors_of_simulate(ae_env, dng: Path, options, message: str, tmp_path: Path) -> None:
    code, _, error = simulate(ae_env, dng, *options)
    assert code == 2
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out.dng").exists()


def test_a_baseline_cannot_simulate(ae_env, dng: Path, tmp_path: Path) -> None:
    save_modules(tmp_path / "pc", build_modules("pc"), "pc", {})
    code, _, error = simulate(ae_env, dng, "--weights", tmp_path / "pc.safetensors")
    assert code == 2
    assert "holds the baseline 'pc'" in error
