"""The terms against the published formulas, quadrature and hand-checked values."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.optimize
import scipy.special
import torch
from scipy.integrate import quad

from ae_env.grid import ExposureGrid
from ae_env.scenes import Scene
from ae_env.scorers import make_scorer
from ae_env.scorers.captures import describe_captures, prepare_scene
from ae_env.scorers.score_table import ScoreTables
from ae_env.scorers.terms import Sharpness
from simulator import CameraSettings, NoiseLevelFunction
from simulator.capture.prepared_scene import Layout
from simulator.optics.motion import Movement
from tests.ae_env.scorer_images import CAMERA, GRID, make_captures, make_scene, random_scene


def _by_the_formulas(
    scene: Scene, state: CameraSettings, speed: float, defocus: float
) -> dict[str, float]:
    """The scores of one state, in float64 and in the notation of the formulas."""

    def effective(settings: CameraSettings) -> float:  # recorded f-numbers are rounded
        return 2.0 ** (round(6 * np.log2(settings.f_number)) / 6)

    def exposure(settings: CameraSettings) -> float:
        return settings.exposure_time * settings.iso / effective(settings) ** 2

    alpha = exposure(state) / exposure(scene.reference)
    x = scene.light.numpy().astype(np.float64) * alpha
    height = x.shape[1]
    ev_state = np.log2(effective(state) ** 2 / state.exposure_time) - np.log2(state.iso / 100)
    if scene.illuminance is None:  # the EV at which the recorded green has a mean of 0.12
        green = scene.light.numpy()[1:3].astype(np.float64).mean(axis=0)
        factor = scipy.optimize.brentq(
            lambda f: np.minimum(green * f, 1.0).mean() - 0.12, 1e-6, 1e6, xtol=1e-14
        )
        e = np.log2(alpha / factor)
    else:
        e = np.log2(scene.illuminance / 2.5) - ev_state
    nlf = CAMERA.nlf(state.iso)
    shot, read = (np.array(v)[:, None, None] for v in (nlf.shot, nlf.read))
    # What an 8-bit code of the recorded value says of it.
    code = np.round(255 * np.sqrt((x.clip(max=1) + 2**-10) / (1 + 2**-10)))
    y = np.where(code > 8, (code / 255) ** 2 * (1 + 2**-10) - 2**-10, 0.0)
    fh = (code == 255).any(axis=0).mean()
    fs = scipy.special.expit(-(np.log2(y.clip(min=2**-40)) + 9) / 0.5).mean()
    snr = y / np.sqrt(shot * y + read)
    blur = np.hypot(
        speed * height * state.exposure_time, 4 * defocus * height / 64 / effective(state)
    )
    terms = {
        "brightness": np.exp(-(np.sqrt(1 + e**2) - 1)),
        "highlights": np.exp(-fh / 0.15),
        "shadows": np.exp(-fs / 0.20),
        "noise": (snr**1.5 / (snr**1.5 + 18**1.5)).mean(),
        "sharpness": 1 / (1 + (blur / (height / 64)) ** 2),
    }
    weights = {"brightness": 0.3, "highlights": 0.15, "shadows": 0.1, "noise": 0.2}
    weights["sharpness"] = 0.25
    product = np.prod([terms[name] ** weight for name, weight in weights.items()])
    return {**terms, "balanced": (1 - fh**4) * (1 - fs**4) * product}


@pytest.mark.parametrize("illuminance", [1000.0, None])
@pytest.mark.parametrize(("speed", "defocus"), [(0.0, 0.0), (0.3, 1.7)])
def test_scores_follow_the_formulas(illuminance, speed, defocus):
    scene = random_scene(illuminance=illuminance)
    states = [GRID[i] for i in (0, 13, 22, 37, 42, 63)]
    captures = make_captures(scene, states, speed, defocus)
    images = captures.light.clamp(0.0, 1.0)
    expected = [_by_the_formulas(scene, state, speed, defocus) for state in states]
    for name in ("brightness", "highlights", "shadows", "noise", "sharpness", "balanced"):
        scorer = make_scorer(name)
        scores = scorer(images, captures)
        assert scores.dtype == torch.float64
        wanted = [scores_of_state[name] for scores_of_state in expected]
        np.testing.assert_allclose(scores.numpy(), wanted, rtol=2e-4, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("value", [1e-9, 1e4])
def test_black_and_white_frames_score_below_a_twentieth(value: float) -> None:
    captures = make_captures(make_scene(np.full((4, 40, 40), value)), list(GRID))
    images = captures.light.clamp(0.0, 1.0)
    assert make_scorer("balanced")(images, captures).sort().values[59] < 0.05  # of 64


def test_noise_is_that_of_the_cameras_own_pixels() -> None:
    """Box-averaging does not make ISO free: only a frame's values are less noisy."""
    tables = ScoreTables(GRID, CAMERA, make_scorer("noise"))
    wanted, found = (tables.table(random_scene(box_factor=k)).mean for k in (1, 31))
    np.testing.assert_allclose(found, wanted, atol=0.01)


def test_values_by_hand() -> None:
    """Flat frames at white and at black, and a stop, 0.1 stop of bands, b0 of blur."""
    state = GRID[0]
    captures = make_captures(make_scene(np.full((4, 40, 40), 0.25)), [state] * 3)
    images = torch.tensor([1.0, 0.0, 0.25])[:, None, None, None].expand(3, 4, 40, 40)
    ev = captures.ev100
    captures = replace(captures, proper_ev=ev + torch.tensor([0.0, 1.0, -2.0]))
    captures = replace(captures, blur_px=torch.tensor([0.0, 40 / 64, 3 * 40 / 64]).double())
    expected = {
        "brightness": [1.0, math.exp(1 - math.sqrt(2)), math.exp(1 - math.sqrt(5))],
        "highlights": [math.exp(-1.0 / 0.15), 1.0, 1.0],
        "shadows": [1.0, math.exp(-1.0 / 0.2), 1.0],
        "sharpness": [1.0, 0.5, 0.1],
        "banding": [1.0, 1.0, 1.0],
    }
    for name, wanted in expected.items():
        found = make_scorer(name)(images, captures).tolist()
        assert found == pytest.approx(wanted, rel=2e-5, abs=1e-6), name


def test_noise_is_a_half_at_a_signal_to_noise_ratio_of_18() -> None:
    """With read noise alone SNR = x / sqrt(read), with shot noise alone sqrt(x / shot)."""
    captures = make_captures(make_scene(np.full((4, 40, 40), 0.5)), [GRID[0]] * 4)
    images, nothing = torch.ones(4, 4, 40, 40), (0.0,) * 4
    read, shot = (lambda v: NoiseLevelFunction(nothing, (v,) * 4)), 18.0**-2
    noises = [read(18.0**-2), read(18.0**-2 / 16), read(0.0), read(18.0**-2 / 16)]
    noises[2] = NoiseLevelFunction((shot,) * 4, nothing)
    captures = replace(captures, nlf=noises)
    wanted = [0.5, 8 / 9, 0.5, 8 / 9]
    assert make_scorer("noise")(images, captures).tolist() == pytest.approx(wanted, rel=1e-5)
    # A source that brings more noise than the settings have, or less.
    captures = replace(captures, source_noise=[read(18.0**-2 / 100)] * 3 + [read(18.0**-2)])
    wanted[3] = 0.5
    assert make_scorer("noise")(images, captures).tolist() == pytest.approx(wanted, rel=1e-5)
    captures = replace(captures, noisy=False)
    assert make_scorer("noise")(images, captures).tolist() == pytest.approx([1.0] * 4)


def test_bands_by_hand() -> None:
    """Half of the rows at 1.2 of the light, half at 0.8; brightness is the mean over the rows."""
    captures = make_captures(make_scene(np.full((4, 40, 40), 0.1)), [GRID[0]])
    rows = torch.tensor([1.2, 0.8], dtype=torch.float64).repeat_interleave(20)[None]
    captures = replace(captures, row_gain=rows, proper_ev=captures.ev100 + 1.0)
    spread = 0.5 * math.log2(1.2 / 0.8)
    assert make_scorer("banding")(None, captures).item() == pytest.approx(
        1 / (1 + (spread / 0.1) ** 2)
    )
    errors = [1 + math.log2(1.2), 1 + math.log2(0.8)]
    wanted = sum(math.exp(1 - math.sqrt(1 + e * e)) for e in errors) / 2
    assert make_scorer("brightness")(None, captures).item() == pytest.approx(wanted)
    dark = replace(captures, row_gain=torch.tensor([[1.0, 0.0]]).double())  # between pulses
    assert 0.0 < make_scorer("banding")(None, dark).item() < 1e-4


SIZE = 40
MOVEMENT = Movement(0.3, 4.0, subject_speed=0.5, subject_direction=2.5)
BLUR_GRID = ExposureGrid((100, 800), (1 / 100, 1 / 4), (4, 8))


def _scene(name: str = "laid-out") -> Scene:
    rng = np.random.default_rng(1)
    layout = Layout(
        torch.from_numpy(rng.random((SIZE, SIZE)).astype(np.float32)),
        torch.from_numpy(rng.random((SIZE, SIZE)) < 0.4),
    )
    light = np.full((4, SIZE, SIZE), 0.12)
    return make_scene(light, 640.0, scene_id=name, layout=layout)


def _wanted(scene: Scene, speed: float, defocus: float, movement: Movement) -> np.ndarray:
    """Mean sharpness of every state, pixel by pixel and by quadrature of the subject's path."""
    own = movement.subject_speed * np.exp(1j * movement.subject_direction)

    def velocity(time: float) -> float:
        return abs(speed * np.exp(1j * (movement.direction + movement.turn * time)) + own)

    found = []
    for state in BLUR_GRID:
        motion = np.full((SIZE, SIZE), speed * state.exposure_time)
        motion[scene.layout.subject] = quad(velocity, 0.0, state.exposure_time)[0]
        disc = scene.layout.defocus.numpy() * defocus * 4.0 / state.effective_f_number / 64.0
        found.append((1.0 / (1.0 + 64.0**2 * (motion**2 + disc**2))).mean())
    return np.array(found)


@pytest.mark.parametrize("defocus", [0.0, 6.0])
@pytest.mark.parametrize("movement", [MOVEMENT, Movement(1.0, -3.0)])
def test_sharpness_is_the_mean_over_the_pixels(defocus: float, movement: Movement) -> None:
    tables = ScoreTables(BLUR_GRID, CAMERA, make_scorer("balanced"))
    table = tables.table(_scene(), speed=0.2, defocus=defocus, movement=movement)
    wanted = _wanted(_scene(), 0.2, defocus, movement)
    np.testing.assert_allclose(table.parts["sharpness"], wanted, rtol=2e-3)


def test_captures_of_several_scenes_are_those_of_each() -> None:
    scenes = [_scene(), replace(_scene(), scene_id="plain", layout=None), _scene()]
    given = {"speed": (0.2, 0.1, 0.0), "defocus": (3.0, 3.0, 0.0), "gain": (1.0, 1.0, 1.0)}
    captures = describe_captures(
        scenes,
        list(BLUR_GRID)[-3:],
        CAMERA,
        movements=[MOVEMENT, MOVEMENT, replace(MOVEMENT, subject_speed=0.0)],
        **{name: np.array(values) for name, values in given.items()},
    )
    found = Sharpness()(None, captures).numpy()
    alone = 1.0 / (1.0 + (captures.blur_px[1] * 64.0 / SIZE) ** 2)
    wanted = [_wanted(_scene(), 0.2, 3.0, MOVEMENT)[-3], float(alone), 1.0]
    np.testing.assert_allclose(found, wanted, rtol=2e-3)
    assert captures.blur_px[2] == 0.0


def test_the_extent_is_the_root_mean_square() -> None:
    scene, tables = _scene(), ScoreTables(BLUR_GRID, CAMERA, make_scorer("balanced"))
    prepared = prepare_scene(scene, CAMERA, defocus=5.0)
    captures = tables.term_scores.captures.describe(scene, prepared)
    wanted = 5.0 * SIZE / 64.0 * float(scene.layout.defocus.double().square().mean().sqrt())
    assert captures.blur_px[0] == pytest.approx(wanted, rel=2e-3)
    # Discs end where the frame has them end: 64 of 256 packed pixels at f/4, the bank's has 32.
    light, layout = np.full((4, 256, 256), 0.12), Layout(torch.ones(256, 256))
    sharp = tables.table(make_scene(light, 640.0, layout=layout), defocus=16.0).parts["sharpness"]
    np.testing.assert_allclose(sharp, 1.0 / (1.0 + (32.0 / 256.0 * 64.0) ** 2), rtol=1e-2)


@pytest.mark.parametrize("layout", [True, False])
@pytest.mark.parametrize("movement", [MOVEMENT, Movement(1.0, -3.0)])
def test_sharpness_of_all_states_at_once_is_that_of_each_capture(layout, movement):
    """To the bit: rewards must not depend on how many states were scored together."""
    scene = _scene() if layout else replace(_scene(), layout=None)
    tables = ScoreTables(BLUR_GRID, CAMERA, make_scorer("balanced"))
    moves: Any = {"speed": 0.2, "defocus": 6.0, "movement": movement}
    prepared = prepare_scene(scene, CAMERA, **moves)
    found = tables.term_scores.closed_form_terms(scene, prepared, "blur")
    for index, state in enumerate(BLUR_GRID):
        numbers = {"speed": np.array([0.2]), "defocus": np.array([6.0]), "gain": np.ones(1)}
        capture = describe_captures([scene], [state], CAMERA, movements=[movement], **numbers)
        assert Sharpness()(None, capture).item() == found["sharpness"][index]
