"""Training states on disk, so that a training that is killed goes on from its last checkpoint."""

import json
import logging
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Self

import torch

from simulator import __version__
from simulator.utils.cache import DAMAGE, decode, encode
from simulator.utils.files import write_atomically

_LOGGER = logging.getLogger(__name__)
#: Least time between two checkpoints of a training [s].
INTERVAL = 20.0


class Checkpoint:
    """The checkpoint of one training, written now and then while the training runs.

    Used as a context manager around the training loop, it also writes the state when the loop ends
    and when Ctrl-C or SIGTERM ends it. After an error it writes nothing: the state may be wrong.

    Args:
        path: The file; None writes and reads nothing.
        identity: JSON value that says what is trained and how. A checkpoint of another training, or
            of another version of this package, is not resumed but replaced.
        state: Gives the state to write: tensors, plain values, and dicts and lists of them.
        writes: False in the processes of a distributed training that only read.
    """

    def __init__(
        self,
        path: Path | None,
        identity: Any,
        state: Callable[[], Mapping[str, Any]],
        *,
        writes: bool = True,
    ) -> None:
        self.path, self.state, self.writes = path, state, writes
        # Through JSON, as tuples compare unequal to the lists that they come back as.
        self.identity = json.dumps({"version": __version__, "training": identity}, sort_keys=True)
        self._saved = time.monotonic()

    def load(self) -> dict[str, Any] | None:
        """The state to resume from, tensors on the CPU; None if there is no file that fits.

        Nothing is unpickled: a checkpoint of others runs no code.
        """
        if self.path is None or not self.path.is_file():
            return None
        try:
            stored = decode(self.path.read_bytes())
            identity, state = stored["identity"], _unpacked(stored["state"], stored)
        except (OSError, *DAMAGE) as error:
            reason = str(error).strip().partition("\n")[0]
            _LOGGER.warning("checkpoint %s is damaged, training restarts: %s", self.path, reason)
            return None
        if identity != self.identity:
            text = "checkpoint %s is of other settings or of another version: training restarts"
            _LOGGER.warning(text, self.path)
            return None
        return state

    def save(self) -> None:
        """Writes the state; on a full disk the previous one stays, with a warning in the log."""
        if self.path is not None and self.writes:
            tensors: dict[str, torch.Tensor] = {}
            state = _packed(dict(self.state()), tensors)
            try:
                write_atomically(
                    self.path, encode({"identity": self.identity, "state": state, **tensors})
                )
            except OSError as error:
                _LOGGER.warning("checkpoint not saved, the one before stays: %s", error)
        self._saved = time.monotonic()

    def save_when_due(self) -> None:
        """Writes the state if the last one is `INTERVAL` seconds old."""
        if time.monotonic() - self._saved > INTERVAL:
            self.save()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None or issubclass(kind, KeyboardInterrupt | SystemExit):
            self.save()


def _packed(value: Any, tensors: dict[str, torch.Tensor]) -> Any:
    """`value` for JSON: each tensor goes to `tensors`, what is no JSON value says what it is."""
    if isinstance(value, torch.Tensor):
        name = str(len(tensors))
        tensors[name] = value.detach().cpu().contiguous().clone()
        return {"tensor": name}
    if isinstance(value, Mapping):  # keys may be numbers
        return {"items": [[key, _packed(own, tensors)] for key, own in value.items()]}
    if isinstance(value, list | tuple):
        return {type(value).__name__: [_packed(own, tensors) for own in value]}
    if value is None or isinstance(value, str | int | float):
        return value
    raise TypeError(f"a checkpoint holds tensors and plain values, not {type(value).__name__}")


def _unpacked(value: Any, tensors: Mapping[str, torch.Tensor]) -> Any:
    if not isinstance(value, dict):
        return value
    ((kind, own),) = value.items()
    if kind == "tensor":
        return tensors[own]
    if kind == "items":
        return {key: _unpacked(part, tensors) for key, part in own}
    parts = [_unpacked(part, tensors) for part in own]
    return tuple(parts) if kind == "tuple" else parts
