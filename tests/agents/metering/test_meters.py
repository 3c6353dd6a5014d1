import math

import numpy as np
import pytest

from ae_env.observation import decode_observation
from agents.metering import reading as readings
from agents.metering.meters import make_meter, weight_map
from agents.metering.reading import EVTracker, frame_ev100
from agents.policy_names import METERS, make_policy
from agents.rollouts import shown_to

GREY = np.ones((64, 64))


@pytest.mark.parametrize("name", ["average", "centre_weighted", "spot", "skewness"])
def test_a_grey_card_reads_the_incident_ev(context, photograph, name):
    states = [int(np.argmin(np.abs(context.grid.ev100 - ev))) for ev in (7.0, 8.0, 9.0, 10.0)]
    reading = make_meter(name, context.camera)(photograph(GREY, 9.0, states))
    np.testing.assert_allclose(reading.ev100, 9.0, atol=0.06)  # half a code of the observation
    assert not reading.saturated.any()
    assert not reading.black.any()


def test_weighted_mean_matches_a_direct_sum(context, photograph):
    light = np.random.default_rng(0).uniform(0.2, 3.0, (64, 64))
    y, x = np.mgrid[:64, :64]
    inside = np.hypot(x - 31.5, y - 31.5) <= 16
    light[inside] *= 2.0
    frame = photograph(light, 9.0, context.grid.nearest(9.0))
    mean = 0.75 * light[inside].mean() + 0.25 * light[~inside].mean()
    reading = make_meter("centre_weighted", context.camera)(frame)
    assert reading.ev100[0] == pytest.approx(9.0 + math.log2(mean), abs=0.02)
    assert (weight_map("spot", 128, 128) > 0).mean() == pytest.approx(0.04, abs=0.002)
    for name in ("spot", "centre_weighted"):
        for height, width in ((48, 64), (57, 33)):
            weights = weight_map(name, height, width)
            assert weights.sum() == pytest.approx(1.0)
            for mirrored in (weights[::-1], weights[:, ::-1]):
                np.testing.assert_array_equal(mirrored, weights)
    with pytest.raises(ValueError, match="`meter`"):
        make_meter("matric", context.camera)


@pytest.mark.parametrize(("corner", "taken_at"), [(4.0, 9.0), (10.0, 11.0)])
def test_matrix_is_the_weighted_mean_of_the_zones_logarithms(context, photograph, corner, taken_at):
    """Five zones a side, weighted by a Gaussian of one zone; the top within its bounds or above."""
    rng = np.random.default_rng(0)
    edges = [0, 12, 25, 38, 51, 64]
    zones = 2.0 ** rng.uniform(-2.5, 1.5, (5, 5))
    zones[4, 4] = corner
    light = np.repeat(np.repeat(zones, np.diff(edges), axis=0), np.diff(edges), axis=1)
    state = context.grid.nearest(taken_at)
    ev = context.grid.ev100[state]
    signal = 0.12 * 2.0 ** (9.0 - ev) * zones
    weights = np.exp(-0.5 * ((np.mgrid[:5, :5] - 2) ** 2).sum(axis=0))
    mean = 2.0 ** ((weights * np.log2(signal)).sum() / weights.sum())
    metered = ev + math.log2(mean / 0.12)
    top = signal.max() * 0.12 / mean  # at that EV
    assert (0.5 < top < 0.8) or (corner == 10.0 and 0.9 < top < 3.0)
    found = make_meter("matrix", context.camera)(photograph(light, 9.0, state)).ev100[0]
    held = max(math.log2(top / 0.8), 0.0)
    assert found == pytest.approx(metered + held + 0.7, abs=0.02)


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
    signal, body = decode_observation(frame["raw"]), context.camera
    span, black = (np.array(levels)[:, None, None] for levels in (body.span, body.black_level))
    numbers = np.rint(signal * span + black).astype(np.uint16)
    meter = make_meter(name, context.camera)
    found = [meter({**frame, "raw": raw}).ev100[0] for raw in (frame["raw"], signal, numbers)]
    np.testing.assert_allclose(found, found[0], atol=0.03)


def _linear(z):
    return z / 12.92 if z <= 0.04045 else ((z + 0.055) / 1.055) ** 2.4


def test_skewness_balances_two_levels_about_mid_grey(context, photograph):
    """Half of the pixels 0.2 of the code below mid-grey, half as much above."""
    middle = 1.055 * 0.18 ** (1 / 2.4) - 0.055  # in sRGB
    levels = [_linear(middle - 0.2) / 0.18, _linear(middle + 0.2) / 0.18]
    light = np.where(np.arange(64)[:, None] < 32, *levels) * np.ones((64, 64))
    for ev in (9.0, 10.0, 11.0):
        frame = photograph(light, 9.0, context.grid.nearest(ev))
        reading = make_meter("skewness", context.camera)(frame)
        assert reading.ev100[0] == pytest.approx(9.0, abs=0.08)


def test_entropy_finds_the_exposure_of_the_highest_entropy(context, photograph):
    """An sRGB ramp up to a level: all 256 greys are equally frequent where the top is white."""
    top = 0.35
    codes = (np.arange(4096) + 0.5) / 4096
    light = np.array([_linear(z) for z in codes]).reshape(64, 64) * top / 0.12
    state = context.grid.nearest(9.0)
    reading = make_meter("entropy", context.camera)(photograph(light, 9.0, state))
    # The frame has its top at 0.35 at EV 9, so at 1 at 9 - log2(1 / 0.35).
    assert reading.ev100[0] == pytest.approx(9.0 + math.log2(top), abs=0.15)


@pytest.mark.parametrize("name", ["shim", "zhang"])
def test_steps_go_on_from_the_estimate_and_not_from_the_state(context, photograph, name):
    """The same frame, a controller that is further on: the step is taken from there."""
    meter = make_meter(name, context.camera)
    light = np.kron(np.random.default_rng(0).uniform(0.3, 1.7, (16, 16)), np.ones((4, 4)))
    over = meter(photograph(light, 9.0, context.grid.nearest(4.0))).ev100[0]
    assert 0.5 < over - context.grid.ev100[context.grid.nearest(4.0)] < 4.1  # less light
    frame = photograph(light, 9.0, context.grid.nearest(12.0))
    path = [12.0]
    for _ in range(40):
        path.append(meter(frame, np.array([path[-1]])).ev100[0])
    steps = np.abs(np.diff(path))
    assert abs(path[-1] - path[-2]) < 0.02  # comes to rest though the frame stays
    assert path[-1] < 10.5
    assert steps[0] > 0.3


def test_highlights_are_exposed_to_nine_tenths_of_white(context, photograph):
    """The 99th percentile of the brightest plane of each pixel; where it is white, by a bound."""
    state, meter = context.grid.nearest(9.0), make_meter("highlight_weighted", context.camera)
    light = np.ones((4, 64, 64))
    light[3, :2] = 4.0  # 3 % of the pixels are blue highlights
    light[:, 2, 0] = 30.0  # and one a lamp, which does not count
    reading = meter(photograph(light, 9.0, [state, state]))
    # 0.12 * 4 at EV 9; 0.9 at 9 + log2(0.48 / 0.9).
    np.testing.assert_allclose(reading.ev100, [9.0 + math.log2(0.48 / 0.9)] * 2, atol=0.03)
    assert reading.saturated.tolist() == [0.0, 0.0]
    assert reading.black.tolist() == [False, False]
    light[:, :4] = 100.0  # a sixteenth is blown
    blown = meter(photograph(light, 9.0, state))
    step = 3.0 * (0.51 + 0.49 * 4 / 64)
    end = context.grid.ev100[state] + math.log2(1.0 / 0.9) + step
    assert blown.ev100[0] == pytest.approx(end, abs=0.02)
    dark = photograph(GREY, -6.0, context.grid.nearest(17.0))
    assert meter(dark).black.tolist() == [True]


#: Stripes from 5 stops below to 2 stops above a grey card, and a flat one.
STRIPES = np.repeat(2.0 ** np.linspace(-5.0, 2.0, 16), 4)[None, :] * np.ones((64, 1))
RAMP = np.geomspace(0.1, 6.0, 64)[None] * np.ones((64, 1))


def _reading(ev, saturated=0.0, black=False):
    return readings.Reading(np.array([ev]), np.array([saturated]), np.array([black]))


def _match(matcher, reading, frame, camera):
    return matcher.match(reading, readings.zone_signals(frame["raw"], camera), frame_ev100(frame))


def test_tracker_jumps_far_averages_near_and_respects_bounds():
    tracker = EVTracker(1, (-1.0, 17.0))
    assert tracker.update(_reading(8.0))[0] == 8.0
    assert tracker.update(_reading(8.5))[0] == 8.25
    assert tracker.update(_reading(12.0))[0] == 12.0
    assert tracker.update(_reading(9.0, saturated=0.8))[0] == 12.0  # 12 is above the bound
    assert tracker.update(_reading(13.0, black=True))[0] == 12.0  # and below this one
    assert tracker.update(_reading(16.0, saturated=0.8))[0] == 16.0  # 12 is below 16 - 2.4
    assert tracker.update(_reading(5.0, black=True))[0] == 2.0  # half of the way to -1
    white = EVTracker(1, (-1.0, 17.0)).update(_reading(9.0, saturated=1.0))
    assert white[0] == 0.5 * (9.0 - 3.0 + 17.0)
    # Damping keeps its share of the distance in EV.
    tracker = EVTracker(1, (-1.0, 17.0), damping=0.75)
    assert tracker.update(_reading(4.0))[0] == 4.0  # nothing to keep yet
    found = [tracker.update(_reading(12.0))[0] for _ in range(6)]
    np.testing.assert_allclose(found, [12.0 - 8.0 * 0.75**n for n in range(1, 7)])


def test_the_brightest_frame_that_hides_nothing_is_kept(context, photograph):
    grid = context.grid
    dark, fair, bright = (grid.nearest(ev) for ev in (13.0, 10.0, 6.0))
    reference = readings.ReferenceFrames(context.camera)
    for state, best in ((dark, dark), (fair, fair), (bright, fair), (dark, fair), (fair, fair)):
        kept = reference.update(photograph(RAMP, 9.0, state))
        assert frame_ev100(kept)[0] == pytest.approx(grid.ev100[best], abs=0.05)


def test_another_light_is_noticed_at_once(context, photograph):
    grid = context.grid
    for change in (-6.0, -4.0, -1.0, 1.0, 4.0):
        reference = readings.ReferenceFrames(context.camera)
        reference.update(photograph(RAMP, 9.0, grid.nearest(9.0)))
        kept = reference.update(photograph(RAMP, 9.0 + change, grid.nearest(11.0)))
        assert frame_ev100(kept)[0] == pytest.approx(grid.ev100[grid.nearest(11.0)], abs=0.05)


@pytest.mark.parametrize("stops", [4.0, 3.0, -2.0])
def test_a_jump_is_read_from_the_shadows(context, photograph, stops):
    """The light is known: 9 EV before, and so much more in two frames after, as the first's."""
    meter, state = make_meter("average", context.camera), context.grid.nearest(9.0)
    matched = readings.ZoneMatcher()
    before = photograph(STRIPES, 9.0, state)
    first = _match(matched, meter(before), before, context.camera)
    for late in (state, context.grid.nearest(11.0), context.grid.nearest(9.0 + stops)):
        after = photograph(STRIPES, 9.0 + stops, late)
        reading = _match(matched, meter(after), after, context.camera)
        assert reading.ev100 - first.ev100 == pytest.approx(stops, abs=0.1)
        assert reading.saturated[0] <= 0.02


def test_a_frame_without_shadows_keeps_its_reading(context, photograph):
    meter, state = make_meter("average", context.camera), context.grid.nearest(9.0)
    matched = readings.ZoneMatcher()
    for light in (9.0, 15.0):
        frame = photograph(np.ones((64, 64)), light, state)
        plain, reading = meter(frame), _match(matched, meter(frame), frame, context.camera)
        np.testing.assert_array_equal(reading.ev100, plain.ev100)
        np.testing.assert_array_equal(reading.saturated, plain.saturated)
    assert reading.saturated[0] == 1.0


# -- a part of the frame ---------------------------------------------------------------------------

BELL = np.add.outer(np.arange(64) < 40, np.arange(64) < 24) > 0  # all but the lower right


@pytest.mark.parametrize("name", METERS)
def test_other_pixels_count_for_nothing(context, photograph, name):
    light = np.random.default_rng(0).uniform(0.3, 2.0, (64, 64))
    state, meter = context.grid.nearest(9.0), make_meter(name, context.camera)
    frame, estimate = photograph(light, 9.0, state), np.array([9.5])

    def read(frame, **part):
        masks = readings.Region(part.get("roi"), part.get("mask"), (4, 64, 64)).masks(frame)
        return readings.read_part(meter, frame, estimate, masks).ev100[0]

    whole = meter(frame, estimate).ev100[0]
    assert read(frame) == whole
    # Only the mean that a zone's samples are summed up in differs.
    assert read(frame, mask=np.ones((64, 64), bool)) == pytest.approx(whole, abs=1e-5)
    # A quarter is as a frame of its own.
    quarter = {"raw": frame["raw"][:, :, 8:40, 32:], "settings": frame["settings"]}
    own = meter(quarter, estimate).ev100[0]
    assert read(frame, roi="0.5,0.125,0.5,0.5") == pytest.approx(own, abs=1e-5)
    light[44:, 28:] = 30.0  # no neighbour of what counts
    part = read(frame, mask=BELL)
    assert read(photograph(light, 9.0, state), mask=BELL) == pytest.approx(part, abs=1e-9)


#: A grey card, and what the meters say of it beside its EV; matrix: its top is at 0.12, not at 0.5.
CARD = {**dict.fromkeys(("average", "centre_weighted", "spot", "skewness"), 0.0)}
CARD |= {"highlight_weighted": math.log2(0.12 / 0.9), "matrix": 0.7 + math.log2(0.12 / 0.5)}
CARD |= {"rpi_agc:P?constraint=shadows&": math.log2(0.12 / 0.17)}


@pytest.mark.parametrize("name", CARD)
def test_each_camera_meters_its_own_subject(context, photograph, name):
    """A card in a world three stops brighter, seen through a fence; and a lone one of 3 pixels."""
    fence = np.indices((64, 64)).sum(axis=0) % 2 == 0
    small = np.zeros((64, 64), bool)
    small[60, 1:4] = True
    frames = [
        photograph(np.where(m, 1.0, 8.0), 9.0, context.grid.nearest(9.0)) for m in (fence, small)
    ]
    both = {key: np.concatenate([frame[key] for frame in frames]) for key in frames[0]}
    policy = make_policy(f"{name}{'' if '?' in name else ':P?'}mask=subject", context)
    policy.reset(2)
    policy.act(shown_to(policy, both, {"subject": np.stack([fence, small])}))
    found = policy._damped if name.startswith("rpi") else policy._tracker.ev100
    np.testing.assert_allclose(found, 9.0 + CARD[name], atol=0.06)
    with pytest.raises(ValueError, match="the scene has no subject"):
        policy.act(shown_to(policy, both, {"subject": np.stack([fence, ~(small | ~small)])}))
    with pytest.raises(ValueError, match="with_subject=True"):
        policy.act(shown_to(policy, both, {}))


def test_what_a_part_may_be(context):
    for roi in ("0,0,1", "0,0,0,1", "0.5,0,0.6,1", (-0.1, 0, 1, 1), "a,b,c,d", 3, (math.nan,) * 4):
        with pytest.raises(ValueError, match="`roi`"):
            make_policy("average", context, roi=roi)
    for mask in ("subjects", np.ones((64, 64)), np.ones((3, 3), bool), np.zeros((64, 64), bool)):
        with pytest.raises(ValueError, match="`mask`"):
            make_policy("rpi_agc", context, mask=mask)
    with pytest.raises(ValueError, match="not both"):
        make_policy("average?roi=0,0,1,1&mask=subject", context)
    # Pixels that are touched: 6.4 to 12.8 across, 32 to 33 down.
    (found,) = readings.Region((0.1, 0.5, 0.1, 1 / 64), None, (4, 64, 64)).masks({})
    assert np.argwhere(found)[[0, -1]].tolist() == [[32, 6], [32, 12]]
    assert found.sum() == 7
