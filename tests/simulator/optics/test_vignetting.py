"""Vignetting: lensfun's model and database, and frames that have it; PRNU and dark current."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from ae_env import ExposureGrid, Scene, ScoreTables, make_scorer
from simulator import CameraSettings, CameraSimulator, NoiseLevelFunction, RawImage, get_camera
from simulator.camera import CameraProfile
from simulator.capture.prepared_scene import PreparedScene
from simulator.optics.vignetting import Vignetting, get_lens, random_lens
from simulator.reference.reference_camera import ReferenceCamera
from tests.ae_env.environments import make_env, make_envs

Z6 = get_camera("nikon_z6")
CANON = "lensfun:Canon EF 24-70mm f/2.8L II USM"
#: A quarter of the light in the corners at f/2, all of it from f/8 on.
LENS = Vignetting("test", (2.0, 8.0), ((-0.75, 0.0, 0.0), (0.0, 0.0, 0.0)))
WIDE, HALF, CLOSED = (CameraSettings(100, 1 / 64, f) for f in (2.0, 4.0, 8.0))
SIDE = 64


def squared_radius(height, width):
    """r^2 of the centres of pixels, 1 in the corners."""
    y, x = np.mgrid[:height, :width]
    y, x = y + 0.5 - height / 2, x + 0.5 - width / 2
    return (y**2 + x**2) / ((height / 2) ** 2 + (width / 2) ** 2)


def test_the_light_left_is_the_models():
    found = LENS.illumination(2.0, (40, 60))
    np.testing.assert_allclose(found, 1 - 0.75 * squared_radius(40, 60), rtol=1e-6)
    assert LENS.corner_loss(2.0) == pytest.approx(2.0)
    assert LENS.corner_loss(22.0) == 0.0  # the nearest f-number counts
    # f/4 lies half way between both, in stops
    halved = LENS.illumination(4.0, (40, 60))
    np.testing.assert_allclose(halved, 1 - 0.375 * squared_radius(40, 60), rtol=1e-6)
    relative = LENS.illumination(4.0, (40, 60), source=2.0)
    np.testing.assert_allclose(relative, halved / found, rtol=1e-6)


def test_lenses_of_lensfun_are_as_its_own_correction_has_them():
    lensfunpy = pytest.importorskip("lensfunpy")
    lens = get_lens(f"{CANON}?focal=50")
    database = lensfunpy.Database()
    known = [one for one in database.lenses if one.model == CANON.removeprefix("lensfun:")]
    for f_number in (2.8, 5.6, 16.0):
        theirs = lensfunpy.Modifier(known[0], 1.0, 1200, 800)
        flags = lensfunpy.ModifyFlags.VIGNETTING
        theirs.initialize(50.0, f_number, 1000.0, pixel_format=np.float32, flags=flags)
        corrected = np.ones((800, 1200, 3), np.float32)
        assert theirs.apply_color_modification(corrected)
        ours = lens.illumination(f_number, (800, 1200))
        np.testing.assert_allclose(
            ours * corrected[..., 0], 1.0, atol=0.01
        )  # they measure to the last pixel, not its edge
    cropped = get_lens(f"{CANON}?focal=50&crop=2")
    expected = lens.illumination(2.8, (201, 301))[50, 75]  # half way to the corner
    assert 2.0 ** -cropped.corner_loss(2.8) == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize(
    ("lens", "message"),
    [
        ("Canon", "lensfun:NAME"),
        ("lensfun:Canon EF 24-70mm f/2.8L II", "did you mean"),
        (f"{CANON}?focal=200", "must be in"),
        (f"{CANON}?zoom=2", "focal"),
        (f"{CANON}?crop=0.5", "no larger frame"),
        (7, "lens"),
    ],
)
def test_lenses_that_there_are_not(lens, message):
    pytest.importorskip("lensfunpy")
    with pytest.raises(ValueError, match=message):
        get_lens(lens)


def test_without_lensfunpy_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "lensfunpy", None)
    with pytest.raises(ImportError, match=r"ae-env\[lens\]"):
        get_lens("lensfun:a lens that no test has asked for")


@pytest.mark.parametrize(
    ("f_numbers", "coefficients"),
    [((), ()), ((4.0, 2.0), ((0.0,) * 3,) * 2), ((2.0,), ((-1.0, 0.0, 0.0),)), ((2.0,), ((0.0,),))],
)
def test_numbers_that_are_no_lens(f_numbers, coefficients):
    with pytest.raises(ValueError, match=r"f_numbers|coefficients"):
        Vignetting("wrong", f_numbers, coefficients)


def flat_raw(level, settings, nlf=None, seed=0):
    light = torch.full((4, SIDE, SIDE), level)
    if nlf is not None:
        deviation = math.sqrt(nlf.shot[0] * level + nlf.read[0])
        light += deviation * torch.randn(light.shape, generator=torch.Generator().manual_seed(seed))
    return RawImage(light, settings, camera=Z6, nlf=nlf or NoiseLevelFunction.zero())


def test_a_raw_was_taken_through_the_lens():
    """Only what the f-number changes is changed: corners brighten as the aperture closes."""
    simulator = CameraSimulator(device="cpu")
    prepared = simulator.prepare(flat_raw(0.02, WIDE), lens=LENS)
    assert "vignetting" in prepared.plan(WIDE).left_out
    assert "vignetting" in prepared.plan(CLOSED).modules
    same, closed = prepared.expected(WIDE), prepared.expected(CLOSED)
    np.testing.assert_allclose(same, 0.02, rtol=1e-5)
    wanted = 0.02 / 16 / (1 - 0.75 * squared_radius(SIDE, SIDE))
    np.testing.assert_allclose(closed[0], wanted, rtol=1e-5)
    sweep = prepared.expose([WIDE, HALF, CLOSED], noise=None)
    for frame, settings in zip(sweep, (WIDE, HALF, CLOSED), strict=True):
        alone = prepared.expected(settings)
        assert float((frame - alone).abs().max()) < 1.0 / min(Z6.span)


def test_the_noise_is_that_of_the_darkened_signal():
    """Of a noisy raw whose aperture opens, in the corner and in the centre."""
    nlf = Z6.nlf(100.0)
    level, corner = 0.05, (slice(0, 8), slice(0, 8))
    prepared = CameraSimulator(device="cpu").prepare(flat_raw(level, CLOSED, nlf), lens=LENS)
    target = CameraSettings(1600, 1 / 64 / 128, 2.0)  # twice the source's exposure
    frames = torch.stack([prepared.capture(target, seed)[0] for seed in range(40)])
    noise = Z6.nlf(1600.0)
    for part in (corner, (slice(28, 36), slice(28, 36))):
        left = 1 - 0.75 * squared_radius(SIDE, SIDE)[part].mean()
        signal = level * 2.0 * left
        found = frames[:, 0, part[0], part[1]]
        assert float(found.mean()) == pytest.approx(signal, rel=0.03)
        wanted = noise.shot[0] * signal + noise.read[0]
        assert float(found.var(dim=0).mean()) == pytest.approx(wanted, rel=0.1)


def test_the_reference_camera_has_the_same_lens():
    light = torch.rand(4, SIDE, SIDE, generator=torch.Generator().manual_seed(1))
    camera = ReferenceCamera(Z6, vignetting=LENS)
    moved = camera.expose(light, CLOSED, WIDE, image_speed=2.0)
    scene = CameraSimulator(device="cpu").prepare(
        RawImage(light.clamp(max=0.999), CLOSED, camera=Z6, nlf=NoiseLevelFunction.zero()),
        image_speed=2.0,
        tolerance=0,
    )
    through = CameraSimulator(device="cpu").prepare(scene, lens=LENS)
    np.testing.assert_allclose(through.expected(WIDE), moved, rtol=1e-3, atol=1e-4)


def frames(device=None, **arguments):
    """Frames of one scene in three environments, each at an aperture of its own, and these."""
    options = {"noise": False, "observation": "linear", **arguments}
    envs = make_envs(3, device=device, **options)
    envs.reset(seed=5, options={"scene": 0})
    for state in (0, 21, 42, 63):
        observation, *_, info = envs.step(np.array([state, 21, 63]))
        f_numbers = np.asarray(info["f_number"])
        stops = np.round(2.0 * np.log2(f_numbers))  # f/5.6 is 4 times the root of 2
        yield np.asarray(observation["raw"]), 2.0 ** (stops / 2.0)[:, None, None, None]


@pytest.mark.parametrize(
    "arguments", [{}, {"lighting": "sine"}, {"motion": "none", "depth": "far"}, {"device": "cpu"}]
)
def test_frames_of_the_environment_are_darkened(arguments):
    known = tuple(2.0 ** (stops / 2.0) for stops in range(4, 8))
    lens = Vignetting("3 / f in the corners", known, tuple((-3.0 / f, 0.0, 0.0) for f in known))
    pairs = zip(frames(**arguments), frames(lens=lens, **arguments), strict=True)
    for (plain, f_numbers), (dark, _) in pairs:
        wanted = plain * (1.0 - 3.0 / f_numbers * squared_radius(*plain.shape[-2:]))
        seen = plain < 0.999
        np.testing.assert_allclose(dark[seen], wanted[seen], atol=2e-4, rtol=1e-3)


def test_each_episode_draws_a_lens_and_its_scores_know_it():
    env = make_env(lens="random", with_oracle=True, reward="expected", noise=False)
    lenses = set()
    for seed in range(4):
        env.reset(seed=seed)
        lenses.add(env.unwrapped.core.episodes.lens(0))
        *_, info = env.step(5)
        assert info["regret"] >= 0.0
    assert len(lenses) > 1
    assert lenses <= {random_lens(number) for number in range(64)}
    plain = make_env(with_oracle=True, noise=False)
    env.reset(seed=1), plain.reset(seed=1)
    tables = [e.unwrapped.core.score_table(0).mean for e in (env, plain)]
    assert not np.allclose(*tables)


#: 10,000 electrons at white and ISO 100, 5 electrons of read noise, 800 a second in the dark.
NLF, CLEAN = NoiseLevelFunction((1e-4,) * 4, (2.5e-7,) * 4), NoiseLevelFunction.zero()
BODY = CameraProfile("body", "RGGB", 4096, 65535, 16, nlf_by_iso={100.0: NLF})
PIXELS, SECOND = replace(BODY, prnu=0.02, dark_current=800.0), CameraSettings(100, 1.0, 4)


@pytest.mark.parametrize("case", [(0.0, 4.0, 1), (0.5, 1.0, 4), (0.5, 1 / 64, 1), (0.02, 4.0, 4)])
def test_the_pattern_stays_and_dark_electrons_do_not(case):
    signal, time, box = case
    light, settings = torch.full((4, 64, 64), signal), CameraSettings(100, time, 4)
    scene = PreparedScene(light, settings, PIXELS, CLEAN, box_factor=box)
    reference, large = ReferenceCamera(PIXELS, box_factor=box), light.repeat(1, box, box)
    generator, patterns = torch.Generator().manual_seed(0), []
    for taken in (
        [scene.capture(settings, seed)[0] for seed in range(24)],
        [reference.record(large, 100.0, generator, time) for _ in range(24)],
    ):
        mean, noise = np.mean(taken, axis=0), float(np.var(taken, axis=0, ddof=1).mean())
        assert mean.mean() == pytest.approx(signal, rel=1e-3, abs=1e-4)
        electrons = 1e4 * signal + 800 * time + 25
        assert noise == pytest.approx(electrons / 1e8 / box**2, rel=0.02)
        fixed = mean.var(axis=(1, 2)).mean() - noise / 24
        assert fixed == pytest.approx((0.02 * signal / box) ** 2, rel=0.06, abs=2e-3 * noise)
        patterns.append(mean.ravel())
    assert np.corrcoef(patterns)[0, 1] > 0.9 or box > 1 or not signal  # one for both


def test_raws_keep_the_pattern_of_their_sensor():
    scene = PreparedScene(torch.full((4, 64, 64), 0.9), SECOND, PIXELS, CLEAN)
    raw = RawImage(scene.capture(SECOND)[0], SECOND, camera=PIXELS)
    again = CameraSimulator(device="cpu").prepare(raw)
    half, _ = again.capture(replace(SECOND, iso=50), 1)
    wanted = math.hypot(0.02 * 0.45, (9000 + 800 + 25) ** 0.5 / 2e4)
    assert float(half.std()) == pytest.approx(wanted, rel=0.05)
    assert "pixel_response" in again.plan(SECOND).left_out
    assert "pixel_response" not in str(replace(scene, camera=BODY).plan(SECOND).steps)


def test_score_tables_and_environments_know_both():
    grid = ExposureGrid((100.0,), (1 / 4, 2.0), (4.0,))
    scene = Scene.from_array(np.full((4, 16, 16), 0.4, np.float32), SECOND, BODY, scene_id="flat")
    table = ScoreTables(grid, PIXELS, make_scorer("noise")).table(scene)
    for state, score in zip(grid, table.mean, strict=True):
        signal, dark = 0.4 * state.exposure_time, 800 * state.exposure_time
        snr = signal / math.hypot((1e4 * signal + dark + 25) ** 0.5 / 1e4, 0.02 * signal)
        assert score == pytest.approx(1 / (1 + (18 / snr) ** 1.5), abs=5e-3)
    cameras = (("nikon_z6?prnu=0.2", None), ("nikon_z6?prnu=0.2", "cpu"), ("nikon_z6", None))
    found = [next(frames(d, camera=c, noise="bank"))[0] for c, d in cameras]
    np.testing.assert_allclose(found[0], found[1], atol=1e-3)
    assert np.abs(found[0] - found[2]).max() > 1e-3
