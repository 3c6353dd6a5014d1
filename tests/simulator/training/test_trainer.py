"""Training in stages: configurations, cards, budgets, stops and resumes, calibration."""

import itertools
import json
import math
import re
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import nn
from torch.optim.swa_utils import AveragedModel

from benchmarks import paper_baselines as paper_baselines  # presets pc and dl
from simulator import get_camera
from simulator.capture.statistics import Residual
from simulator.networks.noise_module import NoiseModule, variance_map
from simulator.networks.weights import load_modules
from simulator.reference.reference_camera import ReferenceCamera
from simulator.training import trainer
from simulator.training.crops import DetailCrops, DetailPicture, ReferencePairs, draw_sequences
from simulator.training.trainer import SimulatorConfig, StageConfig, make_accelerator, validate
from simulator.utils.config_file import load_yaml
from tests.simulator.training.scenes import scene

STAGE = {"steps": 2, "batch": 2, "crop": 16}


def config(preset="compact", **changes):
    names = {"compact": ("noise", "exposure", "aperture"), "nano": ("noise",), "large": ("noise",)}
    names = names.get(preset, ("baseline",))
    values = {"preset": preset, "scenes": {"size": 32}, **dict.fromkeys(names, STAGE), **changes}
    return SimulatorConfig.model_validate(values)


def scenes(config, split):
    first = {"train": 0, "validation": 10}[split]
    return [scene(f"{split}-deep", seed=first), scene(f"{split}-flat", seed=first + 1, depth=False)]


def pictures(config: SimulatorConfig, split: str) -> list[DetailPicture]:
    light = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(len(split)))
    return [DetailPicture(f"{split}-{i}", f"{split}-{i}", "leaves", light[i]) for i in range(2)]


@pytest.fixture(autouse=True, scope="module")
def quick_calibration():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("simulator.training.trainer._CROPS", 8)
        patch.setattr("simulator.training.trainer._SIDE", 16)
        yield


def save(folder, *given, progress=lambda *_: None, scenes=scenes, **changes):
    made, file = config(*given, **changes), folder / "net"
    options = {"command": "ae-env train-simulator x.yaml", "progress": progress}
    options |= {"make_scenes": scenes, "make_pictures": pictures, "tensorboard": True}
    return trainer.train_and_save(made, file, **options)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its progress is complete, and nothing is drawn from torch's own generator."""
    calls: list[tuple[str, float]] = []
    before = torch.random.get_rng_state()
    file = save(tmp_path_factory.mktemp("trained"), progress=lambda *at: calls.append(at[:2]))
    assert torch.equal(torch.random.get_rng_state(), before)
    order = list(dict.fromkeys(task for task, _ in calls))
    stages = itertools.product(("exposure", "aperture"), ("rendering", "training"))
    assert order == ["noise: training", *(f"{stage}: {task}" for stage, task in stages)]
    for task in order:
        shares = [share for name, share in calls if name == task]
        assert shares == sorted(shares)
        assert shares[-1] == 1.0
    return file


def card_of(file):
    return json.loads(file.with_suffix(".json").read_text())


def test_the_card_says_what_was_done(trained):
    card = card_of(trained)
    known = {"preset": "compact", "training": config().card()}
    known["scenes"] = {"leaves": 2, "depth": 1, "flat": 1}
    assert (known | {"command": "ae-env train-simulator x.yaml"}).items() <= card.items()
    assert {"commit", "date", "machine", "versions", "sha256"} <= set(card)
    stages = card["stages"]
    assert list(stages) == ["noise", "exposure", "aperture"]
    assert stages["noise"]["pairs"] == 2
    tables = card["residual"]
    assert len(tables["wiener_error"]) == len(tables["bias"]) == len(tables["variance"])
    values = {"exposure": {"loss"}, "noise": {"loss", "gain_db"}}
    values["aperture"] = {"loss", "map", "relative"}
    assert {name: set(stage["validation"]) for name, stage in stages.items()} == values
    assert all(stage["steps"] == 2 for stage in stages.values())
    # Any two of 20 to 25 captures of 2 scenes; those that open the aperture, at most a half.
    assert 2 * 20 * 19 <= stages["exposure"]["pairs"] <= 2 * 25 * 24
    assert stages["aperture"]["pairs"] <= 2 * 25 * 24 / 2 * 1.12


def test_a_second_run_trains_nothing_and_ends_the_same(trained, monkeypatch):
    before, card = trained.read_bytes(), card_of(trained)
    calls: list[str] = []
    again = save(trained.parent, progress=lambda *at: calls.append(at[0]))
    assert again.read_bytes() == before
    assert card_of(again)["stages"] == card["stages"]
    assert not any("training" in task for task in calls)
    first, other = (trainer.first_modules(config(seed=seed))[0].state_dict() for seed in (0, 1))
    assert not torch.equal(first["noise.network.head.weight"], other["noise.network.head.weight"])
    monkeypatch.setitem(sys.modules, "accelerate", None)
    with pytest.raises(ImportError, match=r"pip install 'ae-env\[train\]'"):
        save(trained.parent)


def test_baselines_in_any_precision_and_their_logs(tmp_path):
    # One precision after another in one process.
    for preset, precision in (("dl", "bfloat16"), ("pc", "float32")):
        modules, card = load_modules(save(tmp_path / preset, preset, precision=precision))
        assert list(modules) == list(card["stages"]) == ["baseline"]
        assert all(p.dtype == torch.float32 for p in modules.parameters())
    (events,) = (tmp_path / "dl" / "tensorboard").rglob("events.out*")
    (entry,) = EventAccumulator(str(events.parent)).Reload().Scalars("baseline/loss")
    assert entry.step == 2


def test_a_noise_module_alone_and_a_training_from_its_weights(tmp_path):
    # A noise module alone needs no scenes.
    first = save(tmp_path, "nano", scenes=lambda *_: pytest.fail("it asked for scenes"))
    weights, card = load_modules(first)
    assert list(weights) == list(card["stages"]) == ["noise"]
    assert weights["noise"].residual.to_card() == card["residual"]
    still = {**STAGE, "steps": 1, "learning_rate": 1e-12}
    (tmp_path / "on").mkdir()
    again, later = load_modules(save(tmp_path / "on", "nano", start=str(first), noise=still))
    for name, value in weights.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], value, rtol=0, atol=1e-8)
    assert later["start"]["sha256"] == card["sha256"]
    with pytest.raises(ValueError, match="`start`"):
        save(tmp_path / "on", "large", noise=STAGE, start=str(first))


def test_validation_is_the_mean_over_fixed_pairs_and_changes_nothing():
    camera = get_camera("nikon_z6")
    pairs = ReferencePairs(draw_sequences([scene()], camera, 0), ReferenceCamera(camera), "all")
    seen: list[float] = []

    class Mean(nn.Module):
        def forward(self, batch):
            seen.append(float(batch.source.mean()))
            value = torch.tensor(float(len(seen)))
            return {"loss": value, "gain_db": value / (len(seen) != 3)}

    loss, accelerator = Mean(), make_accelerator(config(), "cpu", None)
    assert validate(loss, pairs, 16, accelerator) == {"loss": 4.5}  # of 1 to 8; inf is left out
    validate(loss, pairs, 16, accelerator)
    assert seen[8:] == seen[:8]


def test_scenes_to_train_on():
    found = trainer.scenes_of(config(scenes={"procedural": 4, "size": 32}), "train")
    # Three of four procedural scenes have depth; the fourth is draped over two depths.
    assert Counter(s.kind for s in found if s.depth is not None) == {"depth": 3, "draped": 2}
    assert all(s.size == (32, 32) and s.sampled and s.illuminance for s in found)


class Watch:
    """Stands for both clocks of the machine; gives batches of numbers by step, in 7 s each."""

    pairs = ()

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.cpu, self.wall, self.steps, self.stop, self.broken = 1000.0, 50.0, [], -1, -1
        monkeypatch.setattr("time.process_time", lambda: self.cpu)
        monkeypatch.setattr(trainer.time, "monotonic", lambda: self.wall)

    def batch(self, step: int, size: int, crop: int, *, process: int = 0) -> torch.Tensor:
        assert (size, crop, process) == (3, 16, 0)
        if step == self.stop:
            raise KeyboardInterrupt
        self.cpu += 7.0
        self.steps.append(step)
        values = torch.randn(size, 4, generator=torch.Generator().manual_seed(step))
        return values * (math.inf if step == self.broken else 1.0)


class Loss(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.trained, self.frozen = nn.Linear(4, 2), nn.Linear(2, 1)

    def forward(self, batch: torch.Tensor) -> dict[str, torch.Tensor]:
        value = self.frozen(self.trained(batch).tanh() + 0 * batch[:, :2]).square().mean()
        return {"loss": value, "undefined": value.detach() * math.nan}


def run(file, watch, **budget):
    loss, stage = Loss(), StageConfig(batch=3, crop=16, learning_rate=0.05, **budget)
    accelerator = make_accelerator(config("pc"), "cpu", None)
    options = {"checkpoint": file, "identity": "one"}
    args = "noise", loss, loss.trained, watch, stage, accelerator
    return loss, trainer.train_stage(*args, **options)


@pytest.mark.parametrize("budget", [{"steps": 9}, {"minutes": 1}, {"steps": 9, "average": 0.7}])
def test_ctrl_c_and_again_ends_where_one_run_ends(tmp_path, monkeypatch, budget):
    watch = Watch(monkeypatch)
    whole, card = run(tmp_path / "whole", watch, **budget)
    assert card == {"pairs": 0, "steps": 9, "seconds": 63.0}
    watch.stop = 4
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "part", watch, **budget)
    watch.stop, watch.steps = -1, []
    resumed, again = run(tmp_path / "part", watch, **budget)
    assert watch.steps == [4, 5, 6, 7, 8]
    assert again == card
    torch.testing.assert_close(resumed.state_dict(), whole.state_dict(), rtol=0, atol=0)


def test_the_running_average_of_the_weights_by_hand(tmp_path, monkeypatch):
    """It starts at the first."""
    seen: list[torch.Tensor] = []
    real = AveragedModel.update_parameters

    def update(self: AveragedModel, model: nn.Module) -> None:
        seen.append(model.weight.detach().double().clone())
        real(self, model)

    monkeypatch.setattr(AveragedModel, "update_parameters", update)
    loss, _ = run(tmp_path / "a", Watch(monkeypatch), steps=9, average=0.7)
    expected = seen[0]
    for weight in seen[1:]:
        expected = 0.7 * expected + 0.3 * weight
    assert len(seen) == 9
    torch.testing.assert_close(loss.trained.weight.double(), expected, rtol=1e-6, atol=1e-7)


def test_a_loss_that_is_not_finite_stops_the_training_before_it_does_harm(tmp_path, monkeypatch):
    watch = Watch(monkeypatch)
    watch.broken = 5
    with pytest.raises(ValueError, match=r"the loss \(=nan\)"):
        run(tmp_path / "a", watch, steps=9)
    assert not (tmp_path / "a").exists()  # nothing is due yet, and a state of it is not written


STAGES = "exposure: {steps: 2}\nnoise: {steps: 3}\naperture: {minutes: 0.5, crop: 128}\n"
COMPACT = f"preset: compact\n{STAGES}"
CONFIGS = Path(__file__).resolve().parents[3] / "configs" / "simulator"


@pytest.mark.parametrize("file", sorted(CONFIGS.glob("*.yaml")), ids=lambda f: f.name)
def test_shipped_configurations_are_valid(file):
    assert load_yaml(file, SimulatorConfig).preset == file.stem


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (COMPACT.replace("steps: 3", "steps: 3, minutes: 1"), "exactly one"),
        (COMPACT.replace("128", "257"), "`aperture.crop` (=257)"),
        (COMPACT.replace("compact", "nano"), "`exposure` must be left out"),
        ("preset: pc", "`baseline` must be given"),
        (COMPACT.replace("compact", "tiny"), "preset (='tiny')"),
        (f"{COMPACT}camera: nikon_z7", "nikon_z6"),
    ],
)
def test_errors_name_the_entry(tmp_path, text, message):
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(ValueError, match=re.escape(message)):
        load_yaml(tmp_path / "a.yaml", SimulatorConfig)


def test_a_later_stage_does_not_change_what_an_earlier_one_is():
    """The noise stage, which has pictures of its own, depends on nothing else but the seed."""
    plain, longer = config(), config(aperture={**STAGE, "steps": 9})
    for stage, equal in (("noise", True), ("exposure", True), ("aperture", False), (None, False)):
        assert (plain.card(stage) == longer.card(stage)) is equal
    for changes in {"body": 2}, {"scenes": {"size": 512}}, {"exposure": {**STAGE, "steps": 3}}:
        assert config(**changes).card("exposure") != plain.card("exposure"), changes
        assert config(**changes).card("noise") == plain.card("noise"), changes
    for changes in {"seed": 1}, {"noise": {**STAGE, "steps": 3}}, {"precision": "bfloat16"}:
        assert config(**changes).card("noise") != plain.card("noise"), changes


class Known(NoiseModule):
    """Leaves a share of the noise's deviation on a flat field, and shifts it by another."""

    def __init__(self, left, shift):
        super().__init__("nano")
        self.left, self.shift, self.calls = left, shift, 0

    def forward(self, noisy, shot, read):
        mean = noisy.mean(dim=(0, 2, 3), keepdim=True).expand_as(noisy)
        sigma = variance_map(mean, shot, read).sqrt()
        self.calls += 1
        return mean + self.left * (noisy - mean) + self.shift(self.calls) * sigma


def calibrated(left, shift):
    picture = DetailPicture("a", "a", "mosaic", torch.full((4, 64, 64), 0.5))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("simulator.training.trainer._SIDE", 32)
        patch.setattr("simulator.training.trainer._CROPS", 64)
        crops = DetailCrops([picture], [get_camera("nikon_z6")])
        return trainer.calibrate(Known(left, shift), crops)


@pytest.mark.parametrize(("left", "shift"), [(0.0, 0.3), (0.8, -0.2)])
def test_noise_that_is_left_and_a_shift(left: float, shift: float) -> None:
    residual = calibrated(left, lambda _: shift)
    assert residual.wiener_error[0] == 0.0
    seen = residual.wiener_error <= 0.006
    np.testing.assert_allclose(residual.variance[seen], left**2, rtol=0.03, atol=1e-3)
    np.testing.assert_allclose(residual.bias[seen], shift**2, rtol=0.05, atol=2e-3)
    assert 1.0 <= residual.spread < 1.05
    assert Residual.from_card(residual.to_card()).spread == pytest.approx(residual.spread, abs=1e-3)


def test_the_bound_holds_for_nine_crops_of_ten() -> None:
    """The second half of 64 crops is worse: half of it by three times, a twentieth by nine."""
    worse = 32 * [0.1] + [0.1 if n % 2 else 0.9 if n % 20 == 0 else 0.3 for n in range(33, 65)]
    residual = calibrated(0.0, lambda call: worse[call - 1])
    assert residual.bias[0] == pytest.approx(0.01, rel=0.1)
    assert residual.spread == pytest.approx(3.0, rel=0.05)
