"""Training states on disk, so that a training that is killed goes on from its last checkpoint."""

from __future__ import annotations

import copy
import hashlib
import io
import json
import logging
import time
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from simulator.utils.cache import content_digest
from simulator.utils.files import write_atomically

_LOGGER = logging.getLogger(__name__)


def save_checkpoint(path: str | Path, state: Mapping[str, Any]) -> None:
    """Writes the state of a training with `torch.save`, whole or not at all.

    Where the file cannot be written, as on a full disk, a warning is logged, the previous
    checkpoint stays, and the training goes on.

    Args:
        path: The file; its folder is made.
        state: Tensors, numbers, text, and dicts and lists of them, such as state dicts.
    """
    content = io.BytesIO()
    torch.save(dict(state), content)
    try:
        write_atomically(path, content.getvalue())
    except OSError as error:
        _LOGGER.warning("checkpoint not saved, the one before stays: %s", error)


def load_checkpoint(path: str | Path) -> dict[str, Any] | None:
    """What `save_checkpoint` wrote, with its tensors on the CPU.

    Nothing but tensors and plain values is unpickled (``weights_only=True``), so a checkpoint from
    somebody else runs no code.

    Returns:
        The state; None where there is no file, and, with a warning in the log, where it is damaged.
    """
    path = Path(path)
    if not path.is_file():
        return None
    try:
        with zipfile.ZipFile(path) as archive:  # torch itself does not look at the checksums
            damaged = archive.testzip()
        if damaged is not None:
            raise ValueError(f"wrong checksum of {damaged}")
        state = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(state, dict):
            raise ValueError(f"it holds a {type(state).__name__}, not a dict")
    except Exception as error:  # zipfile, pickle and torch raise whatever damaged bytes lead to
        reason = str(error).strip().partition("\n")[0]
        _LOGGER.warning("checkpoint %s is damaged, training restarts: %s", path, reason)
        return None
    return state


# -- the former way, until no training uses it any more --
#: What reading a damaged file, or one of something else, ends in.
_UNFIT = (
    SafetensorError,
    OSError,
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    RuntimeError,
)


class HasState(Protocol):
    """A module, an optimiser or a schedule."""

    def state_dict(self) -> dict[str, Any]:
        """Its state."""

    def load_state_dict(self, state: dict[str, Any], /) -> Any:
        """Takes a state over."""


class Checkpoint:
    """Keeps the state of several objects and a step count in one safetensors file.

    Args:
        path: The file; None keeps nothing.
        parts: Modules, optimisers, schedules by name.
        interval: Least time between two saves [s].
        identity: JSON value that says what is trained and how; the state of another training is
            not taken over.
    """

    def __init__(
        self,
        path: Path | None,
        parts: Mapping[str, HasState],
        interval: float = 20.0,
        identity: Any = None,
    ) -> None:
        self.path, self.parts, self.interval = path, dict(parts), interval
        self._identity = json.loads(json.dumps(identity))
        self._saved = time.monotonic()

    def restore(self) -> int:
        """Takes over the state on disk; returns the steps done so far, 0 where there is none."""
        if self.path is None or not self.path.exists():
            return 0
        before = {name: copy.deepcopy(part.state_dict()) for name, part in self.parts.items()}
        try:
            with safe_open(self.path, framework="pt") as stored:
                tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
                metadata = stored.metadata() or {}
            if metadata.get("digest", "") not in ("", _digest(metadata["structure"], tensors)):
                raise ValueError("its content is not what was written")
            structure = json.loads(metadata["structure"])
            step = int(structure["step"])
            if structure["identity"] != self._identity:
                raise ValueError("it belongs to a training with other settings")
            lacking = [repr(name) for name in self.parts if name not in structure["parts"]]
            if lacking:
                raise ValueError(
                    f"it lacks {', '.join(lacking)}, as those of an earlier version do"
                )
            for name, part in self.parts.items():
                part.load_state_dict(_unflatten(structure["parts"][name], tensors))
        except _UNFIT as error:
            for name, part in self.parts.items():  # nothing of a half-restored state stays
                part.load_state_dict(before[name])
            _LOGGER.warning(
                "checkpoint %s does not fit, training begins anew: %s", self.path, error
            )
            return 0
        return step

    def save(self, step: int, *, force: bool = False) -> None:
        """Writes the state after `step` steps, unless the last save is too recent.

        Where it cannot be written, as on a full disk, that is logged, the state before it stays,
        and the training goes on.
        """
        if self.path is None or not (force or time.monotonic() - self._saved > self.interval):
            return
        tensors: dict[str, torch.Tensor] = {}
        parts = {name: _flatten(part.state_dict(), tensors) for name, part in self.parts.items()}
        structure = json.dumps({"step": step, "identity": self._identity, "parts": parts})
        metadata = {"structure": structure, "digest": _digest(structure, tensors)}
        try:
            write_atomically(self.path, save(tensors, metadata=metadata))
        except OSError as error:
            _LOGGER.warning(
                "checkpoint %s could not be written: %s; a training that is killed now goes on at "
                "the one before",
                self.path,
                error,
            )
        self._saved = time.monotonic()


def _digest(structure: str, tensors: Mapping[str, torch.Tensor]) -> str:
    text = f"{structure}{content_digest(tensors)}"
    return hashlib.sha256(text.encode()).hexdigest()


def _flatten(value: Any, tensors: dict[str, torch.Tensor]) -> Any:
    """`value` as JSON; its tensors go to `tensors` and are replaced by their names."""
    if isinstance(value, torch.Tensor):
        name = f"t{len(tensors)}"
        tensors[name] = value.detach().cpu().clone().contiguous()
        return {"tensor": name}
    if isinstance(value, Mapping):
        return {"map": [[key, _flatten(item, tensors)] for key, item in value.items()]}
    if isinstance(value, list | tuple):
        return {"list": [_flatten(item, tensors) for item in value]}
    return {"value": value}


def _unflatten(node: dict[str, Any], tensors: Mapping[str, torch.Tensor]) -> Any:
    if "tensor" in node:
        return tensors[node["tensor"]]
    if "map" in node:
        return {key: _unflatten(item, tensors) for key, item in node["map"]}
    if "list" in node:
        return [_unflatten(item, tensors) for item in node["list"]]
    return node["value"]
