"""Parts of a run that are kept until all of it is done, so that one that was stopped goes on."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from benchmarks.throughput.isolated import ROOT
from simulator.files import write_atomically

T = TypeVar("T")
#: What a measurement depends on: kept parts count for the very same code alone.
_CODE = ("simulator", "ae_env", "benchmarks/throughput")


class Kept:
    """Results by name, one file each.

    Args:
        folder: Where to.
        words: What they depend on besides the code: seed and arguments.
    """

    def __init__(self, folder: Path, *words: Any) -> None:
        code = 0
        for name in _CODE:
            for path in sorted((ROOT / name).rglob("*.py")):
                code = zlib.crc32(path.read_bytes(), code)
        self._folder, self._words = folder, [code, *words]

    def __call__(self, name: str, make: Callable[[], T]) -> T:
        """What `make` returns, or has returned to an earlier run; JSON values."""
        key = zlib.crc32(json.dumps([*self._words, name]).encode())
        path = self._folder / f"{key:08x}.json"
        if not path.is_file():
            write_atomically(path, json.dumps(make()))
        return json.loads(path.read_text(encoding="utf-8"))

    def forget(self) -> None:
        """Removes everything that is kept, of earlier code too: the next run starts anew."""
        for path in self._folder.glob("*.json"):
            path.unlink()
