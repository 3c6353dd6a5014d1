"""Light that follows a list or a file."""

import json
from pathlib import Path

import numpy as np
import pytest

from ae_env.lighting import make_lighting


def _gains(spec: dict[str, object], frames: int) -> list[float]:
    lighting = make_lighting({"kind": "schedule", **spec})
    return [lighting.gain(frame, 0.01, 0.4) for frame in range(frames)]


@pytest.mark.parametrize(
    "ev", [[0, -1, 2.0], (0, -1, 2), np.array([0, -1, 2]), np.array([0, -1, 2], np.float32)]
)
def test_each_frame_has_its_stops_and_the_last_holds(ev: object) -> None:
    assert _gains({"ev": ev}, 5) == [1.0, 0.5, 4.0, 4.0, 4.0]
    same = make_lighting(json.loads('{"kind": "schedule", "ev": [0, -1, 2]}'))
    assert make_lighting({"kind": "schedule", "ev": ev}) == same


@pytest.mark.parametrize(
    "text",
    ["0\n-1\n2\n", "\ufeff 0 \n\n-1\n2", "ev\n0\n-1\n2\n", "frame,ev,note\n0,0,a\n1,-1,b\n2,2,c\n"],
)
def test_it_is_read_from_a_file(tmp_path: Path, text: str) -> None:
    (tmp_path / "light.csv").write_text(text, encoding="utf-8")
    assert _gains({"file": str(tmp_path / "light.csv")}, 4) == [1.0, 0.5, 4.0, 4.0]


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ({}, r"`lighting\['ev'\]` \(=None\) or `lighting\['file'\]` \(=None\) must be given"),
        ({"ev": [0], "file": "light.csv"}, "only one of them"),
        ({"ev": []}, r"length 0\) must have 1 to"),
        ({"ev": [0, 65]}, r"`lighting\['ev'\]\[1\]` \(=65\) must be a number in \[-64, 64\]"),
        ({"ev": [float("nan")]}, r"'ev'\]\[0\]` \(=nan\)"),
        ({"ev": [0, "1"]}, r"'ev'\]\[1\]` \(='1'\)"),
        ({"ev": "0 1"}, "must be a list of numbers"),
        ({"ev": 3}, "must be a list of numbers"),
        ({"ev": np.zeros((2, 2))}, "must be a list of numbers"),
        ({"file": "missing.csv"}, r"`lighting\['file'\]` \(='missing.csv'\) cannot be read"),
        ({"file": 3}, "must be a path"),
        # The text of a file.
        ("ev\n", "length 0"),
        ("0\none\n", r"row 2 \(='one'\), must be a number of stops"),
        ("0\ninf\n", "row 2"),
        ("a,b\n1,2\n", r"columns \['a', 'b'\]\) must have one column, or a column `ev`"),
        ("frame,ev\n0,1\n1\n", r"row 3 \(=''\)"),
        ("0\n70\n", r"'ev'\]\[1\]` \(=70.0\)"),
    ],
)
def test_bad_schedules_are_refused(tmp_path: Path, spec: object, message: str) -> None:
    if isinstance(spec, str):
        (tmp_path / "light.csv").write_text(spec)
        spec = {"file": tmp_path / "light.csv"}
    with pytest.raises(ValueError, match=message):
        make_lighting({"kind": "schedule", **spec})
