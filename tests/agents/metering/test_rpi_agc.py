"""The Raspberry Pi's AGC: against libcamera's recordings, and on a grid."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest

from ae_env.grid import ExposureGrid
from agents.metering.rpi_agc import LADDERS, LibcameraAgc, signal_histogram, zone_map
from agents.policy_names import make_policy


def test_zones_cover_the_frame_with_the_first_in_the_middle():
    zones = zone_map(60, 90)
    assert np.unique(zones).tolist() == list(range(15))
    assert zones[30, 45] == 0
    counts = np.bincount(zones.ravel())
    assert counts[11:].tolist() == [10 * 15] * 4  # a sixth by a sixth
    assert {int(zones[30, x]) for x in range(90)} == {9, 5, 1, 0, 2, 6, 10}


def _wanted_ev(policy, frame):
    """EV100 that the policy would set if the grid held every exposure."""
    policy.reset(1)
    policy.act(frame)
    return policy._damped[0]


@pytest.mark.parametrize(("scene_ev", "target"), [(7.0, 0.1616), (12.0, 0.17), (9.0, None)])
def test_mean_is_put_at_the_target_of_its_illuminance(context, photograph, scene_ev, target):
    """0.16 at 0 lux, 0.165 at 1000, 0.17 from 10,000 on; 2.5 * 2^EV100 lux at mean light 1."""
    light = np.where(np.arange(64)[:, None] % 16 == 0, 4.0, 0.8) * np.ones((64, 64))  # mean 1
    if target is None:  # EV 9: 1280 lux
        target = 0.165 + 0.005 * 280 / 9000
    frame = photograph(light, scene_ev, context.grid.nearest(scene_ev))
    found = _wanted_ev(make_policy("rpi_agc?metering=matrix", context), frame)
    assert found == pytest.approx(scene_ev - math.log2(target / 0.12), abs=0.04)


def test_constraints(context, photograph):
    """Wide range: half of the frame dark, 4 % of it highlights in the corners."""
    light = np.full((64, 64), 1.3)
    light[:, 32:] = 0.2
    light[[0, 1, -1]] = 10.0
    state = context.grid.nearest(12.0)
    frame = photograph(light, 9.0, state)
    evs = {
        name: _wanted_ev(make_policy(f"rpi_agc?constraint={name}&metering=spot", context), frame)
        for name in ("normal", "highlight", "shadows")
    }
    # 0.12 * 10 * 2^(9 - EV) = 0.8 of white.
    assert evs["highlight"] == pytest.approx(9.0 - math.log2(0.8 / 1.2), abs=0.03)
    # Of the darker half, 61 x 32 pixels have 0.12 * 0.2 / 8 of white, in the first bin of 128, and
    # 96 have 0.12 * 1.3 / 8, in the third: their mean shall be at 0.17.
    shade = (61 * 32 * 0.5 + 96 * 2.5) / 128 / 2048
    ev = context.grid.ev100[state]
    assert evs["shadows"] == pytest.approx(ev - math.log2(0.17 / shade), abs=0.01)
    assert evs["highlight"] > evs["normal"] > evs["shadows"]


def test_ladder_splits_as_published(context):
    policy = make_policy("rpi_agc", context)
    exposures = np.array([0.004, 0.010, 0.015, 0.05, 0.12, 0.3, 1.0, 4.0])
    # 100 us..10 ms at 1; gain to 2; to 30 ms; gain to 4; to 60 ms; gain to 6; to 66.666 ms; to 16.
    times = [0.004, 0.010, 0.010, 0.025, 0.030, 0.060, 0.066666, 0.066666]
    gains = [1.0, 1.0, 1.5, 2.0, 4.0, 5.0, 1.0 / 0.066666, 16.0]
    np.testing.assert_allclose(policy.agc.split(exposures), [times, gains], rtol=1e-6)
    short = make_policy("rpi_agc?mode=short", context).agc.split(np.array([0.008]))
    np.testing.assert_allclose(np.ravel(short), [0.005, 1.6])
    long = make_policy("rpi_agc?mode=long&max_gain=64", context).agc.split(np.array([9.0]))
    np.testing.assert_allclose(np.ravel(long), [0.12, 64.0])  # 7.68 s at most


def test_lamps_do_not_flicker_on_a_grid_with_other_shutters(context):
    """1/60 and 1/120 s would suit the exposure, but are no whole periods of 100 Hz."""
    grid = ExposureGrid((100, 200, 400, 800, 1600), (1 / 120, 1 / 100, 1 / 60, 1 / 50), (5.6, 8))
    other = dataclasses.replace(context, grid=grid)
    evs = np.linspace(6.0, 11.0, 40)
    used = {}
    for name in ("rpi_agc", "rpi_agc?flicker_period=0.01"):
        policy = make_policy(name, other)
        states = policy._utility(evs).argmax(axis=1)
        used[name] = {grid[int(s)].exposure_time for s in states}
        assert np.abs(grid.ev100[states] - evs).max() < 1.1
    assert used["rpi_agc"] & {1 / 120, 1 / 60}
    assert used["rpi_agc?flicker_period=0.01"] <= {1 / 100, 1 / 50, 1 / 120}


#: Six of the 36 recordings, so that nothing else is needed.
OURS = Path(__file__).with_name("libcamera_traces.json")


def _played(recording, zone_factors):
    """Exposure times [s] and gains of ours in the light of a recording, which it does not see.

    Its settings take effect as the sensor's do: a time three frames after its decision, a gain two.
    """
    agc = LibcameraAgc(
        1,
        metering=recording["metering"].replace("-", "_"),
        constraint=recording["constraint"],
        ladder=LADDERS[recording["exposure_mode"]],
        max_exposure_time=66e-3,
        flicker_period=recording["flicker_period_us"] * 1e-6 or None,
    )
    pixels = np.repeat(np.array(zone_factors, float)[:, None], 1000, axis=1)
    if recording["scene"] == "highlights":
        pixels[:, :50] *= 8.0
    times, gains = [1e-3] * 3, [1.0] * 2
    for frame in range(len(recording["gain"])):
        time, gain = min(max(times[frame], 60e-6), 66e-3), gains[frame]
        light = recording["light"][frame >= recording["step_at"]]
        signals = np.minimum(light * pixels * time * gain, 1.0)
        zones, histogram = signals.mean(axis=1)[None], signal_histogram(signals.reshape(1, -1))
        asked = agc.split(agc.update(zones, histogram, np.array([time * gain])))
        for own, value in zip((times, gains), asked, strict=True):
            own.append(float(value[0]))
    count = len(recording["gain"])
    return np.clip(times[:count], 60e-6, 66e-3), np.array(gains[:count])


@pytest.mark.parametrize("every", [False, True])
def test_every_frame_is_libcameras(every: bool, request: pytest.FixtureRequest) -> None:
    """Within 0.1 %; asked are 2 % with two frames of grace, and a settling within a frame."""
    file = request.getfixturevalue("data_dir") / "libcamera_agc" / "traces.json" if every else OURS
    recordings = json.loads(file.read_text())
    assert len(recordings["traces"]) >= (36 if every else 6)
    for recording in recordings["traces"]:
        times, gains = _played(recording, recordings["meta"]["zone_factors"][recording["scene"]])
        wanted = np.array(recording["exposure_s"]), np.array(recording["gain"])
        np.testing.assert_allclose(times, wanted[0], rtol=1e-3)
        np.testing.assert_allclose(times * gains, wanted[0] * wanted[1], rtol=1e-3)
