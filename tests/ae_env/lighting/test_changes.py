"""Light that changes by a rule, and lightings by name."""

import json
import math
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ae_env.lighting import KINDS, MAX_STOPS, Lighting, StepLighting, make_lighting
from tests.strategies import log_uniform


def _gains(spec: object, frames: int = 14, phase: float = 0.0) -> list[float]:
    lighting = make_lighting(spec)  # type: ignore[arg-type]
    return [lighting.gain(frame, 0.01, phase) for frame in range(frames)]


@pytest.mark.parametrize(
    ("spec", "stops"),
    [
        ({"kind": "step", "stops": 3, "at": 2}, [0, 0, 3, 3]),
        ({"kind": "ramp", "stops": -2, "stops_per_frame": 0.5}, [0, -0.5, -1, -1.5, -2, -2, -2]),
        (
            {"kind": "tunnel", "stops": -6, "enter": 2, "leave": 6, "edge": 2},
            [0, 0, 0, -3, -6, -6, -6, -3, 0, 0],
        ),
        # It begins after the named frame, or without an edge at it.
        ({"kind": "tunnel", "enter": 2, "leave": 5, "edge": 0}, [0, 0, -6, -6, -6, 0, 0, 0]),
        ({"kind": "tunnel", "enter": 2, "leave": 5, "edge": 1}, [0, 0, 0, -6, -6, -6, 0, 0]),
        ({"kind": "lens_cap", "on": 1, "off": 3}, [0, -20, -20, 0]),
    ],
)
def test_light_follows_its_rule(spec: dict[str, Any], stops: list[float]) -> None:
    assert _gains(spec, len(stops)) == pytest.approx([2.0**s for s in stops], rel=1e-12)


def test_sine_has_its_period_amplitude_and_phase() -> None:
    spec = {"kind": "sine", "stops": 2, "period": 8}
    stops = [math.log2(g) for g in _gains(spec, 9)]
    assert stops[::2] == pytest.approx([0, 2, 0, -2, 0], abs=1e-9)
    shifted = [math.log2(g) for g in _gains(spec, 7, phase=0.25)]
    assert shifted == pytest.approx(stops[2:9])


@pytest.mark.parametrize("frame", [5.0, np.float32(5), np.int64(5)])
def test_whole_numbers_are_frames(frame: float) -> None:
    lighting = make_lighting({"kind": "step", "at": frame})
    assert lighting == StepLighting(at=5)
    assert type(lighting.at) is int  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("stepp", "did you mean 'step'"),
        ({"stops": 3}, r"`lighting` \(={'stops': 3}\) needs a 'kind', one of"),
        ({"kind": "step", "stop": 3}, "did you mean 'stops'"),
        ({"kind": "step", "stops": math.nan}, r"`lighting\['stops'\]` \(=nan\) must be a number"),
        ({"kind": "step", "stops": -2000}, r"`lighting\['stops'\]` \(=-2000\) .*\[-64, 64\]"),
        ({"kind": "step", "stops": "4"}, r"`lighting\['stops'\]` \(='4'\)"),
        ({"kind": "step", "at": True}, r"`lighting\['at'\]` \(=True\) must be an integer"),
        ({"kind": "step", "at": 1.5}, r"`lighting\['at'\]` \(=1.5\) must be an integer"),
        ({"kind": "step", "at": math.nan}, r"`lighting\['at'\]` \(=nan\) must be an integer"),
        ({"kind": "step", "at": 2.0**32}, r"`lighting\['at'\]`"),
        ({"kind": "sine", "period": 0}, r"`lighting\['period'\]` \(=0\)"),
        ({"kind": "ramp", "stops_per_frame": math.inf}, r"`lighting\['stops_per_frame'\]`"),
        ({"kind": "ramp", "stops_per_frame": -1}, r"'stops_per_frame'\]` \(=-1\) .*\[0, 64\]"),
        ({"kind": "tunnel", "edge": -1}, r"`lighting\['edge'\]` \(=-1\) must be an integer in \[0"),
        ({"kind": "tunnel", "enter": 5, "leave": 4}, r"'leave'.*\(=4\).*'enter'.*\(=5\)"),
        ({"kind": "lens_cap", "on": 6}, r"'off'.*\(=5\).*'on'.*\(=6\)"),
        ({"kind": "flicker", "frequency": 0}, r"'frequency'\]` \(=0\) must be a number in \[0.001"),
        ({"kind": "flicker", "frequency": None}, "frequency"),
        ({"kind": "flicker", "depth": 1.5}, r"'depth'\]` \(=1.5\) must be a number in \[0, 1\]"),
        ({"kind": "flicker", "duty": 0}, "duty"),
        ({"kind": "flicker", "duty": True}, "duty"),
        ({"kind": "flicker", "frame_rate": 0.0}, "frame_rate"),
        ({"kind": ["step"]}, "must be one of"),
        (None, r"`lighting` \(=None\)"),
    ],
)
def test_bad_lightings_are_refused(spec: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_lighting(spec)  # type: ignore[arg-type]


def test_a_subclass_is_known_by_its_name() -> None:
    class Dimmed(Lighting):
        name = "test_dimmed"

        def gain(self, frame: int, exposure_time: float, phase: float) -> float:
            return 0.5

    try:
        assert _gains("test_dimmed", 2) == [0.5, 0.5]
        assert _gains("static", 2) == [1.0, 1.0]
    finally:
        del KINDS["test_dimmed"]


@st.composite
def lightings(draw: st.DrawFn) -> dict[str, Any]:
    """Any lighting in its range."""
    stops, frames = st.floats(-MAX_STOPS, MAX_STOPS), st.integers(-(2**31), 2**31)
    values = {"period": log_uniform(1e-3, 2**31), "stops": stops}
    values |= {"stops_per_frame": st.floats(0, MAX_STOPS), "edge": st.integers(0, 2**31)}
    values |= {"frequency": log_uniform(1e-3, 1e6), "frame_rate": log_uniform(1e-3, 1e6)}
    values |= {"depth": st.floats(0, 1), "duty": st.none() | st.floats(1e-6, 1)}
    values |= {"ev": st.lists(stops, min_size=1, max_size=3), "file": st.none()}
    kind = draw(st.sampled_from(sorted(KINDS)))
    drawn = {f.name: draw(values.get(f.name, frames)) for f in fields(KINDS[kind])}
    for first, last in (("enter", "leave"), ("on", "off")):
        if first in drawn:
            drawn[first], drawn[last] = sorted((drawn[first], drawn[last]))
    return {"kind": kind, **drawn}


@given(
    lightings(),
    st.integers(0, 2**31 - 1),
    log_uniform(1e-5, 100),
    st.floats(0, 1, exclude_max=True),
)
def test_light_is_positive_and_finite_in_every_frame(
    spec: dict[str, Any], frame: int, exposure_time: float, phase: float
) -> None:
    lighting = make_lighting(spec)
    gain = lighting.gain(frame, exposure_time, phase)
    assert 0.0 < gain < math.inf
    known = {"flicker": MAX_STOPS, "schedule": max(map(abs, spec.get("ev", [0.0])))}
    most = known.get(spec["kind"], abs(spec.get("stops", 0.0)))
    assert abs(math.log2(gain)) <= most + 1e-9
    assert make_lighting(json.loads(json.dumps(spec))) == lighting
