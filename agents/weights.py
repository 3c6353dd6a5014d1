"""Trained agents on disk: safetensors for the numbers, JSON for everything else; no pickle."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn

from agents.policy import PolicyContext
from simulator.files import sibling, write_atomically

FORMAT_VERSION = 1
#: What every card says.
_ENTRIES = ("width", "context", "training", "aliases")


def save_agent(path: Path, kind: str, module: nn.Module, description: dict[str, Any]) -> None:
    """Writes ``path.safetensors`` and ``path.json``.

    Args:
        path: File name, with or without one of the two endings.
        kind: ``"regression"`` or ``"ppo"``.
        module: Its state is stored.
        description: JSON values: what the agent expects to observe and how it was trained.
    """
    tensors: dict[str, Tensor] = {}
    aliases: dict[str, str] = {}  # SB3's policies hold one features extractor under three names
    stored: dict[tuple[int, torch.Size], str] = {}
    for name, value in module.state_dict().items():
        source = stored.setdefault((value.data_ptr(), value.shape), name)
        if source == name:
            tensors[name] = value.detach().cpu().contiguous()
        else:
            aliases[name] = source
    write_atomically(sibling(path, ".safetensors"), save(tensors))
    card = {"format": FORMAT_VERSION, "kind": kind, **description, "aliases": aliases}
    write_atomically(sibling(path, ".json"), (json.dumps(card, indent=1) + "\n").encode())


def load_agent(path: str | Path, kind: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and description of an agent written by `save_agent`.

    Raises:
        FileNotFoundError: If one of the two files is missing; the message says which.
        ValueError: If a file is damaged, or holds another kind of agent.
    """
    card_path, tensor_path = sibling(path, ".json"), sibling(path, ".safetensors")
    for file in (tensor_path, card_path):
        if not file.is_file():
            raise FileNotFoundError(
                f"`weights` (={str(path)!r}): there is no {file.name}; an agent is a .safetensors "
                "and a .json file of the same name, as `ae-env train` writes them"
            )
    try:
        card = json.loads(card_path.read_text(encoding="utf-8"))
        tensors = load(tensor_path.read_bytes())
    except (ValueError, SafetensorError) as error:
        raise ValueError(f"`weights` (={str(path)!r}) cannot be read: {error}") from error
    if not isinstance(card, dict):
        raise ValueError(f"`weights` (={str(path)!r}): {card_path.name} must hold a JSON object")
    if card.get("kind") != kind or card.get("format") != FORMAT_VERSION:
        raise ValueError(
            f"`weights` (={str(path)!r}) must be a {kind} agent of format {FORMAT_VERSION}, got "
            f"{card.get('kind')!r} of format {card.get('format')!r}"
        )
    missing = [name for name in _ENTRIES if name not in card]
    if missing:
        raise ValueError(f"`weights` (={str(path)!r}): {card_path.name} lacks {missing}")
    aliases = {name: source for name, source in card["aliases"].items() if source in tensors}
    return tensors | {name: tensors[source] for name, source in aliases.items()}, card


def load_into(module: nn.Module, tensors: dict[str, Tensor], path: str | Path) -> None:
    """Gives `module` the tensors of `load_agent`.

    Raises:
        ValueError: If they are not those of this network.
    """
    try:
        module.load_state_dict(tensors)
    except RuntimeError as error:
        text = " ".join(str(error).split())
        raise ValueError(f"`weights` (={str(path)!r}) do not fit the network: {text}") from error


def describe_context(context: PolicyContext) -> dict[str, Any]:
    """What a network's shape and meaning depend on."""
    raw = context.observation_space["raw"]
    return {
        "resolution": list(raw.shape or ()),
        "observation": str(raw.dtype),
        "sensors": context.has_sensors,
        "isos": list(context.grid.isos),
        "exposure_times": list(context.grid.exposure_times),
        "f_numbers": list(context.grid.f_numbers),
    }


def check_context(card: dict[str, Any], context: PolicyContext) -> None:
    """Raises a `ValueError` that names what `context` has other than the agent was trained for."""
    for name, here in describe_context(context).items():
        trained = card["context"].get(name)
        if trained != here:
            raise ValueError(
                f"`weights`: the agent was trained with {name} = {trained}, "
                f"the environment has {here}"
            )
