"""Trained agents on disk: safetensors for the numbers, JSON for everything else; no pickle."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn

from agents.policy import PolicyContext
from simulator.files import write_atomically

FORMAT_VERSION = 1


def save_agent(path: Path, kind: str, module: nn.Module, description: dict[str, Any]) -> None:
    """Writes ``path.safetensors`` and ``path.json``.

    Args:
        path: File name; its suffix is replaced.
        kind: ``"regression"`` or ``"ppo"``.
        module: Its state is stored.
        description: JSON values: what the agent expects to observe and how it was trained.
    """
    tensors = {
        name: value.detach().cpu().contiguous() for name, value in module.state_dict().items()
    }
    write_atomically(path.with_suffix(".safetensors"), save(tensors))
    card = {"format": FORMAT_VERSION, "kind": kind, **description}
    write_atomically(path.with_suffix(".json"), (json.dumps(card, indent=1) + "\n").encode())


def load_agent(path: str | Path, kind: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and description of an agent written by `save_agent`.

    Raises:
        FileNotFoundError: If one of the two files is missing; the message says which.
        ValueError: If a file is damaged, or holds another kind of agent.
    """
    path = Path(path).expanduser()
    card_path, tensor_path = path.with_suffix(".json"), path.with_suffix(".safetensors")
    for file in (tensor_path, card_path):
        if not file.is_file():
            raise FileNotFoundError(
                f"`weights` (={str(path)!r}): there is no {file.name}; an agent is a .safetensors "
                "and a .json file of the same name, as `ae-env train` writes them"
            )
    try:
        card = json.loads(card_path.read_text(encoding="utf-8"))
        tensors = load(tensor_path.read_bytes())
    except (json.JSONDecodeError, SafetensorError) as error:
        raise ValueError(f"`weights` (={str(path)!r}) cannot be read: {error}") from error
    if card.get("kind") != kind or card.get("format") != FORMAT_VERSION:
        raise ValueError(
            f"`weights` (={str(path)!r}) must be a {kind} agent of format {FORMAT_VERSION}, got "
            f"{card.get('kind')!r} of format {card.get('format')!r}"
        )
    return tensors, card


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
        if card["context"][name] != here:
            raise ValueError(
                f"`weights`: the agent was trained with {name} = {card['context'][name]}, "
                f"the environment has {here}"
            )
