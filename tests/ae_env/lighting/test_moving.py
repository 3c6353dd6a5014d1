"""Light that episodes draw: each kind within its bounds, and the same for the same phase."""

import numpy as np
import pytest

from ae_env.lighting import FlickerLighting, make_lighting
from ae_env.lighting.moving import KIND_SETS, MOVES, read_pans
from ae_env.scenes.polyhaven import light_around, list_assets, split_assets
from simulator.radiance.maps import read_radiance

PHASES = np.random.default_rng(0).random(60)
#: Most stops away from where the light begins (sines begin anywhere), most stops between frames.
BOUNDS = {
    "ramps": (6.0, 1.5),
    "sines": (3.5, 2.0 * np.pi * 3.5 / 7.0),
    "tunnels": (7.0, 7.0 / 3.0),
    "steps": (3.0, 6.0),
    "drifts": (6.0, 1.5),
    "lamps": (0.0, 0.0),
    "shadows": (5.0, 5.0),
    "clouds": (5.0, 5.0),
    "pans": (4.0, 6.0 * 0.6),
}


@pytest.mark.parametrize("kind", MOVES)
def test_kinds_stay_within_their_bounds_and_move(kind: str) -> None:
    lighting = make_lighting({"kind": "moving", "kinds": kind})
    traces = np.stack([lighting.stops(phase) for phase in PHASES])  # type: ignore[attr-defined]
    most, fastest = BOUNDS[kind]
    assert np.abs(traces).max() <= most + 1e-9
    assert np.abs(np.diff(traces, axis=1)).max() <= fastest + 1e-9
    if kind != "lamps":  # in the frames of an episode
        assert np.median(np.ptp(traces[:, :96], axis=1)) > 0.5


def test_the_phase_decides_and_every_kind_is_drawn():
    lighting = make_lighting({"kind": "moving", "kinds": "all"})
    kinds = [lighting.kind(phase) for phase in PHASES]  # type: ignore[attr-defined]
    assert set(kinds) == set(MOVES) == {*KIND_SETS["train"], *KIND_SETS["test"]}
    again = make_lighting({"kind": "moving", "kinds": ["train", "test"]})
    for phase, kind in zip(PHASES, kinds, strict=True):
        found = [lighting.gain(frame, 0.01, phase) for frame in range(0, 200, 7)]
        assert found == [again.gain(frame, 0.01, phase) for frame in range(0, 200, 7)]
        if kind != "lamps":
            stops = lighting.stops(phase)[0:200:7]  # type: ignore[attr-defined]
            np.testing.assert_allclose(np.log2(found), stops, atol=1e-12)
    assert lighting.gain(10**6, 0.01, PHASES[0]) == lighting.gain(1023, 0.01, PHASES[0])


def test_lamps_are_those_of_the_mains():
    """Whole periods of 100 or of 120 Hz have no ripple; 1/500 s has that of the depth drawn."""
    lighting = make_lighting({"kind": "moving", "kinds": ["lamps"]})
    most = 0.0
    for hertz in (100.0, 120.0):
        lamp = FlickerLighting(hertz, 0.8, frame_rate=29.97)
        most = max(most, *(np.ptp([lamp.gain(n, 0.002, p) for n in range(40)]) for p in PHASES))
    for phase in PHASES[:20]:
        whole = [lighting.gain(n, 0.05, phase) for n in range(30)]  # 5 and 6 periods
        np.testing.assert_allclose(whole, 1.0, atol=1e-9)
        assert 0.0 < np.ptp([lighting.gain(n, 0.002, phase) for n in range(40)]) <= most


def test_kinds_are_checked():
    with pytest.raises(ValueError, match=r"'kinds'.*\(='tunnel'\).*did you mean 'tunnels'"):
        make_lighting({"kind": "moving", "kinds": "tunnel"})
    with pytest.raises(ValueError, match="must name one kind or more"):
        make_lighting({"kind": "moving", "kinds": []})
    with pytest.raises(ValueError, match="frame_rate"):
        make_lighting({"kind": "moving", "frame_rate": 0})


def test_pans_are_of_places_to_test_on_and_of_their_maps(data_dir):
    places = read_pans()
    assert set(places) == {asset.name for asset in list_assets() if asset.split == "test"}
    assert {len(turn) for turn in places.values()} == {72}
    asset = next(a for a in split_assets("polyhaven", "test") if a.name == "spree_bank")
    assert asset.path is not None
    found = light_around(read_radiance(asset.path))
    np.testing.assert_allclose(places["spree_bank"], found, atol=6e-4)
