import io
import sys

import pytest

from simulator.utils import progress as module
from simulator.utils.progress import Progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_bar_on_a_terminal_is_wiped_out_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = Terminal()
    monkeypatch.setattr(sys, "stderr", shown)
    monkeypatch.setattr(sys, "__stderr__", shown)
    monkeypatch.setattr(module, "_PAUSE", 0.0)
    with Progress("drawing", 4) as bar:
        for _ in range(6):  # more than was expected
            bar.advance()
    pictures = shown.getvalue().split("\r")
    assert pictures[1] == "drawing [..............................] 0 of 4"
    assert pictures[2] == "drawing [#######.......................] 1 of 4"
    assert pictures[-2].endswith(" 4 of 4")
    assert pictures[-1] == "\x1b[K"


@pytest.mark.parametrize("case", ["a file", "nothing to do", "in a program's own bar", "none"])
def test_else_nothing_is_written(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    shown = io.StringIO() if case == "a file" else Terminal()
    monkeypatch.setattr(sys, "stderr", None if case == "none" else shown)
    monkeypatch.setattr(sys, "__stderr__", Terminal() if "bar" in case else shown)
    with Progress("drawing", 0 if case == "nothing to do" else 4) as bar:
        bar.advance()
    assert shown.getvalue() == ""
