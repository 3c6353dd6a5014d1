"""Trained modules on disk: safetensors for the numbers, JSON for the model card; no pickle."""

from __future__ import annotations

import difflib
import hashlib
import json
from importlib import resources
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import nn

from simulator.files import sibling, write_atomically
from simulator.modules.build import PRESETS, build_modules

#: Bumped when the networks change such that older weights no longer fit.
FORMAT_VERSION = 1


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
        preset: What `simulator.modules.build.build_modules` makes them from.
        card: JSON values: how they were trained and what they score.
    """
    content = save({k: v.detach().cpu().contiguous() for k, v in modules.state_dict().items()})
    head = {
        "format": FORMAT_VERSION,
        "preset": preset,
        "sha256": hashlib.sha256(content).hexdigest(),
        "parameters": sum(p.numel() for p in modules.parameters()),
    }
    write_atomically(sibling(path, ".safetensors"), content)
    text = json.dumps({**head, **card}, indent=1) + "\n"
    write_atomically(sibling(path, ".json"), text.encode())


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
    if str(name) in known:
        card_text = folder.joinpath(f"{name}.json").read_text(encoding="utf-8")
        content = folder.joinpath(f"{name}.safetensors").read_bytes()
    else:
        files = sibling(name, ".json"), sibling(name, ".safetensors")
        missing = [f for f in files if not f.is_file()]
        if missing:
            near = difflib.get_close_matches(str(name), known, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            if str(name) in PRESETS:
                hint = f"; train it: ae-env train-simulator configs/simulator/{name}.yaml"
            raise ValueError(
                f"`weights` (={str(name)!r}) must be one of {known} or the path of a .safetensors "
                f"file with its .json; there is no {missing[0]}{hint}"
            )
        card_text = files[0].read_text(encoding="utf-8", errors="replace")
        content = files[1].read_bytes()
    card = _checked_card(card_text, content, name)
    modules = build_modules(card["preset"])
    try:
        tensors = load(content)
        modules.load_state_dict(tensors)
    except (RuntimeError, SafetensorError) as error:
        text = " ".join(str(error).split())
        raise ValueError(f"`weights` (={str(name)!r}) do not fit the networks: {text}") from error
    if not all(bool(torch.isfinite(t).all()) for t in tensors.values()):
        raise ValueError(f"`weights` (={str(name)!r}) must be finite: their training has failed")
    return modules.eval().requires_grad_(False).to(memory_format=torch.channels_last), card  # type: ignore[call-overload, return-value]


def _checked_card(text: str, content: bytes, name: str | Path) -> dict[str, Any]:
    try:
        card = json.loads(text)
    except ValueError as error:
        raise ValueError(f"`weights` (={str(name)!r}): the .json is damaged: {error}") from error
    if not isinstance(card, dict) or card.get("format") != FORMAT_VERSION:
        raise ValueError(
            f"`weights` (={str(name)!r}): the .json must be a model card of format {FORMAT_VERSION}"
        )
    digest = hashlib.sha256(content).hexdigest()
    if card.get("sha256") != digest:
        raise ValueError(
            f"`weights` (={str(name)!r}): the hash of the .safetensors (={digest[:12]}...) must be "
            f"the model card's (={str(card.get('sha256'))[:12]}...); the file is damaged or another"
        )
    if card.get("preset") not in PRESETS:
        raise ValueError(f"`weights` (={str(name)!r}): unknown preset {card.get('preset')!r}")
    return card
