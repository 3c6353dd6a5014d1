"""Light that changes by a rule, follows a list or a file, flickers, or is drawn by an episode."""

import json
import math
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ae_env.lighting import KINDS, MAX_STOPS, Lighting, RollingShutter, make_lighting
from ae_env.lighting.moving import KIND_SETS, MOVES
from simulator.optics.flicker_integral import MainsLamp, PulsedLamp
from tests.strategies import log_uniform


def _gains(spec: object, frames: int, phase: float = 0.0) -> list[float]:
    lighting = make_lighting(spec)
    return [lighting.gain(frame, 0.01, phase) for frame in range(frames)]


@pytest.mark.parametrize(
    ("spec", "stops"),
    [
        *(({"kind": "step", "stops": 3, "at": at}, [0, 0, 3, 3]) for at in (2, 2.0, np.int64(2))),
        ({"kind": "ramp", "stops": -2, "stops_per_frame": 0.5}, [0, -0.5, -1, -1.5, -2, -2, -2]),
        (
            {"kind": "tunnel", "stops": -6, "enter": 2, "leave": 6, "edge": 2},
            [0, 0, 0, -3, -6, -6, -6, -3, 0, 0],
        ),
        # It begins after the named frame, or without an edge at it.
        ({"kind": "tunnel", "enter": 2, "leave": 5, "edge": 0}, [0, 0, -6, -6, -6, 0, 0, 0]),
        ({"kind": "tunnel", "enter": 2, "leave": 5, "edge": 1}, [0, 0, 0, -6, -6, -6, 0, 0]),
        ({"kind": "lens_cap", "on": 1, "off": 3}, [0, -20, -20, 0]),
        ({"kind": "sine", "stops": 2, "period": 4}, [0, 2, 0, -2, 0]),
    ],
)
def test_light_follows_its_rule(spec: dict[str, Any], stops: list[float]) -> None:
    assert _gains(spec, len(stops)) == pytest.approx([2.0**s for s in stops], rel=1e-12)
    sine = {"kind": "sine", "stops": 2, "period": 8}
    assert _gains(sine, 5, phase=0.25) == pytest.approx(_gains(sine, 7)[2:])


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        *(("stepp", "did you mean 'step'"), (None, "`lighting`"), ({"stops": 3}, "'kind'")),
        ({"kind": "step", "stop": 3}, "did you mean 'stops'"),
        *(({"kind": "step", "stops": v}, r"`lighting\['stops'\]`") for v in (math.nan, -2000)),
        *(({"kind": "step", "at": v}, r"`lighting\['at'\]`") for v in (True, 1.5, 2.0**32)),
        *(({"kind": "sine", "period": 0}, "'period'"), ({"kind": "tunnel", "edge": -1}, "'edge'")),
        ({"kind": "ramp", "stops_per_frame": -1}, "'stops_per_frame'"),
        ({"kind": "tunnel", "enter": 5, "leave": 4}, "'leave'.*'enter'"),
        ({"kind": "lens_cap", "on": 6}, "'off'.*'on'"),
        *(({"kind": "flicker", "frequency": value}, "'frequency'") for value in (0, None)),
        *(({"kind": "flicker", "depth": 1.5}, "'depth'"), ({"kind": "flicker", "duty": 0}, "duty")),
        *(({"kind": kind, "frame_rate": 0.0}, "frame_rate") for kind in ("flicker", "moving")),
        ({"kind": "moving", "kinds": "tunnel"}, "did you mean 'tunnels'"),
        ({"kind": "moving", "kinds": []}, "kinds"),
        *(({"kind": "schedule", "ev": ev}, "'ev'") for ev in (None, [], "0 1", np.zeros((2, 2)))),
        *(({"kind": "schedule", "ev": [0, v]}, r"'ev'\]\[1\]") for v in (65, math.nan)),
        ({"kind": "schedule", "ev": [0], "file": "light.csv"}, "only one of them"),
        ({"kind": "schedule", "file": "missing.csv"}, "cannot be read"),
        ({"kind": "static", "foo": 1}, "'foo': it has none"),
        # The text of a file of a schedule.
        *(("ev\n", "length 0"), ("0\none\n", "row 2"), ("0\ninf\n", "row 2")),
        *(("a,b\n1,2\n", "columns"), ("frame,ev\n0,1\n1\n", "row 3")),
    ],
)
def test_bad_lightings_are_refused(tmp_path: Path, spec: Any, message: str) -> None:
    if isinstance(spec, str) and "\n" in spec:
        (tmp_path / "light.csv").write_text(spec)
        spec = {"kind": "schedule", "file": tmp_path / "light.csv"}
    with pytest.raises(ValueError, match=message):
        make_lighting(spec)


def test_a_subclass_is_known_by_its_name() -> None:
    class Dimmed(Lighting):
        name = "test_dimmed"

        def gain(self, frame: int, exposure_time: float, phase: float) -> float:
            return 0.5

    found = _gains("test_dimmed", 2), _gains("static", 2)
    del KINDS["test_dimmed"]
    assert found == ([0.5, 0.5], [1.0, 1.0])


@st.composite
def lightings(draw: st.DrawFn) -> dict[str, Any]:
    stops, frames = st.floats(-MAX_STOPS, MAX_STOPS), st.integers(-(2**31), 2**31)
    values = {"period": log_uniform(1e-3, 2**31), "stops": stops}
    values |= {"stops_per_frame": st.floats(0, MAX_STOPS), "edge": st.integers(0, 2**31)}
    values |= {"frequency": log_uniform(1e-3, 1e6), "frame_rate": log_uniform(1e-3, 1e6)}
    values |= {"depth": st.floats(0, 1), "duty": st.none() | st.floats(1e-6, 1)}
    values |= {"ev": st.lists(stops, min_size=1, max_size=3), "file": st.none()}
    values |= {"kinds": st.sampled_from([*KIND_SETS, "all"])}
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
def test_light_is_positive_and_finite_in_every_frame(spec, frame, exposure_time, phase):
    lighting = make_lighting(spec)
    gain = lighting.gain(frame, exposure_time, phase)
    assert 0.0 < gain < math.inf
    known = {"flicker": MAX_STOPS, "schedule": max(map(abs, spec.get("ev", [0.0])))}
    most = known.get(spec["kind"], abs(spec.get("stops", 0.0)))
    assert abs(math.log2(gain)) <= most + 1e-9
    assert make_lighting(json.loads(json.dumps(spec))) == lighting


def test_each_frame_has_its_stops_and_the_last_holds(tmp_path: Path) -> None:
    wanted = [1.0, 0.5, 4.0, 4.0, 4.0]
    same = make_lighting({"kind": "schedule", "ev": [0, -1, 2]})
    for ev in ((0, -1, 2.0), np.array([0, -1, 2]), np.array([0, -1, 2], np.float32)):
        assert _gains({"kind": "schedule", "ev": ev}, 5) == wanted
        assert make_lighting({"kind": "schedule", "ev": ev}) == same
    for text in ("0\n-1\n2\n", "\ufeff 0 \n\n-1\n2", "frame,ev,note\n0,0,a\n1,-1,b\n2,2,c\n"):
        (tmp_path / "light.csv").write_text(text, encoding="utf-8")
        assert _gains({"kind": "schedule", "file": str(tmp_path / "light.csv")}, 5) == wanted


SHUTTER = RollingShutter(rows=40, row_time=2e-5, sensor_rows=8)


@pytest.mark.parametrize(
    ("spec", "lamp"),
    [
        ({}, MainsLamp(100.0, 0.8, phase=0.3)),
        ({"frequency": 400, "duty": 0.25, "depth": 0.5}, PulsedLamp(400.0, 0.25, phase=0.3)),
    ],
)
@pytest.mark.parametrize("time", [1 / 1000, 1 / 320, 1 / 30])
def test_rows_are_integrated_over_their_own_exposures(spec, lamp, time: float) -> None:
    lighting = make_lighting({"kind": "flicker", "frame_rate": 24, **spec})
    share = spec.get("depth", 1)
    gain, rows = lighting.rows(7, time, 0.3, SHUTTER)
    starts = (7 / 24 + 2e-5 * np.arange(320)).reshape(40, 8)
    wanted = 1 - share + share * np.vectorize(lamp.mean_light)(starts, time)
    np.testing.assert_allclose(gain * rows, wanted.mean(axis=1), atol=2e-4)
    assert rows.mean() == pytest.approx(1.0, abs=1e-12)
    assert lighting.gain(7, time, 0.3) == pytest.approx(wanted[0, 0], abs=2e-4)


@pytest.mark.parametrize(
    ("frequency", "times"), [(100, (1 / 100, 1 / 50, 1 / 25, 1 / 2)), (120, (1 / 120, 1 / 60))]
)
@pytest.mark.parametrize("duty", [None, 0.1])
def test_whole_periods_have_no_bands(frequency: float, times, duty: float | None) -> None:
    lighting = make_lighting({"kind": "flicker", "frequency": frequency, "duty": duty})
    for time in times:
        for frame, phase in ((0, 0.0), (3, 0.37), (100_000, 0.9)):
            assert lighting.rows(frame, time, phase, SHUTTER) == (1.0, None)
    assert lighting.rows(0, 1 / 90, 0.0, SHUTTER)[1] is not None


PHASES = np.random.default_rng(0).random(40)
#: Most stops away from where the light begins (sines begin anywhere), most stops between frames.
BOUNDS = {"ramps": (6.0, 1.5), "sines": (3.5, np.pi), "tunnels": (7.0, 7.0 / 3.0)}
BOUNDS |= {"steps": (3.0, 6.0), "drifts": (6.0, 1.5), "lamps": (0.0, 0.0), "shadows": (5.0, 5.0)}
BOUNDS |= {"clouds": (5.0, 5.0), "pans": (4.0, 6.0 * 0.6)}


@pytest.mark.parametrize("kind", MOVES)
def test_kinds_stay_within_their_bounds_and_move(kind: str) -> None:
    lighting = make_lighting({"kind": "moving", "kinds": kind})
    traces = np.stack([lighting.stops(phase) for phase in PHASES])
    most, fastest = BOUNDS[kind]
    assert np.abs(traces).max() <= most + 1e-9
    assert np.abs(np.diff(traces, axis=1)).max() <= fastest + 1e-9
    if kind != "lamps":  # in the frames of an episode
        assert np.median(np.ptp(traces[:, :96], axis=1)) > 0.5


def test_the_phase_decides_every_kind_is_drawn_and_lamps_are_those_of_the_mains():
    lighting = make_lighting({"kind": "moving", "kinds": "all"})
    kinds = [lighting.kind(phase) for phase in PHASES]
    assert set(kinds) == set(MOVES) == {*KIND_SETS["train"], *KIND_SETS["test"]}
    again = make_lighting({"kind": "moving", "kinds": ["train", "test"]})
    for phase, kind in zip(PHASES, kinds, strict=True):
        found = [lighting.gain(frame, 0.01, phase) for frame in range(0, 200, 7)]
        assert found == [again.gain(frame, 0.01, phase) for frame in range(0, 200, 7)]
        if kind != "lamps":
            stops = lighting.stops(phase)[0:200:7]
            np.testing.assert_allclose(np.log2(found), stops, atol=1e-12)
    assert lighting.gain(10**6, 0.01, PHASES[0]) == lighting.gain(1023, 0.01, PHASES[0])
    # Whole periods of 100 or of 120 Hz have no ripple; 1/500 s has that of the depth drawn.
    lighting = make_lighting({"kind": "moving", "kinds": ["lamps"]})
    most = 0.0
    for hertz in (100.0, 120.0):
        lamp = make_lighting({"kind": "flicker", "frequency": hertz, "frame_rate": 29.97})
        most = max(most, *(np.ptp([lamp.gain(n, 0.002, p) for n in range(40)]) for p in PHASES))
    for phase in PHASES[:20]:
        whole = [lighting.gain(n, 0.05, phase) for n in range(30)]  # 5 and 6 periods
        np.testing.assert_allclose(whole, 1.0, atol=1e-9)
        assert 0.0 < np.ptp([lighting.gain(n, 0.002, phase) for n in range(40)]) <= most
