"""The paper's table on a small dataset in the paper's layout, from training to table."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from benchmarks import paper
from simulator import CameraSimulator
from simulator.networks.weights import build_modules, save_modules
from simulator.training.paper_dataset import split_dataset
from tests.simulator.training.captures import write_dataset


@pytest.fixture
def here(benchmarks_here: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Parts run in this process, and nothing is written elsewhere."""
    monkeypatch.setattr(paper, "WEIGHTS", tmp_path / "runs" / "paper")
    write_dataset(tmp_path / "data")
    return tmp_path


def test_train_measure_table_in_one_command(ae_env, here: Path) -> None:
    code, _, error = ae_env("bench", "paper", "data", "--quick", "--out", "results")
    assert (code, error) == (0, "")
    result = json.loads((here / "results" / "paper.json").read_text())
    assert result["meta"]["command"] == "ae-env bench paper data --quick"
    rows = result["rows"]
    means = {(r["group"], r["preset"], r["method"]): r for r in rows if "group" in r}
    networks = [("paper", m) for m in ("EXP", "NS", "Full")] + [("pc", "PC"), ("dl", "DL")]
    networks += [("compact", m) for m in ("EXP", "NS", "Full")]
    assert {key[1:] for key in means if key[0] == "all"} == set(networks)
    for key in networks:
        parts = [m["pairs"] for k, m in means.items() if k[1:] == key and k[0] != "all"]
        assert sum(parts) == means["all", *key]["pairs"] == 6
    page = (here / "results" / "paper.md").read_text()
    assert "|EXP`paper`|" in page.replace(" ", "")
    assert "36.10 / 0.923" in page  # what the paper publishes
    with Image.open(here / "results" / "paper.png") as picture:
        assert picture.width > 300
    # The exposure of w = 1, b = 0 by hand, on the pairs that were measured.
    _, held_out = split_dataset(here / "data")
    captures = {str(c.settings): c for c in held_out[0].captures}
    for row in (r for r in rows if (r["preset"], r["method"]) == ("compact", "EXP")):
        if "source" not in row:
            continue
        source, target = captures[row["source"]], captures[row["target"]]
        scale = 2.0 ** (target.settings.log2_exposure - source.settings.log2_exposure)
        pictures = [np.load(c.file).astype(float) for c in (source, target)]
        error = np.minimum(pictures[0] * scale, 1.0) - np.minimum(pictures[1], 1.0)
        decibels = -10.0 * np.log10((error**2).mean())
        assert row["psnr_db"] == pytest.approx(decibels, abs=0.02)


def test_given_weights_are_measured_and_nothing_is_trained(ae_env, here: Path) -> None:
    torch.manual_seed(0)
    save_modules(here / "mine", build_modules("paper"), "paper", {})
    assert CameraSimulator.from_pretrained(here / "mine", device="cpu").noise is not None
    options = ("--quick", "--out", "results", "--weights", "mine.safetensors")
    code, _, error = ae_env("bench", "paper", "data", *options)
    assert (code, error) == (0, "")
    rows = json.loads((here / "results" / "paper.json").read_text())["rows"]
    assert {row["preset"] for row in rows} == {"paper", "compact"}
    assert not (here / "runs" / "paper").exists()
