"""Trained agents on disk: safetensors for the numbers, JSON for everything else; no pickle."""

import reprlib
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from pydantic import AliasPath, BaseModel, Field, ValidationError
from torch import Tensor, nn

from ae_env.grid import ExposureGrid
from agents.policy import Bools, Floats, Ints, Policy, PolicyContext, masked_argmax
from simulator.networks.weights import load_into, read_pair, write_pair
from simulator.utils.checks import check_type
from simulator.utils.config_file import one_line
from simulator.utils.files import sibling

FORMAT_VERSION = 1
#: Most hidden features of a network, and most frames that it remembers.
MAX_WIDTH, MAX_HISTORY = 65536, 256
#: Where a card has its agent's history.
_HISTORY = AliasPath("training", "training", "history")
#: Entries of a card's context that describe the grid.
_GRID = ("isos", "exposure_times", "f_numbers")
#: Nominal values are rounded: 1/1000 s stands for 1/1024 s.
_ROUNDED = 0.03


class _Context(BaseModel, strict=True):
    """What an agent was trained for, as far as its card says."""

    resolution: list[int] = []
    observation: str = ""
    sensors: bool = True
    isos: list[float] = []
    exposure_times: list[float] = []
    f_numbers: list[float] = []


class _Card(BaseModel):
    """Entries that every card must have; `history` is of a PPO's hyperparameters."""

    width: int = Field(strict=True, ge=1, le=MAX_WIDTH)
    context: _Context
    training: dict[str, Any]
    aliases: dict[str, str]
    history: int = Field(0, strict=True, ge=0, le=MAX_HISTORY, validation_alias=_HISTORY)


def save_agent(
    path: Path,
    kind: str,
    module: nn.Module,
    width: int,
    context: PolicyContext | None,
    training: dict[str, Any],
) -> None:
    """Writes ``path.safetensors``, the state of `module`, and ``path.json``, which describes it.

    `context` is that it was trained for, None if for any, and `training` are JSON values that
    identify the training. Weights that are not finite are a `ValueError`, and nothing is written.
    """
    tensors: dict[str, Tensor] = {}
    aliases: dict[str, str] = {}  # SB3's policies hold one features extractor under three names
    stored: dict[tuple[int, torch.Size], str] = {}
    for name, value in module.state_dict().items():
        source = stored.setdefault((value.data_ptr(), value.shape), name)
        if source == name:
            tensors[name] = value
        else:
            aliases[name] = source
    described = {} if context is None else describe_context(context)
    card = {"format": FORMAT_VERSION, "kind": kind, "width": width, "context": described}
    write_pair(path, tensors, {**card, "training": training, "aliases": aliases})


def load_agent(path: str | Path, kind: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and description of an agent written by `save_agent`.

    Raises:
        FileNotFoundError: If one of the two files is missing; the message says which.
        ValueError: If a file is damaged or cannot be read, the two are not of one training, or they
            hold another kind of agent.
    """
    given, card_path = f"`weights` (={str(path)!r})", sibling(path, ".json")
    for file in (sibling(path, ".safetensors"), card_path):
        if not file.is_file():
            raise FileNotFoundError(
                f"{given}: there is no {file.name}; an agent is a .safetensors and a .json file of "
                "the same name, as `ae-env train` writes them"
            )
    tensors, card = read_pair(path)
    found = card.get("kind", card.get("preset")), card.get("format")  # else the simulator's
    if found != (kind, FORMAT_VERSION):
        wanted = f"a {kind} agent of format {FORMAT_VERSION}"
        got = " of format ".join(map(reprlib.repr, found))
        raise ValueError(f"{given} must be {wanted}, got {got}")
    try:
        known = _Card.model_validate(card)
    except ValidationError as error:
        raise ValueError(f"{given}: {card_path.name}: {one_line(error)}") from error
    copies = {name: tensors[source] for name, source in known.aliases.items() if source in tensors}
    return tensors | copies, card | {"history": known.history}


def describe_context(context: PolicyContext) -> dict[str, Any]:
    """Everything that a network's shape and meaning depend on, as JSON values."""
    raw = context.observation_space["raw"]
    return {
        "observation": str(raw.dtype),
        "resolution": list(raw.shape or ()),
        "sensors": context.has_sensors,
        **{name: list(getattr(context.grid, name)) for name in _GRID},
    }


def trained_grid(card: dict[str, Any]) -> ExposureGrid:
    """The grid that an agent was trained on, from its `card`."""
    return ExposureGrid.from_spec({name: card["context"].get(name, ()) for name in _GRID})


def check_context(card: dict[str, Any], context: PolicyContext) -> None:
    """Raises a `ValueError` that says what differs unless the agent of `card` fits `context`.

    Any grid whose values lie within the trained ranges works: states enter networks as numbers.
    """
    for name, here in describe_context(context).items():
        trained = card["context"].get(name)
        differs, values = trained != here, f"= {reprlib.repr(trained)}, the environment has {here}"
        if differs and name in _GRID:
            known = getattr(trained_grid(card), name)
            below, above = known[0] * (1.0 - _ROUNDED), known[-1] * (1.0 + _ROUNDED)
            differs = here[0] < below or here[-1] > above
            ends = f"{here[0]:g} to {here[-1]:g}"
            values = f"from {known[0]:g} to {known[-1]:g}, the environment has {ends}"
        if differs:
            raise ValueError(f"`weights`: the agent was trained with {name} {values}")


class NetworkPolicy(Policy, ABC):
    """Base of the policies that a trained network decides.

    Give `weights`, a file that a training wrote, for the torch `device`; or `network`, in memory. A
    `ValueError` unless it was trained for such an observation, and a grid with the context's range.
    """

    #: The name of this kind of agent in its files.
    kind: ClassVar[str]
    #: What a state must promise beyond the last one to replace it: else still frames may swing.
    hysteresis: ClassVar[float]

    def __init__(
        self,
        context: PolicyContext,
        weights: str | Path | None = None,
        network: nn.Module | None = None,
        device: str = "cpu",
    ) -> None:
        super().__init__(context)
        self.name = self.kind
        check_type("network", network, nn.Module, None)
        if (weights is None) == (network is None):
            raise ValueError("give either `weights` or `network`")
        if network is None:
            tensors, card = load_agent(str(weights), self.kind)
            check_context(card, context)
            network = self.make_network(context, card)
            load_into(network, tensors, f"`weights` (={str(weights)!r})")
            network.to(device)
        self.network: Any = network.eval()
        self.reset(0)

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Forgets the frames so far."""
        super().reset(num_envs, seed)
        self._asked = np.full(num_envs, -1)  # the last decisions

    def _choose(self, utility: Floats, action_masks: Bools | None) -> Ints:
        """The best allowed state (N,) by `utility` (N, S), which gets the hysteresis."""
        known = np.flatnonzero(self._asked >= 0)
        utility[known, self._asked[known]] += self.hysteresis
        self._asked = masked_argmax(utility, action_masks)
        return self._asked.copy()

    @staticmethod
    @abstractmethod
    def make_network(context: PolicyContext, card: dict[str, Any]) -> nn.Module:
        """The untrained network that the weights of an agent of this kind, of `card`, fit."""
