"""What an evaluation has finished, kept in files so that a second run goes on."""

from __future__ import annotations

import hashlib
import io
import json
import logging
import os
import zipfile
from collections.abc import Mapping
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from agents.evaluation.evaluation_plan import digest
from agents.policy import split_name, training_seeds
from simulator.utils.files import sibling, write_atomically

logger = logging.getLogger(__name__)

#: Bumped when what a file holds changes.
_VERSION = 1
#: Python files beside one's own that count as parts of it.
_MAX_NEIGHBOURS = 200
_ROOT = Path(__file__).resolve().parents[2]
#: Modules that only show results: a change of theirs leaves what was measured as it is.
_SHOWING = ("ae_bench", "commands", "plan_jobs", "ranking", "result_table", "statistics")
_COMMANDS = ("cli", "console", "rendering", "scorer_commands")


class EvaluationStore:
    """Finished parts of an evaluation, one ``.npz`` each, without pickles.

    Args:
        folder: Made where missing.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)

    def path(self, key: str) -> Path:
        """File of a part."""
        return self.folder / f"{key}.npz"

    def has(self, key: str) -> bool:
        """Whether the part is there, whole and readable."""
        return self.load(key) is not None

    def load(self, key: str) -> tuple[dict[str, np.ndarray], dict[str, Any]] | None:
        """Arrays and JSON values of a part; None where there is none, or it is damaged."""
        file = self.path(key)
        try:
            # All of it first: of a damaged file, NumPy leaves the handle open.
            with np.load(io.BytesIO(file.read_bytes()), allow_pickle=False) as content:
                arrays = {name: content[name] for name in content.files}
            return arrays, json.loads(str(arrays.pop("meta")))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            logger.warning("%s is damaged and is made anew: %s", file, error)
            return None

    def save(self, key: str, arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> Path:
        """Writes a part: whole, or not at all."""
        stream = io.BytesIO()
        text = np.array(json.dumps(dict(meta), sort_keys=True))
        content: dict[str, Any] = {"meta": text, **arrays}
        np.savez_compressed(stream, **content)
        return write_atomically(self.path(key), stream.getvalue())


def part_key(kind: str, *parts: object) -> str:
    """Name of a part: its kind and a hash of all that decides its content."""
    return f"{kind}-{digest(_VERSION, *parts)[:32]}"


def policy_content(name: str) -> str:
    """Hash of what decides a policy beside its name: its file or module, weights and folders.

    With a Python file, all of its folder count, since it may import them; data that it reads is
    not known.

    Args:
        name: As `agents.make_policy` takes it; a scorer's name or a file's will do as well.
    """
    base, options = split_name(name)
    files = _own_files(base) or _named_files(base)
    for value in options.values():
        files += _named_files(str(value))
    return _files_digest(files) if files else ""


def _own_files(base: str) -> list[Path]:
    head, _, tail = base.rpartition(":") if ".py:" in base else base.partition(":")
    if head.endswith(".py"):
        return _with_neighbours(Path(head).expanduser())
    if head in ("ppo", "regression"):
        weights = tail or training_seeds(head)[0].partition(":")[2]
        return _named_files(weights)
    if head == "recorded":
        return _named_files(tail)
    if tail and "." in head:
        try:
            found = find_spec(head)
        except (ImportError, ValueError):
            found = None
        if found is not None and found.origin is not None:
            return _with_neighbours(Path(found.origin))
    return []


def _with_neighbours(file: Path) -> list[Path]:
    """A Python file, and the first `_MAX_NEIGHBOURS` others of its folder by name."""
    others = sorted(other for other in file.parent.glob("*.py") if other.name != file.name)
    return [file, *(o for o in others[:_MAX_NEIGHBOURS] if os.access(o, os.R_OK))]


def _named_files(text: str) -> list[Path]:
    """The file of this name, the two of an agent, or all in a folder; none where there is none."""
    path = Path(text).expanduser()
    if path.is_dir():
        return sorted(file for file in path.rglob("*") if file.is_file())
    pair = [sibling(path, end) for end in (".safetensors", ".json")] if path.name else []
    return [file for file in (path, *pair) if file.is_file()]


@lru_cache(maxsize=1)
def code_digest() -> str:
    """Hash of the source that measurements come from: other code, other parts."""
    files = [
        file
        for package in ("simulator", "ae_env", "agents")
        for file in sorted((_ROOT / package).rglob("*.py"))
        if not (package == "agents" and (file.stem in _SHOWING or file.parent.name == "report"))
        and not (package == "ae_env" and file.stem in _COMMANDS)
    ]
    return _files_digest(files)


def _place(file: Path) -> str:
    """Name of a file that is the same wherever the packages are installed."""
    return str(file.relative_to(_ROOT)) if file.is_relative_to(_ROOT) else file.name


def _files_digest(files: list[Path]) -> str:
    found = hashlib.sha256()
    for file in files:
        content = file.read_bytes() if file.is_file() else b""
        found.update(f"{_place(file)}\0{len(content)}\0".encode() + content)
    return found.hexdigest()
