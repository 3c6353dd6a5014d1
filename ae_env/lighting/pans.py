"""How the light that a camera sees changes as it turns in real places.

``pans.csv`` has a line for each public panorama (CC0) of the test split of
`ae_env.scenes.polyhaven`: its name and what `light_around` finds, the mean light of 72 directions,
5 degrees apart [EV].
"""

from __future__ import annotations

import csv
from importlib.resources import files


def _read() -> dict[str, tuple[float, ...]]:
    text = (files("ae_env.lighting") / "pans.csv").read_text(encoding="utf-8")
    return {line[0]: tuple(map(float, line[1:])) for line in csv.reader(text.splitlines())}


#: EV of each direction, by the panorama's name.
PANS = _read()
