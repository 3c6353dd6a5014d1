"""Parts of a run that are kept until all of it is done, so that one that was stopped goes on."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from simulator.utils.files import write_atomically

T = TypeVar("T")
#: Folder of the repository.
ROOT = Path(__file__).resolve().parents[1]
#: Modules that only present what was measured.
_PRESENTING = ("report", "report_parts", "plots", "targets")


class Kept:
    """Results by name, one file each.

    Args:
        folder: Where to.
        words: What they depend on besides the code: seed, arguments, weights.
        code: Folders of the repository that they depend on; they count for the very same code.
    """

    def __init__(self, folder: Path, *words: Any, code: Sequence[str]) -> None:
        found = (path for name in code for path in (ROOT / name).rglob("*.py"))
        checksum = 0
        for path in sorted(path for path in found if path.stem not in _PRESENTING):
            checksum = zlib.crc32(path.read_bytes(), checksum)
        self._folder, self._words = folder, [checksum, *words]

    def __call__(self, name: str, make: Callable[[], T]) -> T:
        """What `make` returns, or has returned to an earlier run; JSON values."""
        key = zlib.crc32(json.dumps([*self._words, name]).encode())
        path = self._folder / f"{name.split()[0]}-{key:08x}.json"
        try:
            return json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):  # not there, or damaged
            text = json.dumps(make())
        write_atomically(path, text)
        return json.loads(text)

    def forget(self) -> None:
        """Removes everything that is kept, of earlier code too: the next run starts anew."""
        for path in self._folder.glob("*.json"):
            path.unlink(missing_ok=True)
