"""Trained agents on disk: safetensors for the numbers, JSON for everything else; no pickle."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save
from torch import Tensor, nn

from ae_env.grid import ExposureGrid
from agents.policy import PolicyContext
from simulator.networks.weights import check_finite, read_pair, write_pair
from simulator.utils.files import sibling

FORMAT_VERSION = 1
#: What every card says, and of what type.
_ENTRIES = {"width": int, "context": dict, "training": dict, "aliases": dict}
#: What describes the grid in a card.
_GRID = ("isos", "exposure_times", "f_numbers")
#: Nominal values are rounded: 1/1000 s stands for 1/1024 s.
_ROUNDED = 0.03
#: Most hidden features of a network.
MAX_WIDTH = 65536


def save_agent(path: Path, kind: str, module: nn.Module, description: dict[str, Any]) -> None:
    """Writes ``path.safetensors`` and ``path.json``.

    Args:
        path: File name, with or without one of the two endings.
        kind: ``"regression"`` or ``"ppo"``.
        module: Its state is stored.
        description: JSON values: what the agent expects to observe and how it was trained.

    Raises:
        ValueError: If the weights are not finite; nothing is written then.
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
    check_finite(tensors, path)
    content = save(tensors)
    head = {"format": FORMAT_VERSION, "kind": kind, "sha256": hashlib.sha256(content).hexdigest()}
    write_pair(path, content, {**head, **description, "aliases": aliases})


def load_agent(path: str | Path, kind: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and description of an agent written by `save_agent`.

    Raises:
        FileNotFoundError: If one of the two files is missing; the message says which.
        ValueError: If a file is damaged or cannot be read, the two are not of one training, or they
            hold another kind of agent.
    """
    card_path, tensor_path = sibling(path, ".json"), sibling(path, ".safetensors")
    for file in (tensor_path, card_path):
        if not file.is_file():
            raise FileNotFoundError(
                f"`weights` (={str(path)!r}): there is no {file.name}; an agent is a .safetensors "
                "and a .json file of the same name, as `ae-env train` writes them"
            )
    tensors, card = read_pair(path)
    if card.get("kind") != kind or card.get("format") != FORMAT_VERSION:
        raise ValueError(
            f"`weights` (={str(path)!r}) must be a {kind} agent of format {FORMAT_VERSION}, got "
            f"{card.get('kind')!r} of format {card.get('format')!r}"
        )
    _check_entries(card, f"`weights` (={str(path)!r}): {card_path.name}")
    aliases = {name: source for name, source in card["aliases"].items() if source in tensors}
    return tensors | {name: tensors[source] for name, source in aliases.items()}, card


def _check_entries(card: dict[str, Any], where: str) -> None:
    missing = [name for name in _ENTRIES if name not in card]
    if missing:
        raise ValueError(f"{where} lacks {missing}")
    for name, kind in _ENTRIES.items():
        if not isinstance(card[name], kind) or isinstance(card[name], bool):
            word = "an integer" if kind is int else "a JSON object"
            raise ValueError(f"{where}: `{name}` (={card[name]!r}) must be {word}")
    if not 1 <= card["width"] <= MAX_WIDTH:
        raise ValueError(f"{where}: `width` (={card['width']}) must be in [1, {MAX_WIDTH}]")
    if not all(isinstance(source, str) for source in card["aliases"].values()):
        raise ValueError(f"{where}: `aliases` must map names to names")


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


def trained_grid(card: dict[str, Any]) -> ExposureGrid:
    """The grid that an agent was trained on, from its `card`.

    Raises:
        ValueError: If the card does not describe one.
    """
    return ExposureGrid.from_spec({name: card["context"].get(name, ()) for name in _GRID})


def check_context(card: dict[str, Any], context: PolicyContext) -> None:
    """Raises a `ValueError` that names what `context` has other than the agent was trained for.

    Another grid is well if none of its values lies outside of the range of the trained one: the
    agent then reads its states off between those that it knows.
    """
    for name, here in describe_context(context).items():
        trained = card["context"].get(name)
        if trained == here:
            continue
        if name not in _GRID:
            raise ValueError(
                f"`weights`: the agent was trained with {name} = {trained}, "
                f"the environment has {here}"
            )
        known = getattr(trained_grid(card), name)
        if here[0] < known[0] * (1.0 - _ROUNDED) or here[-1] > known[-1] * (1.0 + _ROUNDED):
            raise ValueError(
                f"`weights`: the agent was trained with {name} from {known[0]:g} to {known[-1]:g}, "
                f"the environment has {here[0]:g} to {here[-1]:g}"
            )
