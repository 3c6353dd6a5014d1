"""Trained weights on disk: what comes back, and what is refused."""

import hashlib
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

from simulator import CameraSimulator
from simulator.networks import weights
from simulator.networks.weights import build_modules, list_pretrained, load_modules, save_modules


@pytest.fixture(scope="module")
def modules() -> nn.ModuleDict:
    torch.manual_seed(0)
    return build_modules("compact")


@pytest.fixture
def saved(modules: nn.ModuleDict, tmp_path: Path) -> Path:
    save_modules(tmp_path / "net-0.5", modules, "compact", {"note": "for a test"})
    return tmp_path / "net-0.5"


def beside(path: Path, suffix: str) -> Path:
    return path.with_name(path.name + suffix)


def test_round_trip(saved: Path, modules: nn.ModuleDict) -> None:
    assert sorted(p.name for p in saved.parent.iterdir()) == ["net-0.5.json", "net-0.5.safetensors"]
    expected = modules.state_dict()
    for ending in ("", ".safetensors", ".json"):
        loaded, card = load_modules(beside(saved, ending))
        state = loaded.state_dict()
        assert list(state) == list(expected)
        assert all(torch.equal(value, expected[name]) for name, value in state.items())
        assert not loaded.training
        assert not any(p.requires_grad for p in loaded.parameters())
        assert (card["preset"], card["note"]) == ("compact", "for a test")
        assert card["parameters"] == sum(p.numel() for p in modules.parameters())


@pytest.mark.parametrize("position", [20, -1])
def test_one_changed_byte_is_noticed(saved: Path, position: int) -> None:
    file = beside(saved, ".safetensors")
    content = bytearray(file.read_bytes())
    digest = json.loads(beside(saved, ".json").read_text())["sha256"]
    assert digest == hashlib.sha256(content).hexdigest()
    content[position] ^= 1
    file.write_bytes(content)
    with pytest.raises(ValueError, match=r"the hash of net-0.5.safetensors .* train or copy"):
        load_modules(saved)


@pytest.mark.parametrize("name", ["exposure.b", "exposure.w", "surplus"])
def test_tensors_of_other_networks_are_refused(saved: Path, name: str) -> None:
    """Under a card whose hash is right."""
    file, card = beside(saved, ".safetensors"), beside(saved, ".json")
    tensors = load_file(file)
    if tensors.pop(name, None) is None or name == "exposure.b":
        tensors[name] = torch.zeros(3)
    save_file(tensors, file)
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    card.write_text(json.dumps({**json.loads(card.read_text()), "sha256": digest}))
    with pytest.raises(ValueError, match=f"do not fit the networks.*{name}"):
        load_modules(saved)


@pytest.mark.parametrize(
    ("card", "message"),
    [
        ("{", "is damaged"),
        ("[" * 10**6, "net-0.5.json is damaged"),
        ("[]", "must hold a JSON object"),
        ('{"format": [1]}', r"model card of format 2, got \[1\]"),
        ({"residual": {"wiener_error": []}}, "must be a calibration"),
        *(({"preset": p}, re.escape(f"unknown preset {p!r}")) for p in ("huge", None, ["compact"])),
    ],
)
def test_damaged_cards(saved: Path, card: str | dict[str, Any], message: str) -> None:
    path = beside(saved, ".json")
    path.write_text(
        card if isinstance(card, str) else json.dumps({**json.loads(path.read_text()), **card})
    )
    with pytest.raises(ValueError, match=message):
        load_modules(saved)


@pytest.mark.parametrize("ending", [".json", ".safetensors"])
def test_files_that_are_not_there_or_cannot_be_read(saved: Path, ending: str) -> None:
    file = beside(saved, ending)
    file.unlink()
    with pytest.raises(ValueError, match=re.escape(f"there is no {file}")):
        load_modules(saved)
    file.mkdir()  # a file that cannot be read
    with pytest.raises(ValueError, match=r"net-0.5'\) cannot be read: .*Is a directory"):
        weights.read_pair(saved)


def test_shipped_weights_load_by_name(saved, monkeypatch, tmp_path_factory):
    """From a package that ships two sizes, in a folder without any; the second errs as its card
    says."""
    root = tmp_path_factory.mktemp("package")
    (root / "pretrained").mkdir()
    for ending in (".json", ".safetensors"):
        beside(saved, ending).rename(root / "pretrained" / f"compact{ending}")
    tables = {"wiener_error": [0.0, 1.0], "bias": [0.2, 0.1], "variance": [0.0, 0.3]}
    residual = tables | {"spread": 1.5}
    save_modules(root / "pretrained/nano", build_modules("nano"), "nano", {"residual": residual})
    monkeypatch.setattr(weights, "resources", SimpleNamespace(files=lambda _: root))
    monkeypatch.chdir(saved.parent)
    assert list_pretrained() == ["compact", "nano"]
    simulators = [CameraSimulator.from_pretrained(n, device="cpu") for n in ("nano", "compact")]
    assert [[n.preset for n in s.noises] for s in simulators] == [["nano"], ["nano", "compact"]]
    for simulator in simulators:  # a noise module alone takes the aperture's of the compact set
        assert simulator.noise is simulator.noises[-1]
        assert simulator.aperture is not None
        nano = simulator.noises[0].residual
        assert nano is not None
        assert nano.to_card() == residual
    assert simulators[1].noise.residual is None
    with pytest.raises(
        ValueError, match=r"one of \['compact', 'nano'\] .* did you mean 'compact'\?"
    ):
        load_modules("compcat")
    with pytest.raises(ValueError) as caught:
        load_modules("zzz")
    assert "did you mean" not in str(caught.value)
    with pytest.raises(ValueError, match=r"`preset` \(='compcat'\)"):
        build_modules("compcat")


def test_sizes_of_the_published_networks() -> None:
    """Of the denoiser: weights 9 * in * out and biases of 19 convolutions."""
    modules = build_modules("paper")
    for stage, parameters in (("noise", 7_849_220), ("aperture", 8_784_324)):
        assert sum(p.numel() for p in modules[stage].parameters()) == parameters
