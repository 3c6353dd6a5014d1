"""Trained modules on disk: safetensors for the numbers, JSON for the model card; no pickle."""

from __future__ import annotations

import difflib
import hashlib
import json
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn

from simulator.capture.statistics import Residual
from simulator.networks.aperture_module import ApertureModule
from simulator.networks.exposure_module import ExposureModule
from simulator.networks.noise_module import NoiseModule
from simulator.networks.paper_baselines import DecoupledNet, ParameterConcatenation
from simulator.utils.files import sibling, write_atomically

#: Everything that can be trained: the simulator's networks in three sizes (nano and large are noise
#: modules alone), the paper's, those of its authors' released code, and the paper's two baselines.
PRESETS = ("nano", "compact", "large", "paper", "ncs", "pc", "dl")
#: Increased when the networks change such that older weights no longer fit.
FORMAT_VERSION = 2


def build_modules(preset: str) -> nn.ModuleDict:
    """The untrained modules of a preset, by stage."""
    if preset == "pc":
        return nn.ModuleDict({"baseline": ParameterConcatenation()})
    if preset == "dl":
        return nn.ModuleDict({"baseline": DecoupledNet()})
    if preset in ("nano", "large"):
        return nn.ModuleDict({"noise": NoiseModule(preset)})  # type: ignore[arg-type]
    return nn.ModuleDict(
        {
            "exposure": ExposureModule(),
            "noise": NoiseModule(preset),  # type: ignore[arg-type]
            "aperture": ApertureModule(preset),  # type: ignore[arg-type]
        }
    )


def list_pretrained() -> list[str]:
    """Names of the weights that come with the package."""
    folder = resources.files("simulator").joinpath("pretrained")
    if not folder.is_dir():
        return []
    files = [f.name for f in folder.iterdir()]
    return sorted(name.removesuffix(".json") for name in files if name.endswith(".json"))


def save_modules(path: Path, modules: nn.Module, preset: str, card: dict[str, Any]) -> None:
    """Writes ``path.safetensors`` and ``path.json``, the card with the hash of the weights.

    Args:
        path: File name, with or without one of the two endings.
        modules: Their state is stored.
        preset: Name that `build_modules` makes them from.
        card: JSON values: how they were trained and what they score.

    Raises:
        ValueError: If the weights are not finite; nothing is written then.
    """
    check_finite(modules.state_dict(), path)
    content = save({k: v.detach().cpu().contiguous() for k, v in modules.state_dict().items()})
    head = {
        "format": FORMAT_VERSION,
        "preset": preset,
        "sha256": hashlib.sha256(content).hexdigest(),
        "parameters": sum(p.numel() for p in modules.parameters()),
    }
    write_pair(path, content, {**head, **card})


def write_pair(path: Path, content: bytes, card: dict[str, Any]) -> None:
    """Writes the card, then the weights whose hash it holds.

    `read_pair` reads them the other way round: whatever other processes write in between, weights
    never come with a card that is older than they are.
    """
    write_atomically(sibling(path, ".json"), json.dumps(card, indent=1) + "\n")
    write_atomically(sibling(path, ".safetensors"), content)


def read_pair(path: str | Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors and the card that `write_pair` wrote; a card without a hash is not compared.

    Raises:
        ValueError: If a file cannot be read or is damaged, the card is no JSON object, or its hash
            is not that of the weights.
    """
    card_file, file = sibling(path, ".json"), sibling(path, ".safetensors")
    try:
        content, text = file.read_bytes(), card_file.read_bytes()
    except OSError as error:
        raise ValueError(f"`weights` (={str(path)!r}) cannot be read: {error}") from error
    try:
        card = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(
            f"`weights` (={str(path)!r}): {card_file.name} is damaged: {error}; train them again"
        ) from error
    if not isinstance(card, dict):
        raise ValueError(f"`weights` (={str(path)!r}): {card_file.name} must hold a JSON object")
    digest = hashlib.sha256(content).hexdigest()
    if card.get("sha256", digest) != digest:
        raise ValueError(
            f"`weights` (={str(path)!r}): the hash of {file.name} (={digest[:12]}...) must be that "
            f"in {card_file.name} (={str(card['sha256'])[:12]}...): one of them is damaged or of "
            "another training, or being written at this moment; train or copy both again"
        )
    try:
        tensors = load(content)
    except SafetensorError as error:
        raise ValueError(
            f"`weights` (={str(path)!r}): {file.name} cannot be read: {error}; train them again"
        ) from error
    check_finite(tensors, path)
    return tensors, card


def check_finite(tensors: Mapping[str, Tensor], path: str | Path) -> None:
    """Raises a `ValueError` that names the first of `tensors` that holds a NaN or an infinity."""
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise ValueError(
                f"`weights` (={str(path)!r}) must be finite: their training has failed ({name}); "
                "train again with a lower learning_rate"
            )


def load_modules(name: str | Path) -> tuple[nn.ModuleDict, dict[str, Any]]:
    """Trained modules, in evaluation mode, and their model card.

    Args:
        name: One of `list_pretrained()`, or the path of a ``.safetensors`` file with its ``.json``.

    Raises:
        ValueError: If there is no such file, its hash is not the card's, or its tensors are not
            those of the preset's networks.
    """
    if not isinstance(name, str | Path) or not str(name):
        raise ValueError(f"`weights` (={name!r}) must be a name or a path")
    folder = resources.files("simulator").joinpath("pretrained")
    known = list_pretrained()
    path: Any = name
    if str(name) in known:
        path = folder.joinpath(str(name))
    else:
        files = sibling(name, ".json"), sibling(name, ".safetensors")
        missing = [f for f in files if not f.is_file()]
        if missing:
            near = difflib.get_close_matches(str(name), known, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            if str(name) in PRESETS:
                hint = f"; train it: ae-env train-simulator configs/simulator/{name}.yaml"
            if str(name) == "ncs":
                hint = "; get them by: ae-env import-weights ncs FOLDER -o ncs.safetensors"
            raise ValueError(
                f"`weights` (={str(name)!r}) must be one of {known} or the path of a .safetensors "
                f"file with its .json; there is no {missing[0]}{hint}"
            )
    tensors, card = read_pair(path)
    _check_card(card, name)
    modules = build_modules(card["preset"])
    try:
        modules.load_state_dict(tensors)
    except RuntimeError as error:
        text = " ".join(str(error).split())
        raise ValueError(f"`weights` (={str(name)!r}) do not fit the networks: {text}") from error
    if "noise" in modules and card.get("residual") is not None:
        modules["noise"].residual = Residual.from_card(card["residual"])  # type: ignore[assignment]
    modules.eval().requires_grad_(False)
    return modules.to(memory_format=torch.channels_last), card  # type: ignore[call-overload]


def _check_card(card: dict[str, Any], name: str | Path) -> None:
    if card.get("format") != FORMAT_VERSION:
        raise ValueError(
            f"`weights` (={str(name)!r}): the .json must be a model card of format "
            f"{FORMAT_VERSION}, got {card.get('format')!r}"
        )
    if "sha256" not in card:
        raise ValueError(f"`weights` (={str(name)!r}): the .json must hold the hash, `sha256`")
    if card.get("preset") not in PRESETS:
        raise ValueError(
            f"`weights` (={str(name)!r}): unknown preset {card.get('preset')!r} in the .json, the "
            f"presets are {list(PRESETS)}"
        )
