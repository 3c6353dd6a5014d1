"""A bar on a terminal for what is waited for without having been asked for."""

from __future__ import annotations

import sys
import threading
import time
from types import TracebackType

#: Width of a bar [characters].
_WIDTH = 30
#: Least time between two pictures of it [s].
_PAUSE = 0.1


class Progress:
    """A progress bar on standard error, where that is a terminal; else nothing.

    Several threads may advance it. It is wiped out when it is closed.

    Args:
        title: What is done.
        total: Number of steps; 0 for no bar.
    """

    def __init__(self, title: str, total: int) -> None:
        self._title, self._total, self._done = title, total, 0
        self._shown, self._lock = -float("inf"), threading.Lock()

    def __enter__(self) -> Progress:
        self.show()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def advance(self) -> None:
        """One step more is done."""
        with self._lock:
            self._done = min(self._done + 1, self._total)
            if time.monotonic() >= self._shown + _PAUSE:
                self.show()

    @property
    def _shows(self) -> bool:
        stream = sys.stderr  # not another in its place, such as that of a bar of the program's own
        return bool(self._total and stream is not None and stream is sys.__stderr__) and (
            stream.isatty()
        )

    def close(self) -> None:
        """Wipes the bar out."""
        if self._shows:
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()

    def show(self) -> None:
        """Shows how far it is."""
        if not self._shows:
            return
        self._shown = time.monotonic()
        full = _WIDTH * self._done // self._total
        bar = "#" * full + "." * (_WIDTH - full)
        sys.stderr.write(f"\r{self._title} [{bar}] {self._done} of {self._total}")
        sys.stderr.flush()
