"""What a training reported on its way, in a CSV file beside the agent."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from simulator.utils.files import write_atomically

#: Rows of a whole training.
ROWS = 200


class LearningCurve:
    """Writes the mean of each reported value over every 200th part of a training.

    A training that was interrupted goes on in its file.

    Args:
        path: File to write, such as ``agent.csv``.

    Raises:
        ValueError: If there is a file that is no learning curve.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        known = load_curve(path) if path.is_file() else {}
        self._rows = [
            dict(zip(known, row, strict=True)) for row in zip(*known.values(), strict=True)
        ]
        self._recent: list[dict[str, float]] = []

    def __call__(self, done: int, total: int, values: dict[str, float]) -> None:
        """Take in what the training reports after `done` of `total` frames."""
        # What another training left here, or this one after its checkpoint.
        while self._rows and not self._goes_on(done, values):
            self._rows.pop()
        self._recent.append(values)
        last = self._rows[-1]["frames"] if self._rows else 0
        if done != total and done - last < total / ROWS:
            return
        means = {name: float(np.mean([v[name] for v in self._recent])) for name in values}
        self._rows.append({"frames": done, **means})
        self._recent = []
        text = io.StringIO()
        writer = csv.DictWriter(text, self._rows[-1], lineterminator="\n")
        writer.writeheader()
        for row in self._rows:
            shown = {name: f"{value:.6g}" for name, value in row.items()}
            writer.writerow({**shown, "frames": int(row["frames"])})
        write_atomically(self.path, text.getvalue())

    def _goes_on(self, done: int, values: dict[str, float]) -> bool:
        """Whether the last row is of this training, from before `done` frames."""
        last = self._rows[-1]
        return last["frames"] < done and last.keys() == {"frames", *values}


def load_curve(path: Path) -> dict[str, list[float]]:
    """Columns of a file that `LearningCurve` wrote: ``frames`` and the reported values.

    Raises:
        ValueError: If it is no such file.
    """
    try:
        rows = list(csv.DictReader(path.read_text().splitlines()))
        curve = {name: [float(row[name]) for row in rows] for name in (rows[0] if rows else ())}
    except (TypeError, ValueError, KeyError) as error:
        raise ValueError(f"{path} is not a learning curve of `ae-env train`") from error
    if "frames" not in curve:
        raise ValueError(f"{path} is not a learning curve of `ae-env train`")
    return curve
