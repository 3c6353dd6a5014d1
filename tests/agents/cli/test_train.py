"""Trainings from YAML files: agents, and the networks of the simulator."""

import json
import re
import shlex
from pathlib import Path

import pytest

from simulator import CameraSimulator
from simulator.networks.weights import load_modules
from simulator.training import scenes as pictures
from simulator.training import trainer
from simulator.training.crops import ReferencePairs
from simulator.utils.files import sibling

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
