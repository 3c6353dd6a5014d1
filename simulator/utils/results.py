"""Result files: every measurement is written as ``{"meta": {...}, "rows": [...]}``."""

from __future__ import annotations

import datetime
import functools
import importlib.metadata
import json
import os
import platform
import subprocess
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from simulator.utils.files import write_atomically

#: Distribution that the three packages are installed as.
_PACKAGE = "ae-env"
#: Libraries that numbers depend on.
_LIBRARIES = (
    "torch",
    "numpy",
    "gymnasium",
    "stable-baselines3",
    "scikit-image",
    "rawpy",
)


def result_meta(command: str, seed: int | None) -> dict[str, Any]:
    """Where a measurement comes from: the ``meta`` of every result file.

    Args:
        command: The command line that writes the file again.
        seed: Seed of the run; None where nothing is random.

    Returns:
        A JSON-ready dict with the keys ``command``, ``commit`` (hash of the checkout, ending in
        ``+changes`` where files differ from it; None outside a checkout), ``seed``, ``date`` (UTC,
        ISO 8601), ``machine`` (``cpu``, ``cores``, ``threads``, ``gpu``) and ``versions``.
    """
    return {
        "command": command,
        "commit": _commit(),
        "seed": seed,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "machine": machine(),
        "versions": versions(),
    }


def write_results(
    path: str | os.PathLike[str],
    rows: Iterable[Mapping[str, Any]],
    meta: Mapping[str, Any],
) -> Path:
    """Write ``{"meta": meta, "rows": rows}`` as JSON, whole or not at all.

    Args:
        path: File to write; its folder is made where missing.
        rows: One mapping per row, JSON-ready; scalars and arrays of numpy and torch become numbers
            and lists.
        meta: As `result_meta` returns it, plus whatever describes this measurement.

    Returns:
        The path written.

    Raises:
        ValueError: If a value is NaN or infinite (JSON has no such number; write None) or of a
            type that JSON cannot hold.
    """
    try:
        text = json.dumps(
            {"meta": dict(meta), "rows": [dict(row) for row in rows]},
            indent=1,
            allow_nan=False,
            default=_plain,
        )
    except (TypeError, ValueError) as error:
        raise ValueError(f"`rows` and `meta` must hold finite JSON values: {error}") from None
    return write_atomically(path, text + "\n")


def machine() -> dict[str, Any]:
    """CPU model, cores this process may use, threads torch uses, name of the GPU or None."""
    import torch

    affinity = getattr(os, "sched_getaffinity", None)  # absent on macOS and Windows
    return {
        "cpu": _cpu_name(),
        "cores": len(affinity(0)) if affinity else os.cpu_count(),
        "threads": torch.get_num_threads(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }


@functools.cache
def package_version() -> str:
    """Version of this package; ``"0"`` where it is run without being installed."""
    return _version(_PACKAGE) or "0"


def versions() -> dict[str, str]:
    """Version of Python, of this package and of the installed libraries that numbers depend on."""
    found = {name: _version(name) for name in (_PACKAGE, *_LIBRARIES)}
    known = {name: version for name, version in found.items() if version is not None}
    return {"python": platform.python_version(), **known}


def _version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def _plain(value: Any) -> Any:
    """Scalars and arrays of numpy and torch as plain Python values."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not a JSON value")


def _cpu_name() -> str:
    """Model name of the CPU; the architecture where the system does not say."""
    table = Path("/proc/cpuinfo")  # of Linux
    for line in table.read_text(encoding="utf-8").splitlines() if table.is_file() else ():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def _commit() -> str | None:
    """Commit of the checkout that this package runs from; None where there is no checkout."""
    root = Path(__file__).resolve().parents[2]
    top = _git(root, "rev-parse", "--show-toplevel")
    # An installed copy may lie inside somebody else's repository.
    if top is None or Path(top).resolve() != root:
        return None
    commit = _git(root, "rev-parse", "--verify", "--quiet", "HEAD")
    if commit is None:
        return None
    changed = _git(root, "status", "--porcelain", "--untracked-files=no")
    return f"{commit}+changes" if changed else commit


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        result = subprocess.run(
            ["git", *arguments], cwd=folder, capture_output=True, text=True, timeout=10, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return result.stdout.strip() if result.returncode == 0 else None
