"""The reference camera against closed forms, and sequences that it photographs.

Thin lenses are compared to sums over points of the aperture, each of which sees two planes through
its own pinhole: nothing there uses the layers that they work with.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from simulator.camera import BayerPattern, CameraProfile, get_camera
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.optics.flicker_integral import PulsedLamp
from simulator.reference import reference_camera, sequences
from simulator.reference.reference_camera import BodyError, ReferenceCamera, ReferenceScene
from simulator.reference.sequences import Sequence, select_pairs
from simulator.reference.thin_lens import Lens, defocus
from simulator.settings import CameraSettings
from tests.simulator.z6_noise import z6_noise

BASE = CameraSettings(100, 1 / 64, 4)
Z6 = get_camera("nikon_z6")


def sensor(shot: float, read: float, *, span: float = 16000.0, **options: object) -> CameraProfile:
    """A camera of round numbers: base ISO 100, the same noise in every plane."""
    table = {100.0: NoiseLevelFunction((shot,) * 4, (read,) * 4)}
    values = {"nlf_by_iso": table, "pixel_pitch_um": 5.0, **options}
    return CameraProfile("round", BayerPattern.RGGB, (200.0,) * 4, 200.0 + span, 16, **values)


def scene(light: torch.Tensor, depth: torch.Tensor | None = None, **options: object):
    settings = {"reference": BASE, "lens": Lens(0.05, 2.0), **options}
    return ReferenceScene("s", "g", "test", light, depth=depth, **settings)


def flat(level: float, size: int = 8) -> torch.Tensor:
    return torch.full((4, size, size), level)


@pytest.mark.parametrize("depth", [1.2, 1.5, 4.0])
def test_a_saturated_lamp_becomes_a_white_disc_of_the_thin_lens(depth):
    camera, light = ReferenceCamera(sensor(1e-4, 1e-7)), torch.zeros(4, 41, 41)
    light[:, 20, 20] = 1e4
    shot = scene(light, torch.full((41, 41), depth))
    # Similar triangles with f = 50 mm, focused at 2 m, on a grid of 10 um.
    image, focus = 1 / (1 / 0.05 - 1 / depth), 1 / (1 / 0.05 - 1 / 2.0)
    expected = 0.05 / 4.0 * abs(focus - image) / image / 10e-6
    np.testing.assert_allclose(camera.blur_diameter(shot, 4.0), expected, rtol=1e-5)
    spread = camera.blurred_light(shot, 4.0).double().numpy() / 1e4
    np.testing.assert_allclose(spread.sum((1, 2)), 1.0, rtol=1e-5)
    moment = spread.sum(1) @ (np.arange(41) - 20) ** 2  # a uniform disc: d^2 / 16
    np.testing.assert_allclose(moment, expected**2 / 16, rtol=0.01)
    np.testing.assert_allclose(spread[:, 20, 20], 4 / (math.pi * expected**2), rtol=0.03)
    capture = camera.capture(shot, BASE, 0)
    border = math.pi * expected  # pixels that the rim touches may fall on either side
    for white in (capture.mean == 1.0, capture.sample == 1.0):
        assert abs(white[1].sum().item() - math.pi * expected**2 / 4) < border
        assert bool(white[1, 20, 20])


def test_photosites_averages_and_marked_stops_in_the_blur():
    shot = scene(flat(0.1, 4), torch.full((4, 4), 1.0))
    native, boxed = (ReferenceCamera(sensor(1e-4, 1e-8), box_factor=k) for k in (1, 4))
    expected = native.blur_diameter(shot, 4.0)
    torch.testing.assert_close(boxed.blur_diameter(shot, 4.0), expected[:1, :1] / 4)
    fine = scene(torch.ones(3, 8, 8), torch.full((8, 8), 1.0))  # two photosites to a packed pixel
    torch.testing.assert_close(native.blur_diameter(fine, 4.0), expected)
    # f/5.6 stands for 4 sqrt(2), f/11 for 8 sqrt(2)
    torch.testing.assert_close(native.blur_diameter(shot, 11.0), expected / (2 * math.sqrt(2)))
    light, camera = torch.rand(4, 7, 5), ReferenceCamera(sensor(1e-4, 1e-8))
    assert not scene(light).sampled
    assert float(camera.blur_diameter(scene(light), 4.0).max()) == 0.0
    far = scene(light, torch.full((7, 5), math.inf), lens=Lens(0.05, math.inf))
    for sharp in (scene(light), scene(light, torch.full((7, 5), 2.0)), far):
        assert torch.equal(camera.blurred_light(sharp, 4.0), light)
    fine = torch.rand(3, 16, 16)  # through the lens, and sampled by the mosaic
    expected = reference_camera.sample_mosaic(reference_camera.lens_blur(fine), BayerPattern.GBRG)
    camera = ReferenceCamera(replace(sensor(1e-4, 1e-8), cfa=BayerPattern.GBRG))
    torch.testing.assert_close(camera.blurred_light(scene(fine), 4.0), expected)


def record(camera: ReferenceCamera, level: float, iso: float, size: int = 160) -> np.ndarray:
    generator = torch.Generator().manual_seed(7)
    return camera.record(flat(level, size), iso, generator).double().numpy()


@pytest.mark.parametrize("iso", [100, 1600, 6400])
@pytest.mark.parametrize("level", [0.0, 0.003, 0.1, 0.6])
def test_mean_and_variance_of_a_flat_field(iso, level):
    shot, read = z6_noise(iso)[:, 1]
    expected = read + shot * level
    sample = record(ReferenceCamera(Z6), level, iso)[1:3]
    numbers, count = sample * 14512, sample.size  # white - black, retyped
    np.testing.assert_allclose(numbers, numbers.round(), atol=2e-3)
    assert abs(sample.mean() - level) < 5 * math.sqrt(expected / count)
    # Fourth central moment of Poisson plus Gauss: 3 v^2 + shot^3 x.
    standard_error = math.sqrt((2 * expected**2 + shot**3 * level) / count)
    assert abs(sample.var() - expected) < 5 * standard_error + 0.01 * expected


def test_counts_are_poisson_and_read_noise_is_gaussian():
    # White is 64 electrons at ISO 100, each 250 numbers high; 0.05 of white is 3.2 electrons.
    sample = record(ReferenceCamera(sensor(1 / 64, 0.0)), 0.05, 100.0) * 64
    np.testing.assert_allclose(sample, sample.round(), atol=1e-4)
    share = [(np.abs(sample - k) < 0.5).mean() for k in range(8)]
    expected = [math.exp(-3.2) * 3.2**k / math.factorial(k) for k in range(8)]
    np.testing.assert_allclose(share, expected, atol=5 * math.sqrt(0.25 / sample.size))
    sample = record(ReferenceCamera(sensor(0.0, 1e-6)), 0.5, 100.0) - 0.5
    assert sample.std() == pytest.approx(1e-3, rel=0.01)
    for numbers in (8.5, 15.5, 31.5):  # sigma is 16 numbers; between two of them nothing is cut
        inside = (np.abs(sample) * 16000 < numbers).mean()
        assert inside == pytest.approx(math.erf(numbers / 16 / math.sqrt(2)), abs=0.008)


def test_rounding_and_box_average_in_the_variance_and_without_noise():
    # sigma = 0.6 numbers: with 1/12 counted twice the variance would be 23 % too large.
    read = (0.6 / 16000) ** 2
    sample = record(ReferenceCamera(sensor(1e-5, read)), 0.0, 100.0)
    assert sample.var() == pytest.approx(read, rel=0.03)
    # An average of k x k has whole multiples of 1/k^2 numbers: sigma is 0.6 of them, then 0.2.
    camera = ReferenceCamera(sensor(1e-5, read), box_factor=3)
    boxed = record(camera, 0.0, 100.0, 480) * 16000 * 9
    np.testing.assert_allclose(boxed, boxed.round(), atol=2e-3)
    assert (boxed.round() % 9 != 0).mean() > 0.5
    assert boxed.var() == pytest.approx(read * 16000**2 * 9, rel=0.03)
    assert record(camera, 0.2, 100.0).mean() == pytest.approx(0.2, rel=1e-3)
    # Clipped first, averaged then: half of the samples white, half at 0.2.
    half = flat(0.2, 8)
    half[..., ::2] = 5.0
    even = ReferenceCamera(sensor(0.0, 0.0), box_factor=4)
    for averaged in (even.record(half, 100.0, torch.Generator()), even.clip(half, 100.0)):
        torch.testing.assert_close(averaged, flat(0.6, 2))
    planes = torch.rand(4, 13, 17, generator=torch.Generator().manual_seed(0))
    assert reference_camera.average_planes(planes, 1) is planes
    expected = planes[:, :12, :15].reshape(4, 4, 3, 5, 3).mean(dim=(2, 4))
    torch.testing.assert_close(reference_camera.average_planes(planes, 3), expected)
    camera = ReferenceCamera(sensor(0.0, 0.0, span=1000.0))
    signal = torch.tensor([-1.0, -0.2, -0.0012, 0.1234, 0.9996, 7.0]).expand(4, 1, 6)
    found = camera.record(signal, 100.0, torch.Generator()) * 1000
    # Black is 200 of 1200 numbers: nothing below -200, nothing above 1000. Light is never negative.
    np.testing.assert_allclose(found, [[[0, 0, 0, 123, 1000, 1000]]] * 4, rtol=1.3e-6, atol=1e-5)


def test_clipped_flat_fields_are_white_or_a_full_well_under_the_base_iso():
    camera = ReferenceCamera(Z6, body=BodyError(black_offset=(-1e-4, -1e-4, 1e-4, 1e-4)))
    for iso, level in itertools.product((100.0, 400.0, 6400.0), (3.0, 1e30)):
        bright = camera.capture(scene(flat(level, 32)), replace(BASE, iso=iso), 1)
        assert float(bright.sample.min()) == float(bright.mean.min()) == 1.0
    # At ISO 50 a number stands for twice the electrons: the well is full at half of white.
    camera = ReferenceCamera(sensor(1e-4, 0.0))
    capture = camera.capture(scene(flat(8.0, 16)), replace(BASE, iso=50), 0)
    assert capture.sample.unique().numel() == 1
    for recorded in (capture.sample, capture.mean):
        np.testing.assert_allclose(recorded, 0.5, rtol=0.005)


def test_ratio_of_two_captures_and_black_offset_are_the_bodys():
    body = BodyError(shutter_delay=-20e-6, shutter_scale=0.01, transmission={12: 0.03, 21: -0.05})
    camera = ReferenceCamera(sensor(1e-6, 1e-9), body=body)
    first, second = CameraSettings(100, 1 / 4000, 4), CameraSettings(400, 1 / 125, 11)
    shot = scene(flat(0.05, 96), reference=first)
    captures = [camera.capture(shot, s, 3) for s in (first, second)]
    times = (1.01 / 4000 - 20e-6, 1.01 / 125 - 20e-6)
    expected = 4 * times[1] / times[0] * (0.95 / 1.03) / 8  # f/4 to f/11: three stops of light
    for name, rel in (("mean", 1e-5), ("sample", 1e-3)):
        one, other = (getattr(c, name).double().mean() for c in captures)
        assert float(other / one) == pytest.approx(expected, rel=rel)
    # A stop without an entry has no error.
    plain = camera.capture(shot, replace(first, f_number=8), 3).mean.mean()
    assert float(captures[0].mean.mean() / plain) == pytest.approx(4 * 1.03, rel=1e-5)
    offset = (2 / 16000, -1.5 / 16000, 0.0, 1 / 16000)
    dark = ReferenceCamera(sensor(1e-4, 1e-6), body=BodyError(black_offset=offset))
    capture = dark.capture(scene(flat(0.0, 200)), BASE, 0)
    np.testing.assert_allclose(capture.sample.mean((1, 2)), offset, atol=5 * 1e-3 / 200)
    np.testing.assert_allclose(capture.mean.mean((1, 2)), offset, rtol=1e-5)
    np.testing.assert_allclose(capture.sample.var((1, 2)), 1e-6, rtol=0.04)


def test_drawn_bodies():
    assert BodyError().light_error(CameraSettings(800, 1 / 8000, 22)) == 1.0
    bodies = [BodyError.draw(Z6, seed) for seed in range(300)]
    assert bodies[5] == BodyError.draw(Z6, 5) != bodies[6]
    assert min(b.exposure_time(1 / 8000) for b in bodies) > 0
    assert np.std([b.shutter_delay for b in bodies]) == pytest.approx(15e-6, rel=0.2)
    assert 1.8 < np.abs([b.black_offset for b in bodies]).max() * 14512 <= 2.0
    light = np.array([list(b.transmission.values()) for b in bodies])
    assert light.std() == pytest.approx(0.02, rel=0.1)
    assert np.abs(light).max() <= 0.06
    assert CameraSettings(100, 1, 22).aperture_stop in bodies[5].transmission


def test_same_seed_same_capture():
    camera, shot = ReferenceCamera(Z6), scene(flat(0.2, 16))
    first = camera.capture(shot, BASE, 4)
    state = torch.get_rng_state()
    again = camera.capture(shot, BASE, 4, light=camera.blurred_light(shot, 4.0))
    assert torch.equal(torch.get_rng_state(), state)  # nothing draws from the global generator
    assert torch.equal(first.sample, again.sample)
    assert again.settings == BASE
    # Captures of a sequence do not repeat each other's noise, whatever seed or setting differs.
    changes = [{}, {"iso": 200}, {"exposure_time": 1 / 128}, {"f_number": 8}, {}]
    dark, settings = scene(flat(0.0, 40)), [replace(BASE, **change) for change in changes]
    seeds = zip(settings, (4, 4, 4, 4, 5), strict=True)
    drawn = [camera.capture(dark, each, seed) for each, seed in seeds]
    correlation = torch.corrcoef(torch.stack([capture.sample.flatten() for capture in drawn]))
    assert float((correlation - torch.eye(5)).abs().max()) < 5 / math.sqrt(4 * 40 * 40)


def test_bad_input_is_refused():
    plain, depth = sensor(1e-4, 1e-8), torch.full((8, 8), 2.0)
    blind = ReferenceCamera(replace(plain, pixel_pitch_um=None))
    assert torch.equal(blind.blurred_light(scene(flat(0.1)), 4.0), flat(0.1))  # no depth, no need
    late = ReferenceCamera(plain, body=BodyError(shutter_delay=-0.001))
    brief, drawing = replace(BASE, exposure_time=1 / 2000), np.random.default_rng(0)
    bad = [torch.where(torch.eye(8) > 0, z, depth) for z in (0.0, -1.0, 0.04, math.nan)]
    for call, arguments, message in (
        *((scene, (light,), "`light`") for light in (flat(-0.1), torch.zeros(3, 7, 8))),
        *((scene, (flat(0.1), each), "`depth`") for each in (*bad, depth[:, :4])),
        *((Lens, (0.05, far), "`focus_distance`") for far in (0.05, -1.0, math.nan)),
        *((Lens, (focal, math.inf), "`focal_length`") for focal in (0.0, math.inf, math.nan)),
        (partial(ReferenceCamera, plain, box_factor=0), (), "`box_factor`"),
        (ReferenceCamera, (replace(plain, nlf_by_iso={}),), "noise calibration"),
        (blind.blurred_light, (scene(flat(0.1), depth + 1), 4.0), "pixel pitch"),
        (late.capture, (scene(flat(0.1)), brief, 0), "`exposure_time`"),
        # No exposure of the levels suits these.
        *((sequences.draw_settings, (lux, drawing, Z6), "`illuminance`") for lux in (0.0, 1e-3)),
        (Sequence, (lit_scene(), (CameraSettings(100, 1, 4),)), "`settings`"),
        (select_pairs, ([], "noises", Z6), "`stage`"),
    ):
        with pytest.raises(ValueError, match=message):
            call(*arguments)


def test_lamps_show_bands_and_moving_images_are_smeared_over_the_true_exposure_time():
    camera = ReferenceCamera(sensor(1e-5, 1e-8, row_time=1e-3), box_factor=2)
    # On for 5 ms of every 10; exposed for 1 us, four sensor rows of 1 ms to a packed row.
    lit = PulsedLamp(frequency=100.0, duty=0.5)
    settings = CameraSettings(100, 1e-6, 4)
    lights = (
        camera.clip(camera.expose(flat(0.1, 10), BASE, settings, lamp=lamp), 100)
        for lamp in (lit, None)
    )
    # Sensor rows begin at 0, 1, ... 19 ms: lit in 0 to 4 and 10 to 14.
    shares = [np.mean([t % 10 < 5 for t in range(4 * row, 4 * row + 4)]) for row in range(5)]
    bands = torch.div(*lights)[:, :, 0]
    np.testing.assert_allclose(bands, 2.0 * np.array([shares] * 4), rtol=1e-5)
    # A whole period has no bands.
    shot, whole = scene(flat(0.1, 10)), CameraSettings(100, 0.01, 4)
    even = camera.capture(shot, whole, seed=0, lamp=lit, start=0.0031).mean
    np.testing.assert_allclose(even, camera.capture(shot, whole, seed=0).mean)
    light = torch.zeros(4, 20, 80)
    light[:, :, 40] = 1.0
    camera = ReferenceCamera(sensor(1e-4, 1e-8), body=BodyError(shutter_scale=0.5))
    settings = replace(BASE, exposure_time=1 / 16)
    signal = camera.expose(light, settings, settings, image_speed=4.0)[0, 0].double().numpy()
    extent = 4.0 * 1.5 / 16 * 20  # frame heights per second, seconds, pixels per frame height
    assert signal.sum() == pytest.approx(1.5, rel=1e-5)
    assert signal @ (np.arange(80) - 40) ** 2 / 1.5 == pytest.approx(extent**2 / 12, rel=1e-3)


@pytest.mark.parametrize("sigma", [0.0, 0.3, 0.5, 1.2])
def test_the_lens_is_scipys_gaussian(sigma: float) -> None:
    light = np.random.default_rng(0).random((3, 21, 34), dtype=np.float32)
    reach = max(1, int(np.ceil(3 * sigma)))
    expected = gaussian_filter(light, (0, sigma, sigma), mode="nearest", radius=(0, reach, reach))
    found = reference_camera.lens_blur(torch.from_numpy(light), sigma).numpy()
    np.testing.assert_allclose(found, expected if sigma else light, atol=2e-7)


@pytest.mark.parametrize("cfa", BayerPattern)
def test_planes_are_sampled_by_their_colour_and_place(cfa: BayerPattern) -> None:
    """By the letters of the pattern; G1 is on red's rows, G2 on blue's; odd sides are cut."""
    light, red, blue = torch.rand(3, 7, 9), cfa.name.index("R"), cfa.name.index("B")
    planes = reference_camera.sample_mosaic(light, cfa)
    for plane, at in zip(planes, (red, red ^ 1, blue ^ 1, blue), strict=True):
        assert torch.equal(plane, light["RGB".index(cfa.name[at]), at // 2 : 6 : 2, at % 2 : 8 : 2])


#: What the marked f-numbers stand for: powers of sqrt(2).
EXACT_F = {4.0: 4.0, 5.6: 2**2.5, 8.0: 8.0, 11.0: 2**3.5, 16.0: 16.0, 22.0: 2**4.5}


def lit_scene(illuminance=320.0, reference=BASE, light=0.1):
    return scene(flat(light, 2), reference=reference, illuminance=illuminance)


def ideal(table: dict[float, tuple[float, float]]) -> CameraProfile:
    """A sensor of these shot and read noises by ISO."""
    nlfs = {iso: NoiseLevelFunction((s,) * 4, (r,) * 4) for iso, (s, r) in table.items()}
    return CameraProfile("ideal", BayerPattern.RGGB, (0, 0, 0, 0), 1000, 10, nlf_by_iso=nlfs)


#: Only the photons' noise, which grows with ISO.
SHOT_ONLY = ideal({iso: (1e-7 * iso, 0.0) for iso in (100.0, 400.0, 6400.0)})


def targets(camera: CameraProfile, ev: int, *settings: CameraSettings) -> set[int]:
    """What the first of these settings is paired with, where incident light has `ev`."""
    sequence = Sequence(lit_scene(2.5 * 2**ev), settings)
    return {p.target for p in select_pairs([sequence], "noise", camera) if p.source == 0}


@pytest.mark.parametrize("illuminance", [10.0, 20_000.0])
def test_20_to_25_exposures_scatter_around_the_right_one_by_three_ev(illuminance):
    rng = np.random.default_rng(1)
    drawn_settings = [sequences.draw_settings(illuminance, rng, Z6) for _ in range(40)]
    assert {20, 25} <= {len(settings) for settings in drawn_settings} <= set(range(20, 26))
    assert all(settings == sorted(set(settings)) for settings in drawn_settings)
    every = list(itertools.chain(*drawn_settings))
    assert {s.iso for s in every} <= {*sequences.ISO_SPEEDS}
    assert {s.exposure_time for s in every} <= {*sequences.EXPOSURE_TIMES}
    # EV100 = log2(N^2 / t) - log2(ISO / 100); incident light of 2.5 lux is EV 0.
    states = [(s.iso, s.exposure_time, EXACT_F[s.f_number]) for s in every]
    iso, time, f_number = np.array(states).T
    errors = math.log2(illuminance / 2.5) - np.log2(f_number**2 / time) + np.log2(iso / 100)
    assert np.abs(errors).max() <= 3 + 1e-9
    assert abs(np.median(errors)) < 0.5
    assert np.percentile(errors, 5) < -2 < 2 < np.percentile(errors, 95)
    # ISOs stay near the calibrated ones.
    few = replace(Z6, nlf_by_iso=dict.fromkeys((200.0, 1600.0), Z6.nlf(100.0)))
    isos = {s.iso for _ in range(40) for s in sequences.draw_settings(illuminance, rng, few)}
    assert 200 <= min(isos) < max(isos) <= 4000


def test_a_grey_card_lies_at_12_percent_of_white_under_an_incident_meter():
    # 320 lux is EV 7: ISO 100, 1/8 s, f/4 is right.
    # x = L t ISO / (120 N^2) with L = 0.18 E / pi and E = 2.5 lux at EV 0: 0.18 * 250 / (120 pi)
    card, settings = 0.18 * 250 / (120 * math.pi), CameraSettings(100, 1 / 8, 4)
    assert card == pytest.approx(0.119, abs=5e-4)
    assert sequences.grey_signal(lit_scene(320.0), settings) == pytest.approx(card)
    assert sequences.grey_signal(lit_scene(640.0), settings) == pytest.approx(2 * card)
    dark = lit_scene(None, CameraSettings(100, 1 / 4, 4), light=0.3)
    assert sequences.grey_signal(dark, settings) == pytest.approx(0.15)


def test_noise_targets_collect_four_times_the_light_and_are_neither_black_nor_white():
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
    source = CameraSettings(6400, 1 / 8192, 8)  # an eighth of the light of any target
    # EV 12 is ISO 100, 1/64 s, f/8; 3 EV below and 2 EV above are the limits.
    times = (2.0**-9 * 0.98, 2.0**-9 * 1.02, 2.0**-4 * 0.98, 2.0**-4 * 1.02)
    assert targets(SHOT_ONLY, 12, source, *(CameraSettings(100, t, 8) for t in times)) == {2, 3}
    # Source and target differ in exposure by 2 and in gain not at all: brought to the target's
    # exposure the source's read variance is 4 times as large.
    reads = ideal({100.0: (1e-12, 4e-6)})
    assert targets(reads, 5, *(CameraSettings(100, t, 4) for t in (0.1, 0.2001))) == {1}
    assert not targets(reads, 5, *(CameraSettings(100, t, 4) for t in (0.1, 0.1999)))


def test_the_aperture_only_opens_and_seldom_stays():
    f_numbers = (4.0, 4.0, 5.6, 5.6, 8.0, 8.0, 11.0, 11.0, 16.0, 22.0)
    settings = tuple(CameraSettings(100, 0.1 + i / 10, n) for i, n in enumerate(f_numbers))
    pairs = select_pairs([Sequence(lit_scene(), settings)] * 3, "aperture", Z6)
    same = {p for p in pairs if f_numbers[p.source] == f_numbers[p.target]}
    opened = {p for p in pairs if f_numbers[p.source] > f_numbers[p.target]}
    assert len(opened) == 3 * (10 * 9 // 2 - 4)
    assert pairs == sorted(opened | same)
    assert 0 < len(same) <= 0.1 * len(pairs)
    assert {p.sequence for p in same} == {0, 1, 2}


# -- the thin lens --------------------------------------------------------------------------------


@pytest.mark.parametrize("case", ["step", "ramp", "through_focus", "stairs", "noise", "islands"])
def test_equal_light_shows_no_seam(case):
    rng = np.random.default_rng(3)
    rows, columns = np.mgrid[:48, :40]
    diameter = {
        "step": np.where(columns < 20, -7.0, 5.0),
        "ramp": 1.0 + columns * 0.2,
        "through_focus": (columns - 20) * 0.3,
        "stairs": (columns // 8) * 3.0 - 6.0,
        "noise": rng.uniform(-8.0, 8.0, (48, 40)),
        "islands": np.where((rows // 6 + columns // 6) % 2 == 0, 0.0, 9.0),
    }[case]
    level = torch.tensor([0.2, 3.0])[:, None, None].expand(2, 48, 40)
    found = defocus(level, torch.from_numpy(diameter))
    torch.testing.assert_close(found, level.contiguous(), rtol=2e-6, atol=0.0)


@pytest.mark.parametrize("row", range(20, 44, 3))
def test_lamp_on_a_receding_floor_keeps_its_energy(row):
    # The floor rises through many layers of blur; none of them stands in the way of its neighbour.
    diameter = torch.linspace(10, 2, 64, dtype=torch.float64)[:, None].expand(64, 48)
    floor = torch.full((1, 64, 48), 0.2, dtype=torch.float64)
    lit = floor.clone()
    lit[0, row, 24] += 100.0
    gained = float((defocus(lit, diameter) - defocus(floor, diameter)).sum())
    assert gained == pytest.approx(100.0, rel=0.05)


def test_sharp_foreground_is_untouched_by_a_bright_blurred_background():
    near = np.broadcast_to(np.arange(60) < 30, (40, 60))
    low, high = np.where(near, 0.01, 50.0), np.where(near, 0.1, 900.0)
    drawn = np.random.default_rng(0).uniform(low, high, (4, 40, 60))
    light = torch.from_numpy(drawn.astype(np.float32))
    found = defocus(light, torch.from_numpy(np.where(near, 0.0, 13.0)))
    assert torch.equal(found[:, :, :30], light[:, :, :30])
    assert float(found[:, :, 30:].min()) > 50.0  # nor does the dark foreground spill over
    # Blur that is too small to see leaves every bit.
    light = torch.rand(4, 9, 13, generator=torch.Generator().manual_seed(0))
    ripple = 0.1 * torch.rand(9, 13, generator=torch.Generator().manual_seed(1))
    assert torch.equal(defocus(light, ripple - 0.05), light)


Texture = Callable[[np.ndarray, np.ndarray], np.ndarray]


def light_of_planes(hides, near, far):
    """Each plane's texture at its own rows and columns."""
    nearer = 0.5 + 0.3 * np.sin(near[0] * 0.9) * np.cos(near[1] * 0.7)
    farther = 3.0 + 1.5 * np.sin(far[0] * 0.25 + 1.0) + 0.5 * np.cos(far[1] * 0.25)
    return np.where(hides, nearer, farther)


def through_an_aperture(shape: Texture, near_blur: float, far_blur: float) -> np.ndarray:
    """What the sensor gets of two planes: a mean over aperture points and points of a pixel."""
    grid = (np.arange(20) + 0.5) / 10 - 1
    aperture = [(a, b) for a in grid for b in grid if a * a + b * b < 1]
    rows, columns = np.mgrid[:56, :72].astype(float)
    total = np.zeros(rows.shape)
    for number, (a, b) in enumerate(aperture):
        y, x = rows + (number * 0.618) % 1 - 0.5, columns + (number * 0.755) % 1 - 0.5
        near, far = ((y - blur / 2 * a, x - blur / 2 * b) for blur in (near_blur, far_blur))
        hides = shape(np.rint(near[0]), np.rint(near[1]))  # the edge of a mask of whole pixels
        total += light_of_planes(hides, near, far)
    return total / len(aperture)


SHAPES: dict[str, Texture] = {
    "half": lambda rows, columns: columns < 36,
    "pole": lambda rows, columns: abs(columns - 36) < 3,
    "disc": lambda rows, columns: (columns - 36) ** 2 + (rows - 28) ** 2 < 13**2,
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("blurs", [(0, 8), (-8, 0), (4, 10), (-10, -4), (-8, 8), (-8, 4)])
def test_two_planes_against_rays(shape, blurs):
    # What is hidden is not in the picture: it can be right only as far as the texture is smooth.
    rows, columns = np.mgrid[:56, :72]
    mask = SHAPES[shape](rows, columns)
    picture = light_of_planes(mask, (rows, columns), (rows, columns))
    diameter = torch.from_numpy(np.where(mask, *map(float, blurs)))
    found = defocus(torch.from_numpy(picture)[None], diameter)[0].numpy()
    expected = through_an_aperture(SHAPES[shape], *blurs)
    errors = ((image - expected)[10:-10, 10:-10] for image in (found, picture))
    error, change = map(np.linalg.norm, errors)
    assert error < 0.15 * change
