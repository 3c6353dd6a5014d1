"""Properties of the simulator that hold for any settings, bodies, shapes, lights and seeds."""

from __future__ import annotations

import math
from dataclasses import replace
from random import Random
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import assume, example, given
from hypothesis import strategies as st

from simulator import (
    CameraSettings,
    CameraSimulator,
    NoiseLevelFunction,
    RawImage,
    exposure_ratio,
    get_camera,
)
from simulator.camera import CameraProfile
from simulator.capture.exposure import Exposure
from simulator.capture.sensor import add_noise, clip_and_quantise, sensor_light
from simulator.noise.generator import FrameNoise, bank_normals, noise_keys, sweep_keys
from simulator.raw.image import unpack_mosaic
from tests.strategies import (
    LIGHT,
    SEEDS,
    SHAPES,
    USUAL_SETTINGS,
    Mosaic,
    cameras,
    lights,
    log_uniform,
    mosaics,
    prepared,
    settings_within,
)

SETTINGS = settings_within()
NOISES = st.sampled_from(["exact", "bank"])


# -- exposure -------------------------------------------------------------------------------------


@given(SETTINGS, SETTINGS, SETTINGS)
def test_exposure_ratios_form_a_group(
    a: CameraSettings, b: CameraSettings, c: CameraSettings
) -> None:
    # A stop is below 2**7, so each of three differences of stops is rounded by up to 2**-47; what
    # that moves a power of 2 by is below it, as ln 2 is below 1, even with the power's own ulp.
    bound = 3 * 2.0**-47
    assert exposure_ratio(a, a) == 1.0
    assert exposure_ratio(a, b) * exposure_ratio(b, a) == pytest.approx(1.0, rel=bound)
    chained = exposure_ratio(a, b) * exposure_ratio(b, c)
    assert chained == pytest.approx(exposure_ratio(a, c), rel=bound)


@given(lights(), lights(), SETTINGS, SETTINGS, cameras(noise=False))
def test_more_light_never_lowers_the_raw(
    first: torch.Tensor,
    second: torch.Tensor,
    reference: CameraSettings,
    settings: CameraSettings,
    camera: CameraProfile,
) -> None:
    second = torch.from_numpy(np.resize(second.numpy(), first.shape))
    darker, brighter = (
        prepared(f(first, second), reference, camera).expose([settings])
        for f in (torch.minimum, torch.maximum)
    )
    assert bool((darker <= brighter).all())
    numbers = np.stack([unpack_mosaic(frame[0], camera) for frame in (darker, brighter)])
    assert numbers.max() <= camera.white_level


@given(lights(LIGHT.map(abs)), SETTINGS, SETTINGS, SETTINGS, cameras(noise=False))
def test_more_exposure_never_lowers_the_raw(
    light: torch.Tensor,
    reference: CameraSettings,
    a: CameraSettings,
    b: CameraSettings,
    camera: CameraProfile,
) -> None:
    less = CameraSettings(
        min(a.iso, b.iso), min(a.exposure_time, b.exposure_time), max(a.f_number, b.f_number)
    )
    more = CameraSettings(
        max(a.iso, b.iso), max(a.exposure_time, b.exposure_time), min(a.f_number, b.f_number)
    )
    assume(exposure_ratio(less, more) >= 1.0)
    darker, brighter = prepared(light, reference, camera).expose([less, more])
    assert bool((darker <= brighter).all())


@given(mosaics(cameras()), SETTINGS, SEEDS, NOISES)
def test_simulating_the_own_settings_changes_nothing(
    mosaic: Mosaic, settings: CameraSettings, seed: int, noise: Any
) -> None:
    """A raw has its noise already; its digital numbers come back, and noise-free light as it is."""
    camera, numbers = mosaic
    raw = RawImage.from_mosaic(numbers, settings, camera)
    again = CameraSimulator(device="cpu").simulate(raw, settings, seed=seed, noise=noise)
    np.testing.assert_array_equal(again.to_mosaic(), numbers)
    assert torch.equal(prepared(raw.data, settings, camera).expected(settings), raw.data)


@given(SETTINGS)
def test_exact_stops_stand_for_themselves(settings: CameraSettings) -> None:
    recorded = CameraSettings.from_exif(settings.iso, settings.exposure_time, settings.f_number)
    thirds = -3 * recorded.time_value
    assert recorded == settings or thirds == pytest.approx(round(thirds), abs=1e-12)
    assert abs(thirds + 3 * settings.time_value) < 0.5  # never to the next one
    again = CameraSettings.from_exif(recorded.iso, recorded.exposure_time, recorded.f_number)
    assert again == recorded
    exact = replace(settings, f_number=min(max(settings.effective_f_number, 0.5), 1024.0))
    assert exposure_ratio(settings, exact) == 1.0


# -- noise ----------------------------------------------------------------------------------------


@example(  # a variance beyond float32
    torch.zeros(4, 1, 1),
    get_camera("nikon_z6"),
    CameraSettings(1e-3, 1e-9, 1024),
    [CameraSettings(1e8, 1e5, 0.5)],
    {"gain": 1e39},
    True,
    0,
    "exact",
    Random(0),
)
@given(
    lights(),
    cameras(),
    SETTINGS,
    st.lists(st.one_of(SETTINGS, USUAL_SETTINGS), min_size=1, max_size=5),
    st.sampled_from(
        [
            {},
            {"image_speed": 0.5},
            {"defocus": 3.0, "tolerance": 0.0},
            {"gain": 0.0},
            {"gain": 1e39},
        ]
    ),
    st.booleans(),
    SEEDS,
    NOISES,
    st.randoms(use_true_random=False),
)
def test_a_frame_is_the_same_alone_in_a_sweep_and_in_any_order(
    light: torch.Tensor,
    camera: CameraProfile,
    reference: CameraSettings,
    states: list[CameraSettings],
    fields: dict[str, float],
    is_noisy: bool,
    seed: int,
    noise: Any,
    random: Any,
) -> None:
    nlf = camera.nlf(reference.iso) if is_noisy else None
    source = prepared(light, reference, camera, nlf, **fields)
    sweep = source.expose(states, seed=seed, noise=noise)
    span = torch.tensor(camera.pedestal)[:, None, None]
    assert bool(((sweep >= -span * (1 + 1e-6) - 1e-6) & (sweep <= 1)).all())
    order = random.sample(range(len(states)), len(states))
    permuted = source.expose([states[i] for i in order], seed=seed, noise=noise)
    assert torch.equal(permuted, sweep[order])
    streamed = list(source.stream(states, seed=seed, noise=noise))
    fresh = prepared(light, reference, camera, nlf, **fields)
    for state, frame, in_stream in zip(states, sweep, streamed, strict=True):
        again, excess = fresh.capture(state, seed, noise=noise)
        assert torch.equal(again, frame)
        assert 0.0 <= excess < math.inf
        assert torch.equal(in_stream, frame)


@given(SHAPES, st.lists(st.integers(0, 2**64 - 1), min_size=2, max_size=2, unique=True), NOISES)
def test_other_seeds_give_other_frames(
    shape: tuple[int, int], seeds: list[int], noise: Any
) -> None:
    state = CameraSettings(6400, 0.01, 4)
    source = prepared(torch.full((4, *shape), 0.3), state, get_camera("nikon_z6"))
    first, second = (source.expose([state], seed=seed, noise=noise) for seed in seeds)
    assert not torch.equal(first, second)


@given(
    st.floats(0.2, 0.6),
    st.tuples(*[st.tuples(st.floats(0.5, 0.95), st.floats(1.2, 4.0))] * 2),
    log_uniform(1e-6, 1e-4),
    log_uniform(1e-9, 1e-7),
    st.sampled_from([1, 2, 5]),
    SEEDS,
)
def test_two_hops_have_the_noise_of_one(
    level: float,
    hops: tuple[tuple[float, float], tuple[float, float]],
    shot: float,
    read: float,
    box_factor: int,
    seed: int,
) -> None:
    """Each hop is a share of the light at a higher ISO: the source never has too much noise.

    All levels are more than ten standard deviations from both clips.
    """
    nlf = NoiseLevelFunction((shot,) * 4, (read,) * 4)
    camera = CameraProfile("fine", "RGGB", 8192.0, 2**16 - 1, 16, nlf_by_iso={100.0: nlf})  # type: ignore[arg-type]
    start = CameraSettings(100, 1.0, 4)
    (first, gain), (second, more) = hops
    middle = CameraSettings(100 * gain, first / gain, 4)
    last = CameraSettings(100 * gain * more, first * second / (gain * more), 4)
    simulator = CameraSimulator(device="cpu")
    clean = prepared(torch.full((4, 64, 64), level), start, camera, box_factor=box_factor)
    source = simulator.simulate(clean, start, seed=seed)
    one = simulator.simulate(source, last, seed=seed + 1)
    two = simulator.simulate(simulator.simulate(source, middle, seed=seed + 2), last, seed=seed + 3)

    ratio, wanted = exposure_ratio(start, last), camera.nlf(last.iso).scaled(1 / box_factor**2)
    mean = level * ratio
    variance = wanted.shot[0] * mean + wanted.read[0]
    count = 4 * 64 * 64
    rounding = (ratio**2 + exposure_ratio(middle, last) ** 2 + 1) / (12 * camera.span[0] ** 2)
    for raw in (one, two):
        data = raw.data.double()
        assert abs(float(data.mean()) - mean) < 5 * math.sqrt(variance / count)
        assert abs(float(data.var()) - variance) < 5 * variance * math.sqrt(2 / count) + rounding
        assert raw.metadata["excess_noise"] < 1e-6
        assert raw.noise.shot == pytest.approx(wanted.shot, rel=1e-6)
        assert raw.noise.read == pytest.approx(wanted.read, rel=1e-6)


@given(
    st.integers(0, 2**64 - 1),
    st.lists(st.floats(allow_nan=False), max_size=4),
    st.integers(2, 40),
)
def test_noise_keys_are_of_seed_and_numbers_alone(seed: int, numbers: list[float], n: int) -> None:
    (key,) = noise_keys(seed, *numbers)
    batch = noise_keys(np.full(n, seed, np.uint64), *(np.full(n, v) for v in numbers))
    assert bool((batch == key).all())
    others = np.arange(n, dtype=np.uint64) ^ np.uint64(seed)
    keys = noise_keys(others, *numbers)
    assert len(set(keys.tolist())) == n
    assert keys[0] == key
    if numbers:  # another last number, another key
        last = np.arange(float(n))
        assert len(set(noise_keys(seed, *numbers[:-1], last).tolist())) == n
        assert noise_keys(seed, *numbers[:-1])[0] != key
    planes = bank_normals(int(key), (4, 1, n))
    assert np.array_equal(planes[:, 0, :1], bank_normals(int(key), (4, 1, 1))[:, 0])


@given(st.sampled_from(["nikon_z6", "canon_70d"]), log_uniform(1e-3, 1e8), log_uniform(1, 4))
def test_noise_grows_with_iso_within_a_conversion_gain(name: str, iso: float, more: float) -> None:
    camera = get_camera(name)
    higher = iso * more
    assume(not any(iso < start <= higher for start in camera.segments))
    nlf, noisier = camera.nlf(iso), camera.nlf(higher)
    assert nlf.extrapolated == (not min(camera.nlf_by_iso) <= iso <= max(camera.nlf_by_iso))
    for low, high in zip((*nlf.shot, *nlf.read), (*noisier.shot, *noisier.read), strict=True):
        assert 0.0 < low <= high * (1 + 1e-12)
    assert nlf.exposed(more).scaled(1 / 4).shot == pytest.approx([s * more / 4 for s in nlf.shot])


# -- plans ----------------------------------------------------------------------------------------


@given(
    lights(st.floats(-0.0625, 4.0, width=32)),
    cameras(),
    SETTINGS,
    st.one_of(SETTINGS, USUAL_SETTINGS),
    st.booleans(),
    st.sampled_from([0.0, 0.3]),
    st.sampled_from([0.0, 3.0]),
    SEEDS,
)
def test_tolerance_0_leaves_out_only_what_changes_no_pixel(
    light: torch.Tensor,
    camera: CameraProfile,
    reference: CameraSettings,
    settings: CameraSettings,
    is_noisy: bool,
    image_speed: float,
    defocus: float,
    seed: int,
) -> None:
    """Against every step run one by one; the numbers of a plan are finite at any tolerance."""
    nlf = camera.nlf(reference.iso) if is_noisy else NoiseLevelFunction.zero()
    fields = {"image_speed": image_speed, "defocus": defocus}
    source = prepared(light, reference, camera, nlf, **fields, tolerance=0.0)
    for tolerance in (0.0, 0.1):
        plan = replace(source, tolerance=tolerance).plan(settings)
        assert math.isfinite(plan.predicted_error)
        assert math.isfinite(plan.predicted_difference)
        assert math.isfinite(plan.predicted_rmse)
        assert math.isfinite(plan.excess_noise)
        assert plan.excess_noise >= 0.0
        assert {*plan.modules, *plan.left_out} >= {"exposure", "defocus", "motion_blur", "noise"}
    everything = Exposure(
        exposure_ratio(reference, settings),
        nlf,
        camera.nlf(settings.iso),
        motion_px=image_speed * settings.exposure_time * light.shape[1],
        defocus_px=defocus * 4.0 / settings.effective_f_number,
    )
    noise = FrameNoise(int(sweep_keys(seed, [settings])[0]))
    noisy, _ = add_noise(sensor_light(light, everything)[None], [everything], [noise])
    wanted = unpack_mosaic(clip_and_quantise(noisy[0], camera), camera)
    found = unpack_mosaic(source.capture(settings, seed)[0], camera)
    steps = np.abs(found.astype(np.int64) - wanted)
    assert steps.max() <= 1  # a sum in another order may round to the next number


# -- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "rule"),
    [
        (lambda: CameraSettings(10**400, 0.01, 4), "`iso` .* must be a number in"),
        (lambda: replace(get_camera("nikon_z6"), white_level=15520.5), "must be a whole number"),
        (lambda: replace(get_camera("nikon_z6"), bit_depth=10.5), "must be an integer in"),
        (lambda: get_camera("nikon_z6").nlf("100"), "`iso` .* must be positive"),
        (
            lambda: RawImage(
                torch.zeros(4, 1, 1), CameraSettings(1, 1, 1), get_camera("nikon_z6"), box_factor=0
            ),
            "`box_factor` .* must be an integer >= 1",
        ),
    ],
)
def test_what_no_property_holds_for_is_refused(make: Any, rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        make()
