"""From a configuration to weights: the stages together, on scenes of 32 x 32 pixels."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from simulator import CameraSettings, CameraSimulator, RawImage, get_camera
from simulator.networks.weights import load_modules
from simulator.reference.reference_camera import ReferenceCamera, ReferenceScene
from simulator.training.config import SimulatorConfig
from simulator.training.data import ReferencePairs, draw_sequences
from simulator.training.train import make_accelerator, train_and_save, train_simulator, validate
from tests.simulator.training.scenes import scene

STAGE = {"steps": 2, "batch": 2, "crop": 16}


def config(preset: str = "compact", **changes: Any) -> SimulatorConfig:
    names = ("exposure", "noise", "aperture") if preset in ("compact", "paper") else ("baseline",)
    values = {"preset": preset, "scenes": {"size": 32}, **dict.fromkeys(names, STAGE), **changes}
    return SimulatorConfig.model_validate(values)


def scenes(config: SimulatorConfig, split: str) -> Sequence[ReferenceScene]:
    first = {"train": 0, "validation": 10}[split]
    return [
        scene(f"{split}-deep", seed=first),
        scene(f"{split}-flat", seed=first + 1, depth=False),
    ]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("trained")
    return train_and_save(config(), scenes, folder / "net", command="ae-env train-simulator x.yaml")


def card_of(file: Path) -> dict[str, Any]:
    return json.loads(file.with_suffix(".json").read_text())


def test_files(trained: Path) -> None:
    assert trained.name == "net.safetensors"
    assert sorted(p.name for p in trained.parent.iterdir()) == [
        "aperture.checkpoint",
        "exposure.checkpoint",
        "net.json",
        "net.safetensors",
        "noise.checkpoint",
    ]


def test_the_card_says_what_was_done(trained: Path) -> None:
    card = card_of(trained)
    assert card["preset"] == "compact"
    assert card["training"] == config().card()
    assert card["command"] == "ae-env train-simulator x.yaml"
    assert card["scenes"] == {"depth": 1, "flat": 1}
    assert {"commit", "date", "machine", "versions", "sha256", "parameters"} <= set(card)
    assert list(card["stages"]) == ["exposure", "noise", "aperture"]
    for stage in card["stages"].values():
        assert stage["steps"] == 2
        assert stage["seconds"] >= 0
        assert stage["pairs"] > 0
        assert stage["validation"]["loss"] > 0
    assert "gain_db" in card["stages"]["noise"]["validation"]
    assert {"map", "relative"} <= set(card["stages"]["aperture"]["validation"])
    # Any two of 20 to 25 captures of 2 scenes; the aperture's come from the one with depth.
    assert 2 * 20 * 19 <= card["stages"]["exposure"]["pairs"] <= 2 * 25 * 24
    assert card["stages"]["aperture"]["pairs"] <= 25 * 24 / 2 * 1.12


def test_the_weights_load_and_run(trained: Path) -> None:
    modules, _ = load_modules(trained)
    torch.manual_seed(config().seed)
    simulator = CameraSimulator.from_pretrained(trained, device="cpu")
    light = scene(depth=False).light
    raw = RawImage(light, CameraSettings(6400, 1 / 64, 8), get_camera("nikon_z6"))
    result = simulator.simulate(raw, CameraSettings(100, 1, 4), depth="unknown")
    assert bool(result.data.isfinite().all())
    w: Any = modules["exposure"].w
    assert float(w) != 1.0  # two steps moved it


def weights(modules: nn.Module) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in modules.state_dict().items()}


def test_a_second_run_trains_nothing_and_ends_the_same(trained: Path) -> None:
    before, card = trained.read_bytes(), card_of(trained)
    calls: list[str] = []
    again = train_and_save(
        config(),
        scenes,
        trained.parent / "net",
        command="",
        progress=lambda task, share, values: calls.append(task),
    )
    assert again.read_bytes() == before
    assert card_of(again)["stages"] == card["stages"]
    assert not any("training" in task for task in calls)


def test_a_killed_training_ends_where_one_run_ends(trained: Path, tmp_path: Path) -> None:
    """Stopped as the noise stage begins its second step."""

    class Stopped(Exception):
        pass

    real = ReferencePairs.batch

    def batch(self, step, *arguments, **options):
        if self.stage == "noise" and step == 1:
            raise Stopped
        return real(self, step, *arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ReferencePairs, "batch", batch)
        with pytest.raises(Stopped):
            train_and_save(config(), scenes, tmp_path / "net", command="")
    assert not (tmp_path / "net.safetensors").exists()
    resumed = train_and_save(config(), scenes, tmp_path / "net", command="")
    assert resumed.read_bytes() == trained.read_bytes()


def test_another_seed_is_another_training(trained: Path, tmp_path: Path) -> None:
    other = train_simulator(config(seed=1), scenes, tmp_path).modules.state_dict()
    first = load_modules(trained)[0].state_dict()
    assert not any(
        torch.equal(first[n], other[n]) for n in ("exposure.b", "noise.network.head.weight")
    )


def test_progress_goes_from_rendering_to_the_end_of_each_stage(tmp_path: Path) -> None:
    calls: list[tuple[str, float]] = []
    train_simulator(
        config(),
        scenes,
        tmp_path,
        progress=lambda task, share, values: calls.append((task, share)),
    )
    order = list(dict.fromkeys(task for task, _ in calls))
    assert order == [
        f"{stage}: {task}"
        for stage in ("exposure", "noise", "aperture")
        for task in ("rendering", "training")
    ]
    for task in order:
        shares = [share for name, share in calls if name == task]
        assert shares == sorted(shares)
        assert shares[-1] == 1.0


@pytest.mark.parametrize("preset", ["pc", "dl"])
def test_a_baseline(preset: str, tmp_path: Path) -> None:
    file = train_and_save(config(preset), scenes, tmp_path / preset, command="")
    modules, card = load_modules(file)
    assert list(modules) == ["baseline"]
    assert list(card["stages"]) == ["baseline"]


def test_tensorboard_logs_each_stage(tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    train_simulator(config("pc"), scenes, tmp_path, tensorboard=True)
    (events,) = (tmp_path / "tensorboard").rglob("events.out*")
    log = EventAccumulator(str(events.parent)).Reload()
    (entry,) = log.Scalars("baseline/loss")
    assert entry.step == 2


def test_validation_is_the_mean_over_fixed_pairs_and_changes_nothing() -> None:
    camera = get_camera("nikon_z6")
    pairs = ReferencePairs(draw_sequences([scene()], camera, 0), ReferenceCamera(camera), "all")

    class Loss(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.seen, self.modes = [], []

        def forward(self, batch):
            self.seen.append(float(batch.source.mean()))
            self.modes.append(self.training)
            value = torch.tensor(float(len(self.seen)))
            return {"loss": value, "gain_db": value / 0 if len(self.seen) == 3 else value}

    loss = Loss()
    accelerator = make_accelerator(config(), "cpu", None)
    assert validate(loss, pairs, 16, accelerator) == {
        "loss": 4.5
    }  # mean of 1 to 8; inf is left out
    assert not any(loss.modes)
    assert loss.training
    first = list(loss.seen)
    validate(loss, pairs, 16, accelerator)
    assert loss.seen[8:] == first


def test_a_precision_after_another_in_one_process(tmp_path: Path) -> None:
    for precision in ("float32", "bfloat16", "float32"):
        made = train_simulator(config("pc", precision=precision), scenes, tmp_path / precision)
        assert all(p.dtype == torch.float32 for p in made.modules.parameters())


def test_without_the_extra_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "accelerate", None)
    with pytest.raises(ImportError, match=r"pip install 'ae-env\[train\]'"):
        train_simulator(config(), scenes, tmp_path)
