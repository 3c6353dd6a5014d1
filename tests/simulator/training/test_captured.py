"""Training on real captures: the split, the pairs, and what is learnt from them."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from simulator.networks.weights import build_modules, load_modules
from simulator.raw.dataset import packed_camera
from simulator.training.captured import (
    CapturedPairs,
    captured_pairs,
    split_dataset,
    train_on_captures,
)
from simulator.training.losses import BaselineLoss
from simulator.training.train import SimulatorConfig
from tests.simulator.training.captures import SETTINGS, write_dataset

STAGE = {"steps": 2, "batch": 2, "crop": 16}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("Nikon"), sequences=4)


def config(preset: str, **changes: Any) -> SimulatorConfig:
    names = ("exposure", "noise", "aperture") if preset == "paper" else ("baseline",)
    return SimulatorConfig.model_validate(
        {"preset": preset, **dict.fromkeys(names, STAGE), **changes}
    )


def test_sequences_are_split_whole(folder: Path) -> None:
    train, test = split_dataset(folder, seed=0)
    assert (len(train), len(test)) == (3, 1)
    names = {s.name for s in (*train, *test)}
    assert names == {f"scene_00{n}" for n in range(4)}
    assert [s.name for s in split_dataset(folder, seed=0)[1]] == [test[0].name]
    drawn = {split_dataset(folder, seed=seed)[1][0].name for seed in range(12)}
    assert len(drawn) > 1
    assert train[0].settings == SETTINGS


def test_folders_named_test_are_held_out(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / "AutoModeNikon_Train")
    write_dataset(tmp_path / "AutoModenikon_test_512", sequences=2)
    train, test = split_dataset(tmp_path)
    assert (len(train), len(test)) == (4, 2)


def test_data_that_cannot_be_split(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="must be an existing folder"):
        split_dataset(tmp_path / "none")
    with pytest.raises(ValueError, match=r"must hold a camera_params\.csv"):
        split_dataset(tmp_path)
    write_dataset(tmp_path / "one", sequences=1)
    with pytest.raises(ValueError, match=r"must hold two sequences or more.* it holds 1"):
        split_dataset(tmp_path / "one")


def test_pairs_of_each_stage(folder: Path) -> None:
    sequences = split_dataset(folder)[0][:1]
    settings = sequences[0].settings
    found = {
        stage: [(settings[p.source], settings[p.target]) for p in captured_pairs(sequences, stage)]
        for stage in ("exposure", "noise", "aperture")
    }
    assert len(found["exposure"]) == 4 * 3
    assert found["noise"] == [(SETTINGS[1], SETTINGS[0])]  # f/8, ISO 1600 to 100
    opens = [(s, t) for s, t in found["aperture"] if s.f_number > t.f_number]
    assert len(opens) == 5  # of 6 unordered pairs, one has the same aperture
    assert all(s.f_number >= t.f_number for s, t in found["aperture"])


def test_batches_hold_what_the_files_and_the_table_say(folder: Path) -> None:
    sequences = split_dataset(folder)[0]
    pairs = CapturedPairs(sequences, "noise", seed=5)
    batch = pairs.batch(3, 4, 16)
    again = CapturedPairs(sequences, "noise", seed=5).batch(3, 4, 16)
    assert all(torch.equal(a, b) for a, b in zip(batch, again, strict=True))
    assert batch.source.shape == (4, 4, 16, 16)
    assert batch.ratio.tolist() == [1.0] * 4  # four stops of ISO against four of time
    assert batch.f_source.tolist() == batch.f_target.tolist() == [8.0] * 4
    assert batch.shot[0].tolist() == pytest.approx(packed_camera("nikon_z6").nlf(1600).shot, 1e-2)
    whole = pairs.batch(0, 1, 4096)
    files = [np.load(c.file)[[0, 1, 3, 2]] for s in sequences for c in s.captures]
    clipped = [np.minimum(f, 1.0) for f in files]
    assert any(np.array_equal(whole.source[0], f) for f in clipped)
    assert any(np.array_equal(whole.sample[0], f) for f in clipped)


def test_a_network_learns_from_captures(tmp_path: Path, folder: Path) -> None:
    """The baseline's error on sequences that it does not see falls to less than half."""
    train, held_out = split_dataset(folder)
    stage = {"steps": 60, "batch": 4, "crop": 32, "learning_rate": 0.003}
    training = config("pc", baseline=stage)
    path = train_on_captures(training, train, tmp_path / "pc", command="test")
    torch.manual_seed(0)
    batch = CapturedPairs(held_out, "baseline").batch(0, 8, 32)
    before, after = (
        float(BaselineLoss(modules["baseline"])(batch)["loss"].detach())
        for modules in (build_modules("pc"), load_modules(path)[0])
    )
    assert after < 0.5 * before


def test_all_stages_are_trained_and_a_second_run_resumes(tmp_path: Path, folder: Path) -> None:
    train, _ = split_dataset(folder)
    path = tmp_path / "out" / "paper"
    written = train_on_captures(config("paper"), train, path, command="test")
    modules, card = load_modules(written)
    assert list(card["stages"]) == ["exposure", "noise", "aperture"]
    assert {name: s["steps"] for name, s in card["stages"].items()} == dict.fromkeys(
        ("exposure", "noise", "aperture"), 2
    )
    assert (card["sequences"], card["training"]["preset"]) == (3, "paper")
    assert modules["exposure"].w != 1.0
    again = train_on_captures(config("paper"), train, path, command="test")
    state = load_modules(again)[0].state_dict()
    assert all(torch.equal(state[name], t) for name, t in modules.state_dict().items())


def test_presets_that_cannot_learn_from_captures(tmp_path: Path, folder: Path) -> None:
    stages = dict.fromkeys(("exposure", "noise", "aperture"), STAGE)
    compact = SimulatorConfig.model_validate({"preset": "compact", **stages})
    with pytest.raises(ValueError, match=r"`preset` \(='compact'\) must be 'paper'"):
        train_on_captures(compact, split_dataset(folder)[0], tmp_path / "a", command="test")
