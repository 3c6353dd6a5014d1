"""Light that follows a list of the user's, frame by frame."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ae_env.lighting.base import MAX_STOPS, Lighting
from simulator.utils.checks import check_number

#: Most frames of a schedule.
MAX_FRAMES = 2**20


@dataclass(frozen=True)
class ScheduleLighting(Lighting):
    """The light changes by `ev[n]` stops in frame n, relative to the scene's; the last one holds.

    Args:
        ev: One number per frame, within +- `MAX_STOPS`: a list, a tuple or a one-dimensional
            array.
        file: In place of `ev`, a text file with one number per line, or a CSV with a column
            ``ev``.

    >>> ScheduleLighting(ev=[0, -1, 2]).gain(7, 0.01, 0.0)
    4.0
    """

    name: ClassVar[str] = "schedule"
    ev: Sequence[float] | np.ndarray | None = None
    file: str | Path | None = None

    def __post_init__(self) -> None:
        if (self.ev is None) == (self.file is None):
            raise ValueError(
                f"`lighting['ev']` (={self.ev!r}) or `lighting['file']` (={self.file!r}) must be "
                "given, and only one of them"
            )
        values = _numbers(self.ev) if self.file is None else _read(self.file)
        if not 1 <= len(values) <= MAX_FRAMES:
            raise ValueError(
                f"`lighting['ev']` (length {len(values)}) must have 1 to {MAX_FRAMES} numbers"
            )
        checked = tuple(
            check_number(f"lighting['ev'][{i}]", value, -MAX_STOPS, MAX_STOPS)
            for i, value in enumerate(values)
        )
        object.__setattr__(self, "ev", checked)

    def gain(self, frame: int, exposure_time: float, phase: float) -> float:
        """See `Lighting.gain`."""
        assert self.ev is not None
        return float(2.0 ** self.ev[min(frame, len(self.ev) - 1)])


def _numbers(ev: Any) -> list[Any]:
    if isinstance(ev, np.ndarray) and ev.ndim == 1:
        return list(ev)
    if isinstance(ev, Sequence) and not isinstance(ev, str | bytes):
        return list(ev)
    raise ValueError(f"`lighting['ev']` (={ev!r}) must be a list of numbers, one per frame")


def _read(file: Any) -> list[float]:
    """The numbers of a file.

    Raises:
        ValueError: If it cannot be read, or a row holds no finite number.
    """
    rule = f"`lighting['file']` (={str(file)!r})"
    if not isinstance(file, str | Path):
        raise ValueError(f"{rule} must be a path")
    try:
        text = Path(file).expanduser().read_text(encoding="utf-8-sig")
        rows = [row for row in csv.reader(text.splitlines()) if any(cell.strip() for cell in row)]
    except (OSError, UnicodeError, csv.Error, RuntimeError) as error:
        raise ValueError(f"{rule} cannot be read: {error}") from error
    header = [cell.strip() for cell in rows[0]] if rows else []
    column, first = 0, 0
    if "ev" in header:
        column, first = header.index("ev"), 1
    elif len(header) > 1:
        raise ValueError(f"{rule} (columns {header}) must have one column, or a column `ev`")
    values = []
    for number, row in enumerate(rows[first:], start=first + 1):
        cell = row[column].strip() if column < len(row) else ""
        try:
            values.append(float(cell))
        except ValueError:
            values.append(math.nan)
        if not math.isfinite(values[-1]):
            raise ValueError(f"{rule}, row {number} (={cell!r}), must be a number of stops")
    return values
