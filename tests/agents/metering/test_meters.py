import math

import numpy as np
import pytest

from ae_env.observation import decode_observation
from agents.metering.meters import make_meter, weight_map
from agents.policy_names import METERS

GREY = np.ones((64, 64))


@pytest.mark.parametrize("name", ["average", "centre_weighted", "spot"])
def test_a_grey_card_reads_the_incident_ev(context, photograph, name):
    states = [int(np.argmin(np.abs(context.grid.ev100 - ev))) for ev in (7.0, 8.0, 9.0, 10.0)]
    reading = make_meter(name, context.camera)(photograph(GREY, 9.0, states))
    np.testing.assert_allclose(reading.ev100, 9.0, atol=0.06)  # half a code of the observation
    assert not reading.saturated.any()
    assert not reading.black.any()


def test_weighted_mean_matches_a_direct_sum(context, photograph):
    light = np.random.default_rng(0).uniform(0.2, 3.0, (64, 64))
    frame = photograph(light, 9.0, context.grid.nearest(9.0))
    y, x = np.mgrid[:64, :64]
    inside = np.hypot(x - 31.5, y - 31.5) <= 16
    mean = 0.75 * light[inside].mean() + 0.25 * light[~inside].mean()
    reading = make_meter("centre_weighted", context.camera)(frame)
    assert reading.ev100[0] == pytest.approx(9.0 + math.log2(mean), abs=0.02)


def test_weights_sum_to_one_and_spot_covers_four_percent():
    for name in ("average", "centre_weighted", "spot"):
        assert weight_map(name, 48, 64).sum() == pytest.approx(1.0, abs=1e-5)
    assert (weight_map("spot", 128, 128) > 0).mean() == pytest.approx(0.04, abs=0.002)


def test_matrix_is_the_weighted_mean_of_the_zones_logarithms(context, photograph):
    """Five zones a side, weighted by a Gaussian of one zone; the top lies within its bounds."""
    rng = np.random.default_rng(0)
    edges = [0, 12, 25, 38, 51, 64]
    zones = 2.0 ** rng.uniform(-2.5, 1.5, (5, 5))
    zones[4, 4] = 4.0
    light = np.repeat(np.repeat(zones, np.diff(edges), axis=0), np.diff(edges), axis=1)
    state = context.grid.nearest(9.0)
    ev = context.grid.ev100[state]
    signal = 0.12 * 2.0 ** (9.0 - ev) * zones
    weights = np.exp(-0.5 * ((np.mgrid[:5, :5] - 2) ** 2).sum(axis=0))
    mean = 2.0 ** ((weights * np.log2(signal)).sum() / weights.sum())
    metered = ev + math.log2(mean / 0.12)
    assert 0.5 < signal.max() * 0.12 / mean < 0.8  # at that EV
    found = make_meter("matrix", context.camera)(photograph(light, 9.0, state)).ev100[0]
    assert found == pytest.approx(metered + 0.7, abs=0.02)


def test_matrix_is_held_by_its_highlights_and_lifted_by_their_lack(context, photograph):
    state, meter = context.grid.nearest(9.0), make_meter("matrix", context.camera)
    ev = context.grid.ev100[state]
    figure = np.full((64, 64), 0.03)
    figure[26:36, 26:36] = 6.0  # 2.4 % of the pixels
    found = meter(photograph(figure, 9.0, state)).ev100[0]
    # In the middle zone, 13 pixels a side; its weight is 1 of 6.17.
    weights = np.exp(-0.5 * ((np.mgrid[:5, :5] - 2) ** 2).sum(axis=0))
    middle = 0.03 + (6.0 - 0.03) * 100 / 169
    level = (math.log2(middle) + (weights.sum() - 1) * math.log2(0.03)) / weights.sum()
    metered = 9.0 + level
    assert math.log2(0.12 * 6.0 / 0.8) - level > 3.0  # too bright by more than the limit
    assert found == pytest.approx(metered + 3.0 + 0.7, abs=0.1)  # a code of the dark
    snow = meter(photograph(np.full((64, 64), 4.5), 9.0, state)).ev100[0]
    # Its top is all of it: at 0.12 of white at the metered EV, to be lifted to 0.5.
    assert snow == pytest.approx(9.0 + math.log2(4.5) + math.log2(0.12 / 0.5) + 0.7, abs=0.03)
    white = meter(photograph(np.full((64, 64), 40.0), 9.0, state))
    assert white.saturated[0] == pytest.approx(1.0)  # brighter than it says: no lift
    assert white.ev100[0] == pytest.approx(ev + math.log2(1.0 / 0.12) + 3.0 + 0.7, abs=0.02)


def test_clipped_frames_are_lower_bounds_and_black_ones_upper_bounds(context, photograph):
    bright, dark = context.grid.nearest(-1.0), context.grid.nearest(17.0)
    meter = make_meter("average", context.camera)
    white, black = meter(photograph(GREY, 15.0, bright)), meter(photograph(GREY, -1.0, dark))
    assert (white.saturated[0], black.black[0]) == (1.0, True)
    assert context.grid.ev100[bright] + 3 < white.ev100[0] < 15.0
    assert -1.0 < black.ev100[0] < context.grid.ev100[dark] - 8


@pytest.mark.parametrize("name", METERS)
def test_every_kind_of_observation_reads_the_same(context, photograph, name):
    light = np.geomspace(0.2, 3.0, 64)[None] * np.ones((64, 1))
    frame = photograph(light, 9.0, context.grid.nearest(9.0))
    signal = decode_observation(frame["raw"])
    span, black = (
        np.array(c)[:, None, None] for c in (context.camera.span, context.camera.black_level)
    )
    numbers = np.rint(signal * span + black).astype(np.uint16)
    meter = make_meter(name, context.camera)
    found = [meter({**frame, "raw": raw}).ev100[0] for raw in (frame["raw"], signal, numbers)]
    np.testing.assert_allclose(found, found[0], atol=0.03)


def test_unknown_meter_names_the_nearest():
    with pytest.raises(ValueError, match=r"`meter` \(='matric'\).*did you mean 'matrix'"):
        make_meter("matric", None)
