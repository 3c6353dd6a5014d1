"""The simulator's plan, its seeds, its limits, and what it says about its own errors."""

from __future__ import annotations

import itertools
import math
import weakref
from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from simulator import (
    CameraProfile,
    CameraSettings,
    CameraSimulator,
    NoiseLevelFunction,
    PreparedScene,
    RawImage,
    get_camera,
)

Z6 = get_camera("nikon_z6")
PEDESTAL = 1008 / 14512
BASE = CameraSettings(100, 1 / 64, 4)
STATES = [
    CameraSettings(iso, exposure_time, f_number)
    for iso, exposure_time, f_number in itertools.product(
        (100, 400, 1600, 6400), (1 / 1000, 1 / 125, 1 / 15, 1 / 2), (4, 5.6, 8, 11)
    )
]
ZERO = NoiseLevelFunction.zero()


@pytest.fixture
def simulator() -> CameraSimulator:
    return CameraSimulator(device="cpu")


def picture(height: int = 16, width: int = 20, scale: float = 1.0, seed: int = 0) -> torch.Tensor:
    values = np.random.default_rng(seed).random((4, height, width), dtype=np.float32)
    return torch.from_numpy(values) * scale


def numbers(data: torch.Tensor) -> np.ndarray:
    return data.double().numpy() * 14512 + 1008


# Seeds


def test_the_same_seed_gives_the_same_frame_alone_in_a_sweep_and_in_simulate(
    simulator: CameraSimulator,
) -> None:
    raw = RawImage(picture(), BASE, Z6)
    prepared = simulator.prepare(raw, image_speed=0.5, defocus=1.5)
    sweep = prepared.expose(STATES, seed=11)
    assert sweep.shape == (64, 4, 16, 20)
    assert sweep.dtype == torch.float32
    for index in (0, 17, 42, 63):
        assert torch.equal(prepared.capture(STATES[index], 11)[0], sweep[index])
        alone = simulator.simulate(raw, STATES[index], seed=11, image_speed=0.5, defocus=1.5)
        assert torch.equal(alone.data, sweep[index])
    assert torch.equal(prepared.expose(STATES[::-1], seed=11), sweep.flip(0))
    assert torch.equal(torch.stack(list(prepared.stream(STATES, seed=11))), sweep)


def test_other_seeds_and_settings_draw_independent_noise() -> None:
    """Standardised noise of every pair of frames is uncorrelated, within 5 / sqrt(n)."""
    prepared = PreparedScene(torch.full((4, 64, 64), 0.3), BASE, Z6, ZERO)
    same_light = [CameraSettings(100, 1 / 64, 4), CameraSettings(200, 1 / 128, 4)]
    same_light += [CameraSettings(100, 1 / 32, 5.6), CameraSettings(400, 1 / 64, 8)]
    frames = [prepared.capture(BASE, seed)[0] for seed in range(6)]
    frames += [prepared.capture(settings, 0)[0] for settings in same_light[1:]]
    correlation = np.corrcoef([frame.flatten().numpy() for frame in frames])
    assert np.abs(correlation - np.eye(len(frames))).max() < 5 / math.sqrt(frames[0].numel())


def test_planes_and_pixels_are_independent() -> None:
    frame = (
        PreparedScene(torch.full((4, 128, 128), 0.3), BASE, Z6, ZERO).capture(BASE, 0)[0].double()
    )
    frame = frame - frame.mean((1, 2), keepdim=True)
    frame = frame / frame.std((1, 2), keepdim=True)
    bound = 5 / math.sqrt(128 * 128)
    planes = (frame[:, None] * frame[None]).mean((2, 3)) - torch.eye(4)
    assert float(planes.abs().max()) < bound
    assert float((frame[:, :, 1:] * frame[:, :, :-1]).mean((1, 2)).abs().max()) < bound
    assert float((frame[:, 1:] * frame[:, :-1]).mean((1, 2)).abs().max()) < bound


def test_global_random_state_is_neither_read_nor_written(simulator: CameraSimulator) -> None:
    raw = RawImage(picture(), BASE, Z6)
    torch.manual_seed(0)
    first = simulator.simulate(raw, STATES[40], seed=1)
    before = torch.random.get_rng_state()
    second = simulator.simulate(raw, STATES[40], seed=1)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert torch.equal(first.data, second.data)


# The plan


def test_plan_of_a_still_far_scene(simulator: CameraSimulator) -> None:
    raw = RawImage(picture(scale=0.5), BASE, Z6)
    plan = simulator.plan(raw, CameraSettings(1600, 1 / 64, 8))
    assert plan.exposure_ratio == pytest.approx(4.0)
    assert plan.modules == ("exposure", "noise", "clip_and_quantise")
    assert set(plan.left_out) == {"noise_reduction", "aperture", "defocus", "motion_blur"}
    assert "far or in focus" in plan.left_out["defocus"]
    assert "does not move" in plan.left_out["motion_blur"]
    assert plan.excess_noise == 0.0
    assert plan.predicted_rmse == 0.0
    assert plan.clipped_source == 0.0
    assert not plan.extrapolated_noise
    assert plan.operations > 0


def test_plan_names_what_a_moving_near_scene_needs(simulator: CameraSimulator) -> None:
    raw = RawImage(picture(), BASE, Z6)
    target = CameraSettings(1600, 1 / 8, 11)  # 16 * 8 / 8 = 16 times the light
    near = simulator.plan(raw, target, image_speed=0.5, defocus=3.0)
    assert near.modules == ("exposure", "defocus", "motion_blur", "noise", "clip_and_quantise")
    assert set(near.left_out) == {"noise_reduction", "aperture"}
    assert near.operations > simulator.plan(raw, target).operations
    fast = simulator.plan(raw, CameraSettings(1600, 1 / 100_000, 4), image_speed=0.5)
    assert "which would hardly show" in fast.left_out["motion_blur"]


def test_plan_without_noise_to_add(simulator: CameraSimulator) -> None:
    raw = RawImage(picture(), CameraSettings(6400, 1 / 64, 4), Z6)
    plan = simulator.plan(raw, CameraSettings(100, 1 / 64, 4))  # darker by the gain alone
    assert "noise" in plan.modules  # 64 times less signal: the target's shot noise is larger
    plan = simulator.plan(raw, CameraSettings(100, 1.0, 4))  # the same light on the sensor
    assert "noise" in plan.left_out
    assert "noise" not in plan.modules
    assert plan.excess_noise > 10


def test_declared_excess_and_error_in_closed_form(simulator: CameraSimulator) -> None:
    """A flat ISO 6400 source recorded at ISO 100 and 64 times the time: its variance stays."""
    raw = RawImage(torch.full((4, 8, 8), 0.25), CameraSettings(6400, 1 / 64, 4), Z6)
    plan = simulator.plan(raw, CameraSettings(100, 1.0, 4))
    shot1 = np.array([0.000536276798657206, 0.000529454489967193, 0.000460526436255436])
    read1 = np.array([6.94797157253651e-07, 7.25184811907467e-07, 7.1397833103636e-07])
    shot2 = np.array([7.88891432059205e-06, 7.47234302281224e-06, 7.31670099946593e-06])
    read2 = np.array([5.71150998895191e-09, 5.73712214136873e-09, 5.59509111432998e-09])
    source, target = read1 + shot1 * 0.25, read2 + shot2 * 0.25
    planes = [0, 1, 1, 2]
    assert plan.excess_noise == pytest.approx((source / target - 1)[planes].mean(), rel=1e-4)
    assert plan.predicted_rmse == pytest.approx(
        math.sqrt((source - target)[planes].mean()), rel=1e-4
    )
    out = simulator.simulate(raw, CameraSettings(100, 1.0, 4))
    assert out.metadata["excess_noise"] == pytest.approx(plan.excess_noise, rel=1e-4)


def test_saturated_source_is_declared(simulator: CameraSimulator) -> None:
    data = picture(10, 10, 0.5)
    data[2, :3, :] = 1.0
    raw = RawImage(data, BASE, Z6)
    darker = CameraSettings(100, 1 / 256, 4)
    assert simulator.plan(raw, darker).clipped_source == pytest.approx(0.3)
    assert simulator.simulate(raw, darker).metadata["clipped_source"] == pytest.approx(0.3)
    prepared = simulator.prepare(raw)
    assert prepared.saturated is not None
    assert prepared.saturated[:3].all()
    assert not prepared.saturated[3:].any()


def test_extrapolated_noise_is_declared(simulator: CameraSimulator) -> None:
    raw = RawImage(picture(), BASE, Z6)
    assert simulator.plan(raw, CameraSettings(25_600, 1 / 64, 4)).extrapolated_noise
    assert not simulator.plan(raw, CameraSettings(600, 1 / 64, 4)).extrapolated_noise


def test_plan_prints_itself(simulator: CameraSimulator) -> None:
    text = str(simulator.plan(RawImage(picture(), BASE, Z6), CameraSettings(25_600, 1 / 64, 4)))
    assert text.startswith("ISO 25600, 1/64 s, f/4: 256 x the light of the source")
    assert "exposure -> noise -> clip_and_quantise" in text
    assert "left out  motion_blur: the image does not move" in text
    assert "outside the camera's noise calibration" in text


# prepare and simulate


def test_same_settings_give_the_same_digital_numbers(simulator: CameraSimulator) -> None:
    mosaic = np.random.default_rng(0).integers(0, 15521, (18, 22))
    raw = RawImage.from_mosaic(mosaic, BASE, Z6)
    np.testing.assert_array_equal(simulator.simulate(raw, BASE, seed=5).to_mosaic(), mosaic)


def test_simulate_keeps_what_is_known(simulator: CameraSimulator) -> None:
    raw = RawImage(
        picture(), BASE, Z6, white_balance=(2.0, 1.0, 1.5), box_factor=2, metadata={"path": "a.nef"}
    )
    target = CameraSettings(400, 1 / 32, 5.6)
    out = simulator.simulate(raw, target, seed=3)
    assert out.settings == target
    assert out.camera is Z6
    assert out.white_balance == (2.0, 1.0, 1.5)
    assert out.box_factor == 2
    assert out.noise.shot[1] == pytest.approx(3.09620813305867e-05 / 4)
    assert out.metadata["path"] == "a.nef"
    assert out.metadata["simulated_from"] == "ISO 100, 1/64 s, f/4"
    assert out.metadata["seed"] == 3
    assert raw.metadata == {"path": "a.nef"}


def test_box_averaged_pixels_carry_less_noise(simulator: CameraSimulator) -> None:
    prepared = PreparedScene(torch.full((4, 128, 128), 0.5), BASE, Z6, ZERO, box_factor=4)
    capture, _ = prepared.capture(CameraSettings(6400, 1 / 4096, 4), 0)
    expected = (7.25184811907467e-07 + 0.5 * 0.000529454489967193) / 16 + 1 / 12 / 14512**2
    relative = 5 * math.sqrt(2 / 128**2)
    assert float(capture[1].double().var()) == pytest.approx(expected, rel=relative)


def test_scene_arguments_replace_only_themselves(simulator: CameraSimulator) -> None:
    prepared = PreparedScene(picture(), BASE, Z6, ZERO, image_speed=0.5, defocus=2.0)
    assert simulator.prepare(prepared).image_speed == 0.5
    assert simulator.prepare(prepared, image_speed=0.0).image_speed == 0.0
    assert simulator.prepare(prepared, image_speed=0.0).defocus == 2.0
    assert simulator.prepare(prepared, defocus=1.0).image_speed == 0.5


def test_anything_with_a_prepared_scene_is_a_source(simulator: CameraSimulator) -> None:
    prepared = PreparedScene(picture(), BASE, Z6, ZERO)
    scene = SimpleNamespace(prepared=prepared)
    assert torch.equal(
        simulator.simulate(scene, STATES[9], seed=1).data,
        simulator.simulate(prepared, STATES[9], seed=1).data,
    )


def test_an_uncalibrated_camera_uses_the_raws_own_noise(simulator: CameraSimulator) -> None:
    unknown = CameraProfile("unknown", "RGGB", 64.0, 1023, 10)  # type: ignore[arg-type]
    own = NoiseLevelFunction((1e-4,) * 4, (1e-6,) * 4)
    raw = RawImage(picture(), BASE, unknown, nlf=own)
    out = simulator.simulate(raw, CameraSettings(200, 1 / 64, 4))
    assert out.noise.shot == pytest.approx((2e-4,) * 4)
    assert out.noise.read == pytest.approx((4e-6,) * 4)
    assert simulator.plan(raw, CameraSettings(200, 1 / 64, 4)).extrapolated_noise
    with pytest.raises(ValueError, match="no noise calibration"):
        simulator.simulate(RawImage(picture(), BASE, unknown), BASE)


def test_expected_is_the_light_without_noise_or_clip(simulator: CameraSimulator) -> None:
    light = picture(scale=3.0)
    prepared = PreparedScene(light, BASE, Z6, ZERO)
    brighter = prepared.expected(CameraSettings(800, 1 / 128, 4))
    np.testing.assert_allclose(brighter.numpy(), 4 * light.numpy(), rtol=1e-6)
    moving = PreparedScene(light, BASE, Z6, ZERO, image_speed=0.5)
    assert moving.exposure(CameraSettings(100, 0.25, 4)).motion_px == pytest.approx(0.5 * 0.25 * 16)
    near = PreparedScene(light, BASE, Z6, ZERO, defocus=2.0)
    assert near.exposure(CameraSettings(100, 0.25, 8)).defocus_px == pytest.approx(1.0)
    assert near.exposure(CameraSettings(100, 0.25, 2.8)).defocus_px == pytest.approx(2 * 2**0.5)


# Sizes and extremes


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1), (3, 5), (17, 31), (33, 16)])
def test_any_size(simulator: CameraSimulator, shape: tuple[int, int]) -> None:
    raw = RawImage(picture(*shape), BASE, Z6)
    for scene in ({}, {"image_speed": 2.0, "defocus": 3.0}):
        out = simulator.simulate(raw, CameraSettings(800, 1.0, 4), **scene)
        assert out.data.shape == (4, *shape)
        assert torch.isfinite(out.data).all()


def dark_and_bright(exponent: int) -> tuple[CameraSettings, CameraSettings]:
    """Settings whose exposures differ by 2**exponent, about half in gain and half in time."""
    gain = 9 * exponent // 20
    return (
        CameraSettings(100, 2.0**-10, 4),
        CameraSettings(100 * 2.0**gain, 2.0 ** (exponent - gain - 10), 4),
    )


@pytest.mark.parametrize("exponent", [-40, -20, 0, 20, 40])
@pytest.mark.parametrize("source", [ZERO, Z6.nlf(400)], ids=["clean", "noisy"])
@pytest.mark.parametrize("blur", [False, True])
def test_extreme_light_and_ratios_stay_finite(
    exponent: int, source: NoiseLevelFunction, blur: bool
) -> None:
    dark, bright = dark_and_bright(abs(exponent))
    reference, target = (dark, bright) if exponent >= 0 else (bright, dark)
    light = torch.zeros(4, 8, 8)
    light[:, 0] = 1e30
    light[:, 1] = 1e-30
    light[:, 2] = -PEDESTAL
    light[:, 3] = -1e30
    light[:, 4] = 3e38
    prepared = PreparedScene(
        light, reference, Z6, source, image_speed=0.1 * blur, defocus=2.0 * blur
    )
    capture, excess = prepared.capture(target, 0)
    plan = prepared.plan(target)
    assert torch.isfinite(capture).all()
    assert float(capture.min()) >= -PEDESTAL * (1 + 1e-6)
    assert float(capture.max()) <= 1.0
    assert torch.isfinite(prepared.expected(target)).all()
    assert math.isfinite(excess)
    assert excess >= 0
    for value in (plan.excess_noise, plan.predicted_rmse, plan.exposure_ratio):
        assert math.isfinite(value)
        assert value >= 0
    if not blur:
        assert torch.all(capture[:, [0, 4]] == 1.0)
        assert np.all(numbers(capture[:, 3]) < 0.01)


@pytest.mark.parametrize("exponent", [-40, -20, 20, 40])
def test_the_mean_is_right_at_extreme_ratios(exponent: int) -> None:
    """0.3 of white at the target, whatever the reference's scale was."""
    dark, bright = dark_and_bright(abs(exponent))
    reference, target = (dark, bright) if exponent >= 0 else (bright, dark)
    quiet = CameraProfile("quiet", "RGGB", 1008.0, 15520.0, 14, nlf_by_iso={100: ZERO})  # type: ignore[arg-type]
    prepared = PreparedScene(torch.full((4, 2, 2), 0.3 * 2.0**-exponent), reference, quiet, ZERO)
    capture, _ = prepared.capture(target, 0)
    assert np.unique(np.rint(numbers(capture))).tolist() == [round(0.3 * 14512 + 1008)]


@pytest.mark.parametrize("iso", [25, 50, 25_600, 409_600])
def test_isos_far_outside_the_table(iso: float) -> None:
    prepared = PreparedScene(torch.full((4, 64, 64), 0.2), CameraSettings(iso, 1 / 64, 4), Z6, ZERO)
    capture, _ = prepared.capture(CameraSettings(iso, 1 / 64, 4), 0)
    assert torch.isfinite(capture).all()
    if iso < 100:
        variance = 5.73712214136873e-09 * (iso / 100) ** 2 + 0.2 * 7.47234302281224e-06 * iso / 100
        measured = float(capture[1].double().var()) - 1 / 12 / 14512**2
        assert measured == pytest.approx(variance, rel=5 * math.sqrt(2 / 64**2))


def test_a_streak_longer_than_the_frame_by_far() -> None:
    prepared = PreparedScene(picture(8, 8), BASE, Z6, ZERO, image_speed=8.0)
    capture, _ = prepared.capture(CameraSettings(100, 1000.0, 1024.0), 0)
    assert torch.isfinite(capture).all()


def test_a_large_sweep_streams_one_frame_at_a_time() -> None:
    """1500 x 2000 packed: settings are taken one by one, and frames handed out are not kept."""
    taken: list[CameraSettings] = []

    def states() -> Iterator[CameraSettings]:
        for state in (STATES[0], STATES[63]):
            taken.append(state)
            yield state

    prepared = PreparedScene(torch.full((4, 1500, 2000), 0.01), BASE, Z6, ZERO)
    frames = prepared.stream(states(), seed=0)
    assert not taken
    frame = next(frames)
    assert len(taken) == 1
    assert frame.shape == (4, 1500, 2000)
    kept = weakref.ref(frame)
    del frame
    assert kept() is None
    # ISO 6400, 1/2 s, f/11 against ISO 100, 1/64 s, f/4: 64 * 32 / 8 = 256 times the light
    assert float(next(frames).min()) == 1.0
    assert len(taken) == 2


# Errors


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s, raw: s.simulate(raw.data, BASE), "`source` .=Tensor. must be a RawImage"),
        (lambda s, raw: s.simulate("a.nef", BASE), "`source`"),
        (lambda s, raw: s.simulate(raw, BASE, seed=-1), "`seed`"),
        (lambda s, raw: s.simulate(raw, BASE, image_speed=-1.0), "`image_speed`"),
        (lambda s, raw: s.simulate(raw, BASE, image_speed=math.nan), "`image_speed`"),
        (lambda s, raw: s.simulate(raw, BASE, defocus=math.inf), "`defocus`"),
        (lambda s, raw: PreparedScene(raw.data[:3], BASE, Z6, ZERO), "`light`"),
        (lambda s, raw: PreparedScene(raw.data * math.nan, BASE, Z6, ZERO), "`light`"),
        (lambda s, raw: CameraSimulator(device="abacus"), "`device`"),
    ],
)
def test_bad_input_is_named(simulator: CameraSimulator, call, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=message):
        call(simulator, RawImage(picture(), BASE, Z6))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_gives_the_same_digital_numbers() -> None:
    raw = RawImage(picture(33, 31), BASE, Z6)
    for scene in ({}, {"image_speed": 0.5, "defocus": 2.0}):
        frames = [
            CameraSimulator(device).simulate(raw, STATES[40], seed=2, **scene).data.cpu()
            for device in ("cpu", "cuda")
        ]
        off = np.abs(numbers(frames[0]) - numbers(frames[1]))
        assert off.max() < 1.01  # rounding may fall either way
        assert (off > 0.5).mean() < 1e-3


def test_a_noisy_source_is_stated_in_the_result() -> None:
    """ISO 6400 exposed at ISO 100: what remains is the source's noise, and the raw must say so."""
    camera = get_camera("nikon_z6")
    noisy, clean = CameraSettings(6400, 1 / 64, 4), CameraSettings(100, 1 / 64, 4)
    ratio = 100 / 6400
    raw = RawImage(torch.full((4, 8, 8), 0.5), noisy, camera)
    stated = CameraSimulator(device="cpu").simulate(raw, clean).noise
    pairs = zip(camera.nlf(6400).shot, camera.nlf(100).shot, strict=True)
    assert stated.shot == pytest.approx([max(ratio * a, b) for a, b in pairs])
    pairs = zip(camera.nlf(6400).read, camera.nlf(100).read, strict=True)
    assert stated.read == pytest.approx([max(ratio**2 * a, b) for a, b in pairs])
