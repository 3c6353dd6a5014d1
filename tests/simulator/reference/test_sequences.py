import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from simulator.camera import BayerPattern, CameraProfile, get_camera
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.reference.camera import ReferenceScene
from simulator.reference.sequences import (
    EXPOSURE_TIMES,
    F_NUMBERS,
    ISO_SPEEDS,
    Pair,
    Sequence,
    draw_settings,
    exposure_error,
    grey_signal,
    select_pairs,
)
from simulator.settings import CameraSettings

Z6 = get_camera("nikon_z6")
#: What the marked f-numbers stand for: powers of sqrt(2).
EXACT_F = {4.0: 4.0, 5.6: 2**2.5, 8.0: 8.0, 11.0: 2**3.5, 16.0: 16.0, 22.0: 2**4.5}


def scene(
    illuminance: float | None = 320.0, reference: CameraSettings | None = None, light: float = 0.1
) -> ReferenceScene:
    frame, reference = torch.full((4, 2, 3), light), reference or CameraSettings(100, 0.01, 4)
    return ReferenceScene("s", "g", "k", frame, reference, illuminance=illuminance)


def ideal(table: dict[float, tuple[float, float]]) -> CameraProfile:
    """A sensor of these shot and read noises by ISO."""
    nlfs = {iso: NoiseLevelFunction((s,) * 4, (r,) * 4) for iso, (s, r) in table.items()}
    return CameraProfile("ideal", BayerPattern.RGGB, (0, 0, 0, 0), 1000, 10, nlf_by_iso=nlfs)


#: Only the photons' noise, which grows with ISO.
SHOT_ONLY = ideal({iso: (1e-7 * iso, 0.0) for iso in (100.0, 400.0, 6400.0)})


def targets(camera: CameraProfile, ev: int, *settings: CameraSettings) -> set[int]:
    """What the first of these settings is paired with, where incident light has `ev`."""
    sequence = Sequence(scene(2.5 * 2**ev), settings)
    return {p.target for p in select_pairs([sequence], "noise", camera) if p.source == 0}


def drawn(illuminance: float, count: int, camera: CameraProfile = Z6) -> list[CameraSettings]:
    rng = np.random.default_rng(7)
    return [s for _ in range(count) for s in draw_settings(illuminance, rng, camera)]


@pytest.mark.parametrize("illuminance", [1.0, 300.0, 20_000.0])
def test_a_sequence_has_20_to_25_different_captures_in_the_papers_ranges(illuminance):
    rng = np.random.default_rng(1)
    sequences = [draw_settings(illuminance, rng, Z6) for _ in range(40)]
    assert {20, 25} <= {len(settings) for settings in sequences} <= set(range(20, 26))
    for settings in sequences:
        assert settings == sorted(set(settings))
        for s in settings:
            assert 100 <= s.iso <= 16_000
            assert 2.0**-13 <= s.exposure_time <= 4.0  # 1/8000 s stands for 2**-13
            assert s.f_number in EXACT_F


def test_levels_are_what_cameras_offer():
    assert tuple(EXACT_F) == F_NUMBERS
    assert (ISO_SPEEDS[0], ISO_SPEEDS[-1]) == (100, 16_000)
    np.testing.assert_allclose(np.diff(np.log2(ISO_SPEEDS)), 1 / 3, atol=0.04)
    np.testing.assert_allclose(np.diff(np.log2(EXPOSURE_TIMES)), 1 / 3)
    # A raw file that states one of these times, rounded or not, brings back the same number.
    for time in EXPOSURE_TIMES:
        assert CameraSettings.from_exif(100, time, 4).exposure_time == time
    assert (EXPOSURE_TIMES[0], EXPOSURE_TIMES[-1]) == (2.0**-13, 4.0)


def test_brighter_scenes_get_lower_iso_shorter_times_and_smaller_apertures():
    means = []
    for illuminance in (1.0, 20.0, 400.0, 4000.0, 20_000.0):
        levels = [(s.iso, s.exposure_time, 1 / s.f_number) for s in drawn(illuminance, 40)]
        means.append(np.log2(levels).mean(axis=0))
    assert (np.diff(means, axis=0) < 0).all()
    # ISOs stay near the calibrated ones.
    table = dict.fromkeys((200.0, 1600.0), Z6.nlf(100.0))
    isos = {s.iso for s in drawn(30.0, 30, replace(Z6, nlf_by_iso=table))}
    assert (min(isos), max(isos)) == (200, 4000)


@pytest.mark.parametrize("illuminance", [10.0, 320.0, 20_000.0])
def test_exposures_scatter_around_the_right_one_by_three_ev(illuminance):
    # EV100 = log2(N^2 / t) - log2(ISO / 100); incident light of 2.5 lux is EV 0.
    states = [(s.iso, s.exposure_time, EXACT_F[s.f_number]) for s in drawn(illuminance, 40)]
    iso, time, f_number = np.array(states).T
    errors = math.log2(illuminance / 2.5) - np.log2(f_number**2 / time) + np.log2(iso / 100)
    assert np.abs(errors).max() <= 3 + 1e-9
    assert abs(np.median(errors)) < 0.5
    assert np.percentile(errors, 5) < -2 < 2 < np.percentile(errors, 95)


def test_bad_arguments_are_refused():
    for light, camera, name in ((100.0, ideal({}), "camera"), (0, Z6, "illuminance")):
        with pytest.raises(ValueError, match=f"`{name}`"):
            draw_settings(light, np.random.default_rng(0), camera)
    with pytest.raises(ValueError, match="`illuminance`"):  # no exposure of the levels suits it
        draw_settings(1e-3, np.random.default_rng(0), Z6)
    with pytest.raises(ValueError, match="at least 2"):
        Sequence(scene(), (CameraSettings(100, 1, 4),))
    with pytest.raises(ValueError, match=r"`stage` \(='noises'\).*did you mean 'noise'"):
        select_pairs([], "noises", Z6)


def test_a_grey_card_lies_at_12_percent_of_white_under_an_incident_meter():
    # 320 lux is EV 7: ISO 100, 1/8 s, f/4 is right; the error is positive where it is too bright.
    for values, ev in (((100, 1 / 8, 4), 0), ((200, 1 / 4, 4), 2), ((100, 1 / 8, 5.6), -1)):
        assert exposure_error(320.0, CameraSettings(*values)) == pytest.approx(ev)
    # x = L t ISO / (120 N^2) with L = 0.18 E / pi and E = 2.5 lux at EV 0: 0.18 * 250 / (120 pi)
    card, settings = 0.18 * 250 / (120 * math.pi), CameraSettings(100, 1 / 8, 4)
    assert card == pytest.approx(0.119, abs=5e-4)
    assert grey_signal(scene(320.0), settings) == pytest.approx(card)
    assert grey_signal(scene(640.0), settings) == pytest.approx(2 * card)
    dark = scene(None, CameraSettings(100, 1 / 4, 4), light=0.3)
    assert grey_signal(dark, settings) == pytest.approx(0.15)


@pytest.mark.parametrize("stage", ["exposure", "all"])
def test_any_two_captures_of_one_sequence_train_the_exposure(stage):
    settings = tuple(CameraSettings(100, t, 4) for t in (0.1, 0.2, 0.4))
    sequences = [Sequence(scene(), settings), Sequence(scene(), settings[:2])]
    expected = [(0, 0, 1), (0, 0, 2), (0, 1, 0), (0, 1, 2), (0, 2, 0), (0, 2, 1)]
    expected += [(1, 0, 1), (1, 1, 0)]
    assert select_pairs(sequences, stage, Z6) == [Pair(*p) for p in expected]


def test_noise_targets_collect_four_times_the_light_at_the_same_aperture():
    # With photon noise alone, variance at a common exposure goes as 1 / (light collected): at one
    # f-number the target's must be at most a quarter, so its exposure time at least fourfold.
    source = CameraSettings(6400, 1 / 128, 8)
    candidates = (
        CameraSettings(100, 1 / 31.9, 8),
        CameraSettings(100, 1 / 32.1, 8),  # not yet four times
        CameraSettings(400, 1 / 16, 8),
        CameraSettings(500, 1 / 16, 8),  # ISO above 400
        CameraSettings(100, 1 / 16, 11),  # other defocus
    )
    # Each target is within the range of exposures asked of it.
    assert targets(SHOT_ONLY, 9, source, *candidates) == {1, 3}


def test_noise_targets_are_neither_black_nor_white():
    source = CameraSettings(6400, 1 / 8192, 8)  # an eighth of the light of any target
    # EV 12 is ISO 100, 1/64 s, f/8; 3 EV below and 2 EV above are the limits.
    times = (2.0**-9 * 0.98, 2.0**-9 * 1.02, 2.0**-4 * 0.98, 2.0**-4 * 1.02)
    assert targets(SHOT_ONLY, 12, source, *(CameraSettings(100, t, 8) for t in times)) == {2, 3}


def test_read_noise_counts_in_dim_light():
    # Source and target differ in exposure by 2 and in gain not at all: brought to the target's
    # exposure the source's read variance is 4 times as large.
    reads = ideal({100.0: (1e-12, 4e-6)})
    assert targets(reads, 5, *(CameraSettings(100, t, 4) for t in (0.1, 0.2001))) == {1}
    assert not targets(reads, 5, *(CameraSettings(100, t, 4) for t in (0.1, 0.1999)))


def test_the_aperture_only_opens_and_seldom_stays():
    f_numbers = (4.0, 4.0, 5.6, 5.6, 8.0, 8.0, 11.0, 11.0, 16.0, 22.0)
    settings = tuple(CameraSettings(100, 0.1 + i / 10, n) for i, n in enumerate(f_numbers))
    pairs = select_pairs([Sequence(scene(), settings)] * 3, "aperture", Z6)
    same = {p for p in pairs if f_numbers[p.source] == f_numbers[p.target]}
    opened = {p for p in pairs if f_numbers[p.source] > f_numbers[p.target]}
    assert len(opened) == 3 * (10 * 9 // 2 - 4)
    assert pairs == sorted(opened | same)
    assert 0 < len(same) <= 0.1 * len(pairs)
    assert {p.sequence for p in same} == {0, 1, 2}
